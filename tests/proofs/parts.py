"""Whether verdicts on parts are true: no wrong part passes, no right part fails, and what is named
lies where the part is wrong."""

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from time import perf_counter
from typing import Literal, get_args

import numpy as np

from slviewer.errors import SlviewerError
from slviewer.evaluation.render import Row
from slviewer.geometry.rigid import Floats
from slviewer.inspection.deviation import Deviation, deviation
from slviewer.inspection.exclusion import NOISE
from slviewer.inspection.tolerance import judge_deviation
from slviewer.inspection.wrong_part import explain_misfit
from slviewer.pipeline.operation import Progress
from slviewer.records.measurement import DeviatingPlace
from slviewer.registration.refusal import WrongPart
from tests.proofs.drawn_parts import UnsuitedPartError
from tests.proofs.part_cases import (
    CaseSetup,
    PartCase,
    PlacedPart,
    make_case,
    plan_part_cases,
)
from tests.proofs.proof import BandCheck, Proof, judge_all, prove_checks

CASES = 1200
"""Of a full run."""
MAX_FALSE_FAILS, MAX_UNDECIDED, MIN_NAMED = 0.005, 0.02, 0.95
HIDING = ("table", "touching clamp")
"""Hide a side of the part, or cannot be told from it: undecided is right."""
FIGURELESS = ("mirrored", "scaled")
"""Faults of the whole part that their name describes, not a place."""

Verdict = Literal["pass", "fail", "undecided", "refused"]


@dataclass(frozen=True)
class Answer:
    """A verdict on a part; ``places`` that it names in the nominal's frame; ``message``: other
    reasons; ``T_nominal_scan`` (4, 4): the pose found, None without one."""

    verdict: Verdict
    places: tuple[DeviatingPlace, ...] = ()
    message: str = ""
    T_nominal_scan: Floats | None = None


def judge_scan(case: PartCase) -> Answer:
    """The program's verdict on a scan of a part."""
    try:
        result = deviation(
            case.points,
            case.nominal,
            normals=case.normals,
            sigma_mm=float(np.median(case.sigma_mm)),
            views=case.views,
        )
        verdict = judge_deviation(result, case.sigma_mm, case.tolerance_mm)
        if verdict.decision != "pass":
            verdict = verdict.of_other_part(_explain(case, result))
    except WrongPart as error:
        return Answer("fail", message=str(error))
    except SlviewerError as error:
        return Answer("refused", message=str(error))
    message = verdict.reason or "; ".join(verdict.doubts)
    return Answer(verdict.decision, verdict.places, message, result.T_nominal_scan)


def _explain(case: PartCase, result: Deviation) -> str:
    """What other part a scan shows, in words."""
    return explain_misfit(
        case.points[result.counted],
        case.normals[result.counted],
        case.nominal,
        result.T_nominal_scan,
        max(case.tolerance_mm, NOISE * result.noise_mm),
        case.views is not None,
    )


@dataclass(frozen=True)
class JudgedCase:
    """A case and the verdict on it, against the part as it is at the pose that was found.
    ``conforms``: a fault that the best fit spreads so that the part lies within the tolerance.
    ``is_place_right``, ``is_value_right``: of the first place of a true fail; None where there is
    none. ``seen``, ``evidence``, ``in_view`` as in `PartCase` and `PlacedPart`."""

    setup: CaseSetup
    verdict: Verdict
    conforms: bool
    in_view: bool
    seen: float
    evidence: int
    is_place_right: bool | None
    is_value_right: bool | None
    kinds: tuple[str, ...]
    message: str
    seconds: float

    @property
    def expected(self) -> Verdict:
        """The true verdict."""
        return self.setup.expected

    @property
    def outcome(self) -> str:
        """The verdict against the truth."""
        if self.expected == "fail" and self.verdict == "pass":
            if self.conforms:
                return "right"
            return "FALSE PASS" if self.in_view else "not in view"
        if self.expected == "pass" and self.setup.clutter == "touching clamp":
            return "right"  # what touches the part is its own until the operator excludes it
        if self.expected == "pass" and self.verdict == "fail":
            return "FALSE FAIL"
        if self.is_place_right is False:
            return "wrong place"
        if self.is_value_right is False:
            return "wrong value"
        return "right" if self.verdict == self.expected else self.verdict

    def text(self) -> str:
        """The case in one line, with the expression that repeats it."""
        shown = f"{100 * self.seen:.0f} % of the fault and {self.evidence} points of it seen"
        named = f"named {', '.join(self.kinds) or 'nothing'}"
        return f"{self.outcome}: judge_part_case({self.setup!r}): {shown}, {named}. {self.message}"


