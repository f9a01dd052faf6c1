"""The start page: a new session, the recent ones, and one from any folder."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from slviewer.errors import InputError
from slviewer.gui.panel import PanelContext, PanelPart, StepPanel
from slviewer.gui.widgets import (
    STEPS_PAGE,
    Html,
    Text,
    Tone,
    coloured,
    help_link,
    paragraph,
    thumbnail,
    to_html,
)
from slviewer.session.importers.clouds import FORMATS
from slviewer.session.importers.images import IMAGE_SUFFIXES
from slviewer.session.names import folder_name
from slviewer.session.recent import MOST_RECENT, new_session_folder, sessions_folder
from slviewer.wizard.operator import CALIBRATIONS
from slviewer.wizard.session_reader import SessionOverview, read_overview

START = "start"
IMPORTED = ",".join((".zip", *FORMATS, *CALIBRATIONS, *sorted(IMAGE_SUFFIXES)))
"""Files that are imported; the page hands its first input for these what is dropped on it, and
makes a zip of images, of several files and of a folder."""
A_FOLDER = IMPORTED + ",folder"
"""Of an input whose dialog takes a folder, by `page_script.js`."""
_PICTURE_PX = 96
_VERDICTS: dict[str, tuple[str, Tone]] = {
    "good": ("Calibration good", "good"),
    "doubtful": ("Calibration doubtful", "warning"),
    "rejected": ("Calibration rejected", "error"),
}


class RecentSession(PanelPart):
    """One of the recent sessions, with what can be done with it; hidden without one."""

    _folder: Path | None = None

    def __init__(self, panel: "StartPanel") -> None:
        self._start = panel
        super().__init__(panel)

    def build(self) -> None:
        """Create picture, text and buttons."""
        self._about = Text(self._gui)
        start = self._start
        self._actions = {
            "Open": start.open_session,
            "Duplicate": start.duplicate,
            "Delete": start.delete,
        }
        self._buttons = self.button_group(" ", tuple(self._actions), self._request)
        self._buttons.visible = False

    def offer(self, overview: SessionOverview | None) -> None:
        """Show a session; None: hide it all."""
        self._folder = overview.folder if overview else None
        self._about.set(overview_html(overview) if overview else "")
        self._buttons.visible = overview is not None

    def _request(self, action: str) -> None:
        """Request the action of a button."""
        if self._folder:
            self._actions[action](self._folder)


class StartPanel(StepPanel):
    """The panel of the start page. `opened` is called when a session was opened."""

    key = START
    _changes = 0

    def __init__(self, context: PanelContext, opened: Callable[[], None]) -> None:
        self._opened = opened
        super().__init__(context)

    def build(self) -> None:
        """Create the inputs of a new session, the recent ones, and the folder of another one."""
        gui = self._gui
        link = help_link("sessions", STEPS_PAGE, "float:right;font-size:0.875rem")
        heading = f'<div style="font-size:1.25rem;font-weight:600">Sessions{link}</div>'
        Text(gui).set(paragraph(Html(heading)))
        self._fault = Text(gui)
        self._name: Any = gui.add_text("Name", "", hint=f"Of a new folder in {sessions_folder()}")
        self.button("New session", self._make_new, "plus", None)
        for label, kinds in (("From files", IMPORTED), ("From a folder", A_FOLDER)):
            self.upload_button(label, self._make_from_files, kinds)
        with gui.add_folder("Recent sessions") as self._recent_folder:
            Text(gui).write("Duplicate: a new session with the same calibration.", "dim")
            self._rows = [RecentSession(self) for _ in range(MOST_RECENT)]
            self._restore = self.button("Restore", self.context.recent.restore, "arrow-back-up")
        with gui.add_folder("Another folder", expand_by_default=False):
            folder = gui.add_text("Folder", "", hint="Of a session; created if it does not exist")
            self.button(
                "Open session", lambda: self.open_session(folder.value.strip()), "folder-open"
            )

    def draw(self) -> None:
        """Show the recent sessions, read anew after each change."""
        recent = self.context.recent
        folders, deleted = recent.read()
        self._fault.write(recent.fault, "warning")
        self._restore.visible = deleted is not None
        self._restore.label = f"Restore {deleted.name}" if deleted else "Restore"
        self._recent_folder.visible = bool(folders or deleted)
        self.painter.request(
            self._show_overviews,
            (self._changes, tuple(folders)),
            lambda: [read_overview(folder) for folder in folders],
        )

    def show(self, visible: bool) -> None:
        """Show or hide the page, with the name of a new session."""
        super().show(visible)
        if visible:
            self._changes += 1
            self._name.value = new_session_folder().name

    def _show_overviews(self, overviews: list[SessionOverview]) -> None:
        """Show the recent sessions."""
        for i, row in enumerate(self._rows):
            row.offer(overviews[i] if i < len(overviews) else None)

    # requests

    def open_session(self, folder: Path | str) -> None:
        """Request a session, and leave the page where it is opened."""
        if not str(folder).strip():
            raise InputError("no folder is named", "enter that of a session")
        if self._operator.open_session(folder):
            self._opened()

    def duplicate(self, folder: Path) -> None:
        """Request a new session with the calibration of another one."""
        if self._operator.duplicate_calibration(folder):
            self._opened()

    def delete(self, folder: Path) -> None:
        """Move a session to the trash beside it."""
        session = self.snapshot.session
        if session and session.folder == folder:
            raise InputError(f"{folder.name} is open", "open another session, then delete it")
        place = self.context.recent.trash(folder)
        self._operator.notify("info", f"{folder.name} was moved to {place}")

    def _make_new(self) -> bool:
        """Request a new session of the entered name, by default today's; returns whether it is
        open."""
        name = self._name.value.strip()
        folder = sessions_folder() / folder_name(name) if name else new_session_folder()
        is_open = self._operator.open_session(folder, is_new=True)
        if is_open:
            self._opened()
        return is_open

    def _make_from_files(self, name: str, content: bytes) -> None:
        """Request a new session, and the import of a file or a zip of files into it."""
        if self._make_new():
            self._operator.import_file(name, content)


def overview_html(overview: SessionOverview) -> Html:
    """Return picture, name, date, content and verdict of a session."""
    if overview.verdict:
        verdict = coloured(*_VERDICTS[overview.verdict])
    else:
        text = "Calibration imported" if overview.is_calibrated else "Not calibrated"
        verdict = coloured(text, "dim")
    lines = [
        Html(f"<b>{to_html(overview.folder.name)}</b>"),
        coloured(f"{overview.changed:%d %b %Y, %H:%M}", "dim"),
        *((to_html(overview.holds), verdict) if not overview.fault else ()),
        coloured(overview.fault, "error"),
    ]
    text = "".join(f"<div>{line}</div>" for line in lines if line)
    picture = thumbnail(overview.thumbnail, _PICTURE_PX, overview.folder.name)
    tip = to_html(overview.folder)
    return paragraph(
        Html(f'<div title="{tip}" style="display:flex;gap:0.8em">{picture}<div>{text}</div></div>')
    )
