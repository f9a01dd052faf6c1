"""A share of the image before in each image: measured where a series of steps begins; nothing else
is taken for it."""

from functools import cache

import numpy as np
import pytest
from facts import missing_facts
from fringe_scene import variants

from slviewer.fringe.ghost import detect_ghosting, measure_ghost_share
from slviewer.fringe.layout import axis_layout, white_level
from slviewer.fringe.noise import measure_noise
from slviewer.fringe.presets import p18
from slviewer.fringe.residual_sample import sample_fringe
from slviewer.simulation.boards import Pose, blank_board
from slviewer.simulation.hostile import FAULTS, expose_frames, render_light
from slviewer.simulation.rig import letter

pytestmark = pytest.mark.computes

RIG = letter(0.15)
SEQUENCE = p18(RIG.projector.size)


@cache
def rendered():
    """The light of all frames of a board, and its renderer."""
    return render_light(RIG, blank_board(Pose(np.eye(3), np.array([0.0, 0.0, 600.0]))), SEQUENCE)


def sampled(fault=None, severity="mild", axis="y"):
    light, renderer = rendered()
    frames = expose_frames(
        RIG, light, SEQUENCE, renderer.room_light(), 0, FAULTS[fault] if fault else None, severity
    )
    layout, white = (
        axis_layout(SEQUENCE, axis),
        white_level(SEQUENCE, frames, SEQUENCE.select(axis)),
    )
    return sample_fringe(frames, layout.shifts[-1], measure_noise(layout, frames, white), white)


@pytest.mark.parametrize(
    ("severity", "share"),
    variants([("mild", 0.02), ("medium", 0.06), ("severe", 0.15)], ("mild", 0.02)),
)
def test_the_share_of_the_image_before_is_measured(severity, share):
    measured, error = measure_ghost_share(sampled("crosstalk", severity))
    assert measured == pytest.approx(share, rel=0.2) and error < 0.002
    (suspect,) = detect_ghosting(sampled("crosstalk", severity))
    first = next(i for i, frame in enumerate(SEQUENCE.frames) if frame.axis == "y")
    assert suspect.fault == "strange" and suspect.frame == first
    assert not missing_facts(suspect.sentence, first + 1, f"{100 * measured:.0f} %")


OTHERS = [
    (None, "mild"), ("vignetting", "severe"), ("gamma", "mild"), ("defocus", "severe"),
    ("auto-exposure", "mild"),
    ("room-light", "medium"), ("jpeg", "severe"), ("hot-pixels", "severe"),
    ("dim-projector", "severe"),
]  # fmt: skip


@pytest.mark.parametrize(
    ("fault", "severity"), variants(OTHERS, (None, "mild"), ("auto-exposure", "mild"))
)
def test_nothing_else_is_taken_for_it(fault, severity):
    assert detect_ghosting(sampled(fault, severity)) == []


def test_the_first_frame_of_a_capture_lacks_the_share_of_the_others():
    assert measure_ghost_share(sampled("crosstalk", "severe", "x"))[0] == pytest.approx(
        0.15, rel=0.25
    )
    assert detect_ghosting(sampled(axis="x")) == []
    (suspect,) = detect_ghosting(sampled("crosstalk", "severe", "x"))
    assert suspect.frame == 0 and not missing_facts(suspect.sentence, 1, "first")
