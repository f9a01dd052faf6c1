"""Calibrations that a session holds, read back."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from slviewer.errors import InputError, SessionError
from slviewer.pipeline.models import available_models, load_model, preferred_model, warn_if_stale
from slviewer.session.store import Session
from slviewer.wizard.operator import Operator


@pytest.mark.parametrize("name", ["pixelwise", "splined"])
def test_a_calibration_of_another_layout_is_refused_with_what_to_do(tmp_path: Path, name: str) -> None:
    with Session.create(tmp_path / "session") as store:
        store.save_result(f"calibration/{name}", {"model": {"axes": ["x"], "periods_px": {"x": 18}}}, {"z": np.eye(2)})
        with pytest.raises(SessionError, match=f"{name}.*`slviewer calibrate`"):
            load_model(store, name)


def test_a_calibration_of_a_model_that_is_no_more_is_ignored(recorded: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(recorded / "session", tmp_path / "session"))
    with Session.open(folder, write=True) as store:
        store.save_result("calibration/anchored", {"model": {"axes": ["x"]}, "inputs": {}}, {"z": np.eye(2)})
        store.decide("model", "anchored")
        assert available_models(store) == ("stereo", "pixelwise", "splined") and preferred_model(store) == "splined"
        with pytest.raises(InputError, match=r"anchored .*stereo, pixelwise, splined"):
            load_model(store, "anchored")
    with Operator(folder) as operator:
        shown = operator.wait_for(lambda s: s.session is not None and s.session.calibration is not None, 20.0)
        assert shown is not None and shown.session is not None and shown.session.calibration is not None
        assert shown.session.calibration.models == ("stereo", "pixelwise", "splined")


def test_what_is_stale_is_told_in_one_sentence(tmp_path: Path) -> None:
    said: list[str] = []
    with Session.create(tmp_path / "session") as store:
        for name in ("stereo", "splined"):
            store.save_result(f"calibration/{name}", {"inputs": {}}, {"z": np.eye(2)})
        warn_if_stale(store, said.append)
        assert not said
        for name in ("stereo", "splined"):
            store.save_result(f"calibration/{name}", {"inputs": {"pose_01": "gone"}}, {"z": np.eye(2)})
        warn_if_stale(store, said.append)
    (sentence,) = said
    assert "stereo" in sentence and "splined" in sentence


def test_the_wizard_opens_a_session_of_another_version_and_says_what_to_do(recorded: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(recorded / "session", tmp_path / "session"))
    shutil.rmtree(folder / "results" / "calibration" / "splined")
    with Session.open(folder, write=True) as store:
        meta = store.load_result("calibration/pixelwise", only=())[0]
        kept = {key: meta[key] for key in ("model", "inputs", "settings")}
        store.save_result("calibration/pixelwise", kept, {"coefficients": np.zeros((2, 2))})
    with Operator(folder) as operator:
        shown = operator.wait_for(lambda s: s.session is not None and s.session.calibration is not None, 20.0)
        assert shown is not None and shown.session is not None and shown.session.calibration is not None
        assert "version" in shown.session.calibration.stale
        assert shown.session.calibration.stereo.reprojection_rms_px


@pytest.mark.parametrize("name", ["pixelwise", "splined"])
def test_a_calibration_is_loaded_again_only_when_it_has_changed(recorded: Path, tmp_path: Path, name: str) -> None:
    folder = Path(shutil.copytree(recorded / "session", tmp_path / "session"))
    with Session.open(folder, write=True) as store:
        first = load_model(store, name)
        assert load_model(store, name) is first
        meta, arrays = store.load_result(f"calibration/{name}")
        saved = {key: meta[key] for key in ("model", "inputs", "settings")}
        store.save_result(f"calibration/{name}", {**saved, "settings": {"changed": 1}}, dict(arrays))
        assert load_model(store, name) is not first
