"""The check of the rig: what it found, what to do about it, and what it offers to set."""

import viser

from slviewer.gui.inputs import Follows, change
from slviewer.gui.panel import Stage
from slviewer.gui.widgets import Html, Tone, Words, block, cell, toned
from slviewer.pipeline.check_results import CheckVerdict, Preflight
from slviewer.wizard.snapshot import Snapshot

_TONES: dict[CheckVerdict, Tone] = {"good": "good", "warning": "warning", "bad": "error", "unknown": "dim"}
_MARKS: dict[CheckVerdict, str] = {"good": "✓", "warning": "!", "bad": "✕", "unknown": "?"}
_EXPOSURES: dict[str, tuple[float, ...]] = {
    "one": (),
    "two: once and 4 times": (1.0, 4.0),
    "three: ¼, once and 4 times": (0.25, 1.0, 4.0),
}


class RigCheck:
    """The part of the step Rig below the picture: the check, and how captures are taken."""

    def __init__(self, stage: Stage) -> None:
        self._stage = stage
        self._drawn: Preflight | None = None
        gui, operator = stage.gui, stage.operator
        self._exposures = gui.add_dropdown(
            "Exposures", tuple(_EXPOSURES), hint="Several, for shiny and dark parts: each pixel keeps the best"
        )
        self._exposures.on_update(stage.safely_with(lambda event: self._expose() if event.client else None))
        self._exposures_follow = Follows(self._exposures)
        self._exposures_say = Words(gui)
        self._check = gui.add_button("Check the rig, about 10 s", icon=viser.Icon.STETHOSCOPE)
        self._check.on_click(stage.safely(operator.check_rig))
        self._found = Words(gui)
        self._better = gui.add_button("Set the exposure", icon=viser.Icon.SUN, color="gray", visible=False)
        self._better.on_click(stage.safely(self._set_exposure))
        self._linear = gui.add_checkbox(
            "Linear light", False, hint="Projects through the table that the check has measured", visible=False
        )
        self._linear_follows = Follows(self._linear)
        self._linear.on_update(
            stage.safely_with(lambda event: operator.linearise(self._linear.value) if event.client else None)
        )

    def draw(self, snapshot: Snapshot) -> None:
        """What was found last."""
        session, found, rig = snapshot.session, snapshot.preflight, snapshot.rig
        recorded = rig.choice is not None and rig.choice.get("driver") == "replay"  # it shows what it was shown
        change(self._check, disabled=rig.state != "open" or rig.capture is not None or recorded)
        exposures = session.exposures_ms if session else ()
        told = next((words for words, times in _EXPOSURES.items() if len(times) == len(exposures)), None)
        if told is not None:
            self._exposures_follow.tell(told)
        each = ", ".join(f"{exposure:g}" for exposure in exposures)
        self._exposures_say.say(f"Each capture is taken at {each} ms." if exposures else "", "dim")
        change(self._exposures, visible=rig.exposure_ms is not None, disabled=rig.state != "open")
        change(self._linear, visible=bool((found and found.levels) or (session and session.linear)))
        self._linear_follows.tell(bool(session and session.linear))
        better = found.exposure_ms if found else None
        if better is not None:
            change(self._better, label=f"Set the exposure to {better:.3g} ms")
        unlike = better is not None and (rig.exposure_ms is None or abs(better / rig.exposure_ms - 1) > 0.02)
        change(self._better, visible=unlike)  # a camera takes the nearest that it has
        if found is not self._drawn:
            self._drawn = found
            self._found.set(checks_table(found) if found else "")

    def _expose(self) -> None:
        now = self._stage.operator.snapshot().rig.exposure_ms
        if now is not None:
            self._stage.operator.set_exposures([now * times for times in _EXPOSURES[self._exposures.value]])

    def _set_exposure(self) -> None:
        found = self._stage.operator.snapshot().preflight
        if found is not None and found.exposure_ms is not None:
            self._stage.operator.set_exposure(found.exposure_ms)


_ROW = "display:flex;gap:0.6em;padding:0.3em 0;border-top:1px solid var(--mantine-color-default-border)"


def checks_table(found: Preflight) -> Html:
    """Each check in its colour, with what to do about it."""
    lines = []
    for check in found.checks:
        mark = toned(_MARKS[check.verdict], _TONES[check.verdict], bold=True)
        remedy = f"<div>{toned(check.remedy, _TONES[check.verdict])}</div>" if check.remedy else ""
        lines.append(
            f'<div style="{_ROW}">'
            f'<div style="width:1em;text-align:center">{mark}</div><div style="flex:1"><b>{cell(check.name)}</b>&ensp;'
            f"{cell(check.sentence)}{remedy}</div></div>"
        )
    return block(Html("".join(lines)))
