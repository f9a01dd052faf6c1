"""A part in the coordinates of its inspection plan: the points of its features, what is measured of
them, on what evidence, and the decisions."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np

from slviewer.errors import InputError, SlviewerError
from slviewer.evaluation.fit import MAX_SIGMA
from slviewer.geometry.rigid import Floats, Uncertainty, move_points
from slviewer.geometry.robust import robust_sigma
from slviewer.geometry.vectors import unit_vectors
from slviewer.inspection.deviation import NominalArea
from slviewer.inspection.features import Feature, relation
from slviewer.inspection.fitting import (
    FeatureFit,
    datum_frame,
    datum_spread,
    face_towards,
    fit_feature,
)
from slviewer.inspection.form import (
    form_error,
    hidden_defect,
    orientation_error,
    position_error,
    profile_error,
    smallest_defect,
)
from slviewer.inspection.membership import find_isolated, percent_measured
from slviewer.inspection.nominal_surface import NominalSurface
from slviewer.inspection.tolerance import judge_limits
from slviewer.inspection.uncertainty import PointErrors
from slviewer.pipeline.compare import fit_to_nominal
from slviewer.pipeline.measure import MeasuredSurface
from slviewer.records.inspection import Characteristic, CharacteristicResult
from slviewer.records.measurement import Quantity
from slviewer.session.inspection_plan import FORMS, SIZES, TO_DATUM, Plan, PlanFeature
from slviewer.session.nominal import Nominal

LEAST_FILLED = 50.0
"""Percent of a feature's area in its region that a decision needs, where neither a nominal model
nor the plan tells how much of the region a whole part fills."""
STATE_FILLED = (
    "; if its region is larger than the feature, state in the plan what percent of it a whole part"
    " fills, as filled"
)
MAX_TURNED_DEG, MAX_OFF_RADIUS = 20.0, 0.4
"""From the plan's direction, and from its place or radius as a share of that: a feature farther off
is another."""
DATUM_ROUNDS = 4
"""Fits of the datums, each with the regions moved by the frame of the last."""


@dataclass(frozen=True, eq=False)
class SurfacePoints:
    """The points (n, 3) of a region of the nominal model, their deviations (n,) mm, and its normals
    (n, 3); percent of the region's points that are ``excluded``, and as what."""

    points: Floats
    deviations: Floats
    normals: Floats
    excluded: float
    excluded_as: str


@dataclass(frozen=True)
class PlanEvidence:
    """As the fields of `CharacteristicResult`."""

    measured: float | None
    excluded: float
    excluded_as: str
    smallest: float


