"""Proof of the claimed accuracy of registration and meshing, on a simulated rig with known ground
truth.

Three depths and a full turn of an object are measured with the splined calibration of rendered
target poses, registered and fused; pairs that do not determine a pose must be refused.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from time import perf_counter

import numpy as np

from slviewer.errors import InputError
from slviewer.evaluation import letter as the_letter
from slviewer.evaluation.render import Row
from slviewer.fringe.decode import texture
from slviewer.geometry.rigid import fit_rigid, move_points, rotation_angle
from slviewer.inspection.deviation import deviation
from slviewer.pipeline.capture_phases import decode_frames
from slviewer.pipeline.operation import Progress, part, stage, track
from slviewer.pipeline.simulate import TARGET, turn_plan
from slviewer.reconstruction.cloud import Cloud
from slviewer.reconstruction.reconstruct import Model, reconstruct_cloud
from slviewer.registration.markers import measure_markers
from slviewer.registration.multiway import MultiwayAlignment, Starts, register_all
from slviewer.registration.refusal import Refused
from slviewer.simulation.boards import Pose, blank_board
from slviewer.simulation.decals import MarkedScene, marked_plate
from slviewer.simulation.mesh import MeshScene, demo_object
from slviewer.simulation.plans import pose_at
from slviewer.simulation.renderer import Renderer
from slviewer.simulation.rig import SimulatedRig, letter
from slviewer.simulation.scenes import Scene, sphere
from slviewer.simulation.turning import STEPS, stone
from slviewer.surface.fuse import fuse
from slviewer.surface.meshing import MeshingPlan, build_mesh
from slviewer.surface.shapes import Mesh, PointSet
from slviewer.target.board import Board
from tests.marked_scenes import cylinder_mesh, marked_cylinder, marked_sphere
from tests.proofs.proof import BandCheck, Proof, prove_checks
from tests.rendered_calibration import calibrate_rendered, scan_sequence

POSES = 25
SHIFT_MM, TURN_DEG = 0.020, 0.01
LOOP_MM = 0.05
MARKERS_MM = 0.05
"""At full resolution; in proportion to the size of the pixels, in which corners are found, at
less."""
SECONDS = 5.0
HONEST = (0.7, 1.5)
"""Predicted over true error, pooled over all pairs."""
GOOD_PAIRS = 10
OVER_SINGLE = (0.3, 1.3)
"""A fused surface's deviation over that of the best single scan."""
MESH_MM = (0.005, 0.08)
_EVERY = 37  # of the pixels, from which the calibrated camera's frame is estimated


@dataclass(frozen=True, eq=False)
class RegisteredScans:
    """Scans of one object: their clouds, their registration, the true poses T_camera_object (4, 4)
    in the calibrated camera's frame, and the seconds that registering took."""

    clouds: Mapping[str, Cloud]
    alignment: MultiwayAlignment
    poses: Mapping[str, np.ndarray]
    seconds: float

    def loop_error(self) -> float:
        """Loop error of the pairs that follow one another, from the first scan to the last and back
        to the first, mm at the object's middle; NaN where one of them did not register."""
        names, pairs = list(self.clouds), self.alignment.pairs
        steps = [(after, before) for before, after in pairwise(names)]
        if not {*steps, (names[-1], names[0])} <= set(pairs):
            return float("nan")
        T = np.linalg.multi_dot([np.eye(4), *(pairs[step].T_reference_scan for step in steps)])
        D = T @ np.linalg.inv(pairs[names[-1], names[0]].T_reference_scan)
        return _measure_motion(D, self.poses[names[0]][:3, 3])[0]

    def error(
        self, scan: str, onto: str, T_onto_scan: np.ndarray, centre: np.ndarray
    ) -> tuple[float, float]:
        """Error of a registration (4, 4): mm at ``centre`` (3,) mm, and degrees."""
        return _measure_motion(
            T_onto_scan @ self.poses[scan] @ np.linalg.inv(self.poses[onto]), centre
        )

    def rows(self) -> Iterator[Row]:
        """Yield a table row for each registered pair, true and predicted errors beside each
        other."""
        for (scan, onto), pair in self.alignment.pairs.items():
            predicted = pair.uncertainty
            shift, turn = self.error(scan, onto, pair.T_reference_scan, predicted.centre)
            yield {
                "scan": scan,
                "onto": onto,
                "error um": 1000 * shift,
                "error mdeg": 1000 * turn,
                "predicted um": 1000 * predicted.shift_mm,
                "predicted mdeg": 1000 * predicted.turn_deg,
                "RMS mm": pair.rms_mm,
                "point to point mm": pair.inlier_rmse_mm,
                "overlap %": 100 * pair.overlap,
                "start": pair.start,
            }


