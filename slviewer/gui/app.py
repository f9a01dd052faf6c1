"""Starts the wizard: the operator, the server, and one thread that draws."""

import logging
import signal
import threading
import time
import webbrowser
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import viser

from slviewer.devices.channel import Channel, PageState
from slviewer.errors import SlviewerError, UsageError
from slviewer.gui.panel import PanelContext
from slviewer.gui.scene import ViewerScene
from slviewer.gui.shell import Shell, greet_viewer, notify
from slviewer.gui.viewpoints import FIELD_OF_VIEW, OVERVIEW, Viewpoints
from slviewer.pipeline.rig_choice import set_up
from slviewer.pipeline.rig_presets import load_rig
from slviewer.server.projector_page import serve_projector
from slviewer.server.secure import SafeServer, serve
from slviewer.server.viewers import Viewers
from slviewer.session.store import Session
from slviewer.wizard.notices import describe_error
from slviewer.wizard.operator import Operator
from slviewer.wizard.preparation import Preparation
from slviewer.wizard.snapshot import Level

log = logging.getLogger("slviewer.gui")

DRAWN_PER_S = 10.0
DEFAULT_SESSION = "slviewer-session"
_BRAND = (25, 113, 194)


class App:
    """A running wizard: its operator, its server, and the thread that draws the newest snapshot."""

    def __init__(
        self,
        operator: Operator,
        host: str = "127.0.0.1",
        port: int = 8080,
        *,
        channel: Channel | None = None,
        **options: Any,
    ) -> None:
        """Serve `operator`, and the projector page if `channel` is given, the one that its rigs are set up with.

        `options` are those of `serve`. Raises SlviewerError where the address cannot be served.
        """
        self.operator = operator
        self.channel = channel
        self.server: SafeServer = serve(host, port, label="slviewer", **options)
        try:
            if channel is not None:
                serve_projector(self.server, channel)
            self._start()
        except BaseException:
            self.server.stop()
            raise

    def close(self) -> None:
        """End drawing and serving; the operator stays open."""
        self._closing = True
        self._changed.set()
        self._unsubscribe()
        self._executor.shutdown(wait=False, cancel_futures=True)
        self._thread.join(5.0)
        self.server.stop()

    def _start(self) -> None:
        """Build the page and its shell, subscribe to snapshots and previews, and start the drawing thread."""
        page, operator = self.server.viser, self.operator
        page.gui.configure_theme(brand_color=_BRAND, control_width="large", dark_mode=False)
        page.initial_camera.position, page.initial_camera.look_at = OVERVIEW
        page.initial_camera.fov = FIELD_OF_VIEW
        page.initial_camera.near, page.initial_camera.far = 5.0, 20000.0
        self._closing = False
        self._executor = ThreadPoolExecutor(1, "slviewer requests")
        self._changed = threading.Event()
        self._offers: dict[Path, str] = {}
        self._folder: Path | None = None
        self._failure = ""
        context = PanelContext(
            page.gui,
            ViewerScene(page.scene),
            Viewpoints(lambda: page.get_clients().values()),
            operator,
            self._offer_download,
            self._notify,
            self._show_step,
            self._report_failure,
            self._executor,
            partial(Viewers, page),
            self._get_page_state,
        )
        snapshot = operator.snapshot()
        self._notified = snapshot.notices[-1].number if snapshot.notices else 0
        self.shell = Shell(context, snapshot.steps)
        page.on_client_connect(self._greet_client)
        self._unsubscribe = operator.subscribe(lambda _: self._changed.set(), lambda _: self._changed.set())
        self._thread = threading.Thread(target=self._draw_forever, name="slviewer drawing", daemon=True)
        self._thread.start()

    # drawing

    def _draw_forever(self) -> None:
        """Draw new snapshots and previews until closing; a failure is reported once and retried every second."""
        version, number, page = -1, -1, None
        while not self._closing:
            begun = time.monotonic()
            self._changed.wait(0.5)
            self._changed.clear()
            if self._closing:
                return
            if page != (page := self._get_page_state()):
                version = -1
            try:
                version, number = self._draw(version, number)
            except Exception as error:
                version = -1
                if repr(error) != self._failure:  # it is tried again, and reported once
                    self._failure = repr(error)
                    self._report_failure(error)
                time.sleep(1.0)
            time.sleep(max(0.0, 1 / DRAWN_PER_S - (time.monotonic() - begun)))

    def _draw(self, version: int, number: int) -> tuple[int, int]:
        """Draw the snapshot and the preview if they are newer than these; returns the version and number drawn."""
        snapshot, preview = self.operator.snapshot(), self.operator.preview()
        folder = snapshot.session.folder if snapshot.session else None
        if folder != self._folder:
            self._folder = folder
            self._offers.clear()
            self.server.downloads.clear()
        if snapshot.version != version or self.shell.needs_drawing:
            with self.server.viser.atomic():
                self.shell.draw(snapshot)
            for notice in snapshot.notices:
                if notice.number > self._notified:
                    self._notified = notice.number
                    self._notify(notice.level, notice.text)
        if preview is not None and preview.number != number:
            self.shell.draw_preview(preview)
            number = preview.number
        return snapshot.version, number

    # what panels use

    def _notify(self, level: Level, text: str) -> None:
        """Show a notification in every browser."""
        for client in self.server.viser.get_clients().values():
            notify(client, level, text)

    def _report_failure(self, error: BaseException) -> None:
        """Show an error as a notification in every browser."""
        self._notify("error", describe_error("This", error))

    def _show_step(self, key: str) -> None:
        """Show another step, drawn at once."""
        self.shell.go(key)
        self._changed.set()

    def _offer_download(self, path: Path) -> str:
        """Return the download address of a file of the session, cached by path."""
        if path not in self._offers:
            session = self.operator.snapshot().session
            folder = session.folder if session is not None else path.parent
            self._offers[path] = self.server.downloads.offer(path, within=folder)
        return self._offers[path]

    def _get_page_state(self) -> PageState | None:
        """Return the state of the projector page; None where none is served."""
        return None if self.channel is None else self.channel.page_state()

    def _greet_client(self, client: viser.ClientHandle) -> None:
        """Show a browser that connected by the view-only link that it may only watch."""
        if self.server.role(client.client_id) == "viewer":
            greet_viewer(client)


