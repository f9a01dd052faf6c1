"""Rigid motions: fitted, composed, and applied to points."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from slviewer.geometry.rigid import (
    fit_rigid,
    move_points,
    rigid_transform,
    rotation_angle,
    transform_from_rvec,
    turn_about,
)

RNG = np.random.default_rng(0)


def test_fitted_motions_bring_points_onto_their_targets() -> None:
    T = rigid_transform(Rotation.random(6, random_state=0).as_matrix(), RNG.normal(0, 100, (6, 3)))
    points = RNG.normal(0, 50, (6, 3, 3))  # triangles: a reflection would fit them as well
    targets = np.stack([move_points(motion, some) for motion, some in zip(T, points, strict=True)])
    assert fit_rigid(points, targets) == pytest.approx(T, abs=1e-9)
    assert fit_rigid(points[0], targets[0]) == pytest.approx(T[0], abs=1e-9)
    noisy = targets[0] + RNG.normal(0, 0.1, (3, 3))
    assert np.linalg.det(fit_rigid(points[0], noisy)[:3, :3]) == pytest.approx(1.0)


def test_a_turn_about_a_point_leaves_it_there() -> None:
    centre, shift = np.array([10.0, -20.0, 500.0]), np.array([1.0, 2.0, 3.0])
    T = turn_about(np.array([0.0, 0.0, np.pi / 2]), centre, shift)
    assert move_points(T, centre[None])[0] == pytest.approx(centre + shift)
    assert move_points(T, centre[None] + [1.0, 0.0, 0.0])[0] == pytest.approx(
        centre + shift + [0.0, 1.0, 0.0]
    )
    assert np.isnan(move_points(T, np.full((1, 3), np.nan))).all()


def test_angles_of_rotations_are_exact_from_tiny_ones_to_half_turns() -> None:
    axes = RNG.normal(size=(5, 3))
    angles = np.array([1e-12, 1e-6, 1.0, np.pi - 1e-7, np.pi])
    vectors = angles[:, None] * axes / np.linalg.norm(axes, axis=1, keepdims=True)
    R = Rotation.from_rotvec(vectors).as_matrix()
    assert rotation_angle(R) == pytest.approx(angles, rel=1e-9, abs=1e-14)
    assert rotation_angle(R[1]) == pytest.approx(1e-6, rel=1e-9)
    for vector, expected in zip(vectors, R, strict=True):
        turned = transform_from_rvec(vector[:, None], np.zeros((3, 1)))[:3, :3]
        assert turned == pytest.approx(expected, rel=1e-14, abs=1e-14)
