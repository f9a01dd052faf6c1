"""Undo and redo, with the name of what they change, and the list of all keys behind "?"."""

import viser

from slviewer.gui.panel import ControlGroup, PanelContext
from slviewer.gui.widgets import table
from slviewer.wizard.snapshot import Snapshot

_VIEW = {
    "1 to 6": "Look from the front, back, left, right, top, bottom",
    "F": "Show all that is in the view",
    "O": "Orthographic view, on or off",
    "Ctrl+K": "Search all commands",
    "Left drag": "Turn the view, or draw the shape that is to be selected",
    "Left drag of a mark": "In Measure, move the point over the surface",
    "Shift, left drag": "Take points away from the selection",
    "Ctrl, left drag": "Turn the view while shapes are drawn",
    "Right drag, wheel": "Move the view, zoom",
}


class UndoControls(ControlGroup):
    """The buttons and keys of `Operator.undo` and `redo`, and the list of keys."""

    def __init__(self, context: PanelContext) -> None:
        super().__init__(context)
        operator, ctrl = self._operator, "cmd/ctrl"
        self._undo = self.button("Undo", operator.undo, "arrow-back-up")
        self._redo = self.button("Redo", operator.redo, "arrow-forward-up")
        self._undo_key = self.command("Undo", operator.undo, "Z", ctrl)
        self._redo_keys = [
            self.command("Redo", operator.redo, "Y", ctrl),
            self.command("Redo", operator.redo, "Z", "cmd/ctrl+shift"),
        ]
        # "?" is written with Shift
        keys = self.command("Keys and mouse", lambda: None, "?", "shift")
        keys.on_trigger(lambda event: self.context.run(lambda: self._show_keys(event.client)))

    def update(self, snapshot: Snapshot) -> None:
        """Name what can be undone and redone."""
        undo, redo = snapshot.next_undo, snapshot.next_redo
        self._undo.label = self._undo_key.label = f"Undo: {undo}" if undo else "Undo"
        self._redo.label = f"Redo: {redo}" if redo else "Redo"
        self._undo.visible, self._redo.visible = bool(undo), bool(redo)
        self._undo_key.disabled = not undo
        for key in self._redo_keys:
            key.label, key.disabled = self._redo.label, not redo

    def _show_keys(self, client: viser.ClientHandle | None) -> None:
        """Show the keys that do something now, and what the mouse does, in one browser."""
        if client is None:
            return
        keys: dict[str, list[str]] = {}
        for each in self.context.commands:
            if not each.disabled:
                keys.setdefault(each.label, []).append(format_key(str(each.hotkey), each.modifier))
        rows = [(" or ".join(dict.fromkeys(names)), label) for label, names in keys.items()]
        with client.gui.add_modal("Keys and mouse") as dialog:
            client.gui.add_html(str(table(("Key", ""), [*rows, *_VIEW.items()], ("left", "left"))))
            client.gui.add_button("Close", color="gray", hint="Closes this dialog").on_click(
                lambda _: dialog.close()
            )


def format_key(key: str, modifier: str | None) -> str:
    """Return how a key is written: Ctrl+Z."""
    if key == "?":
        return key
    words = {"cmd/ctrl": "Ctrl", "shift": "Shift", "alt": "Alt"}
    parts = [words[each] for each in modifier.split("+")] if modifier else []
    return "+".join([*parts, key.capitalize()])
