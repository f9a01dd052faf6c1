"""Pixels of much indirect light are masked, and those of a single reflection are not."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from decode_reference import decode_reference
from fringe_scene import variants
from scipy.ndimage import uniform_filter

from slviewer.fringe import indirect_light
from slviewer.fringe.decode import decode
from slviewer.fringe.decoding_task import prepare_decoding
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


def test_windows_are_those_of_filters_of_the_whole_image():
    rng = np.random.default_rng(0)
    size = 40, 60
    white = rng.integers(100, 250, size, np.uint8)
    phase, amplitude = rng.uniform(0, 2, (2, *size)).astype(np.float32)
    background = rng.uniform(50, 120, size).astype(np.float32)
    reason = (rng.random(size) < 0.2).astype(np.uint8)
    measured = np.empty((*size, 8))
    arrays = white, phase, amplitude, background, reason
    limits = np.array([240.0, 2.0, 0.1])
    indirect_light._measure_samples(0, 40, arrays, limits, np.arange(40), np.arange(60), measured)
    valid = (reason == 0) & (white < 240) & (white > background)
    light = uniform_filter(np.where(valid, white - background.astype(float), 0), 7)
    strength = np.log(uniform_filter(np.where(valid, amplitude.astype(float), 0), 7) / light)
    assert np.array_equal(np.isfinite(measured[..., 0]), valid)
    assert np.abs(measured[..., 0] - strength)[valid].max() < 1e-5
    count = 49 * uniform_filter(valid.astype(float), 7)
    sigma = np.sqrt(2 + 0.1 * (background + light)) * np.sqrt(count) / (49 * light)
    assert np.abs(measured[..., 1] / (4 * sigma) - 1)[valid].max() < 1e-5
    along = np.gradient(phase.astype(float))
    square = (along[0] ** 2 + along[1] ** 2)[1:-1, 1:-1]
    assert np.abs(measured[1:-1, 1:-1, 7] - square)[valid[1:-1, 1:-1]].max() < 1e-4


def test_no_weak_fringes_are_lost_by_the_selection_of_candidates():
    sequence, frames = captured(MISLED, p18)
    task = prepare_decoding(sequence, frames, "x")
    plain = decode(sequence, frames, "x", mask_indirect=False)
    maps = plain.phase, plain.wrapped, plain.modulation, plain.background, plain.reason
    masked = tuple(each.copy() for each in maps)
    indirect_light._mask_weak_fringes(task, frames[-1], masked)
    weak = np.flatnonzero(masked[-1] == Reason.INDIRECT)
    assert np.isnan(masked[0].ravel()[weak]).all()
    assert sequence.frames[-1].kind == "texture"
    arrays, limits = (frames[-1], maps[0], *maps[2:]), np.array([task.white, *task.noise])
    sampled = indirect_light._sample_strength(arrays, limits)
    fit, spread = indirect_light._fit_strength(sampled[:, 0], sampled[:, 2:])
    everywhere = np.empty((*frames.shape[1:], 8))
    height, width = frames.shape[1:]
    pixels = np.arange(height), np.arange(width)
    indirect_light._measure_samples(0, height, arrays, limits, *pixels, everywhere)
    margin = spread - np.log(1 - indirect_light.WEAK) + everywhere[..., 1]
    expected = np.flatnonzero(everywhere[..., 0] < everywhere[..., 2:] @ fit - margin)
    assert len(expected) > 1000
    assert np.array_equal(weak, expected)
