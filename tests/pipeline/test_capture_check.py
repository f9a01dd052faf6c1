"""A capture is measured, or refused for what contradicts it."""

import re
from dataclasses import replace

import numpy as np
import pytest
from facts import raises

from slviewer.errors import InputError
from slviewer.examination.light import look_at
from slviewer.fringe.phase import PhaseMap, Reason
from slviewer.fringe.presets import p18
from slviewer.fringe.sequence import one_axis
from slviewer.pipeline.capture_phases import (
    check_capture,
    decode_examined,
    decode_frames,
    decode_or_explain,
)
from slviewer.pipeline.examination import examine_frames
from slviewer.records.verdict import Examination
from slviewer.simulation.boards import Pose, blank_board
from slviewer.simulation.renderer import Renderer
from slviewer.simulation.rig import letter

PROJECTOR = (912, 1140)
SEQUENCE = one_axis(p18(PROJECTOR), "x")


@pytest.fixture(scope="module")
def frames() -> np.ndarray:
    plate = blank_board(Pose(np.eye(3), np.array([0.0, 0.0, 600.0])))
    return Renderer(letter(0.15), plate).capture(SEQUENCE)


@pytest.mark.computes
def test_a_sound_capture_passes(frames: np.ndarray) -> None:
    examination = examine_frames(SEQUENCE, frames)
    assert examination.warnings() == []
    assert {*decode_examined("pose_01", SEQUENCE, frames)} == {"x"}


@pytest.mark.computes
def test_the_most_probable_contradiction_is_the_reason(frames: np.ndarray) -> None:
    wrong = replace(SEQUENCE, gray_origin_px=8.5)
    examination = examine_frames(wrong, frames)
    assert {finding.axis for finding in examination.rejected} == {"x"}
    with raises(InputError, "pose_01", "gray_origin", "phase_offset") as refusal:
        check_capture("pose_01", wrong, frames, decode_frames("pose_01", wrong, frames))
    stated = {
        key: float(value)
        for key, value in re.findall(
            r"(gray_origin|phase_offset) = (-?[\d.]+\d)", str(refusal.value)
        )
    }
    assert -0.6 < stated["gray_origin"] < -0.4 and 3.1 < abs(stated["phase_offset"]) < 3.2
    assert "phase_offset" in examination.warnings()[0]


@pytest.mark.computes
def test_frames_that_do_not_decode_are_explained(frames: np.ndarray) -> None:
    wide = replace(SEQUENCE, gray_cell_px=36.0)
    with pytest.raises(InputError):
        decode_frames("pose_01", wide, frames)
    look = look_at(wide, frames)
    for decode, given in ((decode_examined, frames), (decode_or_explain, look)):
        with raises(InputError, "pose_01", "gray_cell_px = 18"):
            decode("pose_01", wide, given)


def seen(decoded: float, otherwise: Reason) -> PhaseMap:
    flat = np.zeros((100, 100), np.float32)
    reason = np.full(flat.shape, otherwise, np.uint8)
    reason.flat[: round(decoded * reason.size)] = Reason.VALID
    return PhaseMap("x", 18.0, flat, flat, flat, flat, reason, (1.0, 0.0), 18)


@pytest.mark.parametrize(
    ("decoded", "otherwise", "facts"),
    [
        (0.0002, Reason.INCONSISTENT, ["2 of 10000", "100 %", "contradict"]),
        (0.03, Reason.SATURATED, ["300 of 10000", "97 %", "saturated", "exposure"]),
        (0.0, Reason.DARK, ["no pixel", "x", "modulation", "exposure"]),
        (0.3, Reason.INCONSISTENT, []),
    ],
)
def test_a_capture_of_which_next_to_nothing_decodes_is_refused(
    decoded: float, otherwise: Reason, facts: list[str]
) -> None:
    phases, sound = {"x": seen(decoded, otherwise)}, Examination()
    frames = np.zeros((len(SEQUENCE.frames), 40, 40), np.uint8)
    if not facts:
        check_capture("scan", SEQUENCE, frames, phases, sound)
        return
    with raises(InputError, "scan", *facts):
        check_capture("scan", SEQUENCE, frames, phases, sound)
