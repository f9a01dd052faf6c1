"""Calibrations and parts of reported situations, through the commands."""

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from facts import missing_facts
from reports4 import make_case

Run = Callable[..., tuple[int, str, str]]
pytestmark = [pytest.mark.computes, pytest.mark.slow]


def test_stereo_calibrations_of_other_conventions_are_named_or_warned_of(
    real_data: Path, tmp_path: Path, run: Run
) -> None:
    case = make_case(real_data, "04-matlab-stereo", tmp_path / "case")
    for name in ("right", "inverted", "matlab"):
        session = shutil.copytree(case / "s", case / f"s_{name}")
        options = ("opencv-calibration", case / f"{name}.json", session, "--force")
        status, _, err = run("import", *options)
        assert status == 0
        assert not missing_facts(err, "not checked", "R and T", "inverted", "axes")
        status, _, err = run(
            "reconstruct", session, "sphere_3", "--out", case / f"{name}.ply", "--model", "stereo"
        )
        assert status == 0
        assert not missing_facts(err, "not checked", "R and T", "inverted", "axes")
    for name, facts in (("transposed", ("R is transposed",)), ("metres", ("--unit", 0.18))):
        session = shutil.copytree(case / "s", case / f"s_{name}")
        options = ("opencv-calibration", case / f"{name}.json", session, "--force")
        status, _, err = run("import", *options)
        assert status == 1
        assert not missing_facts(err, *facts)


def test_parts_that_lack_or_exceed_a_feature_fail(
    real_data: Path, tmp_path: Path, run: Run
) -> None:
    case = make_case(real_data, "17-wrong-part", tmp_path / "case")
    session, names = case / "s", ("right", "short", "moved", "mirror")
    assert run("import", "cloud", session, *(case / f"{name}.ply" for name in names))[0] == 0
    for name in names:
        options = (session, name, case / "plate.stl", "--tolerance", "0.2")
        status, out, err = run("compare", *options)
        assert status == (0 if name == "right" else 1), err
        if name == "short":
            assert not missing_facts(out, "fail", "material of the model is missing", "18.6")
        if name == "mirror":
            assert not missing_facts(out + err, "fail", "mirror")
