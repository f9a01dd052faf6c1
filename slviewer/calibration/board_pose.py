"""The pose of a board, and the lens of a device, from pixels of the board's features; by OpenCV."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from slviewer.errors import CalibrationRejected
from slviewer.geometry.lens import Lens
from slviewer.geometry.rigid import Floats, Floats32, transform_from_rvec
from slviewer.geometry.vectors import diagonal

ITERATIONS = 200
CRITERIA = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, ITERATIONS, 1e-9)
"""Where OpenCV's calibrations end."""
GROUPS = 10
"""Largest number of calibrations without some of the pictures, whose spread is the uncertainty of
all."""
MIN_SPREAD_POSES = 3
"""Least number of pictures that each of those calibrations has."""
_DIAGONAL = 225.0
"""Of every board, in the unit in which OpenCV solves: where its steps end depends on that."""


def to_solver_unit(points: Sequence[Floats]) -> tuple[list[Floats32], float]:
    """Return each pose's points (n, 3) mm in the unit in which OpenCV solves, and that unit in
    mm."""
    unit = diagonal(np.concatenate(points)) / _DIAGONAL or 1.0
    return [(each / unit).astype(np.float32) for each in points], unit


def solve_pose(
    points: Floats,
    pixels: Floats,
    K: Floats,
    D: Floats,
    flags: int = cv2.SOLVEPNP_ITERATIVE,
) -> Floats | None:
    """Solve T_camera_board (4, 4) mm from points (n, 3) mm and pixels (n, 2); None without a finite
    solution.

    ``K`` and ``D``: of the lens, as OpenCV has them; ``flags``: OpenCV's method.
    """
    try:
        success, rvec, tvec = cv2.solvePnP(
            points.astype(float), pixels.astype(float), K, D, flags=flags
        )
    except cv2.error:
        return None
    T = transform_from_rvec(rvec, tvec) if success else np.full((4, 4), np.nan)
    return T if np.isfinite(T).all() else None


def intersect_board(T: Floats, rays: Floats) -> Floats:
    """Return where normalised ``rays`` (n, 2) meet the plane of a board at T_camera_board (4, 4):
    (n, 3) mm; NaN where they do not."""
    directions = np.column_stack([rays, np.ones(len(rays))])
    with np.errstate(invalid="ignore", divide="ignore"):
        return directions * ((T[:3, 2] @ T[:3, 3]) / (directions @ T[:3, 2]))[:, None]


@dataclass(frozen=True, eq=False)
class SolvedDevice:
    """Pinhole and Brown lens of one device, as OpenCV solved it.

    ``K`` (3, 3) px, ``D`` (5,); ``size``: (width, height) px; ``poses``: T_device_board (4, 4) mm
    of each pose; ``focal_sigma_px``: standard deviations of fx and fy.
    """

    K: np.ndarray
    D: np.ndarray
    size: tuple[int, int]
    poses: list[Floats]
    focal_sigma_px: tuple[float, float]

    @property
    def lens(self) -> Lens:
        """The lens. Raises InputError where the solution is not one."""
        return Lens(self.K, self.D, self.size)


def solve_device(
    device: str,
    points: Sequence[np.ndarray],
    pixels: Sequence[np.ndarray],
    size: tuple[int, int],
    start: Lens | None = None,
    flags: int = 0,
) -> SolvedDevice:
    """Solve a pinhole and Brown lens from points (n, 3) mm and pixels (n, 2) of each pose.

    ``device``: for the message of CalibrationRejected, which is raised where OpenCV finds no
    solution; ``start``: initial lens, by default OpenCV's estimate; ``flags``: OpenCV's, of
    coefficients that are held at 0.
    """
    objects, unit = to_solver_unit(points)
    images = [each.astype(np.float32) for each in pixels]
    try:
        _, K, D, rvecs, tvecs, deviations, _, _ = cv2.calibrateCameraExtended(
            objects,
            images,
            size,
            np.zeros((3, 3)) if start is None else start.K.copy(),
            np.zeros(5) if start is None else start.D.copy(),
            flags=flags if start is None else flags | cv2.CALIB_USE_INTRINSIC_GUESS,
            criteria=CRITERIA,
        )
    except cv2.error as error:
        raise CalibrationRejected(
            f"the {device}'s lens could not be solved from {len(points)} poses",
            f"capture the board in more positions and tilts ({error.err})",
        ) from error
    poses = [transform_from_rvec(r, unit * t) for r, t in zip(rvecs, tvecs, strict=True)]
    fx, fy = deviations.ravel()[:2].tolist()
    return SolvedDevice(K, D.ravel()[:5], size, poses, (fx, fy))


def measure_focal_spread(points: list[Floats], pixels: list[Floats], lens: Lens) -> float:
    """Return the relative standard deviation of the focal length by calibrations without some
    pictures each (jackknife); 0 where too few would remain.

    What Brown's polynomial lacks makes residuals depend on each other: their number understates
    the uncertainty.
    """
    count = len(points)
    groups = min(count, GROUPS)
    if count - -(-count // groups) < MIN_SPREAD_POSES:
        return 0.0
    focal = []
    for k in range(groups):
        kept = [i for i in range(count) if i % groups != k]
        fewer, seen = ([each[i] for i in kept] for each in (points, pixels))
        K = solve_device("camera", fewer, seen, lens.size, lens).K
        focal.append(float(np.mean(np.diag(K)[:2] / np.diag(lens.K)[:2])))
    return float(np.sqrt(groups - 1) * np.std(focal))
