"""From phases to a cloud: the right axis, clear refusals, normals that point at the camera."""

from dataclasses import dataclass

import numpy as np
import pytest
from facts import raises

from slviewer.errors import InputError
from slviewer.reconstruction.cloud import Cloud
from slviewer.reconstruction.reconstruct import normals, reconstruct_cloud

SHAPE = (30, 40)


def plane_grid(
    shape: tuple[int, int] = SHAPE, slope: tuple[float, float] = (0.3, -0.2)
) -> np.ndarray:
    """A tilted plane 600 mm away, seen by a pinhole of 0.4 mm a pixel there."""
    v, u = np.mgrid[: shape[0], : shape[1]]
    uc, vc = (u - shape[1] / 2) / 1500, (v - shape[0] / 2) / 1500
    z = 600 / (1 - slope[0] * uc - slope[1] * vc)
    return np.dstack([uc * z, vc * z, z]).astype(np.float32)


@dataclass
class FakeModel:
    """A calibration whose 'phase maps' are depth offsets, with a sigma_z per axis."""

    sigmas: dict[str, float]
    name = "fake"

    @property
    def axes(self) -> tuple[str, ...]:
        return tuple(self.sigmas)

    def points(self, phase: "FakePhase") -> np.ndarray:
        return plane_grid() + phase.offset[..., None].astype(np.float32)

    def sigma_z(self, phase: "FakePhase", points: np.ndarray) -> np.ndarray:
        return np.where(np.isfinite(points[..., 2]), self.sigmas[phase.axis], np.nan)


@dataclass
class FakePhase:
    is_relative, steps = False, 18
    sigma_px = np.full(SHAPE, 0.3, np.float32)
    edge_error_px = np.zeros(SHAPE, np.float32)

    axis: str
    offset: np.ndarray

    def correct_edges(self) -> tuple["FakePhase", np.ndarray]:
        return self, self.edge_error_px


def phases(*axes: str) -> dict:
    return {axis: FakePhase(axis, np.zeros(SHAPE)) for axis in axes}


def test_the_axis_with_the_smaller_sigma_is_taken() -> None:
    assert reconstruct_cloud(FakeModel({"x": 0.02, "y": 0.5}), phases("x", "y")).axis == "x"
    model = FakeModel({"x": 0.5, "y": 0.02})
    cloud = reconstruct_cloud(model, phases("x", "y"))
    assert (cloud.axis, cloud.model) == ("y", "fake")
    assert np.nanmedian(cloud.sigma_z) == np.float32(0.02)
    assert reconstruct_cloud(model, phases("x", "y"), axis="x").axis == "x"
    assert reconstruct_cloud(model, phases("x")).axis == "x"
    assert reconstruct_cloud(FakeModel({"x": 0.1}), phases("x", "y")).axis == "x"


def test_sigma_is_compared_on_the_same_pixels() -> None:
    """An axis is not better because the pixels where it would be worse are missing from it."""

    class Uneven(FakeModel):
        def sigma_z(self, phase: FakePhase, points: np.ndarray) -> np.ndarray:
            sigma = np.full(SHAPE, 0.03 if phase.axis == "x" else 0.05)
            sigma[:20] = 1.0 if phase.axis == "x" else 1.5
            return np.where(np.isfinite(points[..., 2]), sigma, np.nan)

    both = phases("x", "y")
    both["y"].offset[:20] = np.nan
    assert reconstruct_cloud(Uneven({"x": 1, "y": 1}), both).axis == "x"
    both["x"].offset[5:] = np.nan
    # nothing in common, and y measures more
    assert reconstruct_cloud(Uneven({"x": 1, "y": 1}), both).axis == "y"


def test_what_the_calibrations_own_phases_scatter_by_is_part_of_sigma() -> None:
    class Scattering(FakeModel):
        def excess_px(self, axis: str) -> float:
            return 0.4

        def sigma_calibration(self, axis: str, points: np.ndarray) -> np.ndarray:
            return np.zeros(SHAPE)

    cloud = reconstruct_cloud(Scattering({"x": 0.02}), phases("x"))
    np.testing.assert_allclose(cloud.sigma_z, 0.02 * 0.5 / 0.3, rtol=1e-5)


