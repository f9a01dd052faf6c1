"""Inspection plans on parts: each part is aligned, its features are fitted, and each characteristic
is measured and judged; the record of part by characteristic, capability, and the files of both. And
a plan from the measurements of a session, to repeat them on other scans."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path

import msgspec
import numpy as np
from scipy.special import chdtri, ndtri

from slviewer.errors import InputError, SlviewerError, UsageError
from slviewer.geometry.rigid import Uncertainty, move_points
from slviewer.inspection.deviation import NominalArea
from slviewer.inspection.features import Feature, relation
from slviewer.inspection.fitting import (
    FeatureFit,
    datum_frame,
    datum_spread,
    face_towards,
    fit_feature,
)
from slviewer.inspection.form import form_error, orientation_error, position_error, profile_error
from slviewer.inspection.nominal_surface import NominalSurface
from slviewer.inspection.regions import Region
from slviewer.inspection.tolerance import judge_limits
from slviewer.inspection.uncertainty import PointErrors
from slviewer.pipeline.compare import fit_to_nominal
from slviewer.pipeline.measure import MERGED, MeasuredSurface, load_feature, load_surface
from slviewer.pipeline.models import ModelName
from slviewer.pipeline.operation import (
    Findings,
    Found,
    Job,
    Progress,
    SessionLike,
    Stored,
    Warn,
    ignore_progress,
    ignore_warnings,
    list_records,
    match_names,
    next_name,
    opened,
    operation,
    part,
)
from slviewer.printable import format_csv
from slviewer.records.inspection import (
    Capability,
    Characteristic,
    CharacteristicResult,
    Inspection,
    PartResult,
)
from slviewer.records.measurement import Measurement, Quantity
from slviewer.records.record import from_plain, to_plain
from slviewer.report.session import write_parts_page
from slviewer.session.atomic import replace_file, to_json
from slviewer.session.inspection_plan import (
    FORMS,
    KINDS,
    SIZES,
    TO_DATUM,
    Alignment,
    Plan,
    PlanFeature,
    read_plan,
    write_plan,
)
from slviewer.session.layout import is_session
from slviewer.session.nominal import NOMINALS, Nominal, read_nominal
from slviewer.session.store import Session

Load = Callable[[Progress], MeasuredSurface]
FILES = ("parts.html", "parts.csv", "parts.json")
"""The report on parts, their table, and the record."""
TOLERANCE_MM = 0.1
LEAST_TOLERANCE_MM, MOST_TOLERANCE_MM = 1e-3, 1e3
_DECIMALS = 4
"""Of nominal values and limits in a plan."""
FORM_OF = {"plane": "flatness", "sphere": "roundness", "cylinder": "cylindricity"}
CONFIDENCE, MIN_PARTS = 0.95, 3
"""Of a capability: of its intervals, and the parts that it takes."""
DATUM_ROUNDS = 4
"""Fits of the datums, each with the regions moved by the frame of the last."""


@dataclass(frozen=True)
class RunPlanSettings:
    """By which plan which scans are inspected.

    Args:
        plan: The inspection plan, a TOML file; `slviewer plan` makes one.
        scans: The scans that each show a part, or patterns such as 'part_*', or merge/1; by default
            every scan.
        model: Which calibration to use; by default the best one available.
        accept_rejected: Use the calibration although its verdict rejects it.
    """

    plan: Path | str
    scans: Sequence[str] = ()
    model: ModelName | None = None
    accept_rejected: bool = False


def inspect_parts(
    plan: Path | str,
    sessions: Sequence[Path],
    *,
    scans: Sequence[str] = (),
    out: Path | None = None,
    model: ModelName | None = None,
    accept_rejected: bool = False,
    progress: Progress = ignore_progress,
    warn: Warn = ignore_warnings,
) -> Findings[Inspection]:
    """Inspect many parts by one plan: a table of part by characteristic, trends and capability as
    HTML, CSV and JSON.

    Ends with status 1 where a part fails or is undecided. What cannot be measured is named, and
    stops no other.

    Args:
        plan: The inspection plan, a TOML file; `slviewer plan` makes one.
        sessions: Session folders, or folders that hold some.
        scans: The scans that each show a part, or patterns such as 'part_*', or merge/1; by default
            every scan.
        out: Folder of the results; by default one beside the plan, named after it.
        model: Which calibration to use; by default each session's best one.
        accept_rejected: Use calibrations although their verdict rejects them.
    """
    read, settings = read_plan(plan), RunPlanSettings(plan, scans, model, accept_rejected)
    sources: list[tuple[str, Load | SlviewerError]] = []
    folders = list_sessions(sessions)
    for folder in folders:
        try:
            with opened(folder) as store:
                names = match_parts(store, scans)
        except SlviewerError as error:
            sources.append((folder.name, error))
            continue
        for name in names:
            label = name if len(folders) == 1 else f"{folder.name}/{name}"
            sources.append((label, partial(_load_part, folder, name, settings, warn)))
    # of several sessions
    found = msgspec.structs.replace(inspect_surfaces(read, sources, progress), inputs={})
    folder = Path(f"{Path(plan).with_suffix('')}-results") if out is None else out
    files = tuple(folder.absolute() / name for name in FILES)
    write_inspection(found, files)
    return Findings(Inspection, {found.plan: found}, files, tuple(f"-> {path}" for path in files))


def _load_part(
    session: SessionLike, scan: str, settings: RunPlanSettings, warn: Warn, progress: Progress
) -> MeasuredSurface:
    """Load the surface of a part."""
    with opened(session) as store:
        job = Job(store, progress, warn, settings.accept_rejected)
        return load_surface(job, scan, settings.model)


def inspect_surfaces(
    plan: Plan,
    sources: Sequence[tuple[str, Load | SlviewerError]],
    progress: Progress = ignore_progress,
) -> Inspection:
    """Inspect parts, each a name and what loads its surface, or why it cannot be loaded. Raises
    SlviewerError where the plan's nominal model cannot be read."""
    nominal = None if plan.alignment.nominal is None else read_nominal(plan.alignment.nominal)
    parts, inputs, scales = list[PartResult](), dict[str, str](), dict[str, float]()
    for k, (name, load) in enumerate(sources):
        whose = f"{k + 1} of {len(sources)}, {name}"
        report = part(progress, k / len(sources), (k + 1) / len(sources), whose)
        report(0.0, "loading")
        try:
            if isinstance(load, SlviewerError):
                raise load
            surface = load(report)
            inputs |= surface.inputs
            if surface.organised:
                scales[surface.model] = surface.scale
            try:
                aligned = AlignedPart(plan, surface, nominal)
            except SlviewerError as error:
                raise InputError(f"not aligned: {error}") from error
            results = tuple(_measure(each, aligned, plan.min_area) for each in plan.characteristic)
        except SlviewerError as error:
            if error.exit_status == 130:  # cancelled
                raise
            results = tuple(_undecided(each, str(error)) for each in plan.characteristic)
        parts.append(PartResult(name, results))
    progress(1.0, "inspected")
    return Inspection(
        plan=plan.name,
        characteristic=plan.characteristic,
        parts=tuple(parts),
        capability=tuple(
            process_capability(
                [value for each in parts if (value := each.results[k].value) is not None],
                wanted.lower,
                wanted.upper,
            )
            for k, wanted in enumerate(plan.characteristic)
        ),
        alignment=plan.alignment.kind,
        inputs=inputs,
        scales=scales,
    )


