"""Whether scans are registered as well as is claimed, on a simulated rig whose truth is known.

Three depths and a full turn of an object, measured with the splined calibration of rendered target poses, what their
fused surfaces are worth, and pairs that must be refused.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from time import perf_counter
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from slviewer.calibration.centres import calibrate_centres
from slviewer.calibration.splined.model import calibrate_splined
from slviewer.errors import InputError
from slviewer.evaluation import letter as the_letter
from slviewer.evaluation.render import Row, render
from slviewer.fringe.presets import p18
from slviewer.fringe.sequence import one_axis
from slviewer.geometry.rigid import fit_rigid
from slviewer.pipeline.capture_phases import decode_frames
from slviewer.pipeline.feedback import Progress, ignore_progress, part
from slviewer.pipeline.simulate import TARGET, turn_plan
from slviewer.reconstruction.cloud import Cloud
from slviewer.reconstruction.reconstruct import Model, reconstruct
from slviewer.registration.multiway import Alignment, Starts, register_all
from slviewer.registration.pairwise import Registration
from slviewer.registration.refusal import Refused
from slviewer.simulation.boards import Pose, blank_board
from slviewer.simulation.mesh import MeshScene, demo_object
from slviewer.simulation.plans import rotation
from slviewer.simulation.renderer import Renderer
from slviewer.simulation.rig import SimulatedRig, letter
from slviewer.simulation.scenes import Scene, sphere
from slviewer.simulation.turning import STEP_DEG, stone
from slviewer.surface.shapes import Mesh
from slviewer.target.board import Board
from slviewer.validation.prove_accuracy import BandCheck
from slviewer.validation.prove_rigs import observe_scene
from slviewer.validation.prove_surface import SurfaceProof, prove_surface

POSES = 25
SHIFT_MM, TURN_DEG = 0.020, 0.01
LOOP_MM = 0.05
SECONDS = 5.0
HONEST = (0.7, 1.5)
"""Predicted over true error, pooled over all pairs."""
GOOD_PAIRS = 10
_EVERY = 37  # of the pixels, to find the calibrated camera's frame from


@dataclass(frozen=True, eq=False)
class RegisteredScans:
    """Scans of one object: their clouds, how they were registered, the true poses T_camera_object (4, 4) in the
    calibrated camera's frame, and the seconds that registering took."""

    clouds: Mapping[str, Cloud]
    alignment: Alignment
    poses: Mapping[str, np.ndarray]
    seconds: float

    def round_all(self) -> tuple[float, float]:
        """Loop error of the pairs that follow one another, from the first scan to the last and back to the first, mm at
        the object's middle and degrees; NaN where one of them did not register."""
        names, pairs = list(self.clouds), self.alignment.pairs
        steps = [(after, before) for before, after in pairwise(names)]
        if not {*steps, (names[-1], names[0])} <= set(pairs):
            return float("nan"), float("nan")
        T = np.linalg.multi_dot([np.eye(4), *(pairs[step].T_reference_scan for step in steps)])
        D = T @ np.linalg.inv(pairs[names[-1], names[0]].T_reference_scan)
        middle = self.poses[names[0]][:3, 3]
        return _size_of(D, middle)

    def error(self, scan: str, onto: str, found: Registration | np.ndarray) -> tuple[float, float]:
        """mm, at the object's middle or where a pair overlaps, and degrees."""
        if isinstance(found, Registration):
            T, centre = found.T_reference_scan, found.uncertainty.centre
        else:
            T, centre = found, self.poses[onto][:3, 3]
        return _size_of(T @ self.poses[scan] @ np.linalg.inv(self.poses[onto]), centre)