def run(
    session: Path | None = None,
    rig: str = "",
    host: str = "127.0.0.1",
    port: int = 8080,
    open_browser: bool = True,
) -> None:
    """Serve the wizard until Ctrl-C. `rig` as in `rig_choice`; empty: the session's, else the simulated one.

    Raises SlviewerError where the session, the rig or the address cannot be used.
    """
    channel = Channel()
    with Operator(set_up=partial(set_up, channel=channel)) as operator:
        _check_granted(operator, operator.open_session(session or Path(DEFAULT_SESSION)))
        remembered = operator.session is not None and operator.session.decision("rig")
        if rig or not remembered:  # a remembered rig that is not connected now is not replaced by the simulated one
            _check_granted(operator, operator.choose_rig(rig_choice(rig or "simulated", operator.session)))
        app = App(operator, host, port, channel=channel)
        preparation = Preparation(operator.set_preparing)
        preparation.start()
        try:
            print(f"slviewer is ready: {app.server.url}")
            print(f"view-only link:    {app.server.view_url}")
            print(f"projector page:    {app.server.link('/projector')}", flush=True)
            if not app.server.loopback:
                print("The connection is not encrypted: use a network that you trust.", flush=True)
            if open_browser:
                _open_browser(app.server.url)
            _wait_for_stop()
        except KeyboardInterrupt:
            print("\nslviewer has stopped; the session is saved.")
        finally:
            preparation.close()
            app.close()


def rig_choice(text: str, session: Session | None = None) -> dict[str, Any]:
    """Parse a rig from text: "simulated" (half resolution), "simulated:0.25", a preset's name or a file.

    Returns the choice that `Operator.choose_rig` takes. Raises UsageError for an invalid scale.
    """
    name, _, scale = text.partition(":")
    if name != "simulated":
        return load_rig(text, session)
    try:
        return {"driver": name, "scale": float(scale or 0.5)}
    except ValueError:
        raise UsageError(f"{text!r} is no rig: write simulated, or simulated:0.25 for a quarter of the size") from None


def _wait_for_stop() -> None:
    """Wait for Ctrl-C, or for the signal of a service manager."""
    stopped = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: stopped.set())
    while not stopped.wait(1.0):  # some systems deliver Ctrl-C only between waits
        pass


def _check_granted(operator: Operator, granted: bool) -> None:
    """Raise SlviewerError with the notice of the error unless a request was granted."""
    if not granted:
        raise SlviewerError(next(notice.text for notice in reversed(operator.notices()) if notice.level == "error"))


def _open_browser(url: str) -> None:
    """Open an address in the default browser without waiting; nothing happens where there is none."""
    try:
        webbrowser.get()
    except webbrowser.Error:
        return
    threading.Thread(target=webbrowser.open, args=(url,), daemon=True).start()
