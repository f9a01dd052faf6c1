"""Starting the wizard: the engine, the server, and one thread that draws."""

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

from slviewer.devices.channel import Channel, Standing
from slviewer.errors import SlviewerError, UsageError
from slviewer.gui import shell as frame
from slviewer.gui.panel import Stage
from slviewer.gui.scene import ViewerScene
from slviewer.gui.shell import Shell
from slviewer.gui.viewpoints import FIELD_OF_VIEW, OVERVIEW, Viewpoints
from slviewer.pipeline.rig_choice import set_up
from slviewer.pipeline.rig_presets import load_rig
from slviewer.server.projector_page import serve_projector
from slviewer.server.secure import SafeServer, serve
from slviewer.server.text import escape
from slviewer.server.viewers import Viewers
from slviewer.session.store import Session
from slviewer.wizard.notices import words_for
from slviewer.wizard.operator import Operator
from slviewer.wizard.snapshot import Level

log = logging.getLogger("slviewer.gui")

DRAWN_PER_S = 10.0
DEFAULT_SESSION = "slviewer-session"
_BRAND = (25, 113, 194)


class App:
    """A running wizard: its engine, its server, and the thread that draws the newest snapshot."""

    def __init__(
        self,
        operator: Operator,
        host: str = "127.0.0.1",
        port: int = 8080,
        *,
        channel: Channel | None = None,
        **options: Any,
    ) -> None:
        """Serve `operator`, and the projector page where `channel` is given, the one that its rigs are set up with.

        `options` are those of `serve`. Raises SlviewerError where the address can't be served.
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
        """End drawing and serving; the operator is whoever's started it."""
        self._closing = True
        self._changed.set()
        self._unsubscribe()
        self._turns.shutdown(wait=False, cancel_futures=True)
        self._thread.join(5.0)
        self.server.stop()

    def _start(self) -> None:
        page, operator = self.server.viser, self.operator
        page.gui.configure_theme(brand_color=_BRAND, control_width="large", dark_mode=False)
        page.initial_camera.position, page.initial_camera.look_at = OVERVIEW
        page.initial_camera.fov = FIELD_OF_VIEW
        page.initial_camera.near, page.initial_camera.far = 5.0, 20000.0
        self._closing = False
        self._turns = ThreadPoolExecutor(1, "slviewer requests")
        self._changed = threading.Event()
        self._offers: dict[Path, str] = {}
        self._folder: Path | None = None
        self._problem = ""
        self._stage = Stage(
            page.gui,
            ViewerScene(page.scene),
            Viewpoints(lambda: page.get_clients().values()),
            operator,
            self._offer,
            self._tell,
            escape,
            self._go,
            self._failed,
            self._turns,
            partial(Viewers, page),
            self._page_standing,
        )
        snapshot = operator.snapshot()
        self._told = snapshot.notices[-1].number if snapshot.notices else 0
        self.shell = Shell(page.gui, self._stage, snapshot.steps, operator.open_session)
        page.on_client_connect(self._greet)
        self._unsubscribe = operator.subscribe(self._wake, self._wake)
        self._thread = threading.Thread(target=self._draw_forever, name="slviewer drawing", daemon=True)
        self._thread.start()

    # drawing

    def _wake(self, _news: object) -> None:
        self._changed.set()

    def _draw_forever(self) -> None:
        version, number, standing = -1, -1, None
        while not self._closing:
            begun = time.monotonic()
            self._changed.wait(0.5)
            self._changed.clear()
            if self._closing:
                return
            if standing != (standing := self._page_standing()):
                version = -1
            try:
                version, number = self._draw(version, number)
            except Exception as error:
                version = -1
                if repr(error) != self._problem:  # it is tried again, and need not be told again
                    self._problem = repr(error)
                    self._failed(error)
                time.sleep(1.0)
            time.sleep(max(0.0, 1 / DRAWN_PER_S - (time.monotonic() - begun)))

    def _draw(self, version: int, number: int) -> tuple[int, int]:
        snapshot, preview = self.operator.snapshot(), self.operator.preview()
        folder = snapshot.session.folder if snapshot.session else None
        if folder != self._folder:
            self._folder = folder
            self._offers.clear()
            self.server.downloads.clear()
        if snapshot.version != version or self.shell.due:
            with self.server.viser.atomic():
                self.shell.draw(snapshot)
            for notice in snapshot.notices:
                if notice.number > self._told:
                    self._told = notice.number
                    self._tell(notice.level, notice.text)
        if preview is not None and preview.number != number:
            self.shell.draw_preview(preview)
            number = preview.number
        return snapshot.version, number

    # what panels use

    def _tell(self, level: Level, text: str) -> None:
        for client in self.server.viser.get_clients().values():
            frame.notify(client, level, text)

    def _failed(self, error: BaseException) -> None:
        self._tell("error", words_for("This", error))

    def _go(self, key: str) -> None:
        self.shell.go(key)
        self._changed.set()

    def _offer(self, path: Path) -> str:
        if path not in self._offers:
            session = self.operator.snapshot().session
            folder = session.folder if session is not None else path.parent
            self._offers[path] = self.server.downloads.offer(path, within=folder)
        return self._offers[path]

    def _page_standing(self) -> Standing | None:
        return None if self.channel is None else self.channel.standing()

    def _greet(self, client: viser.ClientHandle) -> None:
        if self.server.role(client.client_id) == "viewer":
            frame.greet_viewer(client)


