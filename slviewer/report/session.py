"""Report sections of a session: captures, calibration and verification; and the report on many
parts, with a trend chart of each characteristic."""

import inspect
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from slviewer.calibration.stereo import StereoModel
from slviewer.evaluation.render import format_count, format_counts
from slviewer.geometry.lens import Lens
from slviewer.geometry.rigid import rotation_angle
from slviewer.records.acceptance import MARKS, Decision
from slviewer.records.inspection import Characteristic, CharacteristicResult, Inspection
from slviewer.records.record import Record
from slviewer.records.table import Cell, Column, Mark, Table, Value
from slviewer.records.verdict import Verdict
from slviewer.records.verification import Verification, average
from slviewer.report.canvas import (
    HALF,
    INK,
    SOFT,
    finish_figure,
    new_figure,
    percentile,
    style_axes,
)
from slviewer.report.maps import rms_maps
from slviewer.report.page import Figure, Headline, Item, PageNotice, Section, write_page
from slviewer.report.reprojection import coverage, pose_bars, residual_arrows
from slviewer.session.capture import Capture

DEVICES = ("camera", "projector")
WORST = 2.0
"""A pose whose reprojection error exceeds the RMS over the poses this many times is marked."""


@dataclass(frozen=True)
class CaptureUse:
    """Whether the calibration uses a capture, and ``why`` it does not."""

    capture: Capture
    state: Literal["used", "unused", "excluded", "scan", "waiting"]
    why: str = ""


@dataclass(frozen=True, eq=False)
class CalibrationFigures:
    """A stereo calibration, and of each pose and device where its features are, pixels (n, 2), and
    their residuals (n, 2) px, NaN where excluded or not read; empty where none were saved."""

    stereo: StereoModel
    residuals: Mapping[str, Mapping[str, tuple[np.ndarray, np.ndarray]]] = field(
        default_factory=dict
    )


@dataclass(frozen=True, eq=False)
class RecordsView:
    """The records of one kind by their labels, and pictures of them."""

    kind: type[Record]
    records: Mapping[str, Any]
    figures: Sequence[Figure] = ()


@dataclass(frozen=True, eq=False)
class SessionData:
    """A session's captures, its calibrations, and the records made with them.

    ``verdict`` is that on the last attempt to calibrate; ``verdict_of_calibration``: whether that
    made ``calibration``. ``pixel_fits``: {axis: RMS (3, h, w) of the pixel-wise fits in z, x, y}.
    ``model``: the one that is used, and the one ``recommended``; ``scales``: {model: what
    correction of scale was applied, in words}. ``region``: the region of interest that is in
    effect, in words; ``edits``
    of scans in their order: scan and words.
    """

    name: str
    captures: Sequence[CaptureUse]
    calibration: CalibrationFigures | None = None
    pixel_fits: Mapping[str, np.ndarray] = field(default_factory=dict)
    records: Sequence[RecordsView] = ()
    warnings: Sequence[str] = ()
    verdict: Verdict | None = None
    verdict_of_calibration: bool = True
    model: str = ""
    recommended: str = ""
    scales: Mapping[str, str] = field(default_factory=dict)
    region: str = ""
    edits: Sequence[tuple[str, str]] = ()


def session_title(data: SessionData) -> tuple[str, str]:
    """The page's title and the sentence below it."""
    counts = format_counts(each.capture.purpose for each in data.captures)
    return data.name, f"{counts}; {format_count(_count_used(data), 'pose')} used to calibrate."


def _count_used(data: SessionData) -> int:
    """The number of target poses that the calibration was made from."""
    return sum(each.state == "used" for each in data.captures)


def session_headlines(data: SessionData) -> list[Headline]:
    """Headlines: verdict, poses used, reprojection error, RMS of the fit, and the best flatness
    verified."""
    headlines = []
    if data.verdict is not None:
        mark: Mark = "better" if data.verdict.level == "good" else "worse"
        count = format_count(len(data.verdict.findings), "finding")
        headlines.append(Headline(data.verdict.level, "verdict on the calibration", count, mark))
    if data.calibration is not None:
        stereo = data.calibration.stereo
        wanted = sum(each.capture.role == "calibration" for each in data.captures)
        used, note = f"{_count_used(data)} of {wanted}", f"boards at {_format_depths(stereo)}"
        headlines.append(Headline(used, "target poses used", note))
        if rms := stereo.reprojection_rms_px:
            both = f"both devices together {rms['stereo']:.3f} px" if "stereo" in rms else ""
            devices = "{} / {} px".format(*(f"{rms.get(d, np.nan):.3f}" for d in DEVICES))
            headlines.append(Headline(devices, "reprojection RMS, camera / projector", both))
    fits = [(percentile(rms[0], 50), axis) for axis, rms in data.pixel_fits.items()]
    if known := [fit for fit in fits if np.isfinite(fit[0])]:
        rms_z, axis = min(known)
        note = f"median over the pixels, axis {axis}"
        headlines.append(Headline(f"{rms_z:.3f} mm", "pixel-wise fit, RMS in z", note))
    return headlines + _plane_headline(data)


