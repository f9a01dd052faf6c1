"""The frames that SLStudio writes: `frameSeq_NN.bmp`, in the order of one of its codecs.

All codecs show (1 + cos(2 pi u / pitch - 2 pi k / n)) / 2 in step k of n, u counted from 0 at the
first column, and along both axes first the columns, then the rows:

- 2x3 (also the calibration's): 3 steps at a sixteenth of the projector, then 3 at the whole of it;
- nstep: 9 steps at an eighth, then 3 at the whole;
- 3 (also FastWrap) and 4: so many steps at the whole projector;
- gray: white, black, the 10 most significant bits of the columns' Gray code, the 6 most significant
  of the rows'.

With the diamond pattern SLStudio counts twice as many columns: give the projector's size so.
Source: github.com/jakobwilm/slstudio, src/codec.
"""

import re
from math import ceil, log2
from pathlib import Path
from typing import Literal, get_args

from slviewer.errors import InputError
from slviewer.fringe.presets import AXES, gray_bits, phase_steps
from slviewer.fringe.sequence import Axis, Frame, PatternSequence, PerAxis
from slviewer.session.importers.imported import (
    ImportableRecording,
    check_complete,
    define_layout,
    has_images,
    match_images,
    unknown_files_warning,
)
from slviewer.session.names import join_names

Codec = Literal["2x3", "nstep", "3", "4", "gray"]
_FILE = re.compile(r"frameSeq_(\d+)", re.IGNORECASE)
_STEPS: dict[Codec, tuple[tuple[int, int], ...]] = {
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


def _describe(
    folder: Path,
    name: str,
    projector: tuple[int, int],
    codec: Codec | None = None,
    axis: Axis = "x",
) -> tuple[ImportableRecording, list[str]]:
    """The recording of one folder. Without ``codec`` the number of frames determines it, where that
    is enough; ``axis`` is the one that a codec along a single axis showed.

    Raises InputError where the frames are not those of the codec.
    """
    images, others = match_images(folder, _FILE)
    check_complete(images, "frameSeq_")
    sequence = _identify_sequence(projector, len(images), codec, axis)
    return ImportableRecording(
        name, sequence, tuple(images.values()), folder
    ), unknown_files_warning(folder, others)


def _identify_sequence(
    projector: tuple[int, int], images: int, codec: Codec | None, axis: Axis
) -> PatternSequence:
    """Return the sequence that explains the number of images; InputError where none or several
    do."""
    if codec is None and images in _OTHERS:
        raise InputError(
            f"{images} frames may also be those of {_OTHERS[images]}, which cannot be imported: say"
            " with --codec what was shown"
        )
    candidates = [
        (each, axes)
        for each in get_args(Codec)
        for axes in ([(axis,)] if each in _SINGLE_AXIS else [(axis,), AXES])
        if codec in (None, each) and len(_list_frames(each, projector, axes)) == images
    ]
    if not candidates:
        what = f"codec {codec}" if codec else "any codec"
        raise InputError(
            f"it holds {images} frames, which {what} does not show: choose another --codec, or use"
            " a TOML"
        )
    if len(candidates) > 1:
        shown = join_names([f"{each} along {' and '.join(axes)}" for each, axes in candidates])
        raise InputError(f"{images} frames may be {shown}: choose with --codec")
    sequence, axes = candidates[0]
    cells: PerAxis[float | None] | None = (
        PerAxis(*(_gray_cell(each, projector) for each in AXES)) if sequence == "gray" else None
    )
    return PatternSequence(
        projector, _list_frames(sequence, projector, axes), phase_sign=-1, gray_cell_px=cells
    )


def _list_frames(
    codec: Codec, projector: tuple[int, int], axes: tuple[Axis, ...]
) -> tuple[Frame, ...]:
    """Return the frames of a codec in the order in which SLStudio shows them."""
    frames = [Frame("white"), Frame("black")] if codec == "gray" else []
    for axis in axes:
        extent = projector[AXES.index(axis)]
        if codec == "gray":
            frames += gray_bits(axis, _SHOWN_BITS[axis])
        for steps, periods in _STEPS.get(codec, ()):
            frames += phase_steps(axis, steps, extent / periods)
    return tuple(frames)


def _gray_cell(axis: Axis, projector: tuple[int, int]) -> float:
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


LAYOUT = define_layout(
    "slstudio",
    "frameSeq_NN images",
    _describe,
    lambda folder: has_images(folder, _FILE),
    needs_projector="the fringes of SLStudio",
)
