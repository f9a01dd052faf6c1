"""Step 4: calibrate the models from the good poses, and inspect the residuals of poses and
pixels."""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from slviewer.fringe.sequence import Axis
from slviewer.gui.colouring import DEPTH, paint_points, scan_values
from slviewer.gui.panel import StepPanel, scan_options
from slviewer.gui.scene import Click, Colour
from slviewer.gui.widgets import (
    PLOT_PX,
    TONES,
    Html,
    Plot,
    Text,
    Tone,
    alert,
    coloured,
    help_link,
    note,
    paragraph,
    properties_table,
    records_html,
    report_table,
    to_html,
)
from slviewer.pipeline.report import calibration_view
from slviewer.printable import capitalize
from slviewer.records.acceptance import ModelComparison
from slviewer.records.verdict import Finding, Verdict
from slviewer.report.maps import PixelCurve, pixel_curves, pose_bars, residual_arrows, rms_maps
from slviewer.report.page import Figure
from slviewer.report.session import CalibrationFigures, lens_table, rig_table
from slviewer.target.board import Board
from slviewer.wizard import result_views
from slviewer.wizard.snapshot import CalibrationView

USUAL_WEIGHT = "80 % or more is usual"
_MOST_NAMED = 6  # poses of a verdict that are offered as buttons: they fit on two lines
_LEVELS: dict[str, tuple[Tone, str, str]] = {
    "good": ("good", "Good", "no problems detected."),
    "doubtful": ("warning", "Doubtful", "use it with care, or correct this first:"),
    "rejected": ("error", "Rejected", "do not measure with it. Causes and remedies:"),
}
_MARKS: dict[Tone, str] = {
    "good": '<path d="M5 10.5l3.4 3.4L15 7"/>',
    "warning": '<path d="M10 4.5v7M10 15v.2"/>',
    "error": '<path d="M6 6l8 8M14 6l-8 8"/>',
}


