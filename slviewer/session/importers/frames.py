"""Any folder of images, with a TOML that says what each of them shows.

```toml
projector = "912x1140"   # width x height, px; not needed where only the phase is wanted
phase_sign = 1           # optional, like the next: step k of n shows
                         # cos(phi + phase_sign 2 pi k / n + phase_offset)
phase_offset = 0.0       # rad; this and the others may differ by axis: {x = 0.0, y = 1.57}
gray_origin = -0.5       # projector px at which Gray code 0 begins
gray_cell_px = 18.0      # width of the cells that the Gray bits number; by default the longest
                         # period, or 1 px without
relative = false         # true: steps alone whose periods do not cover the projector; the
                         # phase is not absolute
code = "gray"            # "binary": the bits are plain binary numbers (beside phase steps they are
                         # stored as Gray code)
full_scale = 4095        # grey level at which a camera of more than 8 bits clips; by default as
                         # the files state it
channel = "green"        # of colour images: red, green (the default), blue, luma or max

[[frame]]                # one image
file = "00.png"          # relative to the capture's folder; * and ? are wildcards, brackets are
                         # plain characters
kind = "phase"           # phase, gray, inverse, complementary, white, black, texture; binary: a
                         # bit of code = "binary"
axis = "x"               # x varies along projector columns, y along rows; none for white,
                         # black, texture
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

A long sequence is shorter in groups, `[[frames]]` in place of `[[frame]]`. The files of a group are
one pattern, in natural order of the names (2 before 10, and what counts in hexadecimal, in letters,
or on from a camera's 9999, as it counts), or a list. With `order = "name"` at the top no entry
names files: all images of a folder are taken in natural order of their names. The images in a TIFF
of several count as files where it is the only image of the folder, or the only one that a pattern
matches.

```toml
projector = "1280x800"

[[frames]]
kind = "phase"
axis = "x"
steps = 4                # 4 images, in order of the steps
period_px = 20.0         # or a list: all steps of the first period, then of the second ...;
                         # "912/70": 70 fringes across 912 px, which decimals would round
files = "fringe_*.png"

[[frames]]
kind = "gray"            # or inverse: the negatives alone
axis = "x"
bits = 6                 # 13 images here
inverse = true           # each bit is followed by its negative
complementary = true     # the last image is the complementary bit, which `bits` does not count
msb_first = true         # the default; false: the finest stripes come first
files = "*_[00-*]_img.jpg"

[[frames]]
kind = "white"           # one image; so are black, texture, complementary
files = "white.png"
```

A sequence that was taken in several exposures names them: each entry has `exposure_ms`, and every
exposure has the same frames. They become one capture, in which each pixel comes from the longest
exposure that did not saturate it.

Of two cameras each entry says which one its files are of, `camera = "left"` or `camera = "right"`:
all that the one saw, and the same frames of the other. Pixels of clouds are those of the left one.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path
from typing import Annotated, Any, get_args

import msgspec

from slviewer.errors import InputError
from slviewer.fringe.sequence import (
    KINDS,
    SEQUENCE_KEYS,
    Axis,
    Frame,
    Kind,
    PatternSequence,
    Size,
    parse_size,
)
from slviewer.session.importers.images import Channel, file_of
from slviewer.session.importers.imported import (
    FolderLayout,
    ImportableRecording,
    Imports,
    collect_captures,
    has_wildcard,
    images_by_name,
    match_files,
)
from slviewer.session.names import join_names
from slviewer.session.reading import read_toml

_KEYS = {*SEQUENCE_KEYS, "frames", "order", "channel"}
CAMERAS = ("left", "right")
"""What an entry's ``camera`` says of which of two its files are; the left is the first."""


_Period = Annotated[float, msgspec.Meta(gt=0)]
_Exposure = _Period | None


class _Group(msgspec.Struct, forbid_unknown_fields=True, kw_only=True):
    """The entries of a `[[frames]]` table; `files` are checked by `_file_names`."""

    kind: Kind
    axis: Axis | None = None
    files: Any = None
    exposure_ms: _Exposure = None

    def frames(self) -> list[Frame]:
        """Return the frames that the group's images show: one, unless the kind defines several."""
        return [Frame(self.kind, self.axis)]


