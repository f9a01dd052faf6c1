"""What was measured on scans: points, distances, fitted shapes, their relations, deviations from
nominal models; and a measured number with its unit and uncertainty."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import msgspec
import numpy as np

from slviewer.errors import InputError
from slviewer.records.acceptance import COVERAGE, MARKS, Decision
from slviewer.records.record import (
    Cell,
    Column,
    Count,
    Matrix4,
    Meta,
    Record,
    Table,
    Vector,
    from_plain,
)

Unit = Literal["mm", "deg", "mm²", "%", ""]


@dataclass(frozen=True)
class Quantity:
    """A measured value. ``sigma``: its standard uncertainty (k = 1) in ``unit``, None where it has
    none (a residual, a count); ``U``: the expanded one (k = 2). ``whole``: whether they hold the
    calibration's part, which only the splined model knows; without it they are too small."""

    name: str
    value: float
    unit: Unit
    sigma: float | None = None
    whole: bool = True

    @property
    def U(self) -> float | None:
        """Expanded uncertainty, k = 2, in the quantity's unit."""
        return None if self.sigma is None else COVERAGE * self.sigma

    def format(self) -> str:
        """Return value ± U (k = 2) with the unit; a star where the calibration's part of U is
        unknown."""
        digits = 1 if self.unit == "%" else _count_decimals([self])
        unit = {"deg": "°", "%": " %", "": ""}.get(self.unit, f" {self.unit}")
        # no minus before nothing
        value = f"{round(self.value, digits) + 0.0:.{digits}f}".replace("-", "−")
        U = "" if self.U is None else f" ± {self.U:.{digits}f}"
        return f"{value}{U}{unit}{'*' if U and not self.whole else ''}"


def _count_decimals(quantities: Sequence[Quantity]) -> int:
    """Return the decimals that show two digits of each U; 3 to 6."""
    least = min((q.U for q in quantities if q.U), default=1.0)
    return int(np.clip(1 - np.floor(np.log10(least)), 3, 6))


What = Literal[
    "point", "distance", "section", "plane", "sphere", "cylinder", "relation", "deviation"
]
LEAST_AREA = 90.0
"""Percent of the area that the views can see which a verdict needs."""
DECIDED: dict[Decision, str] = {"pass": "pass", "fail": "fail", "undecided": "too close to tell"}
RULE = (
    "decided with a guard band as in ISO 14253-1 on local means of the deviations: pass if all of"
    " them and their expanded uncertainty (k = 2) together stay within the tolerance, fail if one"
    " exceeds it by more than the uncertainty, else too close to tell"
)
_UNCERTAINTY = "U is the expanded uncertainty: the scatter of the points, and the calibration's."
_SCATTER = (
    "U is the expanded uncertainty of the scatter of the points alone: the calibration's part is"
    " unknown."
)
_NO_UNCERTAINTY = "–: a residual or a plain reading, which has no U."


class MeasuredFeature(msgspec.Struct, frozen=True):
    """A picked point or a fitted shape, as `inspection.features.Feature`, and the covariance
    ``scatter`` of its own of its parameters; the part that fits of one ``calibration`` share is the
    array ``shared``."""

    kind: Literal["point", "plane", "sphere", "cylinder"]
    place: Vector
    direction: Vector | None = None
    radius: float | None = None
    scatter: tuple[tuple[float, ...], ...] = ()
    calibration: str = ""


class MeasuredRegion(msgspec.Struct, frozen=True):
    """The region that a shape was fitted to, as `inspection.regions.Region`."""

    kind: Literal["ball", "box"]
    centre: Vector
    size: tuple[float, ...]
    axes: tuple[Vector, Vector, Vector] | None = None

    def to_settings(self) -> dict[str, Any]:
        """Return the settings of `measure` that choose this region."""
        if self.kind == "ball":
            return {"ball": [*self.centre, *self.size]}
        size, axes = np.array(self.size), np.eye(3) if self.axes is None else np.array(self.axes)
        middle = axes @ np.array(self.centre)
        box = {"box": [*(middle - size).tolist(), *(middle + size).tolist()]}
        return box if self.axes is None else {**box, "axes": axes.tolist()}


class SectionPlane(msgspec.Struct, frozen=True):
    """The plane of a section, as `inspection.section.CutPlane`."""

    origin: Vector
    along: Vector
    up: Vector


class NominalModel(msgspec.Struct, frozen=True):
    """A nominal model: its file's name and content, the ``units`` of the file, and ``notes`` on
    repairs."""

    name: str
    hash: str
    units: str = "mm"
    triangles: Count = 0
    size_mm: Vector | None = None
    closed: bool | None = None
    notes: tuple[str, ...] = ()


