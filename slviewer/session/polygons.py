"""Polygons of STL, PLY and OBJ files as they stand there, and their triangles."""

import codecs
import re
from dataclasses import dataclass, field

import numpy as np

from slviewer.errors import SessionError
from slviewer.geometry.vectors import lengths
from slviewer.session.cad import CHORD_MM
from slviewer.session.columns import Columns, note_unused
from slviewer.session.ply import (
    COLOURS,
    NO_INDICES,
    NORMAL,
    PLACE,
    PlyElements,
    PlyRows,
    parse_ply_header,
    read_ply_rows,
)

MAX_TEXT_BYTES = 1 << 27
"""Of a text file: its numbers need several times its size while they are parsed."""
MAX_TRIANGLES = 2_000_000
MAX_CORNERS = 10_000
"""Of one polygon; and of all that cross themselves, for which clipping ears is slow."""
_FACET = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_HEADER_BYTES = 84
_OBJ_NAMES = {4: (*PLACE, "w"), 6: (*PLACE, *COLOURS), 7: (*PLACE, *COLOURS, "alpha")}
"""Names of the numbers of an OBJ's vertices, by how many they are."""
_OBJ_READ = {"v", "f", "g", "o", "s"}
"""Statements that are read, or hold nothing but names and smoothing."""


@dataclass(frozen=True, eq=False)
class Polygons:
    """``vertices`` (n, 3) float64; ``corners`` (k,) int64, the vertices of all polygons one after
    another; ``counts`` (m,) int64, the number of corners of each polygon. ``columns``: of a file of
    named or coloured vertices their numbers by name, with x y z."""

    vertices: np.ndarray
    corners: np.ndarray
    counts: np.ndarray
    columns: Columns = field(default_factory=dict)


def read_polygons(name: str, data: bytes, notes: list[str]) -> Polygons:
    """Return the polygons in the content of an STL, PLY, OBJ or OFF file; what was repaired is
    appended to ``notes``.

    Raises SessionError, with the reason, for a file that is truncated, damaged or too large.
    Corners may still refer to vertices that are missing.
    """
    try:
        return _READERS[name.rpartition(".")[2].lower()](name, data, notes)
    except MemoryError as error:
        raise SessionError(f"{name} does not fit into the memory", "decimate it first") from error
    except (ValueError, LookupError, OverflowError, TypeError) as error:
        raise SessionError(
            f"{name} cannot be read ({error})",
            "it is damaged, or of a kind that is not read; export it again",
        ) from error


