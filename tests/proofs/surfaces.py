"""What surfaces do to a measurement whose geometry is true: light that they throw on themselves,
and printed edges.

Grooves, a bowl and wax before the simulated rig, measured by sequence, and what of the errors is
masked; then surfaces without indirect light, of which nothing should be masked. Printed edges must
leave no ridges: a printed plane is measured through lenses of different blur, and so are the edges
of an object, which must not suffer.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np

from slviewer.evaluation.render import Row
from slviewer.fringe.decode import decode
from slviewer.fringe.phase import Reason
from slviewer.fringe.presets import PRESETS
from slviewer.fringe.sequence import one_axis
from slviewer.geometry.vectors import box_middle, rms
from slviewer.pipeline.operation import Progress, track
from slviewer.reconstruction.reconstruct import normals, reconstruct_cloud
from slviewer.simulation.boards import BoardScene, Pose, printed_board
from slviewer.simulation.concave import Indirect, bowl, groove, wax
from slviewer.simulation.mesh import demo_object
from slviewer.simulation.plans import objects, planes, pose_at, rotation, spheres
from slviewer.simulation.renderer import Renderer
from slviewer.simulation.rig import SimulatedRig, letter
from slviewer.simulation.scenes import Scene
from slviewer.target.board import Board
from tests.perfect_model import PerfectModel
from tests.proofs.proof import BandCheck, Proof, prove_checks
from tests.rendered_calibration import render_phase

LEAST_GAIN = 5.0
"""Of p18's error over micro's, RMS without any mask, in the groove that is judged."""
WRONG_SIGMAS = 5.0
GROSS_PX = 5.0
"""Error in projector px beyond which a point has the order of another place."""
LEAST_CAUGHT = 0.9
"""Share of these points that is masked. Of the points more than `WRONG_SIGMAS` sigma wrong it is
reported only: most of them are off by a tenth of a stripe, by light from beside them, which weakens
fringes no more than defocus does."""
DEFOCUS = 4.0
"""Times the preset's defocus, with which the mask must spare surfaces too."""
MOST_LOST = 0.005
"""Share of the good points of surfaces without indirect light that is masked."""
JUDGED = "groove 90 deg"
"""The others are reported: where Gray code is not misled, micro gains less, and light of the
nearest stripes stays."""
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


@dataclass(frozen=True)
class SequenceErrors:
    """Errors of one sequence on one surface.

    ``rms_mm``: of the depth without the mask; ``masked_rms_mm`` with it. ``wrong``: share of the
    points more than `WRONG_SIGMAS` sigma wrong, ``caught``: of these the share that is masked,
    ``gross_caught``: of those more than `GROSS_PX` wrong, ``lost``: of the good ones.
    """

    rms_mm: float
    masked_rms_mm: float
    wrong: float
    caught: float
    gross_caught: float
    lost: float


def surface_cases() -> dict[str, tuple[Scene, bool]]:
    """Return the surfaces by name, each with whether it lights itself."""
    tilted = {turn: pose_at((0, turn, 0), (0, 0, 640.0)) for turn in (0, 10, 15, 20)}
    glossy = Indirect(2, gloss=0.6, exponent=12.0)
    lit: dict[str, Scene] = {
        JUDGED: groove(tilted[15]),
        "groove 90 deg, one bounce": groove(tilted[15], indirect=Indirect(1)),
        "groove 70 deg, darker": groove(tilted[10], 70, 0.6),
        "groove 70 deg, glossy": groove(tilted[10], 70, 0.9, glossy),
        "groove 110 deg": groove(tilted[20], 110),
        "bowl": bowl(tilted[0], 60, 90, 0.9),
        "wax": wax(tilted[0]),
    }
    clean: dict[str, Scene] = {
        "groove without bounces": groove(tilted[15], indirect=Indirect(0)),
        "plane": planes()["plane_03"],
        "sphere": spheres()["sphere_2"],
        "object": objects()["object_r2"],
        "unsharp plane": planes()["plane_02"],
        "unsharp sphere": spheres()["sphere_1"],
        "unsharp object": objects()["object_r1"],
    }
    return {name: (scene, name in lit) for name, scene in (lit | clean).items()}


