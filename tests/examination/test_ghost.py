"""A share of the image before in each image: measured where a series of steps begins; nothing else
is taken for it."""

from functools import cache

import numpy as np
import pytest
from facts import missing_facts
from fringe_scene import variants

from slviewer.examination.evaluate import Evaluator, described
from slviewer.examination.examine import examine
from slviewer.examination.ghost import has_ghost, measure_ghost
from slviewer.examination.sample import sample_capture
from slviewer.fringe.presets import p18
from slviewer.simulation.boards import Pose, blank_board
from slviewer.simulation.rig import letter
from tests.proofs.hostile_rig import FAULTS, SOUND, expose_frames, render_light

pytestmark = pytest.mark.computes

RIG = letter(0.15)
SEQUENCE = p18(RIG.projector.size)


@cache
def rendered():
    """The light of all frames of a board, and its renderer."""
    return render_light(RIG, blank_board(Pose(np.eye(3), np.array([0.0, 0.0, 600.0]))), SEQUENCE)


def exposed(fault=None, severity="mild"):
    """The frames of a capture with a fault."""
    light, renderer = rendered()
    return expose_frames(renderer, light, SEQUENCE, 0, FAULTS[fault] if fault else SOUND, severity)


def evaluated(fault=None, severity="mild"):
    return Evaluator(sample_capture(SEQUENCE, exposed(fault, severity))), described(SEQUENCE)


@pytest.mark.parametrize(
    ("severity", "share"),
    variants([("mild", 0.02), ("medium", 0.06), ("severe", 0.15)], ("severe", 0.15)),
)
def test_the_share_of_the_image_before_is_measured(severity, share):
    measured, error = measure_ghost(*evaluated("crosstalk", severity))
    assert measured == pytest.approx(share, rel=0.35, abs=0.01) and error < 0.005


def test_a_ghost_is_named_with_its_share():
    (found,) = examine(SEQUENCE, exposed("crosstalk", "severe")).findings
    assert found.cause == "ghosting" and found.severity == "doubtful"
    share = 100 * has_ghost(*evaluated("crosstalk", "severe"))
    assert not missing_facts(found.observation, f"{share:.0f} %")


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
    assert has_ghost(*evaluated(fault, severity)) == 0.0