def _plane_headline(data: SessionData) -> list[Headline]:
    """Headline of the flattest model's mean plane RMS, beside its noise floor and the other
    models'."""
    planes = [
        each
        for view in data.records
        for each in view.records.values()
        if isinstance(each, Verification) and each.shape == "plane"
    ]
    found = average("plane", planes)
    means = {model: mm for model, mm in found.rms_mm.items() if np.isfinite(mm)}
    if not means:
        return []
    best, floor = found.best, found.models[found.best].noise_floor_mm
    notes = [] if floor is None else [f"noise floor {floor:.3f} mm"]
    notes += [f"{other} {mm:.3f} mm" for other, mm in means.items() if other != best]
    mark: Mark = "better" if len(means) > 1 else ""
    return [Headline(f"{means[best]:.3f} mm", f"mean plane RMS, {best}", "; ".join(notes), mark)]


def session_sections(data: SessionData) -> list[Section]:
    """Sections: warnings, then calibration, verification and clouds as far as present, then the
    captures."""
    sections = _notice_section(data)
    if data.verdict is not None:
        sections.append(_verdict_section(data.verdict, data.verdict_of_calibration))
    if data.calibration is not None:
        sections += [
            _reprojection_section(data.calibration),
            Section(
                "Parameters",
                "Pinhole and Brown distortion of both devices, and where the projector stands in"
                " the camera's frame.",
                [lens_table(data.calibration.stereo), rig_table(data.calibration.stereo)],
            ),
        ]
    if data.model:
        used = f"Measured with {data.model}"
        if data.model != data.recommended:
            used += f", as the operator has chosen; recommended: {data.recommended}"
        scales = [PageNotice(f"{model}: {words}.", "plain") for model, words in data.scales.items()]
        sections.append(Section("Model in use", f"{used}.", scales))
    if data.pixel_fits:
        text = (
            "Each camera pixel's own rational function from phase to depth, and lines from depth to"
            " x and y."
        )
        maps = [rms_maps(rms, axis) for axis, rms in data.pixel_fits.items()]
        sections.append(Section("Pixel-wise model", text, maps))
    sections += [_records_section(view) for view in data.records]
    if data.region or data.edits:
        sections.append(_restrictions_section(data))
    return [*sections, _captures_section(data)]


def _notice_section(data: SessionData) -> list[Section]:
    """The section with warnings and with captures that are not used; an empty list if there are
    none."""
    unused = [
        f"{each.capture.name} is {each.state}: {each.why or 'no reason was given'}"
        for each in data.captures
        if each.state in ("unused", "excluded")
    ]
    items = list(map(PageNotice, [*data.warnings, *unused]))
    return [Section("Warnings", "", items)] if items else []


def _restrictions_section(data: SessionData) -> Section:
    """The section with the region of interest, and the points that were deleted from scans."""
    text = (
        f"Points of scans outside of the region of interest are not used: {data.region}."
        if data.region
        else ""
    )
    rows = [{"scan": scan, "edit": edit} for scan, edit in data.edits]
    table = Table.of(rows, "Edits in effect, in their order")
    return Section("Region and edits", text, [table] if data.edits else [])


def _captures_section(data: SessionData) -> Section:
    """The section with the table of captures: role, state, sizes, frames and why one is not
    used."""
    marks: dict[str, Mark] = {"used": "better", "unused": "worse", "excluded": "worse"}
    rows = []
    for each in data.captures:
        capture, sequence = each.capture, each.capture.sequence
        size = sequence.projector_size
        periods = [f"{axis} {sequence.period_px(axis):g}" for axis in sequence.axes]
        rows.append(
            {
                "capture": capture.name,
                "role": capture.role,
                "state": Cell(each.state, marks.get(each.state, "")),
                Column("camera", "px", align="right"): (
                    "" if capture.is_imported_cloud else "{}x{}".format(*capture.size)
                ),
                Column("projector", "px", align="right"): (
                    "{}x{}".format(*size)
                    if size
                    else ""
                    if capture.is_imported_cloud
                    else "unknown"
                ),
                "frames": len(sequence.frames) or "",
                Column("period", "px", align="centre"): ", ".join(periods),
                "made": capture.meta.get("created", ""),
                "why not used": each.why,
            }
        )
    if not rows:
        return Section("Captures", "The session holds no captures yet.")
    table = Table.of(rows, "Captures of the session").without_empty()
    return Section("Captures", "", [table])