def run(
    session: Path | None = None,
    rig: str = "",
    host: str = "127.0.0.1",
    port: int = 8080,
    open_browser: bool = True,
) -> None:
    """Serve the wizard until Ctrl-C. `rig` as `rig_choice` reads it; empty: the session's, else the simulated one.

    Raises SlviewerError where the session, the rig or the address cannot be used.
    """
    channel = Channel()
    with Operator(set_up=partial(set_up, channel=channel)) as operator:
        _granted(operator, operator.open_session(session or Path(DEFAULT_SESSION)))
        remembered = operator.session is not None and operator.session.decision("rig")
        if rig or not remembered:  # one that is remembered and not connected now is not given up for the simulated one
            _granted(operator, operator.choose_rig(rig_choice(rig or "simulated", operator.session)))
        app = App(operator, host, port, channel=channel)
        try:
            print(f"slviewer is ready: {app.server.url}")
            print(f"to watch only:     {app.server.view_url}")
            print(f"projector page:    {app.server.link('/projector')}", flush=True)
            if not app.server.loopback:
                print("Others on this network can read what is sent: use a network that you trust.", flush=True)
            if open_browser:
                _open(app.server.url)
            _until_stopped()
        except KeyboardInterrupt:
            print("\nslviewer ends; the session is kept.")
        finally:
            app.close()


def rig_choice(text: str, session: Session | None = None) -> dict[str, Any]:
    """What `Operator.choose_rig` takes: "simulated" (half resolution), "simulated:0.25", a preset's name or a file."""
    name, _, scale = text.partition(":")
    if name != "simulated":
        return load_rig(text, session)
    try:
        return {"driver": name, "scale": float(scale or 0.5)}
    except ValueError:
        raise UsageError(f"{text!r} is no rig: write simulated, or simulated:0.25 for a quarter of the size") from None


def _until_stopped() -> None:
    """Wait for Ctrl-C, or for the request to end that a service manager sends."""
    stopped = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: stopped.set())
    while not stopped.wait(1.0):  # in pieces: some systems deliver Ctrl-C only between waits
        pass


def _granted(operator: Operator, granted: bool) -> None:
    """Raise what kept a request from being granted."""
    if not granted:
        failed = operator.wait_for(lambda s: any(n.level == "error" for n in s.notices), 2.0)
        raise SlviewerError(failed.notices[-1].text if failed else "the wizard could not begin: its log says why")


def _open(url: str) -> None:
    try:
        webbrowser.get()
    except webbrowser.Error:
        return
    threading.Thread(target=webbrowser.open, args=(url,), daemon=True).start()
