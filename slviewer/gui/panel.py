"""What every step's panel is made of: the services that it uses, its inputs, the callbacks that
report failures, and the thread that makes its pictures."""

import math
import threading
import time
from collections.abc import Callable, Hashable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
import viser

from slviewer.devices.browser import PageChannels, PageRole
from slviewer.devices.page_channel import PageState
from slviewer.errors import InputError, hide_passwords
from slviewer.gui.scene import ViewerScene, Viewpoints, look_at_points
from slviewer.gui.widgets import NOTICES, link, paragraph
from slviewer.server.secure import SafeServer
from slviewer.session.store import Session
from slviewer.wizard.notices import describe_failure
from slviewer.wizard.operator import Operator
from slviewer.wizard.snapshot import ExportView, Level, PreviewView, ScanView, SessionView, Snapshot

NOTHING = "–"
TYPING_S = 1.0
"""An input counts as entered after so long without a keystroke."""
NO_SESSION = SessionView(Path(), "", "")
"""What panels show while no session is open."""

ButtonColour = Literal["gray", "red", "orange", "green", "teal", "cyan"]


class PanelContext:
    """Services that a panel uses.

    `gui` builds inputs, `scene` draws in 3D, `viewpoints` moves the browsers' views, `operator`
    takes requests. `executor` runs one callback after the other. `pages` are the pages of devices;
    None where none is served. `print_links` is called when the links were replaced.
    """

    def __init__(
        self,
        operator: Operator,
        server: SafeServer,
        pages: PageChannels | None,
        print_links: Callable[[SafeServer], None],
    ) -> None:
        self.operator, self.server, self.pages = operator, server, pages
        self.print_links = print_links
        self.gui, self.scene = server.viser.gui, ViewerScene(server.viser.scene)
        self.viewpoints = Viewpoints(server.viser)
        self.executor = ThreadPoolExecutor(1, "slviewer requests")
        self._offers: dict[Path, str] = {}

    @property
    def session(self) -> Session:
        """The open session. Raises InputError where none is open."""
        if self.operator.session is None:
            raise InputError("no session is open: open one first")
        return self.operator.session

    def page_state(self, role: PageRole) -> PageState | None:
        """Return the state of a device's page; None where none is served."""
        return None if self.pages is None else getattr(self.pages, role).page_state()

    # what is shown in the browsers

    def notify(self, level: Level, text: str) -> None:
        """Show a notification in every browser."""
        title, colour, seconds, _ = NOTICES[level]
        for client in self.server.viser.get_clients().values():
            client.add_notification(
                title, hide_passwords(text), color=colour, auto_close_seconds=seconds
            )

    def report_failure(self, error: BaseException) -> None:
        """Show an error as a notification in every browser."""
        self.notify("error", describe_failure("This", error))

    def offer_download(self, path: Path) -> str:
        """Return the download address of a file of the session, cached by path."""
        if path not in self._offers:
            session = self.operator.snapshot().session
            folder = session.folder if session is not None else path.parent
            self._offers[path] = self.server.downloads.offer(path, within=folder)
        return self._offers[path]

    def clear_downloads(self) -> None:
        """Offer no file any more."""
        self._offers.clear()
        self.server.downloads.clear()

    def links_html(self, exports: Iterable[ExportView], *names: str) -> str:
        """Return download links to those of the exported files that have one of these names."""
        return "".join(
            paragraph(link(self.offer_download(each.path), f"Download {each.name}"))
            for each in exports
            if each.name in names
        )

    # inputs

    def callback(
        self, do: Callable[[], Any], *, by_user: bool = False, at_once: bool = False
    ) -> Callable[[Any], None]:
        """Wrap `do()` as a callback for viser; whatever it raises becomes a notification.

        Viser calls back from a pool of threads, several events at a time: here they are queued, so
        that the board is placed before it is captured by someone who clicks fast. `by_user`: only
        for changes made in a browser, not by the program. `at_once`: for what must not wait, such
        as cancelling.
        """

        def call() -> None:
            """Call `do()`, and report what it raises."""
            try:
                do()
            except Exception as error:
                self.report_failure(error)

        def handle(event: Any) -> None:
            """Queue the call for an event, or call at once."""
            if by_user and event.client_id is None:
                return
            if at_once:
                call()
            else:
                with suppress(RuntimeError):  # the wizard ends
                    self.executor.submit(call)

        return handle

    def on_change(self, do: Callable[[], Any], *handles: Any, by_user: bool = False) -> None:
        """Call `do()` whenever one of the inputs changes, as `callback` does."""
        for handle in handles:
            handle.on_update(self.callback(do, by_user=by_user))

    def button(
        self,
        label: str,
        do: Callable[[], Any],
        icon: str | None = None,
        color: ButtonColour | None = "gray",
        *,
        hint: str | None = None,
        at_once: bool = False,
    ) -> viser.GuiButtonHandle:
        """Add a button that calls `do()`; without a colour it is the panel's main action.

        `icon`: the name of one of Tabler's icons.
        """
        name = None if icon is None else viser.IconName(icon)
        handle = self.gui.add_button(label, icon=name, color=color, hint=hint)
        handle.on_click(self.callback(do, at_once=at_once))
        return handle

    def upload_button(
        self, label: str, do: Callable[[str, bytes], Any], file_types: str
    ) -> viser.GuiUploadButtonHandle:
        """Add a button that calls `do(name, content)` with an uploaded file."""
        handle = self.gui.add_upload_button(
            label, icon=viser.Icon.UPLOAD, color="gray", mime_type=file_types
        )
        handle.on_upload(self.callback(lambda: do(handle.value.name, handle.value.content)))
        return handle

    def view_button(self, points: Callable[[], np.ndarray | None]) -> None:
        """Add a button that moves the clicking browser's view to the points (..., 3) mm, if there
        are any."""

        def look(event: Any) -> None:
            """Move the view of the browser that clicked to the points."""
            shown = points()
            if event.client is not None and shown is not None:
                look_at_points(event.client, shown)

        button = self.gui.add_button("Zoom to fit", icon=viser.Icon.FOCUS_2, color="gray")
        button.on_click(lambda event: self.callback(lambda: look(event))(event))