def _reprojection_section(calibration: CalibrationFigures) -> Section:
    """The section about reprojection errors: bars of each pose, residual arrows and image
    coverage."""
    stereo, residuals = calibration.stereo, calibration.residuals
    rms = stereo.reprojection_rms_px
    sizes = {device: getattr(stereo.rig, device).size for device in DEVICES}
    items: list[Item] = []
    if stereo.pose_rms_px:
        items.append(pose_bars(stereo.pose_rms_px, rms))
    if residuals:
        worst = max(residuals, key=lambda name: max(stereo.pose_rms_px.get(name, (0.0, 0.0))))
        items += [
            residual_arrows(f"{device}, {worst} (the worst pose)", *residuals[worst][device], size)
            for device, size in sizes.items()
        ]
        items += [
            coverage(device, size, [each[device][0] for each in residuals.values()])
            for device, size in sizes.items()
        ]
    if stereo.pose_rms_px:
        items.append(_pose_table(stereo.pose_rms_px))
    text = ["This calibration was made elsewhere, without a reprojection error."]
    if rms:
        errors = ", ".join(f"{device} {value:.3f}" for device, value in rms.items())
        text = [
            "How far the target's features lie from where the calibration predicts them, in px:"
            f" {errors}. Target: {stereo.board}."
        ]
    if excluded := stereo.features_excluded:
        text.append(f"Excluded: {format_count(excluded, 'feature')} beyond 6 robust sigma.")
    return Section("Reprojection", text, items)


def _pose_table(pose_rms_px: Mapping[str, tuple[float, float]]) -> Table:
    """Table of reprojection RMS by pose, px, with conspicuous poses marked."""
    typical = np.sqrt(np.nanmean(np.square(list(pose_rms_px.values())), axis=0))
    rows = []
    for name, values in pose_rms_px.items():
        high = np.array(values) > WORST * typical
        row: dict[Any, Value | Cell] = {"pose": name}
        for device, value, is_high in zip(DEVICES, values, high, strict=True):
            row[Column(device, "px")] = Cell(value, "worse" if is_high else "")
        rows.append({**row, "": Cell("look at this pose" if high.any() else "", "worse")})
    return Table.of(rows, "Reprojection RMS of each pose").without_empty()


def lens_table(stereo: StereoModel) -> Table:
    """Table of both lenses' parameters."""

    def values(lens: Lens, sigma: float) -> list[str]:
        """Image size, focal lengths with standard deviation ``sigma``, principal point (px) and
        distortion as texts."""
        spread = f" ± {sigma:.1f}" if np.isfinite(sigma) else ""
        return [
            f"{lens.size[0]} x {lens.size[1]}",
            *(f"{lens.K[i, i]:.2f}{spread}" for i in (0, 1)),
            *(f"{lens.K[i, 2]:.2f}" for i in (0, 1)),
            *(f"{value:.5f}".replace("-", "−") for value in lens.D[:5]),
        ]

    names = [
        "size",
        *("focal length fx", "focal length fy", "principal point cx", "principal point cy"),
        *("radial k1", "radial k2", "tangential p1", "tangential p2", "radial k3"),
    ]
    sigmas = [stereo.focal_sigma_px.get(device, np.nan) for device in DEVICES]
    lenses = map(values, (stereo.rig.camera, stereo.rig.projector), sigmas)
    rows = [
        {
            "parameter": name,
            Column("unit", align="centre"): "px" if k < 5 else "",
            Column("camera", align="right"): of_camera,
            Column("projector", align="right"): of_projector,
        }
        for k, (name, of_camera, of_projector) in enumerate(zip(names, *lenses, strict=True))
    ]
    note = "± is one standard deviation, from the lens's own calibration."
    return Table.of(rows, "Lenses", [note])


def rig_table(stereo: StereoModel) -> Table:
    """Table of the projector's pose in the camera frame."""
    R, t = stereo.rig.R, np.ravel(stereo.rig.t)
    axes_deg = np.degrees(np.arccos(np.clip(R[2, 2], -1, 1)))
    offsets = " / ".join(f"{v:.2f}" for v in t).replace("-", "−")
    figures = {
        "baseline (distance of the two devices)": f"{stereo.baseline_mm:.2f} mm",
        "t, camera to projector (x, y, z)": f"{offsets} mm",
        "angle between the optical axes": f"{axes_deg:.2f}°",
        "rotation, camera to projector": f"{np.degrees(rotation_angle(R)):.2f}°",
        "depths of the boards": _format_depths(stereo),
        "target": stereo.board or "imported",
    }
    return Table.of_figures(figures, "Rig")


