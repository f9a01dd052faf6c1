"""Whether captures of a hostile rig are measured, or refused for the right reason: fault by fault,
at each severity.

A fault strikes either the scans, which a sound calibration then measures, or the target poses of a
calibration, with which sound scans are measured. Errors are those of z against the truth, after the
rigid motion that a calibration leaves open has been removed: it is fitted to the sound scans.
"""

import re
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from time import perf_counter
from typing import Literal, get_args

import cv2
import numpy as np

from slviewer.errors import SlviewerError, UsageError
from slviewer.evaluation.letter import SPHERE_RADIUS_MM
from slviewer.evaluation.render import Row
from slviewer.examination.examine import examine
from slviewer.fringe.presets import AXES, gray_bits, phase_steps
from slviewer.fringe.sequence import Frame, PatternSequence
from slviewer.geometry.rigid import fit_rigid, move_points
from slviewer.geometry.vectors import rms
from slviewer.pipeline.calibrate import CalibrateSettings, calibrate
from slviewer.pipeline.import_captures import import_captures
from slviewer.pipeline.models import ModelName, load_last_verdict
from slviewer.pipeline.operation import Job, Progress, ignore_progress
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
from slviewer.simulation.plans import planes, spheres, target_poses
from slviewer.simulation.renderer import Renderer
from slviewer.simulation.rig import SimulatedRig, letter
from slviewer.target.board import Board
from tests.proofs.hostile_frames import Frames
from tests.proofs.hostile_rig import (
    FAULTS,
    SEVERITIES,
    SOUND,
    Direction,
    Fault,
    Severity,
    expose_frames,
    hostile_light,
    render_light,
)
from tests.proofs.hostile_scenes import CleanScene, MirrorTable
from tests.proofs.proof import Proof

BOARD = Board.parse("circles:21x16:9")
SCANS = ("plane_04", "sphere_3")
"""Inside the calibrated depths."""
STEPS, PERIOD_PX, BITS = 8, 16.0, 7
_SAME_SURFACE_MM = 3.0
MOST_OVER_FLOOR = 1.5
"""Times the undisturbed RMS, within which a case is measured."""
SIGMAS = 3.0
GROSS = 0.01
"""Share of points beyond `SIGMAS`, more than of the undisturbed scans, that makes a result
wrong."""
LEAST_COVERAGE = 0.9
"""Share of the undisturbed coverage that a measured case has."""
EXPLAINED_LOSS = 0.7
"""Share of it below which the loss has to be explained."""
_TRIMMED = 0.99  # of the points count in an RMS; those beyond are counted one by one, by `GROSS`

Case = tuple[str, Severity, Direction]
Outcome = Literal[
    "measured", "degraded, warned", "noisier as predicted", "refused",
    "TURNED AWAY", "UNEXPLAINED LOSS", "WRONG REASON", "SILENTLY WRONG", "CRASH",
]  # fmt: skip
PASSED: tuple[Outcome, ...] = ("measured", "degraded, warned", "noisier as predicted", "refused")

_WORDS = {
    r"outside the projector": "projector-size",
    r"no pixel carries a readable": "unreadable",
    r"[Cc]ircles were|[Cc]ircles detected|board's columns": "board",
    r"% of the image before": "crosstalk",
    r"are saturated and masked": "saturation",
    r"fringes are weak": "dark",
    r"lamps or a projector that flicker": "flicker",
    r"images were compressed": "jpeg",
    r"x and y are exchanged": "axes-swapped",
    r"axis is reversed|turned by 180": "axis-reversed",
    r"calibration is of another rig": "other-rig|moved",
}
"""What messages without a structured cause name, by their facts; several causes joined by "|"."""
_OPEN = {
    r"uncertainty of the points": "other-rig|moved|motion",
    r"neighbouring pixels scatter": "noise",
}
"""What messages name that leave the cause open: right where it is among them, and never wrong."""


@dataclass(frozen=True)
class Figures:
    """``rms_mm``: of z over the best 99 % of the target's points; ``predicted_mm`` of the same;
    ``gross``: share of all measured points beyond 3 sigma; ``coverage``: share of the target's
    illuminated pixels that were measured.
    """

    rms_mm: float
    predicted_mm: float
    gross: float
    coverage: float


