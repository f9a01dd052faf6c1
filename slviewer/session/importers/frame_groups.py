"""The entries of a `frames` TOML: what each image shows, and which files they are."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fnmatch import translate
from pathlib import Path
from re import compile as pattern_of
from typing import Any

from slviewer.errors import InputError
from slviewer.fringe.presets import gray_bits
from slviewer.fringe.sequence import Axis, Frame
from slviewer.session.importers.images import IMAGE_SUFFIXES
from slviewer.session.importers.imported import listed, visible
from slviewer.session.names import natural_key

_GROUP_KEYS = {
    "phase": {"steps", "period_px"},
    "gray": {"bits", "inverse", "complementary", "msb_first"},
    "inverse": {"bits", "msb_first"},
    "complementary": set(),
    "white": set(),
    "black": set(),
    "texture": set(),
}
_COMMON_KEYS = {"kind", "axis", "files", "exposure_ms"}
_MOST_BITS = 30


@dataclass(frozen=True)
class FrameGroup:
    """One or more images that follow each other: the frames that they show, and how their files are named.

    `files`: names relative to the capture's folder, or patterns in which * and ? are wildcards and all else, brackets
    too, is literal. A single pattern stands for all frames of the group, in natural order of the names. None: the
    TOML orders the files by name.
    """

    where: str
    frames: tuple[Frame, ...]
    files: tuple[str, ...] | None
    exposure_ms: float | None

    def select(self, folder: Path) -> list[Path]:
        """The group's files in a capture's folder, in order; fewer or more than its frames where some are missing."""
        assert self.files is not None
        if len(self.files) == 1 and has_wildcard(self.files[0]):
            return match_files(folder, self.files[0])
        found: list[Path] = []
        for name in self.files:
            if not has_wildcard(name):
                found += [folder / name] if (folder / name).is_file() else []
                continue
            matches = match_files(folder, name)
            if len(matches) > 1:
                names = listed([file.name for file in matches])
                raise InputError(f'{self.where}: "{name}" matches {names}: name one file')
            found += matches
        return found


def read_groups(name: str, data: Mapping[str, Any]) -> tuple[FrameGroup, ...]:
    """The `[[frame]]` or the `[[frames]]` tables of the TOML `name`. Raises InputError, saying which is wrong."""
    single, groups = data.get("frame"), data.get("frames")
    if single is not None and groups is not None:
        raise InputError(f"{name} has [[frame]] and [[frames]] tables, and so no order: use one of the two")
    ordered = data.get("order")
    if ordered not in (None, "name"):
        raise InputError(f'{name}: order is {ordered!r}: use "name", or give each entry its files')
    key, entries, read = ("frames", groups, _read_group) if single is None else ("frame", single, _read_frame)
    if not isinstance(entries, list) or not entries:
        raise InputError(f"{name} names no frames: add a [[frame]] table for each image, or [[frames]] for several")
    found = []
    for number, entry in enumerate(entries, 1):
        where = f"{name}, [[{key}]] {number}"
        if not isinstance(entry, Mapping):
            raise InputError(f"{where} is no table: write [[{key}]] above its entries")
        found.append(read(where, entry, ordered is not None))
    return tuple(found)


def has_wildcard(name: str) -> bool:
    """Whether * or ? stands for other characters."""
    return "*" in name or "?" in name


def match_files(folder: Path, pattern: str) -> list[Path]:
    """The images in a folder, or in the inner folder that the pattern names, whose name matches, in natural order."""
    *inner, last = pattern.split("/")
    folder = folder.joinpath(*inner)
    if not folder.is_dir():
        return []
    matches = pattern_of(translate(last.replace("[", "[[]"))).match
    return [file for file in images_by_name(folder) if matches(file.name)]


def images_by_name(folder: Path) -> list[Path]:
    """The images of a folder in natural order of their names: 2 before 10."""
    images = [entry for entry in visible(folder) if entry.suffix.lower() in IMAGE_SUFFIXES]
    return sorted(images, key=lambda file: natural_key(file.name))


def _read_frame(where: str, entry: Mapping[str, Any], ordered: bool) -> FrameGroup:
    """A `[[frame]]` table: one image."""
    if "files" in entry:
        raise InputError(f"{where}: files belongs to [[frames]]: name the one file of a [[frame]] with file")
    files = _files(where, {"files": entry["file"]} if "file" in entry else {}, ordered)
    where = f"{where} ({files[0]})" if files else where
    _check_words(where, entry)
    try:
        frame = Frame.from_dict({key: value for key, value in entry.items() if key != "exposure_ms"})
    except InputError as error:
        raise InputError(f"{where}: {error}") from error
    return FrameGroup(where, (frame,), files, _exposure(where, entry))


def _read_group(where: str, entry: Mapping[str, Any], ordered: bool) -> FrameGroup:
    """A `[[frames]]` table: all images of one kind and axis."""
    _check_words(where, entry)
    kind = entry.get("kind")
    if kind not in _GROUP_KEYS:
        raise InputError(f"{where} has the kind {kind!r}: use one of {', '.join(_GROUP_KEYS)}")
    where = f"{where} ({' '.join(entry[key] for key in ('kind', 'axis') if key in entry)})"
    if unknown := sorted(set(entry) - _GROUP_KEYS[kind] - _COMMON_KEYS):
        raise InputError(f"{where} has the unknown entry '{unknown[0]}': use {', '.join(_group_keys(kind))}")
    try:
        frames = _group_frames(kind, entry)
    except InputError as error:
        raise InputError(f"{where}: {error}") from error
    files = _files(where, entry, ordered)
    if files is not None and not (len(files) == 1 and has_wildcard(files[0])) and len(files) != len(frames):
        raise InputError(f"{where} names {len(files)} files and describes {len(frames)} images: correct one of them")
    return FrameGroup(where, tuple(frames), files, _exposure(where, entry))


def _group_frames(kind: str, entry: Mapping[str, Any]) -> list[Frame]:
    axis: Axis | None = entry.get("axis")
    if kind == "phase":
        periods = entry.get("period_px")
        periods = periods if isinstance(periods, list) else [periods]
        steps = _count(entry, "steps", 3)
        return [
            Frame("phase", axis, step=k, steps=steps, period_px=_number(period, "period_px"))
            for period in periods
            for k in range(steps)
        ]
    if kind not in ("gray", "inverse"):
        return [Frame(kind, axis)]  # type: ignore[arg-type]
    bits = _count(entry, "bits", 1)
    frames: list[Frame] = []
    for bit in gray_bits(axis, bits):  # type: ignore[arg-type]
        negative = Frame("inverse", axis, bit=bit.bit, bits=bits)
        frames += [negative] if kind == "inverse" else [bit, negative] if _flag(entry, "inverse") else [bit]
    if _flag(entry, "complementary"):
        frames.append(Frame("complementary", axis))
    if _flag(entry, "msb_first", True):
        return frames
    return sorted(frames, key=lambda frame: bits if frame.kind == "complementary" else frame.bit, reverse=True)


def _files(where: str, entry: Mapping[str, Any], ordered: bool) -> tuple[str, ...] | None:
    named = entry.get("files")
    if ordered:
        if named is not None:
            raise InputError(f'{where} names files, and order = "name" takes them in order of their names: use one')
        return None
    names = [named] if isinstance(named, str) else named
    if not isinstance(names, list) or not names or not all(isinstance(name, str) and name for name in names):
        raise InputError(f'{where} names no file: add its name in quotes, or order = "name" at the top')
    if outside := [name for name in names if Path(name).is_absolute() or ".." in Path(name).parts]:
        raise InputError(f'{where}: "{outside[0]}" lies outside of the capture\'s folder: name files inside it')
    return tuple(names)


def _check_words(where: str, entry: Mapping[str, Any]) -> None:
    for key in ("kind", "axis"):
        if not isinstance(entry.get(key, ""), str):
            raise InputError(f"{where}: {key} must be a word in quotes, not {entry[key]!r}")


def _exposure(where: str, entry: Mapping[str, Any]) -> float | None:
    try:
        return _number(entry["exposure_ms"], "exposure_ms") if "exposure_ms" in entry else None
    except InputError as error:
        raise InputError(f"{where}: {error}") from error


def _number(value: Any, name: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not value > 0:
        raise InputError(f"{name} is {value!r}: give a number above 0")
    return float(value)


def _count(entry: Mapping[str, Any], name: str, least: int) -> int:
    value = entry.get(name)
    if isinstance(value, bool) or not isinstance(value, int) or not least <= value <= 1000:
        raise InputError(f"{name} is {value!r}: give a whole number from {least}")
    if name == "bits" and value > _MOST_BITS:
        raise InputError(f"bits is {value}: no projector has so many columns")
    return value


def _flag(entry: Mapping[str, Any], name: str, default: bool = False) -> bool:
    value = entry.get(name, default)
    if not isinstance(value, bool):
        raise InputError(f"{name} is {value!r}: use true or false")
    return value


def _group_keys(kind: str) -> Sequence[str]:
    return sorted(_GROUP_KEYS[kind] | _COMMON_KEYS)
