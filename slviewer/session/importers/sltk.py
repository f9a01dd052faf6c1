"""The sltk layout: `TIME_[AA-BB-CC_NN]_img.jpg`.

AA is the axis (00 columns, 01 rows), BB the bit of the Gray code of the projector pixel (0 =
finest), CC 00 the pattern and 01 its negative, NN the running number. Source:
github.com/jhdewitt/sltk, sampledata.
"""

import re
from pathlib import Path

from slviewer.fringe.presets import AXES
from slviewer.fringe.sequence import Frame, PatternSequence
from slviewer.session.importers.imported import (
    ImportableRecording,
    define_layout,
    has_images,
    match_images,
    unknown_files_warning,
)

_FILE = re.compile(r".*\[(0?[01])-(\d+)-(0?[01])_(\d+)\].*")


def _describe(
    folder: Path, name: str, projector: tuple[int, int] | None
) -> tuple[ImportableRecording, list[str]]:
    """The recording of one folder. Raises InputError where a bit or its negative is missing or
    double."""
    images, others = match_images(folder, _FILE)
    ordered = sorted(images, key=lambda numbers: numbers[3])
    bits = [
        1 + max((numbers[1] for numbers in images if numbers[0] == axis), default=0)
        for axis in range(len(AXES))
    ]
    frames = [
        Frame(
            "inverse" if negative else "gray", AXES[axis], bit=bits[axis] - 1 - bit, bits=bits[axis]
        )
        for axis, bit, negative, _ in ordered
    ]
    sequence = PatternSequence(projector, tuple(frames))
    files = tuple(images[numbers] for numbers in ordered)
    return ImportableRecording(name, sequence, files, folder), unknown_files_warning(folder, others)


LAYOUT = define_layout(
    "sltk", "TIME_[AA-BB-CC_NN]_img images", _describe, lambda folder: has_images(folder, _FILE)
)
