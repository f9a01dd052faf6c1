"""Parts that were measured and judged by an inspection plan."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import msgspec

from slviewer.records.acceptance import MARKS, Decision, worst_decision
from slviewer.records.record import Cell, Column, Count, Record, Row, Table, format_count

RULE = (
    "Decided with a guard band as in ISO 14253-1: pass where the value and its expanded uncertainty"
    " U (k = 2) stay within the limits, fail where the value is beyond one by more than U, else"
    " undecided."
)
Interval = tuple[float, float, float]
"""A figure, and the ends of its 95 % confidence interval."""


@dataclass(frozen=True)
class Characteristic:
    """What is measured and judged: its ``kind``, the names of its ``features`` (the second is the
    datum), ``nominal`` value and limits ``lower`` and ``upper`` in ``unit``, as absolute values, of
    which one or both may be absent.
    """

    name: str
    kind: str
    features: tuple[str, ...]
    nominal: float | None = None
    lower: float | None = None
    upper: float | None = None
    unit: str = "mm"

    def __post_init__(self) -> None:
        if self.lower is not None and self.upper is not None and not self.lower < self.upper:
            raise ValueError(
                f"the lower limit {self.lower:g} of {self.name} is not below the upper"
                f" {self.upper:g}"
            )
        if self.unit != ("deg" if self.kind == "angle" else "mm"):
            raise ValueError(f"a {self.kind} is not measured in {self.unit!r}")


class CharacteristicResult(msgspec.Struct, frozen=True):
    """A characteristic of one part: its ``value`` and ``U`` (k = 2), and the ``decision``; or the
    ``reason`` why it could not be measured, or why it is doubtful. ``whole``: whether U holds the
    calibration's part.

    The evidence: percent of the feature's area that was ``measured``, of what the views can see;
    percent of the points in its region that are ``excluded``, and as what; and the ``smallest``
    local defect, mm, that noise and spacing would have shown. Each None where it is not known."""

    name: str
    value: float | None
    U: float | None
    decision: Decision
    reason: str = ""
    whole: bool = True
    measured: float | None = None
    excluded: float | None = None
    excluded_as: str = ""
    smallest: float | None = None

    @property
    def evidence(self) -> str:
        """The evidence in words; empty where none is known."""
        listed = []
        if self.measured is not None:
            listed.append(f"{self.measured:.0f} % of the area measured")
        if self.excluded:
            listed.append(f"{self.excluded:.1f} % of the points excluded: {self.excluded_as}")
        if self.smallest is not None:
            listed.append(f"defects from {self.smallest:.2g} mm would show")
        return "; ".join(listed)


class PartResult(msgspec.Struct, frozen=True):
    """The characteristics of one part, in the plan's order. Its ``decision`` follows from them:
    "fail" where one fails, else "undecided" where one is, else "pass"."""

    part: str
    results: tuple[CharacteristicResult, ...]
    decision: Decision = "pass"

    def __post_init__(self) -> None:
        worst = worst_decision({each.decision for each in self.results})
        msgspec.structs.force_setattr(self, "decision", worst)


class Capability(msgspec.Struct, frozen=True):
    """Of ``parts`` values of this ``mean`` and standard deviation ``sigma``: ``cp`` (None for a
    single limit) and ``cpk``."""

    parts: Count
    mean: float
    sigma: float
    cp: Interval | None
    cpk: Interval


class Inspection(Record, frozen=True, kw_only=True):
    """Parts measured by an inspection plan, and judged by its limits.

    ``capability`` of each characteristic, from the parts on which it was measured; None for fewer
    than 3 parts, without a limit, or where the values do not vary. ``alignment``: how parts are
    aligned; without, places are in the camera's frame.
    """

    kind = "inspection"
    title = "Inspection"
    newest_first = True
    plan: str
    characteristic: tuple[Characteristic, ...]
    parts: tuple[PartResult, ...]
    capability: tuple[Capability | None, ...] = ()
    alignment: str = "none"

    def count_parts(self) -> dict[Decision, int]:
        """Return the number of parts of each decision."""
        counts = Counter(each.decision for each in self.parts)
        return {"pass": counts["pass"], "fail": counts["fail"], "undecided": counts["undecided"]}

    @property
    def failure(self) -> str:
        """Which parts do not pass; empty where all do."""
        listed = []
        for decision in ("fail", "undecided"):
            if names := [each.part for each in self.parts if each.decision == decision]:
                listed.append(f"{len(names)} {decision} ({', '.join(names)})")
        count = len(self.parts)
        return f"{', '.join(listed)} of {format_count(count, 'part')}" if listed else ""

    @property
    def is_good(self) -> bool:
        """Whether all parts pass."""
        return not self.failure

    def summary(self) -> str:
        """Return which parts do not pass in one sentence."""
        passed = "the part passes" if len(self.parts) == 1 else f"all {len(self.parts)} parts pass"
        return f"{self.plan}: {self.failure or passed}"

    def figures(self) -> dict[str, float]:
        """Return the values of each part."""
        return {
            f"{each.part} {wanted.name} {wanted.unit}": result.value
            for each in self.parts
            for wanted, result in zip(self.characteristic, each.results, strict=True)
            if result.value is not None
        }

    def list_tables(self, name: str) -> list[Table]:
        """Return the table of the parts by characteristic, and that of the capability."""
        return [self.list_results().without_empty(), *self._list_capability()]

    def list_results(self) -> Table:
        """Return the table of parts by characteristic."""
        rows = [
            {
                "part": each.part,
                "characteristic": wanted.name,
                Column("type", detail=True): wanted.kind,
                Column("value", digits=4): result.value,
                Column("U (k=2)", digits=4): result.U,
                "unit": wanted.unit,
                Column("nominal", digits=4, detail=True): wanted.nominal,
                Column("lower", digits=4, detail=True): wanted.lower,
                Column("upper", digits=4, detail=True): wanted.upper,
                "decision": Cell(result.decision, MARKS[result.decision]),
                Column("measured", "%", digits=0): result.measured,
                Column("excluded", "%", digits=1, detail=True): result.excluded,
                Column("excluded as", detail=True): result.excluded_as,
                Column("smallest defect", "mm", digits=4, detail=True): result.smallest,
                Column("reason", detail=True): result.reason,
            }
            for each in self.parts
            for wanted, result in zip(self.characteristic, each.results, strict=True)
        ]
        notes = [RULE]
        if not all(result.whole for each in self.parts for result in each.results):
            notes.append(
                "Some U hold no part of the calibration's uncertainty: the model does not"
                " predict it."
            )
        return Table.of(rows, f"Parts by {self.plan}", notes)

    def _list_capability(self) -> list[Table]:
        rows = [
            {
                "characteristic": wanted.name,
                "parts": each.parts,
                Column("mean", digits=4): each.mean,
                Column("std. dev.", digits=4): each.sigma,
                "unit": wanted.unit,
                **_list_ends("Cp", each.cp or (None,) * 3),
                **_list_ends("Cpk", each.cpk),
            }
            for wanted, each in zip(self.characteristic, self.capability, strict=False)
            if each is not None
        ]
        note = (
            "With 95 % confidence intervals; the spread of the values includes the measurement's."
            " Not for fewer than 3 parts, without a limit, or where values do not vary; Cp needs"
            " both limits."
        )
        return [Table.of(rows, f"Capability by {self.plan}", [note])] if rows else []


def _list_ends(index: str, values: Sequence[float | None]) -> Row:
    """Return a capability index and the ends of its interval by column."""
    titles = ("value", "from", "to")
    return {
        Column(title, digits=2, group=index, detail=title != "value"): value
        for title, value in zip(titles, values, strict=True)
    }
