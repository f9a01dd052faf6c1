"""Step 1: choose the rig, check its image, and set exposure and light."""

import time

from slviewer.gui.exposures import ExposureInputs
from slviewer.gui.inputs import SessionValue, change
from slviewer.gui.panel import StepPanel
from slviewer.gui.preview import draw_preview, exposure_html, histogram_chart, legend
from slviewer.gui.rig_check import RigCheck
from slviewer.gui.rig_choice import RigChoice
from slviewer.gui.widgets import Picture, Text
from slviewer.wizard.snapshot import PreviewView, RigView, Snapshot

LIGHTS = {"White": "white", "Grey": "grey", "Dark": "dark", "Fringes": "pattern"}
_THIRD_OF_A_STOP = 2 ** (1 / 3)
# an exposure that is being dragged is not set back to what the camera reported a moment ago
_SETTLES_S = 1.5


class RigPanel(StepPanel):
    """Panel of the step Rig."""

    key = "rig"
    _drawn: RigView | None = None
    _entered = 0.0

    def build(self) -> None:
        """Create the inputs of devices, exposure, light and check."""
        gui, context = self._gui, self._context
        self._rig = RigChoice(context)
        self._picture = Picture(gui, "Live image")
        self._histogram = Text(gui)
        self._exposure = gui.add_slider("Exposure, ms", 0.01, 4.0, 0.01, 1.0)
        self._exposure.on_update(context.callback(self._set_exposure, by_user=True))
        step = gui.add_button_group("Brightness", ("Darker", "Brighter"))
        step.on_click(context.callback(lambda: self._step_exposure(step.value)))
        self._light = gui.add_dropdown("Projector", tuple(LIGHTS), hint="Shown between captures")
        self._light_value = SessionValue(self._light)
        self._light.on_update(context.callback(self._set_light, by_user=True))
        self._exposures = ExposureInputs(context)
        self._check = RigCheck(context)

    def draw(self, snapshot: Snapshot) -> None:
        """Show the rig of a snapshot."""
        self._rig.draw(snapshot)
        self._exposures.draw(snapshot)
        self._check.draw(snapshot)
        rig = snapshot.rig
        self._draw_exposure(rig)
        if rig == self._drawn:
            return
        for handle in (self._exposure, self._light):
            change(handle, disabled=rig.state != "open")
        light = next((label for label, light in LIGHTS.items() if light == rig.light), None)
        if light is not None:
            self._light_value.update(light)
        if rig.state != "open":
            self._picture.hide()
            self._histogram.set("")
        self._drawn = rig

    def _draw_exposure(self, rig: RigView) -> None:
        """Set the slider to the rig's exposure, unless it was moved a moment ago."""
        if rig.exposure_ms is not None and time.monotonic() - self._entered > _SETTLES_S:
            while rig.exposure_ms > self._exposure.max:
                self._exposure.max *= 4
            if abs(self._exposure.value - rig.exposure_ms) > 0.005:
                change(self._exposure, value=round(rig.exposure_ms, 2))

    def draw_preview(self, preview: PreviewView) -> None:
        """Show the live image and its histogram."""
        self._draw_exposure(self._operator.snapshot().rig)
        self._picture.set(draw_preview(preview), legend(preview, exposure_html(preview)))
        self._histogram.set(histogram_chart(preview))

    def _set_exposure(self) -> None:
        """Request the exposure of the slider."""
        self._entered = time.monotonic()
        self._operator.set_exposure(float(self._exposure.value))

    def _step_exposure(self, direction: str) -> None:
        """Request an exposure a third of a stop higher ("Brighter") or lower."""
        now = self._operator.snapshot().rig.exposure_ms
        if now is not None:
            self._entered = 0.0
            self._operator.set_exposure(
                now * _THIRD_OF_A_STOP if direction == "Brighter" else now / _THIRD_OF_A_STOP
            )

    def _set_light(self) -> None:
        """Request the chosen light; where it is refused, show the current one again."""
        if not self._operator.set_light(LIGHTS[self._light.value]):
            now = self._operator.snapshot().rig.light
            change(
                self._light, value=next(label for label, light in LIGHTS.items() if light == now)
            )
