"""Clouds and meshes as binary PLY: little endian, float32, in mm; complete or absent."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from struct import Struct

import numpy as np

from slviewer import __version__
from slviewer.errors import InputError
from slviewer.printable import escape_controls
from slviewer.session.atomic import arriving_file
from slviewer.session.reading import MAX_CLOUD_BYTES, decoding, read_input

PLACE, NORMAL, COLOURS = ("x", "y", "z"), ("nx", "ny", "nz"), ("red", "green", "blue")
_WRITTEN_TYPES = {"<f4": "float", "<f8": "double", "u1": "uchar"}
_TYPES = {
    name: code
    for names, code in {
        "char int8": "i1",
        "uchar uint8": "u1",
        "short int16": "i2",
        "ushort uint16": "u2",
        "int int32": "i4",
        "uint uint32": "u4",
        "float float32": "f4",
        "double float64": "f8",
    }.items()
    for name in names.split()
}
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
NO_INDICES = np.empty(0, np.int64)
PlyProperty = tuple[str, str, str]
"""Name and type of a property, and for a list the type of its length."""
PlyElements = dict[str, tuple[int, list[PlyProperty]]]
"""Of each element the number and the properties."""
PlyRows = dict[str, tuple[np.ndarray, np.ndarray]]
"""Of each property the values (k,) of all elements, and their number (n,) in each element."""
FACE = np.dtype([("count", "u1"), ("vertices", "<i4", (3,))])
CHUNK = 1 << 15
"""Points that are packed at a time, in the processor's cache."""
FAR_MM = 4096.0
"""From the origin: from here on float32 rounds by up to 0.24 um, and coordinates get an origin."""
UNKNOWN_SIGMA = -1.0
"""Value of an unknown standard deviation: no NaN is written, and 0 would claim too much."""


@dataclass(frozen=True, eq=False)
class Ply:
    """A PLY's content: ``points`` (n, 3) float32 mm, ``colours`` (n, 3) uint8, ``normals`` (n, 3)
    float32, ``faces`` (m, 3) int32, each None where absent, and every other property of the
    vertices in ``scalars`` by name, (n,). Unknown normals and sigmas are NaN."""

    points: np.ndarray
    colours: np.ndarray | None = None
    normals: np.ndarray | None = None
    scalars: dict[str, np.ndarray] = field(default_factory=dict)
    faces: np.ndarray | None = None


def write_ply(
    path: str | Path,
    points: np.ndarray,
    colours: np.ndarray | None = None,
    normals: np.ndarray | None = None,
    scalars: Mapping[str, np.ndarray] | None = None,
    faces: np.ndarray | None = None,
    notes: Sequence[str] = (),
) -> None:
    """Writes points (n, 3) mm, and what else is given, as one binary PLY that appears whole or not
    at all.

    ``colours``: (n,) grey or (n, 3) RGB, uint8. ``normals``: (n, 3); one that is not known (NaN) is
    written as 0 0 0. ``scalars``: named (n,), as properties of the vertices; a sigma that is not
    known is written as -1. ``faces``: (m, 3) indices into the points. ``notes``: sentences for the
    file's comments, besides those that state the program and the units. Numbers are float32, of
    scalars in float64, and of points beyond `FAR_MM` in float64, double. Raises InputError for
    shapes that do not fit together and for NaN points; SessionError where the file cannot be
    written (an older file of that name stays unchanged).
    """
    points = np.asarray(points)
    fields = _vertex_fields(points, colours, normals, scalars or {})
    # as groups of plain bytes, which are packed in half of the time
    sizes = [np.dtype(code).itemsize * len(names) for names, code, _ in fields]
    vertex = np.dtype([(f"{i}", f"V{size}") for i, size in enumerate(sizes)])
    header = ["ply", "format binary_little_endian 1.0", "comment slviewer: units mm"]
    header += [
        f"comment {to_ascii(note)}" for note in (f"written by slviewer {__version__}", *notes)
    ]
    header.append(f"element vertex {len(points)}")
    header += [
        f"property {_WRITTEN_TYPES[code]} {name}" for names, code, _ in fields for name in names
    ]
    size = len(points) * vertex.itemsize
    if faces is not None:
        faces = np.asarray(faces)
        check_faces(faces, len(points))
        header += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
        size += len(faces) * FACE.itemsize
    header.append("end_header\n")
    with arriving_file(Path(path), size) as file:
        file.write("\n".join(header).encode("ascii"))
        records = np.empty(min(len(points), CHUNK), vertex)
        for begin in range(0, len(points), CHUNK):
            chunk = records[: len(points) - begin]
            for i, (names, code, values) in enumerate(fields):
                some = replace_nan(names[0], values[begin : begin + CHUNK])
                chunk[f"{i}"] = np.ascontiguousarray(some, code).reshape(-1).view(vertex[i])
            file.write(chunk.data)
        if faces is not None:
            triangles = np.empty(len(faces), FACE)
            triangles["count"], triangles["vertices"] = 3, faces
            file.write(triangles.data)