@dataclass(frozen=True, eq=False)
class RegistrationProof:
    """What came of the three depths, of the turn, of the surfaces made from them, and of what had to be refused: the
    reason by pair, or "accepted"."""

    depths: RegisteredScans
    turn: RegisteredScans
    surface: SurfaceProof
    refusals: Mapping[str, tuple[str, str]]
    scale: float

    @property
    def checks(self) -> tuple[BandCheck, ...]:
        """All that is demanded."""
        found = []
        for name in self.depths.clouds:
            if name != self.depths.alignment.reference:
                onto = self.depths.alignment.reference
                shift, turn = self.depths.error(name, onto, self.depths.alignment.T_reference_scan[name])
                found.append(BandCheck(name, "error of its place in mm", shift, 0.0, SHIFT_MM))
                found.append(BandCheck(name, "error of its turn in degrees", turn, 0.0, TURN_DEG))
        loops = self.turn.alignment.loops
        found.append(BandCheck("three depths", "seconds to register", self.depths.seconds, 0.0, SECONDS))
        left = max((loop.after.shift_mm for loop in loops), default=float("nan"))
        found.append(BandCheck("turn", "largest loop error in mm once adjusted", left, 0.0, LOOP_MM))
        found.append(BandCheck("turn", "loop error in mm round all scans", self.turn.round_all()[0], 0.0, LOOP_MM))
        good = len(self.depths.alignment.pairs) + len(self.turn.alignment.pairs)
        found.append(BandCheck("good pairs", "number accepted", float(good), GOOD_PAIRS, float("inf")))
        for what, ratio in zip(("shift", "turn"), self.honesty, strict=True):
            found.append(BandCheck("all pairs", f"predicted over true error of the {what}", ratio, *HONEST))
        found += self.surface.checks
        for name, (wanted, got) in self.refusals.items():
            found.append(
                BandCheck(name, f"refused as {wanted} (it was: {got})", float(got in wanted.split("/")), 1.0, 1.0)
            )
        return tuple(found)

    @property
    def honesty(self) -> tuple[float, float]:
        """Predicted over true error, shift and turn: root mean squares over all pairs."""
        told, true = [], []
        for measured in (self.depths, self.turn):
            for (scan, onto), found in measured.alignment.pairs.items():
                told.append((found.uncertainty.shift_mm, found.uncertainty.turn_deg))
                true.append(measured.error(scan, onto, found))
        shift, turn = np.sqrt(np.sum(np.square(told), axis=0) / np.sum(np.square(true), axis=0))
        return float(shift), float(turn)

    @property
    def holds(self) -> bool:
        """Whether every figure lies where it must."""
        return all(check.holds for check in self.checks)

    def text(self) -> str:
        """For people: a line a pair, the loops, the refusals, and what misses."""
        rows: list[Row] = []
        for measured in (self.depths, self.turn):
            for (scan, onto), found in measured.alignment.pairs.items():
                shift, turn = measured.error(scan, onto, found)
                rows.append(_row(scan, onto, found, shift, turn))
        missed = [check.text() for check in self.checks if not check.holds]
        r1, r2 = the_letter.EXPERIMENT_3_ICP_RMS_MM.values()
        said = [
            f"errors of pairs at scale {self.scale:g}; the Letter's point-to-point RMS: {r1:.2f} and {r2:.2f} mm",
            render(rows),
            self.surface.text(),
            *(check.text() for check in self.checks if check.holds),
            f"{len(self.checks) - len(missed)} of {len(self.checks)} figures hold",
        ]
        return "\n".join([*said, *missed])

    def to_json(self) -> dict[str, Any]:
        """Plain values."""
        return {
            "scale": self.scale,
            "holds": self.holds,
            "surface": self.surface.to_json(),
            "checks": [{**vars(check), "holds": check.holds} for check in self.checks],
            "refusals": {name: {"wanted": wanted, "got": got} for name, (wanted, got) in self.refusals.items()},
            "pairs": [
                _row(scan, onto, found, *measured.error(scan, onto, found))
                for measured in (self.depths, self.turn)
                for (scan, onto), found in measured.alignment.pairs.items()
            ],
        }


def prove_registration(
    scale: float = 1.0, *, poses: int = POSES, seed: int = 0, progress: Progress = ignore_progress
) -> RegistrationProof:
    """Calibrate a rendered rig, scan and register three depths and a turn, and try what must be refused."""
    rig = letter(scale, seed)
    board = Board.parse(TARGET)
    plan = turn_plan(rig, board, poses)
    targets = {name: scene for name, scene in plan.items() if name.startswith("pose_")}
    model = _calibrated(rig, board, targets, part(progress, 0.0, 0.5))
    scans = {name: scene for name, scene in plan.items() if isinstance(scene, MeshScene)}
    clouds, measured, true = {}, [], []
    for i, (name, scene) in enumerate(scans.items()):
        progress(0.5 + 0.25 * i / len(scans), name)
        renderer = Renderer(rig, scene)
        clouds[name] = _scanned(renderer, model, name, len(targets) + i)
        known = np.flatnonzero(clouds[name].mask & renderer.truth().mask)[::_EVERY]
        measured.append(clouds[name].points.reshape(-1, 3)[known].astype(float))
        true.append(renderer.truth().points.reshape(-1, 3)[known])
    # A calibration's camera frame is a gauge: turned by a part of a milliradian it measures every distance the same.
    T_calibrated_camera = fit_rigid(np.concatenate(true), np.concatenate(measured))
    depths, turn = (
        {name: cloud for name, cloud in clouds.items() if name.startswith(kind)} for kind in ("object_", "turn_")
    )
    truth = {name: T_calibrated_camera @ _matrix(scene.pose) for name, scene in scans.items()}
    first = _registered(depths, "object_r3", truth, None, part(progress, 0.75, 0.8))
    around = _registered(turn, "turn_01", truth, Starts(step_deg=STEP_DEG), part(progress, 0.8, 0.88))
    progress(0.88, "fusing and meshing")
    surface = prove_surface(
        depths,
        first.alignment.T_reference_scan,
        (Mesh(scans["object_r3"].vertices, scans["object_r3"].triangles), truth),
        turn,
        around.alignment.T_reference_scan,
        (Mesh(scans["turn_01"].vertices, scans["turn_01"].triangles), truth["turn_01"]),
    )
    refusals = {}
    for k, (what, (wanted, one, other)) in enumerate(_doubtful().items()):
        progress(0.95 + 0.01 * k, what)
        pair = {
            name: _scanned(Renderer(rig, scene), model, name, 900 + k) for name, scene in (("a", one), ("b", other))
        }
        refusals[what] = wanted, _reason(pair)
    progress(1.0, "proven")
    return RegistrationProof(first, around, surface, refusals, scale)