@dataclass(frozen=True)
class HostileCase:
    """One fault at one severity, and the outcome; ``figures``: None where nothing was measured.
    ``named``: the causes that the messages name."""

    fault: str
    severity: Severity
    direction: Direction
    outcome: Outcome
    passed: bool
    figures: Figures | None
    floor: Figures
    named: tuple[str, ...]
    messages: tuple[str, ...]
    seconds: float

    def row(self) -> Row:
        """The case as a row of the table."""
        figures = self.figures or Figures(*[float("nan")] * 4)
        return {
            "fault": self.fault,
            "severity": self.severity,
            "in": self.direction,
            "RMS mm": figures.rms_mm,
            "predicted": figures.predicted_mm,
            "floor": self.floor.rms_mm,
            ">3 sigma %": 100 * figures.gross,
            "coverage %": 100 * figures.coverage,
            "named": ", ".join(self.named) or "-",
            "outcome": self.outcome,
            "s": round(self.seconds, 1),
        }


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
class CaseRun:
    """A case in a ``session``, and the program's messages on it: its warnings, the causes that it
    named, and the error that ended it."""

    session: Path
    fault: Fault = SOUND
    severity: Severity = "mild"
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
    models: tuple[ModelName, ...] = ("stereo",)
    seed: int = 0
    _light: dict[str, tuple[Frames, Renderer]] = field(default_factory=dict, init=False, repr=False)

    @cached_property
    def sequence(self) -> PatternSequence:
        """Phase steps, Gray code and complementary bit: as many frames along x as along y; white at
        the end."""
        frames: list[Frame] = []
        for axis in AXES:
            frames += *phase_steps(axis, STEPS, PERIOD_PX), *gray_bits(axis, BITS)
            frames.append(Frame("complementary", axis))
        return PatternSequence(self.rig.projector.size, (*frames, Frame("texture")))

    @cached_property
    def scenes(self) -> dict[str, CleanScene]:
        """Target poses and scans by name, in the order of their numbers."""
        scenes: dict[str, CleanScene] = {
            f"pose_{i:02d}": printed_board(BOARD, pose, seed=self.rig.seed)
            for i, pose in enumerate(target_poses(self.rig, BOARD, self.poses), 1)
        }
        plane, ball = SCANS
        return {**scenes, plane: planes()[plane], ball: spheres()[ball]}

    @property
    def targets(self) -> tuple[str, ...]:
        """Names of the target poses."""
        return tuple(name for name in self.scenes if name.startswith("pose_"))

    def capture(
        self, name: str, fault: Fault = SOUND, severity: Severity = "mild"
    ) -> tuple[Frames, Renderer, Renderer]:
        """(n, h, w) uint8, and the renderers of the scene as it was and of the clean one."""
        scene, number = self.scenes[name], list(self.scenes).index(name)
        if name not in self._light:
            self._light[name] = render_light(self.rig, scene, self.sequence)
        light, clean = self._light[name]
        renderer = clean
        if fault.is_optical:
            light, renderer = hostile_light(fault, severity, self.rig, scene, self.sequence, number)
        frames = expose_frames(renderer, light, self.sequence, number, fault, severity, self.seed)
        return frames, renderer, clean

    def measure_anew(self, run: CaseRun) -> list[MeasuredScan]:
        """Calibrate from target poses, of which some have the fault of the run, and measure the
        clean scans; the run gets the causes of the calibration's verdict too."""
        shutil.rmtree(run.session, ignore_errors=True)
        struck = run.fault.struck[SEVERITIES.index(run.severity)]
        frames = {
            name: self.capture(name, run.fault if i < struck else SOUND, run.severity)[0]
            for i, name in enumerate(self.targets)
        }
        self._store(run, "calibration", frames)
        try:
            settings = CalibrateSettings(str(BOARD), self.models)
            calibrate.run(run.session, settings, warn=run.warnings.append)
        finally:
            with Session.open(run.session) as store:
                verdict = load_last_verdict(store)
            run.named += [frozenset({cause}) for cause in verdict.causes] if verdict else []
        return self.measure_scans(run)

    def measure_scans(self, run: CaseRun, fault: Fault = SOUND) -> list[MeasuredScan]:
        """Measure all scans, captured with the fault if there is one, with the calibration of the
        run's session."""
        shots = {name: self.capture(name, fault, run.severity) for name in SCANS}
        self._store(run, "scan", {name: shot[0] for name, shot in shots.items()})
        return [self._measure(run, name, shot[1:]) for name, shot in shots.items()]

    def _store(
        self, run: CaseRun, role: Literal["calibration", "scan"], captures: Mapping[str, Frames]
    ) -> None:
        """Write frames as images with a TOML, and import them as anyone would."""
        source = self.folder / "images"
        shutil.rmtree(source, ignore_errors=True)
        files = [write_images(source / name, frames) for name, frames in captures.items()]
        toml = source / "sequence.toml"
        toml.write_text(describe_sequence(self.sequence, files[0]))
        messages = run.warnings
        try:
            import_captures(
                source,
                run.session,
                "frames",
                sequence=toml,
                role=role,
                force=True,
                warn=messages.append,
            )
        except SlviewerError as error:
            messages = [*messages, str(error)]
            raise
        finally:
            # the causes of the program's own findings whose sentence is part of a message
            run.named += [
                frozenset({finding.cause})
                for name, frames in captures.items()
                if (about := [message for message in messages if name in message])
                for finding in examine(self.sequence, frames).findings
                if any(finding.observation in message for message in about)
            ]

    def _measure(self, run: CaseRun, name: str, truth: tuple[Renderer, Renderer]) -> MeasuredScan:
        """Reconstruct a stored scan and fit its shape; compare with the ``truth`` that the
        renderers know."""
        shape: Shape = "plane" if name.startswith("plane") else "sphere"
        with Session.open(run.session) as store:
            job, out = Job(store, warn=run.warnings.append), self.folder / "cloud.ply"
            used = ReconstructSettings(name, self.models[-1], out=out)
            with reconstruct_capture(job, used) as made:
                cloud = made.cloud
            try:
                radius = SPHERE_RADIUS_MM if shape == "sphere" else None
                settings = VerifySettings([name], shape, self.models, radius=radius)
                verify.run(store, settings, warn=job.warn)
            except SlviewerError as error:
                run.warnings.append(str(error))
        return _match_with_truth(cloud, *truth)