def write_inspection(found: Inspection, files: Sequence[Path]) -> None:
    """Write what was found of parts as HTML, CSV and JSON."""
    html, csv, json = files
    table = found.list_results()
    headings = [column.heading for column in table.columns]
    text = format_csv([headings, *map(table.values, table.rows)])
    replace_file(csv, text.encode("utf-8-sig"))
    replace_file(json, to_json(found))
    write_parts_page(html, found)


def list_sessions(folders: Sequence[Path]) -> list[Path]:
    """The sessions among folders, and those in folders that are none. Raises UsageError where there
    is none."""
    listed: list[Path] = []
    for folder in folders:
        inner = [folder] if is_session(folder) else sorted(filter(is_session, folder.glob("*")))
        if not inner:
            raise UsageError(
                f"{folder} is not a session and holds none: give session folders, or a folder of"
                " them"
            )
        listed += inner
    if not listed:
        raise UsageError("no session named: give the folders of one or more")
    return listed


def match_parts(store: Session, patterns: Sequence[str]) -> list[str]:
    """The scans of a session that show a part. Raises InputError where there are none."""
    merges = [each for each in patterns if each.startswith(MERGED)]
    wanted = [each for each in patterns if each not in merges]
    if merges and not wanted:
        return merges
    names = store.capture_names("scan")
    if wanted:
        names = match_names(names, wanted, "scan", InputError)
    elif not names:
        raise InputError("it holds no scan: scan the part first")
    return [*names, *merges]


