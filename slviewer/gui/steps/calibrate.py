"""Step 4: calibrate the models from the good poses, and inspect the residuals of poses and
pixels."""

from collections.abc import Sequence
from typing import Any, cast

import numpy as np
import viser

from slviewer.fringe.sequence import Axis
from slviewer.gui.calibration_html import (
    exclusions_html,
    model_choice_html,
    named_poses,
    verdict_html,
)
from slviewer.gui.inputs import Choice, SessionValue, change, scan_options
from slviewer.gui.panel import PanelContext, StepPanel
from slviewer.gui.pictures import PLOT_PX, Plot
from slviewer.gui.scene import Stroke
from slviewer.gui.widgets import (
    Html,
    Text,
    coloured,
    paint,
    paragraph,
    records_html,
    report_table,
    table,
    to_html,
)
from slviewer.pipeline.report import calibration_view
from slviewer.pipeline.stored_records import Stored
from slviewer.records.model_comparison import ModelComparison
from slviewer.report.data import CalibrationFigures, PixelCurve
from slviewer.report.maps import pixel_curves, rms_maps
from slviewer.report.page import Figure
from slviewer.report.reprojection import pose_bars, residual_arrows
from slviewer.report.session import lens_rows, rig_rows
from slviewer.target.board import Board
from slviewer.wizard import result_views
from slviewer.wizard.snapshot import CalibrationView, SessionView, Snapshot

LAYER, BOARDS = "calibrate", "calibrated boards"
DEVICES = ("camera", "projector")
USUAL_WEIGHT = "80 % or more is usual"
_MOST_NAMED = 6  # poses of a verdict that are offered as buttons: they fit on two lines


