"""Scan: capture an object, look at its cloud, and ask any of its points."""

import threading
from collections.abc import Sequence
from typing import Any

import numpy as np
import viser

from slviewer.gui.import_inputs import ImportInputs
from slviewer.gui.inputs import Choice, change, titled
from slviewer.gui.live import LAYER as LIVE
from slviewer.gui.live import LiveScreen
from slviewer.gui.panel import Stage
from slviewer.gui.pictures import Painter, opened, spread
from slviewer.gui.preview import drawn, legend, light_words
from slviewer.gui.steps.verify import likely
from slviewer.gui.undelete import Undelete
from slviewer.gui.widgets import Html, Picture, Words, block, boxed, cell, colour_bar, colours, table, thumbnail, toned
from slviewer.gui.world import Stand
from slviewer.report.maps import error_limit
from slviewer.wizard.result_views import ScanCloud, scan_cloud
from slviewer.wizard.snapshot import LiveView, PreviewView, ScanView, Snapshot

LAYER = "scan"
SMALL_PX = 380
"""Width of the live picture: the cloud matters more here."""
COLOURS = ("texture", "depth", "modulation", "expected noise", "uncertainty", "error")
LIVE_HINT = "Clouds while patterns run, 11 frames each; quicker and noisier than a capture"
MUCH_MASKED = 0.2
"""Share of a scan's pixels, masked because no target pose lit what they look through, that the operator is told of."""
_STATES = {"absent": "not reconstructed yet", "fresh": "", "stale": "older calibration"}


