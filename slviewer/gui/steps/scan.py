"""Step 6: capture an object, look at its cloud, and inspect any of its points."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import viser

from slviewer.errors import InputError
from slviewer.fringe.presets import PRESETS
from slviewer.geometry import cuda_device
from slviewer.gui.capture_inputs import ExposureInputs, ImportInputs, SimulatedObject, TurnInputs
from slviewer.gui.colouring import (
    SCAN_COLOURINGS,
    SEEN_COLOURS,
    SEEN_TITLES,
    format_patches,
    paint_points,
    scan_values,
    shade,
    uncertainty,
)
from slviewer.gui.live import LiveScreen
from slviewer.gui.panel import (
    ReconstructAllButton,
    RestoreButton,
    StepPanel,
    display_name,
    scan_labels,
    scan_options,
)
from slviewer.gui.point_editing import PointEditing, RegionInputs
from slviewer.gui.scene import Click
from slviewer.gui.steps.verify import MUCH_MASKED
from slviewer.gui.widgets import (
    Html,
    LiveImage,
    Text,
    Tone,
    alert,
    coloured,
    note,
    paragraph,
    properties_table,
    record_properties,
    thumbnail,
    to_html,
)
from slviewer.pipeline.merge import AlignedScans, load_placements, view_places
from slviewer.printable import capitalize
from slviewer.records.merge import REPORTED_OUTSIDE, Reconstruction
from slviewer.records.verification import Verification
from slviewer.simulation.concave import CONCAVE
from slviewer.wizard.result_views import (
    ScanCloud,
    extrapolated_points,
    used_points,
    whole_cloud,
)
from slviewer.wizard.snapshot import BoardSeen, LiveView, PreviewView, ScanView, SessionView

ONE, ALIGNED = "one", "scans in place"
EXTRAPOLATED = (140, 90, 200)
LIVE_HINT = "Continuous clouds of 11 frames each: faster and noisier than a capture"
_STATES = {"absent": "not reconstructed", "fresh": "", "stale": "older calibration"}


_Made = tuple[ScanCloud, ScanCloud, tuple[np.ndarray, Html], str]
"""The cloud that is drawn, what is used of it, its colours with their legend, and why nothing is
used."""


class ScanPanel(StepPanel):
    """Panel of the step Scan."""

    key = "scan"

    _placed: tuple[str, ...] | None = None
    _loaded: tuple[Any, ScanCloud] | None = None
    _made: _Made | None = None

    def build(self) -> None:
        """Create the inputs of capture, live scan, gallery and cloud."""
        gui, operator = self._gui, self._operator
        self._screen = LiveScreen(self.context)
        operator.subscribe_live(self._screen.offer)
        self._picture = LiveImage(gui)
        self._depths = Text(gui)
        self._capture = self.button(
            "Capture scan", lambda: operator.capture_scan(self._name.value), "camera", None
        )
        self._live = self.button("Live", self._toggle_live, "player-play", hint=LIVE_HINT)
        self._save = self.button(
            "Save cloud", lambda: operator.save_live(self._name.value), "download"
        )
        self._live_status = Text(gui)
        self.checkbox(
            "Graphics card",
            "Computes the next live scan; its first clouds are compared with the processor's",
            cuda_device.find_device() is not None,
            operator.use_graphics_card,
        ).visible = cuda_device.is_present()
        things = ("object", "stone", "stone on a table", "marked", "sphere", "plane", *CONCAVE)
        SimulatedObject(self, *things)
        with gui.add_folder("Capture") as self._capture_folder:
            self._patterns = self.setting(
                self.dropdown(
                    "Patterns",
                    PRESETS,
                    "micro for concave metal, wax and other surfaces that light themselves",
                ),
                operator.choose_patterns,
            )
            ExposureInputs(self, for_scan=True)
            self._align = self.setting(
                self.checkbox(
                    "Align as you scan", "Shows each new scan in its place beside those before it"
                ),
                operator.set_align_scans,
            )
            self._name = gui.add_text("Name", "", hint="Optional; numbered by default")
            TurnInputs(self)
        ReconstructAllButton(self)
        self._gallery = Text(gui)
        with gui.add_folder("Cloud") as self._cloud_folder:
            self._scan = scan = self.choice("Scan", follow=_reconstructed_names)
            self._figures = Text(gui)
            self._colour = self.dropdown("Colour", SCAN_COLOURINGS)
            self._legend = Text(gui)
            self._extrapolated = self.checkbox(
                "Extrapolated points",
                "In violet: no target pose illuminated what they look through; merges and "
                "measurements do not use them",
                True,
            )
            self._view = self.choice("3D view")
            self._model = self.choice("Model")
            self._reconstruct = self.button(
                "Reconstruct",
                lambda: operator.reconstruct(scan.value, self._model.value or None),
                "cube",
            )
            self._placement = Text(gui)
            self._place = self.button("Align scan", lambda: operator.align(scan.value), "puzzle")
            self._take_out = self.button(
                "Undo alignment", lambda: operator.undo_alignment(scan.value), "arrow-back-up"
            )
            self._support = self.button(
                "Remove support", lambda: operator.remove_support(*self._shown_scans()),
                "table-minus",
                hint="Deletes the plane that the object stands on, and all below it; "
                "Undo edit brings it back",
            )  # fmt: skip
            self._point = Text(gui)
            self._region = RegionInputs(self)
            self._editing = PointEditing(self, self._redraw, self._show_point)
            name = gui.add_text("New name", "", hint="Of the scan that is shown")
            self.button("Rename scan", lambda: operator.rename(scan.value, name.value), "pencil")
            self.button(
                "Delete scan", lambda: operator.delete(scan.value), "trash",
                hint="Moves it to the session's trash",
            )  # fmt: skip
        self._restore = RestoreButton(self)
        ImportInputs(self, "scan")

    def draw(self) -> None:
        """Show the live scan, the scans, and the cloud of the chosen one."""
        snapshot, session, calibration = self.snapshot, self.session, self.session.calibration
        rig = snapshot.rig
        ready = rig.is_idle and not self.is_blocked
        self._capture_folder.visible = self._capture.visible = rig.state != "none"
        self._capture.disabled = not ready
        self._picture.is_large = self.is_ready
        self._draw_live(snapshot.live, ready)
        self._patterns.handle.disabled = not rig.is_idle
        if snapshot.session:
            self._patterns.update(session.patterns)
        self._restore.offer(session.deleted_scans)
        self._align.update(session.aligns_scans)
        scans = sort_scans(session.scans)
        self._offer_views(scans)
        self._cloud_folder.visible = bool(scans)
        if not scans:
            self._gallery.set("")
            self._clear_cloud()
            return
        reconstructed = _reconstructed_names(session)
        self._scan.offer(scan_options(scans), (reconstructed or [""])[0])
        if calibration:
            self._model.offer_names(calibration.models, calibration.best)
        else:
            self._model.offer_names(())
        self._draw_scan(next(scan for scan in scans if scan.name == self._scan.value))

    def draw_preview(self, preview: PreviewView) -> None:
        """Show the live image, and whether what is known of it is at the calibrated depths."""
        self._picture.draw(preview)
        self._depths.write(*describe_depths(self._calibrated_mm, preview.board))

    @property
    def _calibrated_mm(self) -> tuple[float, float] | None:
        """The nearest and the farthest calibrated depth; None where they are not known."""
        calibration = self.session.calibration
        return None if calibration is None else calibration.stereo.depth_range_mm

    def show(self, visible: bool) -> None:
        """Show or hide the layers; hiding stops a live scan."""
        super().show(visible)
        if not visible:
            self._operator.stop_live()
        self._editing.show(visible)

    # drawing

    def _draw_live(self, live: LiveView | None, ready: bool) -> None:
        """Update buttons and figures of the live scan, during which a captured cloud is hidden."""
        button, save = self._live, self._save
        button.label = "Live" if live is None else "Stop live"
        button.icon = viser.IconName("player-play" if live is None else "player-stop")
        button.disabled = live is None and not ready
        save.visible, save.disabled = live is not None, live is None or not live.clouds_per_s
        self._live_status.set(
            "" if live is None else live_html(live, self._screen.points, self._calibrated_mm)
        )
        if live:
            self._clear_cloud()
        else:
            self._screen.clear()

    @property
    def _is_live(self) -> bool:
        """Whether a live scan runs."""
        return self.snapshot.live is not None

    def _toggle_live(self) -> None:
        """Start the live scan, or stop it where it runs."""
        if self._is_live:
            self._operator.stop_live()
        else:
            self._operator.start_live()

    def _clear_cloud(self) -> None:
        """Remove the captured cloud with its legend and picked point."""
        self.painter.cancel(self._draw_cloud)
        self.painter.cancel(self._draw_aligned)
        self._forget_cloud()
        self.painter.cancel(self._draw_extrapolated)
        self.layer.remove("cloud", "extrapolated")
        self._legend.set("")

    def _forget_cloud(self) -> None:
        """Forget the captured cloud and its picked point, as others are shown."""
        self._made = self._shown = None
        self._editing.set_scans([])
        self._forget_point()

    def _forget_point(self) -> None:
        """Remove the picked point with its values."""
        self.layer.remove("picked")
        self._point.set("")

    def _draw_scan(self, scan: ScanView) -> None:
        """Show the chosen scan, and request its cloud in the chosen colours."""
        is_absent, busy = scan.cloud == "absent", self.snapshot.is_busy
        self._reconstruct.disabled = busy
        self._reconstruct.label = "Reconstruct" if is_absent else "Reconstruct again"
        self._figures.set(scan_html(scan))
        self._region.offer("" if is_absent else scan.name)
        self._editing.offer([scan])
        self._place.visible = scan.cloud == "fresh" and not scan.is_placed
        self._take_out.visible = scan.is_placed
        self._place.disabled = self._take_out.disabled = busy
        # where it is among the others, or why it is kept apart
        text = f"{scan.label}: {scan.placement.summary()}" if scan.placement else ""
        self._placement.set(note(text, "good" if scan.is_placed else "warning"))
        shown = len(self._shown_scans())
        suffix = "" if shown == 1 else f", {shown} scans"
        self._support.label = f"Remove support{suffix}"
        self._support.disabled = busy or is_absent or scan.shape != "scan"
        frame = self.context.offer_frame(scan.name)
        self._gallery.set(gallery(sort_scans(self.session.scans), scan.name, frame))
        if self._is_live:
            return
        self._request_extrapolated(scan)
        if self._view.value == ALIGNED:
            placed, store = [s for s in self.session.scans if s.is_placed], self.context.session
            self.painter.request(
                self._draw_aligned,
                tuple((each.name, each.figures.model) for each in placed),
                lambda: view_places(load_placements(store), {}, store),
            )
            self.painter.cancel(self._draw_cloud)
        elif is_absent:
            self._clear_cloud()
        else:
            self._request_cloud(self.session, scan)
            self.painter.cancel(self._draw_aligned)

    def _request_extrapolated(self, scan: ScanView) -> None:
        """Request the extrapolated points of a scan where they are to be shown, else remove
        them."""
        store, count = self.context.session, scan.figures.extrapolated
        self._extrapolated.visible = count > 0
        if not (count and self._extrapolated.value and self._view.value == ONE):
            self.painter.cancel(self._draw_extrapolated)
            self.layer.remove("extrapolated")
            return
        key = scan.name, scan.figures.model, count, self.session.restriction(scan.name)
        self.painter.request(
            self._draw_extrapolated, key, lambda: extrapolated_points(store, scan.name)
        )

    def _draw_extrapolated(self, points: np.ndarray) -> None:
        """Draw extrapolated points (n, 3) mm, unless a live scan runs."""
        if not self._is_live:
            self.layer.cloud("extrapolated", points, EXTRAPOLATED)

    def _request_cloud(self, session: SessionView, scan: ScanView) -> None:
        """Request the cloud of a reconstructed scan in the chosen colours."""
        views = session.list_records(Verification)
        verified = tuple(view.record.summary() for view in views if view.name == scan.name)
        key = (scan.name, scan.figures.model, scan.figures.points, scan.figures.noise_mm, verified)
        colour = self._colour.value

        def make() -> _Made:
            """Load the cloud, unless it is loaded already, and colour what is used of it."""
            if self._loaded is None or self._loaded[0] != key:
                self._loaded = key, whole_cloud(self.context.session, scan.name)
            whole, why = self._loaded[1], ""
            try:
                cloud = used_points(self.context.session, whole)
            except InputError as error:  # all is shown, so that the region can be put around it
                cloud, why = whole, str(error)
            return whole, cloud, paint_points(scan_values(cloud), colour), why

        used = session.restriction(scan.name)
        self.painter.request(self._draw_cloud, (key, used, colour), make)

    def _shown_scans(self) -> tuple[str, ...]:
        """Return the names of the scans in the 3D view: those in place, or the chosen one."""
        if self._view.value == ALIGNED:
            return tuple(scan.name for scan in self.session.scans if scan.is_placed)
        return (self._scan.value,)

    def _offer_views(self, scans: Sequence[ScanView]) -> None:
        """Offer to view the aligned scans together, and do so when another one came to its
        place."""
        placed = tuple(sorted(scan.name for scan in scans if scan.is_placed))
        together = {f"{len(placed)} scans in place": ALIGNED} if len(placed) > 1 else {}
        self._view.offer({"this scan": ONE} | together, ONE)
        if together and self._placed is not None and set(placed) - set(self._placed):
            self._view.choose(ALIGNED)
        self._placed = placed

    def _draw_aligned(self, aligned: AlignedScans) -> None:
        """Draw the scans in place, in the colours of how many see each point."""
        if self._is_live:
            return
        self._forget_cloud()
        painted = np.array(SEEN_COLOURS)[(aligned.seen_by > 1).astype(int)]
        self._legend.set(aligned_html(aligned))
        self.show_cloud(ALIGNED, aligned.points, shade(painted, aligned.normals))

    def _redraw(self) -> None:
        """Draw the cloud again, as other points of it are hidden."""
        if self._made:
            self._draw_cloud(self._made)

    def _draw_cloud(self, made: _Made) -> None:
        """Draw what is used of a loaded cloud in the chosen colours, unless a live scan runs."""
        whole, cloud, (painted, bar), why = made
        if self._is_live:
            return
        is_new = self._made is None or whole is not self._made[0]
        self._made = made
        (points,) = self._editing.set_scans([(cloud, cloud.points)])
        title = scan_labels(self.session).get(cloud.name, cloud.name)
        shown = self.layer.cloud("cloud", points, painted, title=title)
        removed = int(whole.measured_count - cloud.measured_count)
        kept = f", {removed:,} removed by edits and region" if removed else "; the file has all"
        text = Html(to_html(f"{shown:,} points shown{kept}. Click a point for its values."))
        text = Html(text + self.layer.hover_html("cloud"))
        self._legend.set(bar + note(text) + alert(why, "warning"))
        if is_new:
            self._forget_point()
        self.show_points(cloud.name, cloud.points)

    def _show_point(self, click: Click) -> None:
        """Show the values of the point closest to the clicked ray."""
        cloud = self._made and self._made[1]
        if cloud and (pixel := cloud.nearest(click.origin, click.direction)):
            u, v = pixel
            self._point.set(point_html(cloud, u, v))
            text = f"({u}, {v}): z {cloud.points[v, u, 2]:.3f} mm"
            self.layer.mark("picked", cloud.points[v, u], text)


def _reconstructed_names(session: SessionView) -> tuple[str, ...]:
    """Return the names of the scans that have a cloud."""
    return tuple(scan.name for scan in sort_scans(session.scans) if scan.cloud != "absent")


def aligned_html(aligned: AlignedScans) -> Html:
    """State what the colours of the aligned scans mean."""
    share = f"{100 * aligned.share_seen_again:.0f} % is seen by more than one"
    text = coloured(f"{share}; gaps were not seen yet.", "dim")
    return format_patches(SEEN_TITLES, SEEN_COLOURS) + paragraph(text)


def describe_depths(
    calibrated_mm: tuple[float, float] | None, board: BoardSeen | None
) -> tuple[str, Tone]:
    """Return the calibrated depths as a sentence, with that of the board in view, and a warning's
    tone where it is outside of them."""
    if calibrated_mm is None:
        return "", "dim"
    near, far = calibrated_mm
    text = f"Calibrated depths: {near:.0f} to {far:.0f} mm from the camera"
    if board is None or board.T_camera_board is None:
        return f"{text}: place the part there.", "dim"
    depth = float(board.T_camera_board[2, 3])
    if near <= depth <= far:
        return f"{text}; the board in view is at {depth:.0f} mm.", "dim"
    where = "nearer" if depth < near else "farther"
    return f"{text}; the board in view is {where}, at {depth:.0f} mm: move it.", "warning"


def live_html(live: LiveView, shown: int, calibrated_mm: tuple[float, float] | None) -> Html:
    """Describe rate and latency of the live clouds, and warn where they are not at the calibrated
    depths."""
    if not live.clouds_per_s:
        return note("Waiting for the first cloud …")
    latency = "" if live.latency_ms is None else f", latency {live.latency_ms:.0f} ms"
    rate = to_html(f"{live.shown_per_s or live.clouds_per_s:.1f} clouds/s{latency}")
    html = f"<b>{rate}</b>"
    if live.shown_per_s and live.shown_per_s < 0.8 * live.clouds_per_s:
        html += f" ({live.clouds_per_s:.1f} computed; the browsers take no more)"
    if not live.points:
        text = "No points: check that the object is illuminated and within the calibrated depths."
        return paragraph(Html(html)) + alert(text, "warning")
    text = f"{live.points:,} points, {shown:,} shown; moving parts are masked."
    drawn = paragraph(Html(html)) + note(f"{text} Nothing is saved yet.")
    if calibrated_mm is not None and live.outside > REPORTED_OUTSIDE:
        share, (near, far) = 100 * live.outside, calibrated_mm
        text = f"{share:.0f} % of the points are outside the calibrated depths"
        drawn += alert(f"{text}, {near:.0f} to {far:.0f} mm: move the part.", "warning")
    return drawn


def point_html(cloud: ScanCloud, u: int, v: int) -> Html:
    """Return a table of all values at pixel (u, v)."""
    x, y, z = cloud.points[v, u]
    values = {
        "Pixel (u, v)": f"({u}, {v})",
        "x, y, z": f"{x:.3f}, {y:.3f}, {z:.3f} mm",
        f"Phase, axis {cloud.axis}": f"{cloud.phase[v, u]:.3f} rad",
        "Modulation": f"{cloud.modulation[v, u]:.1f} grey levels",
        "Noise of z": f"{cloud.sigma_z[v, u]:.3f} mm",
    }
    if cloud.sigma_calibration is not None:
        values["Uncertainty of the calibration"] = f"{cloud.sigma_calibration[v, u]:.3f} mm"
        values["Uncertainty of z (1 sigma)"] = f"{uncertainty(cloud)[v, u]:.3f} mm"
    for model, errors in cloud.errors.items():
        values[f"Error of {model}"] = f"{errors[v, u]:.3f} mm"
    return properties_table("Clicked point", values)


def scan_html(scan: ScanView) -> Html:
    """Return a table of a scan's figures, with what is to be known of its points."""
    if scan.cloud == "absent":
        return note("Not reconstructed yet.", "warning")
    figures = scan.figures
    (table,) = Reconstruction.tables({scan.name: figures})
    html = record_properties(display_name(scan.name, scan.label), table)
    if figures.masked is not None and figures.masked > MUCH_MASKED:
        html += alert(
            "Much is not supported: capture target poses at the object's place.", "warning"
        )
    tone: Tone = "dim" if figures.is_good else "warning"
    html += "".join(alert(f"{capitalize(text)}.", tone) for text in figures.list_notes())
    if scan.cloud == "stale":
        html += note("Made with an older calibration: reconstruct it again.", "warning")
    return html