@operation("run-plan", Inspection, RunPlanSettings)
def run_plan(job: Job, settings: RunPlanSettings) -> Iterator[Found[Inspection]]:
    """Inspect scans of a session, each a part, by a plan; its exports then hold parts.html,
    parts.csv and parts.json.

    Ends with status 1 where a part fails or is undecided. What cannot be measured is named, and
    stops no other.
    """
    store = job.store
    plan = read_plan(settings.plan)
    if plan.alignment.nominal is not None:
        own = store.folder / NOMINALS / Path(plan.alignment.nominal).name
        if own.is_file():
            plan = replace(plan, alignment=replace(plan.alignment, nominal=str(own)))
    sources = [
        (name, partial(_load_part, store, name, settings, job.warn))
        for name in match_parts(store, settings.scans)
    ]
    found = inspect_surfaces(plan, sources, job.progress)
    with ExitStack() as placed:
        write_inspection(found, [placed.enter_context(store.staged_export(name)) for name in FILES])
        files = tuple(store.exports / name for name in FILES)
        notes = tuple(f"-> {path}" for path in files)
        yield Found(next_name(store, Inspection), found, files=files, notes=notes)


def _undecided(wanted: Characteristic, reason: str) -> CharacteristicResult:
    """The result of a characteristic that could not be measured."""
    return CharacteristicResult(wanted.name, None, None, "undecided", reason)


def process_capability(
    values: Sequence[float], lower: float | None, upper: float | None
) -> Capability | None:
    """Estimate the capability of a process; None for fewer than 3 values, without a limit, or where
    they do not vary.

    Cp's interval is exact for normal values (chi squared), Cpk's is Bissell's approximation
    (Applied Statistics 39, 1990). The spread of the values includes that of the measurement.
    """
    x = np.asarray(values, np.float64)
    n = len(x)
    low, high = -np.inf if lower is None else lower, np.inf if upper is None else upper
    sigma = float(x.std(ddof=1)) if n >= MIN_PARTS else 0.0
    if not (sigma > 0 and np.isfinite([low, high]).any()):
        return None
    mean, tail = float(x.mean()), (1 - CONFIDENCE) / 2
    cp = None
    if np.isfinite(high - low):
        value = (high - low) / (6 * sigma)
        ends = value * np.sqrt(chdtri(n - 1, [1 - tail, tail]) / (n - 1))
        cp = (value, float(ends[0]), float(ends[1]))
    cpk = min(mean - low, high - mean) / (3 * sigma)
    reach = float(-ndtri(tail) * np.sqrt(1 / (9 * n) + cpk**2 / (2 * (n - 1))))
    return Capability(n, mean, sigma, cp, (cpk, cpk - reach, cpk + reach))


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
        self._reach = np.inf
        self.T_part_scan: np.ndarray = np.eye(4)
        self.spread: Uncertainty | None = None
        if not len(self._scan_points):
            raise InputError(f"{surface.source} has no measured points: scan the part again.")
        if nominal is not None:
            result = fit_to_nominal(surface, nominal)
            self._nominal_surface, self._area = result.surface, result.area
            self.T_part_scan, self.spread = result.T_nominal_scan, result.alignment_spread
            self._reach = result.reach_mm
        if plan.alignment.kind == "3-2-1":
            self.T_part_scan = np.array(plan.alignment.start)
            self._align_datums(plan.alignment.datums)
        self.points = move_points(self.T_part_scan, self._scan_points)
        self.feature: Callable[[str], FeatureFit] = cache(self._fit)

    def profile(self, name: str) -> Quantity:
        """The profile of a region against the nominal model. Raises InputError without one."""
        if self._nominal_surface is None:
            raise InputError(
                "A profile needs the nominal model: give its file as `nominal` of the plan's"
                " alignment."
            )
        within = self.features[name].region.within(self.points)
        away, towards = self._nominal_surface.signed(self.points[within])
        away[np.abs(away) > self._reach] = np.nan
        return profile_error(self.points[within], away, towards, self.spread, self.errors.raised)

    def doubts(self, names: Sequence[str]) -> list[str]:
        """Return the warnings about the scan and the fits of features."""
        fitted = [name for name in names if self.features[name].kind != "surface"]
        found = [warning for name in fitted for warning in self.feature(name).warnings]
        return [*self.errors.warnings, *dict.fromkeys(found)]

    def percent_measured(self, name: str) -> float | None:
        """Percent of a feature's area that the scan's views can see and was measured; None where
        that is not known."""
        if self._area is None:
            return None
        return self._area.percent_measured(self.features[name].region.within(self._area.places))

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
                "The datums turn the part by more than 90 degrees: place it as the plan's own part"
                " lay."
            )
        middle = move_points(self.T_part_scan, self._scan_points).mean(axis=0)
        self.spread = datum_spread(fits, middle)

    def _fit(self, name: str, as_planned: bool = False) -> FeatureFit:
        """Fit a feature to the part as it lies now; a plane faces the camera, or the side that it
        has ``as_planned``. Raises InputError where the part has none."""
        feature, T = self.features[name], self.T_part_scan
        if feature.kind == "surface":
            raise InputError(
                f"{name} is a surface, which has a profile alone: choose a fitted feature."
            )
        points = move_points(T, self._scan_points)
        within = feature.region.within(points)
        try:
            fit = fit_feature(feature.kind, points[within], self.errors)
        except InputError as error:
            raise InputError(f"{name}: {error}") from error
        towards = T[:3, 3] - fit.feature.place
        if as_planned and feature.direction is not None:
            towards = np.array(feature.direction)
        return face_towards(fit, towards)


