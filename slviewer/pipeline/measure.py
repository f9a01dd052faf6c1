"""The surface of a scan or of a merge to measure on, with all that is known of its errors; and
measuring on it: points, distances, sections, fitted shapes, and the relations between them. The
measurements of a session are listed, renamed, deleted and written as CSV."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import numpy as np

from slviewer.calibration.splined.model import SplinedModel
from slviewer.errors import InputError, UsageError
from slviewer.geometry.rigid import move_points
from slviewer.geometry.vectors import finite_rows
from slviewer.inputs import Input
from slviewer.inspection.features import KINDS, Feature, distance, relation
from slviewer.inspection.fitting import NO_ERRORS, fit_feature
from slviewer.inspection.regions import Region
from slviewer.inspection.section import CutPlane, section, triangulate_near
from slviewer.inspection.uncertainty import PointErrors, Spread, splined_shared
from slviewer.pipeline.cloud_corrections import load_scale_correction
from slviewer.pipeline.imported_calibration import check_calibration
from slviewer.pipeline.models import (
    ModelName,
    available_models,
    device_centres,
    load_model,
    load_stereo,
    preferred_model,
)
from slviewer.pipeline.operation import (
    OPERATIONS,
    Found,
    Job,
    SessionLike,
    Stored,
    Warn,
    ignore_warnings,
    list_records,
    load_arrays,
    load_stored,
    opened,
    operation,
)
from slviewer.pipeline.reconstruct import read_merge, scan_cloud
from slviewer.printable import format_csv
from slviewer.reconstruction.cloud import Cloud
from slviewer.reconstruction.reconstruct import normals, triangulate_grid
from slviewer.reconstruction.rig_change import PointResponse
from slviewer.records.measurement import (
    MeasuredFeature,
    MeasuredRegion,
    Measurement,
    Quantity,
    SectionPlane,
)
from slviewer.records.record import from_plain, to_plain, to_vector
from slviewer.session.atomic import replace_file
from slviewer.session.names import clean_label
from slviewer.session.scan_edits import restriction_inputs
from slviewer.session.store import Session
from slviewer.surface.unorganised import point_set

MERGED = "merge/"
"""Beginning of the name of a stored merge; its number follows, for meshes nothing for the last."""
Place = tuple[int, int] | int
"""A point of a surface: pixel (u, v) of a scan, or the index of a merged surface's point."""


@dataclass(frozen=True, eq=False)
class MeasuredSurface:
    """Points (h, w, 3) of a scan, or (n, 3) of a merged surface, mm, NaN where not measured.

    ``sigma_mm`` like them without the last axis: of z, along the camera's ray, for a scan; along
    ``normals`` for a merged surface; ``left_mm`` likewise: standard deviation from the calibration
    and a misfit of the axes. ``faces`` (m, 3): of a merged mesh. ``source`` is the capture or
    result that it came from, ``model`` the calibration, ``inputs`` the hashes of both; ``errors``:
    those that the points share, by the hash of the calibration. ``views``: of each scan the centres
    (2, 3) mm of camera and projector. Each where known.
    """

    points: np.ndarray
    sigma_mm: np.ndarray
    source: str
    model: str
    inputs: Mapping[str, str]
    left_mm: np.ndarray | None = None
    normals: np.ndarray | None = None
    faces: np.ndarray | None = None
    errors: PointErrors = NO_ERRORS
    texture: np.ndarray | None = None
    scale: float = 1.0
    views: Sequence[np.ndarray] = ()

    @property
    def organised(self) -> bool:
        """Whether it is a scan, pixel by pixel."""
        return self.points.ndim == 3

    @property
    def measured(self) -> np.ndarray:
        """Mask of the measured points, (h, w) or (n,) bool."""
        return finite_rows(self.points)

    def within(self, region: Region) -> np.ndarray:
        """(n, 3) float64: the points of a region."""
        return np.asarray(self.points[region.within(self.points)], np.float64)

    def picked(self, place: Place) -> tuple[Feature, Spread]:
        """The point at a pixel or index, and its uncertainty. Raises InputError without one."""
        if self.organised != isinstance(place, tuple):
            raise InputError(
                f"{place} is not a place on {self.source}",
                f"give {'pixel (u, v)' if self.organised else 'an index'}",
            )
        index = place[::-1] if isinstance(place, tuple) else (place,)
        if not all(0 <= i < n for i, n in zip(index, self.points.shape, strict=False)):
            raise InputError(f"{place} lies outside {self.source}", "pick a point of it")
        point = np.asarray(self.points[index], np.float64)
        if not np.isfinite(point).all():
            raise InputError(f"nothing was measured at {place} of {self.source}", "pick another")
        away, sigma = np.zeros(3), float(np.nan_to_num(self.sigma_mm[index]))
        if self.organised:
            away = sigma * point / point[2]
        elif self.normals is not None:
            away = sigma * np.asarray(self.normals[index], np.float64)
        raised, own = self.errors.raised, np.outer(away, away)
        shared = None if raised is None else raised(point[None], np.eye(3)[:, None])
        return Feature("point", point), Spread(own, shared, self.errors.calibration)

    def sigma_along(self, normals: np.ndarray, whole: bool = False) -> np.ndarray:
        """(n,) mm: standard deviation of the measured points along unit normals (n, 3), of noise
        alone, or on the ``whole``, with what the calibration leaves uncertain."""
        sigma = self.sigma_mm[self.measured].astype(np.float64)
        if whole and self.left_mm is not None:
            sigma = np.hypot(sigma, self.left_mm[self.measured])
        if not self.organised:
            return sigma
        points = self.points[self.measured].astype(np.float64)
        return sigma * np.abs(np.sum(points / points[:, 2:] * normals, axis=1))


