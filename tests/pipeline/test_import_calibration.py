"""Calibrations from other programs, against the file's own statements and against a capture of the
session."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from facts import missing_facts, raises
from sound_checks import save_sound_checks

from slviewer.errors import InputError
from slviewer.fringe.presets import multifrequency
from slviewer.fringe.sequence import one_axis
from slviewer.geometry.lens import Lens
from slviewer.geometry.rig import StereoRig
from slviewer.pipeline.import_captures import import_opencv_calibration
from slviewer.pipeline.imported_verdict import judge_imported
from slviewer.pipeline.reconstruct import reconstruct
from slviewer.session.exporters import write_calibration
from slviewer.session.importers.filestorage import read_storage
from slviewer.session.importers.opencv_calibration import read_matrices
from slviewer.session.store import Session

pytestmark = [pytest.mark.computes, pytest.mark.process]  # a process reads each storage of OpenCV

Run = Callable[..., tuple[int, str, str]]
CAMERA, PROJECTOR = (160, 120), (456, 570)
R = cv2.Rodrigues(np.array([0.01, 0.3, -0.02]))[0]
RIG = StereoRig(
    Lens(
        np.array([[400.0, 0, 78], [0, 402.0, 57], [0, 0, 1]]),
        np.array([-0.05, 0.01, 1e-3, 0, 0]),
        CAMERA,
    ),
    Lens(np.array([[700.0, 0, 230.0], [0, 1400.0, 280.0], [0, 0, 1]]), np.zeros(5), PROJECTOR),
    R,
    -R @ np.array([180.0, 5.0, 8.0]),
)


def entries(**changes: np.ndarray) -> dict[str, np.ndarray]:
    matrices = {
        "K_camera": RIG.camera.K, "D_camera": RIG.camera.D, "K_projector": RIG.projector.K,
        "D_projector": RIG.projector.D, "R": RIG.R, "T": RIG.t,
    }  # fmt: skip
    return matrices | changes


def scaled(K: np.ndarray, factor: float) -> np.ndarray:
    return np.diag([factor, factor, 1.0]) @ K


def save_wall(session: Path, name: str = "wall", axis: str = "") -> None:
    """A capture of a slanted wall along both axes, or along one, noise of one grey level."""
    u, v = np.meshgrid(np.arange(CAMERA[0], dtype=float), np.arange(CAMERA[1], dtype=float))
    rays = np.column_stack(
        [RIG.camera.undistort(np.column_stack([u.ravel(), v.ravel()])), np.ones(u.size)]
    )
    depth = 600 / (1 + 0.3 * rays[:, 0] + 0.2 * rays[:, 1])
    seen = RIG.project(rays * depth[:, None])
    sequence, rng = multifrequency(PROJECTOR, steps=4), np.random.default_rng(5)
    sequence = one_axis(sequence, axis) if axis else sequence
    frames = [
        (
            110
            + 80
            * np.cos(
                2
                * np.pi
                * (seen[:, int(frame.axis == "y")] / frame.period_px + frame.step / frame.steps)
            )
            if frame.kind == "phase"
            else np.full(u.size, 190.0)
        )
        for frame in sequence.frames
    ]
    stack = np.array(frames).reshape(-1, *u.shape) + rng.normal(0, 1, (len(frames), *u.shape))
    with Session.open_or_create(session) as store:
        store.save_capture(
            name, "scan", sequence, stack.round().astype(np.uint8), source="simulated"
        )
        save_sound_checks(store)


@pytest.fixture
def session(tmp_path: Path) -> Path:
    save_wall(tmp_path / "session")
    return tmp_path / "session"


def file(folder: Path, matrices: dict, names: tuple[str, ...] = (), **more: object) -> Path:
    renamed = dict(zip(names, matrices.values(), strict=True)) if names else matrices
    write_calibration(folder / "rig.yml", {**renamed, **more})
    return folder / "rig.yml"


COMMON_NAMES = [
    ("M1", "D1", "M2", "D2", "R", "T"),
    ("cam_K", "cam_kc", "pro_K", "pro_kc", "R", "T"),
    ("Kc", "kc", "Kp", "kp", "Rp", "Tp"),
    ("cam_int", "cam_dist", "proj_int", "proj_dist", "roration", "translation"),
    ("cameraMatrix1", "distCoeffs1", "cameraMatrix2", "distCoeffs2", "rotation", "translation"),
]


@pytest.mark.parametrize("names", COMMON_NAMES)
def test_common_names_are_recognised(tmp_path: Path, names: tuple[str, ...]) -> None:
    read = read_matrices(read_storage(file(tmp_path, entries(), names)))
    assert set(read) == set(entries())
    for name, matrix in entries().items():
        np.testing.assert_allclose(read[name], matrix, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize(
    "names",
    [COMMON_NAMES[0], *(pytest.param(names, marks=pytest.mark.slow) for names in COMMON_NAMES[1:])],
)
def test_common_names_are_imported_and_stated(
    session: Path, run: Run, tmp_path: Path, names: tuple[str, ...]
) -> None:
    path = file(tmp_path, entries(), names)
    status, out, err = run("import", "opencv-calibration", path, session)
    assert status == 0 and err == ""
    assert all(f"{entry} = {name}" in out for entry, name in zip(entries(), names, strict=True))
    assert not missing_facts(out, "camera 160x120", "projector 456x570", "180.2 mm")
    assert run("reconstruct", session, "wall", "--grid", tmp_path / "wall.npy")[0] == 0
    z = np.load(tmp_path / "wall.npy")[..., 2]
    assert 450 < np.nanmin(z) < np.nanmax(z) < 750


@pytest.mark.slow
def test_names_that_are_not_known_or_not_unique_are_asked_for(run: Run, tmp_path: Path) -> None:
    path = file(tmp_path, entries(), ("A", "B", "C", "D", "R", "T"))
    status, _, err = run("import", "opencv-calibration", path, tmp_path / "s")
    assert status == 1 and not missing_facts(err, "--keys", *"ABCDRT")
    path = file(tmp_path, entries(), M1=np.eye(3), D1=np.zeros(5), M2=np.eye(3), D2=np.zeros(5))
    status, _, err = run("import", "opencv-calibration", path, tmp_path / "s")
    assert status == 1 and not missing_facts(
        err, "K_camera", "D_camera", "M1", "D1", "M2", "D2", "--keys"
    )
    assert not (tmp_path / "s").exists()


INVERSE = {"R": RIG.R.T, "T": -RIG.R.T @ RIG.t}


@pytest.mark.parametrize(
    ("changes", "facts"),
    [
        (INVERSE, ["wall", "R", "T", "inverted"]),
        ({"K_projector": scaled(RIG.projector.K, 2)}, ["wall", "projector", "halve", "fx"]),
        pytest.param(
            {"K_projector": scaled(RIG.projector.K, 0.5)},
            ["wall", "projector", "double", "fx"],
            marks=pytest.mark.slow,
        ),
        pytest.param(
            {"K_camera": scaled(RIG.camera.K, 2)},
            ["wall", "camera's matrix", "halve", "fx"],
            marks=pytest.mark.slow,
        ),
    ],
)
def test_a_capture_contradicts_a_calibration(
    session: Path, run: Run, tmp_path: Path, changes: dict, facts: list[str]
) -> None:
    assert run("import", "opencv-calibration", file(tmp_path, entries()), session)[0] == 0
    status, _, err = run(
        "import", "opencv-calibration", file(tmp_path, entries(**changes)), session, "--force"
    )
    assert status == 1 and not missing_facts(err, *facts), err
    with Session.open(session) as store:  # nothing was replaced
        kept = store.load_result("calibration/stereo", only=())[0]["imported"]
        np.testing.assert_allclose(kept["K_projector"], RIG.projector.K)
        np.testing.assert_allclose(kept["T"], RIG.t)
        assert store.deleted_results() == []


@pytest.mark.slow
def test_a_capture_that_arrives_later_contradicts_a_calibration(run: Run, tmp_path: Path) -> None:
    session, path = tmp_path / "s", file(tmp_path, entries(**INVERSE))
    sizes = ("--projector", "456x570", "--camera", "160x120")
    assert run("import", "opencv-calibration", path, session, *sizes)[0] == 0
    save_wall(session)
    status, _, err = run("reconstruct", session, "wall")
    assert status == 3 and not missing_facts(err, "wall", "R", "T", "inverted"), err


@pytest.mark.slow
def test_sizes_that_contradict_each_other_are_refused(
    session: Path, run: Run, tmp_path: Path
) -> None:
    path = file(tmp_path, entries(), cam_size=np.array([320, 240]), pro_size=np.array(PROJECTOR))
    status, _, err = run("import", "opencv-calibration", path, session)
    assert status == 1 and not missing_facts(err, "camera", "320x240", "cam_size", "160x120")
    status, _, err = run(
        "import", "opencv-calibration", path, tmp_path / "new", "--projector", "912x1140"
    )
    assert (
        status == 1
        and not missing_facts(err, "912x1140", "456x570")
        and not (tmp_path / "new").exists()
    )
    status, out, _ = run("import", "opencv-calibration", path, tmp_path / "new")
    assert status == 0 and not missing_facts(out, "camera 320x240")


def test_a_principal_point_outside_of_the_image_is_noticed(run: Run, tmp_path: Path) -> None:
    path = file(tmp_path, entries(K_projector=scaled(RIG.projector.K, 2.2)))
    status, _, err = run(
        "import",
        "opencv-calibration",
        path,
        tmp_path / "s",
        "--projector",
        "456x570",
        "--camera",
        "160x120",
    )
    assert status == 0 and not missing_facts(err, "(506, 616)", "456x570", "scale")


def test_inspect_describes_a_session_with_an_imported_calibration_alone(
    run: Run, tmp_path: Path
) -> None:
    session = tmp_path / "s"
    assert run("import", "opencv-calibration", file(tmp_path, entries()), session)[0] == 0
    status, out, err = run("inspect", session)
    assert status == 0 and err == ""
    assert not missing_facts(out, "0 captures", "rig.yml", "not stated")
    assert not missing_facts(out, "400.0", "402.0", "700.0", "1400.0", "180.2 mm")
    save_wall(session)
    _, out, _ = run("inspect", session)
    line = next(line for line in out.splitlines() if "wall" in line)
    assert not missing_facts(line, "camera 160x120", "projector 456x570", "axes x and y")
    assert not missing_facts(line, "25 frames", "x period 16 px")


@pytest.mark.parametrize("axis", ["x", "y"])
def test_an_imported_calibration_is_not_checked_until_both_axes_agree(
    tmp_path: Path, axis: str
) -> None:
    session, path, warnings = tmp_path / "s", file(tmp_path, entries()), list[str]()
    save_wall(session, "single", axis)
    import_opencv_calibration(path, session, warn=warnings.append)
    settings = reconstruct.settings("single")
    found = reconstruct.run(session, settings, warn=warnings.append).only
    assert len([each for each in warnings if "not checked" in each]) == 2, warnings
    assert not missing_facts(found.calibration_warning, "not checked", "rig.yml", "check")
    save_wall(session, "both")
    warnings.clear()
    assert reconstruct.run(session, settings, warn=warnings.append).only.calibration_warning == ""
    assert warnings == []
    with Session.open(session) as store:
        verdict = judge_imported(store)
        assert verdict is not None and verdict.level == "good"


@pytest.mark.parametrize(("unit", "length"), [("cm", 10.0), ("inch", 25.4)])
def test_another_unit_stays_doubtful_unless_it_is_stated(
    session: Path, tmp_path: Path, unit: str, length: float
) -> None:
    path, warnings = file(tmp_path, entries(T=RIG.t / length)), list[str]()
    import_opencv_calibration(path, session, warn=warnings.append)
    assert [each for each in warnings if "unit not checked" in each and "--unit" in each], warnings
    warnings.clear()
    import_opencv_calibration(path, session, unit=unit, force=True, warn=warnings.append)
    assert warnings == []


def test_transposed_is_named_by_one_axis(tmp_path: Path) -> None:
    session = tmp_path / "s"
    save_wall(session, "single", "x")
    with raises(InputError, "single", "transposed", "MATLAB"):
        import_opencv_calibration(file(tmp_path, entries(R=RIG.R.T)), session)