class Panel:
    """The sixth step."""

    key = "scan"

    def __init__(self, stage: Stage) -> None:
        self._stage = stage
        self._painter = Painter(stage.failed)
        self._lock = threading.RLock()
        self._snapshot: Snapshot | None = None
        self._known: tuple[str, ...] = ()
        self._cloud: ScanCloud | None = None
        self._made: tuple[Any, ScanCloud] | None = None
        self._visible = False
        self._is_live = False
        self._screen = LiveScreen(stage)
        stage.operator.on_live(self._screen.offer)

    def build(self) -> None:
        gui, operator, safely = self._stage.gui, self._stage.operator, self._stage.safely
        with gui.add_folder("Capture", visible=False) as self._capture_folder:
            self._picture = Picture(gui, "Live picture", width_px=SMALL_PX)
            self._capture = gui.add_button("Capture scan", icon=viser.Icon.CAMERA)
            self._label = gui.add_text("Name", "", hint="If you like; else it is numbered")
            self._live = gui.add_button("Live", icon=viser.Icon.PLAYER_PLAY, color="teal", hint=LIVE_HINT)
            self._live.on_click(safely(self._toggle_live))
            self._keep = gui.add_button("Keep this one", icon=viser.Icon.DOWNLOAD, color="green", visible=False)
            self._keep.on_click(safely(lambda: operator.keep_live(self._label.value)))
            self._live_says = Words(gui)
            self._stand = Stand(self._stage, LAYER, ("object", "sphere", "plane"))
            self._capture.on_click(safely(lambda: operator.capture_scan(self._label.value)))
        self._gallery = Words(gui)
        with gui.add_folder("Cloud", visible=False) as self._cloud_folder:
            self._scan = Choice(gui, "Scan")
            self._words = Words(gui)
            self._model = Choice(gui, "Model")
            self._reconstruct = gui.add_button("Reconstruct", icon=viser.Icon.CUBE)
            self._reconstruct.on_click(safely(self._ask_cloud))
            self._colour = gui.add_dropdown("Colour by", COLOURS)
            self._legend = Words(gui)
            self._stage.bring_button(lambda: self._cloud.points if self._cloud else None)
            self._point = Words(gui)
            self._rename_to = gui.add_text("New name", "")
            rename = gui.add_button("Rename scan", icon=viser.Icon.PENCIL, color="gray")
            rename.on_click(safely(lambda: operator.rename(self._scan.value, self._rename_to.value)))
            delete = gui.add_button(
                "Delete scan", icon=viser.Icon.TRASH, color="red", hint="It goes to the session's trash"
            )
            delete.on_click(safely(lambda: operator.delete(self._scan.value)))
        self._undelete = Undelete(self._stage)
        self._import = ImportInputs(self._stage, "scan")
        self._scan.on_change(safely(self._refresh))
        self._colour.on_update(safely(self._refresh))

    def draw(self, snapshot: Snapshot) -> None:
        with self._lock:
            self._snapshot = snapshot
            session, ready = snapshot.session, snapshot.step(self.key).state != "blocked"
            rig = snapshot.rig
            change(self._capture_folder, visible=rig.state != "none")
            change(self._capture, disabled=not ready or rig.state != "open" or rig.capture is not None)
            self._draw_live(snapshot.live, ready and rig.state == "open" and rig.capture is None)
            self._stand.draw(snapshot)
            self._import.draw(snapshot)
            self._undelete.offer(session.deleted_scans if session else ())
            scans = ordered(session.scans) if session else []
            change(self._cloud_folder, visible=bool(scans))
            self._gallery.set(gallery(scans, self._scan.value))
            if session is None or not scans:
                self._stage.scene.remove(LAYER, "cloud")
                self._painter.forget("cloud")
                return
            ready_made = [scan.name for scan in scans if scan.cloud != "absent"]
            self._scan.offer([(scan.name, titled(scan.name, scan.label)) for scan in scans], (ready_made or [""])[0])
            if new := [name for name in ready_made if name not in self._known]:
                if self._known:  # just reconstructed: this is what the operator wants to see
                    self._scan.choose(new[0])
                self._known = tuple(ready_made)
            models = session.calibration.models if session.calibration else ()
            self._model.offer(
                [(model, model) for model in models], session.calibration.best if session.calibration else ""
            )
            self._refresh()

    def draw_preview(self, preview: PreviewView) -> None:
        self._picture.set(drawn(preview), legend(preview, light_words(preview)))

    def shown(self, visible: bool) -> None:
        self._visible = visible
        if not visible:
            self._stage.operator.stop_live()
        self._stage.scene.show(LAYER, visible)
        self._stage.scene.on_pick(self._pick if visible else None)
        self._look()

    # drawing

    def _draw_live(self, live: LiveView | None, ready: bool) -> None:
        """The buttons and figures of the live scan; a cloud that was captured gives way to it meanwhile."""
        change(self._live, label="Live" if live is None else "Stop live", color="teal" if live is None else "red")
        change(self._live, icon=viser.Icon.PLAYER_PLAY if live is None else viser.Icon.PLAYER_STOP)
        change(self._live, disabled=live is None and not ready)
        change(self._keep, visible=live is not None, disabled=live is None or not live.clouds_per_s)
        self._live_says.set("" if live is None else live_words(live, self._screen.points))
        if live is None and self._is_live:
            self._screen.clear()
        self._is_live = live is not None
        if live is not None:
            self._stage.scene.show(LIVE, True)
            self._painter.forget("cloud")
            self._cloud = None
            for name in ("cloud", "picked"):
                self._stage.scene.remove(LAYER, name)
            self._legend.set("")
            self._point.set("")

    def _toggle_live(self) -> None:
        if self._is_live:
            self._stage.operator.stop_live()
        else:
            self._stage.operator.start_live()

    def _refresh(self) -> None:
        """Ask for the chosen cloud in the chosen colours."""
        with self._lock:
            scan = self._snapshot.scan(self._scan.value) if self._snapshot else None
            if scan is None or self._snapshot is None:
                return
            session = self._snapshot.session
            busy = self._snapshot.job is not None and not self._snapshot.job.background
            change(
                self._reconstruct, disabled=busy, label="Reconstruct" if scan.cloud == "absent" else "Reconstruct again"
            )
            self._words.set(scan_words(scan))
            self._gallery.set(gallery(ordered(session.scans) if session else (), scan.name))
            if self._is_live:
                return
            if scan.cloud == "absent":
                self._painter.forget("cloud")
                self._cloud = None
                self._stage.scene.remove(LAYER, "cloud")
                self._stage.scene.remove(LAYER, "picked")
                self._legend.set("")
                self._point.set("")
                return
            rows = session.verifications if session else ()
            verified = tuple(row.rms_mm for row in rows if row.capture == scan.name)
            key = (scan.name, scan.model, scan.points, scan.noise_mm, verified)
            operator, colour = self._stage.operator, self._colour.value

            def make() -> tuple[Any, ScanCloud, str]:
                if self._made is None or self._made[0] != key:
                    self._made = key, scan_cloud(opened(operator), scan.name)
                return key, self._made[1], colour

            self._painter.ask("cloud", (key, colour), make, self._draw_cloud)

    def _draw_cloud(self, made: tuple[Any, ScanCloud, str]) -> None:
        _, cloud, colour = made
        if self._is_live:
            return
        fresh = cloud is not self._cloud
        self._cloud = cloud
        rows, columns = cloud.thinned(150_000)
        painted, bar = painting(cloud, colour)
        shown = self._stage.scene.cloud(LAYER, "cloud", cloud.points[rows, columns], painted[rows, columns])
        self._stage.scene.show(LAYER, self._visible)
        self._legend.set(
            bar + block(toned(f"{shown:,} points drawn; the file holds all. Click on a point to ask it.", "dim"))
        )
        if fresh:
            self._stage.scene.remove(LAYER, "picked")
            self._point.set("")
        self._look()

    def _look(self) -> None:
        if self._visible and self._cloud is not None:
            self._stage.viewpoints.at(f"{LAYER} {self._cloud.name}", self._cloud.points)

    def _pick(self, origin: np.ndarray, direction: np.ndarray) -> None:
        cloud = self._cloud
        pixel = None if cloud is None else cloud.nearest(origin, direction)
        if cloud is None or pixel is None:
            return
        u, v = pixel
        self._point.set(point_words(cloud, u, v))
        self._stage.scene.mark(LAYER, "picked", cloud.points[v, u], f"({u}, {v}): z {cloud.points[v, u, 2]:.3f} mm")

    def _ask_cloud(self) -> None:
        self._stage.operator.reconstruct(self._scan.value, self._model.value or None)


