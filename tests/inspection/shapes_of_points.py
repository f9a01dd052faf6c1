"""Points on analytic surfaces, with known noise along the normal."""

import numpy as np

MIDDLE = np.array([3.0, 5.0, 600.0])


def turned(rng: np.random.Generator) -> np.ndarray:
    q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    return q * np.sign(np.linalg.det(q))


def plane(n: int, half: float, sigma: float, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    points = rng.uniform(-half, half, (n, 3))
    points[:, 2] = sigma * rng.normal(size=n)
    return points @ turned(rng).T + MIDDLE


def sphere(n: int, radius: float, cap: float, sigma: float, seed: int = 0) -> np.ndarray:
    """The cap of so many rad that the camera sees, about MIDDLE."""
    rng = np.random.default_rng(seed)
    c, t = rng.uniform(np.cos(cap), 1, n), rng.uniform(0, 2 * np.pi, n)
    q = np.sqrt(1 - c * c)
    return (radius + sigma * rng.normal(size=(n, 1))) * np.stack(
        [q * np.cos(t), q * np.sin(t), -c], 1
    ) + MIDDLE


def cylinder(
    n: int, radius: float, length: float, arc: float, sigma: float, seed: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """Points, and the axis (3,)."""
    rng = np.random.default_rng(seed)
    t, h = rng.uniform(-arc / 2, arc / 2, n), rng.uniform(-length / 2, length / 2, n)
    out = np.stack([np.cos(t), np.sin(t), 0 * t], 1)
    R = turned(rng)
    points = (radius + sigma * rng.normal(size=(n, 1))) * out + np.outer(h, [0, 0, 1])
    return points @ R.T + MIDDLE, R[:, 2]


def strewn(points: np.ndarray, share: float, reach: float = 8.0) -> np.ndarray:
    """With so great a share of them anywhere about."""
    points, rng = points.copy(), np.random.default_rng(1)
    n = int(share * len(points))
    points[:n] += rng.uniform(-reach, reach, (n, 3))
    return points