def prove_registration(scale: float, seed: int, progress: Progress) -> Proof:
    """Calibrate a rendered rig, scan and register three depths and a turn, mesh them, and try what
    must be refused."""
    rig = letter(scale, seed)
    plan = turn_plan(rig, Board.parse(TARGET), POSES)
    model: Model = calibrate_rendered(rig, plan, part(progress, 0.0, 0.5))[1]
    scans = {name: scene for name, scene in plan.items() if isinstance(scene, MeshScene)}
    clouds: dict[str, Cloud] = {}
    measured, true = [], []
    for name, scene, _ in track(progress, scans, 0.5, 0.75):
        renderer = Renderer(rig, scene)
        clouds[name] = _scan(model, renderer, name, POSES + len(clouds))
        known = np.flatnonzero(clouds[name].mask & renderer.truth().mask)[::_EVERY]
        measured.append(clouds[name].points.reshape(-1, 3)[known].astype(float))
        true.append(renderer.truth().points.reshape(-1, 3)[known])
    # A calibration's camera frame is a gauge: turned by a part of a milliradian it measures every
    # distance the same.
    T_calibrated_camera = fit_rigid(np.concatenate(true), np.concatenate(measured))
    truth = {name: T_calibrated_camera @ scene.pose.matrix for name, scene in scans.items()}
    angles = {f"turn_{k + 1:02d}": 360.0 * k / STEPS for k in range(STEPS)}
    groups: dict[str, RegisteredScans] = {}
    for kind, reference, starts, begin, end in (
        ("object_", "object_r3", None, 0.75, 0.8),
        ("turn_", "turn_01", Starts(table_deg=angles), 0.8, 0.88),
    ):
        chosen = {name: cloud for name, cloud in clouds.items() if name.startswith(kind)}
        start = perf_counter()
        alignment = register_all(
            chosen, reference, starts, stage(progress, begin, end, "registering")
        )
        groups[kind] = RegisteredScans(chosen, alignment, truth, perf_counter() - start)
    depths, turn = groups.values()
    rows = [*depths.rows(), *turn.rows()]
    checks = check_registration(depths, turn, rows)
    progress(0.88, "fusing and meshing")
    surfaces, lines, surface_record = _check_surfaces(depths, turn, scans)
    checks += surfaces
    refusals: dict[str, dict[str, str]] = {}
    for what, (wanted, *pair), _ in track(progress, _make_ambiguous_pairs(), 0.95, 0.98):
        number = 900 + len(refusals)
        reason = _describe_refusal(
            *(
                _scan(model, Renderer(rig, scene), name, number)
                for name, scene in zip("ab", pair, strict=True)
            )
        )
        refusals[what] = {"wanted": wanted, "got": reason}
        is_right = float(reason in wanted.split("/"))
        claim = f"refused as {wanted} (it was: {reason})"
        checks.append(BandCheck(what, claim, is_right, 1.0, 1.0))
    for k, (what, marked) in enumerate(_make_marked_pairs().items()):
        progress(0.98, f"{what} by markers")
        error = _measure_marked(rig, model, marked, T_calibrated_camera, 950 + 2 * k)
        title = f"two scans of a {what}, by markers"
        checks.append(BandCheck(title, "largest error in mm", error, 1e-4, MARKERS_MM / scale))
    r1, r2 = the_letter.EXPERIMENT_3_ICP_RMS_MM.values()
    above = (
        f"errors of pairs at scale {scale:g}; the Letter's point-to-point RMS: {r1:.2f} and"
        f" {r2:.2f} mm"
    )
    record = {"surface": surface_record, "refusals": refusals, "pairs": rows}
    held = [check.text() for check in checks if check.holds]
    return prove_checks(checks, scale, rows, record, [above], [*lines, *held])


