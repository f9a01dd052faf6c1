"""What a session holds: as one self-contained HTML file; in words, and whether it is what was
saved; and what is in its trash."""

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import KW_ONLY, dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from slviewer.calibration.observe import Observation
from slviewer.calibration.pixelwise import PixelwiseModel, pixel_samples
from slviewer.calibration.splined.adjust import pose_residuals
from slviewer.calibration.splined.model import SplinedModel
from slviewer.calibration.stereo import DEVICES, StereoModel
from slviewer.errors import DamagedError, InputError, SlviewerError
from slviewer.evaluation.render import render
from slviewer.fringe.sequence import Axis
from slviewer.inputs import Input
from slviewer.pipeline.certificate import certificate_section, certify_page, make_certificate
from slviewer.pipeline.cloud_corrections import describe_scale, restrict_cloud
from slviewer.pipeline.measure import describe_measurement, section_lines
from slviewer.pipeline.models import (
    available_models,
    load_last_verdict,
    load_model,
    load_reprojection,
    load_residuals,
    load_stereo,
    load_stereo_if_complete,
    load_stereo_verdict,
    preferred_model,
    recommended_model,
)
from slviewer.pipeline.operation import (
    Callbacks,
    Progress,
    SessionLike,
    Stored,
    ignore_progress,
    list_records,
    load_arrays,
    match_names,
    name_records,
    opened,
    takes_settings,
)
from slviewer.pipeline.poses import load_observations
from slviewer.reconstruction.cloud import Cloud
from slviewer.reconstruction.reconstruct import normals
from slviewer.records.acceptance import AcceptanceTest, Drift
from slviewer.records.inspection import Inspection
from slviewer.records.kinds import all_kinds
from slviewer.records.measurement import Measurement
from slviewer.records.merge import Merge, Reconstruction
from slviewer.records.record import Record, format_count
from slviewer.records.verification import Verification
from slviewer.report.maps import PixelCurve, verification_maps
from slviewer.report.page import Figure, write_page
from slviewer.report.session import (
    RESULTS,
    CalibrationFigures,
    CaptureUse,
    RecordsView,
    SessionData,
    make_title_page,
    session_headlines,
    session_sections,
    session_title,
)
from slviewer.report.surfaces import draw_deviation, draw_photo, draw_surface, section_plot
from slviewer.session.capture import Capture
from slviewer.session.ply import read_ply
from slviewer.session.reading import expand_user, read_input
from slviewer.session.report_details import encode_logo
from slviewer.session.results import verify_result
from slviewer.session.scan_edits import list_edits, load_region
from slviewer.session.store import Session

MAX_LOGO_BYTES = 1 << 24
MOST_DRAWN = 6
"""Sections, and comparisons with nominal models, that are drawn, the last ones; the tables hold
all."""
MOST_MAPS = 8
"""Verified captures whose error maps are drawn; the tables hold them all."""


@dataclass(frozen=True)
class ReportSettings(Callbacks):
    """Where a report is written to, and what its title page states.

    Args:
        session: Session folder.
        out: The .html file.
        part: Name or number of the part. This and what follows is remembered in the session for
            its next reports; empty text forgets it.
        customer: Who the report is for.
        order: Number of the order.
        operator: Who measured.
        temperature: Temperature of the room, °C.
        logo: Image of a logo (PNG, JPEG or WebP).
        full: Also what concerns the rig, not the part: verifications, merges, clouds, models,
            residuals, captures and hashes. A report without measurements has it anyway.
    """

    session: SessionLike
    out: Path | str
    _: KW_ONLY
    part: str | None = None
    customer: str | None = None
    order: str | None = None
    operator: str | None = None
    temperature: Annotated[float | None, Input(-100, 200, "°C")] = None
    logo: str | None = None
    full: bool = False

    def changed_details(self) -> dict[str, Any]:
        """Return the stated fields of `ReportDetails`."""
        stated = {name: getattr(self, name) for name in ("part", "customer", "order", "operator")}
        stated["temperature_c"] = self.temperature
        if self.logo:
            path = expand_user(self.logo)
            content = read_input(path, MAX_LOGO_BYTES, "give an image file")
            stated["logo"] = encode_logo(path.name, content)
        elif self.logo is not None:
            stated["logo"] = ""
        return {name: value for name, value in stated.items() if value is not None}


