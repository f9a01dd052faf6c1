"""Calibrate: the models from the good poses, how well each pose agrees, and what every pixel learnt."""

import threading
from typing import Any

import numpy as np
import viser

from slviewer.gui.calibration_words import (
    choice_words,
    comparison_table,
    named_poses,
    set_aside_words,
    splined_table,
    verdict_words,
)
from slviewer.gui.inputs import Choice, Follows, change, titled
from slviewer.gui.panel import Stage
from slviewer.gui.pictures import PLOT_PX, Painter, Plot, opened, spread
from slviewer.gui.widgets import Html, Words, block, cell, colours, table, toned
from slviewer.pipeline.report import calibration_view
from slviewer.report.curves import pixel_curves
from slviewer.report.data import CalibrationFigures as Details
from slviewer.report.maps import rms_maps
from slviewer.report.page import Figure
from slviewer.report.reprojection import pose_bars, residual_arrows
from slviewer.report.session import lens_rows, rig_rows
from slviewer.target.board import Board
from slviewer.wizard import result_views
from slviewer.wizard.snapshot import CalibrationView, PreviewView, SessionView, Snapshot

LAYER, BOARDS = "calibrate", "calibrated boards"
DEVICES = ("camera", "projector")
_MOST_NAMED = 6  # poses that a verdict names, as buttons: more do not fit one line or two