def prove_surfaces(scale: float, seed: int, progress: Progress) -> Proof:
    """Measure every surface with p18, complementary, multifrequency and micro; judge gain, mask and
    false alarms.

    ``scale``: resolution of the camera, as a share of the Letter's.
    """
    rig = letter(scale, seed)
    model = PerfectModel(rig)
    defocus = DEFOCUS * rig.light.defocus_px_mm
    blurred = replace(rig, light=replace(rig.light, defocus_px_mm=defocus))
    rows: list[Row] = []
    record: dict[str, dict[str, SequenceErrors]] = {}
    checks: list[BandCheck] = []
    gains: list[str] = []
    for name, (scene, is_indirect), _ in track(progress, surface_cases()):
        renderer = Renderer(blurred if name.startswith("unsharp") else rig, scene)
        errors = record[name] = {
            preset: measure_errors(renderer, preset, model, seed)
            for preset in ("p18", "complementary", "multifrequency", "micro")
        }
        rows += [
            {
                "surface": name,
                "patterns": preset,
                "RMS mm": each.rms_mm,
                "with mask": each.masked_rms_mm,
                ">5 sigma %": round(100 * each.wrong, 2),
                "of these masked %": 100 * each.caught,
                "gross masked %": 100 * each.gross_caught,
                "good masked %": round(100 * each.lost, 2),
            }
            for preset, each in errors.items()
        ]
        gain = errors["p18"].rms_mm / errors["micro"].rms_mm
        gains.append(f"{name} {gain:.1f}")
        if not is_indirect:
            worst = max(errors, key=lambda preset: errors[preset].lost)
            what = f"good points masked with {worst}"
            checks.append(BandCheck(name, what, errors[worst].lost, 0.0, MOST_LOST))
        if name == JUDGED:
            what = f"share of p18's points over {GROSS_PX:g} px wrong masked"
            checks += [
                BandCheck(name, "error of p18 over that of micro", gain, LEAST_GAIN, np.inf),
                BandCheck(name, what, errors["p18"].gross_caught, LEAST_CAUGHT, 1.0),
            ]
    line = f"p18's RMS over micro's: {', '.join(gains)}"
    return prove_checks(checks, scale, rows, {"surfaces": record}, below=[line])


def measure_errors(
    renderer: Renderer, preset: str, model: PerfectModel, seed: int
) -> SequenceErrors:
    """Return the errors in depth of one sequence on the renderer's scene, along axis x."""
    sequence = one_axis(PRESETS[preset](renderer.rig.projector.size), "x")
    frames = renderer.capture(sequence, seed)
    plain = decode(sequence, frames, "x", mask_indirect=False)
    masked = decode(sequence, frames, "x").reason == Reason.INDIRECT
    truth = renderer.truth()
    z = model.points(plain)[..., 2]
    error = np.abs(z - truth.points[..., 2])
    off = np.abs(plain.coordinate - truth.projector[..., 0])
    valid = plain.mask & truth.mask & np.isfinite(error)
    wrong = valid & (off > WRONG_SIGMAS * plain.sigma_px)
    gross = valid & (off > GROSS_PX)
    caught, gross_caught, lost = (
        float(np.mean(masked[points])) if points.any() else np.nan
        for points in (wrong, gross, valid & ~wrong)
    )
    return SequenceErrors(
        rms(error[valid]),
        rms(error[valid & ~masked]),
        float(np.mean(wrong[valid])),
        caught,
        gross_caught,
        lost,
    )


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
    normal = np.nan_to_num(normals(points.astype(np.float32), 1))
    cosines = [np.sum(normal * np.roll(normal, 2, axis=axis), axis=2) for axis in (0, 1)]
    turn = (np.minimum(*cosines) < 0.9).astype(np.uint8)
    return cv2.dilate(turn, np.ones((2 * _NEAR_PX + 1,) * 2, np.uint8)).astype(bool)
