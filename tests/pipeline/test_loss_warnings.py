"""A capture of which much is masked says why: saturation, or fringes near the least that is
decoded."""

import dataclasses

import cv2
import numpy as np
import pytest
from facts import missing_facts

from slviewer.fringe.presets import complementary
from slviewer.fringe.scatter import SIGNIFICANT
from slviewer.pipeline.capture_phases import decode_frames, loss_warnings
from slviewer.simulation.boards import Pose, blank_board
from slviewer.simulation.renderer import Renderer
from slviewer.simulation.rig import letter

pytestmark = pytest.mark.computes

PLANE = blank_board(Pose(np.eye(3), np.array([0.0, 0.0, 600.0])))


def said(peak_level: float) -> str:
    rig = letter(0.15)
    rig = dataclasses.replace(rig, sensor=dataclasses.replace(rig.sensor, peak_level=peak_level))
    sequence = complementary(rig.projector.size)
    frames = Renderer(rig, PLANE).capture(sequence)
    phases = decode_frames("plane", sequence, frames)
    return " ".join(loss_warnings(sequence, frames, phases))


@pytest.mark.parametrize(("peak_level", "word"), [(400.0, "saturated"), (16.0, "weak")])
def test_the_reason_of_many_masked_pixels_is_named(peak_level, word):
    assert not missing_facts(said(peak_level), word)


@pytest.mark.parametrize("peak_level", [212.0, 60.0])
def test_a_sound_capture_says_nothing(peak_level):
    assert said(peak_level) == ""


def test_compressed_frames_are_named():
    rig = letter(0.3)
    sequence = complementary(rig.projector.size)
    frames = Renderer(rig, PLANE).capture(sequence)
    recorded = [cv2.imencode(".jpg", frame, [cv2.IMWRITE_JPEG_QUALITY, 60])[1] for frame in frames]
    frames = np.stack([cv2.imdecode(each, cv2.IMREAD_GRAYSCALE) for each in recorded])
    phases = decode_frames("plane", sequence, frames)
    factor = max(phase.sigma_scale for phase in phases.values())
    [message] = loss_warnings(sequence, frames, phases)
    assert factor > SIGNIFICANT
    assert not missing_facts(message, f"{factor:.1f}", "JPEG")
