"""Description of the projected patterns, frame by frame."""

from collections import Counter
from collections.abc import Mapping, Sized
from dataclasses import dataclass, replace
from math import isfinite
from typing import Any, Generic, Literal, NamedTuple, TypeVar, get_args

from msgspec import ValidationError, convert

from slviewer.errors import InputError

Axis = Literal["x", "y"]
Indices = tuple[int, ...]
"""Indices of frames in their sequence, or of images in their stack."""
Size = tuple[int, int]
"""Width and height, px."""
T = TypeVar("T")
Kind = Literal["phase", "gray", "inverse", "complementary", "white", "black", "texture"]

KINDS = ", ".join(get_args(Kind)) + ", or in a TOML binary"
"""In words."""
_FIELDS = {
    "phase": ("axis", "step", "steps", "period_px"),
    "gray": ("axis", "bit", "bits"),
    "inverse": ("axis", "bit", "bits"),
    "complementary": ("axis",),
    "white": (),
    "black": (),
    "texture": (),
}
"""Fields that a frame of each kind must define."""

MAX_STEPS = 1000
MAX_EXTENT = 1 << 16
"""Columns and rows of a projector, px."""
SEQUENCE_KEYS = (
    "projector", "phase_sign", "phase_offset", "gray_origin", "gray_cell_px", "relative", "levels",
    "full_scale", "code", "frame",
)  # fmt: skip
"""The entries of `PatternSequence.to_dict`, and of a `frames` TOML."""


class PerAxis(NamedTuple, Generic[T]):
    """Pair of a value for axis x and one for axis y."""

    x: T
    y: T


@dataclass(frozen=True)
class Frame:
    """One projected image.

    ``phase``: step ``step`` of ``steps`` of a cosine of ``period_px``. ``gray``: bit ``bit`` (0 =
    most significant) of ``bits`` of the Gray code of the fringe order; ``inverse``: its negative.
    ``complementary``: the one extra, least significant bit, so that Gray and complementary bits
    together number the half periods. ``white``, ``black``, ``texture`` (the scene under white
    light): no axis.
    """

    kind: Kind
    axis: Axis | None = None
    step: int = 0
    steps: int = 0
    period_px: float = 0.0
    bit: int = 0
    bits: int = 0

    def __post_init__(self) -> None:
        """Raise InputError where the fields of the frame are missing or out of range."""
        if self.kind not in get_args(Kind):
            raise InputError(f"frame kind '{self.kind}' is unknown", f"use one of {KINDS}")
        if self.axis not in (None, "x", "y"):
            raise InputError(
                f"frame axis '{self.axis}' is unknown",
                "use x (varies along columns) or y (along rows)",
            )
        if "axis" in _FIELDS[self.kind] and self.axis is None:
            raise InputError(
                f"a {self.kind} frame has no axis", "say x (varies along columns) or y (along rows)"
            )
        if self.kind == "phase":
            if not 3 <= self.steps <= MAX_STEPS:
                raise InputError(
                    f"{self.steps} phase steps cannot be decoded", f"use 3 to {MAX_STEPS}"
                )
            if not 0 <= self.step < self.steps:
                raise InputError(
                    f"phase step {self.step} of {self.steps} does not exist", "count from 0"
                )
            if not 2 <= self.period_px <= MAX_EXTENT:
                raise InputError(
                    f"a fringe period of {self.period_px:g} px cannot be shown", "use 2 px or more"
                )
        if self.kind in ("gray", "inverse") and not 0 <= self.bit < 31:
            raise InputError(
                f"Gray bit {self.bit} does not exist", "count from 0, the most significant"
            )

    def to_dict(self) -> dict[str, Any]:
        """Return the fields that apply to the kind of the frame, with the keys of the `frames`
        TOML."""
        return (
            {"kind": self.kind}
            | ({"axis": self.axis} if self.axis else {})
            | {name: getattr(self, name) for name in _FIELDS[self.kind] if name != "axis"}
        )

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> "Frame":
        """Return the frame of a `[[frame]]` table or of `to_dict`; entries that its kind does not
        need are ignored."""
        known = {"kind", "axis", "step", "steps", "period_px", "bit", "bits"}
        unknown = sorted(set(data) - known - {"file"})
        if unknown:
            raise InputError(
                f"a frame has the unknown entry '{unknown[0]}'", f"use {', '.join(sorted(known))}"
            )
        if "kind" not in data:
            raise InputError("a frame does not say its kind", 'add kind = "phase", "gray", ...')
        try:
            kind, axis = convert(data["kind"], str), convert(data.get("axis"), str | None)
            numbers: dict[str, Any] = {
                name: convert(data[name], int, strict=False)
                for name in ("step", "steps", "bit", "bits")
                if name in data
            }
            numbers["period_px"] = convert(data.get("period_px", 0.0), float, strict=False)
        except ValidationError as error:
            raise InputError(
                f"a {data['kind']} frame has an entry that is not a number ({error})", "correct it"
            ) from error
        values = {name: value for name, value in numbers.items() if name in _FIELDS.get(kind, ())}
        return cls(kind=kind, axis=axis, **values)  # type: ignore[arg-type]