def _format_depths(stereo: StereoModel) -> str:
    """Text of the calibrated depth range, mm; "unknown" without one."""
    if stereo.depth_range_mm is None:
        return "unknown"
    return "{:.0f} to {:.0f} mm".format(*stereo.depth_range_mm)


def _records_section(view: RecordsView) -> Section:
    """The section with the tables and pictures of the records of one kind."""
    text = inspect.cleandoc(view.kind.__doc__ or "").split("\n\n")[0].replace("\n", " ")
    notices = [
        PageNotice(f"{each.summary()}.") for each in view.records.values() if not each.is_good
    ]
    return Section(
        view.kind.title, text, [*notices, *view.kind.tables(view.records), *view.figures]
    )


_LEVELS: dict[str, tuple[str, str]] = {
    "good": ("Good: no problems detected.", "good"),
    "doubtful": ("Doubtful: use it with care, or correct the causes first.", "warning"),
    "rejected": ("Rejected: do not measure with this calibration.", "warning"),
}


def _verdict_section(verdict: Verdict, of_calibration: bool) -> Section:
    """The section with the verdict's level, and every finding with its remedy."""
    words, kind = _LEVELS[verdict.level]
    items: list[Item] = [PageNotice(words, kind)]  # type: ignore[arg-type]
    for finding in verdict.findings:
        is_corrected = finding.severity == "note"
        what = "Already corrected." if is_corrected else f"What to do: {finding.remedy}."
        items.append(
            PageNotice(f"{finding.sentence}. {what}", "plain" if is_corrected else "warning")
        )
    text = (
        ""
        if of_calibration
        else "This verdict is on the last attempt to calibrate, which gave no calibration."
    )
    return Section("Verdict", text, items)


COLOURS: dict[Decision, str] = {"pass": "#1f9673", "fail": "#c2362e", "undecided": "#c98a12"}


def write_parts_page(path: Path, found: Inspection) -> None:
    """Write the report on parts as one HTML file."""
    headlines = [Headline(str(len(found.parts)), "parts")]
    for decision, count in found.count_parts().items():
        is_marked = decision == "pass" or (decision == "fail" and count)
        headlines.append(Headline(str(count), decision, "", MARKS[decision] if is_marked else ""))
    names = [each.part for each in found.parts]
    charts = [
        _trend_chart(wanted, names, [each.results[k] for each in found.parts])
        for k, wanted in enumerate(found.characteristic)
    ]
    sections = [
        Section("Parts and characteristics", "", Inspection.tables({found.plan: found})),
        Section(
            "Trends",
            "Values with U (k = 2) in the order of the parts; lines are the limits.",
            charts,
        ),
    ]
    subtitle = format_count(len(found.characteristic), "characteristic")
    frame = "in the camera's frame" if found.alignment == "none" else "in part coordinates"
    write_page(path, f"Inspection: {found.plan}", subtitle, headlines, sections, frame=frame)


def _trend_chart(
    wanted: Characteristic, names: Sequence[str], results: Sequence[CharacteristicResult]
) -> Figure:
    """The values of one characteristic over the parts, with U and the limits."""
    drawing = new_figure(HALF, 260)
    axes = drawing.add_subplot()
    style_axes(axes, wanted.name, "part", f"{wanted.kind}, {wanted.unit}")
    for decision, colour in COLOURS.items():
        at = [
            k
            for k, each in enumerate(results)
            if each.value is not None and each.decision == decision
        ]
        values, U = ([getattr(results[k], what) for k in at] for what in ("value", "U"))
        axes.errorbar(
            np.array(at) + 1,
            values,
            U,
            fmt="o",
            color=colour,
            markersize=3.6,
            linewidth=0.9,
            capsize=1.5,
        )
    for limit, style, colour in (
        (wanted.lower, "--", INK),
        (wanted.upper, "--", INK),
        (wanted.nominal, ":", SOFT),
    ):
        if limit is not None:
            axes.axhline(limit, color=colour, linewidth=0.9, linestyle=style)
    axes.set_xlim(0.5, len(results) + 0.5)
    axes.xaxis.get_major_locator().set_params(integer=True)
    listed = ", ".join(
        f"{k + 1} {names[k]}" for k, each in enumerate(results) if each.decision == "fail"
    )
    words = f"Fail: {listed}." if listed else "No part fails."
    return finish_figure(
        drawing,
        f"{wanted.name}. {words}",
        f"Trend of {wanted.name} over {len(results)} parts. {words}",
    )
