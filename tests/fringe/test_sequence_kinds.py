"""Every kind of sequence that can be described comes back as the coordinate that was rendered."""

from dataclasses import replace

import numpy as np
import pytest
from decode_reference import decode_reference
from facts import raises
from fringe_scene import capture, coverage, slope, variants, wrong
from scipy.ndimage import gaussian_filter

from slviewer.errors import InputError
from slviewer.fringe.decode import decode
from slviewer.fringe.phase import Reason
from slviewer.fringe.presets import (
    bits_for,
    complementary,
    gray,
    gray_bits,
    multifrequency,
    p18,
    phase_steps,
)
from slviewer.fringe.sequence import Frame, PatternSequence, PerAxis

pytestmark = pytest.mark.computes

SIZE = (500, 500)
INNER = np.s_[:, 5:-5]  # the simulated lens blur repeats the image's border


def mixed(periods, *, cell=None, steps=6, half=False, inverse=False, **conventions):
    """Phase steps of some periods and Gray bits of some cells, one axis after the other."""
    frames = []
    for axis in ("x", "y"):
        for period in periods:
            frames += phase_steps(axis, steps, period)
        if cell is not None:
            bits = gray_bits(axis, bits_for((SIZE[0] + 2 * cell) / cell))
            frames += bits + [replace(bit, kind="inverse") for bit in bits if inverse]
        if half:
            frames.append(Frame("complementary", axis))
    return PatternSequence(
        SIZE, (*frames, Frame("white"), Frame("black")), gray_cell_px=cell, **conventions
    )


def cells(width, **conventions):
    return mixed((), cell=width, inverse=True, **conventions)


ABSOLUTE = {
    "offset": replace(complementary(SIZE, 5, 18.0), phase_offset_rad=np.pi / 2),
    "offset and sign by axis": replace(
        p18(SIZE),
        phase_offset_rad=PerAxis(-2.5, np.pi),
        phase_sign=PerAxis(-1, 1),
        gray_origin_px=PerAxis(-3.0, -0.5),
    ),
    "several periods, offset": replace(multifrequency(SIZE), phase_offset_rad=1.0),
    "half a period": mixed((18.0,), cell=9.0),
    "third of a period": mixed((24.0,), cell=8.0, gray_origin_px=-5.0),
    "no simple ratio": mixed((20.0,), cell=13.3),
    "nearly a period": mixed((20.0,), cell=19.0),
    "quarter, inverses": mixed((16.0,), cell=4.0, inverse=True, steps=4),
    "half a period, complementary": mixed((32.0,), cell=16.0, half=True),
    "two periods": mixed((64.0, 12.0), cell=64.0),
    "two periods, complementary": mixed((48.0, 12.0), cell=48.0, half=True),
    "two periods, cells of the finer": mixed((64.0, 16.0), cell=16.0, steps=4),
    "three periods": mixed((90.0, 30.0, 10.0), cell=45.0, phase_sign=-1),
    "cells of a beat": mixed((20.0, 18.0), cell=90.0, steps=8),
    "two periods, the first a tenth longer than the projector": mixed((550.0, 20.0), cell=20.0),
    "a beat of two beats": mixed(tuple(500 / k for k in (31, 36, 42)), steps=3),
    "a beat, rounded to less than the projector": mixed((20.8333, 19.9999), steps=8),
}
RELATIVE = {
    "one period": (mixed((40.0,), relative=True), 40.0),
    "two relative periods": (mixed((128.0, 16.0), relative=True, phase_offset_rad=0.7), 128.0),
    "a beat": (mixed((20.0, 18.0), steps=8, relative=True), 180.0),
    "no projector size": (replace(mixed((128.0, 16.0)), projector_size=None), 128.0),
}


def error_px(phase, truth):
    """(h, w) px: distance from the truth, modulo the range that the phase tells apart."""
    error = phase.coordinate - truth
    if phase.is_relative:
        error -= phase.unambiguous_px * np.rint(error / phase.unambiguous_px)
    return error[INNER]


def frames_of(sequence, truth, **light):
    return capture(replace(sequence, projector_size=SIZE), truth, **light)


