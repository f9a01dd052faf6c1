"""Calibrations that a session holds, read back."""

from pathlib import Path

import numpy as np
import pytest

from slviewer.errors import SessionError
from slviewer.session.store import Session
from slviewer.workflow.models import load_model, warn_if_stale


@pytest.mark.parametrize("name", ["pixelwise", "anchored", "splined"])
def test_a_calibration_of_another_layout_is_refused_with_what_to_do(tmp_path: Path, name: str) -> None:
    with Session.create(tmp_path / "session") as store:
        store.save_result(f"calibration/{name}", {"model": {"axes": ["x"], "periods_px": {"x": 18}}}, {"z": np.eye(2)})
        with pytest.raises(SessionError, match=f"the {name} calibration .* run `slviewer calibrate` again"):
            load_model(store, name)


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
    assert sentence.startswith("the stereo and splined calibrations were made from target poses that have since")