@takes_settings(ReportSettings)
def report(settings: ReportSettings) -> str:
    """Write one self-contained HTML report of a session: verdict and results first, then the
    annex."""
    out, progress = settings.out, settings.progress
    if Path(out).suffix.lower() not in (".html", ".htm"):
        raise InputError(f"{out} is not an HTML file", "end its name in .html")
    changed = settings.changed_details()
    with opened(settings.session, write=bool(changed)) as store:
        if changed:
            store.set_report_details(**changed)
        progress(0.1, "reading the session")
        data = _collect_data(store)
        for message in data.warnings:
            settings.warn(message)
        progress(0.4, "drawing")
        title, subtitle = session_title(data)
        is_full = settings.full or not any(view.kind in RESULTS for view in data.records)
        progress(0.7, "reading the frames")
        certificate = make_certificate(store)
        write_page(
            out,
            title,
            subtitle,
            session_headlines(data),
            [
                *session_sections(data, is_full=is_full),
                certificate_section(certificate, is_full=is_full),
            ],
            partial(certify_page, certificate),
            title_page=make_title_page(data),
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
    pixel_fits = dict[str, np.ndarray]()
    if "pixelwise" in there:
        pixelwise = load_model(store, "pixelwise")
        assert isinstance(pixelwise, PixelwiseModel)
        pixel_fits = {axis: fit.rms_mm for axis, fit in pixelwise.fits.items()}
    figures = None if stereo is None else calibration_view(store)
    model = preferred_model(store) if there else ""
    records, outdated = _collect_records(store)
    known = _list_known_shapes(store, records)
    region = load_region(store)
    return SessionData(
        name=store.folder.name,
        captures=[_describe_use(c, stereo, excluded, known) for c in store.captures()],
        calibration=figures,
        pixel_fits=pixel_fits,
        records=records,
        warnings=[*stale, *outdated],
        **_judge(store, figures, model),
        model=model,
        recommended=recommended_model(store) if there else "",
        scales={name: words for name in there if (words := describe_scale(store, name))},
        region="" if region is None else region.text(),
        edits=[
            (scan, words)
            for scan in store.capture_names("scan")
            for words in list_edits(store, scan)[0]
        ],
        labels=store.valid_decision("names") or {},
        details=store.report_details(),
        pictures=list(_draw_part(store, known)),
    )


def _list_known_shapes(store: Session, records: Sequence[RecordsView]) -> set[str]:
    """Return the captures of known shapes: made for that, or verified and no part."""

    def list_inputs(*kinds: type[Record]) -> set[str]:
        """Return the names of all inputs of the records of some kinds."""
        views = [view for view in records if view.kind in kinds]
        return {name for view in views for each in view.records.values() for name in each.inputs}

    made = {each.name for each in store.captures() if each.purpose in ("plane", "sphere")}
    verified = list_inputs(Verification, AcceptanceTest, Drift)
    return (made | verified) - list_inputs(Merge, Inspection)


def _draw_part(store: Session, known: Collection[str]) -> Iterator[Figure]:
    """Yield pictures of the part: as the camera saw it, and the last merged surface, or that of the
    first scan; none of ``known`` shapes."""
    clouds = {each.name: each for each in list_records(store, Reconstruction) if not each.stale}
    scans = [name for name in store.capture_names("scan") if name in clouds and name not in known]
    merge = next((m.record for m in list_records(store, Merge)[::-1] if not m.stale), None)
    if merge and merge.reference in scans:
        scans.insert(0, merge.reference)
    surface = None
    if merge:
        with suppress(SlviewerError, OSError):  # its file was deleted
            merged = read_ply(store.exports / merge.ply)
            words = f"Merged surface of {format_count(len(merge.scans), 'scan')}"
            surface = draw_surface(words, merged.points, merged.normals)
    for name in scans[:1]:
        label, arrays = clouds[name].label, load_arrays(store, f"{Reconstruction.kind}/{name}")
        if "texture" in arrays and clouds[name].record.imported is None:
            yield draw_photo(label, arrays["texture"], arrays["points"])
        if surface:
            continue
        with suppress(InputError):  # all of it was deleted
            beyond = arrays.get("extrapolated")
            cloud = Cloud(arrays["points"], "x", "", arrays["sigma_z"], extrapolated=beyond)
            points = restrict_cloud(store, name, cloud.supported(), load_region(store)).points
            is_known, facing = np.isfinite(points).all(axis=2), arrays.get("normals")
            facing = normals(points) if facing is None else facing
            surface = draw_surface(f"Surface of {label}", points[is_known], facing[is_known])
    if surface:
        yield surface


def _judge(store: Session, figures: CalibrationFigures | None, model: str) -> dict[str, Any]:
    """Return the verdict on the last attempt to calibrate, and whether that made the calibration
    whose ``figures`` are shown: then with what these show of the ``model`` in use."""
    verdict = load_last_verdict(store)
    if verdict is None or figures is None:
        return {"verdict": verdict, "verdict_of_calibration": False}
    if verdict != load_stereo_verdict(store):
        return {"verdict": verdict, "verdict_of_calibration": False}
    return {"verdict": figures.reprojection.judge(verdict, model)}


def _collect_records(store: Session) -> tuple[list[RecordsView], list[str]]:
    """Return the records made from what the session holds now, by kind, with pictures of the first
    ones; and warnings of the others."""
    views, stale = [], []
    for kind in all_kinds().values():
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
    capture: Capture,
    stereo: StereoModel | None,
    excluded: Mapping[str, str],
    known: Collection[str],
) -> CaptureUse:
    """Return whether and why a capture is used or excluded; ``known``: captures of known shapes."""
    name = capture.name
    if capture.role == "scan":
        return CaptureUse(capture, "known shape" if name in known else "scan")
    if name in excluded:
        return CaptureUse(capture, "excluded", excluded[name])
    if stereo is None or not stereo.poses:
        return CaptureUse(capture, "waiting")
    if name in stereo.poses:
        return CaptureUse(capture, "used")
    return CaptureUse(capture, "unused", stereo.excluded.get(name, "added after the calibration"))


