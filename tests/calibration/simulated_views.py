"""Board poses as a simulated rig with local distortion sees them, without rendering: exact
projections and noise."""

from dataclasses import replace

import cv2
import numpy as np

from slviewer.calibration.observe import CELLS_PER_WIDTH, Observation
from slviewer.geometry.splines import fit_spline
from slviewer.simulation.boards import Pose
from slviewer.simulation.plans import rotation, target_poses
from slviewer.simulation.rig import SimulatedRig
from slviewer.target.board import Board

BOARD = Board.parse("circles:21x16:9")
PERIOD = 18.0


def moved(rig: SimulatedRig, turn_mrad=(0.0, 0.0, 0.0), baseline_mm: float = 0.0) -> SimulatedRig:
    """The rig with its projector turned about its own centre, and that centre farther from the
    camera."""
    centre = rig.projector_centre
    centre = centre * (1 + baseline_mm / np.linalg.norm(centre))
    R = rotation(1e-3 * np.array(turn_mrad)) @ rig.R
    return replace(rig, R=R, t=-R @ centre)


def poses(rig: SimulatedRig, count: int, seed: int) -> list[Pose]:
    """Poses of the plan's kind, another set for every seed."""
    return target_poses(replace(rig, seed=seed), BOARD, count)


def seen(
    rig: SimulatedRig, pose: Pose, name: str, axes=("x", "y"), camera_px=0.01, sample_px=0.02
) -> Observation:
    """What the rig sees of the board, with noise of so many px in each feature and each sample of
    the phase."""
    rng = np.random.default_rng([sum(map(ord, name)), 3])
    X = pose.to_camera(BOARD.points)
    camera, projector = rig.camera.project(X), rig.project(X)
    width, height = rig.camera.size
    u0, v0 = np.maximum(np.floor(camera.min(0)).astype(int) - 3, 0)
    u1, v1 = np.minimum(np.ceil(camera.max(0)).astype(int) + 4, (width, height))
    u, v = (a.ravel() for a in np.meshgrid(np.arange(u0, u1, 6), np.arange(v0, v1, 6)))
    rays = np.concatenate(
        [rig.camera.undistort(np.stack([u, v], 1).astype(float)), np.ones((len(u), 1))], 1
    )
    normal = pose.R[:, 2]
    coordinate = rig.project(rays * ((normal @ pose.t) / (rays @ normal))[:, None])
    coordinate += rng.normal(0, sample_px, coordinate.shape)
    box = (u0 - 0.5, v0 - 0.5, u1 - 0.5, v1 - 0.5)
    cells = tuple(max(1, round(length * CELLS_PER_WIDTH / width)) for length in (u1 - u0, v1 - v0))
    surfaces = {
        axis: fit_spline(u, v, 2 * np.pi * coordinate[:, i] / PERIOD, None, box, cells)
        for i, axis in enumerate(("x", "y"))
        if axis in axes
    }
    outline = np.zeros((v1 - v0, u1 - u0), np.uint8)
    hull = cv2.convexHull((camera - [u0, v0]).astype(np.float32)).astype(np.int32)
    cv2.fillConvexPoly(outline, hull, 1)
    read = projector + rng.normal(0, sample_px / 2, projector.shape)
    read[:, [axis not in axes for axis in ("x", "y")]] = np.nan
    return Observation(
        name,
        BOARD.points,
        camera + rng.normal(0, camera_px, camera.shape),
        read,
        surfaces,
        {axis: PERIOD for axis in surfaces},
        (width, height),
        (int(u0), int(v0), int(u1), int(v1)),
        np.packbits(outline.astype(bool)),
    )