def _match_with_truth(cloud: Cloud, renderer: Renderer, clean: Renderer) -> MeasuredScan:
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


def write_images(folder: Path, frames: Frames) -> list[str]:
    """Write frames (n, h, w) uint8 as numbered image files, and return their names."""
    folder.mkdir(parents=True)
    names = [f"{k:02d}.bmp" for k in range(len(frames))]
    for name, frame in zip(names, frames, strict=True):
        cv2.imwrite(str(folder / name), frame)  # written ten times as fast as PNG
    return names


def prove_hostile(
    scale: float = 0.5,
    *,
    cases: Sequence[str] = (),
    splined: bool = True,
    seed: int = 0,
    progress: Progress = ignore_progress,
) -> Proof:
    """Put every fault at every severity into scans, and into target poses, and judge the program's
    reaction.

    ``cases``: some of them, as "flicker", "flicker:mild" or "flicker:mild:scan". ``splined``:
    measure with the splined model on a rig with local distortion; otherwise with stereo on one
    without, which takes a fifth of the time.
    """
    chosen = choose_cases(cases)
    rig = letter(scale, seed) if splined else letter(scale, seed, local_distortion_px=0.0)
    models: tuple[ModelName, ...] = ("stereo", "splined") if splined else ("stereo",)
    done: list[HostileCase] = []
    with tempfile.TemporaryDirectory(prefix="slviewer-hostile-") as folder:
        progress(0.0, "the undisturbed rig")
        bench = HostileBench(rig, Path(folder), 8 if splined else 7, models, seed)
        sound = bench.measure_anew(CaseRun(bench.folder / "sound"))
        gauge = fit_gauge(sound)
        floor = score(sound, gauge)
        for i, wanted in enumerate(chosen):
            progress((i + 1) / (len(chosen) + 1), "{}, {}, in the {}".format(*wanted))
            done.append(run_case(bench, wanted, gauge, floor))
    failed = [case for case in done if not case.passed]
    lines = [f"{len(done) - len(failed)} of {len(done)} hold, at scale {scale:g}"]
    for case in failed:
        lines.append(f"\n{case.fault}, {case.severity}, {case.direction}: {case.outcome}")
        lines += [f"  {message}" for message in case.messages] or ["  (no message)"]
    return Proof(not failed, scale, [case.row() for case in done], {"cases": done}, below=lines)


def choose_cases(wanted: Sequence[str] = ()) -> list[Case]:
    """All cases, or those that begin with one of the ``wanted``, colons between fault, severity and
    direction."""
    every: list[Case] = [
        (name, severity, direction)
        for direction in get_args(Direction)
        for name, fault in FAULTS.items()
        for severity in SEVERITIES
        if direction in fault.directions
    ]
    chosen: dict[Case, None] = {}
    for pattern in wanted or ("",):
        parts = pattern.split(":")
        matching = [
            case
            for case in every
            if all(part in ("", word) for part, word in zip(parts, case, strict=False))
        ]
        if not matching or len(parts) > 3:
            raise UsageError(
                f"no hostile case is called {pattern!r}: use {', '.join(FAULTS)}; :mild, :medium or"
                " :severe"
            )
        chosen |= dict.fromkeys(matching)
    return list(chosen)


