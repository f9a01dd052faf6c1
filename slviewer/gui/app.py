"""Starts the wizard: the operator, the server, and one thread that draws."""

import contextlib
import logging
import os
import signal
import tempfile
import threading
import time
import webbrowser
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import viser

from slviewer.devices.browser import PAGE_ROLES, PageChannels, PageRole
from slviewer.devices.page_channel import PageState
from slviewer.errors import SlviewerError, UsageError
from slviewer.gui.links import show_links
from slviewer.gui.panel import PanelContext
from slviewer.gui.scene import ViewerScene
from slviewer.gui.shell import Shell, greet_viewer, notify
from slviewer.gui.viewpoints import FIELD_OF_VIEW, OVERVIEW, Viewpoints
from slviewer.pipeline.rig_choice import load_rig, set_up
from slviewer.server.access import ONE_TIME_SECONDS, ROLES
from slviewer.server.device_pages import serve_device_pages
from slviewer.server.secure import SafeServer, Serving, serve
from slviewer.server.viewers import Viewers
from slviewer.server.viser_internals import ViserClient
from slviewer.session.store import Session
from slviewer.wizard.notices import describe_failure
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
        serving: Serving,
        *,
        pages: PageChannels | None = None,
        print_links: Callable[[SafeServer], None] = lambda _: None,
    ) -> None:
        """Serve `operator`, and the pages of devices if `pages` is given, those that its rigs are
        set up with.

        `print_links` is called when the links were replaced. Raises SlviewerError where it cannot
        be served.
        """
        self.operator = operator
        self.pages = pages
        self._print_links = print_links
        self.server: SafeServer = serve(serving, label="slviewer")
        try:
            if pages is not None:
                serve_device_pages(self.server, pages)
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
        """Build the page and its shell, subscribe to snapshots and previews, and start the drawing
        thread."""
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
            self._show_links,
        )
        snapshot = operator.snapshot()
        self._notified = snapshot.notices[-1].number if snapshot.notices else 0
        self.shell = Shell(context, snapshot.steps)
        page.on_client_connect(self._greet_client)
        self._unsubscribe = operator.subscribe(
            lambda _: self._changed.set(), lambda _: self._changed.set()
        )
        self._thread = threading.Thread(
            target=self._draw_forever, name="slviewer drawing", daemon=True
        )
        self._thread.start()

    # drawing

    def _draw_forever(self) -> None:
        """Draw new snapshots and previews until closing; a failure is reported once and retried
        every second."""
        version, number = -1, -1
        pages: list[PageState | None] = []
        while not self._closing:
            begun = time.monotonic()
            self._changed.wait(0.5)
            self._changed.clear()
            if self._closing:
                return
            if pages != (pages := [self._get_page_state(role) for role in PAGE_ROLES]):
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
        """Draw the snapshot and the preview if they are newer than these; returns the version and
        number drawn."""
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
        self._notify("error", describe_failure("This", error))

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

    def _get_page_state(self, role: PageRole) -> PageState | None:
        """Return the state of a device's page; None where none is served."""
        if self.pages is None:
            return None
        return (self.pages.projector if role == "projector" else self.pages.camera).page_state()

    def _greet_client(self, client: viser.ClientHandle) -> None:
        """Show a browser that may only watch that it may, and an operator's what only operators
        see."""
        if self.server.role(client.client_id) == "operate":
            ViserClient(self.server.viser, client.client_id).send_private_values()
        else:
            greet_viewer(client)

    def _show_links(self, client: viser.ClientHandle | None) -> None:
        """Show the links in the browser that requested them; None: it has disconnected."""
        if client is None:
            return
        number = client.client_id

        def replace() -> None:
            """Replace all links, and print the new ones."""
            try:
                self.server.renew_links(number)
                self.operator.notify(
                    "info", "The links were replaced: pages opened by the old ones are closed"
                )
            except OSError as error:
                file = self.server.serving.token_file
                self.operator.notify(
                    "error",
                    f"The links were replaced, but {file} holds the old tokens, valid again after a"
                    f" restart ({error.strerror}): write new ones into it",
                )
            self._print_links(self.server)

        show_links(client, self.server, replace)