LoadSurface = Callable[[Session], MeasuredSurface]
"""Returns a surface of a session that is at hand already."""


def triangulate_surface(on: MeasuredSurface) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (n, 3) float64 and faces (m, 3) of a surface; a scan's end where its depth jumps."""
    if on.faces is not None:
        return np.asarray(on.points, np.float64), on.faces
    if not on.organised:
        raise InputError(f"{on.source} is a cloud without triangles", "mesh it first")
    return on.points[on.measured].astype(np.float64), triangulate_grid(on.points)


def load_surface(
    job: Job,
    scan: str,
    model: str | None = None,
    roi: str = "",
    load: LoadSurface | None = None,
) -> MeasuredSurface:
    """Reconstruct a capture to measure on it, or read a stored merge, named ``merge/<number>``;
    ``roi`` as in `resolve_region`, for captures alone. ``load`` returns a surface that is at
    hand."""
    store = job.store
    if load is not None:
        return load(store)
    if scan.startswith(MERGED):
        return load_merged_surface(store, scan, job.warn, roi)
    if not store.load_capture(scan).is_imported_cloud:
        check_calibration(job)
        model = model or preferred_model(store)
    cloud = scan_cloud(job, scan, model, roi)
    job.progress(1.0, "reconstructed")
    return surface_from_cloud(store, scan, cloud, with_region=not roi)


def surface_from_cloud(
    store: Session, scan: str, cloud: Cloud, *, with_region: bool = True
) -> MeasuredSurface:
    """A capture's cloud as a surface to measure on; ``with_region``: whether it was cut by the
    session's region, where that is in effect."""
    if cloud.normals is not None:
        on, used = point_set(cloud), restriction_inputs(store, [scan], with_region=with_region)
        known: dict[str, Any] = {"normals": on.normals, "texture": on.colours}
        known |= {"sigma_mm": on.sigma_mm, "inputs": store.input_hashes(scan) | used}
        return MeasuredSurface(on.points, source=scan, model="", **known)
    fitted = load_model(store, cloud.model)
    calibration, scale, sigma = f"calibration/{fitted.name}", 1.0, 0.0
    names = [scan, calibration]
    if (applied := load_scale_correction(store, fitted.name)) is not None:
        names.append(f"scale/{fitted.name}")
        scale, sigma = float(applied["factor"]), 1e-6 * float(applied["U_ppm"]) / 2
    inputs = store.input_hashes(*names) | restriction_inputs(store, [scan], with_region=with_region)
    shared, rig = None, fitted if isinstance(fitted, SplinedModel) else load_stereo(store)
    if isinstance(fitted, SplinedModel):
        shared = splined_shared(fitted.bundle, cloud.axis, scale, sigma)
    response = PointResponse.from_cloud(cloud, rig.pinholes, rig.residual_px, scale)
    return MeasuredSurface(
        cloud.points, cloud.sigma_z, scan, fitted.name, inputs,
        left_mm=cloud.sigma_calibration if cloud.misfit is None else cloud.sigma_systematic,
        normals=normals(cloud.points),
        errors=PointErrors(shared, "" if shared is None else inputs[calibration], response),
        texture=cloud.texture, scale=scale, views=device_centres(store),
    )  # fmt: skip


