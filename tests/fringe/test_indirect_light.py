"""Pixels of much indirect light are masked, and those of a single reflection are not."""

from dataclasses import replace

import numpy as np
import pytest

from slviewer.fringe.decode import decode, decode_reference
from slviewer.fringe.phase import Reason
from slviewer.fringe.presets import complementary, gray, micro, multifrequency, p18
from slviewer.fringe.sequence import one_axis
from slviewer.simulation.boards import Pose
from slviewer.simulation.concave import Indirect, groove
from slviewer.simulation.plans import planes, rotation, spheres
from slviewer.simulation.renderer import Renderer
from slviewer.simulation.rig import letter

RIG = letter(0.3)
UNSHARP = replace(RIG, light=replace(RIG.light, defocus_px_mm=4 * RIG.light.defocus_px_mm))
POSE = Pose(rotation(np.radians([0, 10, 0])), np.array([0, 0, 640.0]))
MISLED = Renderer(RIG, groove(POSE, 70, 0.8))
CLEAN = {
    "groove": Renderer(RIG, groove(POSE, 70, 0.8, Indirect(0))),
    "plane": Renderer(RIG, planes()["plane_03"]),
    "sphere": Renderer(RIG, spheres()["sphere_2"]),
    "unsharp sphere": Renderer(UNSHARP, spheres()["sphere_1"]),
}


def captured(renderer, sequence_of):
    sequence = one_axis(sequence_of(RIG.projector.size), "x")
    return sequence, renderer.capture(sequence, 1)


@pytest.mark.parametrize("sequence_of", [p18, multifrequency])
def test_points_of_a_wrong_period_are_masked_in_a_groove(sequence_of):
    sequence, frames = captured(MISLED, sequence_of)
    plain, masked = (decode(sequence, frames, "x", mask_indirect=each) for each in (False, True))
    truth = MISLED.truth()
    wrong = plain.mask & truth.mask & (np.abs(plain.coordinate - truth.projector[..., 0]) > 5)
    assert wrong.sum() > 200
    assert np.mean(masked.reason[wrong] == Reason.INDIRECT) > 0.95
    assert not (plain.reason == Reason.INDIRECT).any()
    assert np.isnan(masked.phase[masked.reason == Reason.INDIRECT]).all()
    assert 0.4 < masked.mask.sum() / plain.mask.sum() < 0.9


def test_narrow_stripes_are_masked_only_where_indirect_light_prevails():
    sequence, frames = captured(MISLED, micro)
    masked = decode(sequence, frames, "x")
    assert np.mean(masked.reason[MISLED.truth().mask] == Reason.INDIRECT) < 0.25


@pytest.mark.parametrize("sequence_of", [p18, complementary, multifrequency, micro, gray])
@pytest.mark.parametrize("name", CLEAN)
def test_a_single_reflection_is_not_masked(sequence_of, name):
    sequence, frames = captured(CLEAN[name], sequence_of)
    phase = decode(sequence, frames, "x")
    assert np.mean(phase.reason[CLEAN[name].truth().mask] == Reason.INDIRECT) < 0.005


def test_the_definition_masks_the_same_pixels():
    sequence, frames = captured(MISLED, p18)
    ours, reference = decode(sequence, frames, "x"), decode_reference(sequence, frames, "x")
    assert np.mean((ours.reason == Reason.INDIRECT) != (reference.reason == Reason.INDIRECT)) < 1e-3