def _scan(model: Model, renderer: Renderer, name: str, number: int) -> Cloud:
    """The cloud of a rendered scan, whose noise ``number`` seeds."""
    sequence = scan_sequence(renderer.rig)
    frames = renderer.capture(sequence, number)
    phases = decode_frames(name, sequence, frames)
    return reconstruct_cloud(model, phases, texture=texture(sequence, frames))


def check_registration(
    depths: RegisteredScans, turn: RegisteredScans, rows: Sequence[Row]
) -> list[BandCheck]:
    """Errors of the poses against their bounds, loops, duration, and predicted against true errors
    of the pairs' ``rows``."""
    checks = []
    onto = depths.alignment.reference
    for name in [name for name in depths.clouds if name != onto]:
        shift, angle = depths.error(
            name, onto, depths.alignment.T_reference_scan[name], depths.poses[onto][:3, 3]
        )
        checks.append(BandCheck(name, "error of its place in mm", shift, 0.0, SHIFT_MM))
        checks.append(BandCheck(name, "error of its turn in degrees", angle, 0.0, TURN_DEG))
    adjusted = max((loop.left_mm for loop in turn.alignment.loops), default=float("nan"))
    checks += [
        BandCheck("three depths", "seconds to register", depths.seconds, 0.0, SECONDS),
        BandCheck("turn", "largest loop error in mm once adjusted", adjusted, 0.0, LOOP_MM),
        BandCheck("turn", "loop error in mm round all scans", turn.loop_error(), 0.0, LOOP_MM),
        BandCheck("good pairs", "number accepted", float(len(rows)), GOOD_PAIRS, float("inf")),
    ]
    for what, unit in (("shift", "um"), ("turn", "mdeg")):
        predicted, true = (
            np.linalg.norm([row[f"{kind} {unit}"] for row in rows])
            for kind in ("predicted", "error")
        )
        claim = f"predicted over true error of the {what}"
        checks.append(BandCheck("all pairs", claim, float(predicted / true), *HONEST))
    return checks


def _check_surfaces(
    depths: RegisteredScans, turn: RegisteredScans, scenes: Mapping[str, MeshScene]
) -> tuple[list[BandCheck], list[str], dict[str, object]]:
    """Fuse both groups of scans where they were registered and mesh the turn: checks of the
    deviations from the true surface, lines of text, and figures for JSON."""

    def rms(surface: PointSet, name: str) -> float:
        """RMS deviation in mm from the object, after a best fit that begins at the true pose."""
        nominal = Mesh(scenes[name].vertices, scenes[name].triangles)
        T = np.linalg.inv(depths.poses[name])
        found = deviation(surface.points, nominal, normals=surface.normals, initial=T)
        return found.statistics()["rms"]

    single = {
        name: rms(fuse({name: cloud}, {name: np.eye(4)}).surface, name)
        for name, cloud in depths.clouds.items()
    }
    once, around = (
        fuse(each.clouds, each.alignment.T_reference_scan).surface for each in (depths, turn)
    )
    fused = rms(once, depths.alignment.reference)
    meshed = build_mesh(around, MeshingPlan(watertight=True))
    turned = rms(PointSet(meshed.mesh.vertices), turn.alignment.reference)
    ratio, closed = fused / min(single.values()), float(meshed.topology.watertight)
    what = "RMS deviation over the best single scan's"
    checks = [
        BandCheck("three depths, fused", what, ratio, *OVER_SINGLE),
        BandCheck("turn, mesh", "RMS deviation from the true mesh in mm", turned, *MESH_MM),
        BandCheck("turn, mesh", "watertight", closed, 1.0, 1.0),
    ]
    scans = ", ".join(f"{name} {each:.4f}" for name, each in single.items())
    line = (
        f"RMS deviation from the true surface in mm: {scans}; fused {fused:.4f}; the turn's mesh"
        f" {turned:.4f}"
    )
    record = {"single_mm": single, "fused_mm": fused, "turned_mm": turned, "mesh": meshed.to_json()}
    return checks, [line, meshed.text()], record


