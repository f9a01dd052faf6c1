"""Starts the wizard: the operator, the server, and one thread that draws."""

import contextlib
import os
import signal
import tempfile
import threading
import time
import webbrowser
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, get_args

import viser

from slviewer.devices.browser import PAGE_ROLES, PageChannels
from slviewer.devices.page_channel import PageState
from slviewer.errors import SlviewerError, UsageError
from slviewer.geometry.jit_prepare import Preparation
from slviewer.gui.panel import PanelContext
from slviewer.gui.shell import Shell
from slviewer.gui.widgets import alert
from slviewer.pipeline.rig_choice import load_rig, set_up
from slviewer.server.access import ONE_TIME_SECONDS, ROLES
from slviewer.server.device_pages import serve_device_pages
from slviewer.server.secure import SafeServer, Serving, serve
from slviewer.server.viser_internals import ViserClient
from slviewer.session.recent import RecentSessions, sessions_folder, state_file
from slviewer.session.store import Session
from slviewer.wizard.operator import Operator
from slviewer.wizard.snapshot import Level, Snapshot

DRAWN_PER_S = 10.0
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
        recent: RecentSessions | None = None,
    ) -> None:
        """Serve `operator`, and the pages of devices if `pages` is given, those that its rigs are
        set up with.

        `print_links` is called when the links were replaced. `recent`: sessions on the start page,
        to which those that are opened are added; by default these alone. Raises SlviewerError where
        it cannot be served.
        """
        self.operator = operator
        self.server: SafeServer = serve(serving)
        try:
            if pages:
                serve_device_pages(self.server, pages)
            self._context = PanelContext(
                operator, self.server, pages, print_links, recent or RecentSessions()
            )
            page = self.server.viser
            page.gui.configure_theme(brand_color=_BRAND, control_width="large")
            self._closing = False
            self._changed = threading.Event()
            self._folder: Path | None = None
            self._failure = ""
            self._version, self._number = -1, (-1, "")
            snapshot = operator.snapshot()
            self._notified = snapshot.notices[-1].number if snapshot.notices else 0
            self.shell = Shell(self._context, snapshot.steps)
            page.on_client_connect(self._greet_client)
            self._unsubscribe = operator.subscribe(
                lambda _: self._changed.set(), lambda _: self._changed.set()
            )
            self._thread = threading.Thread(
                target=self._draw_forever, name="slviewer drawing", daemon=True
            )
            self._thread.start()
        except BaseException:
            self.server.stop()
            raise

    def close(self) -> None:
        """End drawing and serving; the operator stays open."""
        self._closing = True
        self._changed.set()
        self._unsubscribe()
        self._thread.join(5.0)
        self.server.stop()

    def _draw_forever(self) -> None:
        """Draw new snapshots and previews until closing; a failure is reported once and retried
        every second."""
        pages: list[PageState | None] = []
        while not self._closing:
            begun = time.monotonic()
            self._changed.wait(0.5)
            self._changed.clear()
            if self._closing:
                return
            if pages != (pages := [self._context.page_state(role) for role in PAGE_ROLES]):
                self._version = -1
            self.operator.watch_previews(
                bool(self.server.viser.get_clients()) and self.shell.shows_preview
            )
            try:
                self._draw()
            except Exception as error:
                self._version = -1
                if repr(error) != self._failure:  # it is tried again, and reported once
                    self._failure = repr(error)
                    self._context.report_failure(error)
                time.sleep(1.0)
            time.sleep(max(0.0, 1 / DRAWN_PER_S - (time.monotonic() - begun)))

    def _draw(self) -> None:
        """Draw the snapshot and the preview if they are newer than those that were drawn."""
        snapshot, preview = self.operator.snapshot(), self.operator.preview()
        folder = snapshot.session.folder if snapshot.session else None
        if folder != self._folder:
            self._folder = folder
            self.server.downloads.clear()
            if folder:
                self._context.recent.add(folder)
        if snapshot.version != self._version or self.shell.needs_drawing:
            with self._context.lock, self.server.viser.atomic():
                self.shell.update(snapshot)
            self._notify(snapshot)
        self._version = snapshot.version
        if preview and (preview.number, self.shell.current) != self._number:
            with self._context.lock:
                self.shell.draw_preview(preview)
            self._number = preview.number, self.shell.current

    def _notify(self, snapshot: Snapshot) -> None:
        """Show the gravest of the new notices that the page does not state, and how many more there
        are."""
        new = [
            each
            for each in snapshot.notices
            if each.number > self._notified and not self.shell.states(each)
        ]
        if snapshot.notices:
            self._notified = snapshot.notices[-1].number
        if new:
            worst = max(new, key=lambda each: (get_args(Level).index(each.level), each.number))
            more = f" ({len(new) - 1} more: see Messages)" if len(new) > 1 else ""
            self._context.notify(worst.level, f"{worst.text}{more}")

    def _greet_client(self, client: viser.ClientHandle) -> None:
        """Show a browser that may only watch that it cannot change anything, and an operator's what
        only operators see."""
        if self.server.role(client.client_id) == "operate":
            ViserClient(self.server.viser, client.client_id).send_private_values()
        else:
            with client.atomic():
                client.gui.add_html(
                    str(alert("View only: this link changes nothing.", "info")), order=-1.0
                )


def run(
    session: Path | None = None,
    rig: str = "",
    serving: Serving | None = None,
    open_browser: bool = True,
) -> None:
    """Serve the wizard until Ctrl-C, with its start page where no session is given. `rig` as in
    `rig_choice`; empty: the session's, else the simulated one.

    Raises SlviewerError where the session, the rig or the address cannot be used.
    """
    pages = PageChannels()
    with Operator(set_up=partial(set_up, pages=pages)) as operator:
        if session:
            _check_granted(operator, operator.open_session(session))
        store = operator.session
        remembered = store is not None and (store.valid_decision("rig") or store.decision_faults())
        # a remembered rig that is not connected now is not replaced by the simulated one
        if rig or not remembered:
            _check_granted(
                operator, operator.choose_rig(rig_choice(rig or "simulated", operator.session))
            )
        recent = RecentSessions(state_file())
        app = App(
            operator, serving or Serving(), pages=pages, print_links=print_links, recent=recent
        )
        preparation = Preparation(lambda share: operator.show(preparing=share))
        preparation.start()
        with contextlib.ExitStack() as ended:
            ended.callback(app.close)
            ended.callback(preparation.close)
            try:
                if session is None:
                    print(f"New sessions are made in {sessions_folder()}.")
                print_links(app.server)
                if open_browser:
                    ended.enter_context(browser_opened(app.server))
                stopped = threading.Event()
                signal.signal(signal.SIGTERM, lambda *_: stopped.set())  # of a service manager
                while not stopped.wait(1.0):  # some systems deliver Ctrl-C only between waits
                    pass
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
    elif server.certificate and server.certificate.self_made:
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
            f"{text!r} is not a rig", "write simulated, or simulated:0.25 for a quarter of the size"
        ) from None


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
        page.touch(0o600, exist_ok=False)
        page.write_text(
            '<!doctype html><meta charset="utf-8"><meta name="referrer" content="no-referrer">'
            f"<title>slviewer</title><script>location.replace({link!r})</script>",
            encoding="utf-8",
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
