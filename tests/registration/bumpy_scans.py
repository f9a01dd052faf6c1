"""Scans of an analytic surface without symmetry, moved by known amounts."""

from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation

from slviewer.registration.pairwise import Registration, register_prepared
from slviewer.registration.scan import prepare_scan
from slviewer.registration.start import Candidate

CENTRE = np.array([0.0, 0.0, 600.0])
SIZE = 150.0
NOISE = 0.03
POINTS = 12_000
Height = Callable[[np.ndarray, np.ndarray], np.ndarray]


def bumpy(seed: int, relief: float = 12.0) -> Height:
    """A height field of nine Gaussians over a square of 150 mm, with no symmetry."""
    rng = np.random.default_rng(seed)
    centres, widths, heights = (
        rng.uniform(-65, 65, (9, 2)),
        rng.uniform(9, 22, 9),
        rng.uniform(-1, 1, 9) * relief,
    )

    def height(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        squares = (x[:, None] - centres[:, 0]) ** 2 + (y[:, None] - centres[:, 1]) ** 2
        return np.exp(-squares / 2 / widths**2) @ heights

    return height


def motion(deg: float, mm: float, seed: int = 0) -> np.ndarray:
    """A rotation about an oblique axis through the object, and a shift."""
    rng = np.random.default_rng(seed)
    axis, shift = rng.normal(size=(2, 3))
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(np.radians(deg) * axis / np.linalg.norm(axis)).as_matrix()
    T[:3, 3] = CENTRE + mm * shift / np.linalg.norm(shift) - T[:3, :3] @ CENTRE
    return T


def view(
    height: Height,
    x_range: tuple[float, float],
    seed: int,
    T_reference_scan: np.ndarray | None = None,
    points: int = POINTS,
    scale: float = 1.0,
) -> np.ndarray:
    """Noisy points of the part of the surface with x in the range, in the frame of the scan."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(*x_range, points), rng.uniform(-75, 75, points)
    P = CENTRE + scale * np.stack([x, y, height(x, y) + rng.normal(0.0, NOISE, points)], axis=1)
    return (
        P if T_reference_scan is None else (P - T_reference_scan[:3, 3]) @ T_reference_scan[:3, :3]
    )


def register(
    scan_points: np.ndarray, reference_points: np.ndarray, start: Candidate | None = None
) -> Registration:
    """The registration of points (n, 3) mm onto others."""
    scan, reference = prepare_scan("scan", scan_points), prepare_scan("reference", reference_points)
    return register_prepared(scan, reference, min(scan.size, reference.size), start)


def error(result: Registration, T: np.ndarray) -> tuple[float, float]:
    """Shift of the object's centre in mm, and rotation in degrees, between the pose found and the
    truth."""
    D = result.T_reference_scan @ np.linalg.inv(T)
    shift = float(np.linalg.norm(D[:3, :3] @ CENTRE + D[:3, 3] - CENTRE))
    return shift, float(np.degrees(np.linalg.norm(Rotation.from_matrix(D[:3, :3]).as_rotvec())))


def organised(
    height: Height,
    T_reference_scan: np.ndarray,
    seed: int,
    size: tuple[int, int] = (200, 160),
) -> np.ndarray:
    """(h, w, 3) float32: what a camera of that many pixels sees of the surface; NaN beside its
    square."""
    w, h = size
    v, u = np.mgrid[:h, :w]
    rays = np.stack([(u - w / 2) / (3.0 * w), (v - h / 2) / (3.0 * w), np.ones(u.shape)], axis=2)
    R, t = T_reference_scan[:3, :3], T_reference_scan[:3, 3] - CENTRE
    along = (np.linalg.inv(T_reference_scan) @ np.append(CENTRE, 1.0))[2] * np.ones(u.shape)
    for _ in range(60):
        P = (rays * along[..., None]) @ R.T + t
        along -= (P[..., 2] - height(P[..., 0].ravel(), P[..., 1].ravel()).reshape(u.shape)) / (
            rays @ R.T
        )[..., 2]
    points = rays * (along + np.random.default_rng(seed).normal(0.0, NOISE, u.shape))[..., None]
    points[(np.abs(P[..., :2]) > 75.0).any(axis=2)] = np.nan
    return points.astype(np.float32)
