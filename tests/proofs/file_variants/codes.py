"""Folders of frames that other programs wrote: codes by formulas of their own, seen by a camera
whose projector columns and rows are known, with the TOML that describes them rightly or wrongly."""

import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from scipy.ndimage import gaussian_filter, gaussian_filter1d

from tests.proofs.file_variants.variant import Form

SIZE = 320, 240
"""Of the camera, px."""
_PROJECTORS = (480, 320), (512, 384), (608, 684), (640, 360), (854, 480), (912, 1140), (1280, 800)
Entry = Mapping[Any, Any]
"""Of a frame in the TOML."""
Files = Mapping[str, bytes]
_FINE = 8
"""Places of which a projector pixel's light is drawn."""


@dataclass(frozen=True, eq=False)
class Shown:
    """One image: ``levels`` (extent,) 0 to 1 of each column or row, or one number, and the entries
    of a `[[frame]]` that describe it."""

    levels: np.ndarray | float
    entry: Entry
    axis: str = ""


@dataclass(frozen=True, eq=False)
class Code:
    """The images of a capture in their order, and the entries at the top of the TOML. ``family``:
    which of the kinds of codes; ``period_px``: the finest."""

    family: str
    projector: tuple[int, int]
    shown: tuple[Shown, ...]
    top: Mapping[str, object]
    period_px: float


@dataclass(frozen=True, eq=False)
class Scene:
    """``coordinates``: (h, w) px of each axis; ``albedo`` (h, w); ``is_seen`` (h, w): pixels that
    the projector lights."""

    coordinates: Mapping[str, np.ndarray]
    albedo: np.ndarray
    is_seen: np.ndarray


@dataclass(frozen=True, eq=False)
class Folder:
    """Files of a capture and its description. ``wrong``: what the description or the files have
    wrong, empty where nothing is; ``reasons``: words of which a refusal or a warning has one."""

    code: Code
    scene: Scene
    files: Mapping[str, bytes]
    toml: str
    form: str
    wrong: str = ""
    reasons: tuple[str, ...] = ()


def draw_scene(rng: np.random.Generator, projector: tuple[int, int]) -> Scene:
    """Draw a curved surface with a step in depth, a shadow and patches of another brightness."""
    x, y = np.meshgrid(np.linspace(-1, 1, SIZE[0]), np.linspace(-1, 1, SIZE[1]))
    coordinates = {}
    box = (np.abs(x - rng.uniform(-0.4, 0.4)) < 0.3) & (np.abs(y - rng.uniform(-0.4, 0.4)) < 0.3)
    for axis, extent, count, along, across in (
        ("x", projector[0], SIZE[0], x, y),
        ("y", projector[1], SIZE[1], y, x),
    ):
        reach = 0.94 * extent
        span = min(count * rng.uniform(0.6, 1.1), reach)
        middle = extent / 2 + rng.uniform(-0.5, 0.5) * (reach - span)
        bend = rng.uniform(-0.06, 0.06, 3)
        seen = along + bend[0] * across + bend[1] * along**2 + bend[2] * across**2
        seen = middle + span / 2 * seen / np.abs(seen).max()
        depth = rng.uniform(0.01, 0.05) * span if axis == "x" else 0.0
        coordinates[axis] = np.clip(seen + depth * box, 1.0, extent - 2.0)
    shadow = (np.abs(x - rng.uniform(-0.8, 0.8)) < 0.15) & (
        np.abs(y - rng.uniform(-0.7, 0.7)) < 0.2
    )
    patches = gaussian_filter(rng.uniform(0, 1, x.shape), 6)
    albedo = 0.55 + 0.4 * (patches - patches.min()) / np.ptp(patches)
    return Scene(coordinates, np.where(shadow, 0.0, albedo), ~shadow)


def _steps(
    axis: str, extent: int, steps: int, period: float, sign: int, offset: float, text: object
) -> list[Shown]:
    """Return the images of all phase steps of a period, which the TOML writes as ``text``."""
    angle = 2 * np.pi * np.arange(extent) / period + offset
    return [
        Shown(
            0.5 + 0.5 * np.cos(angle + sign * 2 * np.pi * k / steps),
            {"kind": "phase", "axis": axis, "step": k, "steps": steps, "period_px": text},
            axis,
        )
        for k in range(steps)
    ]