class AlignedPart:
    """A scan's points in part coordinates, ``T_part_scan``; ``feature`` of a name fits that to
    them, once.

    ``spread``: what the alignment adds to the uncertainty of places; None without one. Raises
    InputError where the part cannot be aligned.
    """

    def __init__(self, plan: Plan, surface: MeasuredSurface, nominal: Nominal | None) -> None:
        self.features = {each.name: each for each in plan.feature}
        self._surface = surface
        self._scan_points = surface.points[surface.measured].astype(np.float64)
        self._nominal_surface: NominalSurface | None = None
        self._area: NominalArea | None = None
        self._counted = np.ones(len(self._scan_points), bool)
        self.T_part_scan: np.ndarray = np.eye(4)
        self.spread: Uncertainty | None = None
        if not len(self._scan_points):
            raise InputError(f"{surface.source} has no measured points", "scan the part again.")
        if nominal is not None:
            result = fit_to_nominal(surface, nominal)
            self._nominal_surface, self._area = result.surface, result.area
            self.T_part_scan, self.spread = result.T_nominal_scan, result.alignment_spread
            self._counted = result.counted
        if plan.alignment.kind == "3-2-1":
            self.T_part_scan = np.array(plan.alignment.start)
            self._align_datums(plan.alignment.datums)
        self.points = move_points(self.T_part_scan, self._scan_points)
        self.feature: Callable[[str], FeatureFit] = cache(self._fit)
        self.surface: Callable[[str], SurfacePoints] = cache(self._surface_points)
        self.percent_measured: Callable[[str], float | None] = cache(self._percent_measured)

    def profile(self, name: str) -> Quantity:
        """The profile of a region against the nominal model. Raises InputError without a model."""
        shown = self.surface(name)
        return profile_error(
            shown.points, shown.deviations, shown.normals, self.spread, self.errors.raised
        )

    def _surface_points(self, name: str) -> SurfacePoints:
        """The points of a region of the nominal model: at any distance, isolated ones excluded, all
        whose nearest place on it lies in the region."""
        if self._nominal_surface is None:
            raise InputError(
                "A profile needs the nominal model",
                "give its file as `nominal` of the plan's alignment.",
            )
        region = self.features[name].region
        inside = region.within(self.points)
        chosen = self._counted | inside
        points = self.points[chosen]
        away, towards = self._nominal_surface.signed(points)
        feet = points - np.where(np.isfinite(away), away, np.nan)[:, None] * towards
        own = region.within(feet)
        points, away, towards = points[own], away[own], towards[own]
        isolated = np.zeros(len(away), bool)
        if len(away):
            isolated = find_isolated(points, away, MAX_SIGMA * robust_sigma(away))
        beside = np.count_nonzero(inside[chosen] & ~own)
        total = max(int(beside) + len(away), 1)
        reasons = {"on other surfaces": int(beside), "isolated": int(isolated.sum())}
        text = ", ".join(f"{100 * n / total:.2g} % {what}" for what, n in reasons.items() if n)
        excluded = 100 * sum(reasons.values()) / total
        return SurfacePoints(
            points[~isolated], away[~isolated], towards[~isolated], float(excluded), text
        )

    def evidence(self, names: Sequence[str]) -> PlanEvidence:
        """The evidence on features: the least share measured, the largest that is excluded, and the
        smallest defect that the first would show."""
        measured = [self.percent_measured(name) for name in names]
        known = [percent for percent in measured if percent is not None]
        excluded, smallest = list[tuple[float, str]](), list[float]()
        for name in names:
            if self.features[name].kind == "surface":
                shown = self.surface(name)
                points, deviations = shown.points, shown.deviations
                excluded.append((shown.excluded, shown.excluded_as))
            else:
                fit = self.feature(name)
                points, deviations = fit.points, fit.feature.distance(fit.points)
                share = 100 * fit.excluded / max(fit.excluded + fit.used, 1)
                excluded.append((share, fit.excluded_as))
            smallest.append(smallest_defect(points, deviations))
        share, text = max(excluded)
        return PlanEvidence(min(known, default=None), share, text, smallest[0])

    def hidden_width(self, wanted: Characteristic, smallest: float) -> float:
        """By how much, mm, a local defect that noise may hide among few points would widen the zone
        of a characteristic, from the `smallest_defect` that they show."""
        name, is_double = wanted.features[0], wanted.kind in ("profile", "position")
        if wanted.kind == "profile":
            points = self.surface(name).points
        else:
            points = self.feature(name).points
            if wanted.kind not in FORMS and self.feature(name).feature.kind != "plane":
                return 0.0  # an axis or a centre lies where all points have it
        return (1 + is_double) * hidden_defect(smallest, len(points))

    def doubts(self, names: Sequence[str]) -> list[str]:
        """Return the warnings about the scan and the fits of features."""
        fitted = [name for name in names if self.features[name].kind != "surface"]
        found = [warning for name in fitted for warning in self.feature(name).warnings]
        return [*self.errors.warnings, *dict.fromkeys(found)]

    def _percent_measured(self, name: str) -> float | None:
        """Percent of a feature's area that the scan's views can see and was measured; None where
        that is not known."""
        feature, T = self.features[name], self.T_part_scan
        if self._area is not None:
            return self._area.percent_measured(feature.region.within(self._area.places))
        views = [move_points(T, each) for each in self._surface.views]
        if not views and self._surface.model:
            views = [T[None, :3, 3]]
        fit = self.feature(name)
        return percent_measured(fit.feature, feature.region, fit.points, views)

    def explain_lack(self, name: str, min_area: float) -> str:
        """Why too little of a feature's area was measured for a decision; empty where enough was:
        ``min_area`` percent of what the nominal model has of it in its region, or the plan's own
        part."""
        measured, filled, needed = self.percent_measured(name), self.features[name].filled, min_area
        more = ""
        if self._area is None and filled is not None:
            needed = min_area * filled / 100
        elif self._area is None:
            needed, more = min(min_area, LEAST_FILLED), STATE_FILLED
        if measured is None or measured >= needed:
            return ""
        return (
            f"{measured:.1f} % of the area of {name} that the views can see was measured, and"
            f" {needed:.3g} % are needed: scan what is missing and merge{more}"
        )

    @property
    def errors(self) -> PointErrors:
        """Errors of the points in part coordinates."""
        return self._surface.errors.moved(self.T_part_scan)

    def _align_datums(self, datums: Sequence[str]) -> None:
        """Align by three datums, whose regions follow the part."""
        first = self.T_part_scan
        for _ in range(DATUM_ROUNDS):
            fits = [self._fit(name, as_planned=True) for name in datums]
            self.T_part_scan = datum_frame([fit.feature for fit in fits]) @ self.T_part_scan
        if np.trace(self.T_part_scan[:3, :3] @ first[:3, :3].T) < 1.0:
            raise InputError(
                "The datums turn the part by more than 90 degrees",
                "place it as the plan's own part lay.",
            )
        middle = move_points(self.T_part_scan, self._scan_points).mean(axis=0)
        self.spread = datum_spread(fits, middle)

    def _fit(self, name: str, as_planned: bool = False) -> FeatureFit:
        """Fit a feature to the part as it lies now; a plane faces the camera, or the side that it
        has ``as_planned``. Raises InputError where the part has none."""
        feature, T = self.features[name], self.T_part_scan
        if feature.kind == "surface":
            raise InputError(
                f"{name} is a surface, which has a profile alone", "choose a fitted feature."
            )
        points = move_points(T, self._scan_points)
        points = points[feature.region.widened.within(points)]
        camera = T[:3, 3] if self._surface.model else None
        try:
            fit = fit_feature(feature.kind, points, self.errors, feature.region, camera)
        except InputError as error:
            raise error.within(name) from error
        _refuse_unplanned(fit.feature, feature)
        towards = T[:3, 3] - fit.feature.place
        if as_planned and feature.direction is not None:
            towards = np.array(feature.direction)
        return face_towards(fit, towards)