class _Phase(_Group):
    """Phase-shifted fringes of one or several periods, ``steps`` images each."""

    steps: Annotated[int, msgspec.Meta(ge=3, le=1000)]
    period_px: _Period | str | list[_Period | str]

    def frames(self) -> list[Frame]:
        """Return the phase steps of all periods, period by period."""
        periods = self.period_px if isinstance(self.period_px, list) else [self.period_px]
        return [
            Frame("phase", self.axis, step=k, steps=self.steps, period_px=_to_px(period))
            for period in periods
            for k in range(self.steps)
        ]


def _to_px(period: float | str) -> float:
    """Return a period as a number; "912/70" states 70 fringes across 912 px."""
    try:
        if isinstance(period, str) and "/" not in period:
            raise ValueError
        return float(Fraction(period))
    except (ValueError, ZeroDivisionError, OverflowError):
        raise InputError(
            f"period_px {period!r} (str) is neither a number nor a ratio",
            'write px, such as 18.0, or a projector\'s size by its fringes, such as "912/70"',
        ) from None


class _Inverse(_Group):
    """Inverse images of a Gray code's bits, listed apart from the bits."""

    bits: Annotated[int, msgspec.Meta(ge=1, le=30)]
    msb_first: bool = True

    def frames(self) -> list[Frame]:
        """Return the frames in the order of the bits."""
        return self.list_bits("inverse")

    def list_bits(self, *kinds: Kind) -> list[Frame]:
        """Return the frames of these kinds of each bit, in the order of the bits."""
        bits = range(self.bits) if self.msb_first else reversed(range(self.bits))
        return [Frame(kind, self.axis, bit=bit, bits=self.bits) for bit in bits for kind in kinds]


class _Gray(_Inverse):
    """Images of a Gray code's bits, optionally with inverse and complementary ones."""

    inverse: bool = False
    complementary: bool = False

    def frames(self) -> list[Frame]:
        """Return the frames of the bits in their order, each followed by its inverse if there is
        one."""
        frames = self.list_bits("gray", "inverse") if self.inverse else self.list_bits("gray")
        extra = [Frame("complementary", self.axis)] if self.complementary else []
        return frames + extra if self.msb_first else extra + frames


_GROUPS: dict[str, type[_Group]] = {"phase": _Phase, "gray": _Gray, "inverse": _Inverse}
"""Kinds of groups with entries of their own."""


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
                raise InputError(f'{self.where}: "{name}" matches {names}', "name one file")
            files += matches
        return files


def read_groups(name: str, data: Mapping[str, Any]) -> tuple[FrameGroup, ...]:
    """The `[[frame]]` or the `[[frames]]` tables of the TOML `name`. Raises InputError, saying
    which is wrong."""
    single, groups = data.get("frame"), data.get("frames")
    if single is not None and groups is not None:
        raise InputError(
            f"{name} has [[frame]] and [[frames]] tables, and so no order", "use one of the two"
        )
    ordered = data.get("order")
    if ordered not in (None, "name"):
        raise InputError(
            f"{name}: order is {ordered!r}", 'use "name", or give each entry its files'
        )
    key, entries, read = (
        ("frames", groups, _read_group) if single is None else ("frame", single, _read_frame)
    )
    if not isinstance(entries, list) or not entries:
        raise InputError(
            f"{name} names no frames",
            "add a [[frame]] table for each image, or [[frames]] for several",
        )
    parsed = []
    for number, entry in enumerate(entries, 1):
        where = f"{name}, [[{key}]] {number}"
        if not isinstance(entry, Mapping):
            raise InputError(f"{where} is not a table", f"write [[{key}]] above its entries")
        parsed.append(read(where, entry, ordered is not None))
    return tuple(parsed)