def _bits(form: Form, axis: str, number: np.ndarray, is_binary: bool, inverse: str) -> list[Shown]:
    """Return the images of the bits of the ``number`` (extent,) of each column's cell, and of their
    inverses, which follow each ("each"), all ("block") or are none ("none")."""
    bits = max(1, int(number.max()).bit_length())
    shown = number if is_binary else number ^ (number >> 1)
    images, inverses = [], []
    for bit in range(bits):
        levels = ((shown >> (bits - 1 - bit)) & 1).astype(float)
        entry = {"axis": axis, "bit": bit, "bits": bits}
        images.append(Shown(levels, {"kind": "gray", **entry}, axis))
        inverses.append(Shown(1 - levels, {"kind": "inverse", **entry}, axis))
    if form.draw("first bit", "most", "most", "least") == "least":
        images, inverses = images[::-1], inverses[::-1]
    if inverse == "each":
        return [each for pair in zip(images, inverses, strict=True) for each in pair]
    return images + (inverses if inverse == "block" else [])


def _draw_axes(form: Form) -> tuple[str, ...]:
    """Draw the axes of the patterns."""
    return tuple(form.draw("axes", "x", "y", "xy", "xy"))


def _extent(projector: tuple[int, int], axis: str) -> int:
    """Return the projector's size along an axis, px."""
    return projector["xy".index(axis)]


def _add_even(form: Form, shown: list[Shown]) -> list[Shown]:
    """Return the images with those of even light where a program shows them."""
    white, black = Shown(1.0, {"kind": "white"}), Shown(0.0, {"kind": "black"})
    texture = Shown(1.0, {"kind": "texture"})
    where = form.draw("even light", "none", "first", "last", "black first", "texture")
    return {
        "none": shown,
        "first": [white, black, *shown],
        "last": [*shown, white, black],
        "black first": [black, white, *shown],
        "texture": [*shown, texture],
    }[where]


def draw_bits_alone(form: Form) -> Code:
    """Draw Gray or binary code alone, of cells of one or more pixels."""
    projector = form.draw("projector", *_PROJECTORS)
    is_binary = form.draw("code", "gray", "gray", "binary") == "binary"
    cell = form.draw("cell", 1, 1, 2, 3, 4)
    inverse = form.draw("inverse", "each", "each", "block", "none")
    images = []
    for axis in _draw_axes(form):
        number = np.arange(_extent(projector, axis)) // cell
        images += _bits(form, axis, number, is_binary, inverse)
    top: dict[str, object] = {"gray_origin": -0.5} if form.draw("origin", 0, 1) else {}
    top |= {"code": "binary"} if is_binary else {}
    top |= {"gray_cell_px": float(cell)} if cell > 1 else {}
    return Code("bits", projector, tuple(_add_even(form, images)), top, float(cell))