def assert_measured(sequence, axis, truth, least_coverage=0.99, **light):
    """Right to the noise predicted, with no pixel off by more than noise can be."""
    phase = decode(sequence, frames_of(sequence, truth, axis=axis, **light), axis)
    error, sigma = (
        error_px(phase, truth),
        (phase.sigma_phase * phase.period_px / (2 * np.pi))[INNER],
    )
    assert np.nanmax(np.abs(error)) < 0.4 * phase.period_px
    predicted = np.sqrt(np.nanmean(sigma**2))
    assert 0.8 * predicted < np.sqrt(np.nanmean(error**2)) < 1.15 * predicted
    assert coverage(phase) > least_coverage
    return phase


@pytest.mark.parametrize(
    "name",
    variants(
        ABSOLUTE,
        "offset and sign by axis",
        "no simple ratio",
        "half a period, complementary",
        "three periods",
        "a beat of two beats",
        "a beat, rounded to less than the projector",
    ),
)
def test_the_coordinate_comes_back(name):
    sequence = ABSOLUTE[name]
    for axis in ("x", "y"):
        phase = assert_measured(sequence, axis, slope())
        assert not phase.is_relative


@pytest.mark.parametrize("name", variants(RELATIVE, "a beat", "no projector size"))
def test_a_relative_phase_is_right_modulo_what_it_states(name):
    sequence, reach = RELATIVE[name]
    phase = assert_measured(sequence, "x", slope(per_px=1.2))
    assert phase.unambiguous_px == pytest.approx(reach)
    # cut at -0.5 and a whole range beyond, where noise allows
    coordinate = phase.coordinate[phase.mask]
    assert -3 < coordinate.min() < 1 and reach - 2 < coordinate.max() < reach + 2


@pytest.mark.parametrize("width", variants([2.0, 3.0, 8.0], 3.0))
@pytest.mark.parametrize("origin", variants([-0.5, -1.5], -1.5))
def test_gray_code_alone_is_known_to_its_cell(width, origin):
    sequence, truth = cells(width, gray_origin_px=origin), slope()
    phase = decode(sequence, frames_of(sequence, truth, defocus=0.3), "x")
    assert phase.period_px == width and sequence.period_px("x") == width
    sigma = (phase.sigma_phase * phase.period_px / (2 * np.pi))[phase.mask]
    assert np.allclose(sigma, width / np.sqrt(12), rtol=1e-6)
    assert coverage(phase) > 0.99
    error = error_px(phase, truth)
    # A pixel on a border is known better than to its cell.
    assert 0.6 * sigma[0] < np.sqrt(np.nanmean(error**2)) < 1.05 * sigma[0]
    assert np.nanmax(np.abs(error)) < 0.5 * width + 0.6


def test_the_last_cell_of_a_gray_code_ends_with_the_projector():
    sequence = cells(16.0)  # 500 px: the last of 32 cells shows only 4 of its 16 px
    truth = slope(start=400.0)
    phase = decode(sequence, frames_of(sequence, truth, defocus=0.3), "x")
    last = (truth > 496.5) & (truth < 498.5)
    assert np.count_nonzero(last) > 100 and phase.mask[last].mean() > 0.95
    assert np.nanmax(np.abs(phase.coordinate - truth)[last]) < 2.5


LIGHTS = [
    {"read": 1.0},
    {"gain": 50, "read": 3.0},
    {"defocus": 3.0, "psf": 1.5, "gamma": 2.2, "gain": 290},
]


@pytest.mark.parametrize(
    "name",
    variants(
        [*ABSOLUTE, *RELATIVE, "cells"],
        "no simple ratio",
        "two periods, cells of the finer",
        "one period",
        "cells",
    ),
)
@pytest.mark.parametrize("light", variants(LIGHTS, {"gain": 50, "read": 3.0}))
def test_kernels_agree_with_the_definition(name, light):
    sequence = {**ABSOLUTE, "cells": cells(4.0)}.get(name) or RELATIVE[name][0]
    truth = slope()
    truth[30:90, 60:130] += 31.3
    rng = np.random.default_rng(2)
    stacks = [frames_of(sequence, truth, **light)]
    stacks += [rng.integers(0, 256, (len(sequence.frames), 23, 31)).astype(np.uint8)]
    stacks += [
        np.zeros((len(sequence.frames), 5, 7), np.uint8),
        np.full((len(sequence.frames), 3, 1), 255, np.uint8),
    ]
    for frames in stacks:
        fast, definition = decode(sequence, frames, "x"), decode_reference(sequence, frames, "x")
        np.testing.assert_array_equal(fast.reason, definition.reason)
        np.testing.assert_allclose(fast.phase, definition.phase, rtol=0, atol=1e-4)
        assert (
            fast.unambiguous_px == definition.unambiguous_px
            and fast.period_px == definition.period_px
        )