def _describe_refusal(scan: Cloud, onto: Cloud) -> str:
    """Why a cloud is not registered onto another one, or "accepted"."""
    try:
        register_all({"a": scan, "b": onto}, "b")
    except Refused as refusal:
        return refusal.reason
    except InputError as error:
        return str(error)
    return "accepted"


def _make_ambiguous_pairs() -> dict[str, tuple[str, Scene, Scene]]:
    """Two scans each that must not be registered, and the reason."""
    first = pose_at((4.0, -6.0, 2.0), (0.0, 0.0, 560.0))
    second = pose_at((-5.0, 3.0, 6.0), (6.0, -4.0, 620.0))
    cylinder = cylinder_mesh(40.0, 150.0)
    return {
        "two scans of a plane": ("plane", blank_board(first), blank_board(second)),
        "two scans of a sphere": ("sphere", sphere((4.0, -3.0, 640.0)), sphere((-8.0, 6.0, 690.0))),
        "two scans of a cylinder": (
            "cylinder",
            MeshScene(*cylinder, first),
            MeshScene(*cylinder, second),
        ),
        "scans of unrelated objects": (
            "disagree/overlap",
            demo_object(first),
            MeshScene(*stone(), Pose(np.diag([1.0, -1.0, -1.0]), second.t)),
        ),
    }


def _make_marked_pairs() -> dict[str, tuple[MarkedScene, MarkedScene]]:
    """Two scans each of shapes that do not hold a pose, with coded markers on them."""
    first = pose_at((4.0, -6.0, 2.0), (0.0, 0.0, 620.0))
    second = pose_at((-5.0, 8.0, 16.0), (6.0, -4.0, 640.0))
    behind = [Pose(pose.R, pose.t + np.array([0.0, 0.0, 60.0])) for pose in (first, second)]
    return {
        "plane": (marked_plate(first), marked_plate(second)),
        "sphere": (marked_sphere(behind[0]), marked_sphere(behind[1])),
        "cylinder": (marked_cylinder(first), marked_cylinder(second)),
    }


def _measure_marked(
    rig: SimulatedRig,
    model: Model,
    pair: tuple[MarkedScene, MarkedScene],
    T_calibrated_camera: np.ndarray,
    number: int,
) -> float:
    """The largest error, mm, over the surface of the second scan, registered by markers onto the
    first."""
    clouds = {
        name: _scan(model, Renderer(rig, scene), name, number + k)
        for k, (name, scene) in enumerate(zip("ab", pair, strict=True))
    }
    markers = {name: measure_markers(cloud) for name, cloud in clouds.items()}
    T = register_all(clouds, "a", Starts(markers=markers)).T_reference_scan["b"]
    true = [T_calibrated_camera @ scene.pose.matrix for scene in pair]
    points = clouds["b"].measured[::_EVERY].astype(float)
    gap = move_points(T, points) - move_points(true[0] @ np.linalg.inv(true[1]), points)
    return float(np.linalg.norm(gap, axis=1).max())


def _measure_motion(D: np.ndarray, centre: np.ndarray) -> tuple[float, float]:
    """How far a motion (4, 4) shifts a point (3,), mm, and its angle, degrees."""
    shift = np.linalg.norm(move_points(D, centre[None]) - centre)
    return float(shift), float(np.degrees(rotation_angle(D[:3, :3])))
