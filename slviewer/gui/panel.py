"""What every step's panel shares: its context, its buttons, and the callbacks that report
failures."""

import threading
from collections.abc import Callable
from concurrent.futures import Executor
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
import viser

from slviewer.devices.browser import PageRole
from slviewer.devices.page_channel import PageState
from slviewer.errors import InputError
from slviewer.gui.pictures import Painter
from slviewer.gui.scene import ViewerScene
from slviewer.gui.viewpoints import Viewpoints, look_at_points
from slviewer.server.viewers import Viewers
from slviewer.session.store import Session
from slviewer.wizard.operator import Operator
from slviewer.wizard.result_views import ScanCloud
from slviewer.wizard.snapshot import Level, PreviewView, SessionView, Snapshot

ButtonColour = Literal["gray", "red", "orange", "green", "teal", "cyan"]


@dataclass(frozen=True)
class PanelContext:
    """Services that a panel uses.

    `gui` builds inputs, `scene` draws in 3D, `viewpoints` moves the browsers' views, `operator`
    takes requests. `offer(path)` returns the address at which a file of the session is downloaded;
    `notify(level, text)` shows a notification in every browser; `go(key)` shows another step.
    `executor` runs one callback after the other. `page_state(role)` returns the state of a device's
    page; None where none is served. `viewers(answered)` tracks which browsers have drawn what they
    were sent. `show_links(client)` shows the links in one browser.
    """

    gui: viser.GuiApi
    scene: ViewerScene
    viewpoints: Viewpoints
    operator: Operator
    offer: Callable[[Path], str]
    notify: Callable[[Level, str], None]
    go: Callable[[str], None]
    failed: Callable[[BaseException], None]
    executor: Executor
    viewers: Callable[[Callable[[], None]], Viewers]
    page_state: Callable[[PageRole], PageState | None] = lambda _: None
    show_links: Callable[[viser.ClientHandle | None], None] = lambda _: None

    @property
    def session(self) -> Session:
        """The open session. Raises InputError where none is open."""
        if self.operator.session is None:
            raise InputError("no session is open: open one first")
        return self.operator.session

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
                self.failed(error)

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

    def button(
        self,
        label: str,
        do: Callable[[], Any],
        icon: viser.IconName | None = None,
        color: ButtonColour | None = "gray",
        *,
        hint: str | None = None,
        visible: bool = True,
        at_once: bool = False,
    ) -> viser.GuiButtonHandle:
        """Add a button that calls `do()`; without a colour it is the panel's main action."""
        handle = self.gui.add_button(label, icon=icon, color=color, hint=hint, visible=visible)
        handle.on_click(self.callback(do, at_once=at_once))
        return handle

    def view_button(self, points: Callable[[], np.ndarray | None]) -> viser.GuiButtonHandle:
        """Add a button that moves the clicking browser's view to the points (..., 3) mm, if there
        are any."""

        def look(event: Any) -> None:
            """Move the view of the browser that clicked to the points."""
            shown = points()
            if event.client is not None and shown is not None:
                look_at_points(event.client, shown)

        button = self.gui.add_button("Zoom to fit", icon=viser.Icon.FOCUS_2, color="gray")
        button.on_click(lambda event: self.callback(lambda: look(event))(event))
        return button


class StepPanel:
    """Base of the steps' panels. Every method is called by the drawing thread; only changed handles
    are set."""

    key: ClassVar[str]
    layers: ClassVar[tuple[str, ...]] = ()
    """Of the scene, shown with the panel."""

    def __init__(self, context: PanelContext) -> None:
        self._context, self._gui, self._scene = context, context.gui, context.scene
        self._operator = context.operator
        self._painter = Painter(context.failed)
        self._lock = threading.RLock()
        self._snapshot: Snapshot | None = None
        self._visible = False
        self._cloud: ScanCloud | None = None

    @property
    def _session(self) -> SessionView | None:
        """The session of the latest snapshot; None where none is open."""
        return self._snapshot.session if self._snapshot else None

    def _show_view(self) -> None:
        """Move the browsers' views to the panel's cloud, if it is visible."""
        if self._visible and self._cloud is not None:
            self._context.viewpoints.show(
                f"{self.layers[0]} {self._cloud.name}", self._cloud.points
            )

    def build(self) -> None:
        """Create the handles; called once, inside the panel's own container."""
        raise NotImplementedError

    def draw(self, snapshot: Snapshot) -> None:
        """Show a snapshot; called after each change while the panel is shown, and right after
        `show(True)`."""
        raise NotImplementedError

    def draw_preview(self, preview: PreviewView) -> None:
        """Show the latest frame; called while the panel is shown, at most ten times a second."""

    def show(self, visible: bool) -> None:
        """Show or hide the panel's layers of the scene."""
        self._visible = visible
        for layer in self.layers:
            self._scene.show(layer, visible)