class CalibratePanel(StepPanel):
    """Panel of the step Calibrate."""

    key = "calibrate"
    layers = (LAYER, BOARDS)

    def __init__(self, context: PanelContext) -> None:
        super().__init__(context)
        self._pixel_chosen = False
        self._boards: tuple[Any, ...] = ()
        self._details: tuple[tuple[Any, ...], CalibrationFigures] | None = None
        self._chosen = ""  # the operator's model in the latest snapshot

    def build(self) -> None:
        """Create the inputs, plots and tables."""
        gui, context, operator = self._gui, self._context, self._operator
        self._calibrate = context.button("Calibrate", operator.calibrate, viser.Icon.TARGET, None)
        self._verdict = Text(gui)
        hint = "Uses this calibration although it was rejected"
        self._anyway = gui.add_checkbox("Accept anyway", False, visible=False, hint=hint)
        self._anyway_value = SessionValue(self._anyway)
        self._named = gui.add_button_group("Show pose", ("–",), visible=False)
        self._exclusions = Text(gui)
        self._summary = Text(gui)
        with gui.add_folder("Models", visible=False) as self._models_folder:
            self._choice_note = Text(gui)
            self._use = Choice(gui, "Model", "Used for scans and verifications")
            self._compare = context.button(
                "Compare models", operator.compare_models, viser.Icon.SCALE,
                hint="Cross-validation: measures each pose by calibrations without it; "
                "takes a minute or more",
            )  # fmt: skip
            self._comparison = Text(gui)
            self._splined = Text(gui)
        with gui.add_folder("Reprojection error", visible=False) as self._poses_folder:
            self._bars = Plot(gui)
            self._pose = Choice(gui, "Pose")
            self._pose_note = Text(gui)
            self._exclude = context.button("Exclude this pose", self._toggle_pose, color="orange")
            self._device = gui.add_dropdown("Residuals", DEVICES)
            self._arrows = Plot(gui)
        with gui.add_folder(
            "Parameters", visible=False, expand_by_default=False
        ) as self._parameters_folder:
            self._parameters = Text(gui)
        with gui.add_folder("Pixel-wise model", visible=False) as self._pixels_folder:
            self._fits = Text(gui)
            self._axis = Choice(gui, "Axis", "x: along the projector's columns; y: along its rows")
            self._maps = Plot(gui)
            self._column = gui.add_number("Pixel u", 0, min=0, step=1, hint="Column")
            self._row = gui.add_number("Pixel v", 0, min=0, step=1, hint="Row")
            self._over = Choice(gui, "Cloud", "Click a point of it to choose its pixel")
            context.view_button(lambda: self._cloud.points if self._cloud else None)
            self._curve_note = Text(gui)
            self._curves = Plot(gui)
        self._anyway.on_update(context.callback(self._toggle_anyway))
        self._named.on_click(context.callback(self._show_named))
        self._use.on_change(context.callback(self._choose_model))
        for choice in (self._pose, self._axis):
            choice.on_change(context.callback(self._refresh))
        for handle in (self._device, self._column, self._row):
            handle.on_update(context.callback(self._refresh))
        self._over.on_change(context.callback(self._request_cloud))

    def draw(self, snapshot: Snapshot) -> None:
        """Show the calibration of a snapshot, and request its pictures."""
        with self._lock:
            self._snapshot = snapshot
            session, calibration, busy = snapshot.session, snapshot.calibration, snapshot.is_busy
            label = "Calibrate again" if calibration else "Calibrate"
            change(
                self._calibrate,
                disabled=busy or snapshot.step(self.key).state == "blocked",
                label=label,
            )
            self._draw_verdict(session, calibration)
            self._draw_models(
                session.list_records(ModelComparison) if session else [], calibration, busy
            )
            change(self._poses_folder, visible=bool(calibration and calibration.stereo.poses))
            change(self._parameters_folder, visible=calibration is not None)
            change(self._pixels_folder, visible=bool(calibration and calibration.pixelwise))
            self._summary.set(_summary(calibration) if calibration else "")
            if session is None or calibration is None:
                return
            names = [
                pose.name for pose in session.poses if pose.state in ("used", "excluded", "unused")
            ]
            self._pose.offer([(name, name) for name in names], worst(calibration))
            self._axis.offer(
                [(axis, axis) for axis in calibration.pixelwise.axes]
                if calibration.pixelwise
                else []
            )
            clouds = scan_options(scan for scan in session.scans if scan.cloud != "absent")
            self._over.offer([("", "none"), *clouds])
            self._fits.set(
                report_table(calibration.pixelwise.table()) if calibration.pixelwise else ""
            )
            if not self._pixel_chosen:
                self._pixel_chosen = True
                u, v = np.round(calibration.stereo.rig.camera.K[:2, 2]).astype(int)
                change(self._column, value=max(int(u), 0))
                change(self._row, value=max(int(v), 0))
            self._refresh()

    def _draw_verdict(
        self, session: SessionView | None, calibration: CalibrationView | None
    ) -> None:
        """Show the verdict, the poses that it names and the exclusions."""
        verdict = session.verdict if session else None
        if session is not None and verdict is not None:
            self._verdict.set(verdict_html(verdict, session.verdict_of_calibration, calibration))
        elif calibration is not None and calibration.stereo.board:
            self._verdict.write("No verdict on this calibration: calibrate again for one.", "plain")
        else:
            self._verdict.set("")
        change(self._anyway, visible=bool(calibration and calibration.rejected))
        self._anyway_value.update(bool(calibration and calibration.is_pinned))
        known = calibration.stereo.pose_rms_px if calibration else {}
        names = tuple(name for name in named_poses(verdict, calibration) if name in known)[
            :_MOST_NAMED
        ]
        if names and names != self._named.options:
            self._named.options = names
        change(self._named, visible=bool(names))
        self._exclusions.set(exclusions_html(calibration) if calibration else "")

    def _draw_models(
        self,
        found: Sequence[Stored[ModelComparison]],
        calibration: CalibrationView | None,
        busy: bool,
    ) -> None:
        """Show the choice and the comparison of the models, where there are several."""
        several = (
            calibration is not None
            and len(calibration.models) > 1
            and bool(calibration.stereo.poses)
        )
        change(self._models_folder, visible=several)
        if calibration is None or not several:
            return
        compared = next((each.record for each in found if not each.stale), None)
        self._choice_note.set(model_choice_html(calibration, compared))
        options = [("", f"{calibration.recommended} (recommended)")]
        self._use.offer(
            options + [(model, model) for model in calibration.models], calibration.chosen
        )
        if calibration.chosen != self._chosen:
            self._chosen = calibration.chosen
            self._use.choose(calibration.chosen)
        label = "Compare models" if compared is None else "Compare again"
        change(self._compare, disabled=busy or bool(calibration.stale), label=label)
        self._comparison.set(records_html(found))
        if calibration.splined is not None:
            self._splined.set(report_table(calibration.splined.table()))
        else:
            self._splined.write(
                f"No splined model: {calibration.missing}." if calibration.missing else "", "dim"
            )

    def show(self, visible: bool) -> None:
        """Show or hide the layers, and react to clicks into the scene while shown."""
        super().show(visible)
        self._scene.on_pick(self._pick_pixel if visible else None)

    # pictures

    def _refresh(self) -> None:
        """Request the pictures of the chosen pose, axis and pixel."""
        with self._lock:
            session = self._session
            if session is None or session.calibration is None:
                return
            calibration, context = session.calibration, self._context
            made = fingerprint(calibration)
            if calibration.stereo.poses:
                self._painter.request(
                    "bars",
                    made,
                    lambda: pose_bars(
                        calibration.stereo.pose_rms_px,
                        calibration.stereo.reprojection_rms_px,
                        width=PLOT_PX,
                    ),
                    self._bars.set,
                )
            self._draw_pose(session, calibration)
            self._draw_boards(session, calibration)
            self._painter.request(
                "parameters",
                made,
                lambda: _parameters(self._load_details(made)),
                self._parameters.set,
            )
            axis = cast(Axis, self._axis.value)
            if calibration.pixelwise is None or axis not in calibration.pixelwise.axes:
                return
            self._painter.request(
                "maps",
                (made, axis),
                lambda: rms_maps(
                    result_views.pixel_fits(context.session)[axis].rms_mm, axis, width=PLOT_PX
                ),
                self._maps.set,
            )
            pixel = (int(self._column.value), int(self._row.value))
            self._painter.request(
                "curves",
                (made, axis, pixel),
                lambda: (pixel, result_views.pixel_curve(context.session, pixel, axis)),
                self._draw_curve,
            )

    def _draw_pose(self, session: SessionView, calibration: CalibrationView) -> None:
        """Show the reprojection error of the chosen pose, and request its residuals as arrows."""
        name, device = self._pose.value, self._device.value
        pose = next((pose for pose in session.poses if pose.name == name), None)
        if pose is None:
            return
        excluded = pose.state == "excluded"
        change(self._exclude, label=f"Include {name} again" if excluded else f"Exclude {name}")
        rms = calibration.stereo.pose_rms_px.get(name)
        if rms is None:
            why = f": {pose.why}" if pose.why else ""
            self._pose_note.write(
                f"{name} is not in this calibration ({pose.state}{why}).", "warning"
            )
            self._painter.cancel("arrows")
            self._arrows.hide()
            return
        text = f"{name}: camera {rms[0]:.3f} px, projector {rms[1]:.3f} px."
        if calibration.splined is not None and name in calibration.splined.weights:
            camera, projector = calibration.splined.weights[name]
            weights = f"features {100 * camera:.0f} %, phase {100 * projector:.0f} %"
            text += f" Weight in the joint adjustment: {weights}; {USUAL_WEIGHT}."
        if excluded:
            self._pose_note.write(f"{text} Excluded since: calibrate again.", "warning")
        else:
            self._pose_note.write(text)
        made = fingerprint(calibration)

        def arrows() -> Figure | None:
            """Plot the residuals of the pose as arrows in the chosen device; None where there are
            none."""
            details = self._load_details(made)
            residuals, title = details.residuals.get(name), f"{name}, {device}"
            if residuals is None:
                return None
            if device == "camera":
                return residual_arrows(
                    title, residuals.pixels, residuals.camera, details.stereo.rig.camera.size
                )
            return residual_arrows(
                title,
                residuals.projector_pixels,
                residuals.projector,
                details.stereo.rig.projector.size,
            )

        self._painter.request("arrows", (made, name, device), arrows, self._arrows.set)

    def _draw_boards(self, session: SessionView, calibration: CalibrationView) -> None:
        """Draw the poses in 3D, coloured from green to red by reprojection error, the chosen one
        thick."""
        scene, chosen = self._scene, self._pose.value
        key = (
            fingerprint(calibration),
            chosen,
            bool(self._over.value),
            tuple((p.name, p.state) for p in session.poses),
        )
        if key == self._boards:
            return
        self._boards = key
        scene.clear(BOARDS)
        if self._over.value or not calibration.stereo.board:
            return
        outline = Board.parse(calibration.stereo.board).outline()
        usual = np.sqrt(
            np.mean(
                np.square([max(rms) for rms in calibration.stereo.pose_rms_px.values()] or [1.0])
            )
        )
        for pose in session.poses:
            if pose.T_camera_board is not None and pose.name in calibration.stereo.pose_rms_px:
                share = float(
                    np.clip(max(calibration.stereo.pose_rms_px[pose.name]) / usual - 0.5, 0, 1)
                )
                colour = (round(60 + 170 * share), round(170 - 110 * share), 70)
                here = pose.name == chosen
                label, stroke = (
                    (pose.name, Stroke(colour, 5.0)) if here else ("", Stroke(colour, 1.5))
                )
                scene.board(BOARDS, pose.name, pose.T_camera_board, outline, stroke, label=label)
        scene.show(BOARDS, self._visible)

    def _load_details(self, made: tuple[Any, ...]) -> CalibrationFigures:
        """Return the calibration with its residuals, read once, on the painter's thread."""
        if self._details is None or self._details[0] != made:
            self._details = made, calibration_view(self._context.session)
        return self._details[1]

    def _draw_curve(self, made: tuple[tuple[int, int], PixelCurve | None]) -> None:
        """Show data and fit of a pixel, or that it has too few poses."""
        (u, v), curve = made
        if curve is None:
            self._curve_note.write(
                f"Pixel ({u}, {v}) saw the board in too few poses: choose another.", "warning"
            )
            self._curves.hide()
            return
        self._curve_note.write("")
        self._curves.set(pixel_curves(curve, width=PLOT_PX))

    # requests

    def _toggle_anyway(self) -> None:
        """Request that the rejected calibration be used, or no longer."""
        calibration = self._snapshot.calibration if self._snapshot else None
        if (
            calibration is not None
            and calibration.rejected
            and self._anyway.value != calibration.is_pinned
        ):
            self._operator.accept_rejected_calibration(self._anyway.value)

    def _choose_model(self) -> None:
        """Request the chosen model, if it is another one."""
        if self._use.value != self._chosen:
            self._chosen = self._use.value
            self._operator.choose_model(self._use.value)

    def _show_named(self) -> None:
        """Choose the pose whose button was pressed."""
        self._pose.choose(self._named.value)
        self._refresh()

    def _toggle_pose(self) -> None:
        """Request that the chosen pose be excluded, or included again."""
        name = self._pose.value
        pose = self._snapshot.pose(name) if self._snapshot else None
        if pose is None:
            return
        if pose.state == "excluded":
            self._operator.include(name)
        else:
            self._operator.exclude(name)

    def _request_cloud(self) -> None:
        """Request the chosen cloud; without one, show the calibrated boards."""
        name = self._over.value
        if not name:
            self._painter.cancel("cloud")
            self._cloud = None
            self._scene.clear(LAYER)
            self._context.viewpoints.overview()
            self._refresh()
            return
        self._refresh()
        context = self._context
        self._painter.request(
            "cloud",
            name,
            lambda: result_views.load_scan_cloud(context.session, name),
            self._draw_cloud,
        )

    def _draw_cloud(self, cloud: result_views.ScanCloud) -> None:
        """Draw a cloud, coloured by depth, to choose pixels on."""
        self._cloud = cloud
        self._scene.cloud(LAYER, "cloud", cloud.points, paint(cloud.points[..., 2], "mm", 1, "")[0])
        self._scene.show(LAYER, self._visible)
        self._show_view()

    def _pick_pixel(self, origin: np.ndarray, direction: np.ndarray) -> None:
        """Choose the pixel whose point is closest to the clicked ray."""
        cloud = self._cloud
        pixel = None if cloud is None else cloud.nearest(origin, direction)
        if cloud is None or pixel is None:
            return
        u, v = pixel
        change(self._column, value=u)
        change(self._row, value=v)
        self._scene.mark(LAYER, "picked", cloud.points[v, u], f"pixel ({u}, {v})")


