"""A scan against a nominal model: aligned, compared, judged."""

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, ClassVar

import numpy as np

from slviewer.errors import InputError, UsageError
from slviewer.geometry.vectors import subsample
from slviewer.inputs import Input
from slviewer.inspection.deviation import (
    Deviation,
    colour_limit,
    deviation,
    deviation_colours,
)
from slviewer.inspection.exclusion import NOISE
from slviewer.inspection.tolerance import judge_deviation
from slviewer.inspection.wrong_part import SAMPLES, explain_misfit
from slviewer.pipeline.measure import (
    LoadSurface,
    MeasuredSurface,
    load_surface,
    provenance,
    triangulate_surface,
)
from slviewer.pipeline.models import ModelName
from slviewer.pipeline.operation import Found, Job, operation, placed_file, stage
from slviewer.records.measurement import (
    LEAST_AREA,
    DeviationStatistics,
    Measurement,
    NominalDeviation,
    NominalModel,
    ToleranceVerdict,
)
from slviewer.records.record import to_matrix, to_vector
from slviewer.session.nominal import NOMINALS, Nominal, check_size, read_nominal
from slviewer.session.ply import write_ply
from slviewer.session.units import Units

MAX_STORED_POINTS = 120_000
"""Points that a session keeps of a deviation, for pictures of it; the figures are of all."""
LIKELY_COVERAGE, MANY_UNMATCHED = 0.05, 0.2


@dataclass(frozen=True)
class CompareSettings:
    """What a scan is compared with.

    Args:
        scan: Name of the capture, or merge/1 and the like for a merge of the session.
        nominal: STL, PLY, OBJ, STEP or 3MF file of the part as it should be.
        tolerance: Plus and minus, mm; the answer is pass, fail, or too close to tell.
        min_area: Percent of the area that the views can see which have to be measured for an
            answer; with less it is undecided.
        units: What the file's numbers are; required where its size does not fit the scan's. STEP
            and 3MF state theirs.
        reach: Points farther than this from the nominal, mm, do not count in the best fit, and are
            deviations unless they stand beside the part; by default 2 % of the nominal's diagonal.
        out: PLY file, the deviation as a scalar and as colours; by default in the session's
            exports.
        model: Which calibration to use; by default the best one available.
        accept_rejected: Use the calibration although its verdict rejects it.

    Python alone: ``content``, the hash that the nominal model must have; ``load`` returns the
    surface where it is at hand.
    """

    UNRECORDED: ClassVar = ("out", "load")
    scan: str
    nominal: Path | str
    tolerance: Annotated[float | None, Input(0, 1000, "mm", "Tolerance ±", 0.01)] = None
    min_area: Annotated[float, Input(0, 100, "%")] = LEAST_AREA
    units: Units | None = None
    reach: Annotated[float | None, Input(1e-6, 1e6, "mm")] = None
    out: Path | str | None = None
    model: ModelName | None = None
    accept_rejected: bool = False
    content: str = ""
    load: LoadSurface | None = None

    def __post_init__(self) -> None:
        if self.out is not None and Path(self.out).suffix.lower() != ".ply":
            raise UsageError(
                f"coloured points are written as .ply, not as {Path(self.out).name}",
                "end its name so",
            )


@operation("compare", Measurement, CompareSettings)
def compare(job: Job, settings: CompareSettings) -> Iterator[Found[Measurement]]:
    """Compare a scan with a nominal model after best-fit alignment: figures, coloured points,
    pictures in the report.

    The session stores the result as a measurement. Ends with status 1 where a tolerance is exceeded
    or that is undecided.
    """
    store = job.store
    path = Path(settings.nominal)
    if path.parts[:1] == (NOMINALS,) and (store.folder / path).is_file():
        path = store.folder / path  # the session's own, as nominal/part.stl
    nominal = read_nominal(path, settings.units)  # a wrong file is refused before minutes of work
    if settings.content not in ("", nominal.hash):
        raise InputError(f"{path.name} is not the nominal model that it was: it has changed since")
    for note in nominal.notes:
        job.warn(f"{nominal.name}: {note}")
    on = load_surface(job.part(0.0, 0.4), settings.scan, settings.model, load=settings.load)
    aligning = stage(job.progress, 0.4, 0.9, "aligning")
    result = fit_to_nominal(on, nominal, settings.reach, aligning)
    if result.turned:
        note = (
            f"{result.turned:,} of {len(nominal.mesh.faces):,} triangles faced away from the scan,"
            " which shows the outside alone: they were turned"
        )
        job.warn(f"{nominal.name}: {note}")
        nominal = replace(nominal, notes=(*nominal.notes, note))
    if result.coverage < LIKELY_COVERAGE:
        job.warn(
            f"only {100 * result.coverage:.1f} % of {nominal.name} were measured: see that it is"
            " the same part"
        )
    if (share := float(result.is_unmatched.mean())) > MANY_UNMATCHED:
        job.warn(
            f"{100 * share:.0f} % of the points lie farther than {result.reach_mm:.3g} mm from"
            f" {nominal.name} or face another way: see that it is the same part"
        )
    towards = np.nan_to_num(result.normals.astype(np.float64))
    verdict = None
    if settings.tolerance is not None:
        noise, whole = on.sigma_along(towards), on.sigma_along(towards, whole=True)
        common = np.sqrt(np.maximum(whole**2 - noise**2, 0.0))
        verdict = judge_deviation(result, noise, settings.tolerance, settings.min_area, common)
        if verdict.decision != "pass":
            job.progress(0.9, "trying the mirror image and other sizes")
            verdict = verdict.of_other_part(_explain_misfit(on, nominal, result, verdict))
    described = _describe(nominal, result, on.sigma_along(towards), verdict)
    place, folder = path.expanduser().absolute(), store.folder.absolute()
    recorded = place.relative_to(folder) if place.is_relative_to(folder) else place
    used = replace(
        settings,
        nominal=recorded.as_posix(),
        content=nominal.hash,
        model=on.model,  # type: ignore[arg-type]
    )
    record = Measurement(
        what="deviation",
        name=f"{on.source} against {nominal.name}",
        **provenance(on),
        quantities=described.quantities(),
        deviation=described,
        warnings=on.errors.warnings,
    )
    job.progress(0.92, "writing")
    compared = (settings.scan, Path(nominal.name).stem)
    valid = (re.sub(r"[^A-Za-z0-9_-]", "-", each)[:60] for each in compared)  # on every system
    file_name = f"{'_'.join(valid)}_deviation.ply"
    with placed_file(store, settings.out, file_name) as (place, written):
        _write_points(written, on, result, nominal, settings.tolerance)
        note = f"coloured points -> {place}"
        arrays = _list_arrays(on.points[on.measured], result)
        yield Found("", record, arrays, (place,), (note,), settings=used)
    job.progress(1.0, "compared")


