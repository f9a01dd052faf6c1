"""One pass over the frames against the definitions: NumPy's decoding, and each model's own
points."""

from dataclasses import replace

import numpy as np
import pytest
from decode_reference import decode_reference
from facts import raises

from slviewer.calibration.pixelwise import PixelFit, PixelwiseModel
from slviewer.calibration.splined.compiled import CompiledAxis
from slviewer.calibration.splined.model import SplinedModel
from slviewer.errors import InputError
from slviewer.fringe.decode import texture
from slviewer.fringe.patterns import profile
from slviewer.fringe.presets import complementary, gray, multifrequency, p18
from slviewer.reconstruction import onepass_kernels as kernels
from slviewer.reconstruction.onepass import OnePass

pytestmark = pytest.mark.computes

PROJECTOR = (912, 1140)
HEIGHT, WIDTH = 61, 150
SEQUENCES = {
    "18 steps and Gray code": p18(PROJECTOR),
    "3 steps and complementary code": complementary(PROJECTOR, 3, 18.0),
    "three frequencies of 4 steps": multifrequency(PROJECTOR, 4),
    "heterodyne, 7 steps": multifrequency((400, 400), 7, (18.0, 21.0, 25.0)),
    "offset and falling phase": replace(
        complementary(PROJECTOR, 4, 18.0), phase_offset_rad=1.9, phase_sign=-1
    ),
}


def frames_of(sequence, dtype=np.uint8, seed=0):
    """Noisy frames of a wavy surface with a depth step, a shadow and a glare."""
    rng = np.random.default_rng(seed)
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    coordinate = 60 + 0.9 * u + 0.1 * v + 2 * np.sin(v / 9)
    coordinate[20:40, 50:90] += 31.3
    gain = np.full(coordinate.shape, 170.0)
    gain[:, :9], gain[50:, 100:120] = 0.5, 300.0
    frames = np.empty((len(sequence.frames), HEIGHT, WIDTH))
    for i in range(len(frames)):
        along, levels = profile(sequence, i)
        seen = (
            np.zeros_like(coordinate)
            if along == "y"
            else np.interp(coordinate, np.arange(len(levels)), levels)
        )
        frames[i] = 15 + gain * seen / 255 + rng.normal(0, 1.5, coordinate.shape)
    full, depth = (255, 1) if dtype == np.uint8 else (4095, 16)
    return np.clip(np.rint(frames * depth), 0, full).astype(dtype)


def pixelwise(period_px=18.0):
    rng = np.random.default_rng(1)
    shape = HEIGHT, WIDTH
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    c = np.stack(
        [400 + 0.02 * u, np.full(shape, 1.4), np.full(shape, -9e-4), (u - 75) / 300, (v - 30) / 300]
    )
    c[:, rng.random(shape) < 0.01] = np.nan
    low, high = np.full(shape, 22, np.float32), np.full(shape, 38, np.float32)
    ones = np.ones(shape, np.float32)
    fit = PixelFit(c, np.stack([ones] * 3), np.full(shape, 20, np.uint16), low, high, ones)
    return PixelwiseModel({"x": fit}, {"x": period_px}, {}, "x")


