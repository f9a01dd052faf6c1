"""The layouts that can be imported, by name, and which of them a folder has. Plugins add others.

Those whose images are numbered in their names are defined here.

p18: `pose_XX/{V,H}/P18_FNN.PNG`. F00-F17 are 18 phase steps at a period of 18 px, F18-F24 seven
Gray bits, most significant first, F25 or F26 the texture. V varies along projector columns (axis
x), H along rows (axis y). Capitals and suffixes vary.

procam-calibration: `capture_N/graycode_NN.*`. Gray code of every projector column, then row; each
bit, most significant first, as the pattern and its inverse; then white, then black. Its option
`graycode step` makes cells of several pixels.

sltk: `TIME_[AA-BB-CC_NN]_img.jpg`. AA is the axis (00 columns, 01 rows), BB the bit of the Gray
code of the projector pixel (0 = finest), CC 00 the pattern and 01 its negative, NN the running
number. Source: github.com/jhdewitt/sltk, sampledata.

SLStudio: `frameSeq_NN.bmp`, in the order of one of its codecs. All of them show (1 + cos(2 pi u /
pitch - 2 pi k / n)) / 2 in step k of n, u counted from 0 at the first column, and along both axes
first the columns, then the rows:

- 2x3 (also the calibration's): 3 steps at a sixteenth of the projector, then 3 at the whole of it;
- nstep: 9 steps at an eighth, then 3 at the whole;
- 3 (also FastWrap) and 4: so many steps at the whole projector;
- gray: white, black, the 10 most significant bits of the columns' Gray code, the 6 most significant
  of the rows'.

With the diamond pattern SLStudio counts twice as many columns: give the projector's size so.
Source: github.com/jakobwilm/slstudio, src/codec.

OpenCV's structured_light GrayCodePattern, in the order in which it generates its images: Gray code
of every projector column, then row; each bit, most significant first, as the pattern and its
inverse; then, in most programs, white and black, or black and white. The images are taken in
natural order of their names. Source: opencv_contrib, modules/structured_light,
src/graycodepattern.cpp and samples/cap_pattern.cpp (`pattern_cam1_im1.png`, ...).
"""

import re
from collections.abc import Callable, Iterable, Mapping
from math import ceil, log2
from pathlib import Path
from shlex import quote
from typing import Any, Literal, get_args

import numpy as np

from slviewer.entry_points import IMPORTERS, PluginGroup
from slviewer.errors import InputError, UnknownLayoutError
from slviewer.fringe.presets import AXES, gray, gray_bits, phase_steps
from slviewer.fringe.sequence import Axis, Frame, PatternSequence, PerAxis, Size
from slviewer.session.importers.frames import LAYOUT as FRAMES
from slviewer.session.importers.images import read_frames, read_image
from slviewer.session.importers.imported import (
    FolderLayout,
    ImportableRecording,
    Imports,
    check_complete,
    collect_captures,
    define_layout,
    explain_stacks,
    has_images,
    images_by_name,
    list_folders,
    match_files,
    match_images,
    missing_projector,
    unknown_files_warning,
    visible,
)
from slviewer.session.names import join_names

_ILLUMINATED, _MOSTLY = 0.25, 0.9
"""Share of the largest difference from which on a pixel counts; share of these in which white is
brighter than black: all of them but for a few that something disturbs, and half of them between two
stripes."""
_PAIRED = 0.25
"""Mean difference of pattern + inverse and white + black, as a share of white - black: noise, and
half of it for two patterns."""
_WIDEST_CELL = 16
"""Cells, px, that are tried for a number of images."""
_SAMPLE = re.compile(r"pattern_(cam\d+_)?(im)?\d+", re.IGNORECASE)