def run_case(bench: HostileBench, case: Case, gauge: np.ndarray, floor: Figures) -> HostileCase:
    """Run one case against the undisturbed session; an error, a crash too, is its result."""
    start, (name, severity, direction), figures = perf_counter(), case, None
    folder = "sound" if direction == "scan" else "hostile"
    run = CaseRun(bench.folder / folder, FAULTS[name], severity)
    try:
        if direction == "scan":
            measured = bench.measure_scans(run, run.fault)
        else:
            measured = bench.measure_anew(run)
            gauge = fit_gauge(measured)
        figures = score(measured, gauge)
    except Exception as error:  # the other cases still have to run
        run.error = error
    outcome, named = judge_case(run, figures, floor)
    passed, seconds = outcome in PASSED, perf_counter() - start
    messages = list(run.warnings)
    if run.error:
        messages.append(f"{type(run.error).__name__}: {run.error}")
    return HostileCase(*case, outcome, passed, figures, floor, named, tuple(messages), seconds)


def judge_case(
    run: CaseRun, figures: Figures | None, floor: Figures
) -> tuple[Outcome, tuple[str, ...]]:
    """The outcome of a case, and the causes that the program named."""
    fault, error = run.fault, run.error
    texts = [*run.warnings, *([str(error)] if error and not run.named else [])]
    named = run.named + _match_causes(_WORDS, texts)
    named += [causes for causes in _match_causes(_OPEN, texts) if causes & fault.causes]
    words = tuple(dict.fromkeys("|".join(sorted(each)) for each in named))
    if error is not None and not isinstance(error, SlviewerError):
        return "CRASH", words
    is_right = any(each & fault.causes for each in named)
    must_measure = fault.must_measure and run.severity == "mild"
    if figures is None or error is not None:
        return (
            "WRONG REASON" if not is_right else "TURNED AWAY" if must_measure else "refused"
        ), words
    if named and not is_right:
        return "WRONG REASON", words
    return _judge_figures(figures, floor, is_right, must_measure), words


def _match_causes(facts: Mapping[str, str], texts: Sequence[str]) -> list[frozenset[str]]:
    """The causes whose pattern is in one of the texts."""
    return [
        frozenset(causes.split("|"))
        for pattern, causes in facts.items()
        if any(re.search(pattern, text) for text in texts)
    ]


def _judge_figures(figures: Figures, floor: Figures, is_right: bool, must_measure: bool) -> Outcome:
    """The outcome of a measured case; ``is_right``: a message names its cause."""
    has_gross = figures.gross > floor.gross + GROSS
    is_good = figures.rms_mm <= MOST_OVER_FLOOR * floor.rms_mm and not has_gross
    is_wrong = figures.rms_mm > SIGMAS * figures.predicted_mm or has_gross
    if is_good and figures.coverage >= LEAST_COVERAGE * floor.coverage:
        return "measured"
    if is_right and not must_measure:
        return "degraded, warned"
    if is_wrong and not is_right:
        return "SILENTLY WRONG"
    if must_measure:
        return "TURNED AWAY"
    return (
        "noisier as predicted"
        if figures.coverage >= EXPLAINED_LOSS * floor.coverage
        else "UNEXPLAINED LOSS"
    )


def fit_gauge(measured: Sequence[MeasuredScan]) -> np.ndarray:
    """T_truth_measured (4, 4) mm that carries the measured points of all scans onto their truth.

    Least squares over the better nine tenths of the targets' points.
    """
    points = np.concatenate([m.points[m.on_target] for m in measured])
    truth = np.concatenate([m.truth[m.on_target] for m in measured])
    T = np.eye(4)
    inliers = np.ones(len(points), bool)
    for _ in range(3):
        if inliers.sum() < 10:
            break
        T = fit_rigid(points[inliers], truth[inliers])
        off = np.linalg.norm(move_points(T, points) - truth, axis=1)
        inliers = off <= np.quantile(off, 0.9)
    return T


def score(measured: Sequence[MeasuredScan], gauge: np.ndarray) -> Figures:
    """The figures of scans, errors of z in mm after the motion of ``gauge``."""
    errors = np.concatenate([(move_points(gauge, m.points) - m.truth)[:, 2] for m in measured])
    sigma = np.concatenate([m.sigma for m in measured])
    target = np.concatenate([m.on_target for m in measured])
    expected = sum(m.expected for m in measured)
    wrong = ~(np.abs(errors) <= SIGMAS * sigma)  # also where nothing is to be seen
    most = max(1, int(_TRIMMED * target.sum()))
    rms_mm, predicted_mm = (
        rms(np.sort(np.abs(values[target]))[:most]) for values in (errors, sigma)
    )
    return Figures(
        rms_mm,
        predicted_mm,
        float(wrong.mean()) if len(wrong) else 0.0,
        float(target.sum() / max(expected, 1)),
    )
