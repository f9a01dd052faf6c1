"""Whether faults of captures are named, harmful ones never pass unnoticed, and sound captures raise
no alarm.

Small captures of six kinds are simulated, some with one fault each. The truth is that of the
simulation; how the faults are made does not depend on how they are searched for.
"""

import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from time import perf_counter
from typing import Literal

import numpy as np

from slviewer.errors import InputError
from slviewer.evaluation.render import Row
from slviewer.fringe.sequence import Axis, PatternSequence
from slviewer.pipeline.capture_phases import check_capture, decode_frames
from slviewer.pipeline.examination import check_capture_exposure, examine_frames
from slviewer.pipeline.operation import Progress
from tests.proofs.capture_faults import CAPTURE_FAULTS, FaultyCapture, draw_faulty
from tests.proofs.pipelines import PIPELINES
from tests.proofs.proof import BandCheck, Proof, judge_all, prove_checks
from tests.proofs.simulated_capture import (
    KINDS,
    CaptureKind,
    SimulatedCapture,
    draw_setup,
    render_capture,
)

SOUND, REPEATS = 420, 3
"""Sound captures, and captures of each fault and kind, at full size."""
NO_FAULT = "none"
MOST_OVER_FLOOR = 1.5
"""Times the error of the same capture without the fault, within which a fault is harmless."""
LEAST_LEFT = 0.9
"""Share of the pixels of the capture without the fault that a harmless one decodes."""

Outcome = Literal["right", "harmless", "wrong", "HARMFUL", "LOST", "CRASH", "sound", "FALSE ALARM"]
OF_FAULTS: tuple[Outcome, ...] = ("right", "harmless", "wrong", "HARMFUL", "LOST", "CRASH")
OF_SOUND: tuple[Outcome, ...] = ("sound", "FALSE ALARM", "CRASH")
PASSED: tuple[Outcome, ...] = ("right", "harmless", "sound")
LEAST_NAMED, MOST_HARMFUL, MOST_ALARMS = 0.95, 0.01, 0.01
"""Share of faults that are named or harmless; of those that are neither noticed nor harmless; and
of sound captures with an alarm."""

Severity = Literal["bad", "warning", "note"]
_SEVERITIES: dict[str, Severity] = {"rejected": "bad", "doubtful": "warning", "note": "note"}
"""Of the findings of an examination; the worst first."""
_REFUSALS = {
    r"are saturated": "saturation",
    r"does not resolve": "blur",
    r"light from other surfaces": "indirect-light",
    r"outside the projector": "projector-size",
    r"which the projector spans": "fringe-period|projector-size",
    r"which a Gray cell spans": "gray-cell|fringe-period",
    r"Gray bits number": "fringe-period|gray-cell|projector-size",
    r"response is nonlinear": "gamma",
    r"modulation is": "dark",
    r"rows and between the frames": "flicker",
    r"light of the room": "room-light",
    r"brightness varies": "exposure-drift",
}
"""Causes that messages of refusals state in words."""


@dataclass(frozen=True)
class Named:
    """A finding: its cause, or the causes between which it leaves the choice, joined by "|"; the
    frames that it names (from 0, none for all); and its severity."""

    cause: str
    frames: tuple[int, ...]
    severity: Severity
    message: str = ""


def examine_capture(sequence: PatternSequence, stack: np.ndarray) -> list[Named]:
    """What the program finds in a capture (n, h, w): the worst first, else in its own order."""
    examination = examine_frames(sequence, stack)
    found = [
        Named(f.cause, f.frames, _SEVERITIES[f.severity], f.observation)
        for f in examination.findings
    ]
    if examination.rejected:
        return found
    try:
        phases = decode_frames("capture", sequence, stack)
        check_capture("capture", sequence, stack, phases, examination)
    except InputError as error:
        causes = (cause for words, cause in _REFUSALS.items() if re.search(words, str(error)))
        return [Named(next(causes, "unreadable"), (), "bad", str(error)), *found]
    exposure = check_capture_exposure(sequence, stack, phases)
    if exposure.verdict in ("bad", "warning"):
        cause = "saturation" if "saturated." in exposure.observation else "dark"
        severity: Severity = "bad" if exposure.verdict == "bad" else "warning"
        found.append(Named(cause, (), severity, exposure.observation))
    order = list(_SEVERITIES.values())
    return sorted(found, key=lambda named: order.index(named.severity))


