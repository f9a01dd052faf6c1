"""Depth from one projector axis: exact under distortion, and silent where there is no answer."""

import json

import cv2
import numpy as np
import pytest
from facts import raises

from slviewer.errors import InputError
from slviewer.geometry.lens import Lens
from slviewer.geometry.rig import StereoRig
from slviewer.geometry.triangulation import (
    depth_per_px,
    points_from_depth,
    triangulate,
    triangulate_pixels,
)
from slviewer.records.record import from_plain, to_plain

pytestmark = pytest.mark.computes


def make_rig(k1: float = -0.08, vertical: bool = False) -> StereoRig:
    """A quarter of the Letter's rig; its projector's rows are half as high as its columns are
    wide."""
    camera = Lens(
        [[890.0, 0, 201.3], [0, 891.0, 149.1], [0, 0, 1]],
        [k1, 0.1, 0.0004, -0.0003, 0.01],
        (400, 300),
    )
    projector = Lens(
        [[1400.0, 0, 455.0], [0, 2800.0, 569.0], [0, 0, 1]],
        [k1, 0.02, 0.0005, 0.0006, 0],
        (912, 1140),
    )
    turn = [-0.3, 0.02, 0.01] if vertical else [0.01, 0.3, 0.01]
    shift = [4.0, -180.0, 20] if vertical else [-180.0, 3, 20]
    return StereoRig(
        camera, projector, cv2.Rodrigues(np.array(turn))[0], np.array(shift).reshape(3, 1)
    )


def wavy_depths(rig: StereoRig) -> np.ndarray:
    width, height = rig.camera.size
    v, u = np.mgrid[:height, :width]
    return 590 + 0.2 * (u - width / 2) + 25 * np.sin(v / 40)