def sort_scans(scans: Sequence[ScanView]) -> list[ScanView]:
    """Sort scans of objects first, then captures of planes and spheres; the newest of each
    first."""
    return sorted(reversed(scans), key=lambda scan: scan.shape != "scan")


def gallery(scans: Sequence[ScanView], chosen: str, frame: str) -> Html:
    """Return thumbnails of the scans with their names; the chosen one has a border, and a ``frame``
    as `thumbnail`."""
    cards = []
    for scan in scans:
        is_chosen = scan.name == chosen
        border = "var(--mantine-primary-color-filled)" if is_chosen else "transparent"
        picture = thumbnail(scan.thumbnail, 84, scan.label, frame if is_chosen else "")
        state = _STATES[scan.cloud] or f"{scan.figures.points:,} points"
        tone: Tone = "dim" if scan.cloud == "fresh" else "warning"
        cards.append(
            '<div style="width:92px;border:2px solid'
            f" {border};border-radius:6px;padding:2px;font-size:0.8rem;"
            f'line-height:1.25;overflow-wrap:anywhere">{picture}'
            f"<div>{to_html(scan.label)}</div>{coloured(state, tone)}</div>"
        )
    style = "display:flex;flex-wrap:wrap;gap:4px;max-height:260px;overflow-y:auto"
    return paragraph(Html(f'<div style="{style}">{"".join(cards)}</div>'))