def _refuse_unplanned(found: Feature, planned: PlanFeature) -> None:
    """Raise InputError where what was fitted is so far from the plan's feature that it is another
    surface of the region."""
    if planned.direction is not None and found.direction is not None:
        cosine = abs(float(found.direction @ unit_vectors(np.array(planned.direction))))
        if cosine < np.cos(np.radians(MAX_TURNED_DEG)):
            raise InputError(
                f"{planned.name}: the {found.kind} in its region is turned by"
                f" {np.degrees(np.arccos(cosine)):.0f} degrees from the plan's",
                "see that the part has it there, and scan what is missing of it.",
            )
    if planned.radius is None or found.radius is None:
        return
    off = abs(found.radius - planned.radius)
    if planned.place is not None:
        nominal = Feature(found.kind, np.array(planned.place), found.direction, 0.0)
        off = max(off, abs(float(nominal.distance(found.place[None])[0])))
    if off > MAX_OFF_RADIUS * planned.radius:
        raise InputError(
            f"{planned.name}: the {found.kind} in its region is {off:.3g} mm off the plan's place"
            " or radius",
            "see that the part has it there, and scan what is missing of it.",
        )


def _mark_undecided(wanted: Characteristic, reason: str) -> CharacteristicResult:
    """The result of a characteristic that could not be measured."""
    return CharacteristicResult(wanted.name, None, None, "undecided", reason)


def judge_characteristic(
    wanted: Characteristic, part: AlignedPart, min_area: float
) -> CharacteristicResult:
    """Measure and judge one characteristic; where that is impossible, or too little was measured,
    the result holds the reason."""
    try:
        quantity = measure_characteristic(wanted, part)
    except (SlviewerError, np.linalg.LinAlgError) as error:
        return _mark_undecided(wanted, str(error))
    value, U = quantity.value, quantity.U
    if U is None or not np.isfinite(value + U):
        return _mark_undecided(wanted, "its uncertainty is not known")
    decision = judge_limits(value, U, wanted.lower, wanted.upper)
    doubts, evidence = part.doubts(wanted.features), part.evidence(wanted.features)
    lacking = [text for name in wanted.features if (text := part.explain_lack(name, min_area))]
    if lacking:
        decision = "undecided"
        doubts += lacking
    is_zone = wanted.kind in (*FORMS, *TO_DATUM, "profile", "position")
    hidden = value + part.hidden_width(wanted, evidence.smallest)
    limit = wanted.upper or np.inf
    if is_zone and decision != "fail" and max(evidence.smallest, hidden) > limit:
        decision = "undecided"
        doubts.append(
            f"a local defect of {evidence.smallest:.2g} mm would not show in the noise: scan with"
            " less noise, such as more steps or a longer exposure, or more densely"
        )
    whole = quantity.whole and bool(part.errors.calibration)
    return CharacteristicResult(
        wanted.name, value, U, decision, "; ".join(doubts), whole, **vars(evidence)
    )


def measure_characteristic(wanted: Characteristic, part: AlignedPart) -> Quantity:
    """Measure a characteristic. Raises InputError where the part does not show it."""
    kind, (name, *others) = wanted.kind, wanted.features
    if kind == "profile":
        return part.profile(name)
    fit, planned = part.feature(name), part.features[name]
    points = fit.points
    if kind in FORMS:
        return form_error(kind, fit, points, part.errors.raised)  # type: ignore[arg-type]
    if kind == "position":
        return position_error(fit, points, planned.nominal(), part.spread, part.errors.raised)
    if kind in SIZES:
        quantities = fit.quantities()
    else:
        datum = part.feature(others[0])
        if kind in TO_DATUM:
            return orientation_error(kind, fit, points, datum, part.errors.raised)  # type: ignore[arg-type]
        quantities = relation(fit.feature, fit.spread, datum.feature, datum.spread)
    named = {quantity.name: quantity for quantity in quantities}
    if kind in named:
        return named[kind]
    raise InputError(f"A {fit.feature.kind} has no {kind} here: it has {', '.join(named)}.")
