"""The p18 layout: `pose_XX/{V,H}/P18_FNN.PNG`.

F00-F17 are 18 phase steps at a period of 18 px, F18-F24 seven Gray bits, most significant first,
F25 or F26 the texture. V varies along projector columns (axis x), H along rows (axis y). Capitals
and suffixes vary.
"""

import re
from pathlib import Path

from slviewer.errors import InputError
from slviewer.fringe.presets import gray_bits, phase_steps
from slviewer.fringe.sequence import Axis, Frame, PatternSequence
from slviewer.session.importers.images import read_image
from slviewer.session.importers.imported import (
    ImportableRecording,
    check_complete,
    define_layout,
    match_images,
    unknown_files_warning,
    visible,
)
from slviewer.session.names import join_names

_STEPS, _PERIOD_PX, _BITS = 18, 18.0, 7
_CODED = _STEPS + _BITS
_REACH_PX = 2**_BITS * _PERIOD_PX
_TEXTURES = (_CODED, _CODED + 1)
_AXES: dict[str, Axis] = {"v": "x", "h": "y"}
_FILE = re.compile(r"p18_f(\d+)", re.IGNORECASE)


def _describe(
    pose: Path, name: str, projector: tuple[int, int]
) -> tuple[ImportableRecording, list[str]]:
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
                f"{_BITS} Gray bits of {_PERIOD_PX:g} px reach {_REACH_PX:g} px, and the projector"
                f" has {extent} along {axis}: give the size of the projector that was used, or"
                " describe the frames in a TOML"
            )
        try:
            images, others = match_images(folder, _FILE)
            check_complete(images, "P18_F", _CODED)
        except InputError as error:
            raise InputError(f"folder {folder.name}: {error}") from error
        if extra := [file.name for (number,), file in images.items() if number > max(_TEXTURES)]:
            raise InputError(
                f"folder {folder.name} holds {join_names(extra)}, beyond the p18 layout's F00 to"
                " F26: move them away, or describe the frames in a TOML"
            )
        warnings += unknown_files_warning(folder, others)
        files += list(images.values())[:_CODED]
        frames += phase_steps(axis, _STEPS, _PERIOD_PX) + gray_bits(axis, _BITS)
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
    if len({entry.name.lower() for entry in there}) < len(there):
        raise InputError(
            f"it holds {join_names(sorted(entry.name for entry in there))}: keep one folder an axis"
        )
    return sorted(
        ((entry, _AXES[entry.name.lower()]) for entry in there),
        key=lambda folder_axis: folder_axis[1],
    )


def _is_capture(folder: Path) -> bool:
    """Return whether a folder has an inner folder of an axis with images in it."""
    return any(
        entry.is_dir()
        and entry.name.lower() in _AXES
        and any(_FILE.match(file.stem) for file in visible(entry))
        for entry in visible(folder)
    )


LAYOUT = define_layout("p18", "pose_XX/{V,H}/P18_FNN images", _describe, _is_capture, (912, 1140))
