"""Step 1: choose the rig, check its image, and set exposure and light."""

import time
from typing import Any

from slviewer.gui.capture_inputs import ExposureInputs
from slviewer.gui.panel import NO_SESSION, PanelPart, Setting, StepPanel
from slviewer.gui.preview import LiveImage, histogram_chart
from slviewer.gui.rig_choice import RigChoice
from slviewer.gui.widgets import Html, Text, Tone, coloured, help_link, paragraph, to_html
from slviewer.pipeline.check_results import CheckVerdict, Preflight
from slviewer.wizard.snapshot import PreviewView, RigView, Snapshot

LIGHTS = {"White": "white", "Grey": "grey", "Dark": "dark", "Fringes": "pattern"}
_NAMES = {light: name for name, light in LIGHTS.items()}
_THIRD_OF_A_STOP = 2 ** (1 / 3)
# an exposure that is being dragged is not set back to what the camera reported a moment ago
_SETTLES_S = 1.5
_MARKS: dict[CheckVerdict, tuple[str, Tone]] = {
    "good": ("✓", "good"),
    "warning": ("!", "warning"),
    "bad": ("✕", "error"),
    "unknown": ("?", "dim"),
}
_ROW = (
    "display:flex;gap:0.6em;padding:0.3em 0;border-top:1px solid"
    " var(--mantine-color-default-border)"
)


class RigPanel(StepPanel):
    """Panel of the step Rig."""

    key = "rig"
    _entered = 0.0

    def build(self) -> None:
        """Create the inputs of devices, exposure, light and check."""
        gui, context = self._gui, self._context
        RigChoice(self)
        self._picture = LiveImage(gui, "Live image")
        self._histogram = Text(gui)
        self._exposure: Any = gui.add_slider("Exposure, ms", 0.01, 4.0, 0.01, 1.0)
        context.on_change(self._set_exposure, self._exposure, by_user=True)
        step = gui.add_button_group("Brightness", ("Darker", "Brighter"))
        step.on_click(context.callback(lambda: self._step_exposure(step.value)))
        light = gui.add_dropdown("Projector", tuple(LIGHTS), hint="Shown between captures")
        self._light = Setting(context, light, self._set_light)
        ExposureInputs(self)
        RigCheck(self)

    def draw(self, snapshot: Snapshot) -> None:
        """Show the rig of a snapshot."""
        rig = snapshot.rig
        self._draw_exposure(rig)
        self._exposure.disabled = self._light.handle.disabled = rig.state != "open"
        if rig.light in _NAMES:
            self._light.update(_NAMES[rig.light])
        if rig.state != "open":
            self._picture.hide()
            self._histogram.set("")

    def _draw_exposure(self, rig: RigView) -> None:
        """Set the slider to the rig's exposure, unless it was moved a moment ago."""
        if rig.exposure_ms is not None and time.monotonic() - self._entered > _SETTLES_S:
            while rig.exposure_ms > self._exposure.max:
                self._exposure.max *= 4
            if abs(self._exposure.value - rig.exposure_ms) > 0.005:
                self._exposure.value = round(rig.exposure_ms, 2)

    def draw_preview(self, preview: PreviewView) -> None:
        """Show the live image and its histogram."""
        self._draw_exposure(self._operator.snapshot().rig)
        self._picture.draw(preview)
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

    def _set_light(self, name: str) -> None:
        """Request the chosen light; where it is refused, show the current one again."""
        if not self._operator.set_light(LIGHTS[name]):
            self._light.handle.value = _NAMES[self._operator.snapshot().rig.light]


class RigCheck(PanelPart):
    """The check of the rig: its results, their remedies, and the settings that it recommends."""

    def build(self) -> None:
        """Create the inputs and the list of results."""
        gui, context, operator = self._gui, self._context, self._operator
        self._check = context.button(
            "Check rig", operator.check_rig, "stethoscope", None, hint="Takes about 10 s"
        )
        self._results = Text(gui)
        self._recommended = context.button("Set exposure", self._set_exposure, "sun")
        linear = gui.add_checkbox(
            "Linear light", False, hint="Corrects the grey levels by the table of the check"
        )
        self._linear = Setting(context, linear, operator.set_linear_light)

    def draw(self, snapshot: Snapshot) -> None:
        """Show the result of the last check."""
        result, rig = snapshot.preflight, snapshot.rig
        is_linear = (snapshot.session or NO_SESSION).is_linear
        # a recording cannot be checked
        self._check.disabled = not rig.is_idle or rig.is_recorded
        self._linear.handle.visible = bool(result and result.levels) or is_linear
        self._linear.update(is_linear)
        better = result.exposure_ms if result else None
        self._recommended.visible = better is not None and (
            # a camera uses the nearest exposure that it has
            rig.exposure_ms is None or abs(better / rig.exposure_ms - 1) > 0.02
        )
        if better is not None:
            self._recommended.label = f"Set exposure {better:.3g} ms"
        self._results.set(checks_table(result) if result else "")

    def _set_exposure(self) -> None:
        """Request the exposure that the check recommends."""
        result = self._operator.snapshot().preflight
        if result is not None and result.exposure_ms is not None:
            self._operator.set_exposure(result.exposure_ms)


def checks_table(result: Preflight) -> Html:
    """List each check in its colour, with its remedy."""
    lines = []
    for check in result.checks:
        sign, tone = _MARKS[check.verdict]
        mark = coloured(sign, tone, bold=True)
        remedy = f"<div>{coloured(check.remedy, tone)}</div>" if check.remedy else ""
        link = "" if check.verdict == "good" else f" {help_link(f'check-{check.name}')}"
        lines.append(
            f'<div style="{_ROW}"><div style="width:1em;text-align:center">{mark}</div>'
            f'<div style="flex:1"><b>{to_html(check.name)}</b>&ensp;{to_html(check.sentence)}'
            f"{link}{remedy}</div></div>"
        )
    return paragraph(Html("".join(lines)))
