"""Frames against the truth behind them: coordinates, noise, blur, exposure."""

from dataclasses import replace

import numba
import numpy as np
import pytest
from decode_reference import decode_reference
from facts import raises

from slviewer.errors import InputError
from slviewer.fringe.presets import p18, phase_steps
from slviewer.fringe.sequence import Frame, PatternSequence
from slviewer.simulation.boards import BoardShape, Pose, blank_board, printed_board
from slviewer.simulation.film import psf_taps
from slviewer.simulation.plans import rotation
from slviewer.simulation.renderer import Renderer
from slviewer.simulation.rig import letter
from slviewer.simulation.scenes import sphere
from slviewer.target.board import Board
from slviewer.target.detect import detect

pytestmark = pytest.mark.computes

PROJECTOR = (912, 1140)
FACING = Pose(np.eye(3), np.array([0.0, 0.0, 580.0]))
PHASE_X = PatternSequence(PROJECTOR, tuple(phase_steps("x", 18, 18.0)))


def predicted_sigma(rig, A, B, steps=18):
    """rad, from the sensor's specification: sigma_phi = sqrt(2/n) sigma_I / B."""
    variance = (
        rig.sensor.read_variance + rig.sensor.shot_variance * (A - rig.sensor.dark_level) + 1 / 12
    )
    return np.sqrt(2 / steps * variance) / B


def shift(stack):
    """Wrapped phase, background and modulation of 18 steps."""
    delta = 2 * np.pi * np.arange(18) / 18
    C, S = (np.tensordot(f(delta), stack[:18].astype(float), 1) for f in (np.cos, np.sin))
    return np.arctan2(-S, C), stack[:18].mean(0), np.hypot(C, S) / 9


def test_frames_decode_to_the_true_coordinates_but_for_the_specified_noise():
    rig = letter(0.25)
    renderer = Renderer(
        rig, blank_board(Pose(rotation(np.array([0.2, 0.3, 0])), np.array([0, 0, 600.0])))
    )
    truth, sequence = renderer.truth(), p18(PROJECTOR)
    stack = renderer.capture(sequence, seed=4)
    # pixels mixed with the dark beside the plate are noisier than specified
    inner = truth.mask.copy()
    for axis in (0, 1):
        for step in (-1, 1):
            inner &= np.roll(truth.mask, step, axis)
    for k, axis in enumerate(("x", "y")):
        phase = decode_reference(sequence, stack, axis)
        assert phase.mask[inner].mean() > 0.999
        good = inner & phase.mask
        error = (phase.coordinate - truth.projector[..., k])[good]
        sigma = (predicted_sigma(rig, phase.background, phase.modulation) * 18 / (2 * np.pi))[good]
        assert 0.95 < np.sqrt(np.mean(error**2) / np.mean(sigma**2)) < 1.06
        assert abs(error.mean()) < 5e-4


def test_the_plane_floor_at_580_mm():
    rig = letter(0.25)
    renderer = Renderer(rig, blank_board(FACING, (400, 300)))
    _, A, B = shift(renderer.capture(PHASE_X))
    assert 100 < np.median(A) < 130 and 75 < np.median(B) < 95
    points = renderer.truth().points
    du_dz = (rig.project(points * (580.5 / 580)) - rig.project(points * (579.5 / 580)))[..., 0]
    sigma_z = predicted_sigma(rig, A, B) * 18 / (2 * np.pi) / np.abs(du_dz)
    assert 0.033 < np.sqrt(np.mean(sigma_z**2)) < 0.039


def test_noise_has_the_specified_variance():
    rig = letter(0.25)
    white = PatternSequence(PROJECTOR, tuple(Frame("white") for _ in range(60)))
    board = printed_board(
        Board.parse("circles:21x16:9"), Pose(np.eye(3), np.array([-90.0, -67.5, 620.0]))
    )
    stack = Renderer(rig, board).capture(white).astype(float)
    level, variance = stack.mean(0), stack.var(0, ddof=1)
    for low, high in ((15, 40), (130, 170), (170, 215)):
        chosen = (level > low) & (level < high)
        expected = (
            rig.sensor.read_variance
            + rig.sensor.shot_variance * (level[chosen].mean() - 3)
            + 1 / 12
        )
        assert chosen.sum() > 500
        assert variance[chosen].mean() == pytest.approx(expected, rel=0.03)
    noise = (stack - level)[:, 100:200, 150:250]
    assert abs((noise[1:] * noise[:-1]).mean()) < 0.02 * noise.var()  # from frame to frame
    # from pixel to pixel
    assert abs((noise[:, :, 1:] * noise[:, :, :-1]).mean()) < 0.02 * noise.var()