class Panel:
    """The fourth step."""

    key = "calibrate"

    def __init__(self, stage: Stage) -> None:
        self._stage = stage
        self._painter = Painter(stage.failed)
        self._lock = threading.RLock()
        self._snapshot: Snapshot | None = None
        self._visible = False
        self._pixel_chosen = False
        self._boards: tuple[Any, ...] = ()
        self._cloud: result_views.ScanCloud | None = None
        self._details: tuple[tuple[Any, ...], Details] | None = None
        self._chosen = ""  # the operator's model, as the session said last

    def build(self) -> None:
        gui, operator, safely = self._stage.gui, self._stage.operator, self._stage.safely
        self._calibrate = gui.add_button("Calibrate", icon=viser.Icon.TARGET)
        self._calibrate.on_click(safely(lambda: operator.calibrate()))
        self._verdict = Words(gui)
        self._anyway = gui.add_checkbox(
            "Use it anyway", False, visible=False, hint="The session remembers it, for this calibration alone"
        )
        self._anyway_follows = Follows(self._anyway)
        self._named = gui.add_button_group("Look at", ("–",), visible=False)
        self._set_aside = Words(gui)
        self._summary = Words(gui)
        with gui.add_folder("Models", visible=False) as self._models_folder:
            self._choice_words = Words(gui)
            self._use = Choice(gui, "Measure with", "The recommended model, or another one of your choice")
            self._compare = gui.add_button(
                "Compare models",
                icon=viser.Icon.SCALE,
                color="gray",
                hint="Measures each pose by calibrations made without it: a minute or more; it can be cancelled",
            )
            self._compare.on_click(safely(lambda: operator.compare_models()))
            self._comparison = Words(gui)
            self._splined = Words(gui)
        with gui.add_folder("Reprojection error", visible=False) as self._poses_folder:
            self._bars = Plot(gui)
            self._pose = Choice(gui, "Pose")
            self._pose_words = Words(gui)
            self._exclude = gui.add_button("Exclude this pose", color="orange")
            self._exclude.on_click(safely(self._toggle_pose))
            self._device = gui.add_dropdown("Arrows of", DEVICES)
            self._arrows = Plot(gui)
        with gui.add_folder("Parameters", visible=False, expand_by_default=False) as self._parameters_folder:
            self._parameters = Words(gui)
        with gui.add_folder("Pixel-wise model", visible=False) as self._pixels_folder:
            self._fits = Words(gui)
            self._axis = Choice(gui, "Axis", "x: along the projector's columns; y: along its rows")
            self._maps = Plot(gui)
            self._column = gui.add_number("Pixel column u", 0, min=0, step=1)
            self._row = gui.add_number("Pixel row v", 0, min=0, step=1)
            self._over = Choice(gui, "Cloud to click", "Shows a cloud in 3D; click on it to choose a pixel")
            self._stage.bring_button(lambda: self._cloud.points if self._cloud else None)
            self._curve_words = Words(gui)
            self._curves = Plot(gui)
        self._anyway.on_update(safely(self._toggle_anyway))
        self._named.on_click(safely(self._look_at_named))
        self._use.on_change(safely(self._choose_model))
        for choice in (self._pose, self._axis):
            choice.on_change(safely(self._refresh))
        for number in (self._device, self._column, self._row):
            number.on_update(safely(self._refresh))
        self._over.on_change(safely(self._show_cloud))

    def draw(self, snapshot: Snapshot) -> None:
        with self._lock:
            self._snapshot = snapshot
            session = snapshot.session
            calibration = session.calibration if session else None
            step = snapshot.step(self.key)
            busy = snapshot.job is not None and not snapshot.job.background
            change(self._calibrate, disabled=busy or step.state == "blocked")
            change(self._calibrate, label="Calibrate again" if calibration else "Calibrate")
            shown = calibration is not None
            self._draw_verdict(session, calibration)
            self._draw_models(calibration, busy)
            for folder, visible in (
                (self._poses_folder, shown and bool(calibration and calibration.poses)),
                (self._parameters_folder, shown),
                (self._pixels_folder, shown and bool(calibration and calibration.fit_rms_mm)),
            ):
                change(folder, visible=visible)
            self._summary.set(_summary(calibration) if calibration else "")
            if session is None or calibration is None:
                return
            names = [pose.name for pose in session.poses if pose.state in ("used", "excluded", "left out")]
            self._pose.offer([(name, name) for name in names], worst(calibration))
            self._axis.offer([(axis, axis) for axis in calibration.fit_rms_mm])
            clouds = [(scan.name, titled(scan.name, scan.label)) for scan in session.scans if scan.cloud != "absent"]
            self._over.offer([("", "no cloud"), *clouds])
            self._fits.set(_fits(calibration))
            if not self._pixel_chosen:
                self._pixel_chosen = True
                u, v = np.round(calibration.K_camera[:2, 2]).astype(int)
                change(self._column, value=max(int(u), 0))
                change(self._row, value=max(int(v), 0))
            self._refresh()

    def _draw_verdict(self, session: SessionView | None, calibration: CalibrationView | None) -> None:
        verdict = session.verdict if session else None
        of_calibration = bool(session and session.verdict_of_calibration)
        if verdict is not None:
            self._verdict.set(verdict_words(verdict, of_calibration, calibration))
        elif calibration is not None and calibration.target:
            self._verdict.say("This calibration was not judged yet: calibrate again for a verdict.", "plain")
        else:
            self._verdict.set("")
        refusable = calibration is not None and bool(calibration.rejected)
        change(self._anyway, visible=refusable)
        self._anyway_follows.tell(bool(calibration and calibration.insisted))
        drawn = calibration.pose_rms_px if calibration else {}
        names = tuple(name for name in named_poses(verdict, calibration) if name in drawn)[:_MOST_NAMED]
        if names and names != self._named.options:
            self._named.options = names
        change(self._named, visible=bool(names))
        self._set_aside.set(set_aside_words(calibration) if calibration else "")

    def _draw_models(self, calibration: CalibrationView | None, busy: bool) -> None:
        several = calibration is not None and len(calibration.models) > 1 and bool(calibration.poses)
        change(self._models_folder, visible=several)
        if calibration is None or not several:
            return
        self._choice_words.set(choice_words(calibration))
        options = [("", f"the recommended one: {calibration.recommended}")]
        self._use.offer(options + [(model, model) for model in calibration.models], calibration.chosen)
        if calibration.chosen != self._chosen:
            self._chosen = calibration.chosen
            self._use.choose(calibration.chosen)
        change(self._compare, disabled=busy or bool(calibration.stale))
        compared = calibration.comparison
        change(self._compare, label="Compare models" if compared is None else "Compare models again")
        self._comparison.set("" if compared is None else comparison_table(compared, calibration.best))
        if calibration.splined is not None:
            self._splined.set(splined_table(calibration.splined))
        else:
            self._splined.say(f"No splined model: {calibration.lacks}." if calibration.lacks else "", "dim")

    def draw_preview(self, preview: PreviewView) -> None:
        """This step needs no camera."""

    def shown(self, visible: bool) -> None:
        self._visible = visible
        for layer in (LAYER, BOARDS):
            self._stage.scene.show(layer, visible)
        self._stage.scene.on_pick(self._pick if visible else None)

    # pictures

    def _refresh(self) -> None:
        """Ask for the pictures of what is chosen."""
        with self._lock:
            session = self._snapshot.session if self._snapshot else None
            calibration = session.calibration if session else None
            if session is None or calibration is None:
                return
            made = fingerprint(calibration)
            operator = self._stage.operator
            if calibration.poses:
                self._painter.ask(
                    "bars",
                    made,
                    lambda: pose_bars(calibration.pose_rms_px, calibration.reprojection_px, width=PLOT_PX),
                    self._bars.set,
                )
            self._draw_pose(session, calibration)
            self._draw_boards(session, calibration)
            self._painter.ask("parameters", made, lambda: _parameters(self._detailed(made)), self._parameters.set)
            axis: Any = self._axis.value
            if axis not in calibration.fit_rms_mm:
                return
            self._painter.ask(
                "maps",
                (made, axis),
                lambda: rms_maps(result_views.pixel_fits(opened(operator))[axis].rms_mm, axis, width=PLOT_PX),
                self._maps.set,
            )
            pixel = (int(self._column.value), int(self._row.value))
            self._painter.ask(
                "curves",
                (made, axis, pixel),
                lambda: (pixel, result_views.pixel_curve(opened(operator), pixel, axis)),
                self._draw_curve,
            )

    def _draw_pose(self, session: SessionView, calibration: CalibrationView) -> None:
        name, device = self._pose.value, self._device.value
        pose = next((pose for pose in session.poses if pose.name == name), None)
        if pose is None:
            return
        excluded = pose.state == "excluded"
        change(self._exclude, label=f"Include {name} again" if excluded else f"Exclude {name}")
        rms = calibration.pose_rms_px.get(name)
        if rms is None:
            why = f": {pose.why}" if pose.why else ""
            self._pose_words.say(f"{name} is not in this calibration ({pose.state}{why}).", "warning")
            self._painter.forget("arrows")
            self._arrows.hide()
            return
        said = f"{name}: camera {rms[0]:.3f} px, projector {rms[1]:.3f} px."
        if calibration.splined is not None and name in calibration.splined.trust:
            camera, projector = calibration.splined.trust[name]
            said += (
                f" The joint adjustment trusts {100 * camera:.0f} % of its features and {100 * projector:.0f} % of its "
                "phase; 80 % are usual."
            )
        if excluded:
            self._pose_words.say(f"{said} It is excluded now: calibrate again to do without it.", "warning")
        else:
            self._pose_words.say(said)
        made = fingerprint(calibration)

        def arrows() -> Figure | None:
            details = self._detailed(made)
            found, title = details.residuals.get(name), f"{name}, {device}"
            if found is None:
                return None
            if device == "camera":
                return residual_arrows(title, found.pixels, found.camera, details.stereo.rig.camera.size)
            return residual_arrows(title, found.projector_pixels, found.projector, details.stereo.rig.projector.size)

        self._painter.ask("arrows", (made, name, device), arrows, self._arrows.set)

    def _draw_boards(self, session: SessionView, calibration: CalibrationView) -> None:
        """The poses in 3D, from green to red by their reprojection error, the chosen one thick."""
        scene, chosen = self._stage.scene, self._pose.value
        shown = (
            fingerprint(calibration),
            chosen,
            bool(self._over.value),
            tuple((p.name, p.state) for p in session.poses),
        )
        if shown == self._boards:
            return
        self._boards = shown
        scene.clear(BOARDS)
        if self._over.value or not calibration.target:
            return
        outline = Board.parse(calibration.target).outline()
        usual = np.sqrt(np.mean(np.square([max(rms) for rms in calibration.pose_rms_px.values()] or [1.0])))
        for pose in session.poses:
            if pose.T_camera_board is not None and pose.name in calibration.pose_rms_px:
                share = float(np.clip(max(calibration.pose_rms_px[pose.name]) / usual - 0.5, 0, 1))
                colour = (round(60 + 170 * share), round(170 - 110 * share), 70)
                here = pose.name == chosen
                label = pose.name if here else ""
                width = 5.0 if here else 1.5
                scene.board(BOARDS, pose.name, pose.T_camera_board, outline, colour, label=label, width_px=width)
        scene.show(BOARDS, self._visible)

    def _detailed(self, made: tuple[Any, ...]) -> Details:
        """The calibration with its residuals, read once; on the painter's thread."""
        if self._details is None or self._details[0] != made:
            self._details = made, calibration_view(opened(self._stage.operator))
        return self._details[1]

    def _draw_curve(self, made: Any) -> None:
        (u, v), curve = made
        if curve is None:
            self._curve_words.say(f"Pixel ({u}, {v}) saw the board too rarely to be fitted: choose another.", "warning")
            self._curves.hide()
            return
        self._curve_words.say("")
        self._curves.set(pixel_curves(curve, width=PLOT_PX))

    # requests

    def _toggle_anyway(self) -> None:
        session = self._snapshot.session if self._snapshot else None
        calibration = session.calibration if session else None
        if calibration is not None and calibration.rejected and self._anyway.value != calibration.insisted:
            self._stage.operator.use_anyway(self._anyway.value)

    def _choose_model(self) -> None:
        if self._use.value != self._chosen:
            self._chosen = self._use.value
            self._stage.operator.choose_model(self._use.value)

    def _look_at_named(self) -> None:
        self._pose.choose(self._named.value)
        self._refresh()

    def _toggle_pose(self) -> None:
        name = self._pose.value
        pose = self._snapshot.pose(name) if self._snapshot else None
        if pose is None:
            return
        if pose.state == "excluded":
            self._stage.operator.include(name)
        else:
            self._stage.operator.exclude(name)

    def _show_cloud(self) -> None:
        name = self._over.value
        if not name:
            self._painter.forget("cloud")
            self._cloud = None
            self._stage.scene.clear(LAYER)
            self._stage.viewpoints.overview()
            self._refresh()
            return
        self._refresh()
        operator = self._stage.operator
        self._painter.ask("cloud", name, lambda: result_views.scan_cloud(opened(operator), name), self._draw_cloud)

    def _draw_cloud(self, cloud: result_views.ScanCloud) -> None:
        self._cloud = cloud
        rows, columns = cloud.thinned(100_000)
        z = cloud.points[rows, columns, 2]
        self._stage.scene.cloud(LAYER, "cloud", cloud.points[rows, columns], colours(z, *spread(z)))
        self._stage.scene.show(LAYER, self._visible)
        if self._visible:
            self._stage.viewpoints.at(f"{LAYER} {cloud.name}", cloud.points)

    def _pick(self, origin: np.ndarray, direction: np.ndarray) -> None:
        cloud = self._cloud
        pixel = None if cloud is None else cloud.nearest(origin, direction)
        if cloud is None or pixel is None:
            return
        u, v = pixel
        change(self._column, value=u)
        change(self._row, value=v)
        self._stage.scene.mark(LAYER, "picked", cloud.points[v, u], f"pixel ({u}, {v})")


