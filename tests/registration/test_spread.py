"""How far apart aligned scans lie on the surface that they were merged to."""

import numpy as np

from slviewer.registration.spread import measure_spread

RADIUS = 20.0


def cap(spacing: float, sigma: float, shift: float = 0.0, seed: int = 0) -> np.ndarray:
    """Points (n, 3) mm on top of a ball, moved outwards by `shift`, with noise along z."""
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(*2 * [np.arange(-8.0, 8.0, spacing)])
    z = np.sqrt(RADIUS**2 - x**2 - y**2)
    points = np.stack([x, y, z], axis=-1).reshape(-1, 3) * (1 + shift / RADIUS)
    points[:, 2] += sigma * rng.standard_normal(len(points))
    return points


def test_spread_is_distance_between_scans_not_their_noise_or_spacing() -> None:
    points = cap(0.5, 0.0)
    normals = points / RADIUS
    inside = np.hypot(points[:, 0], points[:, 1]) < 5.0
    apart = measure_spread(points, normals, [cap(0.3, 0.03), cap(0.6, 0.03, 0.1, seed=1)])
    assert 0.09 < np.median(apart[inside]) < 0.11
    together = measure_spread(points, normals, [cap(0.3, 0.0), cap(0.6, 0.0)])
    assert np.nanmax(together[inside]) < 0.006  # the curvature alone would make 0.03 of a scan
    lone = cap(0.3, 0.0)
    halves = [lone[lone[:, 0] < 1], lone[lone[:, 0] > -1]]
    seen_twice = np.isfinite(measure_spread(points, normals, halves))
    assert not seen_twice[np.abs(points[:, 0]) > 4].any()
    assert seen_twice[inside & (np.abs(points[:, 0]) < 0.5)].all()
    assert np.isnan(measure_spread(points, normals, halves[:1])).all()
