"""The simulated lens against OpenCV and itself, and what its local distortion is."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from facts import raises

from slviewer.errors import InputError
from slviewer.simulation.lens import SimulatedLens
from slviewer.simulation.rig import letter
from slviewer.simulation.waves import displace

pytestmark = pytest.mark.computes


def grid(lens: SimulatedLens, n: int = 41) -> np.ndarray:
    width, height = lens.size
    u, v = np.meshgrid(np.linspace(-0.5, width - 0.5, n), np.linspace(-0.5, height - 0.5, n))
    return np.stack([u, v], -1)


@pytest.mark.parametrize("scale", [1.0, 0.25])
@pytest.mark.parametrize("texture", ["coarse", "fine"])
def test_undistort_inverts_project(scale, texture):
    rig = letter(scale, seed=3, texture=texture)
    for lens in (rig.camera, rig.projector):
        pixels = grid(lens)
        normalised = lens.undistort(pixels)
        points = np.concatenate([normalised, np.ones((*normalised.shape[:2], 1))], -1) * 600
        assert np.abs(lens.project(points) - pixels).max() < 1e-9


def test_without_waves_it_is_opencv_s_model():
    lens = letter(local_distortion_px=0, seed=1).camera
    points = np.random.default_rng(0).uniform([-130, -100, 450], [130, 100, 800], (200, 3))
    (fx, fy), (cx, cy) = lens.focal_px, lens.centre_px
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    expected = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, np.array(lens.brown))[
        0
    ].reshape(-1, 2)
    assert np.abs(lens.project(points) - expected).max() < 1e-9


def test_scale_keeps_the_image_s_edges():
    full, half = letter(1.0).camera, letter(0.5).camera
    assert half.size == (800, 600)
    points = np.array([[10.0, -30.0, 520.0], [-90.0, 60.0, 700.0]])
    assert np.allclose(half.project(points), (full.project(points) + 0.5) / 2 - 0.5, atol=1e-12)


def test_points_behind_a_device_are_not_seen():
    lens = letter().camera
    assert np.isnan(lens.project(np.array([[0.0, 0.0, -5.0], [np.nan, 0.0, 500.0]]))).all()


def test_wrong_shapes_are_refused():
    with raises(InputError, "(4, 2)", "(..., 3)"):
        letter().camera.project(np.zeros((4, 2)))


@pytest.mark.parametrize("rms", [0.0, 0.15, 0.3])
def test_local_distortion_has_the_stated_rms(rms):
    rig = letter(local_distortion_px=rms)
    for lens in (rig.camera, rig.projector):
        width, height = lens.full_size
        u, v = np.meshgrid(np.linspace(0, width - 1, 200), np.linspace(0, height - 1, 160))
        displacement = displace(lens.waves, np.stack([u, v], -1))
        assert np.allclose(np.sqrt((displacement**2).mean((0, 1))), rms, rtol=0.03, atol=0)


def test_switching_the_local_distortion_off_leaves_the_rest_of_the_rig_alone():
    on, off = letter(seed=5), letter(seed=5, local_distortion_px=0)
    assert on.camera.brown == off.camera.brown and on.projector.focal_px == off.projector.focal_px
    assert np.array_equal(on.R, off.R) and len(off.camera.waves) == 0


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("texture", ["coarse", "fine"])
def test_no_brown_polynomial_expresses_the_local_distortion(seed, texture):
    rig = letter(seed=seed, texture=texture)
    for lens in (rig.camera, rig.projector):
        wavy, plain = lens, replace(lens, waves=np.zeros((0, 6)))
        normalised = plain.undistort(grid(plain))
        rays = np.concatenate([normalised, np.ones((*normalised.shape[:2], 1))], -1)
        field = (wavy.project(rays) - plain.project(rays)).ravel()
        columns = []
        for change in _changes(plain):  # every parameter of the lens, and the device's orientation
            columns.append((change(rays) - plain.project(rays)).ravel())
        J = np.stack(columns, 1)
        J /= np.linalg.norm(J, axis=0)
        left = field - J @ np.linalg.lstsq(J, field, rcond=None)[0]
        assert np.linalg.norm(left) > 0.7 * np.linalg.norm(field)


def _changes(lens):
    (fx, fy), (cx, cy) = lens.focal_px, lens.centre_px
    variants = [
        replace(lens, focal_px=(fx + 1e-3, fy)), replace(lens, focal_px=(fx, fy + 1e-3)),
        replace(lens, centre_px=(cx + 1e-3, cy)), replace(lens, centre_px=(cx, cy + 1e-3)),
    ]  # fmt: skip
    for k in range(5):
        brown = list(lens.brown)
        brown[k] += 1e-6
        variants.append(replace(lens, brown=tuple(brown)))
    changes = [variant.project for variant in variants]
    for axis in np.eye(3):
        changes.append(lambda rays, axis=axis: lens.project(rays @ cv2.Rodrigues(1e-6 * axis)[0].T))
    return changes