def _read_graycode(
    source: Path,
    *,
    prefix: str | None = None,
    projector: Size | None = None,
    files: str | None = None,
    cell: int = 1,
) -> Imports:
    """Captures named after their folders. `files` is a pattern of names (* and ? are wildcards) for
    a folder that holds more than these images, such as those of a second camera; `cell` the width
    of the code's cells, px.

    A capture is skipped where the number of its images contradicts the projector's size.
    """
    if projector is None:
        raise missing_projector("the images of OpenCV's Gray code")
    sequence = gray(projector, cell)

    def select(folder: Path) -> list[Path]:
        """Return the images of a capture's folder that match ``files``, or all of them."""
        return match_files(folder, files) if files else images_by_name(folder)

    def describe(folder: Path, name: str) -> tuple[ImportableRecording, list[str]]:
        """Return the recording of a folder, and warnings about images that are not part of it."""
        files = select(folder)
        if len(kinds := {re.sub(r"\d+$", "", file.stem) for file in files}) > 1:
            shown = join_names([f"{kind}N" for kind in sorted(kinds)])
            raise InputError(
                f"it holds images named {shown}", f'choose one with --files "{min(kinds)}*"'
            )
        shown_sequence = _fit_sequence(sequence, len(files), optional=2)
        files = _order_shadow_images(files, shown_sequence)
        unknown = [file for file in images_by_name(folder) if file not in files]
        recording = ImportableRecording(
            name, shown_sequence, tuple(files), folder, unknown=tuple(unknown)
        )
        return recording, []

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
            f"{files[1].name} is not the inverse of {files[0].name}{block}",
            "describe the images in a TOML, which `slviewer import frames --guess` proposes",
        )
    return files if brighter > 0.5 else [*files[:-2], files[-1], files[-2]]


def _fit_sequence(sequence: PatternSequence, images: int, optional: int = 0) -> PatternSequence:
    """Return the sequence of so many images: with or without the ``optional`` ones at its end."""
    needed = len(sequence.frames)
    if images == needed:
        return sequence
    if optional and images == needed - optional:
        return PatternSequence(sequence.projector, sequence.frames[:-optional])
    width, height = sequence.projector
    without = f", or {needed - optional} without white and black" if optional else ""
    cells = [
        str(cell)
        for cell in range(1, _WIDEST_CELL + 1)
        if len(gray(sequence.projector, cell).frames) in (images, images + optional)
    ]
    wide = f"; in cells of {' or '.join(cells)} px it takes {images}" if cells else ""
    remedy = "images are missing or too many, or the projector has another size"
    if cells:
        remedy = (
            "if none is missing, give the projector's size, or the width of the cells that were"
            f" shown, with --cell {' or '.join(cells)} of `slviewer import procam-calibration` or"
            " `opencv-graycode`"
        )
    raise InputError(
        f"it holds {images} images, and the Gray code of a {width}x{height} projector takes"
        f" {needed}{without}{wide}",
        remedy,
    )


Images = Mapping[tuple[int, ...], Path]
"""Images by the numbers in their names, in their order."""


def _define_numbered(
    name: str,
    holds: str,
    stem: str,
    order: Callable[..., tuple[PatternSequence, Iterable[Path]]],
    **known: Any,
) -> FolderLayout:
    """Return a layout of images whose stems match the regular expression ``stem``, which
    ``order(images, size of the projector, **options of the layout)`` explains by a sequence, with
    the files in its order; ``known``: of the projector, as `define_layout` takes it."""
    pattern = re.compile(stem, re.IGNORECASE)

    def describe(
        folder: Path, recording: str, size: Size | None, **options: Any
    ) -> tuple[ImportableRecording, list[str]]:
        """Return the recording of one folder, and warnings."""
        images, others = match_images(folder, pattern)
        sequence, files = order(images, size, **options)
        unknown = tuple(others)
        return ImportableRecording(recording, sequence, tuple(files), folder, unknown=unknown), []

    return define_layout(name, holds, describe, lambda folder: has_images(folder, pattern), **known)


