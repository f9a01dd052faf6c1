"""What every step's panel is made of: the services that it uses, its inputs, the callbacks that
report failures, and the thread that makes its pictures."""

import math
import threading
import time
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager, suppress
from functools import partial
from pathlib import Path
from queue import SimpleQueue
from typing import Any, ClassVar, Literal, get_args

import numpy as np
import viser

from slviewer.devices.browser import PageChannels, PageRole
from slviewer.devices.page_channel import PageState
from slviewer.entry_points import PluginGroup
from slviewer.errors import InputError, SlviewerError, hide_passwords
from slviewer.gui.hints import HINTS
from slviewer.gui.scene import Colour, ViewerScene, Viewpoints
from slviewer.gui.widgets import NOTICES, Text, link, paragraph
from slviewer.inputs import find_inputs, read_hint
from slviewer.server.secure import SafeServer
from slviewer.session.recent import RecentSessions
from slviewer.session.store import Session
from slviewer.wizard.jobs import describe_failure
from slviewer.wizard.operator import Operator
from slviewer.wizard.snapshot import ExportView, Level, PreviewView, ScanView, SessionView, Snapshot

NOTHING = "–"
LONGEST_TOAST = 240
"""Characters of a notification."""
TYPING_S = 1.0
"""An input counts as entered after so long without a keystroke."""
NO_SESSION = SessionView(Path(), "", "")
"""What panels show while no session is open."""

ButtonColour = Literal["gray"]
"""A secondary button's; the main action of a step has the accent colour, None."""


def start_worker(name: str) -> Callable[[Callable[[], Any]], None]:
    """Start a thread that calls what is passed to the returned function, one after the other, and
    ends with the program."""
    jobs = SimpleQueue[Callable[[], Any]]()

    def work() -> None:
        """Call what is passed on, forever."""
        while True:
            jobs.get()()

    threading.Thread(target=work, name=name, daemon=True).start()
    return jobs.put


