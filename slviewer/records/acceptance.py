"""Tests of a calibration: with certified artefacts, against the operator's limits; by a later
capture of its board; and on target poses that it was not made from."""

from collections.abc import Collection, Iterable, Mapping
from math import hypot
from typing import Annotated, Any, Literal

import msgspec

from slviewer.records.record import (
    Cell,
    Column,
    Count,
    Mark,
    Meta,
    Record,
    Table,
    Vector,
    format_scale,
    format_signed,
    list_shares,
)

Decision = Literal["pass", "fail", "undecided"]
Interval = tuple[float, float]
COVERAGE = 2.0
RULE = (
    "Decided with a guard band as in ISO 14253-1: pass if error and expanded uncertainty (k = 2)"
    " together stay within the limit at every position, fail if the error exceeds it by more than"
    " the uncertainty at one, else undecided. The test follows the ideas of VDI/VDE 2634 part 2 and"
    " ISO 10360-13, and claims conformity with neither."
)
MARKS: Mapping[str, Mark] = {"pass": "better", "fail": "worse", "undecided": "strong"}


def worst_decision(decisions: Collection[Decision]) -> Decision:
    """Return "fail" where one fails, else "undecided" where one is, else "pass"."""
    return next((each for each in ("fail", "undecided") if each in decisions), "pass")


LEAST_SURFACE = 0.85
"""Share of the visible surface that a pass takes: a bar before a ball may cover a tenth of it."""
MAX_STRAYS = 0.02
"""Share of the points that a fit may exclude although they depart together by more than a
limit."""


class SurfaceEvidence(msgspec.Struct, frozen=True):
    """What the figures of a ball or a plane rest on: the share of its visible surface that was
    ``measured``, and that something before it ``covered``; the share of the measured points that
    the fit ``excluded``; the lowest and the highest deviation that neighbouring points share."""

    measured: float
    covered: float
    excluded: float
    lowest_mm: float
    highest_mm: float

    @property
    def range_mm(self) -> float:
        """The range of the deviations that neighbouring points share."""
        return self.highest_mm - self.lowest_mm

    def explain_gap(self, limit_mm: float) -> str:
        """Return why no pass within a limit follows from this; empty where one may."""
        if self.measured < LEAST_SURFACE:
            covered = f", {100 * self.covered:.0f} % is covered" if self.covered >= 0.01 else ""
            return (
                f"{100 * self.measured:.0f} % of the visible surface was measured{covered}, and a"
                f" pass takes {100 * LEAST_SURFACE:.0f} %"
            )
        if self.excluded > MAX_STRAYS and self.range_mm > limit_mm:
            return (
                f"{100 * self.excluded:.0f} % of the points were excluded, and depart by"
                f" {self.range_mm:.3f} mm together: part of the feature is missing or covered"
            )
        return ""


class PropertyError(msgspec.Struct, frozen=True):
    """The error of a property at one position, with the test's expanded uncertainty (k = 2), and
    where the error lies with 95 and 99.7 % probability; of form and flatness the ranges that hold
    as many points. ``smallest_mm``: the smallest error that would have been seen."""

    property: str
    position: str
    error_mm: float
    U_mm: float
    within_95_mm: Interval
    within_997_mm: Interval
    smallest_mm: float | None = None


class JudgedProperty(msgspec.Struct, frozen=True):
    """One property over all positions: the ``worst`` error, the limit, and the decision (None
    without a limit)."""

    property: str
    worst: PropertyError
    limit_mm: float | None
    decision: Decision | None