def calibration_view(store: Session) -> CalibrationFigures:
    """The session's calibration as figures and tables show it, with every pose's residuals by the
    model in use, or by stereo where that has none.

    Raises InputError where there is none.
    """
    stereo, model = load_stereo(store), preferred_model(store)
    reprojection = load_reprojection(store, stereo, model)
    observations = load_observations(store, list(stereo.poses))
    views = dict[str, dict[str, tuple[np.ndarray, np.ndarray]]]()
    if reprojection.model == "splined":
        fitted = load_model(store, model)
        assert isinstance(fitted, SplinedModel)
        for o in observations:
            if (each := pose_residuals(fitted.bundle, o)) is not None:
                views[o.name] = dict(zip(DEVICES, each, strict=True))
    else:
        residuals = load_residuals(store)
        for o in observations:
            if (r := residuals.get(o.name)) is not None:
                views[o.name] = {
                    "camera": (o.camera, r[:, :2]),
                    "projector": (o.projector, r[:, 2:]),
                }
    return CalibrationFigures(stereo, reprojection, views)


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


def inspect(
    session: SessionLike, *, check: bool = False, progress: Progress = ignore_progress
) -> str:
    """List what a session holds, and what is stale or damaged.

    Args:
        session: Session folder.
        check: Read every capture and result, and compare it with the hash that it was saved with;
            ends with status 1 where anything is damaged.
    """
    with opened(session) as store:
        if check:
            return _check(store, progress)
        captures, faults = store.read_captures()
        damage = [*faults.values(), *store.decision_faults()]
        lines = [f"{store.folder}: {format_count(len(captures), 'capture')}"]
        lines += [
            f"  {name} was complete, and not yet in its place: it is now"
            for name in store.recovered
        ]
        models = available_models(store)
        with _collecting(damage):
            excluded = store.valid_decision("excluded") or {}
            for capture in captures:
                why = excluded.get(capture.name)
                note = f"  [excluded: {why}]" if why else ""
                lines.append(f"  {summarise_capture(capture)}{note}")
        for name in models:
            with _collecting(damage):
                lines += _describe_calibration(store, name)
        with _collecting(damage):
            if (verdict := load_last_verdict(store)) is not None:
                lines.append(verdict.text())
        with _collecting(damage):
            if measured := list_records(store, Measurement):
                lines.append(f"{format_count(len(measured), 'measurement')}:")
                lines += [f"  {describe_measurement(each)}" for each in measured]
        if not models:
            lines.append("no calibration yet: run `slviewer calibrate` with the --target in use")
        lines += [f"damaged: {fault}" for fault in dict.fromkeys(damage)]
    return "\n".join(lines)


def _check(store: Session, progress: Progress) -> str:
    """Read everything, and describe what was compared. Raises DamagedError that lists what is
    damaged, if anything."""
    (captures, faults), results = store.read_captures(), store.result_names()
    damage = [*faults.values(), *store.decision_faults()]
    checks: list[tuple[str, Callable[[], object]]] = [(each.name, each.verify) for each in captures]
    checks += [(name, partial(verify_result, store.folder / "results" / name)) for name in results]
    for i, (name, verify) in enumerate(checks):
        progress(i / len(checks), f"checking {name}")
        with _collecting(damage):
            verify()
    progress(1.0, "checked")
    counts = f"{len(captures)} captures and {len(results)} results"
    if damage:
        raise DamagedError(
            "\n  ".join([f"{store.folder}: {counts} were read, and this is damaged:", *damage])
        )
    return f"{store.folder}: {counts} are what was saved"