def decode_coordinates(sequence: PatternSequence, stack: np.ndarray) -> dict[Axis, np.ndarray]:
    """The decoded coordinate (h, w) px of each axis, NaN where masked; empty where it is
    refused."""
    try:
        phases = decode_frames("capture", sequence, stack)
    except InputError:
        return {}
    return {axis: phase.coordinate for axis, phase in phases.items()}


@dataclass(frozen=True)
class CaptureCase:
    """One examined capture. ``expected``: causes and frames that are right; ``errors`` of a fault
    that was not named, and ``quality``, in words."""

    fault: str
    kind: CaptureKind
    seed: int
    outcome: Outcome
    expected: str
    named: tuple[Named, ...]
    errors: str
    quality: str
    seconds: float

    def text(self) -> str:
        """The case in one line; `examine_case` of its fault, kind and seed repeats it."""
        named = ", ".join(_name_finding(n) for n in self.named) or "nothing"
        return (
            f"{self.outcome}: {self.fault}, {self.kind}, seed {self.seed}: named {named}, expected"
            f" {self.expected}{self.errors and ': '}{self.errors} ({self.quality})"
        )


def _name_finding(named: Named) -> str:
    """A finding in few words, frames counted from 0."""
    frames = " " + "+".join(map(str, named.frames)) if named.frames else ""
    note = " (note)" if named.severity == "note" else ""
    return f"{named.cause}{frames}{note}"


def prove_captures(scale: float, seed: int, progress: Progress) -> Proof:
    """Examine sound captures, and captures with every fault of every kind, and count the outcomes.

    ``scale``: share of the captures of a full run.
    """
    plan = list(plan_cases(scale, seed))
    cases: list[CaptureCase] = []
    for i, (fault, kind, each) in enumerate(plan):
        progress(i / len(plan), f"{fault}, {kind}")
        cases.append(examine_case(fault, kind, each))
    return summarize_cases(cases, scale)


def plan_cases(scale: float, seed: int) -> Iterator[tuple[str, CaptureKind, int]]:
    """Yield (fault, kind, seed) of each capture; see `prove_captures`."""
    for number, fault in enumerate((NO_FAULT, *CAPTURE_FAULTS)):
        kinds = KINDS if fault == NO_FAULT else CAPTURE_FAULTS[fault].kinds
        full = SOUND if fault == NO_FAULT else REPEATS * len(kinds)
        for i in range(max(1, round(scale * full))):
            # a part of the kinds, another one for each fault
            kind = kinds[(i + number) % len(kinds)]
            yield fault, kind, 1000 * seed + i // len(kinds)


def prove_pipelines(scale: float, seed: int, progress: Progress) -> Proof:
    """Examine sound captures and faults, a kind each in turn, through every pipeline of ordinary
    cameras. ``scale``: share of the captures of a full run."""
    plan = [
        (f"{pipeline}: {fault}, {kind}", (fault, kind, each, pipeline))
        for number, pipeline in enumerate(PIPELINES)
        for fault, kind, each in plan_cases(scale / len(PIPELINES), 100 * seed + number)
    ]
    cases: dict[str, list[CaptureCase]] = {name: [] for name in PIPELINES}
    judged = judge_all(examine_case, plan, progress)
    for (_, (*_, pipeline)), case in zip(plan, judged, strict=True):
        cases[pipeline].append(case)
    every = summarize_cases([case for own in cases.values() for case in own], scale)
    rows = [_list_pipeline(name, own) for name, own in cases.items()]
    return replace(every, rows=rows, record={"pipelines": rows, **every.record})


