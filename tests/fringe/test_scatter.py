"""Noise of the phase between neighbouring pixels, which the phase steps of a pixel do not
contain."""

import cv2
import numpy as np
import pytest
from decode_reference import decode_reference
from fringe_scene import capture, slope, variants
from proofs.simulated_capture import draw_setup, render_capture

from slviewer.fringe.decode import decode
from slviewer.fringe.presets import complementary
from slviewer.fringe.scatter import BLOCKINESS, SIGNIFICANT, measure_scatter

pytestmark = pytest.mark.computes

SEQUENCE = complementary((256, 64))
SHAPE = (176, 240)


def frames_of(coordinate=None, **scene):
    return capture(SEQUENCE, slope(*SHAPE) if coordinate is None else coordinate, read=1.5, **scene)


def jpeg(frames, quality):
    recorded = [
        cv2.imencode(".jpg", frame, [cv2.IMWRITE_JPEG_QUALITY, quality])[1] for frame in frames
    ]
    return np.stack([cv2.imdecode(each, cv2.IMREAD_GRAYSCALE) for each in recorded])


def scatter_over_sigma(phase):
    """The true one, robust."""
    error = (phase.coordinate - slope(*SHAPE))[24:-24, 24:-24] * 2 * np.pi / phase.period_px
    sigma = phase.sigma_phase[24:-24, 24:-24]
    z = ((error - np.nanmedian(error)) / sigma)[np.isfinite(error)]
    return float(np.sqrt(np.mean(np.sort(z**2)[: int(0.99 * len(z))])))


@pytest.mark.parametrize("quality", variants([85, 65, 50], 65))
def test_sigma_holds_for_compressed_frames(quality):
    phase = decode(SEQUENCE, jpeg(frames_of(), quality), "x")
    assert measure_scatter(phase).is_compressed
    assert 0.7 < scatter_over_sigma(phase) < 1.25


@pytest.mark.parametrize(
    ("kind", "seed"),
    variants([("heterodyne", 9511), ("multifrequency", 9523)], ("heterodyne", 9511)),
)
def test_sigma_holds_where_compression_spoils_pixels_in_every_window(kind, seed):
    setup = draw_setup(kind, seed, "JPEG 70")
    shot = render_capture(setup)
    phase = decode(setup.described, shot.stack, "y")
    is_inner = phase.mask & (phase.edge_error_px < 0.3 * phase.sigma_px)
    z = np.abs(phase.coordinate - shot.truth["y"])[is_inner] / phase.sigma_px[is_inner]
    assert 0.8 < np.nanmedian(z) / 0.6745 < 1.25  # 4.8 where nothing was measured


def test_sigma_of_sound_frames_is_not_raised():
    phase = decode(SEQUENCE, frames_of(), "x")
    found = measure_scatter(phase)
    assert 0.93 < found.ratio < 1.07
    assert found.blockiness < 0.8 * BLOCKINESS
    assert phase.sigma_scale == 1.0


def test_texture_and_steps_are_no_scatter():
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]]
    dots = 180.0 * np.where((u // 9 + v // 9) % 2, 1.0, 0.4)
    phase = decode(SEQUENCE, frames_of(slope(*SHAPE) + 25.0 * (u > 110), gain=dots), "x")
    assert phase.sigma_scale == 1.0


def test_scatter_of_neighbours_raises_sigma_without_compression():
    rng = np.random.default_rng(3)
    coordinate = slope(*SHAPE) + 0.08 * rng.normal(size=SHAPE)
    phase = decode(SEQUENCE, frames_of(coordinate, psf=0.01), "x")
    found = measure_scatter(phase)
    assert not found.is_compressed
    assert phase.sigma_scale == pytest.approx(found.ratio)
    assert phase.sigma_scale > SIGNIFICANT


def test_the_definition_measures_the_same():
    frames = jpeg(frames_of(), 65)
    fast, defined = (f(SEQUENCE, frames, "x").sigma_scale for f in (decode, decode_reference))
    assert fast > 1.0
    assert fast == pytest.approx(defined, rel=1e-3)