class CalibratePanel(StepPanel):
    """Panel of the step Calibrate."""

    key = "calibrate"

    _cloud: result_views.ScanCloud | None = None
    _pixel_chosen = False
    _drawn_boards: tuple[Any, ...] = ()
    _details: tuple[tuple[Any, ...], CalibrationFigures] | None = None
    _chosen = ""  # the operator's model in the latest snapshot

    def build(self) -> None:
        """Create the inputs, plots and tables."""
        gui, operator = self._gui, self._operator
        self._boards = self._scene.layer("calibrate/boards")
        self._verdict = Text(gui)
        self._anyway = self.setting(
            self.checkbox("Accept anyway", "Uses this calibration although it was rejected"),
            operator.accept_rejected_calibration,
        )
        self._named = self.button_group("Show pose", "–", lambda name: self._pose.choose(name))
        self._summary = Text(gui)
        self._calibrate = self.button("Calibrate", operator.calibrate, "target", None)
        with gui.add_folder("Models") as self._models_folder:
            self._choice_note = Text(gui)
            self._use = self.choice(
                "Model",
                "Used for scans and verifications",
                do=lambda: operator.choose_model(self._use.value),
            )
            self._compare = self.button(
                "Compare models", operator.compare_models, "scale",
                hint="Cross-validation: measures each pose by calibrations without it; "
                "takes a minute or more",
            )  # fmt: skip
            self._comparison = Text(gui)
        with gui.add_folder("Reprojection error") as self._poses_folder:
            self._bars = Plot(gui)
            self._pose = self.choice("Pose")
            self._pose_note = Text(gui)
            self._exclude = self.button("Exclude this pose", self._toggle_pose)
            self._device = self.choice("Residuals")
            self._arrows = Plot(gui)
        with gui.add_folder("Parameters", expand_by_default=False) as self._parameters_folder:
            self._parameters = Text(gui)
        with gui.add_folder("Pixel-wise model") as self._pixels_folder:
            self._fits = Text(gui)
            self._axis = self.choice("Axis", "x: along the projector's columns; y: along its rows")
            self._maps = Plot(gui)
            self._column = self.number("Pixel u", 0, 0, step=1, hint="Column")
            self._row = self.number("Pixel v", 0, 0, step=1, hint="Row")
            self._over = self.choice("Cloud", "Click a point of it to choose its pixel")
            self._curve_note = Text(gui)
            self._curves = Plot(gui)

    def draw(self) -> None:
        """Show the calibration, and request the pictures of the chosen pose, axis and pixel."""
        snapshot, session, calibration = self.snapshot, self.session, self.session.calibration
        self._calibrate.disabled = snapshot.is_busy or self.is_blocked
        self._calibrate.label = "Calibrate again" if calibration else "Calibrate"
        self._draw_verdict(session.verdict)
        self._poses_folder.visible = bool(calibration and calibration.stereo.poses)
        self._parameters_folder.visible = calibration is not None
        self._pixels_folder.visible = bool(calibration and calibration.pixelwise)
        self._models_folder.visible = bool(
            calibration and len(calibration.models) > 1 and calibration.stereo.poses
        )
        if calibration is None:
            self._summary.set("")
            return
        excluded = exclusions_html(calibration, session.verdict)
        self._summary.set(excluded + _summary(calibration))
        if self._models_folder.visible:
            self._draw_models(calibration, snapshot.is_busy)
        states = ("used", "excluded", "unused")
        names = [pose.name for pose in session.poses if pose.state in states]
        worst_px = {name: max(px) for name, px in calibration.reprojection.pose_rms_px.items()}
        self._pose.offer_names(names, max(worst_px, key=worst_px.__getitem__, default=""))
        clouds = scan_options(scan for scan in session.scans if scan.cloud != "absent")
        self._over.offer({"none": ""} | clouds)
        self._device.offer({text: each for each, text in calibration.reprojection.devices.items()})
        if calibration.pixelwise:
            self._axis.offer_names(calibration.pixelwise.axes)
            self._fits.set(report_table(calibration.pixelwise.table()))
        if not self._pixel_chosen:
            self._pixel_chosen = True
            u, v = np.round(calibration.stereo.rig.camera.K[:2, 2]).astype(int)
            self._column.value, self._row.value = max(int(u), 0), max(int(v), 0)
        self._request_pictures(calibration)

    def _draw_verdict(self, verdict: Verdict | None) -> None:
        """Show the verdict, and the poses that it names."""
        session, calibration = self.session, self.session.calibration
        if verdict:
            if calibration and session.verdict_of_calibration:
                verdict = calibration.reprojection.judge(verdict, calibration.best)
            self._verdict.set(verdict_html(verdict, session.verdict_of_calibration, calibration))
        elif calibration and calibration.stereo.board:
            self._verdict.write("No verdict on this calibration: calibrate again for one.")
        else:
            self._verdict.set("")
        self._anyway.handle.visible = bool(calibration and calibration.rejected)
        self._anyway.update(bool(calibration and calibration.is_pinned))
        known = calibration.reprojection.pose_rms_px if calibration else {}
        names = [name for name in named_poses(verdict, calibration) if name in known]
        if names:
            self._named.options = tuple(names[:_MOST_NAMED])
        self._named.visible = bool(names)

    def _draw_models(self, calibration: CalibrationView, busy: bool) -> None:
        """Show the choice and the comparison of the models."""
        stated = self.session.verdict.causes if self.session.verdict else ()
        found = self.session.list_records(ModelComparison)
        compared = next((each.record for each in found if not each.stale), None)
        self._choice_note.set(model_choice_html(calibration, compared))
        options = {f"{calibration.recommended} (recommended)": ""}
        options |= {model: model for model in calibration.models}
        self._use.offer(options, calibration.chosen)
        if calibration.chosen != self._chosen:
            self._chosen = calibration.chosen
            self._use.choose(calibration.chosen)
        self._compare.disabled = busy or bool(calibration.stale)
        self._compare.label = "Compare models" if compared is None else "Compare again"
        splined = Html("")
        if calibration.splined:
            splined = report_table(calibration.reprojection.rename(calibration.splined.table()))
        elif calibration.missing and "too-few-poses" not in stated:
            splined = note(f"No splined model: {calibration.missing}.")
        self._comparison.set(records_html(found) + splined)

    def show(self, visible: bool) -> None:
        """Show or hide the layers, and react to clicks into the scene while shown."""
        super().show(visible)
        self._scene.on_click(self._pick_pixel if visible else None)

    # pictures

    def _request_pictures(self, calibration: CalibrationView) -> None:
        """Request the pictures of the chosen pose, axis and pixel."""
        context, stereo, request = self.context, calibration.stereo, self.painter.request
        made = fingerprint(calibration)
        if stereo.poses:
            request(
                self._bars.set,
                made,
                lambda: pose_bars(calibration.reprojection, width=PLOT_PX),
            )
        self._draw_pose(calibration)
        self._draw_boards(calibration)
        self._request_cloud()
        request(self._parameters.set, made, lambda: _parameters(self._load_details(made)))
        axis: Axis = self._axis.value
        if calibration.pixelwise is None or axis not in calibration.pixelwise.axes:
            return
        request(
            self._maps.set,
            (made, axis),
            lambda: rms_maps(
                result_views.pixel_fits(context.session)[axis].rms_mm, axis, width=PLOT_PX
            ),
        )
        pixel = (int(self._column.value), int(self._row.value))
        request(
            self._draw_curve,
            (made, axis, pixel),
            lambda: (pixel, result_views.pixel_curve(context.session, pixel, axis)),
        )

    def _draw_pose(self, calibration: CalibrationView) -> None:
        """Show the reprojection error of the chosen pose, and request its residuals as arrows."""
        name, device = self._pose.value, self._device.value
        pose = self.snapshot.pose(name)
        if pose is None:
            return
        excluded = pose.state == "excluded"
        self._exclude.label = f"Include {name} again" if excluded else f"Exclude {name}"
        rms, model = calibration.reprojection.pose_rms_px.get(name), calibration.reprojection.model
        if rms is None:
            why = f": {pose.why}" if pose.why else ""
            self._pose_note.write(
                f"{name} is not in this calibration ({pose.state}{why}).", "warning"
            )
            self.painter.cancel(self._arrows.set)
            self._arrows.set(None)
            return
        other = calibration.reprojection.other
        text = f"{name}, {calibration.label}: camera {rms[0]:.3f} px, {other} {rms[1]:.3f} px."
        if calibration.splined and name in calibration.splined.weights:
            camera, projector = calibration.splined.weights[name]
            weights = f"features {100 * camera:.0f} %, phase {100 * projector:.0f} %"
            text += f" Weight in the joint adjustment: {weights}; {USUAL_WEIGHT}."
        if excluded:
            text += " Excluded since: calibrate again."
        self._pose_note.write(text, "warning" if excluded else "plain")
        made = fingerprint(calibration)

        def arrows() -> Figure | None:
            """Plot the residuals of the pose as arrows in the chosen device; None where there are
            none."""
            details = self._load_details(made)
            residuals, rig = details.residuals.get(name), details.stereo.rig
            if residuals is None:
                return None
            return residual_arrows(
                f"{name}, {calibration.reprojection.devices[device]}, {model}",
                *residuals[device],
                getattr(rig, device).size,
            )

        self.painter.request(self._arrows.set, (made, name, device), arrows)

    def _draw_boards(self, calibration: CalibrationView) -> None:
        """Draw the poses in 3D in the colours of their errors, the chosen one thick."""
        stereo, splined, poses = calibration.stereo, calibration.splined, self.session.poses
        chosen, covered = self._pose.value, bool(self._over.value)
        states = tuple((pose.name, pose.state) for pose in poses)
        key = (fingerprint(calibration), chosen, covered, states)
        if key == self._drawn_boards:
            return
        self._drawn_boards = key
        self._boards.clear()
        if covered or not stereo.board:
            return
        outline = Board.parse(stereo.board).outline()
        worst_px = {name: max(px) for name, px in calibration.reprojection.pose_rms_px.items()}
        colours = colour_errors(worst_px, (splined.noise_px if splined else {}).values())
        for pose in poses:
            if pose.T_camera_board is not None and pose.name in worst_px:
                here = pose.name == chosen
                self._boards.board(
                    pose.name,
                    pose.T_camera_board,
                    outline,
                    colours[pose.name],
                    5.0 if here else 1.5,
                    label=pose.name if here else "",
                )

    def _load_details(self, made: tuple[Any, ...]) -> CalibrationFigures:
        """Return the calibration with its residuals, read once, on the painter's thread."""
        if self._details is None or self._details[0] != made:
            self._details = made, calibration_view(self.context.session)
        return self._details[1]

    def _draw_curve(self, made: tuple[tuple[int, int], PixelCurve | None]) -> None:
        """Show data and fit of a pixel, or that it has too few poses."""
        (u, v), curve = made
        if curve is None:
            text = f"Pixel ({u}, {v}) saw the board in too few poses: choose another."
            self._curve_note.write(text, "warning")
            self._curves.set(None)
        else:
            self._curve_note.set("")
            self._curves.set(pixel_curves(curve, width=PLOT_PX))

    # requests

    def _toggle_pose(self) -> None:
        """Request that the chosen pose be excluded, or included again."""
        pose = self.snapshot.pose(self._pose.value)
        if pose:
            is_excluded = pose.state == "excluded"
            (self._operator.include if is_excluded else self._operator.exclude)(pose.name)

    def _request_cloud(self) -> None:
        """Request the chosen cloud; without one, show the calibrated boards."""
        name = self._over.value
        if not name:
            self.painter.cancel(self._draw_cloud)
            self._cloud = self._shown = None
            self.layer.clear()
            self.context.viewpoints.overview()
        else:
            self.painter.request(
                self._draw_cloud,
                name,
                lambda: paint_depths(result_views.load_scan_cloud(self.context.session, name)),
            )

    def _draw_cloud(self, made: tuple[result_views.ScanCloud, np.ndarray]) -> None:
        """Draw a cloud in its colours, to choose pixels on."""
        cloud, painted = made
        self._cloud = cloud
        self.show_cloud(cloud.name, cloud.points, painted)

    def _pick_pixel(self, click: Click) -> None:
        """Choose the pixel whose point is closest to the clicked ray."""
        cloud = self._cloud
        if cloud and (pixel := cloud.nearest(click.origin, click.direction)):
            u, v = self._column.value, self._row.value = pixel
            self.layer.mark("picked", cloud.points[v, u], f"pixel ({u}, {v})")
            self.redraw()