class PanelContext:
    """Services that a panel uses.

    `gui` builds inputs, `scene` draws in 3D, `viewpoints` moves the browsers' views, `operator`
    takes requests. `lock` is held by whatever reads or changes the panels: drawing, callbacks, and
    the pictures that a painter shows. `pages` are the pages of devices; None where none is served.
    `print_links` is called when the links were replaced. `recent` are the sessions of the start
    page.
    """

    def __init__(
        self,
        operator: Operator,
        server: SafeServer,
        pages: PageChannels | None,
        print_links: Callable[[SafeServer], None],
        recent: RecentSessions,
    ) -> None:
        self.operator, self.server, self.pages = operator, server, pages
        self.print_links, self.recent = print_links, recent
        self.gui, self.scene = server.viser.gui, ViewerScene(server.viser, self.submit)
        self.viewpoints = Viewpoints(server.viser, self.scene)
        self._pass_on = start_worker("slviewer requests")
        self.lock = threading.RLock()
        self._toasts: dict[int, viser.NotificationHandle] = {}  # the latest of each browser
        self._toast = 0, 0.0  # rank of the latest one's level, and when it ends
        self.main_buttons: list[viser.GuiButtonHandle] = []
        """Of all steps; secondary while their step is done, as the next one follows."""
        self.commands: list[viser.CommandHandle] = []
        """Everything that keys do."""

    def show_distance(self, mm: float) -> None:
        """Draw and show the rig at a working distance, if that is another one altogether."""
        if not 2 / 3 < mm / self.scene.distance_mm < 1.5:
            self.scene.set_distance(mm)
            self.viewpoints.follow_distance()

    @property
    def session(self) -> Session:
        """The open session. Raises InputError where none is open."""
        if self.operator.session is None:
            raise InputError("no session is open", "open one first")
        return self.operator.session

    def page_state(self, role: PageRole) -> PageState | None:
        """Return the state of a device's page; None where none is served."""
        return None if self.pages is None else getattr(self.pages, role).page_state()

    # what is shown in the browsers

    def notify(self, level: Level, text: str) -> None:
        """Show a notification in every browser in place of the one before, unless that one is
        graver and still shown."""
        title, colour, seconds, _ = NOTICES[level]
        rank, now = get_args(Level).index(level), time.monotonic()
        text = hide_passwords(text)
        if len(text) > LONGEST_TOAST:
            text = f"{text[:LONGEST_TOAST].rsplit(' ', 1)[0]} … (see Messages)"
        with self.lock:
            toasts, (before, until) = self._toasts, self._toast
            if rank < before and now < until:
                return
            self._toast = rank, now + seconds
            for client in self.server.viser.get_clients().values():
                if client.client_id in toasts:
                    toasts[client.client_id].remove()
                toasts[client.client_id] = client.add_notification(
                    title, text, color=colour, auto_close_seconds=seconds
                )

    def report_failure(self, error: BaseException) -> None:
        """Show an error as a notification in every browser."""
        self.notify("error", describe_failure("This", error))

    def offer_download(self, path: Path) -> str:
        """Return the download address of a file of the session."""
        session = self.operator.snapshot().session
        folder = session.folder if session else path.parent
        return self.server.downloads.offer(path, within=folder)

    def offer_frame(self, name: str) -> str:
        """Return the attributes of a capture's picture by which the page reads its frame's pixels;
        empty where its file is missing."""
        with suppress(SlviewerError):
            capture = self.session.load_capture(name)
            path, size = capture.frame_file(capture.brightest_frame)
            address = self.server.downloads.offer(path, within=capture.folder)
            address += f"#{capture.hash[:8]}"  # the page reads a capture again that was retaken
            return f'data-frame="{address}" data-width="{capture.size[0]}" data-bytes="{size}"'
        return ""

    def offer_archive(self) -> str:
        """Return the download address of a zip of the session's files and results, without
        frames."""
        parts = ("exports", "results", "decisions.json", "session.json")
        return self.server.downloads.offer_zip(self.session.folder, parts)

    def links_html(self, exports: Iterable[ExportView], *names: str) -> str:
        """Return download links to those of the exported files that have one of these names."""
        return "".join(
            paragraph(link(self.offer_download(each.path), f"Download {each.name}"))
            for each in exports
            if each.name in names
        )

    # callbacks

    def run(self, do: Callable[[], Any]) -> None:
        """Call `do()`; whatever it raises becomes a notification."""
        try:
            do()
        except Exception as error:
            self.report_failure(error)

    def submit(self, do: Callable[[], Any]) -> None:
        """Call `do()` as `run` does, after all that was submitted before.

        Viser calls back from a pool of threads, several events at a time: here they are queued, so
        that the board is placed before it is captured by someone who clicks fast.
        """

        def call() -> None:
            """Call `do()` while nothing else uses the panels."""
            with self.lock:
                do()

        self._pass_on(partial(self.run, call))


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
        self._context, self._request = context, request
        self._latest: Any = None
        self._entered = -math.inf
        self._timer: threading.Timer | None = None
        handle.on_update(self._enter)

    def update(self, value: Any) -> None:
        """Set the session's value; the handle follows if it has changed."""
        if value != self._latest:
            self._latest = value
            if self._timer is None:
                self._apply_latest()

    async def _enter(self, event: Any) -> None:
        """Request what was entered in a browser; viser calls this before it handles anything
        else."""
        if event.client_id is not None:
            self._entered = time.monotonic()
            # the value is read at once: an older snapshot may be drawn before the request's turn
            self._context.submit(partial(self._request, self.handle.value))

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
    """A dropdown whose options stand for values; `value` is the chosen one, empty where there is
    none. `followed`: returns the values that there are now, and a new one becomes the choice."""

    def __init__(
        self,
        handle: Any,
        options: Mapping[str, Any],
        followed: Callable[[], Iterable[Any]] | None = None,
    ) -> None:
        self.handle = handle
        self._options, self._followed, self._known = options, followed, set[Any]()
        if followed:
            handle.on_update(self._keep)

    def offer(self, options: Mapping[str, Any], preferred: Any = "") -> None:
        """Set the options, {text: value}; the choice becomes a new one of those that are followed,
        else it stays if possible, else it becomes `preferred` or the first one."""
        chosen, texts = self.value, tuple(options) or (NOTHING,)
        there = set(self._followed()) if self._followed else set()
        drawn = [value for value in options.values() if value in there]
        new = [value for value in drawn if value not in self._known] if self._known else []
        self._known = (self._known & there).union(drawn)
        self._options = options
        if new or self.handle.options != texts:
            by_value = {value: text for text, value in options.items()}
            self.handle.options = texts
            chosen = new[0] if new else chosen
            self.handle.value = by_value.get(chosen) or by_value.get(preferred) or texts[0]

    def offer_names(self, names: Iterable[str], preferred: str = "") -> None:
        """Set options that are called by their names."""
        self.offer({name: name for name in names}, preferred)

    @property
    def value(self) -> Any:
        """The chosen value; empty where there is none."""
        return self._options.get(self.handle.value, "")

    def choose(self, value: Any) -> None:
        """Choose an option by its value, if it is offered."""
        for text, each in self._options.items():
            if each == value:
                self.handle.value = text

    async def _keep(self, event: Any) -> None:
        """Know what is there when a user chooses: drawn later, it must not take the choice back.
        Viser calls this before it handles anything else."""
        if event.client_id is not None and self._followed:
            self._known = set(self._followed())


