"""The check of the rig: its results, their remedies, and the settings that it recommends."""

import viser

from slviewer.gui.help_links import help_link
from slviewer.gui.inputs import SessionValue, change
from slviewer.gui.panel import PanelContext
from slviewer.gui.widgets import Html, Text, Tone, coloured, paragraph, to_html
from slviewer.pipeline.check_results import CheckVerdict, Preflight
from slviewer.wizard.snapshot import Snapshot

_TONES: dict[CheckVerdict, Tone] = {
    "good": "good",
    "warning": "warning",
    "bad": "error",
    "unknown": "dim",
}
_MARKS: dict[CheckVerdict, str] = {"good": "✓", "warning": "!", "bad": "✕", "unknown": "?"}


class RigCheck:
    """Inputs of the step Rig for its check."""

    def __init__(self, context: PanelContext) -> None:
        self._context = context
        self._drawn: Preflight | None = None
        gui, operator = context.gui, context.operator
        self._check = context.button(
            "Check rig", operator.check_rig, viser.Icon.STETHOSCOPE, None, hint="Takes about 10 s"
        )
        self._results = Text(gui)
        self._recommended = context.button(
            "Set exposure", self._set_exposure, viser.Icon.SUN, visible=False
        )
        self._linear = gui.add_checkbox(
            "Linear light",
            False,
            hint="Corrects the grey levels by the table of the check",
            visible=False,
        )
        self._linear_value = SessionValue(self._linear)
        self._linear.on_update(
            context.callback(lambda: operator.set_linear_light(self._linear.value), by_user=True)
        )

    def draw(self, snapshot: Snapshot) -> None:
        """Show the result of the last check."""
        session, result, rig = snapshot.session, snapshot.preflight, snapshot.rig
        # a recording cannot be checked
        change(self._check, disabled=not rig.is_idle or rig.is_recorded)
        change(
            self._linear,
            visible=bool((result and result.levels) or (session and session.is_linear)),
        )
        self._linear_value.update(bool(session and session.is_linear))
        better = result.exposure_ms if result else None
        if better is not None:
            change(self._recommended, label=f"Set exposure {better:.3g} ms")
        differs = better is not None and (
            rig.exposure_ms is None or abs(better / rig.exposure_ms - 1) > 0.02
        )
        change(self._recommended, visible=differs)  # a camera uses the nearest exposure that it has
        if result is not self._drawn:
            self._drawn = result
            self._results.set(checks_table(result) if result else "")

    def _set_exposure(self) -> None:
        """Request the exposure that the check recommends."""
        result = self._context.operator.snapshot().preflight
        if result is not None and result.exposure_ms is not None:
            self._context.operator.set_exposure(result.exposure_ms)


_ROW = (
    "display:flex;gap:0.6em;padding:0.3em 0;border-top:1px solid"
    " var(--mantine-color-default-border)"
)


def checks_table(result: Preflight) -> Html:
    """List each check in its colour, with its remedy."""
    lines = []
    for check in result.checks:
        mark = coloured(_MARKS[check.verdict], _TONES[check.verdict], bold=True)
        remedy = (
            f"<div>{coloured(check.remedy, _TONES[check.verdict])}</div>" if check.remedy else ""
        )
        link = "" if check.verdict == "good" else f" {help_link(f'check-{check.name}')}"
        lines.append(
            f'<div style="{_ROW}"><div style="width:1em;text-align:center">{mark}</div>'
            f'<div style="flex:1"><b>{to_html(check.name)}</b>&ensp;{to_html(check.sentence)}'
            f"{link}{remedy}</div></div>"
        )
    return paragraph(Html("".join(lines)))