def judge_part_case(setup: CaseSetup) -> JudgedCase | None:
    """Make a case and judge it; None where no part suits its fault."""
    try:
        case = make_case(setup)
    except UnsuitedPartError:
        return None
    start = perf_counter()
    answer = judge_scan(case)
    seconds = perf_counter() - start
    T = case.T_nominal_scan if answer.T_nominal_scan is None else answer.T_nominal_scan
    part = case.placed_at(T)
    is_place_right = is_value_right = None
    is_true_fail = setup.expected == answer.verdict == "fail"
    if is_true_fail and setup.fault not in FIGURELESS:
        checked = [_check_place(part, place) for place in answer.places] or [(False, False)]
        is_place_right, is_value_right = checked[0]
        if setup.clutter == "touching clamp":  # itself a place, until the operator excludes it
            missed = (False, False) if part.in_view else (None, None)
            is_place_right, is_value_right = next((each for each in checked if each[0]), missed)
    return JudgedCase(
        setup,
        answer.verdict,
        part.conforms,
        part.in_view,
        case.seen,
        part.evidence,
        is_place_right,
        is_value_right,
        tuple(place.kind for place in answer.places),
        answer.message,
        seconds,
    )


def _check_place(part: PlacedPart, named: DeviatingPlace) -> tuple[bool, bool]:
    """Whether a part is out of tolerance at a named place, and by its value within its U."""
    near = part.deviations_near(np.array(named.place), np.sign(named.value_mm))
    if not len(near):
        return False, False
    off = near - named.value_mm
    return True, bool(off.min() <= named.U_mm and off.max() >= -named.U_mm)


def prove_parts(scale: float, seed: int, progress: Progress) -> Proof:
    """Judge scans of right and wrong parts, and count the verdicts.

    ``scale``: share of the cases of a full run.
    """
    setups = plan_part_cases(max(1, round(scale * CASES)), seed)
    named = [(f"{setup.kind}, {setup.fault}", (setup,)) for setup in setups]
    judged = judge_all(judge_part_case, named, progress)
    return summarize_parts([case for case in judged if case is not None], scale)


def summarize_parts(cases: Sequence[JudgedCase], scale: float) -> Proof:
    """The table of verdicts by fault and by size, and the shares that must lie within bounds."""
    right = [c for c in cases if c.expected == "pass"]
    wrong = [c for c in cases if c.expected == "fail"]
    full = [c for c in cases if c.setup.view == "full" and c.setup.clutter not in HIDING]
    full = [c for c in full if c.in_view or c.expected == "pass"]
    named = [c for c in wrong if c.is_place_right is not None]
    false_fails = _share(right, lambda c: c.outcome == "FALSE FAIL")
    open_cases = _share(full, lambda c: c.verdict in ("undecided", "refused"))
    places = _share(named, lambda c: bool(c.is_place_right))
    values = _share(named, lambda c: bool(c.is_value_right))
    checks = [
        BandCheck("wrong parts", "number of false passes", _count(wrong, "FALSE PASS"), 0, 0),
        BandCheck("right parts", "share of false fails", false_fails, 0, MAX_FALSE_FAILS),
        BandCheck("full views", "share without a decision", open_cases, 0, MAX_UNDECIDED),
        BandCheck("true fails", "share with a place in the fault", places, MIN_NAMED, 1),
        BandCheck("true fails", "share with a value within its U", values, MIN_NAMED, 1),
    ]
    rows = list(_list_rows(cases))
    seconds = np.quantile([c.seconds for c in cases], [0.5, 0.95])
    total = Counter(c.outcome for c in cases)
    lines = [
        f"{len(cases)} cases: " + ", ".join(f"{n} {name}" for name, n in total.most_common()),
        f"{seconds[0]:.2f} s to judge in the median, {seconds[1]:.2f} s in 95 %",
        *(c.text() for c in cases if c.outcome != "right"),
    ]
    record = {"cases": [asdict(c) | {"outcome": c.outcome} for c in cases]}
    return prove_checks(checks, scale, rows, record, below=lines)


def _count(cases: Sequence[JudgedCase], outcome: str) -> int:
    """Number of cases of an outcome."""
    return sum(c.outcome == outcome for c in cases)


def _share(cases: Sequence[JudgedCase], holds: Callable[[JudgedCase], bool]) -> float:
    """Share of the cases for which something holds; NaN without cases."""
    return sum(map(holds, cases)) / len(cases) if cases else float("nan")


def _list_rows(cases: Sequence[JudgedCase]) -> Iterator[Row]:
    """Yield the verdicts on right parts, then of each fault of wrong ones, then of each size."""
    right = [c for c in cases if c.expected == "pass"]
    wrong = [c for c in cases if c.expected == "fail"]
    groups = {"right parts": right, "wrong parts": wrong}
    for fault in sorted({c.setup.fault for c in cases}):
        groups[fault] = [c for c in (wrong if fault != "none" else right) if c.setup.fault == fault]
    for size in sorted({c.setup.size for c in cases}):
        groups[f"{size:g} tolerances"] = [c for c in cases if c.setup.size == size]
    for view in sorted({c.setup.view for c in cases}):
        groups[view] = [c for c in cases if c.setup.view == view]
    for name, own in groups.items():
        verdicts = Counter(c.verdict for c in own)
        yield {
            "cases": name,
            **{verdict: verdicts[verdict] for verdict in get_args(Verdict)},
            "false pass": _count(own, "FALSE PASS"),
            "false fail": _count(own, "FALSE FAIL"),
            "not in view": _count(own, "not in view"),
        }
