"""A projector's size against the codes that were seen."""

import numpy as np
import pytest

from slviewer.errors import InputError
from slviewer.fringe.phase import PhaseMap, Reason
from slviewer.fringe.presets import p18
from slviewer.workflow.decoding import check_projector


def seen(outside: float) -> PhaseMap:
    flat = np.zeros((100, 100), np.float32)
    reason = np.full(flat.shape, Reason.VALID, np.uint8)
    reason.flat[: round(outside * reason.size)] = Reason.OUTSIDE
    return PhaseMap("x", 18.0, flat, flat, flat, flat, reason, (1.0, 0.0), 18)


def test_a_strip_of_codes_beyond_the_projector_contradicts_its_size() -> None:
    sequence = p18((1024, 768))
    check_projector("pose_01", sequence, {"x": seen(0.004)})  # the rim that blur lights
    with pytest.raises(InputError, match=r"pose_01: 2\.0 % of the x codes .* 1024 columns"):
        check_projector("pose_01", sequence, {"x": seen(0.02)})
