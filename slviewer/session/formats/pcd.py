"""PCD of the Point Cloud Library: binary, mm, with normals, colours (one 32-bit number of red,
green and blue), the expected errors (sigma) and other values of each point. Read as text and
compressed too."""

import re
from collections.abc import Sequence
from math import prod
from pathlib import Path

import numpy as np

from slviewer import __version__
from slviewer.errors import InputError
from slviewer.geometry.jit import kernel
from slviewer.session.atomic import replace_file
from slviewer.session.columns import SENSOR, Columns, find_columns
from slviewer.session.ply import COLOURS, NORMAL, PLACE, replace_nan, to_ascii
from slviewer.session.shape_format import Shape, ShapeFormat, Sizes, split_shape
from slviewer.surface.shapes import Mesh

_NORMAL = ("normal_x", "normal_y", "normal_z")
_TYPES = {"F": "f", "I": "i", "U": "u"}
_PACKED = {"rgb", "rgba"}
_Field = tuple[str, np.dtype]
"""Name and type of a field, which may have several numbers a point."""


def _write(path: Path, shape: Shape, scalars: Columns, notes: Sequence[str]) -> None:
    assert not isinstance(shape, Mesh)
    points, _ = split_shape(shape)
    columns = dict(zip(PLACE, points.T, strict=True))
    if shape.normals is not None:
        columns |= dict(zip(_NORMAL, replace_nan("nx", shape.normals).T, strict=True))
    if shape.colours is not None:
        red, green, blue = shape.colours.T.astype(np.uint32)
        columns["rgb"] = (red << 16 | green << 8 | blue).view(np.float32)
    columns |= {name: values for name, values in scalars.items() if name not in columns}
    columns = {
        name: each if each.dtype == np.float64 else each.astype("<f4")
        for name, each in columns.items()
    }
    sizes = " ".join(f"{each.itemsize}" for each in columns.values())
    count, fields = len(points), len(columns)
    comments = "\n# ".join(
        to_ascii(line) for line in (f".PCD v0.7, slviewer {__version__}: units mm", *notes)
    )
    header = (
        f"# {comments}\nVERSION 0.7\nFIELDS {' '.join(columns)}\nSIZE {sizes}\n"
        f"TYPE{' F' * fields}\nCOUNT{' 1' * fields}\nWIDTH {count}\nHEIGHT 1\n"
        f"VIEWPOINT 0 0 0 1 0 0 0\nPOINTS {count}\nDATA binary\n"
    )
    rows = np.empty(count, [(name, each.dtype) for name, each in columns.items()])
    for name, each in columns.items():
        rows[name] = each
    replace_file(path, header.encode("ascii") + rows.tobytes())


def _read(path: Path, data: bytes, notes: list[str]) -> list[Columns]:
    """Return the fields by name, and the sensor's place."""
    match = re.search(rb"^DATA[ \t]+(\w+)[ \t]*\r?\n", data, re.MULTILINE)
    if match is None:
        raise ValueError("it has no line DATA")
    rows = map(str.split, data[: match.start()].decode("ascii", "replace").splitlines())
    header = {words[0].upper(): words[1:] for words in rows if words}
    size = header.get("POINTS") or [*header["WIDTH"], *header.get("HEIGHT", [])]
    count, form, body = prod(map(int, size)), match[1].lower(), data[match.end() :]
    names = header.get("FIELDS") or header["COLUMNS"]
    repeats = header.get("COUNT", ["1"] * len(names))
    described = zip(names, header["TYPE"], header["SIZE"], repeats, strict=True)
    fields = [
        (name, np.dtype((f"<{_TYPES[kind]}{size}", (int(times),))))
        for name, kind, size, times in described
    ]
    if form not in _READERS:
        raise InputError(
            f"{path.name}: DATA {form.decode()} is not read",
            "save it as ascii, binary or compressed",
        )
    columns = _READERS[form](fields, count, body)
    if form == b"binary" and (rest := len(body) - count * sum(kind.itemsize for _, kind in fields)):
        notes.append(f"{rest:,} bytes after the last of its {count:,} points were skipped")
    for name in _PACKED & columns.keys():
        packed = np.ascontiguousarray(columns.pop(name)).view(np.uint32)
        parts = [(packed >> shift & 255).astype(np.uint8) for shift in (16, 8, 0)]
        columns |= dict(zip(COLOURS, parts, strict=True))
    view = np.array(header.get("VIEWPOINT", [0, 0, 0]), np.float64)
    if (view != [0, 0, 0, 1, 0, 0, 0][: len(view)]).any():
        columns |= {**_place_columns(columns, view, notes), SENSOR: view[:3]}
    return [columns]