def _read_frame(where: str, entry: Mapping[str, Any], ordered: bool) -> FrameGroup:
    """Read a `[[frame]]` table: one image."""
    if "files" in entry:
        raise InputError(
            f"{where}: files belongs to [[frames]]", "name the one file of a [[frame]] with file"
        )
    files = _file_names(where, entry.get("file"), ordered)
    where = f"{where} ({files[0]})" if files else where
    for key in ("kind", "axis"):
        if not isinstance(entry.get(key, ""), str):
            raise InputError(f"{where}: {key} must be a word in quotes, not {entry[key]!r}")
    try:
        exposure: float | None = msgspec.convert(entry.get("exposure_ms"), _Exposure)
        fields = {key: value for key, value in entry.items() if key != "exposure_ms"}
        if isinstance(period := fields.get("period_px"), str):
            fields["period_px"] = _to_px(period)
        frame = Frame.from_dict(fields)
    except msgspec.ValidationError as error:
        raise InputError(f"{where}: exposure_ms: {error}") from error
    except InputError as error:
        raise error.within(where) from error
    return FrameGroup(where, (frame,), files, exposure)


def _read_group(where: str, entry: Mapping[str, Any], ordered: bool) -> FrameGroup:
    """Read a `[[frames]]` table: all images of one kind and axis."""
    words = " ".join(str(entry[key]) for key in ("kind", "axis") if key in entry)
    where = f"{where} ({words})" if words else where
    if isinstance(kind := entry.get("kind"), str) and kind not in get_args(Kind):
        raise InputError(f"{where}: frame kind {kind!r} is unknown", f"use one of {KINDS}")
    try:
        group = msgspec.convert(entry, _GROUPS.get(str(entry.get("kind")), _Group))
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
            f"{where} names {len(files)} files and describes {len(frames)} images",
            "correct one of them",
        )
    return FrameGroup(where, frames, files, group.exposure_ms)


def _file_names(where: str, named: Any, ordered: bool) -> tuple[str, ...] | None:
    """Return the checked file names of a group; None where the order of names determines them."""
    if ordered:
        if named is not None:
            raise InputError(
                f'{where} names files, and order = "name" takes them in order of their names',
                "use one",
            )
        return None
    names = [named] if isinstance(named, str) else named
    if (
        not isinstance(names, list)
        or not names
        or not all(isinstance(name, str) and name for name in names)
    ):
        raise InputError(
            f"{where} names no file", 'add its name in quotes, or order = "name" at the top'
        )
    if outside := [name for name in names if Path(name).is_absolute() or ".." in Path(name).parts]:
        raise InputError(
            f'{where}: "{outside[0]}" lies outside of the capture\'s folder', "name files inside it"
        )
    return tuple(names)


@dataclass(frozen=True)
class Description:
    """The content of a TOML that describes every capture of a source.

    `files_order`: index of each stack frame's file among the files of all groups.
    `gray_origin_given`: whether the TOML states where Gray code 0 begins. `second`: what the
    entries of the right one of two cameras describe.
    """

    sequence: PatternSequence
    groups: tuple[FrameGroup, ...]
    files_order: tuple[int, ...]
    exposures_ms: tuple[float, ...]
    channel: Channel | None
    gray_origin_given: bool
    second: "Description | None" = None

    def select_files(self, folder: Path) -> tuple[Path, ...]:
        """Return the files of one capture in the order of its stack; InputError names missing or
        surplus files."""
        if self.groups[0].files is None:
            matched, count = images_by_name(folder), len(self.files_order)
            if len(matched) != count:
                raise InputError(
                    f"it holds {len(matched)} images, and {count} are described",
                    "add or remove images",
                )
        else:
            selected = [group.select(folder) for group in self.groups]
            self._check_selected(selected)
            matched = [file for files in selected for file in files]
            if double := {file.name for file in matched if matched.count(file) > 1}:
                raise InputError(
                    f"{join_names(sorted(double))} would show two patterns",
                    "correct the patterns of the names",
                )
        return tuple(matched[index] for index in self.files_order)

    def _check_selected(self, selected: Sequence[Sequence[Path]]) -> None:
        """Raise InputError, naming the files, where a group has not as many files as frames."""
        missing: list[str] = []
        for group, files in zip(self.groups, selected, strict=True):
            assert group.files is not None
            if len(files) == len(group.frames):
                continue
            if len(group.files) == 1 and has_wildcard(group.files[0]):
                raise InputError(
                    f'{len(files)} files match "{group.files[0]}", and {group.where} describes'
                    f" {len(group.frames)} images",
                    "add what is missing, or correct the pattern",
                )
            names = {file.name for file in files}
            missing += [
                name for name in group.files if has_wildcard(name) or Path(name).name not in names
            ]
        if missing:
            raise InputError(f"it lacks {join_names(missing)}, which the TOML names", "add them")

    def is_capture(self, folder: Path) -> bool:
        """Return whether a folder holds a named file, or more than half of a capture's images."""
        if self.groups[0].files is None:
            return 2 * len(images_by_name(folder)) > len(self.files_order)
        names = [
            name for group in self.groups for name in group.files or () if not has_wildcard(name)
        ]
        if any((folder / name).is_file() for name in names):
            return True
        return 2 * sum(len(group.select(folder)) for group in self.groups) > len(self.files_order)


