"""Clouds and meshes as binary PLY: little endian, float32, in mm; complete or absent."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.lib.recfunctions import structured_to_unstructured

from slviewer import __version__
from slviewer.errors import InputError
from slviewer.printable import escape_controls
from slviewer.session.atomic import arriving_file
from slviewer.session.reading import MAX_CLOUD_BYTES, decoding, read_input

PLACE, NORMAL, COLOURS = ("x", "y", "z"), ("nx", "ny", "nz"), ("red", "green", "blue")
TYPES = {"float": "<f4", "double": "<f8", "uchar": "u1", "int": "<i4"}
FACE = np.dtype([("count", "u1"), ("vertices", "<i4", (3,))])
CHUNK = 1 << 15
"""Points that are packed at a time, in the processor's cache."""
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
    written as 0 0 0. ``scalars``: named (n,), as float32 properties of the vertices; a sigma that
    is not known is written as -1. ``faces``: (m, 3) indices into the points. ``notes``: sentences
    for the file's comments, besides those that state the program and the units. Raises InputError
    for shapes that do not fit together and for NaN elsewhere; SessionError where the file cannot be
    written (an older file of that name stays unchanged).
    """
    points = np.asarray(points)
    fields = _vertex_fields(points, colours, normals, scalars or {})
    # as groups of plain bytes, which are packed in half of the time
    sizes = [np.dtype(code).itemsize * len(names) for names, code, _ in fields]
    vertex = np.dtype([(f"{i}", f"V{size}") for i, size in enumerate(sizes)])
    types = {code: name for name, code in TYPES.items()}
    header = ["ply", "format binary_little_endian 1.0", "comment slviewer: units mm"]
    header += [
        f"comment {to_ascii(note)}" for note in (f"written by slviewer {__version__}", *notes)
    ]
    header.append(f"element vertex {len(points)}")
    header += [f"property {types[code]} {name}" for names, code, _ in fields for name in names]
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
    end = data.find(b"end_header\n")
    lines = [line.split() for line in data[: max(end, 0)].decode("ascii", "replace").splitlines()]
    if lines[:2] != [["ply"], ["format", "binary_little_endian", "1.0"]]:
        raise InputError(
            f"{path} is not a binary little-endian PLY: only files that slviewer wrote can be read"
            " back."
        )
    with decoding(path, InputError):
        return _parse_ply(path, data, end, lines[2:])


def _parse_ply(path: Path, data: bytes, end: int, lines: list[list[str]]) -> Ply:
    """Return the content of a PLY from its bytes and the words of its header's ``lines``."""
    counts: dict[str, int] = {}
    properties: list[tuple[str, str]] = []
    for words in lines:
        if words[0] == "element":
            counts[words[1]] = int(words[2])
            if counts[words[1]] < 0:
                raise ValueError("a negative number of elements")
        elif words[0] == "property" and list(counts) == ["vertex"] and words[1] in TYPES:
            properties.append((words[2], TYPES[words[1]]))
        elif words[0] == "property" and words[1:] != ["list", "uchar", "int", "vertex_indices"]:
            raise InputError(
                f"{path} holds '{' '.join(words)}', which slviewer does not write: convert it"
                " first."
            )
    vertex = np.dtype(properties)
    start = end + len(b"end_header\n")
    middle = start + counts.get("vertex", 0) * vertex.itemsize
    if len(data) != middle + counts.get("face", 0) * FACE.itemsize or not set(PLACE) <= set(
        vertex.names or ()
    ):
        raise InputError(
            f"{path} is {len(data)} bytes, not the size in its header: it is truncated, or has"
            " polygons."
        )
    vertices = np.frombuffer(data[start:middle], dtype=vertex)
    faces = np.frombuffer(data[middle:], dtype=FACE)
    if (faces["count"] != 3).any():
        raise InputError(f"{path} has faces that are not triangles: triangulate it first.")
    return _parse_content(vertices, faces["vertices"].copy() if "face" in counts else None)


def to_ascii(note: str) -> str:
    """Convert a sentence to one line of printable ASCII, for the comments of a file."""
    return " ".join(escape_controls(note).encode("ascii", "replace").decode().split())


def replace_nan(name: str, values: np.ndarray) -> np.ndarray:
    """Replace unknown values of a vertex property by their code in the file: see ``write_ply``."""
    if values.dtype.kind != "f" or name in PLACE:
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
            f"Faces of shape {faces.shape} were given: (m, 3) indices below {count}, the number of"
            " points."
        )


def _parse_content(vertices: np.ndarray, faces: np.ndarray | None) -> Ply:
    """Return points, colours, normals, scalars and faces from the file's vertex and face
    records."""
    names = vertices.dtype.names or ()
    points, normals, colours = (
        structured_to_unstructured(vertices[list(fields)], copy=True)
        if set(fields) <= set(names)
        else None
        for fields in (PLACE, NORMAL, COLOURS)
    )
    known = {*PLACE, *NORMAL, *COLOURS}
    scalars = {name: vertices[name].copy() for name in names if name not in known}
    for name, values in scalars.items():
        if name.startswith("sigma"):
            values[values == UNKNOWN_SIGMA] = np.nan
    assert points is not None
    if normals is not None:
        normals[~normals.any(axis=1)] = np.nan
    return Ply(points, colours, normals, scalars, faces)


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
            f"Points of shape {points.shape} were given: a PLY holds (n, 3); select the valid ones"
            " first."
        )
    if not np.isfinite(points).all():
        raise InputError("Some points are NaN: select the valid ones first.")
    shape, count = points.shape, len(points)
    given: list[tuple[str, tuple[str, ...], str, np.ndarray | None]] = [
        ("normals", NORMAL, "<f4", normals),
        ("colours", COLOURS, "u1", colours),
        *((name, (name,), "<f4", np.asarray(values)) for name, values in scalars.items()),
    ]
    fields: list[tuple[tuple[str, ...], str, np.ndarray]] = [(PLACE, "<f4", points)]
    for what, names, code, values in given:
        if values is None:
            continue
        shapes = [shape] if names == NORMAL else [shape, (count,)] if code == "u1" else [(count,)]
        if values.shape not in shapes:
            raise InputError(
                f"{what} of shape {values.shape} do not belong to {count} points: give one for each"
                " point."
            )
        if code == "u1" and values.dtype != np.uint8:
            raise InputError(f"Colours of {values.dtype} were given: they must be uint8.")
        if len(names) == 1:
            _check_scalar(what, values, [name for before, _, _ in fields for name in before])
        elif values.ndim == 1:
            values = np.repeat(values, len(names)).reshape(shape)
        fields.append((names, code, values))
    return fields


def _check_scalar(name: str, values: np.ndarray, others: Sequence[str]) -> None:
    """Raise InputError for a name that no PLY property can have besides others, and for unknown
    values other than a sigma's."""
    if not (name.isascii() and name.isidentifier()) or name in others:
        raise InputError(
            f"A scalar named {name!r} cannot be a PLY property: use letters, digits, _, and a new"
            " name."
        )
    unknown = np.count_nonzero(~np.isfinite(values))
    if unknown and not name.startswith("sigma"):
        raise InputError(f"{name} is not known of {unknown} points: leave them out.")
