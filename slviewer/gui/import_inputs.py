"""Importing captures that other tools made: from a folder of the computer that runs slviewer, or from a zip."""

from typing import Any, get_args

import viser

from slviewer.gui.inputs import Choice, change
from slviewer.gui.panel import Stage
from slviewer.gui.widgets import Words
from slviewer.session.capture import Role
from slviewer.session.importers.images import DEFAULT_CHANNEL, Channel
from slviewer.session.importers.layouts import LAYOUTS
from slviewer.session.importers.slstudio import Codec
from slviewer.wizard.snapshot import Snapshot

_DETECT = "detect"
_TELL = "by their number"
_WORDS: dict[Role, str] = {
    "calibration": "Photographs of the board that another program took become target poses",
    "scan": "Photographs of an object that another program took become scans",
}


class ImportInputs:
    """A folder of a panel: where the captures are, how they are laid out, and what becomes of them."""

    def __init__(self, stage: Stage, role: Role) -> None:
        gui, safely = stage.gui, stage.safely
        self._stage, self._role = stage, role
        with gui.add_folder("Import captures", expand_by_default=False):
            Words(gui).say(f"{_WORDS[role]}: one folder for each, with its images.", "dim")
            self._layout = Choice(gui, "Layout", "How the files are named; detect goes by the names, or by a TOML")
            self._layout.offer([(_DETECT, _DETECT), *((name, name) for name in LAYOUTS)])
            self._holds = Words(gui)
            self._projector = gui.add_text("Projector", "", hint="Columns x rows, such as 1280x800")
            self._size_hint = Words(gui)
            self._channel = gui.add_dropdown(
                "Channel", get_args(Channel), initial_value=DEFAULT_CHANNEL, hint="Of colour images"
            )
            self._codec = gui.add_dropdown("Codec", (_TELL, *get_args(Codec)), visible=False, hint="SLStudio's")
            self._prefix = gui.add_text("Prefix", "", hint="Before the names, as part gives part_pose_01")
            self._folder = gui.add_text("Image folder", "", hint="On the computer that runs slviewer")
            self._import = gui.add_button("Import folder", icon=viser.Icon.FOLDER_SYMLINK)
            self._import.on_click(safely(self._import_folder))
            self._upload = gui.add_upload_button("Upload a zip", icon=viser.Icon.UPLOAD, color="gray", mime_type=".zip")
            self._upload.on_upload(safely(self._import_zip))
        self._layout.on_change(safely(self._describe))
        self._describe()

    def draw(self, snapshot: Snapshot) -> None:
        """Offer the import while a session is open and nothing else is computed for the operator."""
        ready = snapshot.session is not None and (snapshot.job is None or snapshot.job.background)
        change(self._import, disabled=not ready)
        change(self._upload, disabled=not ready)

    def _describe(self) -> None:
        """What the chosen layout looks like, and which inputs it needs."""
        name = self._layout.value
        layout = LAYOUTS.get(name)
        self._holds.say(f"It holds {layout.holds}." if layout else "", "dim")
        change(self._codec, visible=name == "slstudio")
        size = layout.projector if layout else None
        if size is not None:
            empty = f"{size[0]}x{size[1]}, as this layout has it"
        elif name == "frames":
            empty = "as the TOML states it"
        else:
            empty = "as the layout or the session states it" if layout is None else "as in the session"
        self._size_hint.say(f"Empty: {empty}.", "dim")

    def _options(self) -> dict[str, Any]:
        chosen: dict[str, Any] = {"layout": self._layout.value or _DETECT, "role": self._role}
        for name, handle in (("projector", self._projector), ("prefix", self._prefix)):
            if handle.value.strip():
                chosen[name] = handle.value.strip()
        if self._channel.value != DEFAULT_CHANNEL:
            chosen["channel"] = self._channel.value
        if chosen["layout"] == "slstudio" and self._codec.value != _TELL:
            chosen["codec"] = self._codec.value
        return chosen

    def _import_folder(self) -> None:
        self._stage.operator.import_folder(self._folder.value, **self._options())

    def _import_zip(self) -> None:
        file = self._upload.value
        self._stage.operator.import_zip(file.name, file.content, **self._options())
