"""Inspection plans on parts: each part is aligned, its features are fitted, and each characteristic
is measured and judged; the record of part by characteristic, capability, and the files of both. And
a plan from the measurements of a session, to repeat them on other scans."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import msgspec
import numpy as np
from scipy.special import chdtri, ndtri

from slviewer.errors import Cancelled, InputError, SlviewerError, UsageError
from slviewer.inspection.features import Feature
from slviewer.inspection.fitting import (
    datum_frame,
)
from slviewer.inspection.regions import Region
from slviewer.pipeline.aligned_part import AlignedPart, judge_characteristic
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
from slviewer.records.acceptance import Decision
from slviewer.records.inspection import (
    Capability,
    Characteristic,
    CharacteristicResult,
    Inspection,
    PartResult,
)
from slviewer.records.measurement import Measurement
from slviewer.records.record import from_plain, to_plain
from slviewer.registration.refusal import WrongPart
from slviewer.report.session import write_parts_page
from slviewer.session.atomic import replace_file, to_json
from slviewer.session.inspection_plan import (
    KINDS,
    Alignment,
    Plan,
    PlanFeature,
    read_plan,
    write_plan,
)
from slviewer.session.layout import is_session
from slviewer.session.nominal import NOMINALS, read_nominal
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
            except (WrongPart, Cancelled):
                raise
            except SlviewerError as error:
                raise InputError(f"not aligned: {error}") from error
            results = tuple(
                judge_characteristic(each, aligned, plan.min_area) for each in plan.characteristic
            )
        except Cancelled:
            raise
        except SlviewerError as error:  # what cannot be measured does not fail
            decision: Decision = "fail" if isinstance(error, WrongPart) else "undecided"
            results = tuple(
                CharacteristicResult(each.name, None, None, decision, str(error))
                for each in plan.characteristic
            )
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
                f"{folder} is not a session and holds none",
                "give session folders, or a folder of them",
            )
        listed += inner
    if not listed:
        raise UsageError("no session named", "give the folders of one or more")
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
        raise InputError("it holds no scan", "scan the part first")
    return [*names, *merges]


def read_session_plan(store: Session, path: Path | str) -> Plan:
    """Read a plan, whose nominal model is the session's own file of that name, where it has one."""
    plan = read_plan(path)
    if plan.alignment.nominal is not None:
        own = store.folder / NOMINALS / Path(plan.alignment.nominal).name
        if own.is_file():
            plan = replace(plan, alignment=replace(plan.alignment, nominal=str(own)))
    return plan


@operation("run-plan", Inspection, RunPlanSettings)
def run_plan(job: Job, settings: RunPlanSettings) -> Iterator[Found[Inspection]]:
    """Inspect scans of a session, each a part, by a plan; its exports then hold parts.html,
    parts.csv and parts.json.

    Ends with status 1 where a part fails or is undecided. What cannot be measured is named, and
    stops no other.
    """
    store = job.store
    plan = read_session_plan(store, settings.plan)
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
            f"--tolerance is {tolerance:g}",
            f"give {LEAST_TOLERANCE_MM:g} to {MOST_TOLERANCE_MM:g} mm, by default {TOLERANCE_MM:g}",
        )
    if datums and nominal is not None:
        raise UsageError("--datums and --nominal were given", "choose one way to align")
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
    own = next(iter(fits.values())).record
    surface = load_surface(job, own.source, own.model)
    if datums:
        if missing := [each for each in datums if each not in fits]:
            raise InputError(
                f"{', '.join(missing)} is not a fit to align by: there are {', '.join(fits)}"
            )
        T = datum_frame([features[each] for each in datums])
        start = tuple(map(tuple, T.round(9).tolist()))
        alignment = Alignment("3-2-1", None, tuple(names[each] for each in datums), start)  # type: ignore[arg-type]
    elif nominal is not None:
        T = fit_to_nominal(surface, read_nominal(nominal)).T_nominal_scan
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
    plan = Plan(
        name,
        tuple(_plan_feature(names[i], each, features[i], T) for i, each in fits.items()),
        tuple(_list_characteristics(measured, names, tolerance)),
        alignment,
    )
    return plan if alignment.nominal else _state_filled(plan, surface)


def _state_filled(plan: Plan, surface: MeasuredSurface) -> Plan:
    """Return a plan that states how much of their regions the features of its own part fill."""
    part = AlignedPart(plan, surface, None)
    filled = {each.name: part.percent_measured(each.name) for each in plan.feature}
    features = (replace(f, filled=round(filled[f.name] or 0, 1) or None) for f in plan.feature)
    return replace(plan, feature=tuple(features))


def _select_fits(
    measured: Sequence[Stored[Measurement]], warn: Warn
) -> dict[str, Stored[Measurement]]:
    """The fits that are not stale, by id; warns where several scans have some: those of the last
    one are taken."""
    fits = [each for each in measured if each.record.what in FORM_OF and not each.stale]
    if not fits:
        raise InputError(
            "nothing was fitted in this session", "fit planes, spheres or cylinders to a scan first"
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
