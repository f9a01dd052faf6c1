"""A scan against a nominal model: aligned, compared, judged, written and saved."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from slviewer.errors import UsageError
from slviewer.evaluation.render import Row, render
from slviewer.inspection.colours import colour_limit, deviation_colours
from slviewer.inspection.deviation import Deviation, deviation
from slviewer.inspection.quantities import Quantity
from slviewer.inspection.tolerance import DECIDED, RULE, ToleranceVerdict, judge_deviation
from slviewer.pipeline.feedback import Progress, Warn, ignore_progress, ignore_warnings, part, stage
from slviewer.pipeline.measured_surface import MeasuredSurface, load_surface
from slviewer.pipeline.measurements import triangulate_surface
from slviewer.pipeline.models import ModelName
from slviewer.pipeline.open_session import SessionLike, opened
from slviewer.records.plain import to_plain
from slviewer.session.measurements import Measurement, save_measurement
from slviewer.session.nominal import Nominal, Units, check_size, read_nominal
from slviewer.session.ply import write_ply
from slviewer.session.store import Session

MAX_STORED_POINTS = 120_000
"""Points that a session keeps of a deviation, for pictures of it; the figures are of all."""
LIKELY_COVERAGE = 0.05
SCALARS = "deviation"


@dataclass(frozen=True, eq=False)
class NominalComparison:
    """A scan against a nominal model: the ``found`` deviation, the ``verdict`` where a tolerance
    was given, the noise that the scan alone has along the nominal's normals (RMS, ``noise_mm``),
    and where it went: ``ply``, and the ``measurement`` that the session keeps."""

    scan: str
    model: str
    nominal: Nominal
    found: Deviation
    verdict: ToleranceVerdict | None
    noise_mm: float
    ply: Path | None
    measurement: Measurement | None

    def to_json(self) -> dict[str, Any]:
        """Return the published values of ``compare --json``."""
        return {
            "scan": self.scan,
            "model": self.model,
            "nominal": {
                "name": self.nominal.name,
                "hash": self.nominal.hash,
                "units": self.nominal.units or "mm",
                "triangles": len(self.nominal.mesh.faces),
                "size_mm": self.nominal.size_mm.tolist(),
                "closed": self.nominal.closed,
                "notes": list(self.nominal.notes),
            },
            "noise_mm": self.noise_mm,
            **self.found.to_json(),
            "tolerance": None if self.verdict is None else to_plain(self.verdict) | {"rule": RULE},
        }

    def text(self) -> str:
        """Return the result as a report for the terminal."""
        numbers = self.found.statistics()
        lines = [f"{self.scan} by {self.model} against {self.nominal.text()}"]
        lines += [f"{self.nominal.name}: {note}" for note in self.nominal.notes]
        lines.append(render(_figure_rows(numbers, self.noise_mm)))
        share = 100 * numbers["left_out"] / (numbers["points"] + numbers["left_out"])
        lines.append(
            f"{numbers['points']:,} points; {numbers['left_out']:,} ({share:.1f} %) lie farther"
            f" than {self.found.reach_mm:.3g} mm from the nominal or face another way, and are"
            " excluded"
        )
        lines.append(
            f"{100 * self.found.coverage:.1f} % of the nominal's area was measured; the best fit"
            f" adds {self.found.alignment_mm:.4f} mm (1 sigma)"
        )
        if self.verdict is not None:
            v = self.verdict
            lines.append(
                f"tolerance ± {v.tolerance_mm:g} mm: {v.within:.2f} % of the points within; by more"
                f" than U = {v.U_mm:.4f} mm (k = 2) {v.inside:.2f} % inside and {v.outside:.2f} %"
                f" outside, {v.close:.2f} % too close to tell"
            )
            lines.append(
                f"lowest {v.lowest[0]:+.4f} mm: {DECIDED[v.lowest[1]]}; highest {v.highest[0]:+.4f}"
                f" mm: {DECIDED[v.highest[1]]} (99.7 % of the points)"
            )
            lines.append(f"{DECIDED[v.decision].upper()}: {RULE}")
        if self.ply is not None:
            lines.append(f"coloured points -> {self.ply}")
        return "\n".join(lines)


def compare(
    session: SessionLike,
    scan: str,
    nominal: Path | str,
    *,
    tolerance: float | None = None,
    units: Units | None = None,
    reach: float | None = None,
    out: Path | str | None = None,
    model: ModelName | None = None,
    accept_rejected: bool = False,
    progress: Progress = ignore_progress,
    warn: Warn = ignore_warnings,
) -> NominalComparison:
    """Compare a scan with a nominal model after best-fit alignment: figures, coloured points,
    pictures in the report.

    Args:
        session: Session folder.
        scan: Name of the capture, or merge/1 and the like for a merge of the session.
        nominal: STL, PLY, OBJ, STEP or 3MF file of the part as it should be.
        tolerance: Plus and minus, mm; the answer is pass, fail, or too close to tell.
        units: What the file's numbers are; required where its size does not fit the scan's. STEP
            and 3MF state theirs.
        reach: Points farther than this from the nominal, mm, belong to something else (a table, a
            clamp); by default 2 % of the nominal's diagonal.
        out: PLY file, the deviation as a scalar and as colours; by default in the session's
            exports.
        model: Which calibration to use; by default the best one available.
        accept_rejected: Use the calibration although its verdict rejects it.

    The session stores the result as a measurement.
    """
    if out is not None and Path(out).suffix.lower() != ".ply":
        raise UsageError(
            f"coloured points are written as .ply, not as {Path(out).name}: end its name so"
        )
    ideal = read_nominal(nominal, units)  # a wrong file is refused before minutes of work
    with opened(session, write=True) as store:
        reading = part(progress, 0.0, 0.4)
        on = load_surface(
            store, scan, model=model, accept_rejected=accept_rejected, progress=reading, warn=warn
        )
        default = (
            store.exports / f"{_safe_name(scan)}_{_safe_name(Path(ideal.name).stem)}_deviation.ply"
        )
        return compare_surface(
            store,
            on,
            ideal,
            tolerance=tolerance,
            reach=reach,
            out=default if out is None else out,
            progress=part(progress, 0.4, 1.0),
            warn=warn,
        )


def compare_surface(
    store: Session,
    on: MeasuredSurface,
    nominal: Nominal,
    *,
    tolerance: float | None = None,
    reach: float | None = None,
    out: Path | str | None = None,
    progress: Progress = ignore_progress,
    warn: Warn = ignore_warnings,
) -> NominalComparison:
    """As ``compare``, of a surface that is there already, in a session open for writing. Without
    ``out`` no file is written."""
    measured = on.measured
    points = on.points[measured].astype(np.float64)
    check_size(nominal, points)
    normals = None if on.normals is None else on.normals[measured]
    sigma = on.sigma_mm[measured]
    typical = float(np.nanmedian(sigma)) if np.isfinite(sigma).any() else None
    result = deviation(
        points,
        nominal.mesh,
        normals=normals,
        sigma_mm=typical,
        reach_mm=reach,
        progress=stage(progress, 0.0, 0.85, "aligning"),
    )
    if result.coverage < LIKELY_COVERAGE:
        warn(
            f"only {100 * result.coverage:.1f} % of {nominal.name} were measured: see that it is"
            " the same part"
        )
    towards = np.nan_to_num(result.normals.astype(np.float64))
    along = on.sigma_along(towards)
    counted = result.counted
    noise = (
        float(np.sqrt(np.nanmean(along[counted] ** 2)))
        if np.isfinite(along[counted]).any()
        else float("nan")
    )
    verdict = (
        None
        if tolerance is None
        else judge_deviation(result, on.sigma_along(towards, whole=True), tolerance)
    )
    progress(0.9, "writing")
    ply = None
    if out is not None:
        ply = Path(out)
        ply.parent.mkdir(parents=True, exist_ok=True)
        _write_points(ply, on, result, nominal, tolerance)
    measurement = _save_comparison(store, on, nominal, result, verdict, noise, points)
    progress(1.0, "compared")
    return NominalComparison(on.source, on.model, nominal, result, verdict, noise, ply, measurement)


def _figure_rows(numbers: dict[str, float], noise: float) -> list[Row]:
    """Return the lines of the table of figures, mm."""
    return [
        {"deviation, mm": words, "value": f"{value:+.4f}" if signed else f"{value:.4f}"}
        for words, value, signed in (
            ("mean", numbers["mean"], True),
            ("RMS", numbers["rms"], False),
            ("RMS of noise alone", noise, False),
            ("95 % are off by less than", numbers["within_95"], False),
            ("range of 99.7 %, lower end", numbers["p_low"], True),
            ("range of 99.7 %, upper end", numbers["p_high"], True),
            ("lowest", numbers["lowest"], True),
            ("highest", numbers["highest"], True),
        )
    ]


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
        scalars={SCALARS: signed},
        faces=faces,
        notes=[
            f"{on.source} against {nominal.name}",
            f"colours from {-limit:.4g} to {limit:.4g} mm",
        ],
    )


def _save_comparison(
    store: Session,
    on: MeasuredSurface,
    nominal: Nominal,
    result: Deviation,
    verdict: ToleranceVerdict | None,
    noise: float,
    points: np.ndarray,
) -> Measurement:
    """Save a comparison as a measurement: figures, alignment, and each point's deviation."""
    numbers = result.statistics()
    quantities = [
        Quantity("mean", numbers["mean"], "mm"),
        Quantity("RMS", numbers["rms"], "mm"),
        Quantity("95 % off by less than", numbers["within_95"], "mm"),
        Quantity("range of 99.7 %, lower end", numbers["p_low"], "mm"),
        Quantity("range of 99.7 %, upper end", numbers["p_high"], "mm"),
        Quantity("area measured", 100 * result.coverage, "%"),
    ]
    if verdict is not None:
        quantities.append(Quantity("within tolerance", verdict.within, "%"))
    edges, counts = result.histogram()
    counted = np.flatnonzero(result.counted)
    stored = counted[:: -(-len(counted) // MAX_STORED_POINTS)]
    data = {
        "quantities": quantities,
        "scale": on.scale,
        "nominal": {"name": nominal.name, "hash": nominal.hash, "units": nominal.units or "mm"},
        "noise_mm": noise,
        "verdict": verdict,
        **result.to_json(),
    }
    arrays = {
        "points": points[stored].astype(np.float32),
        "normals": result.normals[stored],
        "signed": result.signed[stored],
        "uncovered": result.uncovered,
        "edges": edges,
        "counts": counts,
    }
    return save_measurement(
        store,
        "deviation",
        source=on.source,
        model=on.model,
        inputs=on.inputs,
        data=data,
        arrays=arrays,
        name=f"{on.source} against {nominal.name}",
    )


def _safe_name(name: str) -> str:
    """Return a file name that is valid on every system: ASCII letters, digits, '-' and '_', 60 at
    most."""
    return "".join(c if c.isascii() and (c.isalnum() or c in "-_") else "-" for c in name)[:60]