def load_merged_surface(
    store: Session, merge: str, warn: Warn = ignore_warnings, roi: str = ""
) -> MeasuredSurface:
    """A stored merge, in the frame of its reference's camera; ``roi`` as in `read_merge`."""
    record, points = read_merge(store, merge, warn, roi)
    sigma = points.scalars.get("sigma", np.full(len(points.points), np.nan, np.float32))
    return MeasuredSurface(
        points.points, sigma, merge, record.model, store.input_hashes(merge),
        normals=points.normals, faces=points.faces, texture=points.colours,
        scale=record.scales.get(record.model, 1.0),
        views=[
            move_points(T, view) for view in device_centres(store) for T in record.poses.values()
        ],
    )  # fmt: skip


What = Literal["point", "distance", "section", "plane", "sphere", "cylinder"]
FITTED = ("plane", "sphere", "cylinder")
MAX_RMS_TO_NOISE = 5.0
"""Times the points' noise: a larger RMS gets a warning where nothing else is known."""
Measured = tuple[dict[str, Any], dict[str, np.ndarray]]
"""Fields of a measurement, and its arrays."""
COLUMNS = (
    "id", "name", "kind", "scan", "quantity", "value", "unit", "U (k = 2)", "calibration in U",
    "state", "time",
)  # fmt: skip
_FOLDER = f"{Measurement.kind}/"


@dataclass(frozen=True)
class MeasureSettings:
    """What is measured, and where.

    Args:
        scan: Name of the capture, or merge/1 and the like for a merge of the session.
        what: point, distance and section take --at; plane, sphere and cylinder take --ball or
            --box.
        at: Pixel u v (column, row of the camera's picture) of the point, or u v u v of both ends of
            the distance or section; for a merge the points' numbers in its file, from 0.
        ball: The region to fit to: centre x y z and radius, mm, in the camera's frame (x right, y
            down, z away). All points within this radius of the centre: for a sphere, a little more
            than its own radius.
        box: The region to fit to: two corners x y z x y z, mm, in the camera's frame.
        name: What to call it.
        model: Which calibration to use; by default the best one available.
        roi: Region of interest, outside of which points are ignored: x0,x1,y0,y1,z0,z1 in mm in the
            camera's frame (x right, y down, z away), a TOML file, or off; by default the session's.
            A merge was cut when it was made.
        accept_rejected: Use the calibration although its verdict rejects it.

    Python alone: ``axes``, three unit vectors that the sides of the box lie along, and its corners
    are given in; ``load`` returns the surface where it is at hand; ``replaces``: the measurement
    whose place it takes.
    """

    UNRECORDED: ClassVar = ("name", "load", "replaces")
    scan: str
    what: What
    at: Annotated[Sequence[int], Input(0)] = ()
    ball: Sequence[float] = ()
    box: Sequence[float] = ()
    name: str = ""
    model: ModelName | None = None
    roi: str = ""
    accept_rejected: bool = False
    axes: Sequence[Sequence[float]] = ()
    load: LoadSurface | None = None
    replaces: str = ""

    def __post_init__(self) -> None:
        if self.what in FITTED and (len(self.ball), len(self.box)) not in ((4, 0), (0, 6)):
            raise UsageError(
                f"a {self.what} needs its region",
                "give --ball x y z radius, or --box x y z x y z, in mm",
            )
        if self.what not in FITTED and len(self.at) not in (self.ends, 2 * self.ends):
            raise self._place_error(organised=True)

    @property
    def ends(self) -> int:
        """How many places it is measured at."""
        return 1 if self.what == "point" else 2

    def region(self) -> Region:
        """Return the region to fit to."""
        if self.ball:
            return Region.ball(self.ball[:3], self.ball[3])
        return Region.box(
            self.box[:3], self.box[3:], np.array(self.axes) if len(self.axes) else None
        )

    def places(self, on: MeasuredSurface) -> list[Place]:
        """Return the places on a surface; UsageError where there are too few or too many."""
        at = [int(number) for number in self.at]
        if len(at) != self.ends * (2 if on.organised else 1):
            raise self._place_error(on.organised)
        return list(zip(at[::2], at[1::2], strict=True)) if on.organised else list(at)

    def _place_error(self, organised: bool) -> UsageError:
        """Return the error that --at does not have one place for each end of what is measured."""
        which, examples = "index", ["1200", "3400"]
        if organised:
            which, examples = "pixel u v", ["180 150", "220 150"]
        return UsageError(
            f"a {self.what} needs --at with the {which} of"
            f" {'its point' if self.ends == 1 else 'both its ends'}, such as --at"
            f" {' '.join(examples[: self.ends])}"
        )


