"""Report sections of a session: captures, calibration and verification."""

import inspect
from collections.abc import Mapping

import numpy as np

from slviewer.calibration.stereo import StereoModel
from slviewer.evaluation.render import format_count
from slviewer.geometry.lens import Lens
from slviewer.records.table import Cell, Column, Mark, Table
from slviewer.records.verification import Verification
from slviewer.report.canvas import percentile
from slviewer.report.data import CalibrationFigures, RecordsView, SessionData
from slviewer.report.maps import rms_maps
from slviewer.report.page import Headline, Item, PageNotice, Section
from slviewer.report.quality import (
    models_section,
    verdict_headline,
    verdict_section,
)
from slviewer.report.reprojection import coverage, pose_bars, residual_arrows
from slviewer.report.tables import format_number

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
    """Headlines: poses used, reprojection error, RMS of the fit, and the best flatness verified."""
    headlines = [] if data.verdict is None else [verdict_headline(data.verdict)]
    calibration = data.calibration
    if calibration is not None:
        used = sum(row.state == "used" for row in data.captures)
        wanted = sum(row.role == "calibration" for row in data.captures)
        note = f"boards at {_format_depths(calibration.stereo)}"
        headlines.append(Headline(f"{used} of {wanted}", "target poses used", note))
        rms = calibration.stereo.reprojection_rms_px
        if rms:
            headlines.append(
                Headline(
                    f"{rms.get('camera', np.nan):.3f} / {rms.get('projector', np.nan):.3f} px",
                    "reprojection RMS, camera / projector",
                    f"both devices together {rms['stereo']:.3f} px" if "stereo" in rms else "",
                )
            )
    fits = [(percentile(fit.rms_mm[0], 50), fit.axis) for fit in data.pixel_fits]
    fits = [fit for fit in fits if np.isfinite(fit[0])]
    if fits:
        rms_z, axis = min(fits)
        headlines.append(
            Headline(
                f"{rms_z:.3f} mm",
                "pixel-wise fit, RMS in z",
                f"median over the pixels, axis {axis}",
            )
        )
    return headlines + _plane_headline(data)


def _plane_headline(data: SessionData) -> list[Headline]:
    """Headline of the flattest model's mean plane RMS, beside its noise floor and the other
    models'."""
    fits = [
        (model, fit)
        for view in data.records
        if view.kind is Verification
        for each in view.records.values()
        if each.shape == "plane"
        for model, fit in each.models.items()
    ]
    rms = {
        model: [fit.rms_mm for name, fit in fits if name == model and fit.rms_mm is not None]
        for model, _ in fits
    }
    means = {model: float(np.mean(values)) for model, values in rms.items() if values}
    if not means:
        return []
    best = min(means, key=lambda model: means[model])
    floors = [
        fit.noise_floor_mm for name, fit in fits if name == best and fit.noise_floor_mm is not None
    ]
    notes = [f"noise floor {np.mean(floors):.3f} mm"] if floors else []
    notes += [f"{other} {mean:.3f} mm" for other, mean in means.items() if other != best]
    mark: Mark = "better" if len(means) > 1 else ""
    return [Headline(f"{means[best]:.3f} mm", f"mean plane RMS, {best}", "; ".join(notes), mark)]


def session_sections(data: SessionData) -> list[Section]:
    """Sections: warnings, then calibration, verification and clouds as far as present, then the
    captures."""
    sections = _notice_section(data)
    if data.verdict is not None:
        sections.append(verdict_section(data.verdict, data.verdict_of_calibration))
    if data.calibration is not None:
        sections += [
            _reprojection_section(data.calibration),
            _parameters_section(data.calibration.stereo),
        ]
    if data.models is not None:
        sections.append(models_section(data.models))
    if data.pixel_fits:
        sections.append(_pixel_fits_section(data))
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
    columns = [Column("scan", align="left"), Column("edit", align="left")]
    table = Table(
        columns, [[scan, words] for scan, words in data.edits], "Edits in effect, in their order"
    )
    return Section("Region and edits", text, [table] if data.edits else [])