_P18_STEPS, _P18_PERIOD_PX, _P18_BITS = 18, 18.0, 7
_CODED = _P18_STEPS + _P18_BITS
_REACH_PX = 2**_P18_BITS * _P18_PERIOD_PX
_TEXTURES = (_CODED, _CODED + 1)
_AXES: dict[str, Axis] = {"v": "x", "h": "y"}
_P18_FILE = re.compile(r"p18_f(\d+)", re.IGNORECASE)


def _describe_p18(pose: Path, name: str, projector: Size) -> tuple[ImportableRecording, list[str]]:
    """The recording of one folder, with the axes whose folder is there, V before H.

    Raises InputError where frames are missing, double or too many, or where the Gray code cannot
    number the projector's columns or rows.
    """
    files: list[Path] = []
    frames: list[Frame] = []
    texture: Path | None = None
    warnings: list[str] = []
    for folder, axis in _axis_folders(pose):
        extent = projector[0] if axis == "x" else projector[1]
        if extent > _REACH_PX:
            raise InputError(
                f"{_P18_BITS} Gray bits of {_P18_PERIOD_PX:g} px reach {_REACH_PX:g} px, and the"
                f" projector has {extent} along {axis}",
                "give the size of the projector that was used, or describe the frames in a TOML",
            )
        try:
            images, others = match_images(folder, _P18_FILE)
            check_complete(images, "P18_F", _CODED)
        except InputError as error:
            raise error.within(f"folder {folder.name}") from error
        if extra := [file.name for (number,), file in images.items() if number > max(_TEXTURES)]:
            raise InputError(
                f"folder {folder.name} holds {join_names(extra)}, beyond the p18 layout's F00 to"
                " F26",
                "move them away, or describe the frames in a TOML",
            )
        warnings += unknown_files_warning(folder, others)
        files += list(images.values())[:_CODED]
        frames += phase_steps(axis, _P18_STEPS, _P18_PERIOD_PX) + gray_bits(axis, _P18_BITS)
        if texture is None and (textures := list(images.values())[_CODED:]):
            texture = textures[0]
            if len(textures) == 2:
                texture = max(textures, key=lambda path: read_image(path).mean())
                warnings.append(
                    f"{pose.name}/{folder.name}: both F25 and F26 are there: the brighter is the"
                    " texture"
                )
            files.append(texture)
            frames.append(Frame("texture"))
    if texture is None:
        warnings.append(
            f"{pose.name} has no texture (P18_F25 or F26): its clouds take their grey from the"
            " fringes"
        )
    return (
        ImportableRecording(name, PatternSequence(projector, tuple(frames)), tuple(files), pose),
        warnings,
    )


def _axis_folders(pose: Path) -> list[tuple[Path, Axis]]:
    """Return the axis folders that exist, V before H."""
    there = [entry for entry in visible(pose) if entry.is_dir() and entry.name.lower() in _AXES]
    found = {_AXES[entry.name.lower()]: entry for entry in there}
    if len(found) < len(there):
        raise InputError(
            f"it holds {join_names(sorted(entry.name for entry in there))}",
            "keep one folder an axis",
        )
    return [(found[axis], axis) for axis in AXES if axis in found]


def _is_p18(folder: Path) -> bool:
    """Return whether a folder has an inner folder of an axis with images in it."""
    return any(
        entry.name.lower() in _AXES
        and entry.is_dir()
        and any(_P18_FILE.match(file.stem) for file in visible(entry))
        for entry in visible(folder)
    )


def _order_procam(
    images: Images, projector: Size, cell: int = 1
) -> tuple[PatternSequence, Iterable[Path]]:
    """Return the sequence, and the files in its order. The projector's size and the width of the
    cells, px, determine the numbers of bits and of images."""
    check_complete(images, "graycode_")
    return _fit_sequence(gray(projector, cell), len(images)), images.values()