@operation("measure", Measurement, MeasureSettings)
def measure(job: Job, settings: MeasureSettings) -> Iterator[Found[Measurement]]:
    """Measure on a scan: a distance between points, a section, a shape fitted to a region; the
    session stores it."""
    store = job.store
    on = load_surface(job, settings.scan, settings.model, settings.roi, settings.load)
    makers = {"point": _pick, "distance": _measure_distance, "section": _cut}
    fields, arrays = makers.get(settings.what, _fit)(on, settings)
    fields["warnings"] = (*on.errors.warnings, *fields.get("warnings", ()))
    name = clean_label(settings.name) or next_label(store, settings.what)
    record = Measurement(what=settings.what, name=name, **provenance(on), **fields)
    used = replace(settings, model=on.model)  # type: ignore[arg-type]
    notes = uncertainty_notes(store, record)
    yield Found(settings.replaces, record, arrays, notes=notes, settings=used)
    job.progress(1.0, "measured")


def provenance(on: MeasuredSurface) -> dict[str, Any]:
    """Return what a measurement states of the surface that it was made on."""
    scales = {on.model: on.scale} if on.model else {}
    return {"source": on.source, "model": on.model, "inputs": dict(on.inputs), "scales": scales}


def uncertainty_notes(store: Session, measured: Measurement) -> tuple[str, ...]:
    """Return what the uncertainty of a measurement lacks, with the remedy; nothing if whole."""
    if all(quantity.whole for quantity in measured.quantities):
        return ()
    models = [each for each in measured.model.split(", ") if each != "splined"]
    cause = f"the model {' or '.join(models)}"
    remedy = "measure with the splined model (--model splined)"
    if "" in models:
        cause, remedy = "an imported cloud", "measure an artefact of known size with its scanner"
    elif any(source.startswith(MERGED) for source in measured.source.split(", ")):
        cause = "a merge"
        remedy = "measure on one of its scans with the splined model (--model splined)"
    elif "splined" not in available_models(store):
        remedy = (
            "calibrate with the splined model, which takes eight poses or more, and measure with it"
        )
    return (f"U is too small, as {cause} does not know the calibration's part: {remedy}",)


def _pick(on: MeasuredSurface, settings: MeasureSettings) -> Measured:
    """A picked point, to relate it with fits."""
    feature, spread = on.picked(settings.places(on)[0])
    fields, arrays = _describe_feature(feature, spread)
    at = zip("xyz", feature.place.tolist(), strict=True)
    return fields | {"quantities": [Quantity(*each, "mm") for each in at]}, arrays


def _measure_distance(on: MeasuredSurface, settings: MeasureSettings) -> Measured:
    """The distance between two picked points."""
    (first, first_spread), (second, second_spread) = map(on.picked, settings.places(on))
    length = distance(first.place, second.place, first_spread, second_spread)
    return {"quantities": [length], "ends": (to_vector(first.place), to_vector(second.place))}, {}


def _fit(on: MeasuredSurface, settings: MeasureSettings) -> Measured:
    """A plane, sphere or cylinder fitted to a region. Raises InputError where it has none."""
    region = settings.region()
    kind, points = settings.what, on.within(region)
    fit = fit_feature(kind, points, on.errors)  # type: ignore[arg-type]
    sigma, warnings = on.sigma_mm[region.within(on.points)], list(fit.warnings)
    noise = float(np.nanmedian(sigma)) if np.isfinite(sigma).any() else np.inf  # not known
    if not on.errors.is_predicted and fit.rms > MAX_RMS_TO_NOISE * noise:
        warnings.append(
            f"points lie {fit.rms:.3g} mm (RMS) off the {settings.what}, and their noise is"
            f" {noise:.2g} mm: see what it shows"
        )
    fields, arrays = _describe_feature(fit.feature, fit.spread)
    fields |= {
        "quantities": fit.quantities(),
        "region": from_plain(to_plain(region), MeasuredRegion),
        "where": f"{region.text()}: {fit.used:,} used, {fit.excluded:,} excluded",
        "warnings": tuple(warnings),
    }
    return fields, arrays


