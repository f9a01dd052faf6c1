"""Measurements on scans: made, saved with the session, listed, written as CSV.

Every function takes a session's folder or one that is open, and saves what it makes; the browser
calls the same.
"""

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from slviewer.errors import InputError
from slviewer.inspection.features import Feature
from slviewer.inspection.fitting import fit_feature
from slviewer.inspection.quantities import Quantity
from slviewer.inspection.regions import Region
from slviewer.inspection.relations import distance, relation
from slviewer.inspection.section import CutPlane, section, triangulate_near
from slviewer.inspection.uncertainty import Spread
from slviewer.pipeline.measured_surface import MeasuredSurface, Place
from slviewer.pipeline.open_session import SessionLike, opened
from slviewer.pipeline.scale import scale_factor
from slviewer.printable import format_csv
from slviewer.reconstruction.mesh import triangulate_grid
from slviewer.reconstruction.reconstruct import JUMP
from slviewer.records.plain import from_plain
from slviewer.session.atomic import replace_file
from slviewer.session.measurements import (
    Measurement,
    list_measurements,
    load_measurement,
    measurement_arrays,
    save_measurement,
)
from slviewer.session.store import Session

Shape = Literal["plane", "sphere", "cylinder"]
MAX_RMS_TO_NOISE = 5.0
"""Times the points' noise: a fit with a larger RMS gets a warning."""
COLUMNS = (
    "id",
    "name",
    "kind",
    "scan",
    "quantity",
    "value",
    "unit",
    "U (k = 2)",
    "calibration in U",
    "state",
    "time",
)


def add_point(session: SessionLike, on: MeasuredSurface, at: Place, name: str = "") -> Measurement:
    """Save a picked point as a measurement, to relate it with fits."""
    feature, spread = on.picked(at)
    x, y, z = (
        Quantity(axis, float(value), "mm") for axis, value in zip("xyz", feature.place, strict=True)
    )
    data = {"at": at, "feature": feature, "scatter": spread.scatter, "calibration": on.calibration}
    arrays = {} if spread.shared is None else {"shared": spread.shared.astype(np.float32)}
    with opened(session, write=True) as store:
        return _save_measurement(store, on, "point", [x, y, z], data, arrays, name)


def add_distance(
    session: SessionLike, on: MeasuredSurface, a: Place, b: Place, name: str = ""
) -> Measurement:
    """Measure and save the distance between two picked points."""
    (first, first_spread), (second, second_spread) = on.picked(a), on.picked(b)
    length = distance(first.place, second.place, first_spread, second_spread)
    data = {"at": [a, b], "ends": [first.place.tolist(), second.place.tolist()]}
    with opened(session, write=True) as store:
        return _save_measurement(store, on, "distance", [length], data, {}, name)


def add_fit(
    session: SessionLike, on: MeasuredSurface, shape: Shape, region: Region, name: str = ""
) -> Measurement:
    """Fit a plane, sphere or cylinder to a region, and save it. Raises InputError where the region
    has none."""
    fit = fit_feature(shape, on.within(region), on.shared, on.calibration)
    noise = on.noise(region)
    if fit.rms > MAX_RMS_TO_NOISE * noise:
        warning = (
            f"points lie {fit.rms:.3g} mm (RMS) off the {shape}, and their noise is {noise:.2g} mm:"
            " see what it shows"
        )
        fit = replace(fit, warnings=(*fit.warnings, warning))
    arrays = {} if fit.spread.shared is None else {"shared": fit.spread.shared.astype(np.float32)}
    where = f"{region.text()}: {fit.used:,} used, {fit.left_out:,} excluded"
    data = {"region": region, "where": where, "fit": fit.to_json()}
    with opened(session, write=True) as store:
        return _save_measurement(store, on, shape, fit.quantities(), data, arrays, name)


def add_relation(session: SessionLike, a: str, b: str, name: str = "") -> Measurement:
    """Angles and distances between two points or fits, by their ids. Raises InputError where one is
    neither, is stale, or is in another camera's frame."""
    with opened(session, write=True) as store:
        first, second = (load_measurement(store, each) for each in (a, b))
        if a == b:
            raise InputError(f"{first.name} was chosen twice: choose two measurements")
        for each in (first, second):
            if _is_stale(store, each):
                raise InputError(
                    f"{each.name} is stale, what it was measured on has changed: measure it again"
                )
        (one, one_spread), (other, other_spread) = (
            load_feature(store, each) for each in (first, second)
        )
        _check_frames(store, first, second)
        source = (
            first.source if first.source == second.source else f"{first.source}, {second.source}"
        )
        quantities = relation(one, one_spread, other, other_spread)
        model = first.model if first.model == second.model else f"{first.model}, {second.model}"
        return save_measurement(
            store,
            "relation",
            source=source,
            model=model,
            inputs={},
            data={"quantities": quantities, "between": [first.name, second.name]},
            arrays={},
            of=(a, b),
            name=name or f"{first.name} – {second.name}",
        )