def read_ply(path: str | Path) -> Ply:
    """Read the content of a PLY that ``write_ply`` wrote.

    Raises InputError for an absent or truncated file and for other kinds of PLY (text, big endian,
    polygons).
    """
    path = Path(path)
    data = read_input(path, MAX_CLOUD_BYTES, "check its name.")
    if not data.startswith(b"ply\nformat binary_little_endian 1.0\n"):
        raise InputError(
            f"{path} is not a binary little-endian PLY",
            "only files that slviewer wrote can be read back.",
        )
    with decoding(path, InputError):
        _, elements, position = parse_ply_header(data)
        rows: dict[str, PlyRows] = {}
        for element, described in elements.items():
            rows[element], position = read_ply_rows(data, position, *described)
    vertices = {name: values for name, (values, _) in rows.get("vertex", {}).items()}
    if position != len(data) or not set(PLACE) <= vertices.keys():
        raise InputError(
            f"{path} holds {len(data)} bytes and the properties {', '.join(vertices) or 'none'}",
            "it is damaged, or has no points.",
        )
    points, normals, colours = (
        np.stack([vertices.pop(name) for name in names], axis=1)
        if set(names) <= vertices.keys()
        else None
        for names in (PLACE, NORMAL, COLOURS)
    )
    for name, values in vertices.items():
        if name.startswith("sigma"):
            values[values == UNKNOWN_SIGMA] = np.nan
    if normals is not None:
        normals[~normals.any(axis=1)] = np.nan
    assert points is not None
    if "face" not in rows:
        return Ply(points, colours, normals, vertices)
    corners, counts = rows["face"].get("vertex_indices", (NO_INDICES, np.ones(1)))
    if (counts != 3).any():
        raise InputError(f"{path} has faces that are not triangles", "triangulate it first.")
    return Ply(points, colours, normals, vertices, corners.reshape(-1, 3))


def parse_ply_header(data: bytes) -> tuple[str, PlyElements, int]:
    """Return the byte order of a PLY ("": it is text), of each element the number and the
    properties, and where its body begins. Raises ValueError or LookupError for other content."""
    end = re.search(rb"[\r\n]end_header[ \t]*(\r\n|\n|\r)", data[:65536])
    if end is None or not data.startswith(b"ply"):
        raise ValueError("it has no header of a PLY")
    order, elements = "", {}
    properties: list[PlyProperty] = []
    for words in map(str.split, data[: end.start()].decode("latin-1").splitlines()):
        if words[:1] == ["format"]:
            order = _ORDERS[words[1]]
        elif words[:1] == ["element"]:
            properties = []
            elements[words[1]] = int(words[2]), properties
        elif words[:1] == ["property"]:
            kinds = [word for word in words[1:-1] if word != "list"]
            if unknown := [kind for kind in kinds if kind not in _TYPES]:
                raise ValueError(f"its property {words[-1]} is of the unknown type {unknown[0]}")
            codes = [order + _TYPES[kind] for kind in kinds]
            properties.append((words[-1], codes[-1], codes[0] if len(codes) > 1 else ""))
    return order, elements, end.end()


def read_ply_rows(
    body: bytes, position: int, count: int, properties: list[PlyProperty]
) -> tuple[PlyRows, int]:
    """Return the values of ``count`` elements, and the position after the last. Raises ValueError
    where the file ends before."""
    if count < 1:
        return {name: (np.empty(0, code), NO_INDICES) for name, code, _ in properties}, position
    first = _walk_ply_rows(body, position, 1, properties)[0]
    row = np.dtype(
        [
            field
            for name, code, length in properties
            for field in ([(f"{name}#", length)] if length else [])
            + [(name, code, (int(first[name][1][0]),))]
        ]
    )
    if position + count * row.itemsize <= len(body):
        rows = np.frombuffer(body, row, count, position)
        sizes = {name: row[name].shape[0] for name, _, _ in properties}
        if all((rows[f"{name}#"] == sizes[name]).all() for name, _, length in properties if length):
            values = {name: (rows[name].ravel(), np.full(count, n)) for name, n in sizes.items()}
            return values, position + rows.nbytes
    return _walk_ply_rows(body, position, count, properties)


