"""One part by an inspection plan: aligned, its features fitted, each characteristic measured and
judged."""

from collections.abc import Callable, Sequence

import numpy as np

from slviewer.errors import InputError, SlviewerError
from slviewer.geometry.rigid import move_points
from slviewer.inspection.datums import datum_frame, datum_spread, face_towards
from slviewer.inspection.deviation import Deviation, deviation
from slviewer.inspection.fitting import FeatureFit, fit_feature
from slviewer.inspection.form import form_error, orientation_error, position_error, profile_error
from slviewer.inspection.nominal_surface import NominalSurface
from slviewer.inspection.relations import relation
from slviewer.inspection.tolerance import judge_limits
from slviewer.inspection.uncertainty import RigidSpread, Shared
from slviewer.pipeline.measured_surface import MeasuredSurface
from slviewer.records.inspection import Characteristic, CharacteristicResult, PartResult
from slviewer.records.quantities import Quantity
from slviewer.session.inspection_plan import FORMS, SIZES, TO_DATUM, Plan, PlanFeature
from slviewer.session.nominal import Nominal, check_size

DATUM_ROUNDS = 4
"""Fits of the datums, each with the regions moved by the frame of the last."""


def inspect_part(
    part: str, plan: Plan, surface: MeasuredSurface, nominal: Nominal | None = None
) -> PartResult:
    """Measure and judge all characteristics of a plan on a part; what cannot be measured has its
    reason."""
    try:
        aligned = AlignedPart(plan, surface, nominal)
    except SlviewerError as error:
        return fail_part(part, plan, f"not aligned: {error}")
    return PartResult(part, tuple(_measure(each, aligned) for each in plan.characteristic))


def fail_part(part: str, plan: Plan, reason: str) -> PartResult:
    """The result of a part of which nothing could be measured."""
    results = (
        CharacteristicResult(each.name, None, None, "undecided", reason)
        for each in plan.characteristic
    )
    return PartResult(part, tuple(results))


class AlignedPart:
    """A scan's points in part coordinates, ``T_part_scan``, and the features fitted to them, each
    when it is used.

    ``spread``: what the alignment adds to the uncertainty of places; None without one. Raises
    InputError where the part cannot be aligned.
    """

    def __init__(
        self, plan: Plan, surface: MeasuredSurface, nominal: Nominal | None = None
    ) -> None:
        self._features = {each.name: each for each in plan.feature}
        self._fits: dict[str, FeatureFit] = {}
        self._surface = surface
        self._scan_points = surface.points[surface.measured].astype(np.float64)
        self._nominal_surface: NominalSurface | None = None
        self._reach = np.inf
        self.T_part_scan = np.eye(4)
        self.spread: RigidSpread | None = None
        if not len(self._scan_points):
            raise InputError(f"{surface.source} has no measured points: scan the part again.")
        if nominal is not None:
            self._nominal_surface = NominalSurface(nominal.mesh)
            result = fit_to_nominal(surface, nominal)
            self.T_part_scan, self.spread = result.T_nominal_scan, result.alignment_spread
            self._reach = result.reach_mm
        if plan.alignment.kind == "3-2-1":
            self.T_part_scan = np.array(plan.alignment.start)
            self._align_datums(plan.alignment.datums)
        self.points = move_points(self.T_part_scan, self._scan_points)

    def feature(self, name: str) -> FeatureFit:
        """The fit of a feature in part coordinates; planes face the camera. Raises InputError where
        it has none."""
        if name not in self._fits:
            self._fits[name] = self._fit(self._features[name], self.T_part_scan)
        return self._fits[name]

    def definition(self, name: str) -> PlanFeature:
        """The feature's definition in the plan."""
        return self._features[name]

    def region_points(self, name: str) -> np.ndarray:
        """(n, 3) mm: the points of a feature's region, in part coordinates."""
        return np.asarray(self.points[self._features[name].region.within(self.points)])

    def profile(self, name: str) -> Quantity:
        """The profile of a region against the nominal model. Raises InputError without one."""
        if self._nominal_surface is None:
            raise InputError(
                "A profile needs the nominal model: give its file as `nominal` of the plan's"
                " alignment."
            )
        within = self._features[name].region.within(self.points)
        away, towards = self._nominal_surface.signed(self.points[within])
        away[np.abs(away) > self._reach] = np.nan
        return profile_error(self.points[within], away, towards, self.spread, self.shared)

    @property
    def shared(self) -> Shared | None:
        """The calibration's part of uncertainties, for places in part coordinates."""
        return _shared_in(self._surface.shared, self.T_part_scan)

    def _align_datums(self, datums: Sequence[str]) -> None:
        """Align by three datums, whose regions follow the part."""
        first = self.T_part_scan
        for _ in range(DATUM_ROUNDS):
            fits = [
                self._fit(self._features[name], self.T_part_scan, as_planned=True)
                for name in datums
            ]
            self.T_part_scan = datum_frame([fit.feature for fit in fits]) @ self.T_part_scan
        turned = self.T_part_scan[:3, :3] @ first[:3, :3].T
        if np.trace(turned) < 1.0:
            raise InputError(
                "The datums turn the part by more than 90 degrees: place it as the plan's own part"
                " lay."
            )
        self.spread = datum_spread(
            fits, move_points(self.T_part_scan, self._scan_points).mean(axis=0)
        )

    def _fit(self, feature: PlanFeature, T: np.ndarray, as_planned: bool = False) -> FeatureFit:
        """Fit a feature at a pose T_part_scan; a plane faces the camera, or the side that it has
        ``as_planned``."""
        if feature.kind == "surface":
            raise InputError(
                f"{feature.name} is a surface, which has a profile alone: choose a fitted feature."
            )
        points = move_points(T, self._scan_points)
        within = feature.region.within(points)
        shared = _shared_in(self._surface.shared, T)
        try:
            fit = fit_feature(feature.kind, points[within], shared, self._surface.calibration)
        except InputError as error:
            raise InputError(f"{feature.name}: {error}") from error
        if as_planned and feature.direction is not None:
            return face_towards(fit, np.array(feature.direction))
        return face_towards(fit, T[:3, 3] - fit.feature.place)