def fit_to_nominal(
    surface: MeasuredSurface,
    nominal: Nominal,
    reach_mm: float | None = None,
    progress: Callable[[float], None] | None = None,
) -> Deviation:
    """Align a surface by the best fit to the nominal model; ``reach_mm`` as in `deviation`. Raises
    SlviewerError where that cannot be trusted."""
    measured, normals = surface.measured, surface.normals
    points, sigma = surface.points[measured].astype(np.float64), surface.sigma_mm[measured]
    check_size(nominal, points)
    return deviation(
        points,
        nominal.mesh,
        normals=None if normals is None else normals[measured].astype(np.float64),
        sigma_mm=float(np.nanmedian(sigma)) if np.isfinite(sigma).any() else None,
        reach_mm=reach_mm,
        views=surface.views if surface.model else None,
        progress=progress,
    )


def _explain_misfit(
    surface: MeasuredSurface, nominal: Nominal, result: Deviation, verdict: ToleranceVerdict
) -> str:
    """Return what other part the scan shows, in words; empty where it is the nominal one."""
    some = subsample(np.flatnonzero(surface.measured)[result.counted], SAMPLES)
    return explain_misfit(
        surface.points.reshape(-1, 3)[some].astype(np.float64),
        None if surface.normals is None else surface.normals.reshape(-1, 3)[some],
        nominal.mesh,
        result.T_nominal_scan,
        max(verdict.tolerance_mm, NOISE * result.noise_mm),
        bool(surface.model),
    )


def _describe(
    nominal: Nominal, result: Deviation, sigma_mm: np.ndarray, verdict: ToleranceVerdict | None
) -> NominalDeviation:
    """Return the figures of a deviation; ``sigma_mm`` (n,): the noise of the points along the
    nominal's normals."""
    noise = sigma_mm[result.counted]
    return NominalDeviation(
        nominal=NominalModel(
            nominal.name,
            nominal.hash,
            nominal.units or "mm",
            len(nominal.mesh.faces),
            to_vector(nominal.size_mm),
            nominal.closed,
            tuple(nominal.notes),
        ),
        statistics_mm=DeviationStatistics(**result.statistics()),  # type: ignore[arg-type]
        noise_mm=float(np.sqrt(np.nanmean(noise**2))) if np.isfinite(noise).any() else None,
        reach_mm=result.reach_mm,
        coverage=result.coverage,
        alignment_mm=result.alignment_mm,
        T_nominal_scan=to_matrix(result.T_nominal_scan),
        verdict=verdict,
        excluded=result.excluded,
    )


def _write_points(
    ply: Path, on: MeasuredSurface, result: Deviation, nominal: Nominal, tolerance: float | None
) -> None:
    """The points that belong to the nominal, with their deviation as a scalar and as colours, and
    the triangles between them where there are any."""
    counted = result.counted
    signed = result.signed[counted]
    limit = colour_limit(signed, tolerance)
    faces = None
    if on.organised or on.faces is not None:
        _, every = triangulate_surface(on)
        number = np.cumsum(counted) - 1
        faces = number[every[counted[every].all(axis=1)]]
    write_ply(
        ply,
        on.points[on.measured][counted],
        colours=deviation_colours(signed, limit),
        normals=None if on.normals is None else on.normals[on.measured][counted],
        scalars={"deviation": signed.astype(np.float32)},
        faces=faces,
        notes=[
            f"{on.source} against {nominal.name}",
            f"colours from {-limit:.4g} to {limit:.4g} mm",
        ],
    )


def _list_arrays(points: np.ndarray, result: Deviation) -> dict[str, np.ndarray]:
    """Return the arrays of a comparison: each point's deviation, thinned, and the histogram of
    all."""
    edges, counts = result.histogram()
    counted = np.flatnonzero(result.counted)
    stored = counted[:: -(-len(counted) // MAX_STORED_POINTS)]
    return {
        "points": points[stored].astype(np.float32),
        "normals": result.normals[stored],
        "signed": result.signed[stored],
        "uncovered": result.uncovered,
        "edges": edges,
        "counts": counts,
    }
