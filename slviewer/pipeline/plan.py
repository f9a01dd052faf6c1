"""An inspection plan from the measurements of a session, to repeat them on other scans."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from slviewer.errors import InputError, UsageError
from slviewer.inspection.datums import datum_frame
from slviewer.inspection.features import Feature
from slviewer.inspection.regions import Region
from slviewer.pipeline.feedback import Progress, Warn, ignore_progress, ignore_warnings
from slviewer.pipeline.inspect_parts import fit_to_nominal
from slviewer.pipeline.measure import load_feature
from slviewer.pipeline.measured_surface import load_surface
from slviewer.pipeline.open_session import SessionLike, opened
from slviewer.pipeline.operation import Job
from slviewer.pipeline.stored_records import Stored, list_records
from slviewer.records.inspection import Characteristic
from slviewer.records.measurement import Measurement
from slviewer.records.plain import from_plain, to_plain
from slviewer.session.inspection_plan import (
    KINDS,
    Alignment,
    Plan,
    PlanFeature,
    PlanRegion,
    write_plan,
)
from slviewer.session.nominal import read_nominal

TOLERANCE_MM = 0.1
LEAST_TOLERANCE_MM, MOST_TOLERANCE_MM = 1e-3, 1e3
_DECIMALS = 4
"""Of nominal values and limits in a plan."""
FORM_OF = {"plane": "flatness", "sphere": "roundness", "cylinder": "cylindricity"}


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
        surface = load_surface(job, source.source, source.model)
        T = fit_to_nominal(surface, ideal).T_nominal_scan
        alignment = Alignment("best fit", str(nominal.expanduser().absolute()))
    listed = [_plan_feature(names[i], each, features[i], T) for i, each in fits.items()]
    left_out = [
        each.label
        for each in measured
        if each.record.what not in (*FORM_OF, "relation") or each.stale
    ]
    if left_out:
        job.warn(
            f"a plan holds fits and their relations that are not stale: {', '.join(left_out)} are"
            " not in it"
        )
    return Plan(
        name, tuple(listed), tuple(_list_characteristics(measured, names, tolerance)), alignment
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
                lower, upper = (
                    round(nominal + each, _DECIMALS) for each in (-tolerance, tolerance)
                )
                name = f"{' – '.join(features)} {quantity.name}"
                yield Characteristic(
                    name, quantity.name, features, nominal, lower, upper, quantity.unit
                )
        if form:
            yield Characteristic(f"{features[0]} {form}", form, features, upper=tolerance)


def _plan_feature(
    name: str, measured: Stored[Measurement], feature: Feature, T: np.ndarray
) -> PlanFeature:
    """A fitted feature with its region, in part coordinates."""
    region = PlanRegion.of(from_plain(to_plain(measured.record.region), Region), T)
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
