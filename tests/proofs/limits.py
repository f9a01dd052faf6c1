"""Rigs at their limits: projectors on any side and turned, small and large angles, tiny and large
fields, cameras with high pixels, telecentric and fisheye lenses, projectors that correct keystone.
Each measures planes as well as its noise allows, or is refused with what limits it."""

import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
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
from slviewer.simulation.lens import SimulatedLens
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
DEEPEST = 1.17
"""Distance of the farthest board, in working distances."""
MACRO = 8 / 380
"""Scale of a world in which a field of 380 mm is one of 8."""


Corners = tuple[tuple[float, float], ...]


@dataclass(frozen=True, eq=False)
class LimitLens(SimulatedLens):
    """A lens behind which a homography ``corrects`` (3, 3) keystone, from its pixels to those of
    the image; where ``is_fisheye``, the distance from the image's centre grows with the angle, not
    with its tangent."""

    corrects: np.ndarray = field(default_factory=lambda: np.eye(3))
    is_fisheye: bool = False

    def project(self, points: np.ndarray) -> np.ndarray:
        """Pixels (..., 2) of points (..., 3) mm."""
        if self.is_fisheye:
            radius = np.linalg.norm(points[..., :2], axis=-1)
            angle = np.arctan2(radius, points[..., 2])
            # seen under this angle, at its tangent's place
            points = np.concatenate(
                [
                    points[..., :2] * (angle / np.maximum(radius, 1e-12))[..., None],
                    np.where(angle < np.pi / 2, 1.0, np.nan)[..., None],
                ],
                axis=-1,
            )
        pixels = super().project(points)
        mapped = np.concatenate([pixels, np.ones_like(pixels[..., :1])], axis=-1) @ self.corrects.T
        return np.asarray(mapped[..., :2] / mapped[..., 2:])

    def undistort(self, pixels: np.ndarray) -> np.ndarray:
        """(x/z, y/z), (..., 2), that project to pixels (..., 2) of a lens without keystone; NaN
        where a ray is at a right angle to the axis, or behind it."""
        places = super().undistort(pixels)
        if not self.is_fisheye:
            return places
        angle = np.linalg.norm(places, axis=-1)
        angle[angle >= np.pi / 2] = np.nan
        return np.asarray(places * (np.tan(angle) / np.maximum(angle, 1e-12))[..., None])


