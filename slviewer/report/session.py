"""Report sections of a session: captures, calibration and verification; and the report on many
parts, with a trend chart of each characteristic."""

import inspect
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from statistics import median
from typing import Any, Literal

import numpy as np

from slviewer.calibration.stereo import StereoModel
from slviewer.geometry.lens import Lens
from slviewer.geometry.rigid import rotation_angle
from slviewer.printable import capitalize
from slviewer.records.acceptance import (
    MARKS,
    AcceptanceTest,
    Decision,
    Drift,
    ModelComparison,
    worst_decision,
)
from slviewer.records.calibration import ModelCalibration, Reprojection
from slviewer.records.inspection import Characteristic, CharacteristicResult, Inspection
from slviewer.records.measurement import Measurement
from slviewer.records.merge import Merge, Reconstruction
from slviewer.records.record import Cell, Column, Mark, Record, Table, Value, format_count, relabel
from slviewer.records.verdict import Verdict
from slviewer.records.verification import Verification, average
from slviewer.report.maps import coverage, pose_bars, residual_arrows, rms_maps
from slviewer.report.page import (
    HALF,
    INK,
    SOFT,
    Figure,
    Headline,
    Item,
    PageNotice,
    Section,
    TitlePage,
    finish_figure,
    new_figure,
    style_axes,
    write_page,
)
from slviewer.session.capture import Capture
from slviewer.session.report_details import ReportDetails

RESULTS: tuple[type[Record], ...] = (Inspection, Measurement)
"""Kinds of records that are results; the others are annex, and begin with these."""
ANNEX: tuple[type[Record], ...] = (
    Verification, AcceptanceTest, Merge, Reconstruction, Drift, ModelComparison, ModelCalibration
)  # fmt: skip
EVIDENCE = AcceptanceTest, Drift
"""Of the annex, what also a report for a customer holds: tests of the rig with limits."""
TERMS = {
    "RMS": "root mean square: the typical size of deviations",
    "noise floor": "the RMS that the noise of a capture alone would give",
    "sigma": "standard deviation, k = 1",
    "U (k = 2)": "expanded uncertainty: with about 95 % probability the true value is within ± U",
    "calibrated depths": "distances from the camera at which the target was captured; nearer and"
    " farther the calibration is extrapolated",
    "stereo": "model of lenses and poses of both devices",
    "pixelwise": "model with a function of its own for each camera pixel",
    "splined": "stereo with smooth local corrections of both lenses",
    "reprojection": "where the calibration predicts the target's features, compared with where they"
    " were seen",
}
_MERGED = " Scans from several sides are registered onto each other and merged into one surface."
_METHODS = {
    False: "A projector casts stripe patterns on the object, and a camera records them. Which"
    " stripe each camera pixel sees gives, with the calibration of both, the position of a point."
    + _MERGED,
    True: "A projector casts stripe patterns on the object, and two cameras record them. Pixels of"
    " both that see the same stripes give, with the calibration of both, the position of a point."
    + _MERGED,
}
"""How was measured, whether two cameras did."""
DEVICES = ("camera", "projector")
WORST = 2.0
"""A pose whose reprojection error exceeds the RMS over the poses this many times is marked."""


@dataclass(frozen=True)
class CaptureUse:
    """Whether the calibration uses a capture, and ``why`` it does not."""

    capture: Capture
    state: Literal["used", "unused", "excluded", "scan", "known shape", "waiting"]
    why: str = ""


@dataclass(frozen=True, eq=False)
class CalibrationFigures:
    """A stereo calibration, the residuals of the model in use where it has any, else of stereo, and
    of each pose and device where these are, pixels (n, 2), and they themselves (n, 2) px, NaN where
    excluded or not read; empty where none were saved."""

    stereo: StereoModel
    reprojection: Reprojection
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
    of scans in their order: scan and words; ``labels``: {capture: what the operator calls it}.
    ``details`` of the title page, and its ``pictures``.
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
    labels: Mapping[str, str] = field(default_factory=dict)
    details: ReportDetails = field(default_factory=ReportDetails)
    pictures: Sequence[Figure] = ()


