"""A session as one self-contained HTML file."""

from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from slviewer.calibration.observe import Observation
from slviewer.calibration.pixelwise import PixelwiseModel, pixel_samples
from slviewer.calibration.stereo import StereoModel
from slviewer.errors import InputError
from slviewer.fringe.sequence import Axis
from slviewer.pipeline.calibrate import load_last_verdict
from slviewer.pipeline.certificate import certificate_section, certify_page, make_certificate
from slviewer.pipeline.feedback import Progress, Warn, ignore_progress, ignore_warnings
from slviewer.pipeline.measure import section_lines
from slviewer.pipeline.models import (
    available_models,
    load_model,
    load_residuals,
    load_stereo,
    load_stereo_if_complete,
    preferred_model,
    recommended_model,
)
from slviewer.pipeline.open_session import SessionLike, opened
from slviewer.pipeline.poses import load_observations
from slviewer.pipeline.scale import describe_scale
from slviewer.pipeline.stored_records import (
    Stored,
    list_records,
    load_arrays,
    load_record,
    name_records,
)
from slviewer.records.calibration import ModelCalibration
from slviewer.records.kinds import RECORDS
from slviewer.records.measurement import Measurement
from slviewer.records.verification import Verification
from slviewer.report.maps import PixelCurve, verification_maps
from slviewer.report.page import Figure, write_page
from slviewer.report.session import (
    CalibrationFigures,
    CaptureUse,
    RecordsView,
    SessionData,
    session_headlines,
    session_sections,
    session_title,
)
from slviewer.report.surfaces import draw_deviation, section_plot
from slviewer.session.capture import Capture
from slviewer.session.scan_edits import list_edits, load_region
from slviewer.session.store import Session

MOST_DRAWN = 6
"""Sections, and comparisons with nominal models, that are drawn, the last ones; the tables hold
all."""
MOST_MAPS = 8
"""Verified captures whose error maps are drawn; the tables hold them all."""


def report(
    session: SessionLike,
    out: Path | str,
    *,
    progress: Progress = ignore_progress,
    warn: Warn = ignore_warnings,
) -> str:
    """Write one self-contained HTML report of a session.

    Args:
        session: Session folder.
        out: The .html file.

    Returns where it is, in words.
    """
    if Path(out).suffix.lower() not in (".html", ".htm"):
        raise InputError(f"{out} is not an HTML file: end its name in .html")
    with opened(session) as store:
        progress(0.1, "reading the session")
        data = _collect_data(store)
        for message in data.warnings:
            warn(message)
        progress(0.4, "drawing")
        title, subtitle = session_title(data)
        progress(0.7, "reading the frames")
        certificate = make_certificate(store)
        write_page(
            out,
            title,
            subtitle,
            session_headlines(data),
            [*session_sections(data), certificate_section(certificate)],
            partial(certify_page, certificate),
        )
    progress(1.0, "written")
    return f"report written to {out}"


def _collect_data(store: Session) -> SessionData:
    """Collect everything that a report shows of a session."""
    stereo, there = load_stereo_if_complete(store), available_models(store)
    stale = [
        f"The {name} calibration was made from target poses that have since changed: run calibrate"
        " again."
        for name in there
        if store.state_of(f"calibration/{name}") == "stale"
    ]
    excluded = store.excluded()
    verdict, pixel_fits = load_last_verdict(store), dict[str, np.ndarray]()
    if "pixelwise" in there:
        pixelwise = load_model(store, "pixelwise")
        assert isinstance(pixelwise, PixelwiseModel)
        pixel_fits = {axis: fit.rms_mm for axis, fit in pixelwise.fits.items()}
    judged = None if stereo is None else load_record(store, ModelCalibration, "stereo").verdict
    records, outdated = _collect_records(store)
    region = load_region(store)
    return SessionData(
        name=store.folder.name,
        captures=[_describe_use(c, stereo, excluded) for c in store.captures()],
        calibration=None if stereo is None else calibration_view(store),
        pixel_fits=pixel_fits,
        records=records,
        warnings=[*stale, *outdated],
        verdict=verdict,
        verdict_of_calibration=verdict is not None and verdict == judged,
        model=preferred_model(store) if there else "",
        recommended=recommended_model(store) if there else "",
        scales={name: words for name in there if (words := describe_scale(store, name))},
        region="" if region is None else region.text(),
        edits=[
            (scan, words)
            for scan in store.capture_names("scan")
            for words in list_edits(store, scan)[0]
        ],
    )


