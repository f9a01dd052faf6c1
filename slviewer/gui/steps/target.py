"""Step 2: choose the board, print it, and check that it is detected."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from slviewer.errors import InputError
from slviewer.gui.panel import StepPanel
from slviewer.gui.widgets import Html, LiveImage, Text, alert, coloured, link, paragraph, to_html
from slviewer.pipeline.detect import recognise_target
from slviewer.pipeline.printouts import target as write_target
from slviewer.target.board import (
    DICTIONARIES,
    EXAMPLES,
    LEGACY,
    Board,
    board_examples,
    plugin_boards,
)
from slviewer.target.detect import RecognisedBoard
from slviewer.wizard.snapshot import PreviewView

KINDS = {
    "Circle grid": "circles",
    "Asymmetric circle grid": "acircles",
    "Chessboard": "chessboard",
    "ChArUco": "charuco",
    "ChArUco before OpenCV 4.6": LEGACY,
}
_EXPLANATIONS = {
    "circles": "Circles per row and column; pitch: distance of their centres",
    "acircles": "Circles per row, number of rows; pitch: half the distance of neighbours in a row",
    "chessboard": "Inner corners per row and column; pitch: side of a square",
    "charuco": "Squares per row and column; pitch: side of a square",
}


class TargetPanel(StepPanel):
    """Panel of the step Target."""

    key = "target"
    _target = ""
    _board: Board | None = None
    _folder: Path | None = None
    _requests = 0
    _examined: tuple[Path, int, int] | None = None

    def build(self) -> None:
        """Create the fields of the board, and the live image."""
        gui, board = self._gui, Board.parse(EXAMPLES["circles"])
        kinds = KINDS | {added.what: name for name, added in plugin_boards().items()}
        self._picture = LiveImage(gui)
        self._note = Text(gui)
        self._kind = self.choice("Board", options=kinds, do=self._fill_example)
        self._columns = self.number("Columns", board.columns, 2, 200, 1)
        self._rows = self.number("Rows", board.rows, 3, 200, 1)
        self._pitch = self.number("Pitch, mm", float(board.pitch_mm), 0.1, 1000.0, 0.01)
        differs = "Along the columns, where the print differs there; 0: the same"
        self._pitch_y = self.number("Pitch y, mm", 0.0, 0.0, 1000.0, 0.01, differs)
        self._marker = self.number("Marker, mm", 1.0, 0.1, 1000.0, 0.01)
        self._dictionary = self.dropdown("Dictionary", tuple(DICTIONARIES))
        self._first_id = self.number("First id", 0, 0, 2400, 1)
        self._use = self.button(
            "Use this board",
            lambda: self._operator.choose_target(str(self._parse_entered())),
            "check",
            None,
        )
        self._recognise = self.button(
            "Recognise board", lambda: self._request_recognition(True), "scan",
            hint="Examines the pictures of the target poses; the pitch is yours to enter",
        )  # fmt: skip
        self._recognised = Text(gui)
        self.button("Create PDF", self._write_sheet, "printer", hint="To print the board to scale")
        self._sheet = Text(gui)

    def draw(self) -> None:
        """Show the session's board, describe the entered one, and whether it is the session's."""
        session = self.session
        self._picture.is_large = self.is_ready
        if session.folder != self._folder:
            self._folder = session.folder
            self._sheet.set("")
        if session.target != self._target:
            self._target = session.target
            self._board = Board.parse(self._target) if self._target else None
            if self._board:
                self._fill_fields(self._board)
        self._recognise.visible = bool(session.poses)
        if not session.poses:
            self._recognised.set("")
        elif not session.target and not self.snapshot.is_busy:
            self._request_recognition(False)
        for field in (self._marker, self._dictionary, self._first_id):
            field.visible = "charuco" in self._kind.value
        try:
            board = self._parse_entered()
        except InputError as error:
            self._note.set(alert(str(error), "error"))
            return
        width, height = np.ptp(board.outline(), axis=0)[:2]
        counts = board.plugin_type.counts if board.plugin_type else _EXPLANATIONS[board.kind]
        explanation = coloured(f"{counts}. Size: {width:.0f} × {height:.0f} mm", "dim")
        in_use = str(board) == self._target
        self._use.disabled = in_use
        state = coloured(
            f"● In use: {board}" if in_use else f"Not in use: {board}",
            "good" if in_use else "warning",
            bold=in_use,
        )
        self._note.set(paragraph(Html(f"{explanation}<br>{state}")))

    def _request_recognition(self, again: bool) -> None:
        """Request that the board in the poses be recognised, once for each number of them unless
        ``again``."""
        self._requests += again
        key = (self.session.folder, len(self.session.poses), self._requests)
        store = self.context.session
        if key != self._examined:
            self._examined = key
            self._recognised.write("Examining the pictures of the poses for the board.", "dim")
        self.painter.request(self._show_recognised, key, lambda: recognise_target(store))

    def _show_recognised(self, found: RecognisedBoard | None) -> None:
        """Fill in the recognised board, with the pitch that was entered."""
        if found is None:
            text = "No board was recognised in the poses: enter kind, columns and rows."
            self._recognised.write(text, "warning")
            return
        board, pitch = found.board, self._pitch.value
        self._fill_fields(replace(board, pitch_mm=pitch, pitch_y_mm=pitch))
        self._recognised.write(
            f"{found.text()}. No picture shows its pitch: measure and enter it, then use the"
            " board.",
            "info",
        )
        self.redraw()

    def draw_preview(self, preview: PreviewView) -> None:
        """Show the live image with the detected board."""
        self._picture.draw_board(preview, self._board, is_wanted=not self.session.good_poses)

    def _parse_entered(self) -> Board:
        """Return the board that the fields describe. Raises InputError for an invalid one."""
        kind, along_y = self._kind.value, self._pitch_y.value
        notation = (
            f"{kind}:{int(self._columns.value)}x{int(self._rows.value)}:{self._pitch.value:g}"
        )
        notation += f"x{along_y:g}" if along_y else ""
        if "charuco" in kind:
            notation += f":{self._marker.value:g}:{self._dictionary.value}"
            notation += f":{int(self._first_id.value)}"
        return Board.parse(notation)

    def _fill_fields(self, board: Board) -> None:
        """Fill the fields from a board."""
        self._kind.choose(LEGACY if board.legacy else board.kind)
        self._columns.value, self._rows.value = board.columns, board.rows
        self._pitch.value = float(board.pitch_mm)
        self._pitch_y.value = 0.0 if board.pitch_y_mm == board.pitch_mm else board.pitch_y_mm
        if board.kind == "charuco":
            self._marker.value, self._dictionary.value = board.marker_mm, board.dictionary
            self._first_id.value = board.first_id

    def _fill_example(self) -> None:
        """Fill the fields with an example of the chosen kind of board."""
        self._fill_fields(Board.parse(board_examples()[self._kind.value]))

    def _write_sheet(self) -> None:
        """Write a PDF of the entered board into the exports, and link it."""
        board = self._parse_entered()
        path = self.context.session.exports / f"{str(board).replace(':', '_')}.pdf"
        write_target(str(board), path)
        note = to_html("Print at 100 %, glue it to a flat plate, and measure the scale bar.")
        button = link(self.context.offer_download(path), f"Download {path.name}")
        self._sheet.set(paragraph(Html(f"{button}<div style='margin-top:0.4em'>{note}</div>")))