class DeviationStatistics(msgspec.Struct, frozen=True):
    """Of the points that belong to the nominal, mm: ``within_95``: 95 % are off by less; 99.7 % lie
    between ``p_low`` and ``p_high``."""

    mean: float
    rms: float
    sigma: float
    within_95: float
    lowest: float
    highest: float
    p_low: float
    p_high: float
    points: Count
    left_out: Count


Exclusion = Literal["alone", "table", "beside", "touching", "border"]
"""Why points of a scan are excluded from the part: spikes; a plane that the part stands on;
something beside its footprint that does not touch it, or does; points at the border of these."""
EXCLUSIONS: dict[Exclusion, str] = {
    "alone": "isolated points",
    "table": "a plane beside the part, as a table",
    "beside": "something beside the part",
    "touching": "something beside the part that touches it",
    "border": "points on the border of these",
}
PlaceKind = Literal["high", "low", "excess", "missing"]
PLACE_KINDS: dict[PlaceKind, str] = {
    "high": "too high",
    "low": "too low",
    "excess": "material where the model has none",
    "missing": "material of the model is missing",
}


class ExcludedPoints(msgspec.Struct, frozen=True):
    """Points of a scan that are excluded from the part: why, how many, and where: their middle in
    the nominal's frame and their extent, mm."""

    reason: Exclusion
    points: Count
    place: Vector
    across_mm: float = 0.0

    def text(self) -> str:
        """Return reason, size and place in words."""
        where = ", ".join(f"{x:.1f}" for x in self.place)
        extent = f", {self.across_mm:.3g} mm across at ({where})" if self.across_mm else ""
        return f"{EXCLUSIONS[self.reason]} ({self.points:,}{extent})"


class DeviatingPlace(msgspec.Struct, frozen=True):
    """A connected area out of tolerance: its worst ``place`` in the nominal's frame, the deviation
    ``value_mm`` there, positive outside, with its expanded uncertainty (k = 2), and its extent."""

    kind: PlaceKind
    place: Vector
    value_mm: float
    U_mm: float
    across_mm: float
    points: Count


@dataclass(frozen=True)
class ToleranceVerdict:
    """Deviations against plus and minus a tolerance, mm.

    ``lowest`` and ``highest``: the least and the largest local mean of the deviations, each with
    its decision. Percent of the points that lie ``within`` the tolerance, ``inside`` it by more
    than U, ``outside`` it by more than U, and too ``close`` to tell. ``U_mm``: expanded uncertainty
    (k = 2) of a local mean, in the median. ``area``: percent of the area that the views can see
    which was measured; below ``least_area``, and where the largest unmeasured spot is larger than
    ``most_gap_mm``, nothing passes. ``places``: where the tolerance is exceeded, the worst first.
    ``spot_mm``: diameter of the smallest spot whose error is seen, and ``gap_mm`` of the largest
    that was not measured, at ``gap_place`` in the nominal's frame. ``reason``: why the scan does
    not show this part; ``doubts``: what else keeps it from passing.
    """

    tolerance_mm: float
    U_mm: float
    lowest: tuple[float, Decision]
    highest: tuple[float, Decision]
    decision: Decision
    within: float
    inside: float
    outside: float
    close: float
    area: float | None = None
    least_area: float = 0.0
    places: tuple[DeviatingPlace, ...] = ()
    spot_mm: float | None = None
    gap_mm: float | None = None
    gap_place: Vector | None = None
    reason: str = ""
    doubts: tuple[str, ...] = ()

    def text(self) -> str:
        """Return the decision in words."""
        decided = DECIDED[self.decision]
        if self.decision == "fail" and self.reason:
            decided = f"fail: {self.reason}"
        elif self.decision == "fail" and self.places:
            decided = f"fail: {_describe_place(self.places[0])}"
            if more := len(self.places) - 1:
                decided += f", and {more} more place{'s' if more > 1 else ''}"
        elif self.decision == "undecided" and self.doubts:
            decided = f"undecided: {'; '.join(self.doubts)}"
        return f"Tolerance ± {self.tolerance_mm:g} mm: {decided}"

    def of_other_part(self, reason: str) -> "ToleranceVerdict":
        """Return the verdict that the scan shows another part; this one without a ``reason``."""
        return replace(self, decision="fail", reason=reason) if reason else self

    def describe_evidence(self) -> str:
        """Return what the decision rests on in a sentence; empty for an old one."""
        if self.area is None or self.spot_mm is None:
            return ""
        gap = (
            f"; the largest spot that was not measured is {self.gap_mm:.2g} mm across, at"
            f" {_format_place(self.gap_place)}"
            if self.gap_mm and self.gap_place
            else ""
        )
        return (
            f"{self.area:.1f} % of the area that the views can see was measured, where an error"
            f" beyond the tolerance over a spot of {self.spot_mm:.2g} mm is seen{gap}."
        )


