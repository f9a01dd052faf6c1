"""Whether captures of a hostile rig are measured, or refused for the right reason: fault by fault,
at each severity.

A fault strikes either the scans, which a sound calibration then measures, or the target poses of a
calibration, with which sound scans are measured. Errors are those of z against the truth, after the
rigid motion that a calibration leaves open has been removed: it is fitted to the sound scans.
"""

import re
import shutil
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Literal, get_args

import numpy as np

from slviewer.errors import SlviewerError, UsageError
from slviewer.evaluation.render import Row
from slviewer.geometry.rigid import fit_rigid, move_points
from slviewer.pipeline.feedback import Progress, ignore_progress
from slviewer.simulation.hostile import FAULTS, SEVERITIES, Direction, Fault, Severity
from slviewer.simulation.rig import letter
from slviewer.validation.hostile_captures import SCANS, CaseReport, HostileBench, MeasuredScan
from slviewer.validation.proof import Proof, root_mean_square

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

Outcome = Literal[
    "measured", "degraded, warned", "noisier as predicted", "refused",
    "TURNED AWAY", "UNEXPLAINED LOSS", "WRONG REASON", "SILENTLY WRONG", "CRASH",
]  # fmt: skip
PASSED: tuple[Outcome, ...] = ("measured", "degraded, warned", "noisier as predicted", "refused")

_WORDS: tuple[tuple[str, frozenset[str]], ...] = (
    (r"outside the projector", frozenset({"projector-size"})),
    (r"no pixel carries a readable", frozenset({"unreadable"})),
    (r"[Cc]ircles were|[Cc]ircles detected|board's columns", frozenset({"board"})),
    (r"% of the image before", frozenset({"crosstalk"})),
    (r"are saturated and masked", frozenset({"saturation"})),
    (r"fringes are weak", frozenset({"dark"})),
    (r"lamps or a projector that flicker", frozenset({"flicker"})),
    (r"images were compressed", frozenset({"jpeg"})),
    (r"x and y are exchanged", frozenset({"axes-swapped"})),
    (r"axis is reversed|turned by 180", frozenset({"axis-reversed"})),
    (r"calibration is of another rig", frozenset({"other-rig", "moved"})),
)
"""What messages without a structured cause name, by their facts."""
_OPEN: tuple[tuple[str, frozenset[str]], ...] = (
    (r"uncertainty of the points", frozenset({"other-rig", "moved", "motion"})),
    (r"neighbouring pixels scatter", frozenset({"noise"})),
)
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
    done: list[HostileCase] = []
    with tempfile.TemporaryDirectory(prefix="slviewer-hostile-") as folder:
        models = ("stereo", "splined") if splined else ("stereo",)
        progress(0.0, "the undisturbed rig")
        trial = _Trial(
            HostileBench(rig, Path(folder), poses=8 if splined else 7, models=models, seed=seed)
        )
        for i, (name, severity, direction) in enumerate(chosen):
            progress((i + 1) / (len(chosen) + 1), f"{name}, {severity}, in the {direction}")
            done.append(trial.run(name, severity, direction))
    failed = [case for case in done if not case.passed]
    lines = [f"{len(done) - len(failed)} of {len(done)} hold, at scale {scale:g}"]
    for case in failed:
        lines.append(f"\n{case.fault}, {case.severity}, {case.direction}: {case.outcome}")
        lines += [f"  {message}" for message in case.messages] or ["  (no message)"]
    return Proof(not failed, scale, [case.row() for case in done], {"cases": done}, below=lines)


def choose_cases(wanted: Sequence[str] = ()) -> list[tuple[str, Severity, Direction]]:
    """All cases, or those that begin with one of the ``wanted``, colons between fault, severity and
    direction."""
    every = [
        (name, severity, direction)
        for direction in get_args(Direction)
        for name, fault in FAULTS.items()
        for severity in SEVERITIES
        if direction in fault.directions
    ]
    chosen: list[tuple[str, Severity, Direction]] = []
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
        chosen += [case for case in matching if case not in chosen]
    return chosen


