"""The sltk layout: `TIME_[AA-BB-CC_NN]_img.jpg`.

AA is the axis (00 columns, 01 rows), BB the bit of the Gray code of the projector pixel (0 = finest), CC 00 the pattern
and 01 its negative, NN the running number. Source: github.com/jhdewitt/sltk, sampledata.
"""

import re
from pathlib import Path

from slviewer.errors import InputError
from slviewer.fringe.presets import AXES
from slviewer.fringe.sequence import Frame, PatternSequence
from slviewer.session.importers.images import IMAGE_SUFFIXES
from slviewer.session.importers.imported import (
    ImportableRecording,
    Imports,
    collect_captures,
    listed,
    strangers_warning,
    visible,
)

_FILE = re.compile(r".*\[(\d+)-(\d+)-(\d+)_(\d+)\].*")


def read(source: Path, *, prefix: str | None = None, projector: tuple[int, int] | None = None) -> Imports:
    """Captures named after their folders. A capture is skipped where a bit or its negative is missing or double."""

    def describe(folder: Path, name: str) -> tuple[ImportableRecording, list[str]]:
        files, strangers = _files(folder)
        frames = _frames(files)
        ordered = sorted(files, key=lambda fields: fields[3])
        sequence = PatternSequence(projector, tuple(frames[fields] for fields in ordered))
        paths = tuple(files[fields] for fields in ordered)
        return ImportableRecording(name, sequence, paths, folder), strangers_warning(folder, strangers)

    return collect_captures(Path(source), prefix, is_capture, "images named ..._[AA-BB-CC_NN]_...", describe)


def is_capture(folder: Path) -> bool:
    """Whether a folder holds images of this layout."""
    return any(_FILE.fullmatch(entry.stem) and entry.suffix.lower() in IMAGE_SUFFIXES for entry in visible(folder))


def _files(folder: Path) -> tuple[dict[tuple[int, ...], Path], list[Path]]:
    """{(axis, bit, negative, number): file}, and the images that are none of these."""
    files: dict[tuple[int, ...], Path] = {}
    strangers = []
    for file in sorted(entry for entry in visible(folder) if entry.suffix.lower() in IMAGE_SUFFIXES):
        match = _FILE.fullmatch(file.stem)
        fields = tuple(int(field) for field in match.groups()) if match else ()
        if not fields or fields[0] >= len(AXES) or fields[2] > 1:
            strangers.append(file)
        elif fields in files:
            raise InputError(f"it holds {listed([files[fields].name, file.name])} for one pattern: keep one of them")
        else:
            files[fields] = file
    return files, strangers


def _frames(files: dict[tuple[int, ...], Path]) -> dict[tuple[int, ...], Frame]:
    bits = {axis: 1 + max(fields[1] for fields in files if fields[0] == axis) for axis in {f[0] for f in files}}
    return {
        fields: Frame(
            "inverse" if fields[2] else "gray",
            AXES[fields[0]],
            bit=bits[fields[0]] - 1 - fields[1],
            bits=bits[fields[0]],
        )
        for fields in files
    }