def session_title(data: SessionData) -> tuple[str, str]:
    """The page's title, the part's name if it is stated, and the sentence below it."""
    states = [each.state for each in data.captures]
    counts = [
        ("measured in", states.count("scan"), "scan"),
        ("checked on", states.count("known shape"), "known shape"),
        ("calibrated with", states.count("used"), "target pose"),
    ]
    listed = ", ".join(f"{verb} {format_count(n, noun)}" for verb, n, noun in counts if n)
    return data.details.part or data.name, listed and f"{capitalize(listed)}."


def make_title_page(data: SessionData) -> TitlePage:
    """The title page: details of the job, pictures, and whether the part is within its limits."""
    scans = [each.capture for each in data.captures if each.state == "scan"]
    days = sorted({str(each.meta.get("created", ""))[:10] for each in scans} - {""})
    measured = {"Measured on": " to ".join(dict.fromkeys((days[0], days[-1])))} if days else {}
    rows = data.details.rows() | measured
    decision, reasons = judge_part(data)
    kinds: dict[str, Any] = {"pass": "good", "fail": "bad", "undecided": "warning"}
    return TitlePage(
        {name: text for name, text in rows.items() if name != "Part"},  # the title
        decision or "not judged",
        kinds.get(decision or "", "plain"),
        reasons,
        data.pictures,
        data.details.logo,
    )


def judge_part(data: SessionData) -> tuple[Decision | None, list[str]]:
    """The decision by all inspections and tolerances, None where there are none, and what it rests
    on; nothing is decided with a rejected calibration."""
    decided: dict[str, Decision] = {}
    for view in data.records:
        for name, each in view.records.items():
            if isinstance(each, Inspection):
                decided[f"{each.summary()}."] = worst_decision(
                    {decision for decision, parts in each.count_parts().items() if parts}
                )
            elif isinstance(each, Measurement) and each.deviation and each.deviation.verdict:
                verdict = each.deviation.verdict
                decided[f"{name}: {verdict.text()}."] = verdict.decision
    if not decided:
        return None, ["No limits or tolerances were stated, so the part is measured, not judged."]
    level = "good" if data.verdict is None else data.verdict.level
    if level == "rejected":
        return "undecided", ["The calibration is rejected: its measurements decide nothing."]
    doubt = ["The calibration is doubtful: see the annex."] if level == "doubtful" else []
    return worst_decision(set(decided.values())), [*decided, *doubt]


def session_headlines(data: SessionData) -> list[Headline]:
    """Headlines: the surface, its noise, the best flatness verified, tests with certified
    artefacts, and the verdict on the calibration."""
    records = {view.kind: list(view.records.items()) for view in data.records}
    headlines = []
    if merges := records.get(Merge):
        merge = merges[-1][1]
        note = f"from {format_count(len(merge.scans), 'scan')}"
        headlines.append(Headline(f"{merge.points:,}", "points of the merged surface", note))
    scans = {each.capture.name for each in data.captures if each.state == "scan"}
    noises = [
        each.noise_mm
        for _, each in records.get(Reconstruction, ())
        if each.noise_mm is not None and scans & each.inputs.keys()
    ]
    if noises:
        note = "standard deviation of depth, median over the scans"
        headlines.append(Headline(f"{median(noises):.3f} mm", "noise of a point", note))
    headlines += _plane_headline(data)
    if tests := records.get(AcceptanceTest):
        test = tests[-1][1]
        decision = test.decision or "not decided"
        label = f"test with {test.artefact.name}"
        headlines.append(Headline(decision, label, test.time[:10], MARKS.get(decision, "")))
    if data.verdict is not None:
        mark: Mark = "better" if data.verdict.level == "good" else "worse"
        findings = data.verdict.findings
        note = f"{format_count(len(findings), 'finding')}: see the annex" if findings else ""
        headlines.append(Headline(data.verdict.level, "verdict on the calibration", note, mark))
    return headlines


