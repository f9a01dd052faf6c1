"""Pixels of much indirect light are masked, and those of a single reflection are not."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from fringe_scene import variants

from slviewer.fringe.decode import decode, decode_reference
from slviewer.fringe.phase import Reason
from slviewer.fringe.presets import complementary, gray, micro, multifrequency, p18
from slviewer.fringe.sequence import one_axis
from slviewer.simulation.boards import Pose
from slviewer.simulation.concave import Indirect, groove
from slviewer.simulation.plans import planes, rotation, spheres
from slviewer.simulation.renderer import Renderer
from slviewer.simulation.rig import letter

pytestmark = pytest.mark.computes

RIG = letter(0.3)
UNSHARP = replace(RIG, light=replace(RIG.light, defocus_px_mm=4 * RIG.light.defocus_px_mm))
POSE = Pose(rotation(np.radians([0, 10, 0])), np.array([0, 0, 640.0]))
MISLED = "groove with interreflections"
SCENES = {
    MISLED: lambda: (RIG, groove(POSE, 70, 0.8)),
    "groove": lambda: (RIG, groove(POSE, 70, 0.8, Indirect(0))),
    "plane": lambda: (RIG, planes()["plane_03"]),
    "sphere": lambda: (RIG, spheres()["sphere_2"]),
    "unsharp sphere": lambda: (UNSHARP, spheres()["sphere_1"]),
}


@cache
def renderer_of(scene):
    return Renderer(*SCENES[scene]())


@cache
def captured(scene, sequence_of):
    sequence = one_axis(sequence_of(RIG.projector.size), "x")
    return sequence, renderer_of(scene).capture(sequence, 1)


@pytest.mark.slow
@pytest.mark.parametrize("sequence_of", variants([p18, multifrequency], p18))
def test_points_of_a_wrong_period_are_masked_in_a_groove(sequence_of):
    sequence, frames = captured(MISLED, sequence_of)
    plain, masked = (decode(sequence, frames, "x", mask_indirect=each) for each in (False, True))
    truth = renderer_of(MISLED).truth()
    wrong = plain.mask & truth.mask & (np.abs(plain.coordinate - truth.projector[..., 0]) > 5)
    assert wrong.sum() > 200
    assert np.mean(masked.reason[wrong] == Reason.INDIRECT) > 0.95
    assert not (plain.reason == Reason.INDIRECT).any()
    assert np.isnan(masked.phase[masked.reason == Reason.INDIRECT]).all()
    assert 0.4 < masked.mask.sum() / plain.mask.sum() < 0.9


@pytest.mark.slow
def test_narrow_stripes_are_masked_only_where_indirect_light_prevails():
    sequence, frames = captured(MISLED, micro)
    masked = decode(sequence, frames, "x")
    assert np.mean(masked.reason[renderer_of(MISLED).truth().mask] == Reason.INDIRECT) < 0.25


@pytest.mark.parametrize(
    "sequence_of", variants([p18, complementary, multifrequency, micro, gray], complementary)
)
@pytest.mark.parametrize(
    "name", variants([name for name in SCENES if name != MISLED], "unsharp sphere")
)
def test_a_single_reflection_is_not_masked(sequence_of, name):
    sequence, frames = captured(name, sequence_of)
    phase = decode(sequence, frames, "x")
    assert np.mean(phase.reason[renderer_of(name).truth().mask] == Reason.INDIRECT) < 0.005


@pytest.mark.slow
def test_the_definition_masks_the_same_pixels():
    sequence, frames = captured(MISLED, p18)
    ours, reference = decode(sequence, frames, "x"), decode_reference(sequence, frames, "x")
    assert np.mean((ours.reason == Reason.INDIRECT) != (reference.reason == Reason.INDIRECT)) < 1e-3