def _captures_section(data: SessionData) -> Section:
    """The section with the table of captures: role, state, sizes, frames and why one is not
    used."""
    marks: dict[str, Mark] = {"used": "better", "unused": "worse", "excluded": "worse"}
    columns = [
        Column("capture", align="left"),
        Column("role", align="left"),
        Column("state", align="left"),
    ]
    columns += [
        Column("camera", "px"),
        Column("projector", "px"),
        Column("frames"),
        Column("period", "px", align="centre"),
    ]
    columns += [Column("made", align="left"), Column("why not used", align="left")]
    rows: list[list[str | Cell]] = [
        [
            row.name,
            row.role,
            Cell(row.state, marks.get(row.state, "")),
            f"{row.camera[0]}x{row.camera[1]}",
            f"{row.projector[0]}x{row.projector[1]}" if row.projector else "unknown",
            str(row.frames),
            ", ".join(f"{axis} {period:g}" for axis, period in row.periods_px.items()),
            row.made,
            row.why,
        ]
        for row in data.captures
    ]
    filled = [i for i, _ in enumerate(columns) if i < 7 or any(row[i] for row in rows)]
    table = Table(
        [columns[i] for i in filled],
        [[row[i] for i in filled] for row in rows],
        "Captures of the session",
    )
    return Section(
        "Captures", "" if rows else "The session holds no captures yet.", [table] if rows else []
    )


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
    columns = [Column("pose", align="left"), Column("camera", "px"), Column("projector", "px")]
    rows: list[list[str | Cell]] = []
    for name, values in pose_rms_px.items():
        high = [value > WORST * usual for value, usual in zip(values, typical, strict=True)]
        shown = [
            Cell(f"{v:.3f}", "worse") if h else format_number(v)
            for v, h in zip(values, high, strict=True)
        ]
        rows.append([name, *shown, Cell("look at this pose", "worse") if any(high) else ""])
    if any(row[3] for row in rows):
        columns.append(Column("", align="left"))
    return Table(columns, [row[: len(columns)] for row in rows], "Reprojection RMS of each pose")


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
        "focal length fx",
        "focal length fy",
        "principal point cx",
        "principal point cy",
    ]
    names += ["radial k1", "radial k2", "tangential p1", "tangential p2", "radial k3"]
    sigmas = stereo.focal_sigma_px
    camera = values(stereo.rig.camera, sigmas.get("camera", np.nan))
    projector = values(stereo.rig.projector, sigmas.get("projector", np.nan))
    return list(zip(names, ["px"] * 5 + [""] * 5, camera, projector, strict=True))


def rig_rows(stereo: StereoModel) -> list[tuple[str, str]]:
    """Table rows with the projector's pose in the camera frame as text: (quantity, value with its
    unit)."""
    R, t = stereo.rig.R, np.asarray(stereo.rig.t, float).ravel()
    angle = np.degrees(np.arccos(np.clip((np.trace(R) - 1) / 2, -1, 1)))
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
        Column("parameter", align="left"),
        Column("unit", align="centre"),
        Column("camera"),
        Column("projector"),
    ]
    note = "± is one standard deviation, from the lens's own calibration."
    return Section(
        "Parameters",
        "Pinhole and Brown distortion of both devices, and where the projector stands in the"
        " camera's frame.",
        [
            Table(columns, lens_rows(stereo), "Lenses", [note]),
            Table([Column("quantity", align="left"), Column("value")], rig_rows(stereo), "Rig"),
        ],
    )


def _pixel_fits_section(data: SessionData) -> Section:
    """The section about the pixel-wise fits: RMS maps of each axis."""
    return Section(
        "Pixel-wise model",
        "Each camera pixel's own rational function from phase to depth, and lines from depth to x"
        " and y.",
        [rms_maps(fit.rms_mm, fit.axis) for fit in data.pixel_fits],
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