def _order_sltk(images: Images, projector: Size | None) -> tuple[PatternSequence, Iterable[Path]]:
    """Return the sequence, and the files in its order. Raises InputError where a bit or its
    negative is missing or double."""
    ordered = sorted(images, key=lambda numbers: numbers[3])
    bits = [1 + max((bit for at, bit, *_ in images if at == axis), default=0) for axis in (0, 1)]
    frames = [
        Frame(
            "inverse" if negative else "gray", AXES[axis], bit=bits[axis] - 1 - bit, bits=bits[axis]
        )
        for axis, bit, negative, _ in ordered
    ]
    return PatternSequence(projector, tuple(frames)), map(images.__getitem__, ordered)


Codec = Literal["2x3", "nstep", "3", "4", "gray"]
_CODEC_STEPS: dict[Codec, tuple[tuple[int, int], ...]] = {
    "2x3": ((3, 16), (3, 1)),
    "nstep": ((9, 8), (3, 1)),
    "3": ((3, 1),),
    "4": ((4, 1),),
}
"""Steps, and periods over the projector."""
_OTHERS = {3: "SLStudio's codecs 2p1 or 3Unwrap"}
"""Numbers of frames that codecs which are not described here have too."""
_SHOWN_BITS: dict[Axis, int] = {"x": 10, "y": 6}
_SINGLE_AXIS: tuple[Codec, ...] = ("3", "4")


def _order_slstudio(
    images: Images, projector: Size, codec: Codec | None = None, axis: Axis = "x"
) -> tuple[PatternSequence, Iterable[Path]]:
    """Return the sequence, and the files in its order. Without ``codec`` the number of frames
    determines it, where that is enough; ``axis`` is the one that a codec along a single axis
    showed.

    Raises InputError where the frames are not those of the codec, or of several.
    """
    check_complete(images, "frameSeq_")
    count = len(images)
    if codec is None and count in _OTHERS:
        raise InputError(
            f"{count} frames may also be those of {_OTHERS[count]}, which cannot be imported",
            "say with --codec what was shown",
        )
    candidates = [
        (each, axes)
        for each in get_args(Codec)
        for axes in ([(axis,)] if each in _SINGLE_AXIS else [(axis,), AXES])
        if codec in (None, each) and len(_list_frames(each, projector, axes)) == count
    ]
    if not candidates:
        what = f"codec {codec}" if codec else "any codec"
        raise InputError(
            f"it holds {count} frames, which {what} does not show",
            "choose another --codec, or use a TOML",
        )
    if len(candidates) > 1:
        several = join_names([f"{each} along {' and '.join(axes)}" for each, axes in candidates])
        raise InputError(f"{count} frames may be {several}", "choose with --codec")
    ((shown, axes),) = candidates
    cells: PerAxis[float | None] | None = (
        PerAxis(*(_gray_cell(each, projector) for each in AXES)) if shown == "gray" else None
    )
    frames = _list_frames(shown, projector, axes)
    sequence = PatternSequence(projector, frames, phase_sign=-1, gray_cell_px=cells)
    return sequence, images.values()


def _list_frames(codec: Codec, projector: Size, axes: tuple[Axis, ...]) -> tuple[Frame, ...]:
    """Return the frames of a codec in the order in which SLStudio shows them."""
    frames = [Frame("white"), Frame("black")] if codec == "gray" else []
    for axis in axes:
        extent = projector[AXES.index(axis)]
        if codec == "gray":
            frames += gray_bits(axis, _SHOWN_BITS[axis])
        for steps, periods in _CODEC_STEPS.get(codec, ()):
            frames += phase_steps(axis, steps, extent / periods)
    return tuple(frames)


def _gray_cell(axis: Axis, projector: Size) -> float:
    """Return the width in px of the finest Gray code cell; SLStudio does not show the least
    significant bits."""
    extent = projector[AXES.index(axis)]
    hidden = ceil(log2(extent)) - _SHOWN_BITS[axis]
    if hidden < 0:
        raise InputError(
            f"SLStudio's Gray code of {_SHOWN_BITS[axis]} bits does not fit {extent} px along"
            f" {axis}"
        )
    return float(2**hidden)