def test_the_seed_alone_decides_the_frames():
    renderer = Renderer(letter(0.25), blank_board(FACING))
    first = renderer.capture(PHASE_X, seed=1)
    threads = numba.get_num_threads()
    try:
        numba.set_num_threads(1)
        again = renderer.capture(PHASE_X, seed=1)
    finally:
        numba.set_num_threads(threads)
    assert np.array_equal(first, again)
    assert not np.array_equal(first, renderer.capture(PHASE_X, seed=2))
    assert not np.array_equal(first[0], first[1])


@pytest.mark.slow
def test_circles_are_seen_where_they_are():
    rig = letter(0.5)
    board = Board.parse("circles:21x16:9")
    pose = Pose(rotation(np.array([0.25, -0.2, 0.05])), np.array([-88.0, -68.0, 600.0]))
    scene = printed_board(board, pose, BoardShape(0.2, 0.1, -0.1, 0.02))
    image = Renderer(rig, scene).capture(PatternSequence(PROJECTOR, (Frame("texture"),)))[0]
    detection = detect(board, image)
    error = detection.pixels - rig.camera.project(pose.to_camera(scene.features))[detection.ids]
    assert len(detection.ids) == 336
    # shading and perspective shift a blob by hundredths of a pixel
    assert np.abs(error.mean(0)).max() < 0.05
    assert 0.001 < np.sqrt(np.mean(error**2)) < 0.06


@pytest.mark.parametrize("depth", [430.0, pytest.param(600.0, marks=pytest.mark.slow), 810.0])
def test_the_operator_s_exposure_neither_saturates_nor_starves(depth):
    renderer = Renderer(
        letter(0.25), blank_board(Pose(np.eye(3), np.array([0, 0, depth])), (600, 400))
    )
    assert renderer.truth().mask.all()  # the projector's field covers the camera's
    frame = renderer.capture(PatternSequence(PROJECTOR, (Frame("white"), Frame("black"))))
    assert np.quantile(frame[0], 0.99) > 200 and frame[0].max() < 245
    assert 10 < frame[1].mean() < 35


def test_defocus_takes_modulation_and_leaves_phase():
    rig = letter(0.25)
    modulation = {}
    for blur in (rig.light.defocus_px_mm, 3 * rig.light.defocus_px_mm):
        soft = replace(rig, light=replace(rig.light, defocus_px_mm=blur))
        renderer = Renderer(
            soft, blank_board(Pose(np.eye(3), np.array([0.0, 0.0, 450.0])), (400, 300))
        )
        phase, _, B = shift(renderer.capture(PHASE_X))
        error = np.angle(np.exp(1j * (phase - 2 * np.pi * renderer.truth().projector[..., 0] / 18)))
        assert abs(error.mean()) < 2e-4
        modulation[blur] = np.median(B)
    sharp, soft_B = modulation.values()
    # the projector is 33 mm further away
    sigma = [np.hypot(0.5, f * 1500 * abs(1 / 483 - 1 / 600)) for f in (1, 3)]
    assert soft_B / sharp == pytest.approx(
        np.exp(-2 * (np.pi / 18) ** 2 * (sigma[1] ** 2 - sigma[0] ** 2)), rel=0.03
    )


@pytest.mark.slow
def test_gamma_bends_the_fringes_and_flicker_shakes_them():
    scene = blank_board(FACING, (400, 300))
    straight, bent = (
        shift(Renderer(letter(0.25, gamma=g), scene).capture(PHASE_X))[1].mean() for g in (1.0, 2.2)
    )
    assert bent < 0.85 * straight
    white = PatternSequence(PROJECTOR, tuple(Frame("white") for _ in range(30)))
    steady, shaking = (
        Renderer(letter(0.25, flicker=f), scene).capture(white).mean((1, 2)).std()
        for f in (0, 0.01)
    )
    assert steady < 0.05 and 0.8 < shaking < 3


@pytest.mark.parametrize("sigma", [0.15, 0.3, 0.6, 1.2])
def test_the_psf_has_the_stated_width(sigma):
    taps = psf_taps(sigma).astype(float)
    k = np.arange(len(taps)) - len(taps) // 2
    assert taps.sum() == pytest.approx(1, abs=1e-6)
    assert np.sqrt((taps * k**2).sum()) == pytest.approx(sigma, rel=0.04)


def test_what_cannot_be_rendered_is_refused():
    rig = letter(0.25)
    with raises(InputError, "800x600", "912x1140"):
        Renderer(rig, blank_board(FACING)).capture(p18((800, 600)))
    with pytest.raises(InputError):
        Renderer(rig, sphere((5000.0, 0.0, 600.0))).capture(PHASE_X)
    with raises(InputError, "scale 0"):
        letter(0.0)