def display_name(name: str, label: str) -> str:
    """Return the text for a capture in a list: its label, followed by its name if they differ."""
    return name if label == name else f"{label} ({name})"


def scan_options(scans: Iterable[ScanView]) -> dict[str, str]:
    """Return {text: name} of each scan, for a `Choice`."""
    return {display_name(scan.name, scan.label): scan.name for scan in scans}


def scan_labels(session: SessionView) -> dict[str, str]:
    """Return {name of a scan: the operator's label for it}."""
    return {scan.name: scan.label for scan in session.scans}


class Painter:
    """Computes the pictures of one panel on a thread; a newer request to `show` something replaces
    a waiting one.

    Whatever is slow (reading a cloud, a figure of matplotlib) is never done by the thread that
    draws panels. `failed(error)` is called for failures; `lock` is held while something is shown.
    """

    def __init__(
        self, failed: Callable[[BaseException], None], lock: AbstractContextManager[Any]
    ) -> None:
        self._failed, self._lock = failed, lock
        self._pass_on = start_worker("slviewer painter")
        self._requested: dict[Callable[[Any], Any], Hashable] = {}

    def request(self, show: Callable[[Any], Any], key: Hashable, make: Callable[[], Any]) -> None:
        """Call `show(make())` on the painter's thread, unless it shows or awaits the same `key`
        already.

        `key` is what the picture depends on. `show` is not called if another request for it came
        meanwhile.
        """
        if self._requested.get(show, self) == key:
            return
        self._requested[show] = key

        def paint() -> None:
            """Compute and show it, as long as it is wanted."""
            try:
                if self._requested.get(show, self) == key:
                    made = make()
                    with self._lock:
                        if self._requested.get(show, self) == key:
                            show(made)
            except Exception as error:
                self._failed(error)

        self._pass_on(paint)

    def request_once(self, show: Callable[[Any], Any], make: Callable[[], Any]) -> None:
        """Call `show(make())` on the painter's thread, whatever else is requested."""

        def show_once(made: Any) -> None:
            """Show it, and forget the request."""
            self.cancel(show_once)
            show(made)

        self.request(show_once, None, make)

    def cancel(self, show: Callable[[Any], Any]) -> None:
        """Drop the request to `show` something; the next one is computed whatever its key."""
        self._requested.pop(show, None)


