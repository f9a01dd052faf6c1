"""Measuring on a scan or a merge: points, distances, sections, fitted shapes."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from typing import Any, ClassVar, Literal, NoReturn

import numpy as np

from slviewer.errors import InputError, UsageError
from slviewer.inspection.features import distance
from slviewer.inspection.fitting import fit_feature
from slviewer.inspection.regions import Region
from slviewer.inspection.section import CutPlane, section, triangulate_near
from slviewer.inspection.uncertainty import Spread
from slviewer.pipeline.measured_surface import (
    MERGED,
    LoadSurface,
    MeasuredSurface,
    Place,
    load_surface,
    triangulate_surface,
)
from slviewer.pipeline.models import ModelName, available_models
from slviewer.pipeline.operation import Found, Job, operation
from slviewer.pipeline.stored_records import next_name
from slviewer.records.measurement import (
    MeasuredFeature,
    MeasuredRegion,
    Measurement,
    Quantity,
    SectionPlane,
)
from slviewer.records.plain import from_plain, to_plain
from slviewer.records.record import to_vector
from slviewer.session.names import clean_label
from slviewer.session.store import Session

What = Literal["point", "distance", "section", "plane", "sphere", "cylinder"]
FITTED = ("plane", "sphere", "cylinder")
MAX_RMS_TO_NOISE = 5.0
"""Times the points' noise: a fit with a larger RMS gets a warning."""
Measured = tuple[dict[str, Any], dict[str, np.ndarray]]
"""Fields of a measurement, and its arrays."""


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
    are given in; ``load`` returns the surface where it is at hand.
    """

    UNRECORDED: ClassVar = ("name", "load")
    scan: str
    what: What
    at: Sequence[int] = ()
    ball: Sequence[float] = ()
    box: Sequence[float] = ()
    name: str = ""
    model: ModelName | None = None
    roi: str = ""
    accept_rejected: bool = False
    axes: Sequence[Sequence[float]] = ()
    load: LoadSurface | None = None

    def __post_init__(self) -> None:
        if self.what in FITTED and (len(self.ball), len(self.box)) not in ((4, 0), (0, 6)):
            raise UsageError(
                f"a {self.what} needs its region: give --ball x y z radius, or --box x y z x y z,"
                " in mm"
            )
        if self.what not in FITTED and len(self.at) not in (self.ends, 2 * self.ends):
            self._raise_place_error("pixel u v")

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
            self._raise_place_error("pixel u v" if on.organised else "index")
        return list(zip(at[::2], at[1::2], strict=True)) if on.organised else list(at)

    def _raise_place_error(self, which: str) -> NoReturn:
        """Raise UsageError: the option --at does not have one place for each end of what is
        measured."""
        example = " ".join(
            (("180 150", "220 150") if which == "pixel u v" else ("1200", "3400"))[: self.ends]
        )
        raise UsageError(
            f"a {self.what} needs --at with the {which} of"
            f" {'its point' if self.ends == 1 else 'both its ends'}, such as --at {example}"
        )


@operation("measure", Measurement, MeasureSettings)
def measure(job: Job, settings: MeasureSettings) -> Iterator[Found[Measurement]]:
    """Measure on a scan: a distance between points, a section, a shape fitted to a region; the
    session stores it."""
    if settings.load is not None:
        on = settings.load(job.store)
    else:
        on = load_surface(
            job.store,
            settings.scan,
            model=settings.model,
            roi=settings.roi,
            accept_rejected=settings.accept_rejected,
            progress=job.progress,
            warn=job.warn,
        )
    if settings.what in FITTED:
        fields, arrays = _fit(on, settings)
    else:
        makers = {"point": _pick, "distance": _measure_distance, "section": _cut}
        fields, arrays = makers[settings.what](on, settings.places(on))
    record = Measurement(
        what=settings.what,
        name=clean_label(settings.name),
        **provenance(on),
        **fields,
    )
    yield Found(
        next_name(job.store, Measurement),
        record,
        arrays,
        notes=uncertainty_notes(job.store, record),
        settings=replace(settings, model=on.model),  # type: ignore[arg-type]
    )
    job.progress(1.0, "measured")


def provenance(on: MeasuredSurface) -> dict[str, Any]:
    """Return what a measurement states of the surface that it was made on, and its time."""
    return {
        "source": on.source,
        "model": on.model,
        "time": datetime.now(UTC).isoformat(timespec="seconds"),
        "inputs": dict(on.inputs),
        "scales": {on.model: on.scale} if on.model else {},
    }


def uncertainty_notes(store: Session, measured: Measurement) -> tuple[str, ...]:
    """Return what the uncertainty of a measurement lacks, with the remedy; nothing where it is
    whole."""
    if all(quantity.whole for quantity in measured.quantities):
        return ()
    cause = "the model " + " or ".join(
        each for each in measured.model.split(", ") if each != "splined"
    )
    if any(source.startswith(MERGED) for source in measured.source.split(", ")):
        cause, remedy = (
            "a merge",
            "measure on one of its scans with the splined model (--model splined)",
        )
    elif "splined" in available_models(store):
        remedy = "measure with the splined model (--model splined)"
    else:
        remedy = (
            "calibrate with the splined model, which takes eight poses or more, and measure with it"
        )
    return (f"U is too small, as {cause} does not know the calibration's part: {remedy}",)


def _pick(on: MeasuredSurface, places: Sequence[Place]) -> Measured:
    """A picked point, to relate it with fits."""
    feature, spread = on.picked(places[0])
    quantities = [
        Quantity(axis, float(value), "mm") for axis, value in zip("xyz", feature.place, strict=True)
    ]
    return {"quantities": quantities, "feature": _to_record(feature, spread)}, _shared_arrays(
        spread
    )


def _measure_distance(on: MeasuredSurface, places: Sequence[Place]) -> Measured:
    """The distance between two picked points."""
    (first, first_spread), (second, second_spread) = (on.picked(place) for place in places)
    length = distance(first.place, second.place, first_spread, second_spread)
    return {"quantities": [length], "ends": (to_vector(first.place), to_vector(second.place))}, {}


def _fit(on: MeasuredSurface, settings: MeasureSettings) -> Measured:
    """A plane, sphere or cylinder fitted to a region. Raises InputError where the region has
    none."""
    region = settings.region()
    fit = fit_feature(settings.what, on.within(region), on.shared, on.calibration)  # type: ignore[arg-type]
    noise, warnings = on.noise(region), list(fit.warnings)
    if fit.rms > MAX_RMS_TO_NOISE * noise:
        warnings.append(
            f"points lie {fit.rms:.3g} mm (RMS) off the {settings.what}, and their noise is"
            f" {noise:.2g} mm: see what it shows"
        )
    fields = {
        "quantities": fit.quantities(),
        "feature": _to_record(fit.feature, fit.spread),
        "region": from_plain(to_plain(region), MeasuredRegion),
        "where": f"{region.text()}: {fit.used:,} used, {fit.left_out:,} excluded",
        "warnings": tuple(warnings),
    }
    return fields, _shared_arrays(fit.spread)


def _cut(on: MeasuredSurface, places: Sequence[Place]) -> Measured:
    """A section: the surface cut along a line between two picked points, as nearly parallel to the
    camera's viewing direction as possible."""
    first, second = (on.picked(place)[0].place for place in places)
    plane = CutPlane.through(first, second, -(first + second) / 2)
    if on.organised or on.faces is not None:
        vertices, faces = triangulate_surface(on)
    elif on.normals is None:
        raise InputError(f"{on.source} has neither triangles nor normals: merge the scans again")
    else:
        vertices, faces = triangulate_near(on.points, on.normals, plane)
    lines = section(vertices, faces, plane)
    drawn = np.concatenate(lines)
    quantities = [
        Quantity("length along", float(np.ptp(drawn[:, 0])), "mm"),
        Quantity("height range", float(np.ptp(drawn[:, 1])), "mm"),
    ]
    lengths = np.array([len(line) for line in lines], np.int32)
    fields = {"quantities": quantities, "plane": from_plain(to_plain(plane), SectionPlane)}
    return fields, {"lines": drawn.astype(np.float32), "lengths": lengths}


def _to_record(feature: Any, spread: Spread) -> MeasuredFeature:
    """Return a feature and its own part of its uncertainty as a measurement holds them."""
    own = {"scatter": spread.scatter.tolist(), "calibration": spread.calibration}
    return from_plain(to_plain(feature) | own, MeasuredFeature)


def _shared_arrays(spread: Spread) -> dict[str, np.ndarray]:
    """Return the part of an uncertainty that fits of one calibration share, as an array of a
    measurement."""
    return {} if spread.shared is None else {"shared": spread.shared.astype(np.float32)}
