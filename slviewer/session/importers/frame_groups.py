"""The entries of a `frames` TOML: what each image shows, and which files they are."""

from collections.abc import Mapping
from dataclasses import dataclass
from fnmatch import translate
from pathlib import Path
from re import compile as pattern_of
from typing import Annotated, Any

import msgspec

from slviewer.errors import InputError
from slviewer.fringe.sequence import Axis, Frame, Kind
from slviewer.session.importers.images import IMAGE_SUFFIXES
from slviewer.session.importers.imported import visible
from slviewer.session.names import join_names, natural_key

_Exposure = Annotated[float, msgspec.Meta(gt=0)] | None


class _Group(msgspec.Struct, tag_field="kind", forbid_unknown_fields=True, kw_only=True):
    """The entries of a `[[frames]]` table, of every kind; `files` are checked by `_file_names`."""

    axis: Axis | None = None
    files: Any = None
    exposure_ms: _Exposure = None

    def frames(self) -> list[Frame]:
        """Return the frames that the group's images show: one, unless the kind defines several."""
        return [Frame(self.__struct_config__.tag, self.axis)]  # type: ignore[arg-type]


class _Phase(_Group, tag="phase"):
    """Phase-shifted fringes of one or several periods, ``steps`` images each."""

    steps: Annotated[int, msgspec.Meta(ge=3, le=1000)]
    period_px: Annotated[float, msgspec.Meta(gt=0)] | list[Annotated[float, msgspec.Meta(gt=0)]]

    def frames(self) -> list[Frame]:
        """Return the phase steps of all periods, period by period."""
        periods = self.period_px if isinstance(self.period_px, list) else [self.period_px]
        return [
            Frame("phase", self.axis, step=k, steps=self.steps, period_px=float(period))
            for period in periods
            for k in range(self.steps)
        ]


class _Gray(_Group, tag="gray"):
    """Images of a Gray code's bits, optionally with inverse and complementary ones."""

    bits: Annotated[int, msgspec.Meta(ge=1, le=30)]
    inverse: bool = False
    complementary: bool = False
    msb_first: bool = True

    def frames(self) -> list[Frame]:
        """Return the frames of the bits in their order, each followed by its inverse if there is
        one."""
        pairs = range(self.bits) if self.msb_first else reversed(range(self.bits))
        kinds: tuple[Kind, ...] = ("gray", "inverse") if self.inverse else ("gray",)
        frames = [
            Frame(kind, self.axis, bit=bit, bits=self.bits) for bit in pairs for kind in kinds
        ]
        extra = [Frame("complementary", self.axis)] if self.complementary else []
        return frames + extra if self.msb_first else extra + frames


class _Inverse(_Group, tag="inverse"):
    """Inverse images of a Gray code's bits, listed apart from the bits."""

    bits: Annotated[int, msgspec.Meta(ge=1, le=30)]
    msb_first: bool = True

    def frames(self) -> list[Frame]:
        """Return the inverse frames in the order of the bits."""
        bits = range(self.bits) if self.msb_first else reversed(range(self.bits))
        return [Frame("inverse", self.axis, bit=bit, bits=self.bits) for bit in bits]


class _Complementary(_Group, tag="complementary"):
    """Group of the complementary Gray code image."""


class _White(_Group, tag="white"):
    """Group of the white image."""


class _Black(_Group, tag="black"):
    """Group of the black image."""


class _Texture(_Group, tag="texture"):
    """The image of the scene's texture."""


_AnyGroup = _Phase | _Gray | _Inverse | _Complementary | _White | _Black | _Texture


@dataclass(frozen=True)
class FrameGroup:
    """One or more images that follow each other: the frames that they show, and how their files are
    named.

    `files`: names relative to the capture's folder, or patterns in which * and ? are wildcards and
    all else, brackets too, is literal. A single pattern stands for all frames of the group, in
    natural order of the names. None: the TOML orders the files by name.
    """

    where: str
    frames: tuple[Frame, ...]
    files: tuple[str, ...] | None
    exposure_ms: float | None

    def select(self, folder: Path) -> list[Path]:
        """The group's files in a capture's folder, in order; fewer or more than its frames where
        some are missing."""
        assert self.files is not None
        if len(self.files) == 1 and has_wildcard(self.files[0]):
            return match_files(folder, self.files[0])
        files: list[Path] = []
        for name in self.files:
            if not has_wildcard(name):
                files += [folder / name] if (folder / name).is_file() else []
                continue
            matches = match_files(folder, name)
            if len(matches) > 1:
                names = join_names([file.name for file in matches])
                raise InputError(f'{self.where}: "{name}" matches {names}: name one file')
            files += matches
        return files


