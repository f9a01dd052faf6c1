"""Captures of reported situations: codes that are not what they are taken for, and raw mosaics."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from facts import missing_facts, raises
from reports4 import make_case

from slviewer.errors import InputError
from slviewer.pipeline.capture_phases import decode_capture
from slviewer.pipeline.import_captures import import_captures
from slviewer.session.importers.guessed_frames import guess_description
from slviewer.session.store import Session

pytestmark = pytest.mark.computes


def import_scan(source: Path, session: Path, layout: str, **options: Any) -> list[str]:
    """Import one capture, and return the warnings."""
    warnings: list[str] = []
    import_captures(source, session, layout, role="scan", warn=warnings.append, **options)
    return warnings


def decoded_error(session: Path, axis: str, truth: np.ndarray) -> np.ndarray:
    """px, where decoded."""
    with Session.open(session) as store:
        (name,) = store.capture_names("scan")
        phase = decode_capture(store.load_capture(name))[axis]
    return (phase.coordinate - truth)[phase.mask]


def binary_truth() -> dict[str, np.ndarray]:
    v, u = np.mgrid[:144, :192].astype(float)
    step = (u > 70) & (u < 125) & (v > 45) & (v < 105)
    return {
        "x": 250 + 2.4 * u + 8 * np.sin(v / 25) + 12 * step,
        "y": 180 + 2.3 * v + 5 * np.sin(u / 30),
    }


@pytest.fixture(scope="module")
def binary(real_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_case(real_data, "13-binary-code", tmp_path_factory.mktemp("binary"))


@pytest.mark.slow
def test_plain_binary_code_is_named_and_decoded_as_described(binary: Path, tmp_path: Path) -> None:
    with raises(InputError, "binary numbers", "Gray", 'code = "binary"'):
        import_scan(binary / "binary", tmp_path / "a", "opencv-graycode", projector="1024x768")
    with raises(InputError, "Gray code", 'code = "gray"'):
        import_scan(binary / "gray", tmp_path / "b", "frames", sequence=binary / "binary.toml")
    import_scan(binary / "binary", tmp_path / "c", "frames", sequence=binary / "binary.toml")
    for axis, truth in binary_truth().items():
        error = np.abs(decoded_error(tmp_path / "c", axis, truth))
        assert len(error) > 0.7 * truth.size
        assert 0.1 < np.median(error) < 0.6
        assert np.mean(error > 4) < 0.002  # at the border of the step


@pytest.mark.slow
def test_plain_binary_code_is_guessed(binary: Path) -> None:
    for name, code in (("binary", True), ("gray", False)):
        guess = guess_description(binary / name, None, None)
        assert not guess.doubts
        assert ('code = "binary"' in guess.toml) == code


def test_an_unknown_kind_lists_the_kinds(binary: Path, tmp_path: Path) -> None:
    text = (binary / "binary.toml").read_text().replace('"binary"', '"binry"')
    (tmp_path / "typo.toml").write_text(text)
    with raises(InputError, "binry", "phase", "gray", "binary", "white"):
        import_scan(binary / "binary", tmp_path / "s", "frames", sequence=tmp_path / "typo.toml")


def test_few_periods_are_named_or_imported_as_relative(real_data: Path, tmp_path: Path) -> None:
    case = make_case(real_data, "14-few-periods", tmp_path / "case")
    for name, count, period in (
        ("three_one", 3, 304),
        ("three_one_8_steps", 3, 304),
        ("eight_one", 8, 114),
    ):
        described = case / f"{name}.toml"
        with raises(InputError, count, period, 912, "relative = true"):
            import_scan(case / name, tmp_path / "refused", "frames", sequence=described)
        described = case / f"{name}_relative.toml"
        assert not import_scan(case / name, tmp_path / name, "frames", sequence=described)
    assert not import_scan(
        case / "one_one", tmp_path / "one", "frames", sequence=case / "one_one.toml"
    )


def test_cells_of_several_pixels_are_named_and_stated(real_data: Path, tmp_path: Path) -> None:
    case = make_case(real_data, "20-graycode-cells-of-3px", tmp_path / "case")
    layout = "procam-calibration"
    with raises(InputError, 38, 44, "3 px", "--cell 3"):
        import_scan(case / "data", tmp_path / "a", layout, projector="1280x800")
    import_scan(case / "data", tmp_path / "b", layout, projector="1280x800", cell=3)
    truth = np.load(case / "truth.npz")
    for axis in ("x", "y"):
        error = np.abs(decoded_error(tmp_path / "b", axis, truth[axis]))
        assert 0.3 < np.median(error) < 1.5


def test_a_raw_mosaic_is_noticed(real_data: Path, tmp_path: Path) -> None:
    case = make_case(real_data, "21-bayer-as-grey", tmp_path / "case")
    warnings = import_scan(case / "poses", tmp_path / "s", "detect")
    assert len(warnings) == 1
    assert not missing_facts(warnings[0], "pose_01", "mosaic", "67 %", "Bayer")
