"""What goes on paper and on the projector: targets and pattern images."""

from pathlib import Path

from slviewer.errors import InputError
from slviewer.fringe.presets import PRESETS
from slviewer.fringe.sequence import parse_size
from slviewer.session.exporters import write_pattern_folder
from slviewer.target.board import Board
from slviewer.target.sheet import write_sheet


def patterns(preset: str, projector: str | tuple[int, int], out: Path | str) -> int:
    """Write every image of a preset sequence as PNG, with the TOML that ``import_frames`` reads; returns how many."""
    if preset not in PRESETS:
        raise InputError(f"no pattern sequence is called {preset!r}: use {', '.join(PRESETS)}")
    sequence = PRESETS[preset](parse_size(projector))
    write_pattern_folder(Path(out), sequence)
    return len(sequence.frames)


def target(board: str | Board, out: Path | str) -> None:
    """Draw a printable target, to exact scale, as .pdf or .svg."""
    write_sheet(board if isinstance(board, Board) else Board.parse(board), Path(out))