def truth(rig: StereoRig) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(z, points, projector coordinates) of a wavy surface, where the projector lights it."""
    z = wavy_depths(rig)
    points = np.dstack([rig.camera.rays() * z[..., None], z])
    pixels = rig.project(points)
    illuminated = ((pixels > -0.5) & (pixels < np.array(rig.projector.size) - 0.5)).all(axis=-1)
    pixels[~illuminated] = np.nan
    assert illuminated.mean() > 0.5
    return np.where(illuminated, z, np.nan), points, pixels


@pytest.mark.parametrize(("axis", "vertical"), [("x", False), ("y", True)])
def test_exact_coordinates_give_exact_depth(axis: str, vertical: bool) -> None:
    rig = make_rig(vertical=vertical)
    z, points, pixels = truth(rig)
    found = triangulate(rig, pixels[..., "xy".index(axis)], axis)
    assert np.array_equal(np.isfinite(found), np.isfinite(z))
    assert np.nanmax(np.abs(found - z)) < 1e-6
    cloud = points_from_depth(rig.camera.rays(), found)
    assert cloud.dtype == np.float32
    assert np.nanmax(np.abs(cloud - points)) < 1e-4


def test_projector_projection_agrees_with_opencv() -> None:
    rig = make_rig()
    points = np.random.default_rng(0).uniform([-100, -80, 500], [100, 80, 700], (200, 3))
    theirs = cv2.projectPoints(points, rig.R, rig.t, rig.projector.K, rig.projector.D)[0].reshape(
        -1, 2
    )
    assert np.abs(rig.project(points) - theirs).max() < 1e-8
    assert np.allclose(rig.to_projector(points), (rig.R @ points.T + rig.t[:, None]).T)


def test_what_ignoring_the_other_coordinate_costs() -> None:
    """Undistorting (u_p, middle row) and trusting eq. 6 is wrong by tenths of a mm; the first guess
    alone by more."""
    rig = make_rig(k1=-0.08)
    z, _, pixels = truth(rig)
    middle = np.full_like(pixels[..., 0], rig.projector.K[1, 2])
    up = rig.projector.undistort(np.stack([pixels[..., 0], middle], axis=-1))[..., 0]
    M = np.column_stack([rig.R, rig.t])
    uc, vc = np.moveaxis(rig.camera.rays(), -1, 0)
    above = M[0, 3] - M[2, 3] * up
    below = (M[0, 0] - M[2, 0] * up) * uc + (M[0, 1] - M[2, 1] * up) * vc + M[0, 2] - M[2, 2] * up
    rms = np.sqrt(np.nanmean((-above / below - z) ** 2))  # Letter eq. 6
    assert 0.1 < rms < 0.6
    assert np.nanmax(np.abs(triangulate(rig, pixels[..., 0], "x") - z)) < 1e-6


def test_strong_distortion_is_solved_or_left_out() -> None:
    rig = make_rig(k1=-0.6)
    z, _, pixels = truth(rig)
    found = triangulate(rig, pixels[..., 0], "x")
    assert np.isfinite(found[np.isfinite(z)]).mean() > 0.99
    assert np.nanmax(np.abs(found - z)) < 1e-6


def test_no_answer_where_there_is_none() -> None:
    rig = make_rig()
    _, _, pixels = truth(rig)
    wild = np.full(pixels.shape[:2], np.nan)
    assert np.isnan(triangulate(rig, wild, "x")).all()
    for coordinate in (-np.inf, np.inf, -300.0, 2000.0):
        wild[:] = coordinate
        assert np.isnan(triangulate(rig, wild, "x")).all()
    # every answer to any coordinate is in front of both devices and meets that coordinate
    wild[:] = np.random.default_rng(3).uniform(-90, 1000, wild.shape)
    z = triangulate(rig, wild, "x")
    points = points_from_depth(rig.camera.rays(), z).astype(float)
    solved = np.isfinite(z)
    assert 0.05 < solved.mean() < 0.95
    assert (z[solved] > 0).all() and (rig.to_projector(points[solved])[:, 2] > 0).all()
    exact = np.dstack([rig.camera.rays() * z[..., None], z])
    back = rig.project(exact)[solved]
    assert np.abs(back[:, 0] - wild[solved]).max() < 1e-6
    assert (back[:, 1] > -115).all() and (back[:, 1] < 1254).all()


def test_scattered_pixels_agree_with_the_map() -> None:
    rig = make_rig()
    _, points, pixels = truth(rig)
    chosen = np.array([[200, 150], [150, 100], [260, 190]])
    coordinates = pixels[chosen[:, 1], chosen[:, 0], 0]
    found = triangulate_pixels(rig, chosen, coordinates, "x")
    assert np.abs(found - points[chosen[:, 1], chosen[:, 0]]).max() < 1e-6
    assert np.isnan(triangulate_pixels(rig, chosen, np.full(3, np.nan), "x")).all()


@pytest.mark.parametrize("axis", ["x", "y"])
def test_depth_per_px_is_the_derivative(axis: str) -> None:
    rig = make_rig()
    z = wavy_depths(rig)
    i, step = "xy".index(axis), 1e-3
    near, far = (
        rig.project(np.dstack([rig.camera.rays() * d[..., None], d])) for d in (z - step, z + step)
    )
    numeric = np.abs(2 * step / (far - near)[..., i])
    found = depth_per_px(rig, axis, z)
    # as slopes: along an epipolar line of the rows, depth per row is infinite
    assert np.allclose(1 / found, 1 / numeric, rtol=1e-4, atol=1e-7)
    if axis == "x":
        assert 0.5 < np.median(found) < 3.0
    else:
        assert np.median(found) > 10  # a horizontal baseline has no depth in the rows
    assert np.isnan(depth_per_px(rig, axis, np.full_like(z, np.nan))).all()


def test_dict_round_trip() -> None:
    rig = make_rig()
    again = from_plain(json.loads(json.dumps(to_plain(rig))), StereoRig)
    assert np.array_equal(again.R, rig.R) and np.array_equal(again.t, rig.t)
    assert np.array_equal(again.camera.rays(), rig.camera.rays())


def test_bad_input_is_refused() -> None:
    rig = make_rig()
    with raises(InputError, "400x300", "(200, 100)"):
        triangulate(rig, np.zeros((200, 100)), "x")
    with raises(InputError, "rotation"):
        StereoRig(rig.camera, rig.projector, -np.eye(3), rig.t)