P18 = define_layout("p18", "pose_XX/{V,H}/P18_FNN images", _describe_p18, _is_p18, (912, 1140))
PROCAM_CALIBRATION = _define_numbered(
    "procam-calibration",
    "capture_N/graycode_NN images",
    r"graycode_?(\d+)",
    _order_procam,
    projector=(1024, 768),
)
SLTK = _define_numbered(
    "sltk",
    "TIME_[AA-BB-CC_NN]_img images",
    r".*\[(0?[01])-(\d+)-(0?[01])_(\d+)\].*",
    _order_sltk,
)
SLSTUDIO = _define_numbered(
    "slstudio",
    "frameSeq_NN images",
    r"frameSeq_(\d+)",
    _order_slstudio,
    needs_projector="the fringes of SLStudio",
)
OPENCV_GRAYCODE = FolderLayout(
    "opencv-graycode",
    "pattern_camN_imN images",
    _read_graycode,
    lambda folder: has_images(folder, _SAMPLE),
)
BUILT_IN = {
    layout.name: layout
    for layout in (
        *(P18, PROCAM_CALIBRATION, SLSTUDIO, SLTK),
        *(OPENCV_GRAYCODE, FRAMES),
    )
}
LAYOUT_PLUGINS = PluginGroup(IMPORTERS, FolderLayout, lambda: BUILT_IN)


def layouts() -> dict[str, FolderLayout]:
    """Return all layouts by name, those of plugins last."""
    return BUILT_IN | LAYOUT_PLUGINS.usable()


def detect_layout(source: Path) -> str:
    """The name of the layout of a folder, by its file names. Raises InputError where it is none, or
    not one alone.

    A TOML in the folder describes the images: it decides. Where folders further inside can be
    imported, the error names them; UnknownLayoutError where there are none.
    """
    folders = list_folders(source)
    if find_description(folders[0]) is not None:
        return "frames"
    candidates = [
        name
        for name, layout in layouts().items()
        if any(layout.recognises(folder) for folder in folders)
    ]
    if len(candidates) == 1:
        return candidates[0]
    if candidates:
        raise InputError(
            f"{source} holds captures of {' and '.join(candidates)}",
            "name the layout, or import one at a time",
        )
    if inside := [each for folder in folders[1:] for each in _list_sources(folder, 3)]:
        shown = [quote(str(source / each.relative_to(folders[0]))) for each in inside]
        raise InputError(
            f"{source} holds no capture itself",
            f"give one of the folders in it, {join_names(shown)}",
        )
    known = "; ".join(f"{layout.name}: {layout.holds}" for layout in layouts().values())
    raise UnknownLayoutError(
        f"{source} has none of the known layouts ({known}){explain_stacks(folders)}",
        "describe the images in a TOML in the folder",
    )


def _list_sources(folder: Path, depth: int) -> list[Path]:
    """Return the folder where it holds captures that can be imported or guessed; else those inside
    it that do, up to a depth."""
    inside = list_folders(folder)[1:]
    if any(entry.suffix.lower() == ".toml" for entry in visible(folder)) or any(
        len(images_by_name(each)) >= 3
        or any(known.recognises(each) for known in layouts().values())
        for each in inside
    ):
        return [folder]
    return [each for inner in inside if depth for each in _list_sources(inner, depth - 1)]


def find_description(source: Path) -> Path | None:
    """The TOML in a folder; None where there is none. Raises InputError where there are several."""
    descriptions = sorted(
        entry for entry in visible(Path(source)) if entry.suffix.lower() == ".toml"
    )
    if len(descriptions) > 1:
        raise InputError(
            f"{source} holds {' and '.join(file.name for file in descriptions)}",
            "keep one description",
        )
    return descriptions[0] if descriptions else None
