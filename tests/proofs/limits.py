"""Rigs at their limits: projectors on any side and turned, small and large angles, tiny and large
fields. Each measures planes as well as its noise allows, or is refused with what limits it."""

import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from slviewer.errors import SlviewerError
from slviewer.evaluation.render import Row
from slviewer.fringe.presets import p18
from slviewer.geometry.vectors import unit_vectors
from slviewer.pipeline.operation import Progress
from slviewer.pipeline.session_operations import SessionOperations
from slviewer.records.calibration import ModelCalibration
from slviewer.session.capture import NewCapture
from slviewer.simulation.boards import Pose, blank_board, printed_board
from slviewer.simulation.plans import pose_at, rotation, target_poses
from slviewer.simulation.renderer import Renderer
from slviewer.simulation.rig import SimulatedRig, letter
from slviewer.simulation.scenes import Scene
from slviewer.target.board import Board
from tests.proofs.proof import BandCheck, Proof, prove_checks

POSES = 9
WORKING_MM = 600.0
PITCH_MM = 9.0
PLANES = {"plane_1": (540.0, 12.0, -8.0), "plane_2": (650.0, -10.0, 15.0)}
"""Depth, mm, and tilts, degrees."""
MOST_FLOORS = 1.15
"""Largest RMS of the splined model's planes, in floors."""
MACRO = 8 / 380
"""Scale of a world in which a field of 380 mm is one of 8."""


@dataclass(frozen=True)
class Limit:
    """A rig: where its projector is about the camera's axis, ``around`` degrees (0: to the right,
    90: below), seen at an ``angle`` from the middle of the field, itself turned by ``roll`` about
    its axis (180: upside down).

    ``scale`` of the world; ``defocus``: factor of the blur that depth makes; ``circles``: columns
    and rows of the board.
    """

    around: float = 180.0
    angle: float = 17.0
    roll: float = 0.0
    scale: float = 1.0
    defocus: float = 1.0
    circles: tuple[int, int] = (21, 16)

    def build(self, resolution: float, seed: int) -> tuple[SimulatedRig, list[Pose]]:
        """Return the rig, and poses of a board in its field."""
        rig = letter(resolution, seed)
        around, angle = np.radians([self.around, self.angle])
        away = np.array([np.sin(angle) * np.cos(around), np.sin(angle) * np.sin(around)])
        centre = WORKING_MM * np.array([*away, 1 - np.cos(angle)])
        R = _aim(rig, centre, np.radians(self.roll))
        rig = replace(rig, R=R, t=-R @ centre)
        poses = target_poses(rig, Board("circles", *self.circles, PITCH_MM), POSES)
        light = replace(
            rig.light,
            focus_mm=rig.light.focus_mm * self.scale,
            defocus_px_mm=rig.light.defocus_px_mm * self.scale * self.defocus,
        )
        rig = replace(rig, t=rig.t * self.scale, light=light)
        return rig, [Pose(pose.R, pose.t * self.scale) for pose in poses]


def _aim(rig: SimulatedRig, centre: np.ndarray, roll: float) -> np.ndarray:
    """Return the turn (3, 3) of a projector at ``centre`` whose image's middle meets the middle of
    the field."""
    lens = rig.projector
    middle = (np.array(lens.full_size) / 2 - lens.centre_px) / lens.focal_px
    ahead = unit_vectors(np.array([0.0, 0.0, WORKING_MM]) - centre)
    right = unit_vectors(np.array([1.0, 0.0, 0.0]) - ahead[0] * ahead)
    look = np.array([right, np.cross(ahead, right), ahead])
    look = rotation(np.array([0.0, 0.0, roll])) @ look
    own = unit_vectors(np.array([*middle, 1.0]))
    axis = np.cross([0.0, 0.0, 1.0], own)
    return np.asarray(rotation(axis / np.linalg.norm(axis) * np.arccos(own[2])) @ look)


RIGS: Mapping[str, Limit] = {
    "projector to the left": Limit(),
    "projector to the right": Limit(0),
    "projector above": Limit(-90),
    "projector below": Limit(90),
    "projector upside down": Limit(roll=180),
    "projector on its side": Limit(roll=90, circles=(14, 11)),
    "angle of 2 degrees": Limit(angle=2),
    "angle of 60 degrees": Limit(angle=60),
    "field of 8 mm": Limit(scale=MACRO),
    "field of 8 mm, out of focus": Limit(scale=MACRO, defocus=6),
    "field of 4 m": Limit(scale=4000 / 380),
}


def measure_limit(limit: Limit, resolution: float, seed: int, folder: Path) -> Row:
    """Render a rig's captures, calibrate it and measure planes; return the figures."""
    rig, poses = limit.build(resolution, seed)
    board = Board("circles", *limit.circles, PITCH_MM * limit.scale)
    sequence = p18(rig.projector.size)

    def render(name: str, scene: Scene, number: int) -> NewCapture:
        """Return a capture."""
        return NewCapture(name, sequence, Renderer(rig, scene).capture(sequence, number))

    targets = [
        render(f"pose_{k:02d}", printed_board(board, pose, seed=seed), k)
        for k, pose in enumerate(poses)
    ]
    size = 220 * limit.scale, 176 * limit.scale
    planes = [
        render(name, blank_board(pose_at((x, y, 0), (0, 0, z * limit.scale)), size), 50 + k)
        for k, (name, (z, x, y)) in enumerate(PLANES.items())
    ]
    with SessionOperations.create(folder) as session:
        session.save_captures(targets, "calibration", board=str(board))
        session.save_captures(planes, "scan")
        try:
            found = session.calibrate(str(board))
        except SlviewerError as error:
            return {"refused": str(error)}
        stereo = found["stereo"]
        assert isinstance(stereo, ModelCalibration) and stereo.verdict is not None
        findings = [each for each in stereo.verdict.findings if each.severity != "note"]
        fits = [each.models["splined"] for each in session.verify(list(PLANES), "plane").values()]
    rms = float(np.mean([fit.rms_mm for fit in fits]))
    floor = float(np.mean([fit.noise_floor_mm for fit in fits]))
    return {
        "verdict": stereo.verdict.level,
        "RMS mm": rms,
        "floor mm": floor,
        "ratio": rms / floor,
        "findings": "; ".join(each.text() for each in findings),
    }


def prove_limits(scale: float, seed: int, progress: Progress) -> Proof:
    """Calibrate each rig and measure planes with it: at the floor, or refused with a reason.

    ``scale``: resolution of the cameras.
    """
    rows: list[Row] = []
    checks: list[BandCheck] = []
    with tempfile.TemporaryDirectory() as scratch:
        for k, (name, limit) in enumerate(RIGS.items()):
            progress(k / len(RIGS), name)
            row = measure_limit(limit, scale, seed, Path(scratch) / str(k))
            rows.append({"rig": name, **row})
            if "ratio" in row:
                what = "splined planes, in floors"
                checks.append(BandCheck(name, what, float(row["ratio"]), 0.8, MOST_FLOORS))
    return prove_checks(checks, scale, rows, {"rigs": rows})
