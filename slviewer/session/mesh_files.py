"""Points and meshes for other programs; the file's suffix says how. What is written can be read anywhere, in its size.

=======  ===========================================================================================================
`.ply`   binary, float32, mm: normals, colours, the expected errors (sigma) and other values of each point
`.stl`   binary, mm: triangles alone
`.obj`   text, mm: colours of the vertices, normals
`.glb`   binary glTF, whose unit is the metre: vertices are written in metres; colours, normals
`.xyz`   text, mm: x y z of a point a line, and its red green blue; no other line, which most readers would not bear
=======  ===========================================================================================================

Large ones are written piece by piece, and appear whole or not at all.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from slviewer import __version__
from slviewer.errors import InputError
from slviewer.session.atomic import arriving_file
from slviewer.session.glb import write_glb
from slviewer.session.ply import FACE, check_faces, pieces, replace_nan, to_ascii, write_ply
from slviewer.surface.shapes import Mesh, PointSet

POINT_FORMATS = ("ply", "xyz", "glb")
MESH_FORMATS = ("ply", "stl", "obj", "glb", "xyz")
IN_WORDS = {
    "ply": "mm; with colours, normals and sigma",
    "stl": "mm; the triangles alone",
    "obj": "mm; with colours and normals",
    "glb": "metres, as glTF demands, so that programs show the true size; with colours",
    "xyz": "mm; text, x y z of a point a line, and its colour",
}
"""Units and content of each format."""
FACET = np.dtype([("normal", "<f4", (3,)), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
DECIMALS = 6
"""Of lengths in text: a nanometre, below what a float32 of some hundred mm resolves."""
LENGTHS = " ".join([f"%.{DECIMALS}f"] * 3)
_NUMBER, _SMALL, _GREY = 11, 9, 4
"""Characters that a coordinate, a sigma or a part of a normal, and a grey level take in text, with the blank."""


def write_shape(
    path: str | Path,
    shape: PointSet | Mesh,
    *,
    scalars: Mapping[str, np.ndarray] | None = None,
    notes: Sequence[str] = (),
) -> int:
    """Writes points or a mesh as the suffix says, and returns the file's size in bytes.

    ``scalars``: values (n,) of each point by name, such as ``sigma_noise`` mm or ``deviation`` mm, for the formats that
    hold them (PLY); the shape's own ``sigma_mm`` is called ``sigma``. ``notes``: sentences for the comments.

    Raises InputError for another suffix, for points where a format takes only triangles, for NaN points and for an
    empty shape; SessionError where the disk refuses (a file of that name is left as it was).
    """
    path = Path(path)
    file_format = path.suffix.lower().removeprefix(".")
    points, faces = (shape.vertices, shape.faces) if isinstance(shape, Mesh) else (shape.points, None)
    formats = POINT_FORMATS if faces is None else MESH_FORMATS
    if file_format not in formats:
        what = "a cloud" if faces is None else "a mesh"
        why = ": it has no triangles" if file_format in MESH_FORMATS else ""
        listed = ", ".join(f".{each}" for each in formats)
        raise InputError(f"{path.name}: {what} cannot be written so{why}; choose one of {listed}")
    if not len(points) or (faces is not None and not len(faces)):
        raise InputError(f"{path.name} would be empty: there is nothing to write")
    if not np.isfinite(points).all():
        raise InputError(f"{path.name}: some points are NaN: select the valid ones first")
    values = dict(scalars or {})
    if shape.sigma_mm is not None:
        values.setdefault("sigma", shape.sigma_mm)
    if file_format == "ply":
        write_ply(path, points, shape.colours, shape.normals, values, faces, notes)
    elif file_format == "glb":
        write_glb(path, shape, notes)
    elif faces is None or file_format == "xyz":
        _write_xyz(path, points, shape.colours)
    elif file_format == "stl":
        _write_stl(path, points, faces)
    else:
        _write_obj(path, points, faces, shape.normals, shape.colours, notes)
    return path.stat().st_size


def estimated_bytes(
    file_format: str, points: int, faces: int = 0, *, colours: bool = True, normals: bool = True, scalars: int = 0
) -> int:
    """How large a file of so many points and faces becomes: within 1 % of the binary ones, some 20 % of texts."""
    if file_format == "ply":
        return 300 + points * (12 + 12 * normals + 3 * colours + 4 * scalars) + faces * FACE.itemsize
    if file_format == "stl":
        return 84 + faces * FACET.itemsize
    if file_format == "glb":
        return 1200 + points * (12 + 12 * normals + 4 * colours) + 12 * faces
    if file_format == "obj":
        vertex = 3 * _NUMBER + 2 + normals * (3 * _SMALL + 4) + 21 * colours
        return 200 + points * vertex + faces * (3 + 3 * (1 + normals) * len(str(points)) + 6 * normals)
    return points * (3 * _NUMBER + 3 * _GREY * colours)


def _comments(notes: Sequence[str]) -> str:
    return "".join(f"# {to_ascii(line)}\n" for line in (f"slviewer {__version__}: units mm", *notes))


def _write_xyz(path: Path, points: np.ndarray, colours: np.ndarray | None) -> None:
    with arriving_file(path, estimated_bytes("xyz", len(points), colours=colours is not None)) as file:
        for part in pieces(len(points)):
            columns = [points[part]] if colours is None else [points[part], colours[part]]
            file.write(_lines(LENGTHS if colours is None else f"{LENGTHS} %d %d %d", *columns))


def _write_stl(path: Path, points: np.ndarray, faces: np.ndarray) -> None:
    check_faces(faces, len(points))
    # a header that began with "solid" would be taken for a text file
    header = f"slviewer {__version__}, binary STL, units mm".encode("ascii").ljust(80)
    with arriving_file(path, 84 + len(faces) * FACET.itemsize) as file:
        file.write(header + np.uint32(len(faces)).astype("<u4").tobytes())
        for part in pieces(len(faces)):
            corners = points[faces[part]]
            records = np.zeros(len(corners), FACET)
            across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
            records["normal"] = across / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-30)
            records["corners"] = corners
            file.write(records.data)


def _write_obj(
    path: Path,
    points: np.ndarray,
    faces: np.ndarray,
    normals: np.ndarray | None,
    colours: np.ndarray | None,
    notes: Sequence[str],
) -> None:
    check_faces(faces, len(points))
    size = estimated_bytes("obj", len(points), len(faces), colours=colours is not None, normals=normals is not None)
    with arriving_file(path, size) as file:
        file.write(_comments(notes).encode("ascii"))
        for part in pieces(len(points)):
            if colours is None:
                file.write(_lines(f"v {LENGTHS}", points[part]))
            else:
                file.write(_lines(f"v {LENGTHS} %.4f %.4f %.4f", points[part], colours[part] / 255))
        for part in pieces(0 if normals is None else len(points)):
            assert normals is not None
            file.write(_lines(f"vn {LENGTHS}", replace_nan("nx", normals[part])))
        for part in pieces(len(faces)):
            corners = faces[part] + 1
            if normals is None:
                file.write(_lines("f %d %d %d", corners))
            else:  # each vertex has its own
                file.write(_lines("f %d//%d %d//%d %d//%d", np.repeat(corners, 2, axis=1)))


def _lines(pattern: str, *columns: np.ndarray) -> bytes:
    """A line of ASCII text for each row of the columns (n, k) side by side; `pattern` has a conversion for each."""
    rows = np.concatenate([np.asarray(each, np.float64) for each in columns], axis=1)
    rows = np.round(rows, DECIMALS) + 0.0  # no "-0.000000"
    return ((pattern + "\n") * len(rows) % tuple(rows.ravel().tolist())).encode("ascii")
