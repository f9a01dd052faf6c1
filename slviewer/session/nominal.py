"""A nominal model from a file: checked, cleaned, and in millimetres."""

import hashlib
import io
import re
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from slviewer.errors import InputError, SessionError
from slviewer.geometry.vectors import lengths
from slviewer.session import cad
from slviewer.session.reading import expand_user, read_input
from slviewer.surface.shapes import Mesh

Units = Literal["mm", "cm", "m", "inch"]
NOMINALS = "nominal"
"""Folder of a session with the nominal models that were uploaded."""
FORMATS = (".stl", ".ply", ".obj", ".step", ".stp", ".3mf")
MAX_BYTES = 1 << 28
MAX_TEXT_BYTES = 1 << 27
"""Of a text STL or OBJ: its numbers need several times its size while they are parsed."""
MAX_TRIANGLES = 2_000_000
MAX_CORNERS = 1000
"""Of a polygon in an OBJ."""
MM: dict[Units, float] = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "inch": 25.4}
MAX_SIZE_RATIO = 5.0
"""A scan's size over the nominal's, or its inverse, from which on the units must be given."""
MATCHING_SIZE_RATIO = 2.0
"""Units that bring the two so near are proposed."""
MAX_COORDINATE_MM = 1e5
MAX_DEGENERATE_SHARE = 0.5
"""Share of triangles without area from which on a file is refused."""


@dataclass(frozen=True, eq=False)
class Nominal:
    """A nominal model: its ``mesh`` in mm, the file's ``name`` and content ``hash``, the ``units``
    that it was read in (None: none were given, and mm assumed), whether it is ``closed``, and
    ``notes``, one for each repair.
    """

    mesh: Mesh
    name: str
    hash: str
    units: Units | None
    closed: bool
    notes: tuple[str, ...] = ()

    @property
    def size_mm(self) -> np.ndarray:
        """(3,): size of the bounding box."""
        return np.ptp(self.mesh.vertices.astype(np.float64), axis=0)

    def text(self) -> str:
        """Describe the model: name, number of triangles, closed or open, and size in mm."""
        size = " x ".join(f"{side:.1f}" for side in self.size_mm)
        kind = "closed" if self.closed else "open"
        return f"{self.name}: {len(self.mesh.faces):,} triangles, {kind}, {size} mm"


def read_nominal(path: Path | str, units: Units | None = None) -> Nominal:
    """The model in an STL, PLY or OBJ file, whose numbers are in ``units``, or where none are given
    in mm; or in a STEP or 3MF file, which states its units.

    Raises SessionError for a file that cannot be used, with the reason: one that is absent, too
    large, damaged, truncated, of another format, without triangles, or with more than
    `MAX_TRIANGLES`.
    """
    path = expand_user(path)
    if path.suffix.lower() not in FORMATS:
        raise SessionError(
            f"{path.name} is not a nominal model that can be read: give an STL, PLY, OBJ, STEP or"
            " 3MF file"
        )
    remedy = f"give a file of up to {MAX_BYTES >> 20} MiB"
    data = read_input(path, MAX_BYTES, remedy, SessionError)
    notes: list[str] = []
    if (form := path.suffix.lower()[1:]) in cad.PACKAGES:
        vertices, faces = cad.load_triangles(path.name, form, data)
        units = "mm"
        if form != "3mf":
            notes.append(f"its surfaces were triangulated within {cad.CHORD_MM:g} mm")
    else:
        vertices, faces = _load_triangles(path.name, data)
    _check_triangles(path.name, vertices, faces)
    vertices = vertices * MM[units or "mm"]
    if not np.abs(vertices).max() < MAX_COORDINATE_MM:
        raise SessionError(
            f"{path.name} reaches {np.abs(vertices).max():.3g} mm: models up to"
            f" {MAX_COORDINATE_MM:g} mm are read; give its units, or move it to its origin"
        )
    vertices, faces = _drop_degenerate(path.name, vertices, faces, notes)
    faces, closed = _orient_faces(vertices, faces, notes)
    digest = hashlib.blake2b(data, digest_size=20).hexdigest()
    return Nominal(Mesh(vertices, faces), path.name, digest, units, closed, tuple(notes))