def run(
    session: Path | None = None,
    rig: str = "",
    serving: Serving | None = None,
    open_browser: bool = True,
) -> None:
    """Serve the wizard until Ctrl-C. `rig` as in `rig_choice`; empty: the session's, else the
    simulated one.

    Raises SlviewerError where the session, the rig or the address cannot be used.
    """
    pages = PageChannels()
    with Operator(set_up=partial(set_up, pages=pages)) as operator:
        _check_granted(operator, operator.open_session(session or Path(DEFAULT_SESSION)))
        store = operator.session
        remembered = store is not None and (store.valid_decision("rig") or store.decision_faults())
        # a remembered rig that is not connected now is not replaced by the simulated one
        if rig or not remembered:
            _check_granted(
                operator, operator.choose_rig(rig_choice(rig or "simulated", operator.session))
            )
        app = App(operator, serving or Serving(), pages=pages, print_links=print_links)
        preparation = Preparation(operator.set_preparing)
        preparation.start()
        with contextlib.ExitStack() as ended:
            ended.callback(app.close)
            ended.callback(preparation.close)
            try:
                print_links(app.server)
                if open_browser:
                    ended.enter_context(browser_opened(app.server))
                _wait_for_stop()
            except KeyboardInterrupt:
                print("\nslviewer has stopped; the session is saved.")


def print_links(server: SafeServer) -> None:
    """Print the links of all roles, or, where their tokens are in a file, its path: the output may
    be logged."""
    file = server.serving.token_file
    if file is None:
        print(f"slviewer is ready: {server.link()}")
        print(f"view-only link:    {server.link('watch')}")
        print(f"projector page:    {server.link('project')}")
        print(f"camera page:       {server.link('camera')}")
    else:
        print(
            f"slviewer is ready: {server.origin}/#TOKEN, with the tokens {', '.join(ROLES)} of"
            f" {file}"
        )
    if server.certificate is None and not server.loopback:
        print("The connection is not encrypted: use --tls, or a network that you trust.")
    elif server.certificate is not None and server.certificate.self_made:
        print(
            "Browsers warn of the self-made certificate. Compare its SHA-256 fingerprint before you"
            " continue:"
        )
        print(f"  {server.certificate.fingerprint}")
    print(end="", flush=True)


def rig_choice(text: str, session: Session | None = None) -> dict[str, Any]:
    """Parse a rig from text: "simulated" (half resolution), "simulated:0.25", a preset's name or a
    file.

    Returns the choice that `Operator.choose_rig` takes. Raises UsageError for an invalid scale.
    """
    name, _, scale = text.partition(":")
    if name != "simulated":
        return load_rig(text, session)
    try:
        return {"driver": name, "scale": float(scale or 0.5)}
    except ValueError:
        raise UsageError(
            f"{text!r} is not a rig: write simulated, or simulated:0.25 for a quarter of the size"
        ) from None


def _wait_for_stop() -> None:
    """Wait for Ctrl-C, or for the signal of a service manager."""
    stopped = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: stopped.set())
    while not stopped.wait(1.0):  # some systems deliver Ctrl-C only between waits
        pass


def _check_granted(operator: Operator, granted: bool) -> None:
    """Raise SlviewerError with the notice of the error unless a request was granted."""
    if not granted:
        raise SlviewerError(
            next(notice.text for notice in reversed(operator.notices()) if notice.level == "error")
        )


@contextlib.contextmanager
def browser_opened(server: SafeServer) -> Iterator[None]:
    """Open the wizard in the default browser without waiting; nothing happens where there is none.

    The command line of a browser can be read by every user of the machine: it is given a file that
    this user alone can read, which leads to a link that can be opened once. The file is in the home
    folder, as some browsers are kept from all others, and removed once it is no longer needed.
    """
    try:
        webbrowser.get()
        home = Path.home()
        folder = tempfile.TemporaryDirectory(
            prefix="slviewer-",
            dir=home if os.access(home, os.W_OK) else None,
            ignore_cleanup_errors=True,
        )
    except (webbrowser.Error, OSError, RuntimeError):
        yield
        return
    with folder as place:
        page = Path(place, "open.html")
        link = server.one_time_link()
        with os.fdopen(
            os.open(page, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w", encoding="utf-8"
        ) as file:
            file.write(
                '<!doctype html><meta charset="utf-8"><meta name="referrer" content="no-referrer">'
                f"<title>slviewer</title><script>location.replace({link!r})</script>"
            )

        def open_page() -> None:
            """Open the page, and remove it when its link has been opened or is no longer valid."""
            webbrowser.open(page.as_uri())
            end = time.monotonic() + ONE_TIME_SECONDS
            while server.access.is_pending(link.partition("#")[2]) and time.monotonic() < end:
                time.sleep(0.5)
            folder.cleanup()

        threading.Thread(target=open_page, daemon=True).start()
        yield