def paint_depths(
    cloud: result_views.ScanCloud,
) -> tuple[result_views.ScanCloud, np.ndarray]:
    """Return a cloud, and its colours by depth."""
    return cloud, paint_points(scan_values(cloud), DEPTH)[0]


def fingerprint(calibration: CalibrationView) -> tuple[Any, ...]:
    """Return a key that changes with the calibration, for its pictures."""
    rig = calibration.stereo.rig
    return (
        calibration.models,
        calibration.best,
        rig.camera.K.tobytes(),
        rig.projector.K.tobytes(),
        rig.t.tobytes(),
    )


def colour_errors(rms_px: Mapping[str, float], noise_px: Iterable[float]) -> dict[str, Colour]:
    """Return the colours of poses by their reprojection RMS, px: green up to the median, or the
    features' noise in one direction where that is more, and red from three times it on."""
    both = [math.sqrt(2) * px for px in noise_px]  # a feature's error has two directions
    usual = max([float(np.median([*rms_px.values()])), *both])
    shares = {name: float(np.clip((px / usual - 1) / 2, 0, 1)) for name, px in rms_px.items()}
    return {
        name: (round(60 + 170 * share), round(170 - 110 * share), 70)
        for name, share in shares.items()
    }


def _summary(calibration: CalibrationView) -> Html:
    """Return a table of the calibration: errors, poses, depths, baseline and models."""
    stereo = calibration.stereo
    properties: dict[str, object] = {
        f"Reprojection RMS, {calibration.reprojection.devices[device]}": coloured(
            f"{rms:.3f} px ({calibration.label})", "plain", bold=True
        )
        for device, rms in calibration.reprojection.rms_px.items()
    }
    depths = stereo.depth_range_mm
    properties |= {
        "Poses used": f"{len(stereo.poses)} of {len(stereo.poses) + len(stereo.excluded)}",
        "Calibrated depths": "{:.0f} to {:.0f} mm".format(*depths) if depths else None,
        "Baseline": f"{stereo.baseline_mm:.2f} mm",
        "Models": ", ".join(calibration.models),
        "Model in use": "none: rejected" if calibration.refused else calibration.best,
        **calibration.scales,
    }
    return properties_table("Calibration", properties)


