"""The images of OpenCV's structured_light GrayCodePattern, in the order in which it generates them.

Gray code of every projector column, then row; each bit, most significant first, as the pattern and
its inverse; then, in most programs, white and black, or black and white. The images are taken in
natural order of their names. Source: opencv_contrib, modules/structured_light,
src/graycodepattern.cpp and samples/cap_pattern.cpp (`pattern_cam1_im1.png`, ...).
"""

import re
from pathlib import Path

import numpy as np

from slviewer.errors import InputError
from slviewer.fringe.presets import gray
from slviewer.fringe.sequence import PatternSequence
from slviewer.session.importers.images import read_frames
from slviewer.session.importers.imported import (
    FolderLayout,
    ImportableRecording,
    Imports,
    collect_captures,
    has_images,
    images_by_name,
    match_files,
    unknown_files_warning,
)
from slviewer.session.names import join_names

_ILLUMINATED, _MOSTLY = 0.25, 0.9
"""Share of the largest difference from which on a pixel counts; share of these in which white is
brighter than black: all of them but for a few that something disturbs, and half of them between two
stripes."""
_PAIRED = 0.25
"""Mean difference of pattern + inverse and white + black, as a share of white - black: noise, and
half of it for two patterns."""
_SAMPLE = re.compile(r"pattern_(cam\d+_)?(im)?\d+", re.IGNORECASE)


def _read(
    source: Path,
    *,
    prefix: str | None = None,
    projector: tuple[int, int] | None = None,
    files: str | None = None,
) -> Imports:
    """Captures named after their folders. `files` is a pattern of names (* and ? are wildcards) for
    a folder that holds more than these images, such as those of a second camera.

    A capture is skipped where the number of its images contradicts the projector's size.
    """
    if projector is None:
        raise InputError(
            "the Gray code of OpenCV depends on the projector's size: give it with --projector"
            " 1280x800"
        )
    sequence = gray(projector)

    def select(folder: Path) -> list[Path]:
        """Return the images of a capture's folder that match ``files``, or all of them."""
        return match_files(folder, files) if files else images_by_name(folder)

    def describe(folder: Path, name: str) -> tuple[ImportableRecording, list[str]]:
        """Return the recording of a folder, and warnings about images that are not part of it."""
        files = select(folder)
        if len(kinds := {re.sub(r"\d+$", "", file.stem) for file in files}) > 1:
            shown = join_names([f"{kind}N" for kind in sorted(kinds)])
            raise InputError(
                f'it holds images named {shown}: choose one with --files "{min(kinds)}*"'
            )
        shown_sequence = _fit_sequence(sequence, len(files))
        files = _order_shadow_images(files, shown_sequence)
        recording = ImportableRecording(name, shown_sequence, tuple(files), folder)
        return recording, unknown_files_warning(
            folder, [file for file in images_by_name(folder) if file not in files]
        )

    def looks_so(folder: Path) -> bool:
        """Return whether a folder holds more than half of the images of a capture."""
        return 2 * len(select(folder)) > len(sequence.frames)

    return collect_captures(
        Path(source),
        prefix,
        looks_so,
        f"the {len(sequence.frames)} images of a Gray code",
        describe,
    )


def _order_shadow_images(files: list[Path], sequence: PatternSequence) -> list[Path]:
    """Return the files with white before black.

    Raises InputError where white and black images are in place of stripes, or the other way round,
    and where the first two images are not a pattern and its inverse. A projector of another size
    may take two images more or less, as many as white and black are. In a pair of the finest
    stripes the first image is the brighter in half of the places, in white and black everywhere.
    """
    half = len(files) // 2 - 1
    stack = read_frames([*files[:2], files[half], *files[-2:]]).stack.astype(np.int32)
    difference = stack[-2] - stack[-1]
    illuminated = np.abs(difference) > _ILLUMINATED * np.abs(difference).max()
    brighter = float((difference[illuminated] > 0).mean()) if illuminated.any() else 0.5
    ends_in_white = sequence.frames[-1].kind == "black"
    if ends_in_white != (abs(brighter - 0.5) > _MOSTLY - 0.5):
        there, expected = (
            ("stripes", "white and black") if ends_in_white else ("white and black", "stripes")
        )
        width, height = sequence.projector
        raise InputError(
            f"the last two images show {there}, and {expected} are expected of a {width}x{height}"
            " projector: it has another size, or images are missing or too many"
        )
    if not ends_in_white:
        return files

    def are_inverse(first: int, second: int) -> bool:
        """Return whether two images sum up to white and black."""
        rest = np.abs(stack[first] + stack[second] - stack[-2] - stack[-1])[illuminated]
        return bool(rest.mean() < _PAIRED * np.abs(difference[illuminated]).mean())

    if not are_inverse(0, 1):
        block = (
            f", but {files[half].name} is: the inverses are a block of their own"
            if are_inverse(0, 2)
            else ""
        )
        raise InputError(
            f"{files[1].name} is not the inverse of {files[0].name}{block}: describe the images in"
            " a TOML, which `slviewer import frames --guess` proposes"
        )
    return files if brighter > 0.5 else [*files[:-2], files[-1], files[-2]]


def _fit_sequence(sequence: PatternSequence, images: int) -> PatternSequence:
    """Return the sequence of so many images: with or without white and black at its end."""
    needed = len(sequence.frames)
    if images == needed:
        return sequence
    if images == needed - 2:
        return PatternSequence(sequence.projector, sequence.frames[:-2])
    width, height = sequence.projector
    raise InputError(
        f"it holds {images} images, and the Gray code of a {width}x{height} projector takes"
        f" {needed}, or {needed - 2} without white and black: images are missing or too many, or"
        " the projector has another size"
    )


LAYOUT = FolderLayout(
    "opencv-graycode", "pattern_camN_imN images", _read, lambda folder: has_images(folder, _SAMPLE)
)