def splined():
    """A made-up compiled form: what a joint adjustment would leave, with cells that no pose
    illuminated."""
    rng = np.random.default_rng(2)
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    shape, step = (HEIGHT, WIDTH), 6
    c = np.stack([560 + 0.02 * u, np.full(shape, 0.5), np.full(shape, -4e-4)]).astype(np.float32)
    grid = rng.normal(0, 0.1, ((HEIGHT - 1) // step + 2, (WIDTH - 1) // step + 2, 17)).astype(
        np.float32
    )
    held = grid.copy()
    held[2, 3:5] = np.nan
    model = object.__new__(SplinedModel)
    rays = np.stack([(u - 75) / 300, (v - 30) / 300])
    vars(model).update(
        rays=rays, _compiled={"x": CompiledAxis(c, 155.5, grid, held, step, 500.0, 600.0)}
    )
    return model


def points_of(model, phase):
    if isinstance(model, PixelwiseModel):
        return model.points(phase), model.sigma_z(phase, None)
    fast, per_rad = model.fast_axis("x"), phase.period_px / (2 * np.pi)
    points = fast.depth(phase.phase, per_rad, model.rays.astype(np.float32), True)
    return points, fast.depth_per_px(phase.phase, per_rad) * np.float32(per_rad) * phase.sigma_phase


@pytest.mark.slow
@pytest.mark.parametrize("make", [pixelwise, splined])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize(
    "name",
    [
        "18 steps and Gray code",
        "heterodyne, 7 steps",
        "offset and falling phase",
        "3 steps and complementary code",
        "three frequencies of 4 steps",
    ],
)
def test_it_is_the_definition(name, dtype, make):
    sequence, model = SEQUENCES[name], make()
    frames = frames_of(sequence, dtype)
    scan = OnePass(sequence, model, "x").run(frames)
    phase = decode_reference(sequence, frames, "x")
    np.testing.assert_array_equal(scan.reason, phase.reason)
    np.testing.assert_allclose(scan.phase, phase.phase, rtol=0, atol=1e-4)
    np.testing.assert_allclose(scan.modulation, phase.modulation, rtol=1e-5, atol=1e-3)
    points, sigma = points_of(model, phase)
    assert 0.3 < np.isfinite(points[..., 2]).mean() < 1.0
    off = np.isfinite(scan.points) != np.isfinite(points)  # on the very limit of what is measured
    assert off.sum() <= 6
    np.testing.assert_allclose(scan.points[~off], points[~off], rtol=0, atol=1e-3)
    seen = np.isfinite(points[..., 2]) & np.isfinite(scan.points[..., 2])
    np.testing.assert_allclose(scan.sigma_z[seen], sigma[seen], rtol=1e-3)
    np.testing.assert_array_equal(scan.texture, texture(sequence, frames))


@pytest.mark.slow
def test_misread_edges_are_moved_and_measured_again():
    sequence, model = SEQUENCES["18 steps and Gray code"], pixelwise()
    frames = frames_of(sequence)
    one = OnePass(sequence, model, "x")
    before = one.sweep(frames)
    swept = before.phase.copy()
    one.repair_spikes(before)
    moved = np.abs(before.phase - swept) > 1
    lost = np.isnan(before.phase) & np.isfinite(swept)
    phase = decode_reference(sequence, frames, "x")
    np.testing.assert_allclose(before.phase[moved], phase.phase[moved], atol=1e-4)
    np.testing.assert_allclose(before.points[moved], model.points(phase)[moved], atol=1e-3)
    assert lost.any() and np.isnan(before.points[lost]).all()


@pytest.mark.slow
def test_arrays_and_light_are_used_again():
    sequence = SEQUENCES["three frequencies of 4 steps"]
    one = OnePass(sequence, pixelwise(16.0), "x")
    first = one.run(frames_of(sequence))
    points = first.points.copy()
    other = one.run(frames_of(sequence, seed=3), first.light, first)
    assert other.points is first.points and not np.array_equal(points, other.points, equal_nan=True)
    again = one.run(frames_of(sequence), first.light, other)
    np.testing.assert_array_equal(again.points, points)
    cloud = again.cloud()
    assert cloud.points is again.points and cloud.axis == "x" and cloud.model == "pixelwise"


def test_light_of_fewer_bits_than_the_frames_is_measured_anew(monkeypatch):
    """The kernel is replaced by what it reports, the largest grey levels: for uint16 it takes long
    to compile."""
    sequence, whites = SEQUENCES["three frequencies of 4 steps"], []
    frames = frames_of(sequence, np.uint16)

    def sweep_rows(
        first, last, stack, shifts, ladder, rules, scale, depths, maps, texture, indices, peaks
    ):
        whites.append(scale.white)
        peaks[first // kernels.ROWS : -(-last // kernels.ROWS)] = stack.max()

    monkeypatch.setattr(kernels, "sweep_rows", sweep_rows)
    one = OnePass(sequence, pixelwise(16.0), "x")
    dim = one.light((frames // 16).astype(np.uint16))
    assert dim.white == 255
    assert one.sweep(frames, dim).light.white == 4095
    assert set(whites) == {255.0, 4095.0}


@pytest.mark.slow
def test_a_camera_of_more_bits_than_the_last_light_says_is_judged_anew():
    sequence = SEQUENCES["three frequencies of 4 steps"]
    one = OnePass(sequence, pixelwise(16.0), "x")
    dim = one.light((frames_of(sequence, np.uint16) // 16).astype(np.uint16))
    assert dim.white == 255
    scan = one.run(frames_of(sequence, np.uint16), dim)
    assert scan.light.white == 4095 and np.isfinite(scan.phase).mean() > 0.5


def test_it_refuses_what_it_cannot_do():
    with raises(InputError, "phase steps"):
        OnePass(gray(PROJECTOR), pixelwise(), "x")
    with raises(InputError, "periods"):
        OnePass(replace(SEQUENCES["18 steps and Gray code"], gray_cell_px=9.0), pixelwise(), "x")
    with raises(InputError, "relative"):
        OnePass(replace(multifrequency(PROJECTOR, 4, (16.0,)), relative=True), pixelwise(), "x")
    with raises(InputError, "axis y"):
        OnePass(SEQUENCES["18 steps and Gray code"], pixelwise(), "y")
    one = OnePass(SEQUENCES["18 steps and Gray code"], pixelwise(), "x")
    with pytest.raises(InputError):
        one.run(frames_of(SEQUENCES["18 steps and Gray code"])[:, 1:])