def _format_place(place: Vector) -> str:
    """Return a place in the nominal's frame in words."""
    return f"x y z {' '.join(f'{x:.1f}' for x in place)} mm of the model"


def _describe_place(each: DeviatingPlace) -> str:
    """Return what is wrong at a place in words."""
    value = f"{each.value_mm:+.3f}".replace("-", "−")
    return f"{value} ± {each.U_mm:.3f} mm, {PLACE_KINDS[each.kind]}, at {_format_place(each.place)}"


class NominalDeviation(msgspec.Struct, frozen=True):
    """Signed distances of a scan from a nominal model after the best fit, positive outside it.

    ``noise_mm``: RMS of the scan's noise alone along the nominal's normals; ``reach_mm``: points
    nearer count in the best fit; ``excluded``: those that are not the part; ``coverage``: share of
    the nominal's area that was measured; ``alignment_mm``: standard uncertainty that the best fit
    adds to a point.
    """

    nominal: NominalModel
    statistics_mm: DeviationStatistics
    noise_mm: float | None
    reach_mm: float
    coverage: float
    alignment_mm: float
    T_nominal_scan: Matrix4
    verdict: ToleranceVerdict | None = None
    excluded: tuple[ExcludedPoints, ...] = ()

    @property
    def tolerance_mm(self) -> float | None:
        """The tolerance, mm; None without one."""
        return None if self.verdict is None else self.verdict.tolerance_mm

    def quantities(self) -> list[Quantity]:
        """Return the most important figures."""
        numbers, verdict = self.statistics_mm, self.verdict
        listed = [
            Quantity("mean", numbers.mean, "mm"),
            Quantity("RMS", numbers.rms, "mm"),
            Quantity("95 % off by less than", numbers.within_95, "mm"),
            Quantity("range of 99.7 %, lower end", numbers.p_low, "mm"),
            Quantity("range of 99.7 %, upper end", numbers.p_high, "mm"),
            Quantity("area measured", 100 * self.coverage, "%"),
        ]
        return (
            listed
            if verdict is None
            else [*listed, Quantity("within tolerance", verdict.within, "%")]
        )

    def table(self, name: str, source: str, warnings: Sequence[str] = ()) -> Table:
        """Return all figures, with the decision for each end of the range where there is a
        tolerance."""
        numbers, verdict, nominal = self.statistics_mm, self.verdict, self.nominal
        figures = [
            *self.quantities(),
            Quantity("lowest", numbers.lowest, "mm"),
            Quantity("highest", numbers.highest, "mm"),
        ]
        if self.noise_mm is not None:
            figures.append(Quantity("RMS of the scan's noise alone", self.noise_mm, "mm"))
        decisions: dict[str, Cell] = {}
        if verdict is not None:
            for name_of_end, (value, decision) in (
                ("least local mean", verdict.lowest),
                ("largest local mean", verdict.highest),
            ):
                decisions[name_of_end] = Cell(DECIDED[decision], MARKS[decision])
                figures.append(Quantity(name_of_end, value, "mm"))
            figures += [
                Quantity("inside by more than U", verdict.inside, "%"),
                Quantity("too close to tell", verdict.close, "%"),
                Quantity("outside by more than U", verdict.outside, "%"),
                Quantity("U of a local mean, k = 2", verdict.U_mm, "mm"),
            ]
            if verdict.area is not None:
                figures.append(Quantity("visible area measured", verdict.area, "%"))
        rows = [
            {
                "quantity": each.name,
                Column("value", digits=4): each.value,
                "unit": each.unit,
                "decision": decisions.get(each.name, ""),
            }
            for each in figures
        ]
        share = 100 * numbers.left_out / max(numbers.points + numbers.left_out, 1)
        size = (
            ""
            if nominal.size_mm is None
            else f", {' x '.join(f'{side:.1f}' for side in nominal.size_mm)} mm"
        )
        triangles = f": {nominal.triangles:,} triangles" if nominal.triangles else ""
        notes = [
            f"{source} against {nominal.name}{triangles}{size}.",
            *(f"{nominal.name}: {note}." for note in nominal.notes),
            (
                f"{numbers.points:,} points; {numbers.left_out:,} ({share:.1f} %) are excluded:"
                f" {self._describe_excluded()}. The best fit adds {self.alignment_mm:.4f} mm"
                " (1 sigma)."
            ),
            *(f"{warning}." for warning in warnings),
            *([] if verdict is None else [f"{verdict.text()}. It is {RULE}."]),
            *([] if verdict is None else filter(None, [verdict.describe_evidence()])),
        ]
        return Table.of(rows, f"Deviation from nominal: {name}", notes).without_empty()

    def _describe_excluded(self) -> str:
        """Return what was excluded, in words."""
        if self.statistics_mm.left_out and not self.excluded:  # a record of an earlier version
            return f"they lie farther than {self.reach_mm:.3g} mm from it or face another way"
        return "; ".join(each.text() for each in self.excluded) or "none is excluded"

    def list_places(self, name: str) -> Table:
        """Return the table of the places out of tolerance."""
        rows = [
            {
                "what": PLACE_KINDS[each.kind],
                Column("deviation", "mm"): each.value_mm,
                Column("U (k=2)", "mm"): each.U_mm,
                Column("x", "mm", digits=1): each.place[0],
                Column("y", "mm", digits=1): each.place[1],
                Column("z", "mm", digits=1): each.place[2],
                Column("across", "mm", digits=1): each.across_mm,
                "points": each.points,
            }
            for each in (() if self.verdict is None else self.verdict.places)
        ]
        notes = ["Each at its worst place, in the frame of the model."]
        return Table.of(rows, f"Out of tolerance: {name}", notes)


