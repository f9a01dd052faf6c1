"""Triangles from the grid: all of a surface, none across its edges, all facing the camera."""

import numpy as np
import pytest

from slviewer.reconstruction.reconstruct import triangulate_grid


def grid(shape: tuple[int, int] = (20, 30)) -> np.ndarray:
    v, u = np.mgrid[: shape[0], : shape[1]].astype(np.float32)
    return np.dstack([u, v, 500 + 0.1 * u + 0.2 * v])


def cross_products(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    a, b, c = np.moveaxis(points[np.isfinite(points).all(axis=-1)][faces], 1, 0)
    return np.cross(b - a, c - a)


def test_a_whole_grid() -> None:
    points = grid()
    faces = triangulate_grid(points, 1.0)
    assert faces.dtype == np.int32
    assert faces.shape == (2 * 19 * 29, 3)
    normals = cross_products(points, faces)
    assert (normals[:, 2] < 0).all()
    assert -normals[:, 2].sum() / 2 == pytest.approx(19 * 29)  # covered once, no overlap


def test_gaps_leave_the_triangles_around_them() -> None:
    for v, u in ((0, 0), (0, 29), (19, 0), (19, 29)):
        points = grid()
        points[v, u] = np.nan
        assert len(triangulate_grid(points, 1.0)) == 2 * 19 * 29 - 1
    points = grid()
    points[10, 10] = np.nan
    faces = triangulate_grid(points, 1.0)
    assert len(faces) == 2 * 19 * 29 - 4  # each of the four squares keeps one
    assert (cross_products(points, faces)[:, 2] < 0).all()
    assert faces.max() == 20 * 30 - 2
    assert triangulate_grid(np.full((5, 5, 3), np.nan), 1.0).shape == (0, 3)


def test_cut_at_jumps() -> None:
    points = grid()
    points[:, 15:, 2] += 50
    faces = triangulate_grid(points, 2.0)
    assert len(faces) == 2 * 19 * 28
    assert np.ptp(points.reshape(-1, 3)[faces][..., 2], axis=1).max() <= 2.0
    assert len(triangulate_grid(points, 100.0)) == 2 * 19 * 29


def test_a_ridge_is_cut_along_itself() -> None:
    v, u = np.mgrid[:2, :2]
    points = np.dstack([u, v, [[500, 501], [505, 500]]]).astype(np.float32)
    faces = triangulate_grid(points, 10.0)
    assert all({0, 3} <= set(face) for face in faces.tolist())