def _read(
    source: Path, toml: Path, *, prefix: str | None = None, projector: Size | None = None
) -> Imports:
    """Captures named after their folders, all described by the one TOML.

    `projector` is for a TOML that does not say the size. A capture's settings say under
    `gray_origin_given` whether the TOML did: where not, the sequence carries the default, and the
    origin is better estimated from the phase. Raises InputError for a TOML that is damaged,
    incomplete or contradicts itself, and where no capture can be used.
    """
    described = read_description(toml, projector)

    def describe(folder: Path, name: str) -> tuple[ImportableRecording, list[str]]:
        """Return the recording of a folder, and warnings about files that the TOML does not
        mention."""
        files = described.select_files(folder)
        settings: dict[str, Any] = {"gray_origin_given": described.gray_origin_given}
        exposures = described.exposures_ms
        if len(exposures) == 1:
            settings["exposure_ms"], exposures = exposures[0], ()
        recording = ImportableRecording(
            name, described.sequence, files, folder, settings, described.channel, exposures
        )
        if described.second is not None:
            files = described.second.select_files(folder)
            recording = replace(recording, second=replace(recording, files=files))
            files += recording.files
        unknown = sorted(set(images_by_name(folder)) - set(files) - set(map(file_of, files)))
        return replace(recording, unknown=tuple(unknown)), []

    files = described.groups[0].files
    first = (
        "images in the order of their names" if files is None else f"{files[0]} and the other files"
    )
    looks_like = f"{first} of {Path(toml).name}"
    return collect_captures(Path(source), prefix, described.is_capture, looks_like, describe)


def read_description(toml: Path, projector: Size | None = None) -> Description:
    """What a TOML describes; `projector` is for one that does not state the size. Raises
    InputError."""
    toml = Path(toml)
    data = read_toml(toml)
    if unknown := sorted(set(data) - _KEYS):
        raise InputError(
            f"{toml.name} has the unknown entry '{unknown[0]}'", f"use {', '.join(sorted(_KEYS))}"
        )
    if data.get("channel") not in (None, *get_args(Channel)):
        raise InputError(
            f"{toml.name}: channel is {data['channel']!r}",
            f"use one of {', '.join(get_args(Channel))}",
        )
    if projector and parse_size(data.get("projector", projector)) != tuple(projector):
        raise InputError(
            f"{toml.name} says that the projector is {data['projector']}, and"
            f" {projector[0]}x{projector[1]} was given",
            "correct the one that is wrong",
        )
    left, right = _split_cameras(toml.name, data)
    first = _describe(toml.name, left, projector)
    if right is None:
        return first
    second = _describe(toml.name, right, projector)
    if second.sequence != first.sequence or second.exposures_ms != first.exposures_ms:
        raise InputError(
            f"{toml.name}: the entries of the left and of the right camera describe other frames",
            "both saw the same patterns, in the same order",
        )
    return replace(first, second=second)


