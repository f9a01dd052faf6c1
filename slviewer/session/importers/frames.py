"""Any folder of images, with a TOML that says what each of them shows.

```toml
projector = "912x1140"   # width x height, px
phase_sign = 1           # optional, like the next: step k of n shows cos(phi + phase_sign 2 pi k / n + phase_offset)
phase_offset = 0.0       # rad; this and the others may differ by axis: {x = 0.0, y = 1.57}
gray_origin = -0.5       # projector px at which Gray code 0 begins
gray_cell_px = 18.0      # width of the cells that the Gray bits number; by default the longest period, or 1 px without
relative = false         # true: steps alone whose periods do not cover the projector; the phase is not absolute

[[frame]]
file = "00.png"          # relative to the capture's folder
kind = "phase"           # phase, gray, inverse, complementary, white, black, texture
axis = "x"               # x varies along projector columns, y along rows; none for white, black, texture
step = 0                 # phase: step of steps, at a period in projector px
steps = 4
period_px = 18.0

[[frame]]
file = "04.png"
kind = "gray"            # inverse: the negative of the same bit
axis = "x"
bit = 0                  # 0 = most significant
bits = 7
```
"""

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from slviewer.errors import InputError
from slviewer.fringe.sequence import SEQUENCE_KEYS, Frame, PatternSequence, parse_size
from slviewer.session.importers.images import IMAGE_SUFFIXES
from slviewer.session.importers.imported import (
    Imports,
    Recording,
    collect_captures,
    listed,
    strangers_warning,
    visible,
)


def read(source: Path, toml: Path, *, prefix: str | None = None, projector: tuple[int, int] | None = None) -> Imports:
    """Captures named after their folders, all described by the one TOML.

    `projector` is for a TOML that does not say the size. A capture's settings say under `gray_origin_given` whether
    the TOML did: where not, the sequence carries the default, and the origin is better estimated from the phase.
    Raises InputError for a TOML that is damaged, incomplete or contradicts itself, and for files that are missing.
    """
    sequence, names, given = read_sequence(toml, projector)

    def is_capture(folder: Path) -> bool:
        return any((folder / name).is_file() for name in names)

    def describe(folder: Path, name: str) -> tuple[Recording, list[str]]:
        files = tuple(folder / name for name in names)
        if missing := [name for name, file in zip(names, files, strict=True) if not file.is_file()]:
            raise InputError(f"it lacks {listed(missing)}, which {Path(toml).name} names: add them")
        strangers = [entry for entry in visible(folder) if entry.suffix.lower() in IMAGE_SUFFIXES]
        recording = Recording(name, sequence, files, folder, {"gray_origin_given": given})
        return recording, strangers_warning(folder, sorted(set(strangers) - set(files)))

    looks_like = f"{names[0]} and the other files of {Path(toml).name}"
    return collect_captures(Path(source), prefix, is_capture, looks_like, describe)


def read_sequence(
    toml: Path, projector: tuple[int, int] | None = None
) -> tuple[PatternSequence, tuple[str, ...], bool]:
    """The sequence that a TOML describes, each frame's file, and whether the TOML says where Gray code 0 begins."""
    toml = Path(toml)
    try:
        with open(toml, "rb") as file:
            data = tomllib.load(file)
    except OSError as error:
        raise InputError(
            f"{toml} cannot be read ({error.strerror}): give the TOML that describes the frames"
        ) from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"{toml.name} is not TOML ({error}): mend it there") from error
    if unknown := sorted(set(data) - set(SEQUENCE_KEYS)):
        raise InputError(f"{toml.name} has the unknown entry '{unknown[0]}': use {', '.join(sorted(SEQUENCE_KEYS))}")
    _check_projector(toml, data, projector)
    frames = data.get("frame")
    if not isinstance(frames, list) or not frames:
        raise InputError(f"{toml.name} names no frames: add a [[frame]] table for each image")
    names = tuple(_checked(toml, number, frame) for number, frame in enumerate(frames, 1))
    size = {"projector": projector} if projector else {}
    try:
        return PatternSequence.from_dict({**data, **size}), names, "gray_origin" in data
    except InputError as error:
        raise InputError(f"{toml.name}: {error}") from error


def _checked(toml: Path, number: int, frame: Any) -> str:
    """The file of one `[[frame]]`; InputError, saying which, for one that is not understood."""
    where = f"{toml.name}, [[frame]] {number}"
    if not isinstance(frame, Mapping):
        raise InputError(f"{where} is no table: write [[frame]] above its entries")
    name = frame.get("file")
    if not isinstance(name, str) or not name:
        raise InputError(f'{where} names no file: add file = "...", relative to the capture\'s folder')
    for key in ("kind", "axis"):
        if not isinstance(frame.get(key, ""), str):
            raise InputError(f"{where} ({name}): {key} must be a word in quotes, not {frame[key]!r}")
    try:
        Frame.from_dict(frame)
    except InputError as error:
        raise InputError(f"{where} ({name}): {error}") from error
    return name


def _check_projector(toml: Path, data: Mapping[str, Any], projector: tuple[int, int] | None) -> None:
    if "projector" not in data and projector is None:
        raise InputError(
            f'{toml.name} does not say the projector\'s size: add projector = "912x1140", or give --projector'
        )
    if "projector" in data and projector is not None and parse_size(data["projector"]) != tuple(projector):
        raise InputError(
            f"{toml.name} says that the projector is {data['projector']}, and {projector[0]}x{projector[1]} was given: "
            "mend the one that is wrong"
        )
