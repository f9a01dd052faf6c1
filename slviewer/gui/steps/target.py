"""Step 2: say which board there is, print it, and see it found."""

from pathlib import Path
from typing import Any

import viser

from slviewer.errors import InputError
from slviewer.gui.inputs import change
from slviewer.gui.panel import Stage
from slviewer.gui.preview import board_words, drawn, legend, light_words
from slviewer.gui.widgets import Html, Picture, Words, block, boxed, cell, link, toned
from slviewer.pipeline.printouts import target as write_target
from slviewer.target.board import EXAMPLES, Board, Kind
from slviewer.wizard.snapshot import PreviewView, Snapshot

KINDS: dict[str, Kind] = {
    "Circle grid": "circles",
    "Asymmetric circle grid": "acircles",
    "Chessboard": "chessboard",
    "ChArUco": "charuco",
}
DICTIONARIES = tuple(f"DICT_{bits}X{bits}_{count}" for bits in (4, 5, 6, 7) for count in (50, 100, 250, 1000))
_COUNTED = {
    "circles": "circles across and down, and the distance between their centres",
    "acircles": "circles in a row, rows, and half the distance between neighbours of a row",
    "chessboard": "inner corners across and down, and the side of a square",
    "charuco": "squares across and down, and the side of a square",
}


class Panel:
    """The board."""

    key = "target"

    def __init__(self, stage: Stage) -> None:
        self._stage = stage
        self._target = ""
        self._board: Board | None = None
        self._folder: Path | None = None

    def build(self) -> None:
        """The board's fields, its sheet, and the picture in which it is found."""
        gui, stage = self._stage.gui, self._stage
        board = Board.parse(EXAMPLES["circles"])
        self._kind = gui.add_dropdown("Kind", tuple(KINDS))
        self._columns = gui.add_number("Across", board.columns, min=2, max=200, step=1)
        self._rows = gui.add_number("Down", board.rows, min=3, max=200, step=1)
        self._pitch = gui.add_number("Pitch, mm", float(board.pitch_mm), min=0.1, max=1000.0, step=0.01)
        self._marker = gui.add_number("Marker, mm", 1.0, min=0.1, max=1000.0, step=0.01, visible=False)
        self._dictionary = gui.add_dropdown("Dictionary", DICTIONARIES, visible=False)
        self._counts = Words(gui)
        self._use = gui.add_button("Use this board", icon=viser.Icon.CHECK)
        self._print = gui.add_button("Make PDF to print", icon=viser.Icon.PRINTER, color="gray")
        self._sheet = Words(gui)
        self._picture = Picture(gui, "Live picture")
        for field in (self._columns, self._rows, self._pitch, self._marker, self._dictionary):
            field.on_update(stage.safely_with(self._edited))
        self._kind.on_update(stage.safely_with(self._another_kind))
        self._use.on_click(stage.safely(lambda: stage.operator.choose_target(str(self._entered()))))
        self._print.on_click(stage.safely(self._make_sheet))

    def draw(self, snapshot: Snapshot) -> None:
        """The session's board, in the fields too."""
        target = snapshot.session.target if snapshot.session else ""
        folder = snapshot.session.folder if snapshot.session else None
        if folder != self._folder:
            self._folder = folder
            self._sheet.set("")
        if target != self._target:
            self._target = target
            self._board = Board.parse(target) if target else None
            if self._board is not None:
                self._fill(self._board)
        self._say()

    def draw_preview(self, preview: PreviewView) -> None:
        """The board, where it is seen."""
        words = legend(preview, board_words(preview, self._board), light_words(preview))
        self._picture.set(drawn(preview, self._board), words)

    def shown(self, visible: bool) -> None:
        """Nothing of this step stands in the scene."""

    def _entered(self) -> Board:
        """The board that the fields describe; InputError where there is none such."""
        kind = KINDS[self._kind.value]
        notation = f"{kind}:{int(self._columns.value)}x{int(self._rows.value)}:{self._pitch.value:g}"
        markers = f":{self._marker.value:g}:{self._dictionary.value}" if kind == "charuco" else ""
        return Board.parse(notation + markers)

    def _fill(self, board: Board) -> None:
        change(self._kind, value=next(words for words, kind in KINDS.items() if kind == board.kind))
        change(self._columns, value=board.columns)
        change(self._rows, value=board.rows)
        change(self._pitch, value=float(board.pitch_mm))
        markers = board.kind == "charuco"
        for field in (self._marker, self._dictionary):
            change(field, visible=markers)
        if markers:
            change(self._marker, value=board.marker_mm)
            change(self._dictionary, value=board.dictionary)

    def _another_kind(self, event: Any) -> None:
        if event.client is not None:
            self._fill(Board.parse(EXAMPLES[KINDS[self._kind.value]]))
            self._say()

    def _edited(self, event: Any) -> None:
        if event.client is not None:
            self._say()

    def _say(self) -> None:
        """What the fields mean, and whether that is the session's board."""
        try:
            board = self._entered()
        except InputError as error:
            self._counts.set(boxed(str(error), "error"))
            return
        corners = board.outline()
        width, height = corners[2, 0] - corners[0, 0], corners[2, 1] - corners[0, 1]
        what = f"{_COUNTED[board.kind]}: {width:.0f} × {height:.0f} mm"
        change(self._use, disabled=str(board) == self._target)
        if str(board) == self._target:
            state = toned(f"● in use: {board}", "good", bold=True)
        else:
            state = toned(f"not in use yet: {board}", "warning")
        self._counts.set(block(Html(f"{toned(what, 'dim')}<br>{state}")))

    def _make_sheet(self) -> None:
        board = self._entered()
        session = self._stage.operator.session
        if session is None:
            raise InputError("no session is open to keep the sheet in: open one first")
        path = session.exports / f"{str(board).replace(':', '_')}.pdf"
        write_target(board, path)
        note = cell("Print at 100 %, glue it to something flat, and measure the scale bar.")
        button = link(self._stage.offer(path), f"Download {path.name}")
        self._sheet.set(block(Html(f"{button}<div style='margin-top:0.4em'>{note}</div>")))