def _parameters(details: CalibrationFigures) -> Html:
    """Return tables of the lens and rig parameters with their standard deviations."""
    tables = lens_table(details.stereo), rig_table(details.stereo)
    lens, rig = (report_table(details.reprojection.rename(each)) for each in tables)
    return lens + rig


def verdict_html(
    verdict: Verdict, of_calibration: bool, calibration: CalibrationView | None
) -> Html:
    """Return the verdict as text, colour and icon, then every finding with its remedy.

    `of_calibration`: whether the judged attempt made the current calibration.
    """
    tone, level, meaning = _LEVELS[verdict.level]
    if verdict.level == "good" and of_calibration and calibration:
        meaning += describe_residuals(calibration)
    lines = [
        f'<div style="display:flex;gap:0.5em;align-items:flex-start">{_draw_icon(tone)}'
        f"<div>{coloured(level, tone, bold=True)}: {to_html(meaning)}</div></div>"
    ]
    lines += [_format_finding(finding) for finding in verdict.findings]
    if not of_calibration:
        end = "." if calibration is None else ": the previous one is shown below."
        text = to_html(f"This attempt gave no calibration{end}")
        lines.append(f'<div style="margin-top:0.5em">{text}</div>')
    return alert(Html("".join(lines)), tone)


def describe_residuals(calibration: CalibrationView) -> str:
    """Describe what the residuals that are drawn say of a good calibration, as a sentence."""
    of = calibration.reprojection
    if not of.pattern_px:
        return ""
    if not of.patterns:
        return f" The residuals of {of.model} are noise."
    return f" The residuals drawn are those of {calibration.label} pixel by pixel."