def draw_coded_steps(form: Form) -> Code:
    """Draw phase steps whose periods a Gray or binary code numbers."""
    projector = form.draw("projector", *_PROJECTORS)
    is_binary = form.draw("code", "gray", "gray", "gray", "binary") == "binary"
    steps = form.draw("steps", 3, 4, 4, 5, 6, 8, 12)
    sign = form.draw("sign", 1, 1, -1)
    period = form.draw("period", 12.0, 16.0, 18.0, 20.0, 24.0, 32.0, 36.0)
    offset = form.draw("offset", 0.0, 0.0, -np.pi / 2, np.pi, np.pi / period)
    inverse = form.draw("inverse", "none", "none", "each", "block")
    is_doubled = not is_binary and inverse == "none" and form.draw("doubled", False, True)
    code_first = form.draw("code first", False, True)
    # the code's cells begin where the fringes do
    images = []
    for axis in _draw_axes(form):
        columns = np.arange(_extent(projector, axis))
        fringes = _steps(axis, len(columns), steps, period, sign, offset, period)
        if is_doubled:
            bits = _bits(form, axis, (2 * columns // period).astype(int), False, "none")
            last = max(bits, key=lambda each: each.entry["bit"])
            count = len(bits) - 1
            bits = [
                replace(each, entry={"kind": "complementary", "axis": axis})
                if each is last
                else replace(each, entry={**each.entry, "bits": count})
                for each in bits
            ]
        else:
            bits = _bits(form, axis, (columns // period).astype(int), is_binary, inverse)
        images += [*bits, *fringes] if code_first else [*fringes, *bits]
    top: dict[str, object] = {"phase_sign": sign, "phase_offset": round(offset, 6)}
    top |= {"gray_origin": -0.5} if form.draw("origin", 0, 1) else {}
    top |= {"code": "binary"} if is_binary else {}
    return Code("coded", projector, tuple(_add_even(form, images)), top, period)


def draw_frequencies(form: Form) -> Code:
    """Draw phase steps of several periods, each a multiple of the next, or whose beats are long."""
    projector = form.draw("projector", *_PROJECTORS)
    sign = form.draw("sign", 1, 1, -1)
    offset = form.draw("offset", 0.0, 0.0, np.pi)
    steps = form.draw("steps", (3, 3, 3), (4, 4, 4), (3, 3, 8), (6, 6, 6), (8, 8, 8), (5, 4, 4))
    kinds = ((1, 8, 40), (1, 6, 36), (1, 4, 28), (70, 64, 59), (49, 48, 42), (28, 26, 25), (1, 16))
    counts = form.draw("fringes", *kinds)
    order = form.draw("order", "as they are", "reversed")
    style = form.draw("periods", "ratio", "ratio", "full", "1 decimal", "2 decimals", "3 decimals")
    images, finest = [], np.inf
    for axis in _draw_axes(form):
        extent = _extent(projector, axis)
        of_axis = []
        for count, n in zip(counts, steps, strict=False):
            period = extent / count
            finest = min(finest, period)
            text: object = f"{extent}/{count}" if style == "ratio" else period
            if "decimal" in style:
                text = round(period, int(style[0]))
            of_axis.append(_steps(axis, extent, n, period, sign, offset, text))
        for each in of_axis[:: -1 if order == "reversed" else 1]:
            images += each
    top: dict[str, object] = {"phase_sign": sign, "phase_offset": round(offset, 6)}
    family = "beats" if counts[0] > 1 else "frequencies"
    family += ", rounded" if "decimal" in style else ""
    return Code(family, projector, tuple(_add_even(form, images)), top, finest)


def photograph(rng: np.random.Generator, code: Code, scene: Scene) -> np.ndarray:
    """Return the light (n, h, w), 0 to 1, that a camera sees of each image, with its noise."""
    ambient, noise, blur = (
        rng.uniform(0.01, 0.06),
        rng.uniform(0.0015, 0.005),
        rng.uniform(0.3, 0.6),
    )
    seen = []
    for shown in code.shown:
        if shown.axis:
            fine = np.repeat(np.asarray(shown.levels), _FINE)
            fine = gaussian_filter1d(fine, blur * _FINE, mode="nearest")
            at = (scene.coordinates[shown.axis] + 0.5) * _FINE - 0.5
            light = np.interp(at, np.arange(len(fine)), fine)
        else:
            light = np.full(scene.albedo.shape, float(shown.levels))
        seen.append(ambient + 0.88 * scene.albedo * (0.02 + 0.98 * light))
    stack = np.stack(seen)
    return np.clip(stack + rng.normal(0, 1, stack.shape) * noise, 0, 1)


def _save(kind: str, quality: int = 95) -> Callable[[np.ndarray], bytes]:
    """Return a writer of images by Pillow."""

    def save(pixels: np.ndarray) -> bytes:
        """Return the file of an image."""
        data = io.BytesIO()
        Image.fromarray(pixels).save(data, kind, quality=quality)
        return data.getvalue()

    return save


def _to_colour(pixels: np.ndarray) -> np.ndarray:
    """Return an image (h, w, 3) whose green channel is the given one."""
    return np.stack([(0.8 * pixels).astype(np.uint8), pixels, (0.6 * pixels).astype(np.uint8)], 2)


_WRITERS: Mapping[str, tuple[str, int, Callable[[np.ndarray], bytes]]] = {
    "PNG": ("png", 255, _save("PNG")),
    "PNG of 16 bits": ("png", 65535, _save("PNG")),
    "BMP": ("bmp", 255, _save("BMP")),
    "TIFF": ("tif", 255, _save("TIFF")),
    "TIFF of 16 bits": ("tiff", 65535, _save("TIFF")),
    "TIFF of 12 bits": ("tif", 4095, _save("TIFF")),
    "colour PNG": ("png", 255, lambda each: _save("PNG")(_to_colour(each))),
    "PGM": ("pgm", 255, _save("PPM")),
    "JPEG": ("JPG", 255, _save("JPEG", 98)),
}


def _letters(i: int) -> str:
    """Return the name of a table's column: a, b, ... z, aa, ab."""
    return (chr(96 + i // 26) if i >= 26 else "") + chr(97 + i % 26)


_NAMES: Mapping[str, Callable[[int], str]] = {
    "00": lambda i: f"{i:02d}",
    "1": lambda i: f"{i + 1}",
    "IMG_0098": lambda i: f"IMG_{98 + i:04d}",
    "Image (1)": lambda i: f"Image ({i + 1})",
    "cam0_7": lambda i: f"cam0_{7 + i}",
    "time": lambda i: f"2024-05-03_{9 + (58 + i) // 60}-{(58 + i) % 60:02d}-07",
    "second": lambda i: f"shot_{9 + 2 * i}.5s",
    "capture-1 of 9": lambda i: f"capture-{i + 1}_exp20ms",
}
"""Names whose natural order is that of the images."""
_MISSORTED: Mapping[str, Callable[[int], str]] = {
    "hexadecimal": lambda i: f"f{i:x}",
    "letters": _letters,
    "counted down": lambda i: f"{99 - i}",
    "wrapped": lambda i: f"DSC{(9990 + i) % 10000:04d}",
}


def _value(value: object) -> str:
    """Return a value as TOML writes it."""
    return f'"{value}"' if isinstance(value, str) else f"{value}"


def _write_toml(code: Code, names: Sequence[str] | None) -> str:
    """Return the TOML of a code, by the files' names, or by their order where None."""
    lines = [f'projector = "{code.projector[0]}x{code.projector[1]}"']
    lines += [] if names else ['order = "name"']
    lines += [f"{key} = {_value(value)}" for key, value in code.top.items()]
    for i, each in enumerate(code.shown):
        lines += ["", "[[frame]]"] + ([f'file = "{names[i]}"'] if names else [])
        lines += [f"{key} = {_value(value)}" for key, value in each.entry.items()]
    return "\n".join(lines) + "\n"


FAMILIES: Sequence[Callable[[Form], Code]] = (draw_bits_alone, draw_coded_steps, draw_frequencies)


def draw_folder(rng: np.random.Generator, fault: str = "") -> Folder | None:
    """Draw a folder of frames; None where its code cannot have the ``fault``, of `FAULTS`."""
    form = Form(rng)
    code = FAMILIES[int(rng.integers(len(FAMILIES)))](form)
    scene = draw_scene(rng, code.projector)
    stack = photograph(rng, code, scene)
    writer = form.draw("writer", *_WRITERS)
    suffix, white, write = _WRITERS[writer]
    top = dict(code.top)
    if writer == "colour PNG":
        top["channel"] = "green"
    if writer == "TIFF of 12 bits":
        top["full_scale"] = 4095
    code = replace(code, top=top)
    by_name = bool(form.draw("by name", True, False))
    named = form.draw("names", *_NAMES)
    stem = _NAMES[named]
    if fault == "names":
        if not by_name:
            return None
        stem = _MISSORTED[form.draw("missorted", *_MISSORTED)]
    names = [f"{stem(i)}.{suffix}" for i in range(len(stack))]
    levels = np.rint(stack * white).astype(np.uint8 if white == 255 else np.uint16)
    files = {name: write(image) for name, image in zip(names, levels, strict=True)}
    described: Spoilt | None = Spoilt(code, files, names)
    reasons: tuple[str, ...] = ()
    if fault == "names":
        reasons = ("order", "changed places", "behind", "late", "names")
    if fault in FAULTS:
        spoil, reasons = FAULTS[fault]
        described = spoil(rng, code, files, names)
    if described is None:
        return None
    kinds = {each.entry["kind"] for each in code.shown}
    if code.family == "bits" and not kinds & {"inverse", "white"}:
        reasons += ("needs its inverses",)
    toml = _write_toml(described.code, None if by_name else described.names)
    text = f"{code.family}: {form.text()}"
    return Folder(
        code,
        scene,
        described.files,
        toml,
        text,
        fault,
        reasons,
    )


@dataclass(frozen=True, eq=False)
class Spoilt:
    """A code as it is described, the files that are there, and their names in the description."""

    code: Code
    files: Mapping[str, bytes]
    names: Sequence[str]


def _choose(rng: np.random.Generator, code: Code, count: int, *kinds: str) -> list[int] | None:
    """Return different images of these kinds; None where there are too few."""
    found = [i for i, each in enumerate(code.shown) if each.entry["kind"] in kinds]
    return None if len(found) < count else [int(i) for i in rng.choice(found, count, False)]


def _swap(
    rng: np.random.Generator, code: Code, files: Files, names: Sequence[str]
) -> Spoilt | None:
    chosen = _choose(rng, code, 2, "phase", "gray", "inverse", "complementary")
    if chosen is None:
        return None
    a, b = (names[i] for i in chosen)
    return Spoilt(code, {**files, a: files[b], b: files[a]}, names)


def _drop(rng: np.random.Generator, code: Code, files: Files, names: Sequence[str]) -> Spoilt:
    lost = names[int(rng.integers(len(names)))]
    return Spoilt(code, {name: each for name, each in files.items() if name != lost}, names)


def _add(rng: np.random.Generator, code: Code, files: Files, names: Sequence[str]) -> Spoilt:
    source = names[int(rng.integers(len(names)))]
    return Spoilt(code, {**files, f"extra_{source}": files[source]}, names)


def _repeat(rng: np.random.Generator, code: Code, files: Files, names: Sequence[str]) -> Spoilt:
    """A camera missed one image and took the one before twice: the images behind are late."""
    at = int(rng.integers(1, len(names)))
    seen = [files[each] for each in names]
    late = [*seen[:at], seen[at - 1], *seen[at:-1]]
    return Spoilt(code, dict(zip(names, late, strict=True)), names)


def _rename(key: str, other: Entry, entry: Entry) -> Entry:
    """Return an entry with another value of a key, if it has one of these."""
    return {**entry, key: other.get(entry[key], entry[key])} if key in entry else entry


def _change(code: Code, change: Callable[[Entry], Entry]) -> Code:
    """Return a code whose entries are changed."""
    return replace(
        code, shown=tuple(replace(each, entry=change(each.entry)) for each in code.shown)
    )


def _turn_bits(
    rng: np.random.Generator, code: Code, files: Files, names: Sequence[str]
) -> Spoilt | None:
    """The least significant bit is called the most significant."""
    if _choose(rng, code, 2, "gray") is None:
        return None

    def change(entry: Entry) -> Entry:
        if "bits" not in entry:
            return entry
        return {**entry, "bit": entry["bits"] - 1 - entry["bit"]}

    return Spoilt(_change(code, change), files, names)


def _exchange_codes(
    rng: np.random.Generator, code: Code, files: Files, names: Sequence[str]
) -> Spoilt | None:
    """Gray code is called binary, or the other way round."""
    if code.family == "frequencies" or _choose(rng, code, 3, "gray") is None:
        return None
    top = dict(code.top)
    if top.pop("code", None) is None:
        if _choose(rng, code, 1, "complementary"):
            return None
        top["code"] = "binary"
    return Spoilt(replace(code, top=top), files, names)


def _exchange_inverses(
    rng: np.random.Generator, code: Code, files: Files, names: Sequence[str]
) -> Spoilt | None:
    """Patterns are called inverses, and these patterns."""
    if _choose(rng, code, 2, "inverse") is None:
        return None
    other: Entry = {"gray": "inverse", "inverse": "gray"}
    return Spoilt(_change(code, partial(_rename, "kind", other)), files, names)


def _exchange_even(
    rng: np.random.Generator, code: Code, files: Files, names: Sequence[str]
) -> Spoilt | None:
    """White is called black."""
    if _choose(rng, code, 1, "white") is None:
        return None
    other = {"white": "black", "black": "white"}
    return Spoilt(_change(code, partial(_rename, "kind", other)), files, names)


def _turn_sign(
    rng: np.random.Generator, code: Code, files: Files, names: Sequence[str]
) -> Spoilt | None:
    """Steps run the other way; of three or four steps that is an order like another."""
    if "phase_sign" not in code.top:
        return None
    top = {**code.top, "phase_sign": -int(str(code.top["phase_sign"]))}
    return Spoilt(replace(code, top=top), files, names)


def _forget_offset(
    rng: np.random.Generator, code: Code, files: Files, names: Sequence[str]
) -> Spoilt | None:
    """Sines are described as cosines."""
    offset = float(str(code.top.get("phase_offset", 0.0)))
    if abs(offset) < 1 or (code.family == "coded" and "gray_origin" not in code.top):
        return None
    top = {key: value for key, value in code.top.items() if key != "phase_offset"}
    return Spoilt(replace(code, top=top), files, names)


def _change_period(
    rng: np.random.Generator, code: Code, files: Files, names: Sequence[str]
) -> Spoilt | None:
    """One of several periods is another."""
    periods = {str(each.entry["period_px"]) for each in code.shown if "period_px" in each.entry}
    if code.family == "coded" or len(periods) < 2:
        return None
    wrong = sorted(periods)[int(rng.integers(len(periods)))]

    def change(entry: Entry) -> Entry:
        if str(entry.get("period_px")) != wrong:
            return entry
        numbers = [float(each) for each in wrong.split("/")]
        return {**entry, "period_px": 1.13 * numbers[0] / (numbers[1:] or [1.0])[0]}

    return Spoilt(_change(code, change), files, names)


def _join_steps(
    rng: np.random.Generator, code: Code, files: Files, names: Sequence[str]
) -> Spoilt | None:
    """All steps of two periods are called those of the first, or steps of half the number."""
    steps = {e.entry["steps"] for e in code.shown if e.entry["kind"] == "phase"}
    if code.family != "coded" or not steps & {6, 8, 12}:
        return None
    (count,) = steps
    half = count // 2

    def change(entry: Entry) -> Entry:
        if entry["kind"] != "phase":
            return entry
        # every second step follows, then the others
        return {**entry, "step": entry["step"] // 2 + half * (entry["step"] % 2)}

    return Spoilt(_change(code, change), files, names)


def _widen_cells(
    rng: np.random.Generator, code: Code, files: Files, names: Sequence[str]
) -> Spoilt | None:
    """The width of the cells is not described, or as another."""
    if code.family != "bits":
        return None
    top = dict(code.top)
    if top.pop("gray_cell_px", None) is None:
        top["gray_cell_px"] = 2.0
    return Spoilt(replace(code, top=top), files, names)


def _exchange_axes(
    rng: np.random.Generator, code: Code, files: Files, names: Sequence[str]
) -> Spoilt | None:
    """Columns are called rows."""
    if len({each.axis for each in code.shown if each.axis}) < 2:
        return None
    other = {"x": "y", "y": "x"}
    return Spoilt(_change(code, partial(_rename, "axis", other)), files, names)


FAULTS: Mapping[str, tuple[Callable[..., Spoilt | None], tuple[str, ...]]] = {
    "swapped": (_swap, ("changed places",)),
    "missing": (_drop, ("images, and", "lacks")),
    "one too many": (_add, ("images, and", "extra_")),
    "late": (_repeat, ("behind", "late", "same image", "same pattern")),
    "bits turned": (_turn_bits, ("bit", "significan")),
    "other code": (_exchange_codes, ("binary", "Gray")),
    "inverses exchanged": (_exchange_inverses, ("inverse",)),
    "white and black": (_exchange_even, ("changed places", "white", "black")),
    "sign": (_turn_sign, ("phase_sign", "order", "mirror")),
    "offset": (_forget_offset, ("phase_offset",)),
    "period": (_change_period, ("period",)),
    "steps": (_join_steps, ("order", "step")),
    "cells": (_widen_cells, ("cell", "projector")),
    "axes": (_exchange_axes, ("x and y",)),
}
"""What is wrong, what makes it so, and words of a right reason."""


def write_folder(folder: Folder, path: Path) -> None:
    """Write the files and the description of a folder."""
    path.mkdir(parents=True)
    for name, content in folder.files.items():
        (path / name).write_bytes(content)
