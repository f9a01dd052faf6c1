"""Captures of a hostile rig, put through the program's own path: files, import, calibration,
clouds, fitted shapes."""

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np

from slviewer.errors import SlviewerError
from slviewer.evaluation.letter import SPHERE_RADIUS_MM
from slviewer.examination.examine import examine
from slviewer.fringe.presets import AXES, gray_bits, phase_steps
from slviewer.fringe.sequence import Frame, PatternSequence
from slviewer.pipeline.calibrate import CalibrateSettings, calibrate, load_last_verdict
from slviewer.pipeline.import_captures import import_captures
from slviewer.pipeline.operation import Job
from slviewer.pipeline.reconstruct import (
    ReconstructSettings,
    VerifySettings,
    reconstruct_capture,
    verify,
)
from slviewer.reconstruction.cloud import Cloud
from slviewer.records.verification import Shape
from slviewer.session.store import Session
from slviewer.session.toml import describe_sequence
from slviewer.simulation.boards import printed_board
from slviewer.simulation.hostile import Fault, Severity, expose_frames, hostile_light, render_light
from slviewer.simulation.hostile_scenes import MirrorTable
from slviewer.simulation.plans import planes, spheres, target_poses
from slviewer.simulation.renderer import Renderer
from slviewer.simulation.rig import SimulatedRig
from slviewer.simulation.scenes import Scene
from slviewer.target.board import Board

BOARD = Board.parse("circles:21x16:9")
SCANS = ("plane_04", "sphere_3")
"""Inside the calibrated depths."""
STEPS, PERIOD_PX, BITS = 8, 16.0, 7
_SAME_SURFACE_MM = 3.0


@dataclass(frozen=True, eq=False)
class MeasuredScan:
    """A scan, point by point.

    ``points`` (n, 3) mm as measured, ``truth`` (n, 3) mm of the same pixels, NaN where they see no
    surface directly, ``sigma`` (n,) mm predicted for z; ``on_target`` (n,) bool: of the plane or
    sphere, which has ``expected`` pixels that the projector lights.
    """

    points: np.ndarray
    truth: np.ndarray
    sigma: np.ndarray
    on_target: np.ndarray
    expected: int


@dataclass(eq=False)
class CaseReport:
    """The program's messages on a case: its warnings, the causes that it named, and the error that
    ended it."""

    warnings: list[str] = field(default_factory=list)
    named: list[frozenset[str]] = field(default_factory=list)
    error: Exception | None = None


