"""What goes on paper and on the projector: targets and pattern images."""

from pathlib import Path

from slviewer.fringe.presets import PresetName, find_preset
from slviewer.fringe.sequence import parse_size
from slviewer.session.exporters import write_pattern_folder
from slviewer.target.board import Board
from slviewer.target.coded import draw_marker_sheet
from slviewer.target.sheet import write_drawing, write_sheet


def patterns(preset: PresetName, projector: str, out: Path | str) -> str:
    """Write the images of a pattern sequence, and the TOML that `import frames` reads.

    Args:
        preset: Which sequence.
        projector: Width x height of the projector, px.
        out: Folder to make.

    Returns how many images were written, in words.
    """
    sequence = find_preset(preset)(parse_size(projector))
    write_pattern_folder(Path(out), sequence)
    return f"{len(sequence.frames)} patterns written to {out}"


def target(board: str, out: Path | str) -> str:
    """Draw a printable target to exact scale.

    Args:
        board: circles:21x16:9, acircles:..., chessboard:9x7:75 or charuco:...; or coded markers for
            merging: markers:0-23:20 (numbers to cut out, mm) or mat:16 (a mat for a turntable, mm).
        out: A .pdf or .svg file.

    Returns what to do with it, in words.
    """
    if board.partition(":")[0] in ("markers", "mat"):
        write_drawing(draw_marker_sheet(board), Path(out))
    else:
        write_sheet(Board.parse(board), Path(out))
    return f"{board} drawn to {out}: print at 100 %, and measure it"