class _Trial:
    """The undisturbed session, and each case against it."""

    def __init__(self, bench: HostileBench) -> None:
        self._bench = bench
        self._session = bench.folder / "sound"
        report = CaseReport()
        bench.store(self._session, {name: bench.capture(name)[0] for name in bench.targets}, report)
        bench.calibrate(self._session, report)
        measured = self._measure_scans(self._session, report)
        self._gauge = fit_gauge(measured)
        self._floor = score(measured, self._gauge)

    def run(self, name: str, severity: Severity, direction: Direction) -> HostileCase:
        """Run one case; an error, a crash too, is its result."""
        start, report = perf_counter(), CaseReport()
        measured: Sequence[MeasuredScan] = ()
        try:
            if direction == "scan":
                measured = self._measure_scans(self._session, report, FAULTS[name], severity)
            else:
                measured = self._measure_after_faulty_calibration(FAULTS[name], severity, report)
        except Exception as error:  # the other cases still have to run
            report.error = error
        gauge = self._gauge if direction == "scan" or not measured else fit_gauge(measured)
        figures = score(measured, gauge) if measured else None
        outcome, named = judge_case(FAULTS[name], severity, report, figures, self._floor)
        messages = [
            *report.warnings,
            *([f"{type(report.error).__name__}: {report.error}"] if report.error else []),
        ]
        seconds = perf_counter() - start
        return HostileCase(
            name,
            severity,
            direction,
            outcome,
            outcome in PASSED,
            figures,
            self._floor,
            named,
            tuple(messages),
            seconds,
        )

    def _measure_scans(
        self,
        session: Path,
        report: CaseReport,
        fault: Fault | None = None,
        severity: Severity = "mild",
    ) -> list[MeasuredScan]:
        """Measure all scans, captured with the fault if there is one, with the calibration of a
        session."""
        shots = {name: self._bench.capture(name, fault, severity) for name in SCANS}
        self._bench.store(session, {name: shot[0] for name, shot in shots.items()}, report)
        return [
            self._bench.measure(session, name, shot[1:], report) for name, shot in shots.items()
        ]

    def _measure_after_faulty_calibration(
        self, fault: Fault, severity: Severity, report: CaseReport
    ) -> Sequence[MeasuredScan]:
        """Calibrate from target poses of which some have the fault, and measure the clean scans."""
        bench, session = self._bench, self._bench.folder / "hostile"
        shutil.rmtree(session, ignore_errors=True)
        struck = bench.targets[: fault.struck[SEVERITIES.index(severity)]]
        frames = {
            n: bench.capture(n, *((fault, severity) if n in struck else ()))[0]
            for n in bench.targets
        }
        bench.store(session, frames, report)
        bench.calibrate(session, report)
        return self._measure_scans(session, report)


def judge_case(
    fault: Fault, severity: Severity, report: CaseReport, figures: Figures | None, floor: Figures
) -> tuple[Outcome, tuple[str, ...]]:
    """The outcome of a case, and the causes that the program named."""
    texts = [*report.warnings, *([str(report.error)] if report.error and not report.named else [])]
    named = report.named + _match_causes(_WORDS, texts)
    named += [causes for causes in _match_causes(_OPEN, texts) if causes & fault.causes]
    words = tuple(dict.fromkeys("|".join(sorted(each)) for each in named))
    if report.error is not None and not isinstance(report.error, SlviewerError):
        return "CRASH", words
    is_right = any(each & fault.causes for each in named)
    must_measure = fault.must_measure and severity == "mild"
    if figures is None or report.error is not None:
        return (
            "WRONG REASON" if not is_right else "TURNED AWAY" if must_measure else "refused"
        ), words
    if named and not is_right:
        return "WRONG REASON", words
    return _judge_figures(figures, floor, is_right, must_measure), words


def _match_causes(
    facts: Sequence[tuple[str, frozenset[str]]], texts: Sequence[str]
) -> list[frozenset[str]]:
    """The causes whose pattern is in one of the texts."""
    return [causes for pattern, causes in facts if any(re.search(pattern, text) for text in texts)]


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
    rms, predicted = (
        root_mean_square(np.sort(np.abs(values[target]))[:most]) for values in (errors, sigma)
    )
    return Figures(
        rms,
        predicted,
        float(wrong.mean()) if len(wrong) else 0.0,
        float(target.sum() / max(expected, 1)),
    )