@dataclass(frozen=True)
class Limit:
    """A rig: where its projector is about the camera's axis, ``around`` degrees (0: to the right,
    90: below), seen at an ``angle`` from the middle of the field, itself turned by ``roll`` about
    its axis (180: upside down).

    ``scale`` of the world; ``defocus``: factor of the blur that depth makes; ``circles``: columns
    and rows of the board. ``camera_mm``: the camera's distance, from which a longer or shorter lens
    sees the same field; ``fisheye_deg``: the width that a fisheye sees there; ``pixel_height``:
    height of the camera's pixels, in widths. ``keystone``: corners between which the projector
    shows its image, in widths and heights of its own, in the order of reading. ``limited_by``: the
    word that a refusal or a finding has to name, "" where the rig is as good as any.
    """

    around: float = 180.0
    angle: float = 17.0
    roll: float = 0.0
    scale: float = 1.0
    defocus: float = 1.0
    circles: tuple[int, int] = (21, 16)
    camera_mm: float = WORKING_MM
    fisheye_deg: float = 0.0
    pixel_height: float = 1.0
    keystone: Corners = ()
    limited_by: str = ""

    @property
    def back_mm(self) -> float:
        """How far the camera is behind the place that it has in the other rigs, in a world of
        scale 1."""
        return self.camera_mm - WORKING_MM

    def build(self, resolution: float, seed: int) -> tuple[SimulatedRig, list[Pose]]:
        """Return the rig, and poses of a board in its field."""
        rig = letter(resolution, seed)
        around, angle = np.radians([self.around, self.angle])
        away = np.array([np.sin(angle) * np.cos(around), np.sin(angle) * np.sin(around)])
        centre = WORKING_MM * np.array([*away, 1 - np.cos(angle)])
        R = _aim(rig, centre, np.radians(self.roll))
        projector = _correct_keystone(rig.projector, self.keystone)
        rig = replace(rig, R=R, t=-R @ centre, projector=projector)
        poses = target_poses(
            self._narrow_view(rig), Board("circles", *self.circles, PITCH_MM), POSES
        )
        back = np.array([0.0, 0.0, self.back_mm])
        light = replace(
            rig.light,
            focus_mm=rig.light.focus_mm * self.scale,
            defocus_px_mm=rig.light.defocus_px_mm * self.scale * self.defocus,
        )
        rig = replace(
            rig,
            t=-R @ (centre + back) * self.scale,
            camera=self._camera(rig.camera),
            light=light,
        )
        return rig, [Pose(pose.R, (pose.t + back) * self.scale) for pose in poses]

    def _narrow_view(self, rig: SimulatedRig) -> SimulatedRig:
        """Return the rig with the camera of the other rigs, which sees no more than this one's at
        any depth of a board: from afar, the field is as wide behind its middle as there."""
        if self.camera_mm <= WORKING_MM:
            return rig
        (fx, fy), lens = rig.camera.focal_px, rig.camera
        return replace(rig, camera=replace(lens, focal_px=(DEEPEST * fx, DEEPEST * fy)))

    def _camera(self, lens: SimulatedLens) -> LimitLens:
        """Return the camera's lens with this rig's distance, kind and pixels; its distortion is the
        same on the image."""
        longer, height = self.camera_mm / WORKING_MM, self.pixel_height
        if self.fisheye_deg:
            longer = lens.full_size[0] / np.radians(self.fisheye_deg) / lens.focal_px[0]
        k1, k2, p1, p2, k3 = lens.brown
        waves = lens.waves * [1, height, 1, 1, 1 / height, 1 / height]
        (width, rows), (cx, cy) = lens.full_size, lens.centre_px
        return LimitLens(
            (width, round(rows / height)),
            (lens.focal_px[0] * longer, lens.focal_px[1] * longer / height),
            (cx, (cy + 0.5) / height - 0.5),
            (k1 * longer**2, k2 * longer**4, p1 * longer, p2 * longer, k3 * longer**6),
            waves,
            lens.scale,
            is_fisheye=self.fisheye_deg > 0,
        )


def _correct_keystone(lens: SimulatedLens, corners: Corners) -> SimulatedLens:
    """Return a projector's lens whose image is shown between these corners of its panel."""
    if not corners:
        return lens
    outer = np.array([(0, 0), (1, 0), (0, 1), (1, 1)]) * lens.full_size - 0.5
    inner = np.array(corners) * lens.full_size - 0.5
    corrects = cv2.getPerspectiveTransform(inner.astype(np.float32), outer.astype(np.float32))
    return LimitLens(
        lens.full_size, lens.focal_px, lens.centre_px, lens.brown, lens.waves, lens.scale,
        corrects=corrects,
    )  # fmt: skip


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
    "pixels twice as high": Limit(pixel_height=2),
    "lens ten times as long": Limit(camera_mm=10 * WORKING_MM, circles=(14, 11)),
    "telecentric lens": Limit(
        camera_mm=1000 * WORKING_MM, circles=(14, 11), limited_by="telecentric"
    ),
    "fisheye of 120 degrees": Limit(
        angle=60, camera_mm=0.3 * WORKING_MM, fisheye_deg=120, limited_by="fisheye"
    ),
    "keystone": Limit(keystone=((0.1, 0), (0.9, 0), (0, 1), (1, 1)), limited_by="keystone"),
    "keystone of four corners": Limit(
        keystone=((0.1, 0.02), (0.96, 0.08), (0, 0.94), (0.9, 1)), limited_by="keystone"
    ),
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
        render(
            name,
            blank_board(pose_at((x, y, 0), (0, 0, (z + limit.back_mm) * limit.scale)), size),
            50 + k,
        )
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
            text = f"{row.get('refused', '')} {row.get('findings', '')}"
            if limit.limited_by:
                is_named = float(limit.limited_by in text)
                checks.append(BandCheck(name, f"{limit.limited_by} named", is_named, 1, 1))
            else:
                checks.append(BandCheck(name, "refused", float("refused" in row), 0, 0))
            if "ratio" in row and not limit.limited_by:
                what = "splined planes, in floors"
                checks.append(BandCheck(name, what, float(row["ratio"]), 0.8, MOST_FLOORS))
    return prove_checks(checks, scale, rows, {"rigs": rows})