def _list_pipeline(name: str, cases: Sequence[CaptureCase]) -> Row:
    """The row of a pipeline: how often each outcome was seen."""
    faulty = [case for case in cases if case.fault != NO_FAULT]
    counts = Counter(case.outcome for case in cases)
    row: Row = {"pipeline": name}
    row |= {outcome: counts[outcome] for outcome in (*OF_SOUND[:2], *OF_FAULTS)}
    row["right %"] = 100 * sum(case.outcome in PASSED for case in faulty) / max(len(faulty), 1)
    return row


def examine_case(fault: str, kind: CaptureKind, seed: int, pipeline: str = "") -> CaptureCase:
    """Render one capture, sound where ``fault`` is "none", examine it, and judge the result."""
    if fault == NO_FAULT:
        setup = draw_setup(kind, seed, pipeline)
        faulty = FaultyCapture(setup, setup, frozenset())
    else:
        faulty = draw_faulty(fault, kind, seed, pipeline)
    setup = faulty.setup
    capture = render_capture(setup)
    start = perf_counter()
    try:
        named = examine_capture(setup.described, capture.stack)
        outcome = judge_findings(named, faulty)
    except Exception as error:  # the other cases still have to run
        named, outcome = [Named(f"{type(error).__name__}: {error}", (), "bad")], "CRASH"
    seconds, errors = perf_counter() - start, ""
    frames = " of frame " + " or ".join(map(str, faulty.frames)) if faulty.frames else ""
    expected = (" or ".join(sorted(faulty.causes)) or "nothing") + frames
    if outcome is None:
        outcome, errors = judge_errors(faulty, capture)
    return CaptureCase(
        fault, kind, seed, outcome, expected, tuple(named), errors, setup.text(), seconds
    )


def judge_findings(named: Sequence[Named], faulty: FaultyCapture) -> Outcome | None:
    """The outcome of a capture, of a fault without findings None: it depends on the errors.

    Findings of what is true of the capture without the fault do not count, and notes only where
    they are right.
    """
    tolerated = faulty.sound.tolerated - faulty.causes
    counted = [n for n in named if n.cause not in tolerated]
    serious = [n for n in counted if n.severity != "note"]
    if not faulty.causes:
        return "FALSE ALARM" if serious else "sound"
    if serious:
        return "right" if _is_right(serious[0], faulty) else "wrong"
    return "right" if any(_is_right(n, faulty) for n in counted) else None


def _is_right(named: Named, faulty: FaultyCapture) -> bool:
    """Whether a finding names the cause, and the frame of a fault of one frame."""
    is_frame_right = not faulty.frames or bool(set(named.frames) & set(faulty.frames))
    return is_frame_right and not faulty.causes.isdisjoint(named.cause.split("|"))


def judge_errors(faulty: FaultyCapture, capture: SimulatedCapture) -> tuple[Outcome, str]:
    """The outcome of a fault that is not named, by its errors and those without the fault, and both
    in words."""
    sound = render_capture(faulty.sound)
    floor = _list_errors(decode_coordinates(faulty.sound.described, sound.stack), sound.truth)
    errors = _list_errors(decode_coordinates(faulty.setup.described, capture.stack), capture.truth)
    texts = [_describe_errors(axis, errors.get(axis, np.empty(0)), floor[axis]) for axis in floor]
    return judge_coordinates(errors, floor), "; ".join(texts)


def _describe_errors(axis: Axis, errors: np.ndarray, floor: np.ndarray) -> str:
    """The errors of an axis in words, with those without the fault."""
    both = [np.quantile(e, [0.5, 0.95]) if len(e) else [np.nan] * 2 for e in (errors, floor)]
    (median, most), (least, least_most) = both
    share = 100 * len(errors) / max(len(floor), 1)
    return (
        f"{axis}: {median:.3g} px in the median and {most:.3g} in 95 %, not {least:.3g} and"
        f" {least_most:.3g}, of {share:.0f} % of the pixels"
    )


def judge_coordinates(
    errors: Mapping[Axis, np.ndarray], floor: Mapping[Axis, np.ndarray]
) -> Outcome:
    """The outcome by the absolute errors px of the decoded pixels of each axis; ``floor``: those
    without the fault."""
    for axis, least in floor.items():
        found = errors.get(axis, np.empty(0))
        if len(found) < LEAST_LEFT * len(least):
            # what is left may be wrong as well
            is_worse = len(found) and _exceeds(found, least)
            return "HARMFUL" if is_worse else "LOST"
        if _exceeds(found, least):
            return "HARMFUL"
    return "harmless"


