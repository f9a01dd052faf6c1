"""What is in the 3D view, each object with an eye to show or hide it, and the size of points."""

from functools import partial
from typing import Any

import viser

from slviewer.gui.panel import ControlGroup, PanelContext
from slviewer.gui.scene import SceneLayer
from slviewer.gui.widgets import Text

_EYES = {True: viser.Icon.EYE, False: viser.Icon.EYE_OFF}


class ViewTree(ControlGroup):
    """Inputs of the 3D view, for all browsers; the list follows the scene."""

    def __init__(self, context: PanelContext) -> None:
        super().__init__(context)
        gui = self._gui
        self._size: Any = gui.add_slider(
            "Point size", 0.25, 4.0, 0.25, 1.0, hint="Of all clouds, relative to their spacing"
        )
        self.react(self._size.on_update, lambda: context.scene.scale_points(self._size.value))
        self._eyes: dict[tuple[str, str], viser.GuiButtonHandle] = {}
        self._is_requested = False
        self._hint = Text(gui)
        self._hint.write("Press an object to hide it, or to show it again.", "dim")
        self._folder = gui.add_folder("In the view")
        context.scene.on_change = self._request

    def draw(self) -> None:
        """List the objects of the layers that are shown."""
        self._is_requested = False
        listed: dict[tuple[str, str], tuple[SceneLayer, str, bool]] = {
            (layer.name, name): (layer, *about)
            for layer in self._scene.layers
            for name, about in layer.list_objects().items()
        }
        for key in self._eyes.keys() - listed.keys():
            self._eyes.pop(key).remove()
        for key, (layer, title, visible) in listed.items():
            if key not in self._eyes:
                with self._folder:
                    self._eyes[key] = self.button(
                        title,
                        partial(layer.toggle, key[1]),
                        "eye",
                        hint="Shows or hides it in the view",
                    )
            eye = self._eyes[key]
            if (eye.label, eye.icon) != (title, _EYES[visible]):  # each would be sent
                eye.label, eye.icon = title, _EYES[visible]

    def _request(self) -> None:
        """Draw once more, after what is drawn now."""
        if not self._is_requested:
            self._is_requested = True
            self.context.submit(self.draw)