class PositionErrors(msgspec.Struct, frozen=True):
    """What was measured at one position: ``rms_mm`` and ``floor_mm`` of each ball or the plane, RMS
    of the points' deviations and what noise alone would leave; ``noise_mm``: standard uncertainty
    of a length by the cloud's noise alone; ``incidence``: percent in R1, R2, R3; ``warnings``: what
    was excluded; ``evidence`` and ``centres_mm`` of each ball, or the plane."""

    position: str
    capture: str
    figures: list[PropertyError]
    rms_mm: list[float]
    floor_mm: list[float | None]
    points: Count
    noise_mm: float = 0.0
    incidence: dict[str, float] | None = None
    warnings: list[str] = []
    evidence: list[SurfaceEvidence] = []
    centres_mm: list[Vector] = []

    def explain_gap(self, limit_mm: float) -> str:
        """Return why no pass follows from this position; empty where one may."""
        return next(filter(None, (each.explain_gap(limit_mm) for each in self.evidence)), "")

    @property
    def properties(self) -> set[str]:
        """Names of the properties that were measured here."""
        return {figure.property for figure in self.figures}

    def list_evidence(self) -> dict[Any, float | None]:
        """Return the least share measured, the greatest excluded, and the largest deviation that
        neighbours share, of all features, by column."""
        if not self.evidence:
            return {}
        return {
            Column("measured", "%", digits=0): 100 * min(each.measured for each in self.evidence),
            Column("covered", "%", digits=0): 100 * max(each.covered for each in self.evidence),
            Column("excluded", "%", digits=1): 100 * max(each.excluded for each in self.evidence),
            Column("shared deviation", "mm"): max(each.range_mm for each in self.evidence),
        }

    def error(self, name: str) -> PropertyError:
        """Return the worst figure of a property at this position."""
        return max((f for f in self.figures if f.property == name), key=lambda f: abs(f.error_mm))


class ScaleError(msgspec.Struct, frozen=True):
    """Relative error of the scale, positive where the instrument measures too long; ``u_ppm`` is
    its standard uncertainty.

    From the errors of one length at several positions: their mean, with the scatter between
    positions (widened for their number by Student's t) and what all of them share, the certificate
    and the temperature.
    """

    ppm: float
    u_ppm: float
    length_mm: float
    positions: Count

    @property
    def U_ppm(self) -> float:
        """Expanded uncertainty of the scale, k = 2."""
        return COVERAGE * self.u_ppm

    def within(self, k: float) -> Interval:
        """Return the interval of k standard uncertainties, ppm."""
        return self.ppm - k * self.u_ppm, self.ppm + k * self.u_ppm


class Contribution(msgspec.Struct, frozen=True):
    """One source of a length's uncertainty: its standard uncertainty, None where nothing is known
    of it. ``kind`` A: from repeated observations; B: from anything else."""

    source: str
    u_mm: float | None
    kind: str
    how: str


class ErrorBudget(msgspec.Struct, frozen=True):
    """The contributions to the uncertainty of a length, in the manner of the GUM."""

    length_mm: float
    contributions: list[Contribution]

    @property
    def U_mm(self) -> float:
        """Expanded uncertainty (k = 2) of all known contributions."""
        return COVERAGE * hypot(
            *(each.u_mm for each in self.contributions if each.u_mm is not None)
        )

    @property
    def unknown(self) -> list[str]:
        """Sources of unknown uncertainty, which U does not include."""
        return [each.source for each in self.contributions if each.u_mm is None]

    def table(self) -> Table:
        """Return the contributions, and the expanded uncertainty below."""
        uncertainty = Column("standard uncertainty", "mm", digits=4)
        rows = [
            {
                "source": each.source,
                uncertainty: each.u_mm,
                Column("type", align="centre"): each.kind,
                Column("from", detail=True): each.how,
            }
            for each in self.contributions
        ]
        without = f" Unknown: {' and '.join(self.unknown)}; U excludes it." if self.unknown else ""
        notes = [f"Type A: from repeated observations; B: from anything else.{without}"]
        caption = f"Uncertainty of a length of {self.length_mm:.0f} mm"
        footer = [{"source": "expanded, k = 2", uncertainty: self.U_mm}]
        return Table.of(rows, caption, notes, footer)


class StillCaptures(msgspec.Struct, frozen=True):
    """The spread of depth over captures of a still object: medians over the pixels, and what noise
    predicts; ``wandering_mm``: how far the mean depth moved."""

    captures: Count
    pixels: Count
    sigma_mm: float
    sigma_95_mm: float
    predicted_mm: float
    wandering_mm: float


class CertifiedArtefact(msgspec.Struct, frozen=True):
    """The artefact of a test, and its certificate."""

    name: str
    certificate: str
    kind: str = ""