def _measure(wanted: Characteristic, part: AlignedPart, min_area: float) -> CharacteristicResult:
    """Measure and judge one characteristic; where that is impossible, or too little was measured,
    the result holds the reason."""
    try:
        quantity = measure_characteristic(wanted, part)
    except (SlviewerError, np.linalg.LinAlgError) as error:
        return _undecided(wanted, str(error))
    value, U = quantity.value, quantity.U
    if U is None or not np.isfinite(value + U):
        return _undecided(wanted, "its uncertainty is not known")
    decision = judge_limits(value, U, wanted.lower, wanted.upper)
    doubts = part.doubts(wanted.features)
    for name in wanted.features:
        percent = part.percent_measured(name)
        if percent is not None and percent < min_area:
            decision = "undecided"
            doubts.append(
                f"{percent:.1f} % of the area of {name} that the views can see was measured, and"
                f" {min_area:g} % are needed: scan what is missing and merge, or give a smaller"
                " min_area in the plan"
            )
    whole = quantity.whole and bool(part.errors.calibration)
    return CharacteristicResult(wanted.name, value, U, decision, "; ".join(doubts), whole)


def measure_characteristic(wanted: Characteristic, part: AlignedPart) -> Quantity:
    """Measure a characteristic. Raises InputError where the part does not show it."""
    kind, (name, *others) = wanted.kind, wanted.features
    if kind == "profile":
        return part.profile(name)
    fit, planned = part.feature(name), part.features[name]
    points = part.points[planned.region.within(part.points)]
    if kind in FORMS:
        return form_error(kind, fit, points, part.errors.raised)  # type: ignore[arg-type]
    if kind == "position":
        return position_error(fit, points, planned.nominal(), part.spread)
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


def plan(
    session: SessionLike,
    *,
    out: Path = Path("plan.toml"),
    tolerance: float = TOLERANCE_MM,
    datums: tuple[str, str, str] | None = None,
    nominal: Path | None = None,
    progress: Progress = ignore_progress,
    warn: Warn = ignore_warnings,
) -> str:
    """Make an inspection plan from what was measured on a scan, to repeat it on others with
    `slviewer inspect-parts`.

    The plan is a text file: edit its nominal values and limits there.

    Args:
        session: Session folder.
        out: The plan, a TOML file.
        tolerance: Plus and minus around each measured size, mm (and degrees for angles); the upper
            limit of form.
        datums: Align by these three measurements (3-2-1), such as m1 m2 m3: a plane, then planes or
            spheres.
        nominal: Align by the best fit to this STL, PLY or OBJ file. By default parts lie in one
            place, in a fixture.
    """
    if not LEAST_TOLERANCE_MM <= tolerance <= MOST_TOLERANCE_MM:
        raise UsageError(
            f"--tolerance is {tolerance:g}: give {LEAST_TOLERANCE_MM:g} to {MOST_TOLERANCE_MM:g}"
            f" mm, by default {TOLERANCE_MM:g}"
        )
    if datums and nominal is not None:
        raise UsageError("--datums and --nominal were given: choose one way to align")
    with opened(session) as store:
        job = Job(store, progress, warn)
        made = make_plan(job, tolerance, Path(out).stem, datums or (), nominal)
    write_plan(made, out)
    return (
        f"{len(made.characteristic)} characteristics of {len(made.feature)} features -> {out}; set"
        f" nominal values and limits there, then: slviewer inspect-parts {out} SESSION..."
    )