class Form:
    """Inputs of the fields of settings that declare what they may be; `values` are what was
    entered. One that need not be given is 0 until then."""

    def __init__(self, group: "ControlGroup", settings: type, *names: str) -> None:
        self._inputs: dict[str, tuple[Any, type]] = {}
        self._optional = set[str]()
        for name, (each, declared) in find_inputs(settings).items():
            if names and name not in names:
                continue
            value: Any = each.default
            low, hint = declared.low, read_hint(settings, name)
            if value is None:
                low, value, hint = min(low, 0), 0.0, f"{hint} 0: not given."
                self._optional.add(name)
            title = declared.title(name)
            handle = group.number(title, value, low, declared.high, declared.step, hint)
            self._inputs[name] = handle, type(value)

    def values(self) -> dict[str, Any]:
        """What was entered, by the name of its field; None where nothing was given."""
        return {
            name: None if name in self._optional and not handle.value else kind(handle.value)
            for name, (handle, kind) in self._inputs.items()
        }

    def __getitem__(self, name: str) -> Any:
        """The handle of the input of that name."""
        return self._inputs[name][0]


class ControlGroup:
    """Base of what is built of inputs: each calls back one after the other, reports what is raised,
    and is followed by `redraw`."""

    def __init__(self, context: PanelContext) -> None:
        self.context, self._operator = context, context.operator
        self._gui, self._scene = context.gui, context.scene

    def build(self) -> None:
        """Create the handles; called once, inside the container of panel or part."""

    def draw(self) -> None:
        """Show the latest snapshot by what is chosen in the inputs."""

    def redraw(self) -> None:
        """Draw what an input has changed."""

    def react(
        self,
        register: Callable[[Callable[[Any], None]], object],
        do: Callable[[], Any] | None = None,
        *,
        at_once: bool = False,
    ) -> None:
        """Call `do()`, and redraw, whenever a user changes an input or presses a button, not when
        the program does: `register` is its method that takes a callback.

        `at_once`: for what must not wait, such as cancelling; nothing is redrawn.
        """

        def act() -> None:
            """Call `do()`, and redraw."""
            if do is not None:
                do()
            self.redraw()

        def handle(event: Any) -> None:
            """Queue the call for an event, or call at once."""
            if event.client_id is None:
                return
            if at_once and do is not None:
                self.context.run(do)
            else:
                self.context.submit(act)

        register(handle)

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
        """Add a button that calls `do()`; without a colour it is the step's main action.

        `icon`: the name of one of Tabler's icons.
        """
        name = None if icon is None else viser.IconName(icon)
        handle = self._gui.add_button(label, icon=name, color=color, hint=hint or HINTS.get(label))
        self.react(handle.on_click, do, at_once=at_once)
        if color is None:
            self.context.main_buttons.append(handle)
        return handle

    def command(
        self, label: str, do: Callable[[], Any], key: str, modifier: str | None = None
    ) -> viser.CommandHandle:
        """Add a key that calls `do()` while no text is being entered, and is listed behind "?"."""
        handle = self._gui.add_command(label, hotkey=key, modifier=modifier)  # type: ignore[arg-type]
        self.react(handle.on_trigger, do)
        self.context.commands.append(handle)
        return handle

    def button_group(self, label: str, names: Sequence[str], do: Callable[[str], Any]) -> Any:
        """Add buttons side by side; `do(name)` is called with the name of the pressed one."""
        handle: Any = self._gui.add_button_group(label, tuple(names), hint=HINTS.get(label))
        self.react(handle.on_click, lambda: do(handle.value))
        return handle

    def upload_button(
        self, label: str, do: Callable[[str, bytes], Any], file_types: str
    ) -> viser.GuiUploadButtonHandle:
        """Add a button that calls `do(name, content)` with an uploaded file."""
        handle = self._gui.add_upload_button(
            label,
            icon=viser.Icon.UPLOAD,
            color="gray",
            mime_type=file_types,
            hint=HINTS.get(label),
        )
        self.react(handle.on_upload, lambda: do(handle.value.name, handle.value.content))
        return handle

    def number(
        self,
        label: str,
        value: float,
        low: float | None = None,
        high: float | None = None,
        step: float | None = None,
        hint: str | None = None,
    ) -> Any:
        """Add a number within `low` ... `high`, a whole one if `value` is."""
        hint = hint or HINTS.get(label)
        handle: Any = self._gui.add_number(label, value, min=low, max=high, step=step, hint=hint)
        self.react(handle.on_update)
        return handle

    def checkbox(
        self,
        label: str,
        hint: str | None,
        value: bool = False,
        do: Callable[[bool], Any] | None = None,
    ) -> Any:
        """Add a checkbox; `do(value)` is called when a user changes it."""
        handle = self._gui.add_checkbox(label, value, hint=hint or HINTS.get(label))
        self.react(handle.on_update, None if do is None else lambda: do(handle.value))
        return handle

    def dropdown(
        self,
        label: str,
        options: Iterable[str],
        hint: str | None = None,
        do: Callable[[], Any] | None = None,
    ) -> Any:
        """Add a dropdown of texts; `do()` is called when a user chooses another one."""
        handle: Any = self._gui.add_dropdown(label, tuple(options), hint=hint or HINTS.get(label))
        self.react(handle.on_update, do)
        return handle

    def choice(
        self,
        label: str,
        hint: str | None = None,
        options: Mapping[str, Any] | None = None,
        do: Callable[[], Any] | None = None,
        follow: Callable[[SessionView], Iterable[Any]] | None = None,
    ) -> Choice:
        """Add a dropdown of values, {text: value}; without `options` they are offered later. A new
        one of those that `follow` lists of the session becomes the choice."""
        handle = self.dropdown(label, options or (NOTHING,), hint, do)
        if follow is None:
            return Choice(handle, options or {})
        operator = self.context.operator
        return Choice(handle, options or {}, lambda: follow(operator.snapshot().content))

    def setting(self, handle: Any, request: Callable[[Any], object]) -> Setting:
        """Bind an input to a value of the session, which it requests."""
        return Setting(self.context, handle, request)


