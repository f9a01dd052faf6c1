"""The aspect of a camera's pixels, from features that other code projected."""

import numpy as np
import pytest
from analytic_rig import board_poses, observation, rig

from slviewer.calibration.squareness import measure_squareness


def test_poses_without_features_change_nothing() -> None:
    true, poses = rig(), board_poses(8)
    K = true.camera.K
    seen = [observation(true, T, f"pose_{k}") for k, T in enumerate(poses)]
    pixels = [
        o.camera + np.random.default_rng(k).normal(0, 0.02, o.camera.shape)
        for k, o in enumerate(seen)
    ]
    X = [o.points for o in seen]
    found = measure_squareness(true.camera, poses, X, pixels)
    assert found.aspect == pytest.approx(K[1, 1] / K[0, 0], abs=found.aspect_limit)
    assert 0 < found.aspect_limit < 1e-3
    none = np.full_like(pixels[0], np.nan)
    again = measure_squareness(true.camera, [*poses, poses[0]], [*X, X[0]], [*pixels, none])
    assert repr(again) == repr(found)
    alone = measure_squareness(true.camera, poses[:2], X[:2], [none, pixels[1]])
    assert alone.aspect_limit == np.inf
    assert not alone.is_doubtful