def read_groups(name: str, data: Mapping[str, Any]) -> tuple[FrameGroup, ...]:
    """The `[[frame]]` or the `[[frames]]` tables of the TOML `name`. Raises InputError, saying
    which is wrong."""
    single, groups = data.get("frame"), data.get("frames")
    if single is not None and groups is not None:
        raise InputError(
            f"{name} has [[frame]] and [[frames]] tables, and so no order: use one of the two"
        )
    ordered = data.get("order")
    if ordered not in (None, "name"):
        raise InputError(f'{name}: order is {ordered!r}: use "name", or give each entry its files')
    key, entries, read = (
        ("frames", groups, _read_group) if single is None else ("frame", single, _read_frame)
    )
    if not isinstance(entries, list) or not entries:
        raise InputError(
            f"{name} names no frames: add a [[frame]] table for each image, or [[frames]] for"
            " several"
        )
    parsed = []
    for number, entry in enumerate(entries, 1):
        where = f"{name}, [[{key}]] {number}"
        if not isinstance(entry, Mapping):
            raise InputError(f"{where} is not a table: write [[{key}]] above its entries")
        parsed.append(read(where, entry, ordered is not None))
    return tuple(parsed)


def has_wildcard(name: str) -> bool:
    """Return whether a name contains the wildcards * or ?."""
    return "*" in name or "?" in name


def match_files(folder: Path, pattern: str) -> list[Path]:
    """The images in a folder, or in the inner folder that the pattern names, whose name matches, in
    natural order."""
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
    """Read a `[[frame]]` table: one image."""
    if "files" in entry:
        raise InputError(
            f"{where}: files belongs to [[frames]]: name the one file of a [[frame]] with file"
        )
    files = _file_names(where, entry.get("file"), ordered)
    where = f"{where} ({files[0]})" if files else where
    for key in ("kind", "axis"):
        if not isinstance(entry.get(key, ""), str):
            raise InputError(f"{where}: {key} must be a word in quotes, not {entry[key]!r}")
    try:
        exposure: float | None = msgspec.convert(entry.get("exposure_ms"), _Exposure)
        frame = Frame.from_dict(
            {key: value for key, value in entry.items() if key != "exposure_ms"}
        )
    except msgspec.ValidationError as error:
        raise InputError(f"{where}: exposure_ms: {error}") from error
    except InputError as error:
        raise InputError(f"{where}: {error}") from error
    return FrameGroup(where, (frame,), files, exposure)


def _read_group(where: str, entry: Mapping[str, Any], ordered: bool) -> FrameGroup:
    """Read a `[[frames]]` table: all images of one kind and axis."""
    words = " ".join(str(entry[key]) for key in ("kind", "axis") if key in entry)
    where = f"{where} ({words})" if words else where
    try:
        group: _Group = msgspec.convert(entry, _AnyGroup)
        frames = tuple(group.frames())
    except (msgspec.ValidationError, InputError) as error:
        raise InputError(f"{where}: {error}") from error
    files = _file_names(where, group.files, ordered)
    if (
        files is not None
        and not (len(files) == 1 and has_wildcard(files[0]))
        and len(files) != len(frames)
    ):
        raise InputError(
            f"{where} names {len(files)} files and describes {len(frames)} images: correct one of"
            " them"
        )
    return FrameGroup(where, frames, files, group.exposure_ms)


def _file_names(where: str, named: Any, ordered: bool) -> tuple[str, ...] | None:
    """Return the checked file names of a group; None where the order of names determines them."""
    if ordered:
        if named is not None:
            raise InputError(
                f'{where} names files, and order = "name" takes them in order of their names:'
                " use one"
            )
        return None
    names = [named] if isinstance(named, str) else named
    if (
        not isinstance(names, list)
        or not names
        or not all(isinstance(name, str) and name for name in names)
    ):
        raise InputError(
            f'{where} names no file: add its name in quotes, or order = "name" at the top'
        )
    if outside := [name for name in names if Path(name).is_absolute() or ".." in Path(name).parts]:
        raise InputError(
            f'{where}: "{outside[0]}" lies outside of the capture\'s folder: name files inside it'
        )
    return tuple(names)