def _walk_ply_rows(
    body: bytes, position: int, count: int, properties: list[PlyProperty]
) -> tuple[PlyRows, int]:
    """Return what `read_ply_rows` does, element by element, whose lists may differ in length."""
    values: dict[str, list[bytes]] = {name: [] for name, _, _ in properties}
    steps = [
        (values[name], np.dtype(code).itemsize, length and Struct(code[0] + np.dtype(length).char))
        for name, code, length in properties
    ]
    for _ in range(count):
        for parts, size, length in steps:
            if length:
                if position + length.size > len(body):
                    raise ValueError("it ends early")
                size *= int(length.unpack_from(body, position)[0])
                position += length.size
            if not 0 <= size <= len(body) - position:
                raise ValueError(f"a list of {size} bytes")
            parts.append(body[position : position + size])
            position += size
    return {
        name: (
            np.frombuffer(bytearray().join(values[name]), code),
            np.array([len(part) for part in values[name]]) // np.dtype(code).itemsize,
        )
        for name, code, _ in properties
    }, position


def to_ascii(note: str) -> str:
    """Convert a sentence to one line of printable ASCII, for the comments of a file."""
    return " ".join(escape_controls(note).encode("ascii", "replace").decode().split())


def replace_nan(name: str, values: np.ndarray) -> np.ndarray:
    """Replace unknown values of a vertex property by their code in the file: see ``write_ply``."""
    if values.dtype.kind != "f" or name in PLACE:
        return values
    if name not in NORMAL and not name.startswith("sigma"):
        return values
    return np.where(np.isfinite(values), values, 0.0 if name in NORMAL else UNKNOWN_SIGMA)


def check_faces(faces: np.ndarray, count: int) -> None:
    """Raise InputError for faces that are not triangles between ``count`` points."""
    if (
        faces.ndim != 2
        or faces.shape[1] != 3
        or (faces.size and not 0 <= faces.min() <= faces.max() < count)
    ):
        raise InputError(
            f"Faces of shape {faces.shape} were given",
            f"(m, 3) indices below {count}, the number of points.",
        )


def _vertex_fields(
    points: np.ndarray,
    colours: np.ndarray | None,
    normals: np.ndarray | None,
    scalars: Mapping[str, np.ndarray],
) -> list[tuple[tuple[str, ...], str, np.ndarray]]:
    """(names, type, values (n,) or (n, k)) of the properties of a vertex, in the order in which PLY
    lays them out."""
    if points.ndim != 2 or points.shape[1] != 3:
        raise InputError(
            f"Points of shape {points.shape} were given",
            "a PLY holds (n, 3); select the valid ones first.",
        )
    if not np.isfinite(points).all():
        raise InputError("Some points are NaN", "select the valid ones first.")
    shape, count = points.shape, len(points)
    given: list[tuple[str, tuple[str, ...], str, np.ndarray | None]] = [
        ("normals", NORMAL, "<f4", normals),
        ("colours", COLOURS, "u1", colours),
        *((name, (name,), _to_type(each), np.asarray(each)) for name, each in scalars.items()),
    ]
    place_type = _to_type(points, FAR_MM)
    fields: list[tuple[tuple[str, ...], str, np.ndarray]] = [(PLACE, place_type, points)]
    for what, names, code, values in given:
        if values is None:
            continue
        shapes = [shape] if names == NORMAL else [shape, (count,)] if code == "u1" else [(count,)]
        if values.shape not in shapes:
            raise InputError(
                f"{what} of shape {values.shape} do not belong to {count} points",
                "give one for each point.",
            )
        if code == "u1" and values.dtype != np.uint8:
            raise InputError(f"Colours of {values.dtype} were given", "they must be uint8.")
        if len(names) == 1:
            _check_name(what, [name for before, _, _ in fields for name in before])
        elif values.ndim == 1:
            values = np.repeat(values, len(names)).reshape(shape)
        fields.append((names, code, values))
    return fields


def _to_type(values: np.ndarray, beyond: float = 0.0) -> str:
    """Return the type in which the values of a property are written, float32 where all are within
    ``beyond``."""
    is_wide = np.asarray(values).dtype == np.float64
    return "<f8" if is_wide and not np.abs(values).max(initial=0) <= beyond else "<f4"


def _check_name(name: str, others: Sequence[str]) -> None:
    """Raise InputError for a name that no PLY property can have besides others."""
    if not (name.isascii() and name.isidentifier()) or name in others:
        raise InputError(
            f"A scalar named {name!r} cannot be a PLY property",
            "use letters, digits, _, and a new name.",
        )