def _cut(on: MeasuredSurface, settings: MeasureSettings) -> Measured:
    """A section: the surface cut along a line between two picked points, as nearly parallel to the
    camera's viewing direction as possible."""
    first, second = (on.picked(place)[0].place for place in settings.places(on))
    plane = CutPlane.through(first, second, -(first + second) / 2)
    if on.organised or on.faces is not None:
        vertices, faces = triangulate_surface(on)
    elif on.normals is None:
        raise InputError(f"{on.source} has neither triangles nor normals", "merge the scans again")
    else:
        vertices, faces = triangulate_near(on.points, on.normals, plane)
    lines = section(vertices, faces, plane)
    drawn = np.concatenate(lines)
    along, up = np.ptp(drawn, axis=0).tolist()
    fields = {
        "quantities": [Quantity("length along", along, "mm"), Quantity("height range", up, "mm")],
        "plane": from_plain(to_plain(plane), SectionPlane),
    }
    lengths = np.array([len(line) for line in lines], np.int32)
    return fields, {"lines": drawn.astype(np.float32), "lengths": lengths}


def _describe_feature(feature: Feature, spread: Spread) -> Measured:
    """Return a feature with its own part of its uncertainty; and the part that is shared, as an
    array."""
    own = {"scatter": spread.scatter.tolist(), "calibration": spread.calibration}
    fields = {"feature": from_plain(to_plain(feature) | own, MeasuredFeature)}
    return fields, {} if spread.shared is None else {"shared": spread.shared.astype(np.float32)}


@dataclass(frozen=True)
class RelateSettings:
    """Which measurements are related.

    Args:
        a: A point or a fit, such as m1.
        b: Another one.
    """

    a: str
    b: str


@operation("relate", Measurement, RelateSettings)
def relate(job: Job, settings: RelateSettings) -> Iterator[Found[Measurement]]:
    """Measure the distances and angles between two points or fits.

    Raises InputError where one is neither, is stale, or is in another camera's frame.
    """
    store = job.store
    first, second = (load_stored(store, Measurement, each) for each in (settings.a, settings.b))
    if settings.a == settings.b:
        raise InputError(f"{first.label} was chosen twice", "choose two measurements")
    if stale := [each.label for each in (first, second) if each.stale]:
        raise InputError(
            f"{stale[0]} is stale, what it was measured on has changed", "measure it again"
        )
    features = (*load_feature(store, first), *load_feature(store, second))
    a, b = first.record, second.record
    # scans are in one frame only while camera and calibration are the same; a merge has its own
    scans = {a.source, b.source} <= set(store.capture_names())
    if a.source != b.source and (a.model != b.model or not (a.model and scans)):
        raise InputError(
            f"{first.label} was measured on {a.source} with {a.model}, {second.label} on {b.source}"
            f" with {b.model}",
            "they do not lie in one frame; measure both on one surface",
        )
    record = Measurement(
        what="relation",
        name=f"{first.label} – {second.label}",
        source=", ".join(dict.fromkeys((a.source, b.source))),
        model=", ".join(dict.fromkeys((a.model, b.model))),
        quantities=relation(*features),
        where=f"{first.label} and {second.label}",
        of=(settings.a, settings.b),
        inputs=store.input_hashes(_FOLDER + settings.a, _FOLDER + settings.b),
        scales=a.scales | b.scales,
    )
    yield Found("", record, notes=uncertainty_notes(store, record))


def load_feature(store: Session, measured: Stored[Measurement]) -> tuple[Feature, Spread]:
    """Load the point, plane, sphere or cylinder of a measurement, and its uncertainty."""
    found = measured.record.feature
    if found is None:
        raise InputError(
            f"{measured.label} is a {measured.record.what}", f"choose one of {', '.join(KINDS)}"
        )
    shared = load_arrays(store, _FOLDER + measured.name).get("shared")
    if shared is not None:
        shared = shared.astype(np.float64)
    spread = Spread(np.array(found.scatter), shared, found.calibration)
    return from_plain(to_plain(found), Feature), spread