def to_polygons(vertices: np.ndarray, faces: np.ndarray) -> Polygons:
    """Return triangles (m, 3), or (3 m,), between vertices (n, 3) as polygons."""
    corners = faces.ravel().astype(np.int64)
    return Polygons(vertices.astype(np.float64), corners, np.full(len(corners) // 3, 3))


def triangulate_polygons(polygons: Polygons, notes: list[str]) -> np.ndarray:
    """Return the triangles (m, 3) of polygons in mm, which turn as the polygons do; concave ones
    are cut by clipping ears. Polygons that are not flat, or cross themselves, are named in
    ``notes``. Raises SessionError for many that cross themselves.
    """
    vertices, counts = polygons.vertices, polygons.counts
    starts = np.cumsum(counts) - counts
    triangles, heights, crossing = [np.empty((0, 3), np.int64)], [np.empty(0)], []
    for k in np.unique(counts[counts > 2]):
        rows = polygons.corners[starts[counts == k][:, None] + np.arange(k)]
        if k == 3:
            triangles.append(rows)
            continue
        for turn in range(2):  # one of the two fans fits every quadrilateral
            edges = vertices[rows[:, 1:]] - vertices[rows[:, :1]]
            fan = np.cross(edges[:, :-1], edges[:, 1:])
            normal = fan.sum(axis=1)
            area = lengths(normal)
            normal /= np.maximum(area, np.finfo(float).tiny)[:, None]
            if not turn:
                above = np.einsum("mkc,mc->mk", edges, normal)
                heights.append(above.max(axis=1).clip(0) - above.min(axis=1).clip(max=0))
            fits = (np.einsum("mkc,mc->mk", fan, normal) > 1e-9 * area[:, None]).all(axis=1)
            triangles += [rows[fits][:, [0, i, i + 1]] for i in range(1, k - 1)]
            rows = np.roll(rows[~fits], -1, axis=1)
        for row in rows:
            found, is_simple = _clip_ears(vertices[row])
            triangles.append(row[found])
            crossing += [] if is_simple else [k]
            if sum(crossing) > MAX_CORNERS:
                raise SessionError(
                    f"{len(crossing):,} polygons or more cross themselves, one of {k:,} corners",
                    "export the model again, as triangles",
                )
    if len(uneven := (height := np.concatenate(heights))[height > CHORD_MM]):
        notes.append(
            f"{len(uneven):,} of {len(counts):,} polygons are not flat, by up to"
            f" {uneven.max():.2g} mm: their surface is not defined any closer"
        )
    if crossing:
        notes.append(
            f"{len(crossing):,} of {len(counts):,} polygons cross themselves, and their surface is"
            " not defined: export the model as triangles if it matters there"
        )
    return np.concatenate(triangles)


def _clip_ears(points: np.ndarray) -> tuple[np.ndarray, bool]:
    """Return the triangles (m, 3) of one polygon (k, 3), and whether they cover it exactly."""
    from mapbox_earcut import triangulate_float64

    edges = points - points[0]
    normal = np.cross(edges[1:-1], edges[2:]).sum(axis=0)
    axis = int(np.argmax(np.abs(normal)))
    flat = np.delete(edges, axis, axis=1)
    triangles = triangulate_float64(flat, np.array([len(flat)])).reshape(-1, 3).astype(np.int64)
    a, b, c = (edges[triangles[:, i]] for i in range(3))
    areas = np.cross(b - a, c - a)[:, axis]
    turned = areas * normal[axis] < 0
    triangles[turned] = triangles[turned][:, ::-1]
    return triangles, bool(np.isclose(np.abs(areas).sum(), abs(normal[axis]), rtol=1e-6))


def too_many(name: str, amount: str) -> SessionError:
    """Return the error for a model that is too large."""
    return SessionError(
        f"{name} has {amount}, and at most {MAX_TRIANGLES:,} triangles are read",
        "decimate it first",
    )


def _to_text(name: str, data: bytes) -> bytes:
    """Return a text without byte order mark, its lines ended by line feeds."""
    if len(data) > MAX_TEXT_BYTES:
        raise SessionError(
            f"{name} has {len(data) / 1e6:.0f} MB of text, and {MAX_TEXT_BYTES / 1e6:.0f} are read",
            "export it in a binary format, or decimate it first",
        )
    if data[:2] in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE):
        data = data.decode("utf-16").encode()
    return data.removeprefix(codecs.BOM_UTF8).replace(b"\r\n", b"\n").replace(b"\r", b"\n")


def _with_points(numbers: bytes, notes: list[str]) -> bytes:
    """Return numbers whose decimal commas, where no point occurs beside them, are points."""
    if b"," not in numbers or b"." in numbers:
        return numbers
    notes.append("the commas in its numbers were read as decimal points")
    return numbers.replace(b",", b".")


def _read_obj(name: str, data: bytes, notes: list[str]) -> Polygons:
    """Return the polygons of an OBJ; indices below zero count from the line where they stand."""
    text = _to_text(name, data).replace(b"\\\n", b" ")
    lines = re.findall(rb"^[ \t]*([vf])[ \t]([^\n#]*)", text, re.MULTILINE)
    is_vertex = np.array([kind == b"v" for kind, _ in lines], bool)
    numbers = _with_points(b"\n".join(rest for kind, rest in lines if kind == b"v"), notes)
    words = [line.split() for line in numbers.splitlines()]
    if len(found := {len(each) for each in words}) > 1 or found & {0, 1, 2}:
        raise SessionError(
            f"{name} has vertices of {' and '.join(map(str, sorted(found)))} numbers",
            "export the model again",
        )
    rows = np.array(words, np.float64).reshape(len(words), -1)
    others = [f"number {i} of its vertices" for i in range(4, rows.shape[1] + 1)]
    columns = dict(zip(_OBJ_NAMES.get(rows.shape[1], [*PLACE, *others]), rows.T, strict=False))
    statements = {
        each.decode() for each in re.findall(rb"^[ \t]*([a-z_]+)[ \t]", text, re.MULTILINE)
    }
    note_unused(sorted(statements - _OBJ_READ), notes)
    faces = [rest.split() for kind, rest in lines if kind == b"f"]
    counts = np.array([len(face) for face in faces], np.int64)
    _check_counts(name, counts)
    corners = np.array([corner.partition(b"/")[0] for face in faces for corner in face], np.int64)
    before = np.repeat(np.cumsum(is_vertex)[~is_vertex], counts)
    corners = np.where(corners < 0, corners + before, corners - 1)
    return Polygons(rows[:, :3], corners, counts, columns)


def _read_off(name: str, data: bytes, notes: list[str]) -> Polygons:
    """Return the polygons of an OFF, whose first word names what follows x y z."""
    text = re.sub(rb"#[^\n]*", b"", _to_text(name, data))
    head = re.match(rb"\s*(ST)?(C?)(N?)OFF\s+(\d+)\s+(\d+)(?:[ \t]+\d+)?[ \t]*\n", text)
    if head is None:
        raise SessionError(
            f"{name} is no OFF as text, of three coordinates", "export it as such, or as PLY"
        )
    count, faces = int(head[4]), int(head[5])
    lines = [each for line in text[head.end() :].splitlines() if (each := line.split())]
    if len(lines) < count + faces:
        raise SessionError(
            f"{name} holds {len(lines):,} of {count + faces:,} vertices and faces",
            "it is truncated; export it again",
        )
    rows = np.array(lines[:count], np.float64).reshape(count, -1)
    titles = [*PLACE, *(NORMAL if head[3] else ())]
    if rest := rows.shape[1] - len(titles):
        titles += [*COLOURS, "alpha"][:rest] if head[2] or rest in (3, 4) else []
    others = (f"number {i} of its vertices" for i in range(len(titles) + 1, rows.shape[1] + 1))
    columns = dict(zip([*titles, *others], rows.T, strict=True))
    note_unused(["texture"] if head[1] else [], notes)
    corners, counts = _parse_off_faces(lines[count : count + faces], notes)
    _check_counts(name, counts)
    return Polygons(rows[:, :3], corners, counts, columns)


def _parse_off_faces(lines: list[list[bytes]], notes: list[str]) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners (k,) of faces and their numbers (m,), of lines that begin with these."""
    counts = np.array([int(line[0]) for line in lines], np.int64)
    if any(len(line) > 1 + count for line, count in zip(lines, counts, strict=True)):
        note_unused(["numbers behind the corners of its faces"], notes)
    corners = [line[1 : 1 + count] for line, count in zip(lines, counts, strict=True)]
    if any(len(row) < count for row, count in zip(corners, counts, strict=True)):
        raise ValueError("a face has fewer corners than it states")
    return np.array([each for row in corners for each in row], np.int64), counts


def _read_stl(name: str, data: bytes, notes: list[str]) -> Polygons:
    """Return the triangles of an STL: a binary one, whatever its header says, where the file holds
    as many as it announces."""
    count = int.from_bytes(data[80:_HEADER_BYTES], "little")
    end = _HEADER_BYTES + count * _FACET.itemsize
    if not _HEADER_BYTES <= end <= len(data):
        head = _to_text(name, data[:4096])
        if b"\0" not in head[:_HEADER_BYTES] and re.search(rb"(?i)\b(solid|facet)\b", head):
            return _read_text_stl(name, data, notes)
        held = max(0, len(data) - _HEADER_BYTES) // _FACET.itemsize
        raise SessionError(
            f"{name} is truncated, or no STL: it announces {count:,} triangles and holds {held:,};"
            " export the model again"
        )
    rest = len(data) - end
    if rest >= _FACET.itemsize and data[end:].strip(b"\0\t\n\r\x1a "):
        raise SessionError(
            f"{name} announces {count:,} triangles and holds {count + rest // _FACET.itemsize:,}",
            "export the model again",
        )
    if rest:
        notes.append(f"{rest:,} bytes after the last of its {count:,} triangles were skipped")
    _check_counts(name, np.full(count, 3))
    facets = np.frombuffer(data, _FACET, count, _HEADER_BYTES)
    is_coloured = facets["attribute"].any() or b"COLOR=" in data[:_HEADER_BYTES]
    note_unused(["colours (attribute bytes, COLOR=)"] if is_coloured else [], notes)
    vertices = facets["corners"].reshape(-1, 3)
    return to_polygons(vertices, np.arange(3 * count))


def _read_text_stl(name: str, data: bytes, notes: list[str]) -> Polygons:
    """Return the triangles of a text STL, of one or more solids."""
    text = _to_text(name, data).lower()
    is_whole = text.rfind(b"endsolid") > text.rfind(b"endfacet")
    text = re.sub(rb"^[ \t]*(end)?solid\b[^\n]*?(?=\n|\sfacet\s|\Z)", b"", text, flags=re.MULTILINE)
    begun, ended = (len(re.findall(rb"\b%s\b" % word, text)) for word in (b"facet", b"endfacet"))
    if not is_whole or begun != ended:
        raise SessionError(
            f"{name} is truncated: it ends after {ended:,} triangles, without an 'endsolid';"
            " export the model again"
        )
    _check_counts(name, np.full(ended, 3))
    rows = re.findall(rb"\bvertex\s+(\S+\s+\S+\s+\S+)", text)
    if len(rows) != 3 * ended:
        raise SessionError(
            f"{name} has {len(rows):,} corners in {ended:,} facets, which are triangles in an STL",
            "export the model again",
        )
    numbers = _with_points(b" ".join(rows), notes)
    vertices = np.array(numbers.split(), np.float64).reshape(-1, 3)
    return to_polygons(vertices, np.arange(3 * ended))


def _read_ply(name: str, data: bytes, notes: list[str]) -> Polygons:
    """Return the polygons of a PLY, text or binary."""
    order, elements, start = parse_ply_header(data := data.removeprefix(codecs.BOM_UTF8))
    count = elements["face"][0] if "face" in elements else 0
    if count > MAX_TRIANGLES:
        raise too_many(name, f"{count:,} triangles")
    body = data[start:]
    if not order:
        body = _with_points(_to_text(name, body), notes)
    unused = [each for each in elements if each not in ("vertex", "face")]
    rows = _read_elements(name, body, order, elements, unused)
    lists = [each for each, _, length in elements["vertex"][1] if length]
    columns = {each: values for each, (values, _) in rows["vertex"].items() if each not in lists}
    for axis in set(PLACE) - columns.keys() if {*map(str.upper, PLACE)} <= columns.keys() else ():
        columns[axis] = columns.pop(axis.upper())
    faces = rows.get("face", {})
    indices = next((each for each in ("vertex_indices", "vertex_index") if each in faces), "")
    if not {*PLACE} <= columns.keys() or (faces and not indices):
        has = [*columns, *(f"{each} of its faces" for each in faces)]
        raise SessionError(
            f"{name} has no x y z, or faces without vertex_indices: it has {', '.join(has)}",
            "export the model again",
        )
    unused += [*lists, *(f"{each} of its faces" for each in faces if each != indices)]
    note_unused(unused, notes)
    corners, counts = faces.get(indices, (NO_INDICES, NO_INDICES))
    vertices = np.stack([columns[axis] for axis in PLACE], axis=-1).astype(np.float64)
    _check_counts(name, counts)
    return Polygons(vertices, corners.astype(np.int64), counts.astype(np.int64), columns)


def _read_elements(
    name: str, body: bytes, order: str, elements: PlyElements, unused: list[str]
) -> dict[str, PlyRows]:
    """Return the values of all elements of a PLY; bytes behind the last are named in ``unused``."""
    described = elements
    if not order:  # a text is read as if its numbers were binary
        body = np.array(body.split(), np.float64).tobytes()
        described = {
            element: (count, [(each, "<f8", length and "<f8") for each, _, length in properties])
            for element, (count, properties) in elements.items()
        }
    rows, position = dict[str, PlyRows](), 0
    try:
        for element, (count, properties) in described.items():
            rows[element], position = read_ply_rows(body, position, count, properties)
            for each, code, _ in elements[element][1]:
                values, counts = rows[element][each]
                rows[element][each] = values.astype(code, copy=False), counts
    except ValueError as error:
        raise SessionError(
            f"{name} is truncated, or damaged: not all of its {count:,} elements of the kind"
            f" '{element}' can be read; export the model again"
        ) from error
    if position < len(body):
        unused.append(f"{len(body) - position:,} bytes behind its last element")
    return rows


_READERS = {"stl": _read_stl, "ply": _read_ply, "obj": _read_obj, "off": _read_off}


def _check_counts(name: str, counts: np.ndarray) -> None:
    """Raise SessionError for polygons of ``counts`` (m,) corners that are too many or too large."""
    if (triangles := int((counts - 2).clip(0).sum())) > MAX_TRIANGLES:
        raise too_many(name, f"{triangles:,} triangles or more")
    if len(counts) and counts.max() > MAX_CORNERS:
        raise SessionError(
            f"{name} has a polygon of {counts.max():,} corners, more than {MAX_CORNERS:,}",
            "export the model again, as triangles",
        )
