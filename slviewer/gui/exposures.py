"""The exposures of captures: chosen by the operator, or suggested from what the camera sees."""

import numpy as np
import viser

from slviewer.gui.inputs import SessionValue, change
from slviewer.gui.panel import PanelContext
from slviewer.gui.widgets import Html, Picture, Text, coloured, paragraph
from slviewer.pipeline.suggest_exposure import BUDGET_S, STATES, ExposureSuggestion
from slviewer.wizard.snapshot import ExposureChange, Snapshot

_MULTIPLES: dict[str, tuple[float, ...]] = {
    "1": (),
    "2: 1×, 4×": (1.0, 4.0),
    "3: ¼×, 1×, 4×": (0.25, 1.0, 4.0),
}
_SUGGESTED = "as suggested"
_SATURATED, _DARK = (230, 40, 40), (40, 110, 230)
_UNLIT = 0.35  # of its brightness
_GAP_PX = 4


class ExposureInputs:
    """Inputs for the exposures of each capture, in the steps Rig and Scan."""

    def __init__(self, context: PanelContext, *, for_scan: bool = False) -> None:
        self._context, self._for_scan = context, for_scan
        self._drawn: ExposureChange | None = None
        gui = context.gui
        self._budget = gui.add_number(
            "Time limit, s",
            BUDGET_S,
            min=0.5,
            max=600.0,
            step=0.5,
            visible=not for_scan,
            hint="Of one capture",
        )
        self._suggest = context.button(
            "Suggest exposure",
            self._request,
            viser.Icon.SUN,
            hint="Tries exposures for some seconds, and sets the best",
        )
        self._undo = context.button(
            "Undo exposure", context.operator.undo_exposure, viser.Icon.ARROW_BACK_UP, visible=False
        )
        self._picture = Picture(gui, "Measured before and now")
        if for_scan:
            return
        self._several = gui.add_dropdown(
            "Exposures",
            (*_MULTIPLES, _SUGGESTED),
            hint="Several for shiny and dark parts: each pixel uses the best",
        )
        self._several.on_update(context.callback(self._set_several, by_user=True))
        self._several_value = SessionValue(self._several)
        self._note = Text(gui)

    def draw(self, snapshot: Snapshot) -> None:
        """Show the exposures of the session, and what the last suggestion measures."""
        session, rig = snapshot.session, snapshot.rig
        idle = rig.is_idle and session is not None
        shown = rig.exposure_ms is not None and not rig.is_recorded
        change(self._suggest, visible=shown, disabled=not idle)
        latest = snapshot.exposure_change
        change(self._undo, visible=shown and latest is not None, disabled=not idle)
        if latest is not self._drawn:
            self._drawn = latest
            if latest is None:
                self._picture.hide()
            else:
                self._picture.set(
                    draw_suggestion(latest.suggestion), suggestion_html(latest.suggestion)
                )
        if self._for_scan:
            return
        change(self._budget, visible=shown)
        exposures = session.exposures_ms if session else ()
        self._several_value.update(name_exposures(exposures, rig.exposure_ms))
        each = ", ".join(f"{exposure:g}" for exposure in exposures)
        self._note.write(f"Exposures of each capture: {each} ms." if exposures else "", "dim")
        change(self._several, visible=shown, disabled=rig.state != "open")

    def _request(self) -> None:
        """Request a suggestion within the time that is allowed."""
        if self._for_scan:
            self._context.operator.suggest_exposure(for_scan=True)
        else:
            self._context.operator.suggest_exposure(budget_s=float(self._budget.value))

    def _set_several(self) -> None:
        """Request the chosen multiples of the current exposure, or a suggestion."""
        now = self._context.operator.snapshot().rig.exposure_ms
        if self._several.value == _SUGGESTED:
            self._request()
        elif now is not None:
            self._context.operator.set_exposures(
                [now * times for times in _MULTIPLES[self._several.value]]
            )


def draw_suggestion(suggestion: ExposureSuggestion) -> np.ndarray:
    """The scene before and now, side by side (h, 2 w, 3) uint8: saturated pixels red, too dark ones
    blue, and those that the projector does not light dim."""
    before, now = (
        _paint(suggestion.image, state) for state in (suggestion.state_before, suggestion.state)
    )
    gap = np.full((len(now), _GAP_PX, 3), 255, np.uint8)
    return np.concatenate([before, gap, now], axis=1)


def suggestion_html(suggestion: ExposureSuggestion) -> Html:
    """State what is measured before and now, and what the colours mean."""
    marks = (
        f"{coloured('■ saturated', 'error')}&ensp;<span style='color:rgb{_DARK}'>■ too dark</span>"
    )
    return paragraph(
        Html(
            '<div style="display:flex;justify-content:space-between">'
            f"<span>{100 * suggestion.share_before:.1f} % measured</span>"
            f"<b>{100 * suggestion.share:.1f} % measured</b></div><div>{marks}&ensp;"
            f"{coloured(f'{suggestion.capture_s:.1f} s a capture', 'dim')}</div>"
        )
    )


def _paint(image: np.ndarray, state: np.ndarray) -> np.ndarray:
    """Colour an image (h, w) by the states of its pixels."""
    picture = np.repeat(image[..., None], 3, axis=2)
    picture[state == STATES.index("saturated")] = _SATURATED
    picture[state == STATES.index("dark")] = _DARK
    unlit = state == STATES.index("unlit")
    picture[unlit] = (_UNLIT * picture[unlit]).astype(np.uint8)
    return picture


def name_exposures(exposures_ms: tuple[float, ...], exposure_ms: float | None) -> str:
    """The label of exposures as multiples of the camera's, else that of suggested ones."""
    for label, multiples in _MULTIPLES.items():
        wanted = [times * (exposure_ms or 0.0) for times in multiples]
        if len(wanted) == len(exposures_ms) and np.allclose(wanted, exposures_ms, rtol=0.05):
            return label
    return _SUGGESTED
