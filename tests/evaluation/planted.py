"""Organised clouds with known truth, made without a renderer: rays of a pinhole camera meet
shapes."""

import numpy as np

WIDTH, HEIGHT, FOCAL = 400, 300, 700.0


def rays() -> np.ndarray:
    """(h, w, 3): x/z, y/z, 1."""
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    return np.stack([(u - WIDTH / 2) / FOCAL, (v - HEIGHT / 2) / FOCAL, np.ones(u.shape)], axis=2)


def plane_depth(z: float = 600.0, tilt: tuple[float, float] = (0.2, -0.1)) -> np.ndarray:
    """(h, w) z of a plane through (0, 0, z) that rises by ``tilt`` along x and y."""
    r = rays()
    return z / (1.0 - tilt[0] * r[..., 0] - tilt[1] * r[..., 1])


def sphere_depth(centre: tuple[float, float, float], radius: float) -> np.ndarray:
    """(h, w) z of a sphere's front, NaN beside it."""
    r = rays()
    c = np.asarray(centre)
    a, b = np.sum(r * r, axis=2), r @ c
    with np.errstate(invalid="ignore"):
        return (b - np.sqrt(b * b - a * (c @ c - radius**2))) / a


def cloud(z: np.ndarray, sigma_z: float | np.ndarray = 0.0, seed: int = 0) -> np.ndarray:
    """(h, w, 3) float32 points at depths z with noise along the rays."""
    noise = np.random.default_rng(seed).normal(size=z.shape) * sigma_z
    return (rays() * (z + noise)[..., None]).astype(np.float32)


def rectangle(u: tuple[int, int], v: tuple[int, int]) -> np.ndarray:
    mask = np.zeros((HEIGHT, WIDTH), dtype=bool)
    mask[v[0] : v[1], u[0] : u[1]] = True
    return mask


def board_before_a_wall(sigma_z: float = 0.05, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """A board at 600 mm that fills 55 % of the view before a wall at 900 mm, and the board's
    pixels."""
    board = rectangle((50, 320), (20, 270))
    z = np.where(board, plane_depth(), plane_depth(900.0, (0.0, 0.1)))
    return cloud(z, sigma_z, seed), board
