"""Lenses: agreement with OpenCV, round trips, and no answer where there is none."""

import json

import cv2
import numpy as np
import pytest
from facts import raises

from slviewer.errors import InputError
from slviewer.geometry.lens import Lens
from slviewer.records.record import from_plain, to_plain

K = np.array([[880.0, 0, 199.3], [0, 884.0, 151.7], [0, 0, 1]])
D = np.array([-0.08, 0.11, 0.0009, -0.0007, 0.02])


@pytest.fixture
def lens() -> Lens:
    return Lens(K, D, (400, 300))


def test_project_agrees_with_opencv(lens: Lens) -> None:
    points = np.random.default_rng(1).uniform([-150, -110, 450], [150, 110, 750], (500, 3))
    theirs = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, D)[0].reshape(-1, 2)
    assert np.abs(lens.project(points) - theirs).max() < 1e-9
    assert np.allclose(lens.distort(points[:, :2] / points[:, 2:]), theirs, rtol=0, atol=1e-9)


def test_undistort_agrees_with_opencv(lens: Lens) -> None:
    pixels = np.random.default_rng(2).uniform(0, [399, 299], (500, 2))
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-14)
    columns = pixels.reshape(-1, 1, 2)
    if hasattr(cv2, "undistortPointsIter"):  # OpenCV 4
        theirs = cv2.undistortPointsIter(columns, K, D, None, None, criteria).reshape(-1, 2)
    else:
        theirs = cv2.undistortPoints(columns, K, D, criteria=criteria).reshape(-1, 2)
    assert np.abs(lens.undistort(pixels) - theirs).max() < 1e-9


@pytest.mark.parametrize(
    "distortion",
    [
        [0, 0, 0, 0, 0],
        [-0.3, 0.1, 0.001, -0.002, 0],
        [0.4, -0.2, 0, 0, 0.05],
        [-0.9, 0.5, 0.01, 0.01, -0.1],
        [0, 0, 0.02, -0.03, 0],
    ],
)
def test_undistort_inverts_distort(distortion: list[float]) -> None:
    lens = Lens([[300.0, 0, 199], [0, 280.0, 150], [0, 0, 1]], distortion, (400, 300))
    rays = lens.rays()
    v, u = np.mgrid[:300, :400]
    back = lens.distort(rays)
    solved = np.isfinite(rays[..., 0])
    assert solved[150, 199]
    assert np.abs(back - np.stack([u, v], axis=-1))[solved].max() < 1e-7
    # wherever the image of a ray short of the fold falls into the picture, that ray is found again
    radius = 0.95 * min(np.sqrt(lens.parameters[9]), 1.0)
    angles = np.linspace(0, 2 * np.pi, 400)
    for r in np.linspace(0, radius, 30):
        ray = r * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
        assert np.abs(lens.undistort(lens.distort(ray)) - ray).max() < 1e-9


def test_past_the_fold_there_is_no_ray() -> None:
    lens = Lens([[300.0, 0, 200], [0, 300.0, 150], [0, 0, 1]], [-0.5, 0, 0, 0, 0], (400, 300))
    fold = np.sqrt(2 / 3)  # r (1 - r^2 / 2) grows up to here
    image_of_fold = 300 * fold * (1 - fold**2 / 2)
    inside, outside = lens.undistort(
        np.array([[200 + 0.99 * image_of_fold, 150], [200 + 1.01 * image_of_fold, 150]])
    )
    assert inside[0] < fold
    assert np.isnan(outside).all()
    assert np.isnan(lens.distort(np.array([1.01 * fold, 0]))).all()
    assert np.isnan(lens.project(np.array([[0, 0, -500.0], [600, 0, 500], [np.nan, 0, 500]]))).all()
    assert np.isnan(lens.undistort(np.array([np.nan, 3.0]))).all()


def test_rays_are_shared_and_protected(lens: Lens) -> None:
    assert lens.rays() is lens.rays()
    assert lens.rays().shape == (300, 400, 2)
    with raises(ValueError, "read-only"):
        lens.rays()[0, 0] = 0


def test_scaled_keeps_what_a_pixel_sees(lens: Lens) -> None:
    half = lens.resize(0.5)
    assert half.size == (200, 150)
    points = np.array([[30.0, -20, 600], [0, 0, 500]])
    # four pixels become one: the outer edges stay where they were
    assert np.allclose(half.project(points) + 0.5, (lens.project(points) + 0.5) / 2, atol=1e-9)
    assert np.allclose(half.resize(2).K, lens.K)


def test_dict_round_trip(lens: Lens) -> None:
    again = from_plain(json.loads(json.dumps(to_plain(lens))), Lens)
    assert (
        np.array_equal(again.K, lens.K)
        and np.array_equal(again.D, lens.D)
        and again.size == lens.size
    )


def test_opencv_shapes_are_accepted() -> None:
    assert Lens(K, D.reshape(5, 1), (400, 300)).D.shape == (5,)
    assert Lens(K, D[:4], (400, 300)).D[4] == 0
    assert np.array_equal(Lens(K, np.append(D, np.zeros(9)), (400, 300)).D, D)


@pytest.mark.parametrize(
    ("matrix", "distortion", "size", "facts"),
    [
        (np.eye(4), D, (400, 300), ("3x3",)),
        (np.array([[880.0, 2, 199], [0, 884, 151], [0, 0, 1]]), D, (400, 300), ("skew",)),
        (K, np.ones(8), (400, 300), ("rational",)),
        (K, [0.1, 0.2], (400, 300), (2, "distortion coefficients")),
        (K, D, (0, 300), ("0x300",)),
    ],
)
def test_other_models_are_refused(
    matrix: np.ndarray, distortion: object, size: tuple[int, int], facts: tuple
) -> None:
    with raises(InputError, *facts):
        Lens(matrix, distortion, size)  # type: ignore[arg-type]


def test_wrong_shapes_are_refused(lens: Lens) -> None:
    with pytest.raises(InputError):
        lens.project(np.zeros((5, 2)))
    with pytest.raises(InputError):
        lens.undistort(np.zeros((5, 3)))


def test_rays_are_shared_by_equal_lenses() -> None:
    first, equal, other = Lens(K, D, (40, 30)), Lens(K, D, (40, 30)), Lens(K, D, (30, 40))
    rays = first.rays()
    assert equal.rays() is rays
    assert other.rays().shape == (40, 30, 2)
    assert not np.array_equal(Lens(K, 0 * D, (40, 30)).rays(), rays)
