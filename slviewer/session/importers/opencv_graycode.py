"""The images of OpenCV's structured_light GrayCodePattern, in the order in which it generates them.

Gray code of every projector column, then row; each bit, most significant first, as the pattern and its inverse; then,
in most programs, white and black. The images are taken in natural order of their names. Source: opencv_contrib,
modules/structured_light, src/graycodepattern.cpp and samples/cap_pattern.cpp (`pattern_cam1_im1.png`, ...).
"""

import re
from pathlib import Path

from slviewer.errors import InputError
from slviewer.fringe.presets import gray
from slviewer.fringe.sequence import PatternSequence
from slviewer.session.importers.frame_groups import images_by_name, match_files
from slviewer.session.importers.imported import Imports, Recording, collect_captures, listed, strangers_warning

_SAMPLE = re.compile(r"pattern_(cam\d+_)?(im)?\d+", re.IGNORECASE)


def read(
    source: Path,
    *,
    prefix: str | None = None,
    projector: tuple[int, int] | None = None,
    files: str | None = None,
) -> Imports:
    """Captures named after their folders. `files` is a pattern of names (* and ? are wildcards) for a folder that holds
    more than these images, such as those of a second camera.

    A capture is skipped where the number of its images contradicts the projector's size.
    """
    if projector is None:
        raise InputError("the Gray code of OpenCV depends on the projector's size: give it with --projector 1280x800")
    sequence = gray(projector)

    def select(folder: Path) -> list[Path]:
        return match_files(folder, files) if files else images_by_name(folder)

    def describe(folder: Path, name: str) -> tuple[Recording, list[str]]:
        found = select(folder)
        if len(kinds := {re.sub(r"\d+$", "", file.stem) for file in found}) > 1:
            shown = listed([f"{kind}N" for kind in sorted(kinds)])
            raise InputError(f'it holds images named {shown}: choose one with --files "{min(kinds)}*"')
        shown_sequence = _shown(sequence, len(found))
        recording = Recording(name, shown_sequence, tuple(found), folder)
        return recording, strangers_warning(folder, [file for file in images_by_name(folder) if file not in found])

    def looks_so(folder: Path) -> bool:
        return 2 * len(select(folder)) > len(sequence.frames)

    return collect_captures(
        Path(source), prefix, looks_so, f"the {len(sequence.frames)} images of a Gray code", describe
    )


def is_capture(folder: Path) -> bool:
    """Whether a folder holds images with the names of OpenCV's own program."""
    return any(_SAMPLE.fullmatch(file.stem) for file in images_by_name(folder))


def _shown(sequence: PatternSequence, images: int) -> PatternSequence:
    """The sequence of so many images: with or without white and black at its end."""
    needed = len(sequence.frames)
    if images == needed:
        return sequence
    if images == needed - 2:
        return PatternSequence(sequence.projector, sequence.frames[:-2])
    width, height = sequence.projector
    raise InputError(
        f"it holds {images} images, and the Gray code of a {width}x{height} projector takes {needed}, or {needed - 2} "
        "without white and black: images are missing or too many, or the projector has another size"
    )