class AcceptanceTest(Record, frozen=True, kw_only=True):
    """Artefacts with known lengths, measured in several places.

    ``lacks``: what the positions do not test; ``scale_factor``: the correction in force during the
    test, ``scale_applied`` the one that it put in force; ``time``: ISO 8601, UTC.
    """

    kind = "acceptance"
    title = "Acceptance"
    has_figures = False  # repeated, the test would find a scale that was corrected since
    is_history = True
    newest_first = True
    artefact: CertifiedArtefact
    model: str
    positions: list[PositionErrors]
    judgements: list[JudgedProperty]
    scale: ScaleError | None = None
    decision: Decision | None = None
    lacks: list[str] = []
    scale_factor: float = 1.0
    scale_applied: float | None = None
    budget: ErrorBudget | None = None
    repeatability: StillCaptures | None = None
    time: str = ""

    @classmethod
    def upgrade(cls, meta: Meta) -> Meta:
        """Convert a record of version 0.2, whose figures were one entry."""
        if not isinstance(old := meta.get("accepted"), dict):
            return meta
        return {**old, "time": meta.get("time", ""), "inputs": meta.get("inputs", {})}

    @property
    def is_good(self) -> bool:
        """Whether no property fails or is undecided, and nothing is left untested."""
        return self.decision in ("pass", None) and not self.lacks

    def summary(self) -> str:
        """Return artefact, decision and what is missing in one sentence."""
        missing = f"; incomplete: {'; '.join(self.lacks)}" if self.lacks else ""
        return (
            f"{self.artefact.name}, certificate {self.artefact.certificate}, measured by"
            f" {self.model} on {self.time[:10]}:"
            f" {(self.decision or 'not decided').upper()}{missing}"
        )

    def list_tables(self, name: str) -> list[Table]:
        """Return the properties, the positions, and the budget of a length."""
        rows = [
            {
                "property": each.property,
                Column("worst", "mm", digits=4): each.worst.error_mm,
                Column("at", detail=True): each.worst.position,
                Column("uncertainty U, k = 2", "mm", digits=4): each.worst.U_mm,
                Column("smallest error seen", "mm", digits=4): each.worst.smallest_mm,
                **{
                    Column(end, "mm", "95 % lie", digits=4, detail=True): mm
                    for end, mm in zip(("from", "to"), each.worst.within_95_mm, strict=True)
                },
                Column("limit", "mm"): each.limit_mm,
                "decision": Cell(each.decision or "no limit", MARKS.get(each.decision or "", "")),
            }
            for each in self.judgements
        ]
        caption = f"Test {name}: {self.artefact.name}"
        tables = [Table.of(rows, caption, self._list_notes()), self._list_positions()]
        return tables if self.budget is None else [*tables, self.budget.table()]

    def _list_positions(self) -> Table:
        shown = [each.property for each in self.judgements]
        rows = [
            {
                "position": each.position,
                **{
                    Column(name, "mm", digits=4): each.error(name).error_mm
                    if name in each.properties
                    else None
                    for name in shown
                },
                Column("RMS", "mm"): max(each.rms_mm),
                Column("noise floor", "mm"): max(
                    (mm for mm in each.floor_mm if mm is not None), default=None
                ),
                **list_shares(each.incidence),
                Column("points", detail=True): each.points,
                **each.list_evidence(),
            }
            for each in self.positions
        ]
        notes = [
            f"{each.position}: {warning}" for each in self.positions for warning in each.warnings
        ]
        caption = "The worst error of each property at each position"
        return Table.of(rows, caption, notes).without_empty()

    def _list_notes(self) -> list[str]:
        notes = [f"{self.summary()}.", f"{len(self.positions)} positions.", RULE]
        if self.scale is not None:
            scale = self.scale
            notes.append(
                f"Scale: {format_signed(scale.ppm, 'ppm')} ± {scale.U_ppm:.0f} ppm (k = 2) over"
                f" {scale.length_mm:.3f} mm."
            )
        if self.scale_applied is not None:
            notes.append(
                f"The scale was corrected by {format_scale(self.scale_applied)} from this test on."
            )
        elif self.scale_factor != 1:
            in_force = format_scale(self.scale_factor)
            notes.append(f"A scale correction of {in_force} was in force during the test.")
        if self.scale is not None and self.scale_applied is None:
            notes.append("The scale was not corrected: --apply-scale does so.")
        if (still := self.repeatability) is not None:
            notes.append(
                f"Repeatability over {still.captures} captures of a still object:"
                f" {still.sigma_mm:.4f} mm (median over {still.pixels:,} pixels; 95 % below"
                f" {still.sigma_95_mm:.4f}), {still.predicted_mm:.4f} mm expected from noise; the"
                f" mean depth drifted by {still.wandering_mm:.4f} mm. This is not a measure of"
                " accuracy."
            )
        return notes