@dataclass(frozen=True)
class PatternSequence:
    """Frames of one capture, in the order in which they are shown, and the conventions that they
    follow.

    ``projector_size`` is (width, height) in px, None where it is not known. Phase step k of n shows
    A + B cos(phi + phase_sign 2 pi k / n + phase_offset_rad). ``gray_origin_px`` is the projector
    coordinate at which Gray code 0 begins; a displayed column u reaches from u - 0.5 to u + 0.5,
    hence -0.5. ``gray_cell_px`` is the width of the cells that the Gray bits number (the
    complementary bit halves them); None: the longest fringe period, or 1 px for Gray code alone.
    These four are one value for both axes, or a `PerAxis`.

    ``relative``: an axis of phase steps alone, whose periods do not cover the projector, is decoded
    modulo the longest unambiguous range; otherwise it is refused. Without a projector size such an
    axis is always relative. ``levels``: for each grey level 0 ... 255 of a cosine the one that is
    shown in its place, so that a projector whose light is not proportional to it shows cosines;
    None where they are the same. It records what was shown; decoding does not use it.
    ``binary``: the Gray bits and their inverses show plain binary numbers instead, which is decoded
    without phase steps only. ``full_scale``: grey level at which the camera clips, as the camera,
    the format or the operator states it, 4095 for the 12 bits in a uint16; None: derived from the
    brightest pixel, see `layout.clip_level`.

    Raises InputError when steps or bits are missing, repeated, or contradict each other, or a value
    is out of range.
    """

    projector_size: Size | None
    frames: tuple[Frame, ...]
    phase_sign: int | PerAxis[int] = 1
    gray_origin_px: float | PerAxis[float] = -0.5
    levels: tuple[int, ...] | None = None
    phase_offset_rad: float | PerAxis[float] = 0.0
    gray_cell_px: float | PerAxis[float | None] | None = None
    relative: bool = False
    full_scale: int | None = None
    binary: bool = False

    def __post_init__(self) -> None:
        """Check the frames and conventions, and replace pairs of equal values by one value. Raises
        InputError."""
        size = self.projector_size
        if size is not None and (len(size) != 2 or min(size) < 1):
            raise InputError(
                f"a projector of {size} px does not exist", "give width and height, like 912x1140"
            )
        for name in ("phase_sign", "gray_origin_px", "phase_offset_rad", "gray_cell_px"):
            value = getattr(self, name)
            # one way to write it, so that equal is equal
            if isinstance(value, PerAxis) and value.x == value.y:
                object.__setattr__(self, name, value.x)
        for axis in get_args(Axis):
            self._check_values(axis)
        if self.full_scale is not None and not 1 <= self.full_scale < 1 << 16:
            raise InputError(
                f"full_scale is {self.full_scale}",
                "give the level at which the camera clips, such as 4095",
            )
        if self.levels is not None:
            _check_levels(self.levels)
        for axis in self.axes:
            self._check_phase(axis)
            self._check_bits(axis)

    def count_images(self, exposures: Sized) -> int:
        """Return the number of images of a capture in these exposures; in one where none are
        given."""
        return len(self.frames) * max(1, len(exposures))

    @property
    def projector(self) -> Size:
        """Projector size (width, height) in px. Raises InputError where it is not known."""
        if self.projector_size is None:
            raise InputError(
                "the size of the projector is not known, and it is needed here",
                'import the capture again with projector = "912x1140" (width x height), or'
                " --projector",
            )
        return self.projector_size

    @property
    def axes(self) -> tuple[Axis, ...]:
        """Axes that carry a pattern, x before y."""
        coded = {f.axis for f in self.frames if "axis" in _FIELDS[f.kind]}
        return tuple(axis for axis in get_args(Axis) if axis in coded)

    def extent(self, axis: Axis) -> int:
        """Return the projector size along the axis, px: columns for x, rows for y."""
        return self.projector[0] if axis == "x" else self.projector[1]

    def periods_px(self, axis: Axis) -> tuple[float, ...]:
        """Return the phase-shifted periods of the axis, longest first; empty for Gray code
        alone."""
        return tuple(
            sorted(
                {f.period_px for f in self.frames if f.kind == "phase" and f.axis == axis},
                reverse=True,
            )
        )

    def period_px(self, axis: Axis) -> float:
        """Return the finest period, px; the width of a Gray cell for Gray code alone."""
        periods = self.periods_px(axis)
        return periods[-1] if periods else self.gray_cell(axis)

    def sign(self, axis: Axis) -> int:
        """Return ``phase_sign`` of the axis, 1 or -1."""
        return select_axis_value(self.phase_sign, axis)

    def offset_rad(self, axis: Axis) -> float:
        """Return ``phase_offset_rad`` of the axis."""
        return float(select_axis_value(self.phase_offset_rad, axis))

    def origin_px(self, axis: Axis) -> float:
        """Return ``gray_origin_px`` of the axis."""
        return select_axis_value(self.gray_origin_px, axis)

    def gray_cell(self, axis: Axis) -> float:
        """Return the width, px, of the cells that the Gray bits of the axis number."""
        cell = select_axis_value(self.gray_cell_px, axis)
        if cell is not None:
            return float(cell)
        periods = self.periods_px(axis)
        return periods[0] if periods else 1.0

    def select(self, axis: Axis) -> list[int]:
        """Return the indices of the frames that decoding this axis needs: its own, and white and
        black."""
        return [
            i
            for i, f in enumerate(self.frames)
            if (f.axis == axis and "axis" in _FIELDS[f.kind])
            or (f.kind in ("white", "black") and f.axis in (None, axis))
        ]

    @property
    def patterns(self) -> list[int]:
        """The indices of the frames that are not the texture."""
        return [i for i, frame in enumerate(self.frames) if frame.kind != "texture"]

    def find(self, kind: Kind, axis: Axis) -> list[int]:
        """Return the indices of the axis' frames of one kind, in order."""
        return [i for i in self.select(axis) if self.frames[i].kind == kind]

    def bits(self, kind: Kind, axis: Axis) -> Indices:
        """Return the indices of the axis' frames of one kind, the most significant bit first."""
        return tuple(sorted(self.find(kind, axis), key=lambda i: self.frames[i].bit))

    def phase_shifts(self, axis: Axis) -> tuple[tuple[float, Indices], ...]:
        """Return (period px, frame indices by step) of each phase shift of the axis, longest period
        first."""
        steps = sorted(self.find("phase", axis), key=lambda i: self.frames[i].step)
        return tuple(
            (period, tuple(i for i in steps if self.frames[i].period_px == period))
            for period in self.periods_px(axis)
        )

    def _check_values(self, axis: Axis) -> None:
        """Raise InputError for signs, offsets and cell widths out of range."""
        if self.sign(axis) not in (1, -1):
            raise InputError(f"phase_sign is {self.sign(axis)}", "use 1 or -1")
        if not isfinite(self.offset_rad(axis)) or not isfinite(self.origin_px(axis)):
            raise InputError(
                f"axis {axis}: phase_offset (phase_offset_rad) is {self.offset_rad(axis)} rad and"
                f" gray_origin (gray_origin_px) {self.origin_px(axis)} px",
                "give finite numbers",
            )
        cell = select_axis_value(self.gray_cell_px, axis)
        if cell is not None and not (isfinite(cell) and cell > 0):
            raise InputError(
                f"axis {axis}: a Gray cell of {cell} px does not exist",
                "give its width in projector px",
            )

    def _check_phase(self, axis: Axis) -> None:
        """Raise InputError where phase steps of a period are missing, repeated or disagree."""
        for period in self.periods_px(axis):
            frames = [
                f
                for f in self.frames
                if f.kind == "phase" and f.axis == axis and f.period_px == period
            ]
            counts = {f.steps for f in frames}
            where = f"axis {axis}, period {period:g} px"
            if len(counts) > 1:
                raise InputError(
                    f"{where}: the frames speak of {_join_numbers(counts)} phase steps",
                    "they must all say the same",
                )
            _check_complete([f.step for f in frames], range(counts.pop()), f"{where}: phase step")

    def _check_bits(self, axis: Axis) -> None:
        """Raise InputError where Gray bits are missing, repeated or disagree."""
        gray = [f.bit for f in self.frames if f.kind == "gray" and f.axis == axis]
        inverse = [f.bit for f in self.frames if f.kind == "inverse" and f.axis == axis]
        complementary = len(self.find("complementary", axis))
        # `bits` of a foreign description may or may not count the complementary bit; the frames
        # themselves decide, yet a least significant bit that was announced and is absent must not
        # pass for a shorter code.
        stated_counts = {
            f.bits for f in self.frames if f.kind == "gray" and f.axis == axis and f.bits
        }
        if len(stated_counts) > 1:
            raise InputError(
                f"axis {axis}: the frames speak of {_join_numbers(stated_counts)} Gray bits",
                "they must all say the same",
            )
        needed = max([b + 1 for b in gray + inverse], default=0)
        if stated_counts:
            needed = max(needed, stated_counts.pop() - min(complementary, 1))
        _check_complete(gray, range(needed), f"axis {axis}: Gray bit")
        if inverse:
            _check_complete(inverse, range(needed), f"axis {axis}: inverse of Gray bit")
        if complementary > 1:
            raise InputError(
                f"axis {axis}: {complementary} complementary frames",
                "there is only one such bit, keep one",
            )
        if complementary and not self.periods_px(axis):
            raise InputError(
                f"axis {axis}: a complementary bit without phase steps says nothing",
                "call it a Gray bit",
            )

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON or TOML, with the keys of the `frames` TOML.

        Entries that were added in later versions appear only where they are used, so that
        descriptions written before, and their hashes, do not change.
        """
        size = self.projector_size
        values: dict[str, Any] = {"projector": f"{size[0]}x{size[1]}"} if size else {}
        values["phase_sign"] = _convert_axes(self.phase_sign)
        values["gray_origin"] = _convert_axes(self.gray_origin_px)
        values["frame"] = [frame.to_dict() for frame in self.frames]
        if self.levels is not None:
            values["levels"] = list(self.levels)
        if self.phase_offset_rad != 0:
            values["phase_offset"] = _convert_axes(self.phase_offset_rad)
        if self.gray_cell_px is not None:
            values["gray_cell_px"] = _convert_axes(self.gray_cell_px)
        if self.relative:
            values["relative"] = True
        if self.full_scale is not None:
            values["full_scale"] = self.full_scale
        if self.binary:
            values["code"] = "binary"
        return values

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> "PatternSequence":
        """Return the sequence that `to_dict` or a `frames` TOML describes. Raises InputError."""
        frames = data.get("frame")
        if not isinstance(frames, list) or not frames:
            raise InputError("the sequence names no frames", "add a [[frame]] table for each image")
        levels, relative = data.get("levels"), data.get("relative", False)
        if levels is not None and not isinstance(levels, list):
            raise InputError(
                f"levels is {levels!r}", "give a list of 256 grey levels, or leave it out"
            )
        if not isinstance(relative, bool):
            raise InputError(f"relative is {relative!r}", "use true or false")
        if (code := data.get("code", "gray")) not in ("gray", "binary"):
            raise InputError(f"code is {code!r}", 'use "gray" or "binary"')
        try:
            full_scale = convert(data.get("full_scale"), int | None)
        except ValidationError as error:
            raise InputError(
                f"full_scale is {data['full_scale']!r}", "give a whole number, such as 4095"
            ) from error
        return cls(
            None if data.get("projector") is None else parse_size(data["projector"]),
            tuple(Frame.from_dict(f) for f in frames),
            _read_values(data, "phase_sign", 1, int),
            _read_values(data, "gray_origin", -0.5, float),
            None if levels is None else tuple(levels),
            _read_values(data, "phase_offset", 0.0, float),
            _read_values(data, "gray_cell_px", None, float),
            relative,
            full_scale,
            code == "binary",
        )


def parse_size(text: Any) -> Size:
    """Parse (width, height) from "912x1140" or [912, 1140]. Raises InputError."""
    parts = text.lower().split("x") if isinstance(text, str) else text
    try:
        width, height = convert(parts, Size, strict=False)
    except ValidationError as error:
        raise InputError(
            f"'{text}' is not a size", "write width and height in px like 912x1140"
        ) from error
    if not (1 <= width <= MAX_EXTENT and 1 <= height <= MAX_EXTENT):
        raise InputError(f"'{text}' is not a size", "write width and height in px like 912x1140")
    return width, height


def select_axis_value(values: Any, axis: Axis) -> Any:
    """Return the value of one axis, from a common value or a pair."""
    return getattr(values, axis) if isinstance(values, PerAxis) else values


def _convert_axes(values: Any) -> Any:
    """Convert a pair to a dictionary of its axes; a common value is returned unchanged."""
    if not isinstance(values, PerAxis):
        return values
    return {axis: value for axis, value in values._asdict().items() if value is not None}


def _read_values(data: Mapping[str, Any], name: str, default: Any, kind: type) -> Any:
    """Read one value for both axes, or a `PerAxis`, from ``data``; a missing axis has the default.

    ``kind``: type to convert to. Raises InputError.
    """
    given = data.get(name, default)
    if unknown := sorted(set(given) - set(get_args(Axis))) if isinstance(given, Mapping) else []:
        raise InputError(f"{name} has the unknown entry '{unknown[0]}'", "use x and y")
    try:
        if isinstance(given, Mapping):
            pair = (
                convert(given[axis], kind, strict=False) if axis in given else default
                for axis in get_args(Axis)
            )
            return PerAxis(*pair)
        return given if given is default else convert(given, kind, strict=False)
    except ValidationError as error:
        raise InputError(
            f"{name} must be a number, or {{x = ..., y = ...}} ({error})", "correct it"
        ) from error


def _check_levels(levels: tuple[int, ...]) -> None:
    """Raise InputError for a table that is not 256 rising grey levels from 0 to 255."""
    whole = all(isinstance(level, int) and not isinstance(level, bool) for level in levels)
    if (
        not whole
        or len(levels) != 256
        or levels[0] != 0
        or levels[-1] != 255
        or list(levels) != sorted(levels)
    ):
        raise InputError(
            f"a table of {len(levels)} grey levels cannot stand in for 0 ... 255",
            "give 256 whole numbers that never fall, the first 0 and the last 255, or none",
        )


def _check_complete(numbers: list[int], wanted: range, what: str) -> None:
    """Raise InputError where numbers are missing or occur twice."""
    missing = sorted(set(wanted) - set(numbers))
    if missing:
        raise InputError(
            f"{what} {_join_numbers(missing)} of {len(wanted)} is missing",
            "add the frame, or correct its description",
        )
    double = [value for value, count in Counter(numbers).items() if count > 1]
    if double:
        raise InputError(
            f"{what} {_join_numbers(double)} occurs more than once", "keep one frame of each"
        )


def _join_numbers(values: Any) -> str:
    """Return numbers as text, sorted, separated by commas."""
    return ", ".join(f"{v:g}" for v in sorted(values))


def one_axis(sequence: PatternSequence, axis: Axis) -> PatternSequence:
    """Return the sequence with the frames of one axis only, and one texture frame."""
    frames = [f for f in sequence.frames if f.axis == axis]
    texture = [f for f in sequence.frames if f.kind == "texture"][:1]
    return replace(sequence, frames=(*frames, *texture))