def _plane_headline(data: SessionData) -> list[Headline]:
    """Headline of the mean plane RMS of the model in use, else of the flattest, beside its noise
    floor."""
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
    model = data.model if data.model in means else found.best
    floor = found.models[model].noise_floor_mm
    note = f"model {model}" + ("" if floor is None else f"; noise alone gives {floor:.3f} mm")
    return [Headline(f"{means[model]:.3f} mm", "RMS deviation of a flat plate", note)]


def session_sections(data: SessionData, *, is_full: bool = True) -> list[Section]:
    """Sections: warnings, what was inspected and measured; as annex the other records, calibration,
    restrictions, method, and captures. Those of a customer, unless ``is_full``, hold of the annex
    what proves and limits the results."""
    views = {view.kind: view for view in data.records}
    results = [_records_section(views.pop(kind), data.labels) for kind in RESULTS if kind in views]
    first = [views.pop(kind) for kind in ANNEX if kind in views]
    others, skipped = [*first, *views.values()], list[RecordsView]()
    if not is_full:
        skipped = [view for view in others if view.kind not in EVIDENCE]
        others = [view for view in others if view.kind in EVIDENCE]
    annex = [_records_section(view, data.labels) for view in others]
    if data.verdict is not None:
        annex.append(_verdict_section(data.verdict, data.verdict_of_calibration))
    if is_full:
        annex += _calibration_sections(data)
    if data.region or data.edits:
        annex.append(_restrictions_section(data))
    annex += [_method_section(data), *([_captures_section(data)] if is_full else [])]
    return [
        *_notice_section(data, skipped),
        *results,
        *(replace(each, is_annex=True) for each in annex),
    ]


def _calibration_sections(data: SessionData) -> Iterator[Section]:
    """Yield the sections on the calibration's residuals and parameters."""
    if data.calibration is not None:
        yield _reprojection_section(data.calibration)
        yield _parameters_section(data.calibration)
    if data.pixel_fits:
        text = (
            "Each camera pixel's own rational function from phase to depth, and lines from depth to"
            " x and y."
        )
        maps = [rms_maps(rms, axis) for axis, rms in data.pixel_fits.items()]
        yield Section("Pixel-wise model", text, maps)


def _parameters_section(calibration: CalibrationFigures) -> Section:
    """The section with the parameters of lenses and rig."""
    stereo, of = calibration.stereo, calibration.reprojection
    text = (
        f"Lenses (pinhole and Brown distortion) of camera and {of.other}, and where the {of.other}"
        " is in the camera's frame."
    )
    tables = [of.rename(each) for each in (lens_table(stereo), rig_table(stereo))]
    return Section("Parameters", text, tables)


def _method_section(data: SessionData) -> Section:
    """The section about how was measured, in what environment, and what terms mean."""
    text = [_METHODS[any(each.capture.is_of_pair for each in data.captures)]]
    if data.model:
        used = f"Measured with the calibration model {data.model}"
        if data.model != data.recommended:
            used += f", as the operator has chosen; recommended: {data.recommended}"
        text.append(f"{used}.")
    known = data.details.rows().get("Temperature")
    text.append(f"Temperature: {known or 'not recorded'}.")
    scales = [PageNotice(f"{model}: {words}.", "plain") for model, words in data.scales.items()]
    table = Table.of([{"term": term, "meaning": words} for term, words in TERMS.items()], "Terms")
    return Section("Method and terms", text, [*scales, table])