def make_plan(
    job: Job, tolerance: float, name: str, datums: Sequence[str] = (), nominal: Path | None = None
) -> Plan:
    """The plan of a session's fitted planes, spheres and cylinders, and of the relations between
    them."""
    measured = list_records(job.store, Measurement)
    fits = _select_fits(measured, job.warn)
    features = {identity: load_feature(job.store, each)[0] for identity, each in fits.items()}
    names, T, alignment = _distinct_names(fits), np.eye(4), Alignment()
    if datums:
        if missing := [each for each in datums if each not in fits]:
            raise InputError(
                f"{', '.join(missing)} is not a fit to align by: there are {', '.join(fits)}"
            )
        T = datum_frame([features[each] for each in datums])
        start = tuple(map(tuple, T.round(9).tolist()))
        alignment = Alignment("3-2-1", None, tuple(names[each] for each in datums), start)  # type: ignore[arg-type]
    elif nominal is not None:
        ideal, source = read_nominal(nominal), next(iter(fits.values())).record
        T = fit_to_nominal(load_surface(job, source.source, source.model), ideal).T_nominal_scan
        alignment = Alignment("best fit", str(nominal.expanduser().absolute()))
    if skipped := [
        each.label
        for each in measured
        if each.record.what not in (*FORM_OF, "relation") or each.stale
    ]:
        job.warn(
            f"a plan holds fits and their relations that are not stale: {', '.join(skipped)} are"
            " not in it"
        )
    return Plan(
        name,
        tuple(_plan_feature(names[i], each, features[i], T) for i, each in fits.items()),
        tuple(_list_characteristics(measured, names, tolerance)),
        alignment,
    )


def _select_fits(
    measured: Sequence[Stored[Measurement]], warn: Warn
) -> dict[str, Stored[Measurement]]:
    """The fits that are not stale, by id; warns where several scans have some: those of the last
    one are taken."""
    fits = [each for each in measured if each.record.what in FORM_OF and not each.stale]
    if not fits:
        raise InputError(
            "nothing was fitted in this session: fit planes, spheres or cylinders to a scan first"
        )
    last = fits[-1].record.source
    if len(sources := {each.record.source for each in fits}) > 1:
        warn(
            f"measurements were made on {', '.join(sorted(sources))}: the plan takes those on"
            f" {last} alone"
        )
    return {each.name: each for each in fits if each.record.source == last}


def _list_characteristics(
    measured: Sequence[Stored[Measurement]], names: Mapping[str, str], tolerance: float
) -> Iterator[Characteristic]:
    """Size and form of the fits in ``names``, by id, then the relations between two of them."""
    relations = [each for each in measured if each.record.what == "relation" and not each.stale]
    related = [each for each in relations if names.keys() >= {*each.record.of}]
    for each in [*(each for each in measured if each.name in names), *related]:
        form = FORM_OF.get(each.record.what)
        features = (names[each.name],) if form else tuple(names[i] for i in each.record.of)
        for quantity in each.record.quantities:
            if quantity.name in (("diameter",) if form else KINDS):
                nominal = round(quantity.value, _DECIMALS)
                yield Characteristic(
                    f"{' – '.join(features)} {quantity.name}",
                    quantity.name,
                    features,
                    nominal,
                    round(nominal - tolerance, _DECIMALS),
                    round(nominal + tolerance, _DECIMALS),
                    quantity.unit,
                )
        if form:
            yield Characteristic(f"{features[0]} {form}", form, features, upper=tolerance)


def _plan_feature(
    name: str, measured: Stored[Measurement], feature: Feature, T: np.ndarray
) -> PlanFeature:
    """A fitted feature with its region, in part coordinates."""
    region = from_plain(to_plain(measured.record.region), Region).moved(T)
    place = tuple((T[:3, :3] @ feature.place + T[:3, 3]).round(6).tolist())
    direction = None
    if feature.direction is not None:
        direction = tuple((T[:3, :3] @ feature.direction).round(9).tolist())
    return PlanFeature(name, feature.kind, region, place, direction, feature.radius)  # type: ignore[arg-type]


def _distinct_names(fits: Mapping[str, Stored[Measurement]]) -> dict[str, str]:
    """The measurements' names by id, with the id where two have the same."""
    names = [each.label for each in fits.values()]
    return {
        i: each.label if names.count(each.label) == 1 else f"{each.label} {i}"
        for i, each in fits.items()
    }