def fingerprint(calibration: CalibrationView) -> tuple[Any, ...]:
    """Return a key that changes with the calibration, for its pictures."""
    rig = calibration.stereo.rig
    return calibration.models, rig.camera.K.tobytes(), rig.projector.K.tobytes(), rig.t.tobytes()


def worst(calibration: CalibrationView) -> str:
    """Return the pose with the largest reprojection error; empty where none is known."""
    errors = calibration.stereo.pose_rms_px
    return max(errors, key=lambda name: max(errors[name]), default="")


def _summary(calibration: CalibrationView) -> Html:
    """Return a table of the calibration: errors, poses, depths, baseline and models."""
    stereo = calibration.stereo
    rms = stereo.reprojection_rms_px
    rows: list[tuple[object, object]] = []
    if rms:
        rows.append(
            ("Reprojection RMS, camera", coloured(f"{rms['camera']:.3f} px", "plain", bold=True))
        )
        rows.append(
            (
                "Reprojection RMS, projector",
                coloured(f"{rms['projector']:.3f} px", "plain", bold=True),
            )
        )
    rows.append(
        ("Poses used", f"{len(stereo.poses)} of {len(stereo.poses) + len(stereo.excluded)}")
    )
    if stereo.depth_range_mm:
        rows.append(
            ("Calibrated depths (R2)", "{:.0f} to {:.0f} mm".format(*stereo.depth_range_mm))
        )
    rows.append(("Baseline", f"{stereo.baseline_mm:.2f} mm"))
    rows.append(("Models", ", ".join(calibration.models)))
    rows.append(("Model in use", "none: rejected" if calibration.refused else calibration.best))
    rows += [(model, words) for model, words in calibration.scales.items()]
    return table(("Calibration", ""), rows)


def _parameters(details: CalibrationFigures) -> Html:
    """Return tables of the lens and rig parameters with their standard deviations."""
    stereo = details.stereo
    lenses = [
        (f"{name}, {unit}" if unit else name, *values) for name, unit, *values in lens_rows(stereo)
    ]
    rig = [*rig_rows(stereo), ("Target", stereo.board or "imported")]
    note = paragraph(coloured("±: one standard deviation.", "dim"))
    return Html(
        table(("Lens", "camera", "projector"), lenses) + table(("Rig", ""), rig) + to_html(note)
    )
