"""What a step's panel is, and what it is given: where to draw, whom to ask, and how to hear of failures."""

from collections.abc import Callable
from concurrent.futures import Executor
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import viser

from slviewer.devices.channel import Standing
from slviewer.gui.scene import ViewerScene
from slviewer.gui.viewpoints import Viewpoints, bring
from slviewer.server.viewers import Viewers
from slviewer.wizard.snapshot import Level, PreviewView, Snapshot


@dataclass(frozen=True)
class Stage:
    """What a panel works with.

    `gui` builds inputs, `scene` draws in 3D, `viewpoints` turns the browsers' views, `operator` takes requests.
    `offer(path)` gives the address at which a file of the session is downloaded; `tell(level, text)` shows a
    notification in every browser; `escape(text)` makes text that was typed or read harmless inside HTML and
    Markdown. `go(key)` brings another step to the front. `turns` does one callback after the other.
    `projector_page()` says where the projector page stands; None where none is served. `viewers(answered)` tells
    which browsers have drawn what they were sent.
    """

    gui: viser.GuiApi
    scene: ViewerScene
    viewpoints: Viewpoints
    operator: Any
    offer: Callable[[Path], str]
    tell: Callable[[Level, str], None]
    escape: Callable[[str], str]
    go: Callable[[str], None]
    failed: Callable[[BaseException], None]
    turns: Executor
    viewers: Callable[[Callable[[], None]], Viewers]
    projector_page: Callable[[], Standing | None] = lambda: None

    def safely(self, do: Callable[[], Any], *, at_once: bool = False) -> Callable[[Any], None]:
        """A callback for viser that calls `do()`; whatever it raises becomes a notification in plain words.

        ``button.on_click(stage.safely(lambda: stage.operator.calibrate()))``. Viser calls back from a pool of threads,
        one event beside the other: here they take their turns, so that the board is placed before it is captured by
        whoever clicks fast. `at_once`: for what must not wait, as cancelling.
        """

        def call() -> None:
            try:
                do()
            except Exception as error:
                self.failed(error)

        return (lambda _event: call()) if at_once else (lambda _event: self._queue(call))

    def safely_with(self, do: Callable[[Any], Any]) -> Callable[[Any], None]:
        """The same for a callback that needs viser's event, as those of gizmos and of the scene do."""
        return lambda event: self.safely(lambda: do(event))(event)

    def bring_button(self, points: Callable[[], np.ndarray | None]) -> viser.GuiButtonHandle:
        """A button that turns the view of whoever clicks it to the points (..., 3) mm that it is given then, if any."""
        button = self.gui.add_button("Bring into view", icon=viser.Icon.FOCUS_2, color="gray")
        button.on_click(self.safely_with(lambda event: _bring(event, points())))
        return button

    def _queue(self, call: Callable[[], None]) -> None:
        with suppress(RuntimeError):  # the wizard ends
            self.turns.submit(call)


def _bring(event: Any, points: np.ndarray | None) -> None:
    if event.client is not None and points is not None:
        bring(event.client, points)


class Panel(Protocol):
    """One step's controls. Every method is called by the drawing thread, and only handles that changed are touched."""

    key: str

    def __init__(self, stage: Stage) -> None: ...

    def build(self) -> None:
        """Make the handles; called once, inside the panel's own container."""

    def draw(self, snapshot: Snapshot) -> None:
        """Show this. Called whenever the snapshot changed while the panel is shown, and right after `shown(True)`."""

    def draw_preview(self, preview: PreviewView) -> None:
        """Show the latest frame; called while the panel is shown, ten times a second at most."""

    def shown(self, visible: bool) -> None:
        """The panel is brought to the front, or hidden: show or hide its layers of the scene."""
