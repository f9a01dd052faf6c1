"""Proof that printed edges leave no ridges: a printed plane measured through lenses of different
blur, and the edges of an object, which must not suffer."""

from dataclasses import replace

import numpy as np

from slviewer.evaluation.render import Row
from slviewer.geometry.vectors import box_middle, rms
from slviewer.pipeline.feedback import Progress
from slviewer.reconstruction.reconstruct import normals, reconstruct_cloud
from slviewer.simulation.boards import BoardScene, Pose, printed_board
from slviewer.simulation.mesh import demo_object
from slviewer.simulation.plans import rotation
from slviewer.simulation.renderer import Renderer
from slviewer.simulation.rig import SimulatedRig, letter
from slviewer.simulation.truth import PerfectModel
from slviewer.target.board import Board
from slviewer.validation.proof import BandCheck, Proof, prove_checks, track
from slviewer.validation.rendered_calibration import render_phase

PRINT = "chessboard:7x5:32"
BLURS_PX = (0.6, 1.2, 2.0)
"""Standard deviations of the camera's point spread."""
MAX_BLUR_SHARE = 3.0
"""px at full scale: fringes are narrower at a smaller one, and a wider blur mixes too many of their
slopes."""
LOWER = 3.0
"""By this factor, at least, a ridge is lower than without the correction."""
TILT = np.array([0.25, 0.2, 0.1])
DEPTH_MM = 600.0
_REACH_PX = 12
_BINS_PX = 0.5
_NEAR_PX = 3


def prove_edges(scale: float, seed: int, progress: Progress) -> Proof:
    """Measure the ridges of a printed plane and the edges of the demo object, with and without the
    correction."""
    rows: list[Row] = []
    checks: list[BandCheck] = []
    blurs = {f"blur {blur:g} px": blur for blur in BLURS_PX if blur <= MAX_BLUR_SHARE * scale}
    for name, blur, _ in track(progress, blurs):
        rig = letter(scale, seed)
        rig = replace(rig, sensor=replace(rig.sensor, psf_px=blur / scale))
        for scene, measure, what, least in (
            ("printed plane", measure_ridges, "ridge's factor", LOWER),
            ("object's edges", measure_object_edges, "factor at an object's edges", 0.98),
        ):
            before, after = (1e3 * error for error in measure(rig, seed))
            ratio = before / after
            rows.append(
                {
                    "scene": f"{scene}, {name}",
                    "without, µm": before,
                    "with, µm": after,
                    "ratio": ratio,
                }
            )
            checks.append(BandCheck(name, what, ratio, least, 100.0))
    above = [
        (
            "Peak to valley of the mean depth error across the edges of a print, and RMS depth"
            f" error within {_NEAR_PX} px of an object's creases and depth jumps, by the true"
            " lenses."
        ),
        "",
    ]
    return prove_checks(checks, scale, rows, {"rows": rows}, above=above)


def measure_ridges(rig: SimulatedRig, seed: int = 0) -> tuple[float, float]:
    """Peak to valley, mm, of the mean depth error across the printed edges of a plane: as decoded,
    and corrected."""
    board = Board.parse(PRINT)
    R = rotation(TILT)
    place = np.array([0.0, 0.0, DEPTH_MM]) - R @ box_middle(board.points)
    scene = printed_board(board, Pose(R, place))
    before, after = _measure_depth_errors(Renderer(rig, scene), "print", seed)
    distance, side = _signed_distance(rig, scene)
    return _measure_ridge(before, distance, side), _measure_ridge(after, distance, side)


def measure_object_edges(rig: SimulatedRig, seed: int = 0) -> tuple[float, float]:
    """RMS depth error, mm, near the creases and depth jumps of the demo object, of the points that
    are in both clouds: as decoded, and corrected."""
    scene = demo_object(Pose(np.eye(3), np.array([0.0, 0.0, DEPTH_MM])))
    renderer = Renderer(rig, scene)
    before, after = _measure_depth_errors(renderer, "object", seed)
    near = _find_creases(renderer.truth().points) & np.isfinite(before) & np.isfinite(after)
    rms_before, rms_after = (rms(np.clip(each[near], -1.0, 1.0)) for each in (before, after))
    return rms_before, rms_after


def _measure_depth_errors(
    renderer: Renderer, name: str, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """Depth errors (h, w) mm of a scan's phase as decoded, and of the cloud that the program makes
    of it."""
    model, phase = PerfectModel(renderer.rig), render_phase(renderer, name, seed)
    cloud = reconstruct_cloud(model, {"x": phase})
    true_z = renderer.truth().points[..., 2]
    return model.points(phase)[..., 2] - true_z, cloud.points[..., 2] - true_z


def _signed_distance(rig: SimulatedRig, scene: BoardScene) -> tuple[np.ndarray, np.ndarray]:
    """Distance (h, w) px along the rows from the nearest printed edge, positive on its right, NaN
    where another edge is near or the plate ends; and whether that edge is bright on its right."""
    width, height = rig.camera.size
    albedo = scene.trace(rig.camera.rays()).albedo
    over = albedo - (scene.white + scene.dark) / 2
    distance, side = np.full((height, width), np.nan), np.zeros((height, width), bool)
    for v, row in enumerate(over):
        crossings = np.flatnonzero((row[:-1] < 0) != (row[1:] < 0))
        places = crossings + row[crossings] / (row[crossings] - row[crossings + 1])
        gaps = np.diff(places, prepend=-np.inf, append=np.inf) > 2 * _REACH_PX
        for crossing, place, is_isolated in zip(
            crossings, places, gaps[:-1] & gaps[1:], strict=True
        ):
            first, last = int(place) - _REACH_PX, int(place) + _REACH_PX + 2
            if is_isolated and first >= 0 and last <= width and (albedo[v, first:last] > 0).all():
                distance[v, first:last] = np.arange(first, last) - place
                side[v, first:last] = row[crossing + 1] > 0
    return distance, side


def _measure_ridge(error: np.ndarray, distance: np.ndarray, side: np.ndarray) -> float:
    """Peak to valley of the mean error by distance from the edges, those bright on the right and on
    the left apart."""
    known = np.isfinite(error) & np.isfinite(distance)
    profile = []
    for is_right in (True, False):
        here = known & (side == is_right)
        bins = np.floor(distance[here] / _BINS_PX).astype(int) + round((_REACH_PX + 1) / _BINS_PX)
        count = np.bincount(bins)
        with np.errstate(invalid="ignore"):
            mean = np.bincount(bins, error[here]) / count
        profile.append(mean[count > 0.2 * np.median(count[count > 0])])
    return float(np.ptp(np.concatenate(profile)))


def _find_creases(points: np.ndarray) -> np.ndarray:
    """Return the pixels (h, w) bool within `_NEAR_PX` of a depth jump, a silhouette or a crease of
    the true surface."""
    import cv2

    normal = np.nan_to_num(normals(points.astype(np.float32), 1))
    cosines = [np.sum(normal * np.roll(normal, 2, axis=axis), axis=2) for axis in (0, 1)]
    turn = (np.minimum(*cosines) < 0.9).astype(np.uint8)
    return cv2.dilate(turn, np.ones((2 * _NEAR_PX + 1,) * 2, np.uint8)).astype(bool)