def section_lines(session: SessionLike, name: str) -> tuple[CutPlane, list[np.ndarray]]:
    """Load the plane of a saved section, and its lines (k, 2) mm: along, and up."""
    with opened(session) as store:
        measured = load_stored(store, Measurement, name)
        if measured.record.plane is None:
            raise InputError(
                f"{measured.label} is a {measured.record.what}, not a section", "choose a section"
            )
        arrays = load_arrays(store, _FOLDER + name)
    lines = np.split(arrays["lines"].astype(np.float64), np.cumsum(arrays["lengths"])[:-1])
    return from_plain(to_plain(measured.record.plane), CutPlane), lines


def describe_measurement(measured: Stored[Measurement]) -> str:
    """A measurement as one line of text."""
    mark = "  [stale: measured on what has since changed]" if measured.stale else ""
    return f"{measured.name:<4} {measured.label}: {measured.record.summary()}{mark}"


def format_measurements(found: Sequence[Stored[Measurement]]) -> str:
    """Return measurements as comma-separated values, one row a quantity; U where it is known."""
    rows: list[Iterable[object]] = [COLUMNS]
    for each in found:
        record, state = each.record, "stale" if each.stale else "fresh"
        for q in record.quantities:
            known = ("", "") if q.U is None else (f"{q.U:.6g}", "yes" if q.whole else "no")
            value = (q.name, f"{q.value:.6f}", q.unit, *known)
            rows.append(
                [each.name, each.label, record.what, record.source, *value, state, record.time]
            )
    return format_csv(rows)


def export_measurements(store: Session, out: Path | str) -> int:
    """Write all measurements to a CSV file; returns how many it holds."""
    out = Path(out)
    if out.suffix.lower() != ".csv":
        raise InputError(f"{out.name} is not a table", "end its name in .csv")
    found = list_records(store, Measurement)
    replace_file(out.absolute(), format_measurements(found).encode("utf-8-sig"))
    return len(found)


def next_label(store: Session, what: str) -> str:
    """Return the first of the names "point 1", "point 2" ... that no measurement has."""
    used = {each.label for each in list_records(store, Measurement)}
    return next(name for name in (f"{what} {n}" for n in count(1)) if name not in used)


def rename_measurement(store: Session, name: str, label: str) -> Stored[Measurement]:
    """Call a measurement otherwise; an empty label restores its original one."""
    load_stored(store, Measurement, name)
    labels = store.decision(Measurement.labels) or {}
    store.decide(Measurement.labels, {**labels, name: clean_label(label)})
    return load_stored(store, Measurement, name)


def trash_measurement(store: Session, name: str) -> None:
    """Move a measurement to the trash; what was made from it becomes stale."""
    load_stored(store, Measurement, name)
    store.trash_result(_FOLDER + name)


def restore_measurement(store: Session) -> Stored[Measurement]:
    """Bring the measurement back that was deleted last. Raises InputError where there is none."""
    deleted = [each for each in store.deleted_results() if each.startswith(_FOLDER)]
    if not deleted:
        raise InputError("no measurement was deleted, so none can be restored", "measure again")
    store.restore_last(deleted[0])
    return load_stored(store, Measurement, deleted[0].removeprefix(_FOLDER))


def edit_measurements(
    session: SessionLike,
    *,
    relate: tuple[str, str] | None = None,
    name: tuple[str, str] | None = None,
    delete: Sequence[str] = (),
    bring_back: bool = False,
    csv: Path | None = None,
    warn: Warn = ignore_warnings,
) -> str:
    """List the measurements that a session holds.

    Args:
        session: Session folder.
        relate: Two of them, such as m1 m2: their distances and angles are measured too.
        name: One of them, and what to call it from now on.
        delete: Some of them, to the trash.
        bring_back: Undo the last deletion.
        csv: Write them all to this table too.
    """
    with opened(session, write=bool(relate or name or delete or bring_back)) as store:
        if relate:
            for note in OPERATIONS["relate"](store, *relate).notes:
                warn(note)
        if name:
            rename_measurement(store, *name)
        for each in delete:
            trash_measurement(store, each)
        if bring_back:
            restore_measurement(store)
        found = list_records(store, Measurement)
        lines = list(map(describe_measurement, found)) or ["nothing was measured yet"]
        if csv is not None:
            lines.append(f"{export_measurements(store, csv)} measurements -> {csv}")
    return "\n".join(lines)