class StepPanel(ControlGroup):
    """Base of the steps' panels, each with a layer of the scene that is shown with it. Every method
    is called by one thread at a time."""

    key: ClassVar[str]
    snapshot: Snapshot
    """The latest one; set before anything can be chosen in the panel."""
    _visible = False
    _shown: tuple[str, np.ndarray | None] | None = None
    """Name and points (..., 3) mm of what is shown."""

    def __init__(self, context: PanelContext) -> None:
        super().__init__(context)
        self.painter = Painter(context.report_failure, context.lock)
        self.parts: list[PanelPart] = []
        self.layer = context.scene.layer(self.key)
        with context.gui.add_folder(None, visible=False) as self._container:
            self.build()

    @property
    def session(self) -> SessionView:
        """The session of the latest snapshot, an empty one where none is open."""
        return self.snapshot.session or NO_SESSION

    @property
    def is_blocked(self) -> bool:
        """Whether the step cannot be done yet."""
        return self.snapshot.step(self.key).state == "blocked"

    @property
    def is_ready(self) -> bool:
        """Whether the step can be done, and has no result yet."""
        return self.snapshot.step(self.key).state == "ready"

    def add_plugin(self, plugin: type["PanelPlugin"]) -> None:
        """Add a panel of another package at the end. Raises what building it raises; it is not
        drawn then."""
        before = list(self.parts)
        try:
            with self._container, self._gui.add_folder(plugin.title, expand_by_default=False):
                plugin(self)
        except Exception:
            self.parts = before
            raise

    def show_points(self, name: str, points: np.ndarray | None) -> None:
        """Move the browsers' views to what is shown now, points (..., 3) mm, or once the panel is
        visible."""
        self._shown = name, points
        self.show_view()

    def show_cloud(self, name: str, points: np.ndarray, colours: np.ndarray | Colour) -> int:
        """Draw a cloud (..., 3) mm in place of the last one, and move the browsers' views to it;
        returns the number of points drawn."""
        title = scan_labels(self.session).get(name, name)
        drawn = self.layer.cloud("cloud", points, colours, title=title)
        self.show_points(name, points)
        return drawn

    def show_view(self) -> None:
        """Move the browsers' views to what is shown, if the panel is visible."""
        if self._visible and self._shown:
            name, points = self._shown
            self.context.viewpoints.show(f"{self.key} {name}", points)

    def update(self, snapshot: Snapshot) -> None:
        """Show a snapshot; called after each change while the panel is shown, and right after
        `show(True)`."""
        self.snapshot = snapshot
        self.redraw()

    def redraw(self) -> None:
        """Draw the parts, then the panel; a part of another package that fails is reported, and
        not drawn again."""
        for each in (*self.parts, self):
            try:
                each.draw()
            except Exception as error:
                if not isinstance(each, PanelPlugin):
                    raise
                self.parts.remove(each)
                self.context.report_failure(error)

    def draw_preview(self, preview: PreviewView) -> None:
        """Show the latest frame; called while the panel is shown, at most ten times a second."""

    def show(self, visible: bool) -> None:
        """Show or hide the panel, its layer of the scene, and the layers in that one."""
        self._visible = self._container.visible = visible
        self.layer.show(visible)


