"""The procam-calibration layout: `capture_N/graycode_NN.*`.

Gray code of every projector column, then row; each bit, most significant first, as the pattern and
its inverse; then white, then black.
"""

import re
from pathlib import Path

from slviewer.errors import InputError
from slviewer.fringe.presets import gray
from slviewer.session.importers.imported import (
    ImportableRecording,
    check_complete,
    define_layout,
    has_images,
    match_images,
    unknown_files_warning,
)

_FILE = re.compile(r"graycode_?(\d+)", re.IGNORECASE)


def _describe(
    folder: Path, name: str, projector: tuple[int, int]
) -> tuple[ImportableRecording, list[str]]:
    """Return the recording of one folder. The projector's size determines the numbers of bits and
    of images."""
    images, others = match_images(folder, _FILE)
    sequence = gray(projector)
    check_complete(images, "graycode_")
    if len(images) != len(sequence.frames):
        fault = (
            "images are missing"
            if len(images) < len(sequence.frames)
            else "there are images too many"
        )
        raise InputError(
            f"it holds {len(images)} images, and the Gray code of a {projector[0]}x{projector[1]}"
            f" projector takes {len(sequence.frames)}: {fault}, or the projector has another size"
        )
    return ImportableRecording(
        name, sequence, tuple(images.values()), folder
    ), unknown_files_warning(folder, others)


LAYOUT = define_layout(
    "procam-calibration",
    "capture_N/graycode_NN images",
    _describe,
    lambda folder: has_images(folder, _FILE),
    (1024, 768),
)