def _collect_records(store: Session) -> tuple[list[RecordsView], list[str]]:
    """Return the records made from what the session holds now, by kind, with pictures of the first
    ones; and warnings of the others."""
    views, stale = [], []
    for kind in RECORDS.values():
        every = list_records(store, kind)
        fresh = [each for each in every if kind.is_history or not each.stale]
        stale += [
            f"{kind.title} of {each.label} is out of date and not shown."
            for each in every
            if each not in fresh
        ]
        if fresh:
            views.append(RecordsView(kind, name_records(fresh), list(_draw_records(store, fresh))))
    return views, stale


def _draw_records(store: Session, records: Sequence[Stored[Any]]) -> Iterator[Figure]:
    """Yield pictures of records of one kind: of the first verifications, and of the last
    measurements of each kind."""
    for each in records[:MOST_MAPS]:
        if isinstance(each.record, Verification):
            arrays = load_arrays(store, f"{each.record.kind}/{each.name}")
            yield verification_maps(each.label, each.record, arrays)
    measured = [each for each in records if isinstance(each.record, Measurement)]
    for each in [each for each in measured if each.record.plane is not None][-MOST_DRAWN:]:
        yield section_plot(each.label, section_lines(store, each.name)[1])
    for each in [each for each in measured if each.record.deviation is not None][-MOST_DRAWN:]:
        arrays = load_arrays(store, f"{each.record.kind}/{each.name}")
        yield draw_deviation(each.label, each.record.source, each.record.deviation, arrays)


def _describe_use(
    capture: Capture, stereo: StereoModel | None, excluded: Mapping[str, str]
) -> CaptureUse:
    """Return whether and why a capture is used or excluded."""
    name = capture.name
    if capture.role == "scan":
        return CaptureUse(capture, "scan")
    if name in excluded:
        return CaptureUse(capture, "excluded", excluded[name])
    if stereo is None or not stereo.poses:
        return CaptureUse(capture, "waiting")
    if name in stereo.poses:
        return CaptureUse(capture, "used")
    return CaptureUse(capture, "unused", stereo.excluded.get(name, "added after the calibration"))


def calibration_view(store: Session) -> CalibrationFigures:
    """The session's stereo calibration as figures and tables show it, with every pose's residuals.

    Raises InputError where there is none.
    """
    stereo, residuals = load_stereo(store), load_residuals(store)
    views = {
        o.name: {"camera": (o.camera, r[:, :2]), "projector": (o.projector, r[:, 2:])}
        for o in load_observations(store, list(stereo.poses))
        if (r := residuals.get(o.name)) is not None
    }
    return CalibrationFigures(stereo, views)


def curve_at(
    pixel: tuple[int, int],
    model: PixelwiseModel,
    stereo: StereoModel,
    observations: Sequence[Observation],
    axis: Axis,
) -> PixelCurve | None:
    """The data and the fit of one pixel (u, v); None where it was not fitted."""
    u, v = pixel
    fit = model.fits[axis]
    phase, points = pixel_samples(observations, stereo, model, axis, pixel)
    if not len(phase) or not np.isfinite(fit.coefficients[0, v, u]):
        return None
    x, y, z = points.T
    return PixelCurve(pixel, axis, phase, z, x, y, fit.coefficients[:, v, u], fit.rms_mm[:, v, u])
