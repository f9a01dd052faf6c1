"""Step 1: choose the rig, see what it sees, and set the light."""

import time
from typing import Any

from slviewer.devices.drivers import available
from slviewer.gui.inputs import Follows, change
from slviewer.gui.panel import Stage
from slviewer.gui.preview import drawn as drawn_preview
from slviewer.gui.preview import histogram_chart, legend, light_words
from slviewer.gui.widgets import Html, Picture, Words, block, boxed, cell, toned
from slviewer.simulation.rig import letter
from slviewer.workflow.wizard.snapshot import PreviewView, RigView, Snapshot

SIMULATED: dict[str, dict[str, Any]] = {
    "Simulated, half resolution": {"driver": "simulated", "scale": 0.5},
    "Simulated, full resolution": {"driver": "simulated", "scale": 1.0},
    "Simulated, quarter resolution": {"driver": "simulated", "scale": 0.25},
}
LIGHTS = {"Even white": "white", "Even grey": "grey", "Dark": "dark", "Test stripes": "pattern"}
_CHOOSE = "Choose …"
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
        self._choices: dict[str, dict[str, Any]] = {
            **SIMULATED,
            **{
                f"{d.name}: {d.what}": {"driver": d.name}
                for d in available()
                if d.rig and not d.needs and not d.missing
            },
        }
        self._choices.pop("simulated: a rig that exists in numbers only, with known truth", None)
        self._choice = gui.add_dropdown("Rig", (_CHOOSE, *self._choices))
        self._choice.on_update(stage.safely_with(self._choose))
        self._says = Words(gui)
        self._picture = Picture(gui, "Live picture")
        self._histogram = Words(gui)
        self._exposure = gui.add_slider("Exposure, ms", 0.01, 4.0, 0.01, 1.0)
        self._exposure.on_update(stage.safely_with(self._expose))
        step = gui.add_button_group("Brightness", ("Darker", "Brighter"))
        step.on_click(stage.safely(lambda: self._step(step.value)))
        self._light = gui.add_dropdown("Projector shows", tuple(LIGHTS))
        self._choice_follows, self._light_follows = Follows(self._choice), Follows(self._light)
        self._light.on_update(stage.safely_with(self._shine))

    def draw(self, snapshot: Snapshot) -> None:
        """The rig as it is."""
        rig = snapshot.rig
        if rig == self._drawn:
            return
        self._says.set(_described(rig))
        self._choice_follows.tell(self._chosen(rig))
        open_now = rig.state == "open"
        for handle in (self._exposure, self._light):
            change(handle, disabled=not open_now)
        if rig.exposure_ms is not None and time.monotonic() - self._touched > _SETTLES_S:
            if rig.exposure_ms > self._exposure.max:
                self._exposure.max = _round_up(rig.exposure_ms)
            if abs(self._exposure.value - rig.exposure_ms) > 0.005:
                change(self._exposure, value=round(rig.exposure_ms, 2))
        shows = next((words for words, light in LIGHTS.items() if light == rig.light), None)
        if shows is not None:
            self._light_follows.tell(shows)
        if not open_now:
            self._picture.hide()
            self._histogram.set("")
        self._drawn = rig

    def draw_preview(self, preview: PreviewView) -> None:
        """What the camera sees."""
        self._picture.set(drawn_preview(preview), legend(preview, light_words(preview)))
        self._histogram.set(histogram_chart(preview))

    def shown(self, visible: bool) -> None:
        """Nothing of this step stands in the scene."""

    def _chosen(self, rig: RigView) -> str:
        """The choice that gave this rig, as far as it can be told."""
        if rig.simulated and rig.camera is not None:
            width, _ = letter().camera.size
            return next((c for c, how in SIMULATED.items() if round(width * how["scale"]) == rig.camera[0]), _CHOOSE)
        return next((c for c, how in self._choices.items() if how["driver"] == rig.name), _CHOOSE)

    def _choose(self, event: Any) -> None:
        if event.client is not None and self._choice.value in self._choices:
            self._stage.operator.choose_rig(self._choices[self._choice.value])

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
        if event.client is not None:
            self._stage.operator.shine(LIGHTS[self._light.value])


def _described(rig: RigView) -> str:
    if rig.state == "none":
        return boxed("No rig yet: the simulated one needs nothing but this program.", "info")
    if rig.state == "lost":
        return boxed(rig.fault or "The rig does not answer.", "error")
    if rig.state == "opening":
        return block(toned("Opening …", "dim"))
    sizes = [
        f"{what} {size[0]} × {size[1]} px"
        for what, size in (("camera", rig.camera), ("projector", rig.projector))
        if size is not None
    ]
    return block(Html(f"{toned('●', 'good')} {cell(rig.name)} · {cell(', '.join(sizes))}"))


def _round_up(exposure_ms: float) -> float:
    top = 4.0
    while top < exposure_ms:
        top *= 4
    return top