DriftVerdict = Literal["still good", "recalibrate"]


class Drift(Record, frozen=True, kw_only=True):
    """One board against the saved calibration: whether the rig is still as it was.

    Sigmas are standard deviations. ``turn_mrad``, ``shift_mm``: estimated rotation about and
    translation along the projector's own axes. ``scale_ppm``: apparent growth of the board;
    ``across_px``: mean offset across the epipolar lines, None with one axis; ``misfit_px``: RMS
    that no movement explains. ``chance``: p-value of the change if nothing moved. ``seen_alone``:
    size in mrad and mm at which each rotation and translation would be detected with 95 %
    probability if it were the only change. ``unseen``: descriptions of changes that would not be
    detected. ``time``: ISO 8601, UTC.
    """

    kind = "drift"
    title = "Drift"
    is_history = True
    capture: str
    axes: tuple[Literal["x", "y"], ...]
    verdict: DriftVerdict
    reasons: tuple[str, ...]
    turn_mrad: Vector
    turn_sigma_mrad: Vector
    shift_mm: Vector
    shift_sigma_mm: Vector
    baseline_mm: float
    baseline_sigma_mm: float
    scale_ppm: float
    scale_sigma_ppm: float
    across_px: float | None
    across_sigma_px: float | None
    misfit_px: float
    chance: float
    seen_alone: tuple[float, float, float, float, float, float]
    unseen: tuple[str, ...]
    time: str = ""

    @classmethod
    def upgrade(cls, meta: Meta) -> Meta:
        """Convert a record of version 0.2, whose figures were one entry."""
        if not isinstance(old := meta.get("checked"), Mapping):
            return meta
        settings = {"capture": old.get("capture")}
        return {**old, "inputs": meta.get("inputs", {}), "operation": "check", "settings": settings}

    @property
    def is_good(self) -> bool:
        """Whether the calibration is still good."""
        return self.verdict == "still good"

    def summary(self) -> str:
        """Return the verdict and its reasons in one sentence."""
        because = f", because {'; '.join(self.reasons)}" if self.reasons else ""
        return f"{self.capture}: {self.verdict}{because}"

    def figures(self) -> dict[str, float]:
        """Return the apparent growth of the board, and what no movement explains."""
        return {"scale_ppm": self.scale_ppm, "misfit_px": self.misfit_px}

    @classmethod
    def tables(cls, found: Mapping[str, "Drift"]) -> list[Table]:  # type: ignore[override]
        """Return a table of the checks, the latest first, and one of what the latest found of each
        axis."""
        rows = [
            {
                "check": name,
                Column("time, UTC", detail=True): each.time[:16].replace("T", " "),
                "capture": each.capture,
                "answer": Cell(each.verdict, "better" if each.is_good else "worse"),
                Column("change of scale", "ppm", digits=0): each.scale_ppm,
                Column("±", "ppm", digits=0): each.scale_sigma_ppm,
                Column("epipolar error", "px", digits=4): each.across_px,
                Column("±", "px", digits=4, detail=True): each.across_sigma_px,
                Column("misfit", "px", detail=True): each.misfit_px,
            }
            for name, each in reversed(list(found.items()))
        ]
        *_, (name, latest) = found.items()
        return [
            Table.of(rows, "Drift checks, the latest first").without_empty(),
            latest._list_movements(name),
        ]

    def _list_movements(self, name: str) -> Table:
        rows = [
            {
                "axis of the projector": axis,
                Column("turn", "mrad"): self.turn_mrad[k],
                Column("±", "mrad"): self.turn_sigma_mrad[k],
                Column("shift", "µm", digits=0): 1e3 * self.shift_mm[k],
                Column("±", "µm", digits=0): 1e3 * self.shift_sigma_mm[k],
                Column("turn", "mrad", "detectable", digits=4, detail=True): self.seen_alone[k],
                Column("shift", "µm", "detectable", digits=1, detail=True): (
                    1e3 * self.seen_alone[3 + k]
                ),
            }
            for k, axis in enumerate("xyz")
        ]
        baseline = 1e3 * self.baseline_mm
        notes = [
            f"{self.summary()}.",
            f"Baseline {format_signed(baseline)} ± {1e3 * self.baseline_sigma_mm:.0f} µm.",
            (
                "A pan and a shift along x look nearly alike, as do a nod and a shift along y:"
                " their sum is known far better than each. Detectable: if it is the only change."
            ),
            *(f"Not detectable: {what}." for what in self.unseen),
        ]
        return Table.of(rows, f"Check {name}: how the projector has moved", notes)


