"""PCD of the Point Cloud Library: binary, float32, mm, with normals, colours (one 32-bit number of
red, green and blue) and the expected errors (sigma). Read as text and compressed too."""

import io
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from slviewer import __version__
from slviewer.registration.open3d_loader import open3d
from slviewer.session.atomic import replace_file
from slviewer.session.ply import COLOURS, NORMAL, PLACE, replace_nan, to_ascii
from slviewer.session.shape_format import Columns, Shape, ShapeFormat, Sizes
from slviewer.surface.shapes import Mesh

_NORMAL = ("normal_x", "normal_y", "normal_z")
_NAMES = dict(zip(_NORMAL, NORMAL, strict=True))
_TYPES = {"F": "f", "I": "i", "U": "u"}
_PACKED = {"rgb", "rgba"}


def _write(path: Path, shape: Shape, scalars: Columns, notes: Sequence[str]) -> None:
    assert not isinstance(shape, Mesh)
    columns = dict(zip(PLACE, shape.points.T, strict=True))
    if shape.normals is not None:
        columns |= dict(zip(_NORMAL, replace_nan("nx", shape.normals).T, strict=True))
    if shape.colours is not None:
        red, green, blue = shape.colours.T.astype(np.uint32)
        columns["rgb"] = (red << 16 | green << 8 | blue).view(np.float32)
    columns |= {name: values for name, values in scalars.items() if name not in columns}
    count, fields = len(shape.points), len(columns)
    comments = "\n# ".join(
        to_ascii(line) for line in (f".PCD v0.7, slviewer {__version__}: units mm", *notes)
    )
    header = (
        f"# {comments}\nVERSION 0.7\nFIELDS {' '.join(columns)}\nSIZE{' 4' * fields}\n"
        f"TYPE{' F' * fields}\nCOUNT{' 1' * fields}\nWIDTH {count}\nHEIGHT 1\n"
        f"VIEWPOINT 0 0 0 1 0 0 0\nPOINTS {count}\nDATA binary\n"
    )
    values = np.stack([np.asarray(each, "<f4") for each in columns.values()], axis=1)
    replace_file(path, header.encode("ascii") + values.tobytes())


def _read(path: Path, data: bytes) -> list[Columns]:
    """Return the fields by name, and the sensor's place."""
    match = re.search(rb"^DATA[ \t]+(\w+)[ \t]*\r?\n", data, re.MULTILINE)
    if match is None:
        raise ValueError("it has no line DATA")
    rows = map(str.split, data[: match.start()].decode("ascii", "replace").splitlines())
    header = {words[0].upper(): words[1:] for words in rows if words}
    count, form, body = int(header["POINTS"][0]), match[1].lower(), data[match.end() :]
    if form == b"binary_compressed":
        columns = _read_compressed(path, body)
    else:
        columns = _read_fields(header, count, body, form == b"binary")
    if len(columns["x"]) != count:
        raise ValueError(f"it has {len(columns['x'])} of {count} points")
    for name in _PACKED & columns.keys():
        packed = np.ascontiguousarray(columns.pop(name)).view(np.uint32)
        parts = [(packed >> shift & 255).astype(np.uint8) for shift in (16, 8, 0)]
        columns |= dict(zip(COLOURS, parts, strict=True))
    sensor = np.array(header.get("VIEWPOINT", [0, 0, 0])[:3], np.float64)
    return [columns | ({"sensor": sensor} if sensor.any() else {})]


def _read_compressed(path: Path, body: bytes) -> dict[str, np.ndarray]:
    """Return the columns of a compressed file."""
    if len(body) < 8 + int.from_bytes(body[:4], "little"):
        raise ValueError("it breaks off")
    cloud = open3d().io.read_point_cloud(str(path))
    columns = dict(zip(PLACE, np.asarray(cloud.points).T, strict=True))
    if cloud.has_normals():
        columns |= dict(zip(NORMAL, np.asarray(cloud.normals).T, strict=True))
    if cloud.has_colors():
        colours = np.rint(255 * np.asarray(cloud.colors)).astype(np.uint8)
        columns |= dict(zip(COLOURS, colours.T, strict=True))
    return columns


def _read_fields(
    header: Mapping[str, list[str]], count: int, body: bytes, is_binary: bool
) -> dict[str, np.ndarray]:
    """Return the columns that a header describes, of bytes or of text."""
    repeats = header.get("COUNT", ["1"] * len(header["FIELDS"]))
    described = zip(header["FIELDS"], header["TYPE"], header["SIZE"], repeats, strict=True)
    fields = [
        (f"{name}{'_' * i if name == '_' else ''}", f"<{_TYPES[kind]}{size}", int(times))
        for i, (name, kind, size, times) in enumerate(described, 1)
    ]
    if is_binary:
        values = np.frombuffer(body, np.dtype(fields), count)
        names = values.dtype.names or ()
        return {_NAMES.get(name, name): _as_column(values[name]) for name in names}
    columns, start = dict[str, np.ndarray](), 0
    table = np.loadtxt(io.BytesIO(body), ndmin=2, max_rows=count)
    for name, kind, times in fields:
        column = _as_column(table[:, start : start + times])
        columns[_NAMES.get(name, name)] = column.astype(kind) if name in _PACKED else column
        start += times
    return columns


def _as_column(values: np.ndarray) -> np.ndarray:
    """Return the values (n, k) of a field, (n,) where it has one."""
    return values[:, 0] if values.shape[1] == 1 else values


FORMAT = ShapeFormat(
    "pcd",
    "mm; with colours, normals and sigma, for the Point Cloud Library",
    Sizes(200, 24, 4, 4),
    _write,
    takes_points=True,
    read=_read,
)