@contextmanager
def _collecting(damage: list[str]) -> Iterator[None]:
    """Context manager: an error of slviewer ends the block and is added; one damaged file hides
    nothing else."""
    try:
        yield
    except SlviewerError as error:
        damage.append(str(error))


def _describe_calibration(store: Session, name: str) -> list[str]:
    """One model of the session's calibration, by name: what it was made from, its state, its
    accuracy."""
    state = store.state_of(f"calibration/{name}")
    meta = store.load_meta(f"calibration/{name}")
    mark = ", the default" if name == preferred_model(store) else ""
    if "imported" not in meta:
        lines = [f"calibration {name}: from {len(meta['inputs'])} poses, {state}{mark}"]
        of = load_reprojection(store, load_stereo(store), name)
        if of.model == name:
            lines.append(f"  reprojection RMS {of.rms_text}")
        return lines
    lines = [f"calibration {name}: imported from {meta['source']}, {state}{mark}"]
    for device in ("camera", "projector"):
        K, size = np.array(meta["imported"][f"K_{device}"]), meta[device]
        size_text = f"{size[0]}x{size[1]} px" if size else "size not stated (the captures' is used)"
        lines.append(
            f"  {device} {size_text}, focal length {K[0, 0]:.1f}, {K[1, 1]:.1f} px, "
            f"principal point {K[0, 2]:.1f}, {K[1, 2]:.1f} px"
        )
    T = np.array(meta["imported"]["T"])
    return [*lines, f"  baseline {np.linalg.norm(T):.1f} mm; it states no reprojection error"]


def summarise_capture(capture: Capture) -> str:
    """A capture in one line: sizes, axes, frames, and the finest pattern of each axis."""
    sequence, (width, height) = capture.sequence, capture.size
    if capture.is_imported_cloud:
        return (
            f"{capture.name:<16} {capture.role:<12} imported cloud, from {capture.meta['source']}"
        )
    patterns = ", ".join(
        f"{axis} {'period' if sequence.periods_px(axis) else 'Gray cell'}"
        f" {sequence.period_px(axis):g} px"
        for axis in sequence.axes
    )
    size = sequence.projector_size
    projector = f"{size[0]}x{size[1]}" if size else "of unknown size"
    line = (
        f"{capture.name:<16} {capture.role:<12} camera {width}x{height}, projector {projector}, "
        f"{'axis' if len(sequence.axes) == 1 else 'axes'} {' and '.join(sequence.axes)}, "
        f"{len(sequence.frames)} frames, {patterns}"
    )
    if capture.second is not None:
        line += ", second camera {}x{}".format(*capture.second.size)
    if capture.exposures_ms:
        line += f", exposures {', '.join(f'{exposure:g}' for exposure in capture.exposures_ms)} ms"
    return line + (", colour" if capture.meta.get("texture") else "")


def restore(session: SessionLike, names: Sequence[str] = ()) -> str:
    """List what is in a session's trash, or bring back what is named.

    Captures and results that were deleted or replaced are in the trash. What has a restored name
    now goes there in exchange, in one step.

    Args:
        session: Session folder.
        names: What to bring back: names, the last deleted of each, or patterns such as
            'calibration/*', or the name of one folder in the trash; without any, the trash is
            listed.
    """
    with opened(session, write=bool(names)) as store:
        trashed = store.trashed()
        if not names:
            if not trashed:
                return f"nothing is in the trash of {store.folder}"
            rows = [
                {
                    "name": each.name,
                    "kind": "capture" if each.is_capture else "result",
                    "deleted (UTC)": f"{each.time:%Y-%m-%d %H:%M:%S}",
                    "folder in the trash": each.place.name,
                }
                for each in trashed
            ]
            return render(rows)
        latest = {each.name: each for each in reversed(trashed)}
        latest |= {each.place.name: each for each in trashed}
        found = match_names(list(latest), names, "item of the trash", InputError)
        chosen = list(
            dict.fromkeys(  # patterns match no folders
                latest[name] for name in found if name in names or name == latest[name].name
            )
        )
        store.exchange({each.name: each.place for each in chosen})
        return "\n".join(
            f"restored: {each.name}, deleted {each.time:%Y-%m-%d %H:%M:%S} UTC" for each in chosen
        )
