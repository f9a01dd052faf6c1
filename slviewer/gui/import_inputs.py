"""Inputs to import captures of other tools: from a folder of the computer that runs slviewer, or
from a zip."""

from typing import Any, get_args

import viser

from slviewer.gui.inputs import Choice, change
from slviewer.gui.panel import PanelContext
from slviewer.gui.widgets import Text
from slviewer.session.capture import Role
from slviewer.session.importers.images import DEFAULT_CHANNEL, Channel
from slviewer.session.importers.layouts import Codec, layouts
from slviewer.wizard.snapshot import Snapshot

_DETECT = "detect"
_AUTOMATIC = "by number"
_RESULTS: dict[Role, str] = {"calibration": "target poses", "scan": "scans"}


class ImportInputs:
    """Inputs of a panel to import captures: location, layout and role."""

    def __init__(self, context: PanelContext, role: Role) -> None:
        gui, callback = context.gui, context.callback
        self._context, self._role = context, role
        with gui.add_folder("Import captures", expand_by_default=False):
            Text(gui).write(
                f"Imports images of another program as {_RESULTS[role]}, one folder each.", "dim"
            )
            self._layout = Choice(
                gui, "Layout", "How the files are named; detect uses the names, or a TOML"
            )
            self._layout.offer([(_DETECT, _DETECT), *((name, name) for name in layouts())])
            self._description = Text(gui)
            self._projector = gui.add_text(
                "Projector", "", hint="Columns x rows, for example 1280x800"
            )
            self._size_hint = Text(gui)
            self._channel = gui.add_dropdown(
                "Channel", get_args(Channel), initial_value=DEFAULT_CHANNEL, hint="Of colour images"
            )
            self._codec = gui.add_dropdown(
                "Codec", (_AUTOMATIC, *get_args(Codec)), visible=False, hint="Of SLStudio"
            )
            self._prefix = gui.add_text(
                "Prefix", "", hint="Put before the names: part gives part_pose_01"
            )
            self._folder = gui.add_text(
                "Folder path", "", hint="On the computer that runs slviewer"
            )
            self._import = context.button(
                "Import folder", self._import_folder, viser.Icon.FOLDER_SYMLINK, None
            )
            self._upload = gui.add_upload_button(
                "Upload zip", icon=viser.Icon.UPLOAD, color="gray", mime_type=".zip"
            )
            self._upload.on_upload(callback(self._import_zip))
        self._layout.on_change(callback(self._describe))
        self._describe()

    def draw(self, snapshot: Snapshot) -> None:
        """Enable the import while a session is open and no requested job runs."""
        ready = snapshot.session is not None and not snapshot.is_busy
        change(self._import, disabled=not ready)
        change(self._upload, disabled=not ready)

    def _describe(self) -> None:
        """Describe the chosen layout, and show the inputs that it needs."""
        name = self._layout.value
        layout = layouts().get(name)
        self._description.write(f"Contains {layout.holds}." if layout else "", "dim")
        change(self._codec, visible=name == "slstudio")
        size = layout.projector if layout else None
        if size is not None:
            empty = f"of the session, else {size[0]}x{size[1]}"
        elif name == "frames":
            empty = "of the TOML"
        else:
            empty = "of the layout or the session" if layout is None else "of the session"
        self._size_hint.write(f"Default size: {empty}.", "dim")

    def _collect_options(self) -> dict[str, Any]:
        """Return the import options that were entered: layout, role, projector, prefix, channel and
        codec."""
        chosen: dict[str, Any] = {"layout": self._layout.value or _DETECT, "role": self._role}
        for name, handle in (("projector", self._projector), ("prefix", self._prefix)):
            if handle.value.strip():
                chosen[name] = handle.value.strip()
        if self._channel.value != DEFAULT_CHANNEL:
            chosen["channel"] = self._channel.value
        if chosen["layout"] == "slstudio" and self._codec.value != _AUTOMATIC:
            chosen["codec"] = self._codec.value
        return chosen

    def _import_folder(self) -> None:
        """Request the import of the entered folder."""
        self._context.operator.import_folder(self._folder.value, **self._collect_options())

    def _import_zip(self) -> None:
        """Request the import of the uploaded zip."""
        file = self._upload.value
        self._context.operator.import_zip(file.name, file.content, **self._collect_options())