def _notice_section(data: SessionData, skipped: Sequence[RecordsView]) -> list[Section]:
    """The section with warnings, with captures that are not used, and with what is not good of
    records whose sections are ``skipped``; an empty list if there are none."""
    known = {each.capture.name for each in data.captures if each.state == "known shape"}
    doubts = [
        f"{view.kind.title}, {data.labels.get(name, name)}: {each.summary()}"
        for view in skipped
        for name, each in view.records.items()
        if not (each.is_good or (isinstance(each, Reconstruction) and name in known))
    ]
    unused = [
        f"{each.capture.name} is {each.state}: {each.why or 'no reason was given'}"
        for each in data.captures
        if each.state in ("unused", "excluded")
    ]
    items = list(map(PageNotice, [*data.warnings, *unused, *doubts]))
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
        made = str(capture.meta.get("created", ""))[:16].replace("T", " ")
        size = sequence.projector_size
        periods = [f"{axis} {sequence.period_px(axis):g}" for axis in sequence.axes]
        rows.append(
            {
                "capture": capture.name,
                "called": data.labels.get(capture.name, ""),
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
                Column("made", align="centre"): made,
                "why not used": each.why,
                "hash": capture.hash,
            }
        )
    if not rows:
        return Section("Captures", "The session holds no captures yet.")
    note = (
        "Hash: BLAKE2b, 160 bits, of frames and description; the hash of every single frame is kept"
        " in this file."
    )
    table = Table.of(rows, "Captures of the session", [note]).without_empty()
    return Section("Captures", "", [table])


def _reprojection_section(calibration: CalibrationFigures) -> Section:
    """The section about reprojection errors: bars of each pose, residual arrows and image
    coverage."""
    stereo, residuals, of = calibration.stereo, calibration.residuals, calibration.reprojection
    sizes = {device: getattr(stereo.rig, device).size for device in DEVICES}
    items: list[Item] = []
    if of.pose_rms_px:
        items.append(pose_bars(of))
    if residuals:
        worst = max(residuals, key=lambda name: max(of.pose_rms_px.get(name, (0.0, 0.0))))
        items += [
            residual_arrows(
                f"{of.devices[device]}, {of.model}, {worst} (the worst pose)",
                *residuals[worst][device],
                size,
            )
            for device, size in sizes.items()
        ]
        items += [
            coverage(of.devices[device], size, [each[device][0] for each in residuals.values()])
            for device, size in sizes.items()
        ]
    if of.pose_rms_px:
        items.append(of.rename(_pose_table(of)))
    text = ["This calibration was made elsewhere, without a reprojection error."]
    if of.rms_px:
        text = [
            f"How far the target lies from where the {of.model} model predicts it, RMS:"
            f" {of.rms_text}. Target: {stereo.board}."
        ]
    if excluded := stereo.features_excluded:
        text.append(f"Excluded: {format_count(excluded, 'feature')} beyond 6 robust sigma.")
    return Section("Reprojection", text, items)


def _pose_table(of: Reprojection) -> Table:
    """Table of reprojection RMS by pose, px, with conspicuous poses marked."""
    typical = np.sqrt(np.nanmean(np.square(list(of.pose_rms_px.values())), axis=0))
    rows = []
    for name, values in of.pose_rms_px.items():
        high = np.array(values) > WORST * typical
        row: dict[Any, Value | Cell] = {"pose": name}
        for device, value, is_high in zip(DEVICES, values, high, strict=True):
            row[Column(device, "px")] = Cell(value, "worse" if is_high else "")
        rows.append({**row, "": Cell("look at this pose" if high.any() else "", "worse")})
    return Table.of(rows, f"Reprojection RMS of each pose, {of.model}").without_empty()


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


def _records_section(view: RecordsView, labels: Mapping[str, str]) -> Section:
    """The section with the tables and pictures of the records of one kind."""
    text = inspect.cleandoc(view.kind.__doc__ or "").split("\n\n")[0].replace("\n", " ")
    notices = [
        PageNotice(f"{each.summary()}.") for each in view.records.values() if not each.is_good
    ]
    tables = [relabel(each, labels) for each in view.kind.tables(view.records)]
    return Section(view.kind.title, text, [*notices, *tables, *view.figures])


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
            PageNotice(f"{finding.observation}. {what}", "plain" if is_corrected else "warning")
        )
    text = (
        ""
        if of_calibration
        else "This verdict is on the last attempt to calibrate, which gave no calibration."
    )
    return Section("Verdict on the calibration", text, items)


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
