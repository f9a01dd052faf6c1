"""Report sections of a session: captures, calibration and verification; and the report on many
parts, with a trend chart of each characteristic."""

import inspect
from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from slviewer.calibration.stereo import StereoModel
from slviewer.evaluation.render import format_count
from slviewer.geometry.lens import Lens
from slviewer.geometry.rigid import rotation_angle
from slviewer.records.acceptance import MARKS, Decision
from slviewer.records.inspection import Characteristic, CharacteristicResult, Inspection
from slviewer.records.table import Cell, Column, Mark, Rows, Table
from slviewer.records.verdict import Verdict
from slviewer.records.verification import Verification
from slviewer.report.canvas import (
    HALF,
    INK,
    SOFT,
    finish_figure,
    new_figure,
    percentile,
    style_axes,
)
from slviewer.report.data import CalibrationFigures, ModelsView, RecordsView, SessionData
from slviewer.report.maps import rms_maps
from slviewer.report.page import Figure, Headline, Item, PageNotice, Section, write_page
from slviewer.report.reprojection import coverage, pose_bars, residual_arrows

WORST = 2.0
"""A pose whose reprojection error exceeds the RMS over the poses this many times is marked."""


def session_title(data: SessionData) -> tuple[str, str]:
    """The page's title and the sentence below it."""
    poses = sum(row.state == "used" for row in data.captures)
    scans = sum(row.role == "scan" for row in data.captures)
    return (
        data.name,
        (
            f"{format_count(len(data.captures), 'capture')}: {format_count(poses, 'target pose')}"
            f" used to calibrate, {format_count(scans, 'scan')}."
        ),
    )


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
        used = sum(row.state == "used" for row in data.captures)
        wanted = sum(row.role == "calibration" for row in data.captures)
        note = f"boards at {_format_depths(stereo)}"
        headlines.append(Headline(f"{used} of {wanted}", "target poses used", note))
        if rms := stereo.reprojection_rms_px:
            headlines.append(
                Headline(
                    f"{rms.get('camera', np.nan):.3f} / {rms.get('projector', np.nan):.3f} px",
                    "reprojection RMS, camera / projector",
                    f"both devices together {rms['stereo']:.3f} px" if "stereo" in rms else "",
                )
            )
    fits = [(percentile(rms[0], 50), axis) for axis, rms in data.pixel_fits.items()]
    if known := [fit for fit in fits if np.isfinite(fit[0])]:
        rms_z, axis = min(known)
        note = f"median over the pixels, axis {axis}"
        headlines.append(Headline(f"{rms_z:.3f} mm", "pixel-wise fit, RMS in z", note))
    return headlines + _plane_headline(data)


def _plane_headline(data: SessionData) -> list[Headline]:
    """Headline of the flattest model's mean plane RMS, beside its noise floor and the other
    models'."""
    rms, floors = defaultdict[str, list[float]](list), defaultdict[str, list[float]](list)
    for each in (each for view in data.records for each in view.records.values()):
        if isinstance(each, Verification) and each.shape == "plane":
            for model, fit in each.models.items():
                rms[model] += [] if fit.rms_mm is None else [fit.rms_mm]
                floors[model] += [] if fit.noise_floor_mm is None else [fit.noise_floor_mm]
    means = {model: float(np.mean(values)) for model, values in rms.items() if values}
    if not means:
        return []
    best = min(means, key=lambda model: means[model])
    notes = [f"noise floor {np.mean(floors[best]):.3f} mm"] if floors[best] else []
    notes += [f"{other} {mean:.3f} mm" for other, mean in means.items() if other != best]
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
            _parameters_section(data.calibration.stereo),
        ]
    if data.models is not None:
        sections.append(_models_section(data.models))
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
    unused = [row for row in data.captures if row.state in ("unused", "excluded")]
    items: list[Item] = [PageNotice(warning) for warning in data.warnings]
    items += [
        PageNotice(f"{row.name} is {row.state}: {row.why or 'no reason was given'}")
        for row in unused
    ]
    return [Section("Warnings", "", items)] if items else []


def _restrictions_section(data: SessionData) -> Section:
    """The section with the region of interest, and the points that were deleted from scans."""
    text = (
        f"Points of scans outside of the region of interest are not used: {data.region}."
        if data.region
        else ""
    )
    columns = [Column("scan"), Column("edit")]
    table = Table(columns, data.edits, "Edits in effect, in their order")
    return Section("Region and edits", text, [table] if data.edits else [])


def _captures_section(data: SessionData) -> Section:
    """The section with the table of captures: role, state, sizes, frames and why one is not
    used."""
    marks: dict[str, Mark] = {"used": "better", "unused": "worse", "excluded": "worse"}
    columns = [
        *(Column(title) for title in ("capture", "role", "state")),
        Column("camera", "px", align="right"),
        Column("projector", "px", align="right"),
        Column("frames"),
        Column("period", "px", align="centre"),
        *(Column(title) for title in ("made", "why not used")),
    ]
    rows: Rows = [
        [
            row.name,
            row.role,
            Cell(row.state, marks.get(row.state, "")),
            "{}x{}".format(*row.camera),
            "{}x{}".format(*row.projector) if row.projector else "unknown",
            row.frames,
            ", ".join(f"{axis} {period:g}" for axis, period in row.periods_px.items()),
            row.made,
            row.why,
        ]
        for row in data.captures
    ]
    if not rows:
        return Section("Captures", "The session holds no captures yet.")
    table = Table(columns, rows, "Captures of the session").without_empty()
    return Section("Captures", "", [table])