def fit_to_nominal(
    surface: MeasuredSurface,
    nominal: Nominal,
    reach_mm: float | None = None,
    progress: Callable[[float], None] | None = None,
) -> Deviation:
    """Align a surface by the best fit to the nominal model; ``reach_mm`` as in `deviation`. Raises
    SlviewerError where that cannot be trusted."""
    points = surface.points[surface.measured].astype(np.float64)
    normals = (
        None if surface.normals is None else surface.normals[surface.measured].astype(np.float64)
    )
    check_size(nominal, points)
    sigma = surface.sigma_mm[surface.measured]
    typical = float(np.nanmedian(sigma)) if np.isfinite(sigma).any() else None
    return deviation(
        points,
        nominal.mesh,
        normals=normals,
        sigma_mm=typical,
        reach_mm=reach_mm,
        progress=progress,
    )


def _shared_in(shared: Shared | None, T_part_scan: np.ndarray) -> Shared | None:
    """The calibration's part of uncertainties for places and displacements in part coordinates."""
    if shared is None:
        return None
    back, scan_shared = np.linalg.inv(T_part_scan), shared
    return lambda points, answers: scan_shared(
        move_points(back, points), answers @ T_part_scan[:3, :3]
    )


def _measure(wanted: Characteristic, part: AlignedPart) -> CharacteristicResult:
    """Measure and judge one characteristic; where that is impossible the result holds the
    reason."""
    try:
        quantity = measure_characteristic(wanted, part)
    except (SlviewerError, np.linalg.LinAlgError) as error:
        return CharacteristicResult(wanted.name, None, None, "undecided", str(error))
    U = quantity.U
    if U is None or not np.isfinite(quantity.value + U):
        return CharacteristicResult(
            wanted.name, None, None, "undecided", "its uncertainty is not known"
        )
    decision = judge_limits(quantity.value, U, wanted.lower, wanted.upper)
    return CharacteristicResult(wanted.name, quantity.value, U, decision, whole=quantity.whole)


def measure_characteristic(wanted: Characteristic, part: AlignedPart) -> Quantity:
    """Measure a characteristic. Raises InputError where the part does not show it."""
    name = wanted.features[0]
    if wanted.kind == "profile":
        return part.profile(name)
    fit = part.feature(name)
    if wanted.kind in SIZES:
        quantities = fit.quantities()
    elif wanted.kind in FORMS:
        return form_error(wanted.kind, fit, part.region_points(name), part.shared)  # type: ignore[arg-type]
    elif wanted.kind in TO_DATUM:
        datum = part.feature(wanted.features[1])
        return orientation_error(wanted.kind, fit, part.region_points(name), datum, part.shared)  # type: ignore[arg-type]
    elif wanted.kind == "position":
        return position_error(
            fit, part.region_points(name), part.definition(name).nominal(), part.spread
        )
    else:
        datum = part.feature(wanted.features[1])
        quantities = relation(fit.feature, fit.spread, datum.feature, datum.spread)
    for quantity in quantities:
        if quantity.name == wanted.kind:
            return quantity
    raise InputError(
        f"A {fit.feature.kind} has no {wanted.kind} here: it has"
        f" {', '.join(q.name for q in quantities)}."
    )