def live_words(live: LiveView, drawn: int) -> Html:
    """How fast and how late the live clouds are."""
    if not live.clouds_per_s:
        return block(toned("The first live clouds are on their way …", "dim"))
    late = "" if live.behind_ms is None else f", {live.behind_ms:.0f} ms behind"
    words = f"<b>{live.shown_per_s or live.clouds_per_s:.1f} clouds/s{late}</b>"
    if live.shown_per_s and live.shown_per_s < 0.8 * live.clouds_per_s:
        words += f" ({live.clouds_per_s:.1f} are made, and this is what the screens take)"
    if not live.points:
        nothing = "Nothing is measured: is the object lit, and within the calibrated depths?"
        return Html(block(Html(words)) + boxed(nothing, "warning"))
    more = f"{live.points:,} points measured, {drawn:,} of them drawn. What moves is left out; nothing is saved yet."
    return Html(block(Html(words)) + block(toned(more, "dim")))


def painting(cloud: ScanCloud, colour: str) -> tuple[np.ndarray, Html]:
    """((h, w, 3) uint8, the legend as HTML) of a cloud in one of COLOURS."""
    if colour == "error":
        if not cloud.errors:
            grey = np.full(cloud.points.shape, 150, np.uint8)
            return grey, block(
                toned("No error is known: measure this capture as a plane or a sphere first.", "warning")
            )
        model = cloud.model if cloud.model in cloud.errors else next(iter(cloud.errors))
        limit = error_limit(list(cloud.errors.values()))
        bar = colour_bar(f"−{limit:g} mm", f"+{limit:g} mm", "error", f"error by {model}")
        return colours(cloud.errors[model], -limit, limit, "error"), bar
    if colour == "texture":
        texture = cloud.texture if cloud.texture.ndim == 3 else np.repeat(cloud.texture[..., None], 3, axis=2)
        return texture, Html("")
    if colour == "uncertainty":
        sure = uncertainty(cloud)
        low, high = spread(sure)
        said = "uncertainty of z (1 sigma), noise and calibration together"
        if cloud.sigma_calibration is None:
            said = f"uncertainty of z (1 sigma) from noise alone: {cloud.model} does not know its own part"
        return colours(sure, low, high), colour_bar(f"{low:.3f} mm", f"{high:.3f} mm", "value", said)
    valid = np.isfinite(cloud.points[..., 2])
    values, unit, digits = {
        "depth": (cloud.points[..., 2], "mm", 1),
        "modulation": (cloud.modulation, "grey levels", 0),
        "expected noise": (cloud.sigma_z, "mm", 3),
    }[colour]
    low, high = spread(np.where(valid, values, np.nan))
    return colours(values, low, high), colour_bar(
        f"{low:.{digits}f} {unit}", f"{high:.{digits}f} {unit}", "value", colour
    )