def _place_columns(columns: Columns, view: np.ndarray, notes: list[str]) -> Columns:
    """Return places and normals in the frame in which a VIEWPOINT, x y z and a quaternion w x y z,
    states how the sensor stands, as the viewer of the Point Cloud Library shows them."""
    from scipy.spatial.transform import Rotation

    turn = Rotation.identity()
    if view[3:].any():
        turn = Rotation.from_quat(np.roll(view[3:], -1))
    placed, names = dict[str, np.ndarray](), [*columns]
    for kind, shift in ((PLACE, view[:3]), (NORMAL, 0.0)):
        if places := find_columns(names).get(kind):
            values = np.stack([columns[names[i]] for i in places], axis=1).astype(np.float64)
            moved = turn.apply(values) + shift
            placed |= {names[i]: column for i, column in zip(places, moved.T, strict=True)}
    x, y, z = view[:3]
    degrees = np.degrees(turn.magnitude())
    notes.append(f"turned by {degrees:.4g} degrees, and moved by {x:g} {y:g} {z:g}, by VIEWPOINT")
    return placed


def _read_text(fields: list[_Field], count: int, body: bytes) -> dict[str, np.ndarray]:
    """Return the columns of lines of numbers."""
    columns, start = dict[str, np.ndarray](), 0
    numbers = np.array(body.split(), np.float64)
    table = numbers.reshape(-1, sum(kind.itemsize // kind.base.itemsize for _, kind in fields))
    if len(table) != count:
        raise ValueError(f"it has {len(table)} of {count} points")
    for name, kind in fields:
        times = kind.itemsize // kind.base.itemsize
        columns[name] = _as_column(table[:, start : start + times].astype(kind.base))
        start += times
    return columns


def _read_rows(fields: list[_Field], count: int, body: bytes) -> dict[str, np.ndarray]:
    """Return the columns of binary points."""
    row = np.dtype([(f"{i}", kind) for i, (_, kind) in enumerate(fields)])
    _check_count(len(body) // row.itemsize, count)
    values = np.frombuffer(body, row, count)
    return {name: _as_column(values[f"{i}"]) for i, (name, _) in enumerate(fields)}


def _read_compressed(fields: list[_Field], count: int, body: bytes) -> dict[str, np.ndarray]:
    """Return the columns of fields that were compressed by LZF, one behind the other."""
    packed, size = (int(each) for each in np.frombuffer(body, "<u4", 2))
    plain, start = np.zeros(size, np.uint8), 0
    if len(body) < 8 + packed or not _unpack(np.frombuffer(body, "u1", packed, 8), plain):
        raise ValueError("it breaks off")
    columns = dict[str, np.ndarray]()
    for name, kind in fields:
        end = start + count * kind.itemsize
        columns[name] = _as_column(plain[start:end].view(kind.base).reshape(count, -1))
        start = end
    return columns


_READERS = {b"ascii": _read_text, b"binary": _read_rows, b"binary_compressed": _read_compressed}


@kernel()
def _unpack(packed: np.ndarray, plain: np.ndarray) -> bool:
    """Fill ``plain`` with what LZF packed, and return whether it fits. Each part begins with its
    kind: up to 32 bytes as they are, or the length and distance of some that came before."""
    i = j = 0
    while i < len(packed):
        kind, i = int(packed[i]), i + 1
        length = kind + 1
        begin = -1
        if kind >= 32:
            length = kind >> 5
            if length == 7 and i < len(packed):
                length, i = length + packed[i], i + 1
            if i >= len(packed):
                return False
            begin, i = j - ((kind & 31) << 8) - packed[i] - 1, i + 1
            length += 2
            if begin < 0:
                return False
        elif i + length > len(packed):
            return False
        if j + length > len(plain):
            return False
        for k in range(length):
            plain[j + k] = packed[i + k] if begin < 0 else plain[begin + k]
        i += length if begin < 0 else 0
        j += length
    return j == len(plain)


def _check_count(found: int, count: int) -> None:
    """Raise ValueError for a file of fewer points than it states."""
    if found < count:
        raise ValueError(f"it has {found} of {count} points")


def _as_column(values: np.ndarray) -> np.ndarray:
    """Return the values (n, k) of a field, (n,) where it has one."""
    return values.reshape(len(values), -1)[:, 0] if values.size == len(values) else values


FORMAT = ShapeFormat(
    "pcd",
    "mm; with colours, normals and sigma, for the Point Cloud Library",
    Sizes(200, 24, 4, 4),
    _write,
    takes_points=True,
    read=_read,
    holds_scalars=True,
)