@dataclass(frozen=True, eq=False)
class HostileBench:
    """A rig, its scenes, and their clean light, each rendered when it is first needed.

    ``folder`` takes the sessions and images. ``models`` are fitted by every calibration, the last
    of them measures.
    """

    rig: SimulatedRig
    folder: Path
    poses: int = 7
    models: tuple[str, ...] = ("stereo",)
    seed: int = 0
    _light: dict[str, tuple[np.ndarray, Renderer]] = field(
        default_factory=dict, init=False, repr=False
    )

    @cached_property
    def sequence(self) -> PatternSequence:
        """Phase steps, Gray code and complementary bit: as many frames along x as along y; white at
        the end."""
        frames = [
            frame
            for axis in AXES
            for frame in (
                *phase_steps(axis, STEPS, PERIOD_PX),
                *gray_bits(axis, BITS),
                Frame("complementary", axis),
            )
        ]
        return PatternSequence(self.rig.projector.size, (*frames, Frame("texture")))

    @cached_property
    def scenes(self) -> dict[str, Scene]:
        """Target poses and scans by name, in the order of their numbers."""
        scenes: dict[str, Scene] = {
            f"pose_{i:02d}": printed_board(BOARD, pose, seed=self.rig.seed)
            for i, pose in enumerate(target_poses(self.rig, BOARD, self.poses), 1)
        }
        shapes: dict[str, Scene] = {**planes(), **spheres()}
        return {**scenes, **{name: shapes[name] for name in SCANS}}

    @property
    def targets(self) -> tuple[str, ...]:
        """Names of the target poses."""
        return tuple(name for name in self.scenes if name.startswith("pose_"))

    def capture(
        self, name: str, fault: Fault | None = None, severity: Severity = "mild"
    ) -> tuple[np.ndarray, Renderer, Renderer]:
        """(n, h, w) uint8, and the renderers of the scene as it was and of the clean one."""
        scene, number = self.scenes[name], list(self.scenes).index(name)
        if name not in self._light:
            self._light[name] = render_light(self.rig, scene, self.sequence)
        light, clean = self._light[name]
        renderer = clean
        if fault is not None and fault.is_optical:
            light, renderer = hostile_light(fault, severity, self.rig, scene, self.sequence, number)
        ambient = renderer.room_light()
        frames = expose_frames(
            renderer.rig, light, self.sequence, ambient, number, fault, severity, self.seed
        )
        return frames, renderer, clean

    def store(self, session: Path, captures: dict[str, np.ndarray], report: CaseReport) -> None:
        """Write frames as images with a TOML, and import them as anyone would; poses and scans by
        their names."""
        for role in ("calibration", "scan"):
            names = [
                name for name in captures if name.startswith("pose_") == (role == "calibration")
            ]
            if not names:
                continue
            source = self.folder / "images"
            shutil.rmtree(source, ignore_errors=True)
            files = [write_images(source / name, captures[name]) for name in names]
            toml = source / "sequence.toml"
            toml.write_text(describe_sequence(self.sequence, files[0]))
            try:
                warn = report.warnings.append
                import_captures(
                    source, session, "frames", sequence=toml, role=role, force=True, warn=warn
                )  # type: ignore[arg-type]
            except SlviewerError as error:
                report.named += named_causes(
                    self.sequence, captures, [*report.warnings, str(error)]
                )
                raise
        report.named += named_causes(self.sequence, captures, report.warnings)

    def calibrate(self, session: Path, report: CaseReport) -> None:
        """Calibrate the session's target poses; the report gets the verdict's causes."""
        try:
            calibrate.run(
                session, CalibrateSettings(str(BOARD), self.models), warn=report.warnings.append
            )
        finally:
            with Session.open(session) as store:
                verdict = load_last_verdict(store)
            report.named += [frozenset({cause}) for cause in verdict.causes] if verdict else []

    def measure(
        self, session: Path, name: str, truth: tuple[Renderer, Renderer], report: CaseReport
    ) -> MeasuredScan:
        """Reconstruct a stored scan and fit its shape; compare with the ``truth`` that the
        renderers know."""
        shape: Shape = "plane" if name.startswith("plane") else "sphere"
        with Session.open(session) as store:
            job, out = Job(store, warn=report.warnings.append), self.folder / "cloud.ply"
            used = ReconstructSettings(name, self.models[-1], out=out)  # type: ignore[arg-type]
            with reconstruct_capture(job, used) as made:
                cloud = made.cloud
            try:
                radius = SPHERE_RADIUS_MM if shape == "sphere" else None
                settings = VerifySettings([name], shape, self.models, radius=radius)  # type: ignore[arg-type]
                verify.run(store, settings, warn=job.warn)
            except SlviewerError as error:
                report.warnings.append(str(error))
        return match_with_truth(cloud, *truth)


def match_with_truth(cloud: Cloud, renderer: Renderer, clean: Renderer) -> MeasuredScan:
    """The cloud's points beside those that a perfect instrument would measure, of the scene as it
    was."""
    truth = renderer.truth()
    points = truth.points
    if isinstance(renderer.scene, MirrorTable):
        direct = renderer.scene.is_direct(renderer.rig.camera.rays())
        points = np.where(direct[..., None], points, np.nan)
    with np.errstate(invalid="ignore"):
        target = np.abs(points[..., 2] - clean.truth().points[..., 2]) < _SAME_SURFACE_MM
    measured = cloud.mask
    return MeasuredScan(
        cloud.points[measured].astype(float),
        points[measured],
        cloud.sigma[measured].astype(float),
        target[measured],
        int(np.count_nonzero(target & truth.mask)),
    )


def write_images(folder: Path, frames: np.ndarray) -> list[str]:
    """Write frames (n, h, w) uint8 as numbered image files, and return their names."""
    folder.mkdir(parents=True)
    names = [f"{k:02d}.bmp" for k in range(len(frames))]
    for name, frame in zip(names, frames, strict=True):
        cv2.imwrite(str(folder / name), frame)  # written ten times as fast as PNG
    return names


def named_causes(
    sequence: PatternSequence, captures: Mapping[str, np.ndarray], messages: Sequence[str]
) -> list[frozenset[str]]:
    """The causes that messages about captures name: those of the program's own findings whose
    sentence is part of a message."""
    named: dict[frozenset[str], None] = {}
    for name, frames in captures.items():
        about = [message for message in messages if name in message]
        if not about:
            continue
        named |= {
            frozenset({finding.cause}): None
            for finding in examine(sequence, frames).findings
            if any(finding.sentence in message for message in about)
        }
    return list(named)
