"""Step 1: choose the rig, see what it sees, and set the light."""

import time
from typing import Any

from slviewer.gui.inputs import Follows, change
from slviewer.gui.panel import Stage
from slviewer.gui.preview import drawn as drawn_preview
from slviewer.gui.preview import histogram_chart, legend, light_words
from slviewer.gui.rig_check import RigCheck
from slviewer.gui.rig_choice import RigChoice
from slviewer.gui.widgets import Picture, Words
from slviewer.wizard.snapshot import PreviewView, RigView, Snapshot

LIGHTS = {"Even white": "white", "Even grey": "grey", "Dark": "dark", "Test stripes": "pattern"}
_STOP = 2 ** (1 / 3)
_SETTLES_S = 1.5  # the exposure that the operator drags is not set back to what the camera said a moment ago


class Panel:
    """The rig."""

    key = "rig"

    def __init__(self, stage: Stage) -> None:
        self._stage = stage
        self._drawn: RigView | None = None
        self._touched = 0.0

    def build(self) -> None:
        """Choice, picture, light."""
        gui, stage = self._stage.gui, self._stage
        self._rig = RigChoice(stage)
        self._picture = Picture(gui, "Live picture")
        self._histogram = Words(gui)
        self._exposure = gui.add_slider("Exposure, ms", 0.01, 4.0, 0.01, 1.0)
        self._exposure.on_update(stage.safely_with(self._expose))
        step = gui.add_button_group("Brightness", ("Darker", "Brighter"))
        step.on_click(stage.safely(lambda: self._step(step.value)))
        self._light = gui.add_dropdown("Projector shows", tuple(LIGHTS))
        self._light_follows = Follows(self._light)
        self._light.on_update(stage.safely_with(self._shine))
        self._check = RigCheck(stage)

    def draw(self, snapshot: Snapshot) -> None:
        """The rig as it is."""
        self._rig.draw(snapshot)
        self._check.draw(snapshot)
        rig = snapshot.rig
        self._draw_exposure(rig)
        if rig == self._drawn:
            return
        open_now = rig.state == "open"
        for handle in (self._exposure, self._light):
            change(handle, disabled=not open_now)
        shows = next((words for words, light in LIGHTS.items() if light == rig.light), None)
        if shows is not None:
            self._light_follows.tell(shows)
        if not open_now:
            self._picture.hide()
            self._histogram.set("")
        self._drawn = rig

    def _draw_exposure(self, rig: RigView) -> None:
        if rig.exposure_ms is not None and time.monotonic() - self._touched > _SETTLES_S:
            if rig.exposure_ms > self._exposure.max:
                self._exposure.max = _round_up(rig.exposure_ms)
            if abs(self._exposure.value - rig.exposure_ms) > 0.005:
                change(self._exposure, value=round(rig.exposure_ms, 2))

    def draw_preview(self, preview: PreviewView) -> None:
        """What the camera sees, and what it was set to, once nobody drags that any more."""
        self._draw_exposure(self._stage.operator.snapshot().rig)
        self._picture.set(drawn_preview(preview), legend(preview, light_words(preview)))
        self._histogram.set(histogram_chart(preview))

    def shown(self, visible: bool) -> None:
        """Nothing of this step stands in the scene."""

    def _expose(self, event: Any) -> None:
        if event.client is not None:
            self._touched = time.monotonic()
            self._stage.operator.set_exposure(float(self._exposure.value))

    def _step(self, direction: str) -> None:
        now = self._stage.operator.snapshot().rig.exposure_ms
        if now is not None:
            self._touched = 0.0
            self._stage.operator.set_exposure(now * _STOP if direction == "Brighter" else now / _STOP)

    def _shine(self, event: Any) -> None:
        operator = self._stage.operator
        if event.client is not None and not operator.shine(LIGHTS[self._light.value]):
            now = operator.snapshot().rig.light
            change(self._light, value=next(words for words, light in LIGHTS.items() if light == now))


def _round_up(exposure_ms: float) -> float:
    top = 4.0
    while top < exposure_ms:
        top *= 4
    return top