def _exceeds(errors: np.ndarray, floor: np.ndarray) -> bool:
    """Whether the median or the 95th percentile exceeds `MOST_OVER_FLOOR` times the floor's."""
    found, least = (np.quantile(each, [0.5, 0.95]) for each in (errors, floor))
    return bool((found > MOST_OVER_FLOOR * least).any())


def _list_errors(
    decoded: Mapping[Axis, np.ndarray], truth: Mapping[Axis, np.ndarray]
) -> dict[Axis, np.ndarray]:
    """Absolute errors px of each axis, of the pixels that are decoded and whose truth is known."""
    errors = {axis: np.abs(decoded[axis] - truth[axis]) for axis in decoded}
    return {axis: each[np.isfinite(each)] for axis, each in errors.items()}


def summarize_cases(cases: Sequence[CaptureCase], scale: float) -> Proof:
    """The table of outcomes by fault and kind, the shares that must lie within bounds, and the
    cases that failed."""
    faulty = [case for case in cases if case.fault != NO_FAULT]
    sound = [case for case in cases if case.fault == NO_FAULT]
    rows = [
        _list_row(fault, [c for c in cases if c.fault == fault])
        for fault in dict.fromkeys(c.fault for c in cases)
    ]
    passed = sum(case.outcome in PASSED for case in faulty) / len(faulty)
    harmful = sum(case.outcome in ("HARMFUL", "LOST", "CRASH") for case in faulty) / len(faulty)
    alarms = sum(case.outcome != "sound" for case in sound) / len(sound)
    checks = [
        BandCheck("faults", "share that is named or harmless", passed, LEAST_NAMED, 1.0),
        BandCheck("faults", "share that is harmful", harmful, 0.0, MOST_HARMFUL),
        BandCheck("sound", "share with an alarm", alarms, 0.0, MOST_ALARMS),
    ]
    lines = list(_list_totals(faulty, sound))
    lines += [case.text() for case in cases if case.outcome not in PASSED]
    return prove_checks(checks, scale, rows, {"cases": cases}, below=lines)


def _list_row(fault: str, cases: Sequence[CaptureCase]) -> Row:
    """The row of a fault: outcomes of each kind as counts and initials, then totals."""
    outcomes = OF_SOUND if fault == NO_FAULT else OF_FAULTS
    row: Row = {"fault": fault}
    for kind in KINDS:
        own = Counter(case.outcome for case in cases if case.kind == kind)
        row[kind] = " ".join(f"{own[o]} {o}" for o in outcomes if own[o]) or "-"
    row["right %"] = 100 * sum(case.outcome in PASSED for case in cases) / len(cases)
    row["harmful"] = sum(case.outcome in ("HARMFUL", "LOST") for case in cases)
    row["s"] = float(np.mean([case.seconds for case in cases]))
    return row


def _list_totals(faulty: Sequence[CaptureCase], sound: Sequence[CaptureCase]) -> Iterator[str]:
    """Yield the totals of all faults and of all sound captures in words."""
    for name, cases, outcomes in (("faults", faulty, OF_FAULTS), ("sound", sound, OF_SOUND)):
        total = Counter(case.outcome for case in cases)
        counts = ", ".join(f"{total[o]} {o}" for o in outcomes)
        passed = 100 * sum(case.outcome in PASSED for case in cases) / len(cases)
        seconds = np.quantile([case.seconds for case in cases], [0.5, 0.95])
        yield (
            f"{len(cases)} {name}: {counts}; {passed:.1f} % right; {seconds[0]:.2f} s to examine in"
            f" the median, {seconds[1]:.2f} s in 95 %"
        )
    alarms = Counter(
        next((n.cause for n in case.named if n.severity != "note"), "none")
        for case in sound
        if case.outcome == "FALSE ALARM"
    )
    if alarms:
        yield "false alarms: " + ", ".join(f"{n} {cause}" for cause, n in alarms.most_common())
