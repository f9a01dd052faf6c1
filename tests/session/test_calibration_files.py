"""Calibrations from and for other programs."""

import cv2
import numpy as np
import pytest
from facts import raises

from slviewer.errors import InputError
from slviewer.session.exporters import write_calibration
from slviewer.session.importers import opencv_calibration
from slviewer.session.importers.filestorage import Storage, read_storage

KEYS = ("M1", "D1", "M2", "D2", "rot", "trans")


def rig() -> dict[str, np.ndarray]:
    return {
        "M1": np.array([[3450.5, 0, 583.25], [0, 3449.5, 525.125], [0, 0, 1]]),
        "D1": np.array([[-0.08, 0.11, 1e-3, -2e-3, 0.03]]),
        "M2": np.array([[1890.0, 0, 484], [0, 1892.0, 855], [0, 0, 1]]),
        "D2": np.array([[0.02, 0.01, -1e-3, 2e-3]]),
        "rot": cv2.Rodrigues(np.array([0.1, -0.2, 0.3]))[0],
        "trans": np.array([[94.6], [-625.7], [-247.1]]),
    }


def write(path, entries):
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for key, value in entries.items():
        storage.write(key, value)
    storage.release()
    return path


@pytest.mark.process
@pytest.mark.parametrize("suffix", [".yml", ".xml", ".json"])
def test_a_file_of_opencv_is_read(tmp_path, suffix):
    read = opencv_calibration.read_matrices(
        read_storage(write(tmp_path / f"a{suffix}", {"note": "made elsewhere", **rig()})), KEYS
    )
    assert list(read) == list(opencv_calibration.ENTRIES)
    for key, entry in zip(KEYS, opencv_calibration.ENTRIES, strict=True):
        expected = np.append(rig()[key], 0.0) if key == "D2" else rig()[key]
        shape = {"D": (5,), "T": (3,)}.get(entry[0], (3, 3))
        assert read[entry].shape == shape and read[entry].dtype == np.float64
        np.testing.assert_allclose(read[entry], expected.reshape(shape), rtol=1e-14, atol=1e-14)


@pytest.mark.process
@pytest.mark.parametrize("suffix", [".yml", ".yaml", ".xml", ".json"])
def test_what_is_written_is_read_back(tmp_path, suffix):
    entries = dict(zip(opencv_calibration.ENTRIES, rig().values(), strict=True))
    entries["D_projector"] = np.append(entries["D_projector"], 0.5)
    entries["T"] = entries["T"].ravel()
    path = tmp_path / f"calibration{suffix}"
    for _ in range(2):  # the second replaces the first
        write_calibration(
            path, {**entries, "rms_px": 0.25, "camera_size": (1600, 1200), "program": "slviewer"}
        )
    read = opencv_calibration.read_matrices(read_storage(path))
    for key, value in entries.items():
        np.testing.assert_allclose(
            read[key], value.reshape(read[key].shape), rtol=1e-14, atol=1e-14
        )
    assert [entry.name for entry in tmp_path.iterdir()] == [path.name]


def test_what_cannot_be_written_leaves_the_old_file(tmp_path):
    path = tmp_path / "a.yml"
    write_calibration(path, {"a": 1})
    before = path.read_bytes()
    with raises(InputError, "b"):
        write_calibration(path, {"a": 1, "b": np.zeros((2, 2, 2))})
    with pytest.raises(InputError):
        write_calibration(tmp_path / "a.txt", {"a": 1})
    assert path.read_bytes() == before


@pytest.mark.parametrize(
    ("change", "facts"),
    [
        ({"trans": "absent"}, ("trans", "M1", "D1", "M2", "D2", "rot")),
        ({"rot": np.eye(3) * 1.01}, ("rot", "rotation", 0.01, 1.03)),
        ({"rot": -np.eye(3)}, ("rot", "rotation", "determinant -1")),
        ({"rot": np.zeros((3, 1))}, ("rot", "(3, 1)")),
        ({"trans": np.zeros((2, 1))}, ("trans", "(2, 1)")),
        ({"trans": np.array([[0.3, 0.0, 0.0]])}, ("trans", 0.3, "mm")),
        ({"trans": np.array([[1e308, 1e308, 0.0]])}, ("trans", "1.41e+308", "mm")),
        ({"M1": np.eye(4)}, ("M1", "(4, 4)", "3x3")),
        ({"M1": rig()["M1"].T}, ("M1", "camera matrix")),
        ({"M1": rig()["M1"] + np.array([[0, 2, 0], [0, 0, 0], [0, 0, 0]])}, ("M1", "skew", "2.0")),
        ({"M1": rig()["M1"] * np.nan}, ("M1", "finite")),
        ({"D1": np.full((1, 8), 0.1)}, ("D1", 8, "k1 k2 p1 p2 k3")),
        ({"D1": np.zeros((1, 6))}, ("D1", "(1, 6)", 4, 5, 8, 12, 14)),
        ({"M2": None}, ("M2", "matrix")),
    ],
)
@pytest.mark.filterwarnings("error")  # which NumPy would print beside the message
def test_what_cannot_be_used_is_named(change, facts):
    entries = {
        key: value for key, value in {**rig(), **change}.items() if not isinstance(value, str)
    }
    with raises(InputError, "a.yml", *facts):
        opencv_calibration.read_matrices(Storage("a.yml", entries), KEYS)