def check_size(nominal: Nominal, points: np.ndarray) -> None:
    """Raise InputError where a model, without stated units, is so much smaller or larger than a
    scan's points (n, 3) mm that they may be others: the message states both sizes and the units
    that fit. Nothing is scaled.
    """
    if nominal.units is not None:
        return
    some = points[:: max(1, len(points) // 100_000)]
    scan = float(np.linalg.norm(np.ptp(np.percentile(some, [1, 99], axis=0), axis=0)))
    model = float(np.linalg.norm(nominal.size_mm))
    ratio = scan / model
    if 1 / MAX_SIZE_RATIO < ratio < MAX_SIZE_RATIO:
        return
    fitting = [
        name
        for name, mm in MM.items()
        if 1 / MATCHING_SIZE_RATIO < ratio / mm < MATCHING_SIZE_RATIO and name != "mm"
    ]
    times, than = (ratio, "larger") if ratio > 1 else (1 / ratio, "smaller")
    comparison = (
        f"{nominal.name} measures {_format_size(model)} mm across if its numbers are mm, and the"
        f" scan {_format_size(scan)} mm, about {_format_size(times)} times {than}"
    )
    if fitting:
        raise InputError(
            f"{comparison}: give --units {' or --units '.join(fitting)} if it is so, else"
            " --units mm"
        )
    raise InputError(
        f"{comparison}: see that it is the same part; give --units mm if its numbers are mm all the"
        " same"
    )


def _format_size(size: float) -> str:
    """A size in three digits or more, never with an exponent."""
    return f"{size:,.0f}" if size >= 100 else f"{size:#.3g}"


def _load_triangles(name: str, data: bytes) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices (n, 3) float64 and faces (m, 3) int64 of a file, unchanged but for merged
    duplicate vertices."""
    import trimesh

    form = name.rpartition(".")[2].lower()
    data = _simplify(name, form, data)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            # from memory, so that other files that it may name are not opened; unprocessed, or
            # points that are not numbers would be dropped
            mesh: Any = trimesh.load(
                io.BytesIO(data), file_type=form, force="mesh", skip_materials=True, process=False
            )
            mesh.merge_vertices(merge_tex=True, merge_norm=True)
            vertices = np.asarray(mesh.vertices, np.float64)
            faces = np.asarray(mesh.faces, np.int64)
    except MemoryError as error:
        raise SessionError(f"{name} does not fit into the memory: decimate it first") from error
    except Exception as error:  # a file from anywhere may make its reader fail in any way
        raise SessionError(
            f"{name} cannot be read ({type(error).__name__}): it is damaged; export the model"
            " again, as triangles"
        ) from error
    declared = _declared_faces(data) if form == "ply" else 0
    # a text that breaks off is read as far as it goes
    if len(faces) < declared:
        raise SessionError(
            f"{name} is truncated: {len(faces):,} of {declared:,} triangles were read;"
            " export the model again"
        )
    return vertices, faces


def _check_triangles(name: str, vertices: np.ndarray, faces: np.ndarray) -> None:
    """Raise SessionError where vertices and faces are not triangles, too many, or reach beyond what
    is read."""
    if not vertices.shape[1:] == faces.shape[1:] == (3,) or not len(faces):
        raise SessionError(f"{name} holds no triangles, or is damaged: export the model as a mesh")
    if len(faces) > MAX_TRIANGLES:
        raise _too_many(name, f"{len(faces):,} triangles")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise SessionError(f"{name} has triangles whose points are missing: export the model again")
    if not np.isfinite(vertices).all():
        raise SessionError(
            f"{name} holds points that are not numbers (NaN or infinite): export the model again"
        )


def _simplify(name: str, form: str, data: bytes) -> bytes:
    """Return a file without what only costs time: the groups of an OBJ, all but one of the sections
    of a text STL.

    Raises SessionError for one of more triangles than are read, counted before anything is loaded.
    """
    is_text = form == "obj" or (form == "stl" and _is_text_stl(data))
    if is_text and len(data) > MAX_TEXT_BYTES:
        raise _too_many(name, f"{len(data) / 1e6:.0f} MB of text")
    if form == "obj":
        data = b"\n".join(
            re.findall(rb"^[ \t]*[vf][ \t][^\r\n]*", data.replace(b"\\\n", b" "), re.MULTILINE)
        )
        faces = re.findall(rb"^[ \t]*f[^\n]*", data, re.MULTILINE)
        corners = max((len(face.split()) for face in faces), default=0)
        if corners > MAX_CORNERS:
            raise SessionError(
                f"{name} has a face of {corners - 1:,} corners: export the model again, as"
                " triangles"
            )
        count = len(faces)
    elif form == "ply":
        count = _declared_faces(data)
    elif is_text:
        data = re.sub(rb"(?im)^[ \t]*endsolid[^\n]*\n\s*solid[^\n]*\n", b"", data)
        count = data.lower().count(b"endfacet")
    else:
        count = int.from_bytes(data[80:84], "little")
        if len(data) < 84 + 50 * count:
            raise SessionError(
                f"{name} holds no triangles, or is truncated: it announces {count:,} triangles;"
                " export the model again"
            )
    if count > MAX_TRIANGLES:
        raise _too_many(name, f"{count:,} triangles")
    return data


def _declared_faces(data: bytes) -> int:
    """Return the number of faces that the header of a PLY declares; 0 where it declares none."""
    declared = re.search(rb"element face (\d{1,12})\b", data[:65536])
    return int(declared[1]) if declared else 0


def _is_text_stl(data: bytes) -> bool:
    """Return whether an STL is text: it begins with "solid", and is not of the size that a binary
    one announces."""
    binary = len(data) >= 84 and len(data) == 84 + 50 * int.from_bytes(data[80:84], "little")
    return data[:512].lstrip().lower().startswith(b"solid") and not binary


def _too_many(name: str, amount: str) -> SessionError:
    """Return the error for a model that is too large."""
    return SessionError(
        f"{name} has {amount}, and at most {MAX_TRIANGLES:,} triangles are read: decimate it first"
    )


def _drop_degenerate(
    name: str, vertices: np.ndarray, faces: np.ndarray, notes: list[str]
) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces without triangles that have no area, and without the vertices that only
    those had."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    sides = np.maximum(lengths(b - a), lengths(c - a))
    sound = lengths(np.cross(b - a, c - a)) > 1e-9 * sides**2
    flat = len(faces) - int(np.count_nonzero(sound))
    if flat > MAX_DEGENERATE_SHARE * len(faces):
        raise SessionError(
            f"{flat:,} of the {len(faces):,} triangles in {name} have no area: export the model"
            " again"
        )
    if flat:
        notes.append(f"{flat:,} of {len(faces):,} triangles without area were removed")
    faces = faces[sound]
    # the smallest index first, so that equal triangles have equal rows
    rolled = np.take_along_axis(
        faces, (np.argmin(faces, axis=1)[:, None] + np.arange(3)) % 3, axis=1
    )
    first = np.unique(rolled, axis=0, return_index=True)[1]
    if repeated := len(faces) - len(first):
        notes.append(
            f"{repeated:,} of {len(faces):,} triangles were repetitions of others: they were"
            " removed"
        )
        faces = faces[np.sort(first)]
    used, faces = np.unique(faces, return_inverse=True)
    return vertices[used].astype(np.float32), faces.reshape(-1, 3).astype(np.int32)


def _orient_faces(
    vertices: np.ndarray, faces: np.ndarray, notes: list[str]
) -> tuple[np.ndarray, bool]:
    """Return the faces wound consistently, outwards where the model is closed; and whether it is
    closed."""
    import trimesh

    mesh = trimesh.Trimesh(vertices.astype(np.float64), faces, process=False)
    edge, directed = mesh.edges_unique_inverse, mesh.edges
    sides = np.bincount(edge)
    # neighbours that turn alike run along their side in opposite directions
    balance = np.bincount(edge, np.sign(directed[:, 1] - directed[:, 0]))
    if ((balance != 0) & (sides > 1)).any():
        turned = _turn_alike(mesh) if sides.max() == 2 else None
        if turned is None:
            notes.append(
                "its triangles do not all turn one way, and cannot be turned: some deviations may"
                " have the wrong sign"
            )
            return faces, False
        faces = turned
        notes.append("its triangles did not all turn one way: they were turned")
    if not (sides == 2).all():
        notes.append("it is open: outside is where its triangles face")
        return faces, False
    if trimesh.Trimesh(mesh.vertices, faces, process=False).volume < 0:
        faces = faces[:, ::-1].copy()
        notes.append("its triangles faced inwards: they were turned")
    return faces, True


def _turn_alike(mesh: Any) -> np.ndarray | None:
    """Faces (m, 3) of a manifold turned one way, each part of the surface the way in which most of
    its area faces; None where that is impossible."""
    from trimesh.grouping import group_rows

    pairs = group_rows(mesh.edges_sorted, require_count=2)
    one, other = mesh.edges_face[pairs].T
    alike = mesh.edges[pairs[:, 0], 0] == mesh.edges[pairs[:, 1], 0]
    m = len(mesh.faces)
    # a node for each face as it is, and one for it turned: two components a part, which are its two
    # orientations
    start = np.concatenate([one, one + m])
    end = np.concatenate([np.where(alike, other + m, other), np.where(alike, other, other + m)])
    links = coo_matrix((np.ones(len(start), np.int8), (start, end)), (2 * m, 2 * m))
    labels = connected_components(links, directed=False)[1]
    as_is, turned = labels[:m], labels[m:]
    if (as_is == turned).any():
        return None
    # area that an orientation leaves as it is
    kept = np.bincount(as_is, mesh.area_faces, int(labels.max()) + 1)
    wrong = kept[as_is] < kept[turned]
    wrong |= (kept[as_is] == kept[turned]) & (as_is > turned)
    return np.where(wrong[:, None], mesh.faces[:, ::-1], mesh.faces).astype(np.int32)