def _reprojection_section(calibration: CalibrationFigures) -> Section:
    """The section about reprojection errors: bars of each pose, residual arrows and image
    coverage."""
    stereo, residuals = calibration.stereo, calibration.residuals
    rms, cameras, projectors = (
        stereo.reprojection_rms_px,
        stereo.rig.camera.size,
        stereo.rig.projector.size,
    )
    items: list[Item] = []
    if stereo.pose_rms_px:
        items.append(pose_bars(stereo.pose_rms_px, rms))
    if residuals:
        worst = max(residuals, key=lambda name: max(stereo.pose_rms_px.get(name, (0.0, 0.0))))
        shown = residuals[worst]
        items += [
            residual_arrows(
                f"camera, {worst} (the worst pose)", shown.pixels, shown.camera, cameras
            ),
            residual_arrows(
                f"projector, {worst}", shown.projector_pixels, shown.projector, projectors
            ),
            coverage("camera", cameras, [r.pixels for r in residuals.values()]),
            coverage("projector", projectors, [r.projector_pixels for r in residuals.values()]),
        ]
    if stereo.pose_rms_px:
        items.append(_pose_table(stereo.pose_rms_px))
    excluded = stereo.features_excluded
    text = [
        (
            "How far the target's features lie from where the calibration predicts them, in px: "
            + ", ".join(f"{device} {value:.3f}" for device, value in rms.items())
            + f". Target: {stereo.board}."
            if rms
            else "This calibration was made elsewhere, without a reprojection error."
        )
    ]
    if excluded:
        text.append(f"Excluded: {format_count(excluded, 'feature')} beyond 6 robust sigma.")
    return Section("Reprojection", text, items)


def _pose_table(pose_rms_px: Mapping[str, tuple[float, float]]) -> Table:
    """Table of reprojection RMS by pose, px, with conspicuous poses marked."""
    typical = np.sqrt(np.nanmean(np.square(list(pose_rms_px.values())), axis=0))
    columns = [Column("pose"), Column("camera", "px"), Column("projector", "px")]
    rows: Rows = []
    for name, values in pose_rms_px.items():
        high = np.array(values) > WORST * typical
        cells = [Cell(v, "worse" if h else "") for v, h in zip(values, high, strict=True)]
        rows.append([name, *cells, Cell("look at this pose" if high.any() else "", "worse")])
    columns.append(Column(""))
    return Table(columns, rows, "Reprojection RMS of each pose").without_empty()


def lens_rows(stereo: StereoModel) -> list[tuple[str, str, str, str]]:
    """Table rows with both lenses' parameters as text: (name, unit, camera's, projector's)."""

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
    sigmas = stereo.focal_sigma_px
    camera = values(stereo.rig.camera, sigmas.get("camera", np.nan))
    projector = values(stereo.rig.projector, sigmas.get("projector", np.nan))
    return list(zip(names, ["px"] * 5 + [""] * 5, camera, projector, strict=True))


def rig_rows(stereo: StereoModel) -> list[tuple[str, str]]:
    """Table rows with the projector's pose in the camera frame as text: (quantity, value with its
    unit)."""
    R, t = stereo.rig.R, np.asarray(stereo.rig.t, float).ravel()
    angle = np.degrees(rotation_angle(R))
    axes = np.degrees(np.arccos(np.clip(R[2, 2], -1, 1)))
    return [
        ("baseline (distance of the two devices)", f"{np.linalg.norm(t):.2f} mm"),
        (
            "t, camera to projector (x, y, z)",
            " / ".join(f"{v:.2f}" for v in t).replace("-", "−") + " mm",
        ),
        ("angle between the optical axes", f"{axes:.2f}°"),
        ("rotation, camera to projector", f"{angle:.2f}°"),
        ("depths of the boards", _format_depths(stereo)),
    ]


def _format_depths(stereo: StereoModel) -> str:
    """Text of the calibrated depth range, mm; "unknown" without one."""
    if stereo.depth_range_mm is None:
        return "unknown"
    return "{:.0f} to {:.0f} mm".format(*stereo.depth_range_mm)


def _parameters_section(stereo: StereoModel) -> Section:
    """The section with the parameters of both lenses and the pose of the projector."""
    columns = [
        Column("parameter"),
        Column("unit", align="centre"),
        Column("camera", align="right"),
        Column("projector", align="right"),
    ]
    note = "± is one standard deviation, from the lens's own calibration."
    return Section(
        "Parameters",
        "Pinhole and Brown distortion of both devices, and where the projector stands in the"
        " camera's frame.",
        [
            Table(columns, lens_rows(stereo), "Lenses", [note]),
            Table([Column("quantity"), Column("value", align="right")], rig_rows(stereo), "Rig"),
        ],
    )


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


def _models_section(models: ModelsView) -> Section:
    """The section about the model that is used, and corrections of scale."""
    items: list[Item] = [
        PageNotice(f"{model}: {words}.", "plain") for model, words in models.scales.items()
    ]
    used = f"Measured with {models.used}"
    used += (
        "."
        if models.used == models.recommended
        else f", as the operator has chosen; recommended: {models.recommended}."
    )
    return Section("Model in use", used, items)


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