class HeldOutError(msgspec.Struct, frozen=True):
    """Errors of one model on boards that were not used to fit it, RMS where they are of several
    poses.

    ``plane_mm``: RMS distance of the board's pixels from their plane. ``board_mm``: RMS distance of
    the features from the board laid over them, flatness, shape and scale included. ``scale_ppm``:
    how much too long the board's own spacings come out. ``camera_px``, ``projector_px``: what
    ``board_mm`` amounts to in the images, RMS.
    """

    plane_mm: float
    board_mm: float
    scale_ppm: float
    camera_px: float
    projector_px: float


class HeldOutPose(HeldOutError, frozen=True):
    """Errors of one model on one pose, from so many ``pixels``."""

    pixels: Count
    depth_mm: float


class ModelComparison(Record, frozen=True, kw_only=True):
    """Target poses, each measured by calibrations that were made without it, all over the same
    pixels.

    ``models``: errors over all poses, the simplest model first; ``poses``: {model: {pose: its
    errors}}; ``folds``: poses held out together; ``failed``: {model: why it could not be fitted to
    some fold}; ``recommended``: the model with the least error on boards, of nearly equal ones the
    simplest.
    """

    kind = "validation"
    title = "Comparison of models"
    has_figures = False  # repeated, each model is fitted to each fold, which takes minutes
    recommended: str
    models: Annotated[dict[str, HeldOutError], msgspec.Meta(min_length=1)]
    poses: dict[str, dict[str, HeldOutPose]]
    folds: tuple[tuple[str, ...], ...]
    failed: dict[str, str] = {}

    @classmethod
    def upgrade(cls, meta: Meta) -> Meta:
        """Convert a record of version 0.2, whose figures were one entry."""
        if not isinstance(old := meta.get("validation"), Mapping):
            return meta
        settings = {"models": list(old.get("models", {})), "folds": len(old.get("folds", ()))}
        inputs = meta.get("inputs", {})
        return {**old, "inputs": inputs, "operation": "validate", "settings": settings}

    def covers(self, models: Iterable[str]) -> bool:
        """Whether all of these models were compared."""
        return {*self.models, *self.failed}.issuperset(models)

    def summary(self) -> str:
        """Return the error of each model on boards, and the recommended model, in one sentence."""
        errors = ", ".join(f"{model} {each.board_mm:.3f} mm" for model, each in self.models.items())
        return f"held-out error of the models: {errors}; {self.recommended} is recommended"

    def list_tables(self, name: str) -> list[Table]:
        """Return a table of the errors with a line for each model; the least ones are marked."""
        columns = {
            "plane_mm": Column("plane", "mm", digits=4),
            "board_mm": Column("board", "mm", digits=4),
            "scale_ppm": Column("scale", "ppm", digits=0),
            "camera_px": Column("camera", "px"),
            "projector_px": Column("projector", "px"),
        }
        least = {
            figure: min(getattr(each, figure) for each in self.models.values())
            for figure in ("plane_mm", "board_mm", "camera_px")
            if len(self.models) > 1
        }
        rows = []
        for model, each in self.models.items():
            row: dict[Any, Cell] = {
                "model": Cell(model, "strong" if model == self.recommended else "")
            }
            for figure, column in columns.items():
                value = getattr(each, figure)
                row[column] = Cell(value, "better" if value == least.get(figure) else "")
            rows.append(row)
        count = len(next(iter(self.poses.values())))
        notes = [
            (
                f"{count} poses, each measured by calibrations without it ({len(self.folds)}"
                " folds). Plane: distance of the board's features from their plane; board: from"
                " their true positions."
            ),
            f"Recommended of these: {self.recommended}.",
            *(f"{model} could not be compared: {why}." for model, why in self.failed.items()),
        ]
        return [Table.of(rows, "RMS on held-out poses", notes)]