def test_blur_at_edges_masks_a_pixel_or_adds_to_its_uncertainty() -> None:
    phase = FakePhase("x", np.zeros(SHAPE))
    phase.edge_error_px = np.zeros(SHAPE, np.float32)
    phase.edge_error_px[4], phase.edge_error_px[7] = 0.4, 3.1  # of a noise of 0.3 px, 0.02 mm
    cloud = reconstruct_cloud(FakeModel({"x": 0.02}), {"x": phase})
    assert not cloud.mask[7].any() and cloud.mask.mean() == 29 / 30
    np.testing.assert_allclose(cloud.sigma_z[4], 0.02, rtol=1e-6)  # what averaging lessens
    np.testing.assert_allclose(cloud.sigma[4], 0.02 * np.hypot(1, 4 / 3), rtol=1e-6)
    np.testing.assert_allclose(cloud.sigma[5], 0.02, rtol=1e-6)


def test_missing_axes_are_named() -> None:
    with raises(InputError, "axis y", "x"):
        reconstruct_cloud(FakeModel({"x": 1, "y": 1}), phases("x"), axis="y")
    with raises(InputError, "fake", "axis y", "x"):
        reconstruct_cloud(FakeModel({"x": 1}), phases("x", "y"), axis="y")
    with raises(InputError, "axis y", "fake", "x"):
        reconstruct_cloud(FakeModel({"x": 1}), phases("y"))


def test_cloud_and_its_texture() -> None:
    points = plane_grid()
    points[:10] = np.nan
    sigma = np.full(SHAPE, 0.03)
    assert Cloud(points, "x", "stereo", sigma).colours() is None
    texture = np.random.default_rng(0).integers(0, 256, (*SHAPE, 3), dtype=np.uint8)
    cloud = Cloud(points, "x", "stereo", sigma, texture)
    assert cloud.mask.sum() == 20 * 40 == len(cloud.measured)
    assert np.array_equal(cloud.colours(), texture[10:].reshape(-1, 3))
    assert cloud.sigma_z.dtype == np.float32
    for bits in (8, 10, 12, 14, 16):
        deep = np.full(SHAPE, 3 * 2 ** (bits - 2), np.uint16)  # three quarters of the range
        assert (Cloud(points, "x", "stereo", sigma, deep).texture == 192).all()
    with raises(InputError, "capture"):
        Cloud(points, "x", "stereo", sigma, texture[1:])
    with raises(InputError, "float64"):
        Cloud(points, "x", "stereo", sigma, sigma)
    with pytest.raises(InputError):
        Cloud(points, "x", "stereo", sigma[1:])


@pytest.mark.computes
def test_normals_of_a_plane() -> None:
    points = plane_grid((60, 80))
    truth = np.array([0.3, -0.2, -1]) / np.linalg.norm([0.3, -0.2, -1])
    found = normals(points)
    assert found.dtype == np.float32
    # float32 depths at 600 mm step by 6e-5 mm, pixels by 0.4 mm
    assert np.abs(found - truth).max() < 1e-3
    assert (np.einsum("hwc,hwc->hw", found, points) < 0).all()
    noisy = points + points * np.random.default_rng(0).normal(0, 0.04 / 600, (60, 80, 1)).astype(
        np.float32
    )
    tilt = {
        reach: np.degrees(np.arccos(np.clip(normals(noisy, reach) @ truth, -1, 1))).mean()
        for reach in (1, 2)
    }
    assert 0.3 < tilt[2] < 1.5
    assert tilt[1] > 2 * tilt[2]


@pytest.mark.computes
def test_normals_with_gaps_and_jumps() -> None:
    truth = np.array([0.3, -0.2, -1]) / np.linalg.norm([0.3, -0.2, -1])
    points = plane_grid((60, 80))
    gaps = np.random.default_rng(1).random((60, 80)) < 0.3
    points[gaps] = np.nan
    points[:, 40:] *= 1.2  # a surface 120 mm behind begins here
    found = normals(points)
    assert np.isnan(found[gaps]).all()
    solved = np.isfinite(found[..., 0])
    assert solved[~gaps].mean() > 0.99
    assert np.abs(found[solved] - truth).max() < 3e-3
    lonely = np.full((9, 9, 3), np.nan, np.float32)
    lonely[4] = [0, 0, 500]  # one row says nothing about the other direction
    lonely[4, :, 0] = np.arange(9)
    assert np.isnan(normals(lonely)).all()