class Measurement(Record, frozen=True, kw_only=True):
    """Points, distances, sections, fitted planes, spheres and cylinders, their relations, and
    deviations of scans from nominal models after the best fit, positive outside.

    ``source``: the scan, or the merge, that it was made on; ``of``: the measurements that it was
    made from; ``name``: what it was called when it was made; ``time``: ISO 8601, UTC. ``where``:
    region or features in words. Arrays: ``shared`` (k, p) of a feature; of a section ``lines`` (n,
    2) float32 mm, along and up, of ``lengths`` each; of a deviation ``points`` (n, 3) float32 mm
    with the nominal's ``normals`` and their ``signed`` distances, places ``uncovered`` (k, 3) mm
    that were not measured, ``counts`` of all points between ``edges`` mm.
    """

    kind = "measurements"
    title = "Measurements"
    prefix = "m"
    labels = "measurement names"
    what: What
    source: str
    model: str
    quantities: list[Quantity]
    name: str = ""
    time: str = ""
    of: tuple[str, ...] = ()
    where: str = ""
    feature: MeasuredFeature | None = None
    region: MeasuredRegion | None = None
    ends: tuple[Vector, Vector] | None = None
    plane: SectionPlane | None = None
    deviation: NominalDeviation | None = None
    warnings: tuple[str, ...] = ()

    @classmethod
    def upgrade(cls, meta: Meta) -> Meta:
        """Convert a measurement of version 0.2, whose figures were in its ``data``."""
        if "data" not in meta:
            return meta
        data, what = meta["data"], meta["kind"]
        fit, scale = data.get("fit", {}), data.get("scale")
        same = ("name", "source", "model", "time", "of", "inputs")
        new = {key: meta[key] for key in same if key in meta} | {
            "what": what,
            "operation": "measure",
        }
        new |= {key: data[key] for key in ("quantities", "ends", "plane", "region") if key in data}
        new |= {
            "warnings": fit.get("warnings", ()),
            "scales": {} if scale is None else {meta["model"]: scale},
        }
        new["where"] = data.get("where") or " and ".join(data.get("between", ()))
        if "feature" in (source := fit or data):
            new["feature"] = source["feature"] | {
                key: source[key] for key in ("scatter", "calibration")
            }
        settings: dict[str, Any] = {"scan": meta["source"], "what": what, "model": meta["model"]}
        if what == "relation":
            new["operation"], settings = "relate", dict(zip("ab", meta["of"], strict=True))
        elif what == "deviation":
            new |= {"operation": "compare", "deviation": data}
            settings = _settings_of_comparison(meta)
        elif "region" in data:
            settings |= from_plain(data["region"], MeasuredRegion).to_settings()
        else:
            settings["at"] = np.ravel(data.get("at", ())).tolist()
        return {**new, "settings": settings}

    def label(self, name: str) -> str:
        """Return the name that it was given when it was made, or its kind and number."""
        return self.name or f"{self.what} {name.removeprefix(self.prefix)}"

    def places(self) -> list[Any]:
        """Return the places that it was measured at: pixels (u, v) of a scan, numbers of points of
        a merge; empty for others."""
        at = self.settings.get("at", ())
        ends = 1 if self.what == "point" else 2
        return list(at) if len(at) == ends else list(zip(at[::2], at[1::2], strict=False))

    def __getitem__(self, name: str) -> Quantity:
        """Return the quantity of that name, such as "diameter". Raises InputError for others."""
        for quantity in self.quantities:
            if quantity.name == name:
                return quantity
        raise InputError(
            f"there is no {name!r}",
            f"the quantities are {', '.join(each.name for each in self.quantities)}",
        )

    @property
    def is_good(self) -> bool:
        """Whether no tolerance is exceeded, nor may be."""
        return (
            self.deviation is None
            or self.deviation.verdict is None
            or self.deviation.verdict.decision == "pass"
        )

    @property
    def failure(self) -> str:
        """Why `compare` ends with status 1: the verdict, where it is not a pass."""
        verdict = None if self.deviation is None else self.deviation.verdict
        return "" if verdict is None or self.is_good else verdict.text()

    def summary(self) -> str:
        """Return kind, scan and quantities in one sentence."""
        known = [each for each in self.quantities if each.U is not None]
        note = (
            "k = 2"
            if all(each.whole for each in known)
            else "k = 2; *: without the calibration's part"
        )
        listed = "; ".join(f"{each.name} {each.format()}" for each in self.quantities) + (
            f" ({note})" if known else ""
        )
        if self.deviation is None:
            return f"{self.what} on {self.source}: {listed}"
        verdict = self.deviation.verdict
        end = "" if verdict is None else f". {verdict.text()}"
        return f"deviation of {self.source} from {self.deviation.nominal.name}: {listed}{end}"

    def figures(self) -> dict[str, float]:
        """Return the values of the quantities, and their uncertainties."""
        values = {f"{each.name}, {each.unit}": each.value for each in self.quantities}
        return values | {
            f"U of {each.name}, {each.unit}": each.U
            for each in self.quantities
            if each.U is not None
        }

    @classmethod
    def tables(cls, found: Mapping[str, "Measurement"]) -> list[Table]:  # type: ignore[override]
        """Return a table with a line for each quantity, and one of each deviation from a nominal
        model."""
        measured = {name: each for name, each in found.items() if each.deviation is None}
        tables = [list_quantities(measured)] if measured else []
        for name, each in found.items():
            if (deviation := each.deviation) is not None:
                tables.append(deviation.table(name, each.source, each.warnings))
                if deviation.verdict is not None and deviation.verdict.places:
                    tables.append(deviation.list_places(name))
        return tables


