"""The procam-calibration layout: `capture_N/graycode_NN.*`.

Gray code of every projector column, then row; each bit, most significant first, as the pattern and its inverse; then
white, then black.
"""

import re
from pathlib import Path

from slviewer.errors import InputError
from slviewer.fringe.presets import gray
from slviewer.session.importers.images import IMAGE_SUFFIXES
from slviewer.session.importers.imported import (
    ImportableRecording,
    Imports,
    collect_captures,
    listed,
    strangers_warning,
    visible,
)

_FILE = re.compile(r"graycode_?(\d+)", re.IGNORECASE)


def read(source: Path, *, prefix: str | None = None, projector: tuple[int, int] = (1024, 768)) -> Imports:
    """Captures named after their folders. The projector's size says how many bits, and so how many images, there are.

    A capture is skipped where images are missing or double, or where their number contradicts the projector's size;
    InputError where none can be used.
    """
    sequence = gray(projector)

    def describe(folder: Path, name: str) -> tuple[ImportableRecording, list[str]]:
        numbered, strangers = _numbered(folder)
        _check_count(folder, set(numbered), len(sequence.frames), projector)
        files = tuple(numbered[number] for number in range(len(sequence.frames)))
        return ImportableRecording(name, sequence, files, folder), strangers_warning(folder, strangers)

    return collect_captures(Path(source), prefix, is_capture, "graycode_NN images", describe)


def _numbered(folder: Path) -> tuple[dict[int, Path], list[Path]]:
    numbered: dict[int, Path] = {}
    strangers: list[Path] = []
    for file in sorted(visible(folder)):
        match = _FILE.fullmatch(file.stem)
        if not match or file.suffix.lower() not in IMAGE_SUFFIXES:
            strangers.append(file)
        elif (number := int(match[1])) in numbered:
            raise InputError(f"it holds {numbered[number].name} and {file.name}: keep one of them")
        else:
            numbered[number] = file
    return numbered, strangers


def _check_count(folder: Path, numbers: set[int], needed: int, projector: tuple[int, int]) -> None:
    size = f"{projector[0]}x{projector[1]}"
    if gaps := [n for n in range(max(numbers)) if n not in numbers]:
        raise InputError(f"it lacks graycode_{listed([f'{n:02d}' for n in gaps])}: record or copy them again")
    if len(numbers) != needed:
        fault = "images are missing" if len(numbers) < needed else "there are images too many"
        raise InputError(
            f"it holds {len(numbers)} images, and the Gray code of a {size} projector takes {needed}: "
            f"{fault}, or the projector has another size"
        )


def is_capture(folder: Path) -> bool:
    """Whether a folder holds images of this layout."""
    return any(_FILE.fullmatch(entry.stem) and entry.is_file() for entry in visible(folder))
