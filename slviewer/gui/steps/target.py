"""Step 2: choose the board, print it, and check that it is detected."""

from pathlib import Path
from typing import Any

from slviewer.errors import InputError
from slviewer.gui.panel import NO_SESSION, StepPanel
from slviewer.gui.preview import LiveImage
from slviewer.gui.widgets import Html, Text, alert, coloured, link, paragraph, to_html
from slviewer.pipeline.printouts import target as write_target
from slviewer.target.board import EXAMPLES, Board, board_examples, plugin_boards
from slviewer.wizard.snapshot import PreviewView, Snapshot

KINDS = {
    "Circle grid": "circles",
    "Asymmetric circle grid": "acircles",
    "Chessboard": "chessboard",
    "ChArUco": "charuco",
}
DICTIONARIES = tuple(
    f"DICT_{bits}X{bits}_{count}" for bits in (4, 5, 6, 7) for count in (50, 100, 250, 1000)
)
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

    def build(self) -> None:
        """Create the fields of the board, and the live image."""
        gui, context = self._gui, self._context
        board = Board.parse(EXAMPLES["circles"])
        self._kinds = KINDS | {added.what: name for name, added in plugin_boards().items()}
        self._kind: Any = gui.add_dropdown("Board", tuple(self._kinds))
        self._columns: Any = gui.add_number("Columns", board.columns, min=2, max=200, step=1)
        self._rows: Any = gui.add_number("Rows", board.rows, min=3, max=200, step=1)
        self._pitch: Any = gui.add_number(
            "Pitch, mm", float(board.pitch_mm), min=0.1, max=1000.0, step=0.01
        )
        self._marker: Any = gui.add_number(
            "Marker, mm", 1.0, min=0.1, max=1000.0, step=0.01, visible=False
        )
        self._dictionary: Any = gui.add_dropdown("Dictionary", DICTIONARIES, visible=False)
        self._note = Text(gui)
        self._use = context.button(
            "Use this board",
            lambda: self._operator.choose_target(str(self._parse_entered())),
            "check",
            None,
        )
        context.button(
            "Create PDF", self._write_sheet, "printer", hint="To print the board to scale"
        )
        self._sheet = Text(gui)
        self._picture = LiveImage(gui, "Live image")
        numbers = self._columns, self._rows, self._pitch, self._marker
        context.on_change(self._describe, *numbers, self._dictionary, by_user=True)
        context.on_change(self._change_kind, self._kind, by_user=True)

    def draw(self, snapshot: Snapshot) -> None:
        """Show the board of a snapshot's session."""
        session = snapshot.session or NO_SESSION
        if session.folder != self._folder:
            self._folder = session.folder
            self._sheet.set("")
        if session.target != self._target:
            self._target = session.target
            self._board = Board.parse(self._target) if self._target else None
            if self._board is not None:
                self._fill_fields(self._board)
        self._describe()

    def draw_preview(self, preview: PreviewView) -> None:
        """Show the live image with the detected board."""
        self._picture.draw_board(preview, self._board)

    def _parse_entered(self) -> Board:
        """Return the board that the fields describe. Raises InputError for an invalid one."""
        kind = self._kinds[self._kind.value]
        notation = (
            f"{kind}:{int(self._columns.value)}x{int(self._rows.value)}:{self._pitch.value:g}"
        )
        markers = f":{self._marker.value:g}:{self._dictionary.value}" if kind == "charuco" else ""
        return Board.parse(notation + markers)

    def _fill_fields(self, board: Board) -> None:
        """Fill the fields from a board."""
        self._kind.value = next(k for k, kind in self._kinds.items() if kind == board.kind)
        self._columns.value, self._rows.value = board.columns, board.rows
        self._pitch.value = float(board.pitch_mm)
        has_markers = board.kind == "charuco"
        self._marker.visible = self._dictionary.visible = has_markers
        if has_markers:
            self._marker.value, self._dictionary.value = board.marker_mm, board.dictionary

    def _change_kind(self) -> None:
        """Fill the fields with an example of the chosen kind of board."""
        self._fill_fields(Board.parse(board_examples()[self._kinds[self._kind.value]]))
        self._describe()

    def _describe(self) -> None:
        """Describe the entered board, and whether it is the session's."""
        try:
            board = self._parse_entered()
        except InputError as error:
            self._note.set(alert(str(error), "error"))
            return
        corners = board.outline()
        width, height = corners[2, 0] - corners[0, 0], corners[2, 1] - corners[0, 1]
        added = board.plugin_type
        counts = added.counts if added else _EXPLANATIONS[board.kind]
        explanation = coloured(f"{counts}. Size: {width:.0f} × {height:.0f} mm", "dim")
        in_use = str(board) == self._target
        self._use.disabled = in_use
        state = coloured(
            f"● In use: {board}" if in_use else f"Not in use: {board}",
            "good" if in_use else "warning",
            bold=in_use,
        )
        self._note.set(paragraph(Html(f"{explanation}<br>{state}")))

    def _write_sheet(self) -> None:
        """Write a PDF of the entered board into the exports, and link it."""
        board = self._parse_entered()
        path = self._context.session.exports / f"{str(board).replace(':', '_')}.pdf"
        write_target(str(board), path)
        note = to_html("Print at 100 %, glue it to a flat plate, and measure the scale bar.")
        button = link(self._context.offer_download(path), f"Download {path.name}")
        self._sheet.set(paragraph(Html(f"{button}<div style='margin-top:0.4em'>{note}</div>")))