def _split_cameras(
    name: str, data: Mapping[str, Any]
) -> tuple[Mapping[str, Any], Mapping[str, Any] | None]:
    """Return the content of a TOML for the left and for the right camera, without the entries
    ``camera``; None for the right one where no entry says so. Raises InputError where only some
    do."""
    key = "frames" if "frames" in data else "frame"
    entries = data.get(key)
    tables = entries if isinstance(entries, list) else []
    named = [each.get("camera") for each in tables if isinstance(each, Mapping)]
    if not any(named):
        return data, None
    for number, camera in enumerate(named, 1):
        if camera not in CAMERAS:
            raise InputError(
                f"{name}, [[{key}]] {number}: camera is {camera!r}",
                'write "left" or "right" in every entry, or in none',
            )
    left, right = (
        {
            **data,
            key: [
                {word: value for word, value in each.items() if word != "camera"}
                for each, named_camera in zip(tables, named, strict=True)
                if named_camera == camera
            ],
        }
        for camera in CAMERAS
    )
    return left, right


def _describe(name: str, data: Mapping[str, Any], projector: Size | None) -> Description:
    """What the entries of one camera in the TOML ``name`` describe."""
    data = _read_code(name, data)
    groups = read_groups(name, data)
    try:
        exposures, order = _list_exposures(groups)
        frames = [frame for group in groups for frame in group.frames]
        shown = [frames[index].to_dict() for index in order[: len(order) // max(1, len(exposures))]]
        size = {"projector": projector} if projector else {}
        sequence = PatternSequence.from_dict({**data, **size, "frame": shown})
    except InputError as error:
        raise error.within(name) from error
    return Description(
        sequence, groups, tuple(order), exposures, data.get("channel"), "gray_origin" in data
    )


def _read_code(name: str, data: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the content of a TOML with the kind "binary" as Gray bits of code = "binary". Raises
    InputError for both codes."""
    key = "frames" if "frames" in data else "frame"
    entries = data.get(key)
    if not isinstance(entries, list):
        return data
    kinds = [each.get("kind") if isinstance(each, Mapping) else None for each in entries]
    if "binary" not in kinds:
        return data
    if "gray" in kinds or data.get("code", "binary") != "binary":
        raise InputError(f"{name} describes both Gray code and binary code", "use one of them")
    shown = [
        {**each, "kind": "gray"} if kind == "binary" else each
        for each, kind in zip(entries, kinds, strict=True)
    ]
    return {**data, "code": "binary", key: shown}


def _list_exposures(groups: Sequence[FrameGroup]) -> tuple[tuple[float, ...], list[int]]:
    """The exposures, none where no entry states one, and the frames' indices, one exposure after
    the other, all in the order of the first."""
    frames = [(frame, group.exposure_ms) for group in groups for frame in group.frames]
    exposures = tuple(dict.fromkeys(exposure for _, exposure in frames if exposure is not None))
    if not exposures:
        return (), list(range(len(frames)))
    if unstated := [frame for frame, exposure in frames if exposure is None]:
        raise InputError(
            f"{len(unstated)} of {len(frames)} images state no exposure_ms",
            "add it to all, or to none",
        )
    shown = [[i for i, (_, ms) in enumerate(frames) if ms == exposure] for exposure in exposures]
    wanted, order = [frames[i][0] for i in shown[0]], list[int]()
    for exposure, indices in zip(exposures, shown, strict=True):
        there = {frames[i][0]: i for i in indices}
        if set(there) != set(wanted) or len(indices) != len(wanted):
            raise InputError(
                f"the exposures of {exposures[0]:g} and {exposure:g} ms show other frames",
                "describe the whole sequence, each frame once, in every exposure",
            )
        order += [there[frame] for frame in wanted]
    return exposures, order


LAYOUT = FolderLayout(
    "frames", "images and a TOML that describes them", _read, lambda folder: False
)