class Setting:
    """An input of a value of the session: `request(value)` is called for what a user enters, and
    the session's value is shown when it changes.

    A snapshot that is a moment older must not overwrite what was just entered. While somebody
    types, the first digits are a value too; the session's answer to them waits until typing has
    stopped.
    """

    def __init__(
        self, context: PanelContext, handle: Any, request: Callable[[Any], object]
    ) -> None:
        self.handle = handle
        self._latest: Any = None
        self._entered = -math.inf
        self._timer: threading.Timer | None = None
        handle.on_update(self._note_entry)
        # the value is read at once: an older snapshot may be drawn before the callback's turn
        handle.on_update(
            lambda event: context.callback(partial(request, handle.value), by_user=True)(event)
        )

    def update(self, value: Any) -> None:
        """Set the session's value; the handle follows if it has changed."""
        if value != self._latest:
            self._latest = value
            if self._timer is None:
                self._apply_latest()

    async def _note_entry(self, event: Any) -> None:
        """Store the time of an entry in a browser."""
        if event.client_id is not None:
            self._entered = time.monotonic()

    def _apply_latest(self) -> None:
        """Set the handle to the latest value, or retry once the user has stopped typing."""
        self._timer = None
        remaining = self._entered + TYPING_S - time.monotonic()
        if remaining <= 0:
            self.handle.value = self._latest
        else:
            self._timer = threading.Timer(remaining, self._apply_latest)
            self._timer.daemon = True
            self._timer.start()


class Choice:
    """A dropdown of (name, text) options; `value` is the chosen name, empty where there is none."""

    def __init__(
        self,
        context: PanelContext,
        label: str,
        do: Callable[[], Any] | None = None,
        *,
        hint: str | None = None,
    ) -> None:
        """Add the dropdown; `do()` is called whenever the choice changes, by the user or by the
        program."""
        self.handle: Any = context.gui.add_dropdown(label, (NOTHING,), hint=hint)
        self._names: dict[str, str] = {}
        if do is not None:
            context.on_change(do, self.handle)

    def offer(self, things: Iterable[tuple[str, str]], preferred: str = "") -> None:
        """Set the (name, text) options; the choice stays if possible, else it becomes `preferred`
        or the first one."""
        chosen = self.value
        self._names = {text: name for name, text in things}
        texts = tuple(self._names) or (NOTHING,)
        if self.handle.options != texts:
            by_name = {name: text for text, name in self._names.items()}
            self.handle.options = texts
            self.handle.value = by_name.get(chosen) or by_name.get(preferred) or texts[0]

    def offer_names(self, names: Iterable[str], preferred: str = "") -> None:
        """Set options that are called by their names."""
        self.offer(((name, name) for name in names), preferred)

    @property
    def value(self) -> str:
        """The chosen name; empty where there is none."""
        return self._names.get(self.handle.value, "")

    def choose(self, name: str) -> None:
        """Choose an option by its name, if it is offered."""
        for text, each in self._names.items():
            if each == name:
                self.handle.value = text


class RestoreButton:
    """A button that restores the capture that was deleted last."""

    def __init__(self, context: PanelContext) -> None:
        self._name = ""
        self._button = context.button(
            "Restore", lambda: context.operator.undelete(self._name), "arrow-back-up", "orange"
        )

    def offer(self, deleted: Sequence[str]) -> None:
        """Offer the first of these names, the last deleted; the button is hidden without one."""
        self._name = deleted[0] if deleted else ""
        self._button.label = f"Restore {self._name}"
        self._button.visible = bool(deleted)


def display_name(name: str, label: str) -> str:
    """Return the text for a capture in a list: its label, followed by its name if they differ."""
    return name if label == name else f"{label} ({name})"


def scan_options(scans: Iterable[ScanView]) -> list[tuple[str, str]]:
    """Return (name, text) of each scan, for a `Choice`."""
    return [(scan.name, display_name(scan.name, scan.label)) for scan in scans]