def fingerprint(calibration: CalibrationView) -> tuple[Any, ...]:
    """What pictures of a calibration depend on."""
    return (
        calibration.models,
        calibration.K_camera.tobytes(),
        calibration.K_projector.tobytes(),
        calibration.t.tobytes(),
    )


def worst(calibration: CalibrationView) -> str:
    """The pose that agrees least; empty where none is known."""
    errors = calibration.pose_rms_px
    return max(errors, key=lambda name: max(errors[name]), default="")


def _summary(calibration: CalibrationView) -> Html:
    rms = calibration.reprojection_px
    rows: list[tuple[object, object]] = []
    if rms:
        rows.append(("reprojection RMS, camera", toned(f"{rms['camera']:.3f} px", "plain", bold=True)))
        rows.append(("reprojection RMS, projector", toned(f"{rms['projector']:.3f} px", "plain", bold=True)))
    rows.append(("poses used", f"{len(calibration.poses)} of {len(calibration.poses) + len(calibration.left_out)}"))
    if calibration.depth_range_mm:
        rows.append(("calibrated depths (R2)", "{:.0f} to {:.0f} mm".format(*calibration.depth_range_mm)))
    rows.append(("baseline", f"{calibration.baseline_mm:.2f} mm"))
    rows.append(("models", ", ".join(calibration.models)))
    rows.append(("used for scans", "nothing: it was rejected" if calibration.refused else calibration.best))
    rows += [(model, words) for model, words in calibration.scales.items()]
    return table(("Calibration", ""), rows)


def _fits(calibration: CalibrationView) -> Html:
    rows = [
        (f"axis {axis}", *(f"{medians[name]:.3f} mm" for name in "zxy"))
        for axis, medians in calibration.fit_rms_mm.items()
    ]
    return table(("Median RMS of the fits", "z", "x", "y"), rows)


def _parameters(details: Details) -> Html:
    stereo = details.stereo
    lenses = [(f"{name}, {unit}" if unit else name, *values) for name, unit, *values in lens_rows(stereo)]
    rig = [*rig_rows(stereo), ("target", stereo.board or "made elsewhere")]
    note = block(toned("± is one standard deviation.", "dim"))
    return Html(table(("Lens", "camera", "projector"), lenses) + table(("Rig", ""), rig) + cell(note))
