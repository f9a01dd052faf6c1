"""Calibrations that a session holds, read back."""

from pathlib import Path

import numpy as np
import pytest

from slviewer.errors import SessionError
from slviewer.session.store import Session
from slviewer.workflow.models import load_model


@pytest.mark.parametrize("name", ["pixelwise", "anchored", "splined"])
def test_a_calibration_of_another_layout_is_refused_with_what_to_do(tmp_path: Path, name: str) -> None:
    with Session.create(tmp_path / "session") as store:
        store.save_result(f"calibration/{name}", {"model": {"axes": ["x"], "periods_px": {"x": 18}}}, {"z": np.eye(2)})
        with pytest.raises(SessionError, match=f"the {name} calibration .* run `slviewer calibrate` again"):
            load_model(store, name)