@pytest.mark.process
def test_entries_of_a_file_that_cannot_be_used_are_named(tmp_path):
    storage = read_storage(
        write(tmp_path / "a.yml", {**rig(), "M1": rig()["M1"] * np.nan, "M2": "words"})
    )
    with raises(InputError, "a.yml", "M1", "finite"):
        opencv_calibration.read_matrices(storage, KEYS)
    with raises(InputError, "a.yml", "M2", "matrix"):
        opencv_calibration.read_matrices(storage, ("M2", *KEYS[1:]))


@pytest.mark.process
def test_other_shapes_that_mean_the_same(tmp_path):
    changed = {
        "D1": np.concatenate([rig()["D1"], np.zeros((1, 3))], axis=1).T,
        "trans": rig()["trans"].T,
        "rot": rig()["rot"].round(6),
    }
    read = opencv_calibration.read_matrices(
        read_storage(write(tmp_path / "a.yml", {**rig(), **changed})), KEYS
    )
    np.testing.assert_array_equal(read["D_camera"], rig()["D1"].ravel())
    np.testing.assert_array_equal(read["T"], rig()["trans"].ravel())
    np.testing.assert_allclose(read["R"], rig()["rot"], atol=2e-6)
    np.testing.assert_allclose(read["R"] @ read["R"].T, np.eye(3), atol=1e-14)


NO_STORAGE = ("", "no storage", "%YAML:1.0\n---\nM1: !!opencv-matrix\n   rows: 3")
SUFFIXES = (".yml", ".xml", ".json")


@pytest.mark.process
@pytest.mark.parametrize(
    ("content", "suffix"),
    [
        pytest.param(content, suffix, marks=[] if i == j else pytest.mark.slow)
        for i, content in enumerate(NO_STORAGE)
        for j, suffix in enumerate(SUFFIXES)
    ],
)
def test_files_that_are_no_storage(tmp_path, content, suffix):
    path = tmp_path / f"a{suffix}"
    path.write_text(content)
    with raises(InputError, f"a{suffix}"):
        opencv_calibration.read_matrices(read_storage(path), KEYS)


def test_a_file_or_keys_that_are_missing(tmp_path):
    with raises(InputError, "absent.yml"):
        opencv_calibration.read_matrices(read_storage(tmp_path / "absent.yml"), KEYS)
    with raises(InputError, "2 keys"):
        opencv_calibration.read_matrices(Storage("a.yml", {}), KEYS[:2])


@pytest.mark.process
def test_a_real_file_in_two_parts(real_data):
    with raises(InputError, "intrinsic.yml", "R, T", "M1, D1, M2, D2"):
        opencv_calibration.read_matrices(
            read_storage(real_data / "slmaster_david" / "intrinsic.yml"),
            ("M1", "D1", "M2", "D2", "R", "T"),
        )


@pytest.mark.process
@pytest.mark.parametrize(
    ("suffix", "content"),
    [
        (".json", '{"a": ' + "[" * 100_000),
        (".yml", "%YAML:1.0\n---\na: " + "[" * 100_000),
        (".xml", "<?xml version='1.0'?><opencv_storage>" + "<a>" * 100_000),
        (
            ".yml",
            (
                "%YAML:1.0\n---\nM1: !!opencv-matrix\n   rows: 2000000000\n   cols: 2000000000\n  "
                " dt: d\n   data: [1]\n"
            ),
        ),
    ],
)
def test_a_file_that_crashes_the_parser_is_refused(tmp_path, suffix, content):
    path = tmp_path / f"a{suffix}"
    path.write_text(content)
    with raises(InputError, f"a{suffix}"):
        opencv_calibration.read_matrices(read_storage(path), KEYS)


@pytest.mark.process
def test_other_entries_of_a_file_do_not_matter(tmp_path):
    others = {"points": np.zeros((300, 200)), "M0": np.full((3, 3), np.nan), "note": "M1"}
    storage = read_storage(write(tmp_path / "a.yml", {**others, **rig()}))
    assert storage.entries["points"] is None and list(storage.entries) == [*others, *rig()]
    np.testing.assert_array_equal(
        opencv_calibration.read_matrices(storage, KEYS)["K_camera"], rig()["M1"]
    )