def scan_labels(session: SessionView) -> dict[str, str]:
    """Return {name of a scan: the operator's label for it}."""
    return {scan.name: scan.label for scan in session.scans}


class Painter:
    """Computes the pictures of one panel on a thread, by slots; a newer request for a slot replaces
    a waiting one.

    Whatever is slow (reading a cloud, a figure of matplotlib) is never done by the thread that
    draws panels. `failed(error)` is called for failures. The thread begins with the first request,
    and ends with the program.
    """

    def __init__(self, failed: Callable[[BaseException], None]) -> None:
        self._failed = failed
        self._condition = threading.Condition()
        self._requested: dict[str, Hashable] = {}
        self._waiting: dict[str, tuple[Hashable, Callable[[], Any], Callable[[Any], None]]] = {}
        self._thread: threading.Thread | None = None

    def request(
        self, slot: str, key: Hashable, make: Callable[[], Any], show: Callable[[Any], None]
    ) -> None:
        """Call `show(make())` on the painter's thread, unless `slot` already shows or awaits the
        same `key`.

        `key` is what the picture depends on. `show` is not called if another request for the slot
        came meanwhile.
        """
        with self._condition:
            if self._requested.get(slot, self) == key:
                return
            self._requested[slot] = key
            self._waiting[slot] = (key, make, show)
            if self._thread is None:
                self._thread = threading.Thread(
                    target=self._serve, name="slviewer painter", daemon=True
                )
                self._thread.start()
            self._condition.notify_all()

    def cancel(self, slot: str) -> None:
        """Drop the request for a slot; the next one is computed whatever its key."""
        with self._condition:
            self._requested.pop(slot, None)
            self._waiting.pop(slot, None)

    def _serve(self) -> None:
        """Compute and show the waiting requests, one after the other; failures are reported."""
        while True:
            with self._condition:
                self._condition.wait_for(lambda: self._waiting)
                slot = next(iter(self._waiting))
                key, make, show = self._waiting.pop(slot)
            try:
                made = make()
                with self._condition:
                    wanted = self._requested.get(slot, self) == key
                if wanted:
                    show(made)
            except Exception as error:  # one picture that fails must not end the thread
                self._failed(error)


class PanelBase:
    """Base of panels and of their parts: inputs that show snapshots and send requests."""

    def __init__(self, context: PanelContext) -> None:
        self._context, self._gui, self._scene = context, context.gui, context.scene
        self._operator = context.operator
        self._lock = threading.RLock()
        self.build()

    def build(self) -> None:
        """Create the handles; called once, inside the container of panel or part."""

    def draw(self, snapshot: Snapshot) -> None:
        """Draw a snapshot."""


class StepPanel(PanelBase):
    """Base of the steps' panels, each with a layer of the scene that is shown with it. Every method
    is called by the drawing thread."""

    key: ClassVar[str]
    _snapshot: Snapshot
    """The latest one; set before anything can be chosen in the panel."""
    _visible = False
    _shown: tuple[str, np.ndarray | None] | None = None
    """Name and points (..., 3) mm of what is shown."""

    def __init__(self, context: PanelContext) -> None:
        self.context, self.painter = context, Painter(context.report_failure)
        self.parts: list[PanelPart] = []
        self.layer = context.scene.layer(self.key)
        self.layers = [self.layer]
        with context.gui.add_folder(None, visible=False) as self._container:
            super().__init__(context)

    @property
    def _session(self) -> SessionView:
        """The session of the latest snapshot, an empty one where none is open."""
        return self._snapshot.session or NO_SESSION

    def show_points(self, name: str, points: np.ndarray | None) -> None:
        """Move the browsers' views to what is shown now, points (..., 3) mm, or once the panel is
        visible."""
        self._shown = name, points
        self.show_view()

    def show_view(self) -> None:
        """Move the browsers' views to what is shown, if the panel is visible."""
        if self._visible and self._shown is not None:
            name, points = self._shown
            self._context.viewpoints.show(f"{self.key} {name}", points)

    def get_points(self) -> np.ndarray | None:
        """Return the points that are shown; None where there are none."""
        return self._shown and self._shown[1]

    def update(self, snapshot: Snapshot) -> None:
        """Show a snapshot; called after each change while the panel is shown, and right after
        `show(True)`."""
        with self._lock:
            self._snapshot = snapshot
            for part in self.parts:
                part.draw(snapshot)
            self.draw(snapshot)

    def draw_preview(self, preview: PreviewView) -> None:
        """Show the latest frame; called while the panel is shown, at most ten times a second."""

    def show(self, visible: bool) -> None:
        """Show or hide the panel and its layers of the scene."""
        self._visible = self._container.visible = visible
        for layer in self.layers:
            layer.show(visible)


class PanelPart(PanelBase):
    """Base of what several panels share, and of parts that have a state of their own; drawn with
    its panel, by whose painter and in whose layer."""

    def __init__(self, panel: StepPanel) -> None:
        self._painter, self._layer = panel.painter, panel.layer
        panel.parts.append(self)
        super().__init__(panel.context)