def named_poses(verdict: Verdict | None, calibration: CalibrationView | None) -> tuple[str, ...]:
    """List the poses that the verdict or the joint adjustment names, each once."""
    names = [name for finding in verdict.findings for name in finding.poses] if verdict else []
    if calibration and calibration.splined:
        names += calibration.splined.excluded
    return tuple(dict.fromkeys(names))


def exclusions_html(calibration: CalibrationView, verdict: Verdict | None) -> Html:
    """List excluded poses and features, each with its reason, but for the poses of which the
    verdict states it; empty where there are none."""
    n = calibration.stereo.features_excluded
    text = f"{n} outlying feature{'s' * (n != 1)} excluded (beyond 6 robust sigma)"
    outliers = note(f"{text}: shadow or occlusion.")
    findings, excluded = verdict.findings if verdict else (), calibration.stereo.excluded.items()
    stated = {name for each in findings for name in each.poses if name in each.observation}
    lines = [f"{name}: {why}" for name, why in excluded if name not in stated]
    if calibration.splined:
        lines += [
            f"{name}, in the splined model only: it {why}"
            for name, why in calibration.splined.excluded.items()
        ]
    lines = [line.replace("projector", calibration.reprojection.other) for line in lines]
    html = Html("")
    if lines:
        items = "".join(
            f'<li style="margin:0.15em 0">{to_html(_capitalise(line))}</li>' for line in lines
        )
        listed = f'<ul style="margin:0.2em 0 0;padding-left:1.2em">{items}</ul>'
        html = alert(Html(f"{coloured('Excluded', 'warning', bold=True)}{listed}"), "warning")
    return html + outliers if n else html


def model_choice_html(calibration: CalibrationView, compared: ModelComparison | None) -> Html:
    """Describe which model is used, and why, by their comparison if there is one."""
    if calibration.chosen and calibration.chosen != calibration.recommended:
        return alert(
            f"{calibration.chosen} is used (your choice); {calibration.recommended} is"
            " recommended.",
            "warning",
        )
    if compared is None:
        why = "by default; compare the models to confirm it."
    elif calibration.recommended in compared.models:
        why = "because its error on held-out boards is the smallest."
    else:
        why = "by default."
    model = coloured(calibration.best, "good", bold=True)
    return paragraph(Html(f"The {model} model is used {to_html(why)}"))


def _format_finding(finding: Finding) -> str:
    """Return the HTML of a finding and its remedy."""
    text, link = to_html(_capitalise(finding.observation, finding.poses)), help_link(finding.cause)
    if finding.severity == "note":
        return f'<div style="margin-top:0.5em">{coloured("Corrected:", "dim")} {text}. {link}</div>'
    remedy = coloured(f"{capitalize(finding.remedy)}.", "plain", bold=True)
    return f'<div style="margin-top:0.5em">{text}.<br>→ {remedy} {link}</div>'


def _capitalise(text: str, names: Sequence[str] = ()) -> str:
    """Return the text with a capital first letter, unless it begins with a name."""
    named = any(text.startswith(name) for name in names) or text.split(":")[0].count("_")
    return text if named else capitalize(text)


def _draw_icon(tone: Tone) -> str:
    """Return the SVG icon of a tone: a disc with a check mark, an exclamation mark or a cross."""
    return (
        '<svg viewBox="0 0 20 20" width="22" height="22" style="flex:none" fill="none"'
        ' stroke="#fff" stroke-width="2.2" stroke-linecap="round" stroke-linejoin="round"><circle'
        ' cx="10" cy="10" r="10" stroke="none"'
        f' fill="{TONES[tone]}"/>{_MARKS[tone]}</svg>'
    )
