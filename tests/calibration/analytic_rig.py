"""A rig and target poses known exactly, without images: projections by OpenCV, whose lens code is
not ours."""

import cv2
import numpy as np

from slviewer.calibration.observe import Observation
from slviewer.geometry.lens import Lens
from slviewer.geometry.polynomial import fit_polynomial
from slviewer.geometry.rig import StereoRig
from slviewer.target.board import Board

SIZE = (400, 300)
PROJECTOR = (456, 570)
PERIOD = 18.0
BOARD = Board.parse("circles:11x9:16")


def rig() -> StereoRig:
    """A quarter of the Letter's resolution: baseline 180 mm, axes crossing at 600 mm, fy twice fx
    in the projector."""
    camera = Lens(
        np.array([[890.0, 0, 203.0], [0, 890.5, 147.0], [0, 0, 1]]),
        np.array([-0.08, 0.03, 4e-4, -3e-4, 0.0]),
        SIZE,
    )
    projector = Lens(
        np.array([[700.0, 0, 230.0], [0, 1400.0, 280.0], [0, 0, 1]]),
        np.array([-0.06, 0.02, 3e-4, 5e-4, 0.0]),
        PROJECTOR,
    )
    R = cv2.Rodrigues(np.array([0.01, 0.29, -0.005]))[0]
    return StereoRig(camera, projector, R, -R @ np.array([180.0, 5.0, 8.0]))


def board_poses(count: int, seed: int = 0, max_tilt_deg: float = 25) -> list[np.ndarray]:
    """(4, 4) board to camera, 500 to 700 mm away, tilted by up to 25 degrees about each axis."""
    rng = np.random.default_rng(seed)
    poses = []
    for k in range(count):
        T = np.eye(4)
        T[:3, :3] = cv2.Rodrigues(
            np.radians(rng.uniform(-1, 1, 3) * [max_tilt_deg, max_tilt_deg, 8])
        )[0]
        z = 500 + 200 * (k + 0.5) / count
        middle = BOARD.points.mean(0)
        T[:3, 3] = np.array([rng.uniform(-25, 25), rng.uniform(-20, 20), z]) - T[:3, :3] @ middle
        poses.append(T)
    return poses


def observation(
    true: StereoRig,
    T: np.ndarray,
    name: str,
    noise_px: float = 0.02,
    seed: int = 0,
    axes: tuple[str, ...] = ("x", "y"),
    bend_per_mm: float = 0.0,
) -> Observation:
    """The board, bent along x to z = bend_per_mm x^2, at pose T as camera and projector see it,
    with Gaussian noise on every feature."""
    rng = np.random.default_rng([seed, sum(map(ord, name))])
    bend = bend_per_mm * (BOARD.points[:, :1] - BOARD.points[:, 0].mean()) ** 2
    X = (BOARD.points + bend * [0, 0, 1]) @ T[:3, :3].T + T[:3, 3]
    camera, projector = (
        cv_project(true.camera, X),
        cv_project(true.projector, X @ true.R.T + true.t),
    )
    u0, v0 = np.maximum(np.floor(camera.min(0)).astype(int) - 8, 0)
    u1, v1 = np.minimum(np.ceil(camera.max(0)).astype(int) + 9, SIZE)
    u, v = (a.ravel() for a in np.meshgrid(np.arange(u0, u1, 4), np.arange(v0, v1, 4)))
    rays = cv2.undistortPoints(
        np.stack([u, v], 1)[:, None].astype(float), true.camera.K, true.camera.D
    )[:, 0]
    d = np.c_[rays, np.ones(len(rays))]
    seen = d * (T[:3, 2] @ T[:3, 3] / (d @ T[:3, 2]))[:, None]
    coordinate = cv_project(true.projector, seen @ true.R.T + true.t)
    box = (u0 - 0.5, v0 - 0.5, u1 - 0.5, v1 - 0.5)
    surfaces = {
        axis: fit_polynomial(u, v, 2 * np.pi * coordinate[:, i] / PERIOD, None, box, 6)
        for i, axis in enumerate(("x", "y"))
        if axis in axes
    }
    projector = projector + rng.normal(0, noise_px, projector.shape)
    projector[:, [axis not in axes for axis in ("x", "y")]] = np.nan
    return Observation(
        name,
        BOARD.points,
        camera + rng.normal(0, noise_px, camera.shape),
        projector,
        surfaces,
        {axis: PERIOD for axis in surfaces},
        SIZE,
        (int(u0), int(v0), int(u1), int(v1)),
        np.packbits(np.ones((v1 - v0, u1 - u0), bool)),
    )


def cv_project(lens: Lens, points: np.ndarray) -> np.ndarray:
    """(n, 2) px by OpenCV."""
    return cv2.projectPoints(points[:, None], np.zeros(3), np.zeros(3), lens.K, lens.D)[0][:, 0]