class PanelPart(ControlGroup):
    """Base of what several panels share, and of parts that have a state of their own; drawn before
    its panel, by whose painter and in whose layer."""

    def __init__(self, panel: StepPanel) -> None:
        super().__init__(panel.context)
        self.panel, self._painter, self._layer = panel, panel.painter, panel.layer
        panel.parts.append(self)
        self.build()

    def redraw(self) -> None:
        """Draw the panel."""
        self.panel.redraw()


class PanelPlugin(PanelPart):
    """Base of the panels of other packages: a folder at the end of the ``step``, called ``title``.

    ``name``: that of its entry point. ``build`` creates its inputs, ``draw`` shows the session's
    records in ``self.panel.session``, and ``self._operator.run(operation, ...)`` runs an operation.
    """

    name: ClassVar[str]
    step: ClassVar[str]
    title: ClassVar[str]


PANEL_PLUGINS = PluginGroup[type[PanelPlugin]](
    "slviewer.panels",
    type,  # type: ignore[arg-type]
    lambda: (),
)


class ReconstructAllButton(PanelPart):
    """A button that reconstructs all scans without an up-to-date cloud, while there are any and
    nothing is computed."""

    def build(self) -> None:
        """Create the button."""
        self._button = self.button(
            "Reconstruct all",
            self._operator.reconstruct_all,
            "cube",
            hint="The scans without a cloud of the present calibration",
        )

    def draw(self) -> None:
        """State how many there are."""
        pending = self.panel.session.pending_scans
        what = scan_labels(self.panel.session)[pending[0]] if pending else ""
        self._button.label = f"Reconstruct {f'all {len(pending)}' if pending[1:] else what}"
        is_calibrated = self.panel.snapshot.step("scan").state != "blocked"
        self._button.visible = bool(pending) and is_calibrated and not self.panel.snapshot.is_busy


class Confirmation(PanelPart):
    """A question before something that is missed afterwards, hidden until it is asked."""

    _do: Callable[[], Any] | None = None

    def build(self) -> None:
        """Create text and buttons."""
        self._text = Text(self._gui)
        self._confirm = self.button("Confirm", lambda: self._close(True), "check")
        self._keep = self.button("Keep", lambda: self._close(False), "x")
        self._close(False)

    def ask(self, question: str, action: str, do: Callable[[], Any]) -> None:
        """Ask; `do()` is called once the button ``action`` is pressed."""
        self._do = do
        self._text.write(question, "warning")
        self._confirm.label = action
        self._confirm.visible = self._keep.visible = True

    def _close(self, is_confirmed: bool) -> None:
        """Hide the question, and do what it asked about where that is confirmed."""
        do, self._do = self._do, None
        self._text.set("")
        self._confirm.visible = self._keep.visible = False
        if is_confirmed and do:
            do()


class RestoreButton(PanelPart):
    """A button that restores the capture that was deleted last."""

    _name = ""

    def build(self) -> None:
        """Create the button."""
        self._button = self.button(
            "Restore", lambda: self._operator.undelete(self._name), "arrow-back-up"
        )

    def offer(self, deleted: Sequence[str]) -> None:
        """Offer the first of these names, the last deleted; the button is hidden without one."""
        self._name = deleted[0] if deleted else ""
        self._button.label = f"Restore {self._name}"
        self._button.visible = bool(deleted)