def uncertainty(cloud: ScanCloud) -> np.ndarray:
    """(h, w) mm: one standard deviation of z, of noise and calibration together as far as they are known."""
    sigma = np.where(np.isfinite(cloud.points[..., 2]), cloud.sigma_z, np.nan)
    for part in (cloud.sigma_calibration, cloud.sigma_edges):
        sigma = sigma if part is None else np.hypot(sigma, part)
    return np.asarray(sigma)


def point_words(cloud: ScanCloud, u: int, v: int) -> Html:
    """All that is known of the point at pixel (u, v)."""
    x, y, z = cloud.points[v, u]
    rows: list[tuple[object, object]] = [
        ("pixel (column, row)", f"({u}, {v})"),
        ("x, y, z", f"{x:.3f}, {y:.3f}, {z:.3f} mm"),
        (f"absolute phase, axis {cloud.axis}", f"{cloud.phase[v, u]:.3f} rad"),
        ("modulation", f"{cloud.modulation[v, u]:.1f} grey levels"),
        ("expected noise of z", f"{cloud.sigma_z[v, u]:.3f} mm"),
    ]
    if cloud.sigma_calibration is not None:
        rows.append(("left uncertain by the calibration", f"{cloud.sigma_calibration[v, u]:.3f} mm"))
        rows.append(("uncertainty of z (1 sigma)", f"{uncertainty(cloud)[v, u]:.3f} mm"))
    rows += [(f"error, {model}", f"{errors[v, u]:.3f} mm") for model, errors in cloud.errors.items()]
    return table(("Clicked point", ""), rows)


def scan_words(scan: ScanView) -> Html:
    """A scan's figures."""
    if scan.cloud == "absent":
        return block(toned("Captured, and not reconstructed yet.", "warning"))
    rows: list[tuple[object, object]] = [("points", f"{scan.points:,}"), ("model", scan.model)]
    if scan.depth_mm is not None:
        rows.append(("depths", f"{scan.depth_mm[0]:.0f} to {scan.depth_mm[1]:.0f} mm"))
    if scan.noise_mm is not None:
        rows.append(("expected noise of z (median)", f"{scan.noise_mm:.3f} mm"))
    if scan.masked is not None:
        rows.append(("masked: look where no target pose was", f"{100 * scan.masked:.1f} % of the pixels"))
    said = table((titled(scan.name, scan.label), ""), rows)
    if scan.masked is not None and scan.masked > MUCH_MASKED:
        said = Html(said + boxed("Much is masked: capture target poses where this object stands.", "warning"))
    if scan.scale:
        said = Html(said + block(f"{scan.scale[:1].upper()}{scan.scale[1:]}."))
    if scan.cloud == "stale":
        said = Html(said + block(toned("Made with an older calibration: reconstruct it again.", "warning")))
    return said


def ordered(scans: Sequence[ScanView]) -> list[ScanView]:
    """Scans of objects first, and what was captured to verify behind them; the newest of each first."""
    return sorted(reversed(scans), key=lambda scan: likely(scan) != "scan")


def gallery(scans: Sequence[ScanView], chosen: str) -> Html:
    """Pictures of the scans with their names."""
    if not scans:
        return Html("")
    cards = []
    for scan in scans:
        frame = "var(--mantine-primary-color-filled)" if scan.name == chosen else "transparent"
        state = _STATES[scan.cloud] or f"{scan.points:,} points"
        tone = "dim" if scan.cloud == "fresh" else "warning"
        cards.append(
            f'<div style="width:92px;border:2px solid {frame};border-radius:6px;padding:2px;font-size:0.8rem;'
            f'line-height:1.25;overflow:hidden">{thumbnail(scan.thumbnail, 84, scan.label)}'
            f'<div style="white-space:nowrap;overflow:hidden;text-overflow:ellipsis">{cell(scan.label)}</div>'
            f"{toned(state, tone)}</div>"  # type: ignore[arg-type]
        )
    style = "display:flex;flex-wrap:wrap;gap:4px;max-height:260px;overflow-y:auto"
    return block(Html(f'<div style="{style}">{"".join(cards)}</div>'))