def _calibrated(rig: SimulatedRig, board: Board, targets: Mapping[str, Scene], progress: Progress) -> Model:
    both = p18(rig.projector.size)
    observations = []
    for i, (name, scene) in enumerate(targets.items()):
        progress(0.8 * i / len(targets), name)
        observations.append(observe_scene(name, rig, scene, board, both, i))
    progress(0.8, "calibrating")
    stereo, observations = calibrate_centres(observations, rig.projector.size, TARGET)
    return calibrate_splined(observations, stereo)


def _scanned(renderer: Renderer, model: Model, name: str, number: int) -> Cloud:
    only_x = one_axis(p18(renderer.rig.projector.size), "x")
    return reconstruct(model, decode_frames(name, only_x, renderer.capture(only_x, number)))


def _registered(
    clouds: Mapping[str, Cloud],
    reference: str,
    truth: Mapping[str, np.ndarray],
    starts: Starts | None,
    progress: Progress,
) -> RegisteredScans:
    begun = perf_counter()
    found = register_all(clouds, reference, starts, lambda done: progress(done, "registering"))
    taken = perf_counter() - begun
    return RegisteredScans(clouds, found, {name: truth[name] for name in clouds}, taken)


def _reason(pair: Mapping[str, Cloud]) -> str:
    try:
        register_all(pair, "b")
    except Refused as refusal:
        return refusal.reason
    except InputError as error:
        return str(error)
    return "accepted"


def _doubtful() -> dict[str, tuple[str, Scene, Scene]]:
    """Two scans each that must not be registered, and the reason."""
    near, far = np.array([0.0, 0.0, 560.0]), np.array([6.0, -4.0, 620.0])
    tilts = [np.radians(turns) for turns in ((4.0, -6.0, 2.0), (-5.0, 3.0, 6.0))]
    vertices, triangles = _cylinder(40.0, 150.0)
    first, second = Pose(rotation(tilts[0]), near), Pose(rotation(tilts[1]), far)
    return {
        "two scans of a plane": ("plane", blank_board(first), blank_board(second)),
        "two scans of a sphere": ("sphere", sphere((4.0, -3.0, 640.0)), sphere((-8.0, 6.0, 690.0))),
        "two scans of a cylinder": (
            "cylinder",
            MeshScene(vertices, triangles, first),
            MeshScene(vertices, triangles, second),
        ),
        "scans of unrelated objects": (
            "disagree/overlap",
            demo_object(first),
            MeshScene(*stone(), Pose(np.diag([1.0, -1.0, -1.0]), far)),
        ),
    }


def _cylinder(radius: float, length: float) -> tuple[np.ndarray, np.ndarray]:
    """An open one along y, so fine that its facets are lost in the noise: vertices (n, 3) mm, triangles (m, 3)."""
    around, along = 720, 2
    angles = np.arange(around) * 2 * np.pi / around
    ring = np.stack([radius * np.cos(angles), np.zeros(around), radius * np.sin(angles)], axis=1)
    vertices = np.concatenate([ring + np.array([0, y, 0]) for y in np.linspace(-length / 2, length / 2, along)])
    i, j = np.arange(around), (np.arange(around) + 1) % around
    return vertices, np.concatenate([np.stack([i, i + around, j], 1), np.stack([j, i + around, j + around], 1)])


def _size_of(D: np.ndarray, centre: np.ndarray) -> tuple[float, float]:
    """How far a motion (4, 4) shifts a point (3,), mm, and its angle, degrees."""
    shift = np.linalg.norm(D[:3, :3] @ centre + D[:3, 3] - centre)
    return float(shift), float(np.degrees(Rotation.from_matrix(D[:3, :3]).magnitude()))


def _row(scan: str, onto: str, found: Registration, shift: float, turn: float) -> Row:
    return {
        "scan": scan,
        "onto": onto,
        "error um": 1000 * shift,
        "error mdeg": 1000 * turn,
        "told um": 1000 * found.uncertainty.shift_mm,
        "told mdeg": 1000 * found.uncertainty.turn_deg,
        "RMS mm": found.rms_mm,
        "point to point mm": found.inlier_rmse_mm,
        "overlap %": 100 * found.overlap,
        "start": found.start,
    }


def _matrix(pose: Pose) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = pose.R, pose.t
    return T