def add_section(
    session: SessionLike, on: MeasuredSurface, a: Place, b: Place, name: str = ""
) -> Measurement:
    """Add a section: the surface cut along a line between two picked points, as nearly parallel to
    the camera's viewing direction as possible."""
    ends = [on.picked(place)[0].place for place in (a, b)]
    middle = (ends[0] + ends[1]) / 2
    plane = CutPlane.through(ends[0], ends[1], -middle)
    if on.organised or on.faces is not None:
        vertices, faces = triangulate_surface(on)
    elif on.normals is None:
        raise InputError(f"{on.source} has neither triangles nor normals: merge the scans again")
    else:
        vertices, faces = triangulate_near(on.points, on.normals, plane)
    lines = section(vertices, faces, plane)
    heights = np.concatenate(lines)
    quantities = [
        Quantity("length along", float(np.ptp(heights[:, 0])), "mm"),
        Quantity("height range", float(np.ptp(heights[:, 1])), "mm"),
    ]
    data = {"at": [a, b], "plane": plane}
    arrays = {
        "lines": np.concatenate(lines).astype(np.float32),
        "lengths": np.array([len(line) for line in lines], np.int32),
    }
    with opened(session, write=True) as store:
        return _save_measurement(store, on, "section", quantities, data, arrays, name)


def section_lines(session: SessionLike, identity: str) -> tuple[CutPlane, list[np.ndarray]]:
    """Load the plane of a saved section, and its lines (k, 2) mm: along, and up."""
    with opened(session) as store:
        measured = load_measurement(store, identity)
        if measured.kind != "section":
            raise InputError(
                f"{measured.name} is a {measured.kind}, not a section: choose a section"
            )
        arrays = measurement_arrays(store, identity)
    lines = np.split(arrays["lines"].astype(np.float64), np.cumsum(arrays["lengths"])[:-1])
    return from_plain(measured.data["plane"], CutPlane), lines


def load_measurements(session: SessionLike) -> list[Measurement]:
    """Load all measurements, in the order in which they were made; stale where their inputs have
    changed."""
    with opened(session) as store:
        return [replace(each, stale=_is_stale(store, each)) for each in list_measurements(store)]


def describe_measurement(measured: Measurement) -> str:
    """A measurement as one line of text."""
    mark = "  [stale: measured on what has since changed]" if measured.stale else ""
    read = "; ".join(quantity.text() for quantity in measured.quantities)
    return f"{measured.id:<4} {measured.name} ({measured.kind} on {measured.source}): {read}{mark}"


def measurements_csv(session: SessionLike) -> str:
    """All measurements as comma-separated values, one row a quantity; U where it is known."""
    rows: list[Iterable[object]] = [COLUMNS]
    for each in load_measurements(session):
        for q in each.quantities:
            U = "" if q.U is None else f"{q.U:.6g}"
            whole = "" if q.U is None else ("yes" if q.whole else "no")
            state = "stale" if each.stale else "fresh"
            rows.append(
                [
                    each.id,
                    each.name,
                    each.kind,
                    each.source,
                    q.name,
                    f"{q.value:.6f}",
                    q.unit,
                    U,
                    whole,
                    state,
                    each.time,
                ]
            )
    return format_csv(rows)


def export_measurements(session: SessionLike, out: Path | str) -> int:
    """Write ``measurements_csv`` to a file; returns how many measurements it holds."""
    out = Path(out)
    if out.suffix.lower() != ".csv":
        raise InputError(f"{out.name} is no table: end its name in .csv")
    with opened(session) as store:
        replace_file(out.absolute(), measurements_csv(store).encode("utf-8-sig"))
        return len(list_measurements(store))


def triangulate_surface(on: MeasuredSurface) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (n, 3) float64 and faces (m, 3) of a surface; a scan's end where its depth jumps."""
    if on.faces is not None:
        return np.asarray(on.points, np.float64), on.faces
    if not on.organised:
        raise InputError(f"{on.source} is a cloud without triangles: mesh it first")
    faces = triangulate_grid(on.points, JUMP * float(np.median(on.points[..., 2][on.measured])))
    return on.points[on.measured].astype(np.float64), faces


def load_feature(store: Session, measured: Measurement) -> tuple[Feature, Spread]:
    """Load the point, plane, sphere or cylinder of a measurement, and its uncertainty."""
    if measured.kind not in ("point", "plane", "sphere", "cylinder"):
        raise InputError(
            f"{measured.name} is a {measured.kind}: choose a point, plane, sphere or cylinder"
        )
    shared = measurement_arrays(store, measured.id).get("shared")
    shared = None if shared is None else shared.astype(np.float64)
    record = measured.data if measured.kind == "point" else measured.data["fit"]
    return from_plain(record["feature"], Feature), Spread(
        np.array(record["scatter"]), shared, record["calibration"]
    )


def _save_measurement(
    store: Session,
    on: MeasuredSurface,
    kind: str,
    quantities: list[Quantity],
    data: dict[str, Any],
    arrays: dict[str, np.ndarray],
    name: str,
) -> Measurement:
    """Save a measurement on a surface with its quantities, data and arrays, and the hashes of its
    inputs."""
    return save_measurement(
        store,
        kind,
        source=on.source,
        model=on.model,
        inputs=on.inputs,
        data={"quantities": quantities, **data, "scale": on.scale},
        arrays=arrays,
        name=name,
    )


def _is_stale(store: Session, measured: Measurement) -> bool:
    """Whether the inputs changed, or a correction of scale was applied or removed since."""
    if measured.stale:
        return True
    if measured.of:
        return any(_is_stale(store, load_measurement(store, each)) for each in measured.of)
    used = measured.data.get("scale")
    return used is not None and scale_factor(store, measured.model) != used


def _check_frames(store: Session, a: Measurement, b: Measurement) -> None:
    """Two scans are in one frame only while camera and calibration are the same; a merged surface
    has its own."""
    if a.source == b.source:
        return
    captures = set(store.capture_names())
    if a.model != b.model or not {a.source, b.source} <= captures:
        raise InputError(
            f"{a.name} was measured on {a.source} with {a.model}, {b.name} on {b.source} with"
            f" {b.model}: they do not lie in one frame; measure both on one surface"
        )
