"""A button that brings the last deleted capture back, there while there is one."""

from collections.abc import Sequence

import viser

from slviewer.gui.inputs import change
from slviewer.gui.panel import Stage


class Undelete:
    """Offers the first of the names that it is given."""

    def __init__(self, stage: Stage) -> None:
        self._name = ""
        self._button = stage.gui.add_button("Bring back", icon=viser.Icon.ARROW_BACK_UP, color="orange", visible=False)
        self._button.on_click(stage.safely(lambda: stage.operator.undelete(self._name)))

    def offer(self, deleted: Sequence[str]) -> None:
        """Offer what can be brought back now, the last deleted first."""
        self._name = deleted[0] if deleted else ""
        if self._name:
            change(self._button, label=f"Bring {self._name} back")
        change(self._button, visible=bool(self._name))