@pytest.mark.parametrize("name", variants(ABSOLUTE, "half a period", "several periods, offset"))
def test_dim_blurred_and_clipped_pixels_are_masked_rather_than_wrong(name):
    sequence, truth = ABSOLUTE[name], slope()
    truth[30:90, 60:130] += 31.3
    gain = np.full(truth.shape, 180.0)
    gain[:, :40], gain[:, 100:130], gain[:, 160:] = 0.0, 330.0, 25.0
    phase = decode(sequence, frames_of(sequence, truth, gain=gain, read=2.0, psf=0.3), "x")
    assert (phase.reason[:, :39] == Reason.DARK).mean() > 0.99
    assert (phase.reason[:, 102:128] == Reason.SATURATED).mean() > 0.9
    assert phase.mask[:, 42:98].mean() > 0.95
    off = np.abs(phase.coordinate - truth) > 0.4 * phase.period_px
    assert np.count_nonzero(off & phase.mask) <= 2


def test_levels_that_scatter_leave_fewer_pixels_but_no_wrong_fringe():
    """An error of the long period of 20 % of a fringe, as of light that changed."""
    frames = [*phase_steps("x", 6, 512.0), *phase_steps("x", 6, 32.0)]
    sequence, truth = PatternSequence((512, 500), tuple(frames)), slope()
    stack = capture(sequence, truth)
    error = gaussian_filter(np.random.default_rng(5).normal(size=truth.shape), 15)
    stack[:6] = capture(sequence, truth + 0.2 * 32 / error.std() * error)[:6]
    phase = decode(sequence, stack, "x")
    assert wrong(phase, truth) == 0 and 0.2 < phase.mask.mean() < 0.7


@pytest.mark.slow
def test_random_sequences_come_back():
    """Periods, cells, origins, signs and offsets that nobody chose."""
    rng = np.random.default_rng(11)
    for _ in range(12):
        finest = rng.uniform(10, 24)
        periods = [finest, finest * rng.uniform(2.5, 5)][: rng.integers(1, 3)]
        sequence = mixed(
            periods[::-1],
            cell=float(periods[-1] * rng.choice([1.0, 0.5, 1 / 3, rng.uniform(0.3, 0.95)])),
            steps=int(rng.integers(4, 9)),
            inverse=bool(rng.integers(2)),
            phase_sign=PerAxis(int(rng.choice([-1, 1])), 1),
            phase_offset_rad=float(rng.uniform(-7, 7)),
            gray_origin_px=float(-rng.uniform(0.5, 9)),
        )
        assert_measured(sequence, "x", slope(start=20.0), 0.98)


@pytest.mark.parametrize(
    ("sequence", "facts"),
    [
        (mixed((18.0,), cell=36.0), ("18 px", "36 px", "gray_cell_px")),
        (mixed((18.0,)), ("18 px", "500", "relative = true")),
        (mixed((100.0, 16.0), relative=True), ("100, 16 px", "16 px")),
        (replace(multifrequency(SIZE), projector_size=None), ("550, 128, 16 px", "projector")),
        (replace(cells(4.0), gray_cell_px=3.0), (128, "3 px", 167)),
    ],
)
def test_what_no_frame_can_tell_is_refused_with_the_figures(sequence, facts):
    stack = np.zeros((len(sequence.frames), 8, 10), np.uint8)
    for decoder in (decode, decode_reference):
        with raises(InputError, *facts):
            decoder(sequence, stack, "x")


CODED = {
    "steps and code": p18(SIZE),
    "code": gray(SIZE),
    "cells of half a period": ABSOLUTE["half a period"],
}


@pytest.mark.parametrize("name", variants(CODED, "cells of half a period"))
def test_without_a_projector_size_a_gray_code_is_absolute_and_nothing_is_outside(name):
    sequence = CODED[name]
    frames = capture(sequence, slope())
    phase = decode(replace(sequence, projector_size=None), frames, "x")
    known = decode(sequence, frames, "x")
    assert not phase.is_relative
    np.testing.assert_array_equal(phase.phase, known.phase)
