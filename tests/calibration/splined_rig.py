"""Observations of the simulated rig without images: its own lenses say where features and bright
places are seen."""

import numpy as np

from slviewer.calibration.observe import Observation, Samples
from slviewer.fringe.phase import PhaseMap
from slviewer.geometry.polynomial import fit_polynomial
from slviewer.simulation.boards import FLAT, BoardScene, BoardShape, Pose, printed_board
from slviewer.simulation.plans import target_poses
from slviewer.simulation.rig import SimulatedRig, letter
from slviewer.simulation.scenes import directions_of
from slviewer.target.board import Board

BOARD = Board.parse("circles:15x12:12")
PERIOD = 18.0
FEATURE_PX, SAMPLE_PX = 0.01, 0.006
CELLS = 13
"""Half as many across an image as by default: the coarse waves of the rig need no more, and it
takes a second."""


def rig(seed: int = 0, local_distortion_px: float | None = None) -> SimulatedRig:
    return letter(0.25, seed, local_distortion_px=local_distortion_px)


def poses(true: SimulatedRig, count: int) -> list[Pose]:
    return target_poses(true, BOARD, count)


def observation(
    true: SimulatedRig,
    pose: Pose,
    name: str,
    shape: BoardShape = FLAT,
    samples: int = 1500,
    moved_mm: float = 0.0,
    axes: tuple[str, ...] = ("x", "y"),
) -> Observation:
    """A pose with normal noise; the board ``moved_mm`` away between its picture and its
    patterns."""
    rng = np.random.default_rng([true.seed, sum(map(ord, name))])
    scene = printed_board(BOARD, pose, shape, true.seed)
    points = pose.to_camera(scene.features)
    camera = true.camera.project(points)
    later = printed_board(
        BOARD, Pose(pose.R, pose.t + np.array([0, 0, moved_mm])), shape, true.seed
    )
    low, high = camera.min(0) - 4, camera.max(0) + 4
    pixels = rng.uniform(low, high, (3 * samples, 2))
    seen = on_board(later, true.camera.undistort(pixels))
    projector = true.project(seen)
    illuminated = (
        np.isfinite(projector).all(1)
        & (projector > 0).all(1)
        & (projector < np.array(true.projector.size) - 1).all(1)
    )
    pixels, projector = pixels[illuminated][:samples], projector[illuminated][:samples]
    box = (low[0], low[1], high[0], high[1])
    surfaces = {
        a: fit_polynomial(*pixels.T, projector[:, i], None, box, 3)
        for i, a in enumerate("xy")
        if a in axes
    }
    absent = [a not in axes for a in "xy"]
    noisy = projector + rng.normal(0, SAMPLE_PX, projector.shape)
    noisy[:, absent] = np.nan
    sigma = np.full(projector.shape, SAMPLE_PX)
    features = true.project(points)
    features[:, absent] = np.nan
    size = true.camera.size
    return Observation(
        name,
        BOARD.points,
        camera + rng.normal(0, FEATURE_PX, camera.shape),
        features,
        surfaces,  # type: ignore[arg-type]
        {a: PERIOD for a in surfaces},  # type: ignore[misc]
        size,
        (0, 0, *size),
        np.packbits(np.ones(size[::-1], bool)),
        samples=Samples(pixels, noisy, sigma),
    )


def on_board(scene: BoardScene, rays: np.ndarray) -> np.ndarray:
    """(n, 3) mm: where rays (n, 2) meet the board's bent surface."""
    return directions_of(rays[None])[0] * scene.intersect(rays[None])[2].T


def phase_map(
    true: SimulatedRig, depth: np.ndarray, axis: str = "x", period: float = PERIOD
) -> PhaseMap:
    """What a capture without noise says of a surface at ``depth`` (h, w) mm; NaN beyond the
    projector's image."""
    coordinate = true.project(surface(true, depth))
    inside = ((coordinate >= 0) & (coordinate <= np.array(true.projector.size) - 1)).all(-1)
    seen = np.where(inside, coordinate[..., "xy".index(axis)], np.nan)
    ones = np.ones(depth.shape, np.float32)
    phase = (2 * np.pi * seen / period).astype(np.float32)
    return PhaseMap(
        axis,
        period,
        phase,
        phase,
        60 * ones,
        90 * ones,
        np.isnan(seen).astype(np.uint8),
        (2.0, 0.0),
        18,
    )  # type: ignore[arg-type]


def surface(true: SimulatedRig, depth: np.ndarray) -> np.ndarray:
    """(h, w, 3) mm: where each pixel really meets the depth."""
    return np.dstack([true.camera.rays() * depth[..., None], depth])


def aligned_error(found: np.ndarray, true: np.ndarray) -> np.ndarray:
    """(n, 3) mm: found points (n, 3) less the true ones, after the best rigid motion."""
    A, B = found - found.mean(0), true - true.mean(0)
    U, _, V = np.linalg.svd(A.T @ B)
    turn = U @ np.diag([1, 1, np.sign(np.linalg.det(U @ V))]) @ V
    return np.asarray(A @ turn - B)
