"""Captures as two folders of numbered images, x/0.png ... x/11.png and y/0.png ... y/11.png.

Each holds 4 steps at each of three periods: the whole projector, a sixth and a thirty-sixth of it.
"""

import re
from pathlib import Path

from slviewer.plugins import (
    ImportableRecording,
    InputError,
    PatternSequence,
    check_complete,
    define_layout,
    has_images,
    match_images,
    phase_steps,
    unknown_files_warning,
)

_FILE = re.compile(r"(\d+)")
_STEPS, _PARTS = 4, (1, 6, 36)


def describe(
    folder: Path, name: str, projector: tuple[int, int]
) -> tuple[ImportableRecording, list[str]]:
    """Return the recording of one capture's folder, and warnings about files that do not belong to
    it.

    Raises InputError for a capture that is incomplete: it is skipped with that reason.
    """
    frames, files, warnings = [], [], []
    for axis, extent in (("x", projector[0]), ("y", projector[1])):
        if not (folder / axis).is_dir():
            raise InputError(f"it lacks the folder {axis}", "copy it again")
        images, others = match_images(folder / axis, _FILE)
        check_complete(images, f"{axis}/", count=_STEPS * len(_PARTS))
        for parts in _PARTS:
            frames += phase_steps(axis, _STEPS, extent / parts)
        files += images.values()
        warnings += unknown_files_warning(folder / axis, others)
    return (
        ImportableRecording(name, PatternSequence(projector, tuple(frames)), tuple(files), folder),
        warnings,
    )


def is_capture(folder: Path) -> bool:
    """Whether a folder looks like a capture of this layout, by its names alone."""
    return any((folder / axis).is_dir() and has_images(folder / axis, _FILE) for axis in ("x", "y"))


LAYOUT = define_layout(
    "axisfolders",
    "folders x and y of numbered images",
    describe,
    is_capture,
    needs_projector="the fringes of the layout axisfolders",
)