def _settings_of_comparison(meta: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings of `compare` of a deviation that version 0.2 stored."""
    data, nominal = meta["data"], meta["data"]["nominal"]
    settings = {
        "scan": meta["source"],
        "nominal": f"nominal/{nominal['name']}",
        "units": nominal["units"],
        "reach": data["reach_mm"],
        "model": meta["model"],
        "content": nominal["hash"],
    }
    verdict = data.get("verdict")
    return settings if verdict is None else {**settings, "tolerance": verdict["tolerance_mm"]}


def list_quantities(found: Mapping[str, Measurement]) -> Table:
    """Return the table of all quantities of measurements."""
    digits = _count_decimals([q for each in found.values() for q in each.quantities])
    rows = [
        {
            "measurement": name,
            Column("type", detail=True): each.what,
            "scan": each.source,
            "quantity": q.name,
            Column("value", digits=digits): q.value,
            "unit": q.unit,
            Column("U (k=2)", digits=digits): q.U,
            Column("calibration in U", detail=True): (
                None if q.U is None else "yes" if q.whole else "no"
            ),
            Column("of", detail=True): "" if k else each.where,
        }
        for name, each in found.items()
        for k, q in enumerate(each.quantities)
    ]
    warnings = [f"{name}: {warning}." for name, each in found.items() for warning in each.warnings]
    return Table.of(rows, "Measured on the scans", [*_describe_uncertainty(found), *warnings])


def _describe_uncertainty(found: Mapping[str, Measurement]) -> list[str]:
    """Return what U of the measurements states, in sentences."""
    stated = {  # name: whether its U are whole
        name: all(q.whole for q in each.quantities if q.U is not None)
        for name, each in found.items()
        if any(q.U is not None for q in each.quantities)
    }
    sentences = []
    if stated:
        sentences.append(_UNCERTAINTY if any(stated.values()) else _SCATTER)
    if any(stated.values()) and not all(stated.values()):
        partial = ", ".join(name for name, whole in stated.items() if not whole)
        sentences.append(f"U of {partial} lacks the calibration's part, which is unknown.")
    if any(q.U is None for each in found.values() for q in each.quantities):
        sentences.append(_NO_UNCERTAINTY)
    return sentences
