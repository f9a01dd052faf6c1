"""A nominal model from a file: checked, cleaned, and in millimetres."""

import hashlib
import io
import re
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from slviewer.errors import InputError, SessionError
from slviewer.registration.open3d_loader import open3d
from slviewer.surface.shapes import Mesh

Units = Literal["mm", "cm", "m", "inch"]
FORMATS = (".stl", ".ply", ".obj")
MAX_BYTES = 1 << 28
"""Of a file: five million triangles of a binary STL."""
MAX_TRIANGLES = 5_000_000
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
    """A nominal model: its ``mesh`` in mm, the file's ``name`` and content ``hash``, the ``units`` that it was read in
    (None: none were given, and mm assumed), whether it is ``closed``, and ``notes``, one for each repair."""

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
    """The model in an STL, PLY or OBJ file, whose numbers are in ``units``; where none are given, in mm.

    Raises SessionError for a file that cannot be used, with the reason: one that is absent, too large, damaged,
    truncated, of another format, or without triangles.
    """
    path = Path(path).expanduser()
    data = _read_bytes(path)
    vertices, faces = _load_triangles(path.name, data)
    if not np.isfinite(vertices).all():
        raise SessionError(f"{path.name} holds points that are no numbers (NaN or infinite): export the model again")
    vertices = vertices * MM[units or "mm"]
    if not np.abs(vertices).max() < MAX_COORDINATE_MM:
        raise SessionError(
            f"{path.name} reaches {np.abs(vertices).max():.3g} mm: models up to {MAX_COORDINATE_MM:g} mm are read; "
            "give its units, or move it to its origin"
        )
    notes: list[str] = []
    vertices, faces = _drop_degenerate(path.name, vertices, faces, notes)
    faces, closed = _orient_faces(vertices, faces, notes)
    digest = hashlib.blake2b(data, digest_size=20).hexdigest()
    return Nominal(Mesh(vertices, faces), path.name, digest, units, closed, tuple(notes))


def check_size(nominal: Nominal, points: np.ndarray) -> None:
    """Raise InputError where a model, without stated units, is so much smaller or larger than a scan's points (n, 3)
    mm that they may be others: the message states both sizes and the units that fit. Nothing is scaled."""
    if nominal.units is not None:
        return
    some = points[:: max(1, len(points) // 100_000)]
    scan = float(np.linalg.norm(np.ptp(np.percentile(some, [1, 99], axis=0), axis=0)))
    model = float(np.linalg.norm(nominal.size_mm))
    ratio = scan / model
    if 1 / MAX_SIZE_RATIO < ratio < MAX_SIZE_RATIO:
        return
    fitting = [
        name for name, mm in MM.items() if 1 / MATCHING_SIZE_RATIO < ratio / mm < MATCHING_SIZE_RATIO and name != "mm"
    ]
    many = (
        f"about {_format_size(ratio)} times larger" if ratio > 1 else f"about {_format_size(1 / ratio)} times smaller"
    )
    sizes = f"{_format_size(model)} mm across if its numbers are mm, and the scan {_format_size(scan)} mm"
    comparison = f"{nominal.name} measures {sizes}, {many}"
    if fitting:
        raise InputError(f"{comparison}: give --units {' or --units '.join(fitting)} if it is so, else --units mm")
    raise InputError(f"{comparison}: see that it is the same part; give --units mm if its numbers are mm all the same")


def _format_size(size: float) -> str:
    """A size in three digits or more, never with an exponent."""
    return f"{size:,.0f}" if size >= 100 else f"{size:#.3g}"


def _read_bytes(path: Path) -> bytes:
    """Return the content of a model's file; SessionError for another format, or one too large to read."""
    if path.suffix.lower() not in FORMATS:
        raise SessionError(f"{path.name} is no nominal model that can be read: give an STL, PLY or OBJ file")
    try:
        size = path.stat().st_size
        if not path.is_file():
            raise SessionError(f"{path} is no file: give an STL, PLY or OBJ file")
        if size > MAX_BYTES:
            raise SessionError(
                f"{path.name} has {size / 1e6:.0f} MB, and up to {MAX_BYTES / 1e6:.0f} MB are read: decimate it first"
            )
        return path.read_bytes()
    except OSError as error:
        raise SessionError(f"{path} cannot be read ({error.strerror}): check its name") from error


def _load_triangles(name: str, data: bytes) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices (n, 3) float64 and faces (m, 3) int64 of a file, unchanged but for merged duplicate vertices."""
    import trimesh

    form = name.rpartition(".")[2].lower()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            # from memory, so that other files that it may name are not opened; unprocessed, or points that are no
            # numbers would be dropped
            mesh: Any = trimesh.load(io.BytesIO(data), file_type=form, force="mesh", skip_materials=True, process=False)
            if np.isfinite(mesh.vertices).all():
                mesh.merge_vertices(merge_tex=True, merge_norm=True)
            vertices, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)
    except Exception as error:  # a file from anywhere may make its reader fail in any way
        raise SessionError(
            f"{name} cannot be read ({type(error).__name__}): it is damaged; export the model again, as triangles"
        ) from error
    declared = re.search(rb"element face (\d{1,12})\b", data[:65536]) if form == "ply" else None
    if declared and len(faces) < int(declared[1]):  # a text that breaks off is read as far as it goes
        raise SessionError(
            f"{name} is truncated: {len(faces):,} of {int(declared[1]):,} triangles were read; export the model again"
        )
    if vertices.ndim != 2 or vertices.shape[1:] != (3,) or faces.ndim != 2 or faces.shape[1:] != (3,) or not len(faces):
        raise SessionError(f"{name} holds no triangles, or is damaged: export the model as a mesh")
    if len(faces) > MAX_TRIANGLES:
        raise SessionError(
            f"{name} has {len(faces):,} triangles, and at most {MAX_TRIANGLES:,} are read: decimate it first"
        )
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise SessionError(f"{name} has triangles whose points are missing: export the model again")
    return vertices, faces


def _drop_degenerate(
    name: str, vertices: np.ndarray, faces: np.ndarray, notes: list[str]
) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces without triangles that have no area, and without the vertices that only those had."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    sides = np.maximum(np.linalg.norm(b - a, axis=1), np.linalg.norm(c - a, axis=1))
    sound = np.linalg.norm(np.cross(b - a, c - a), axis=1) > 1e-9 * sides**2
    flat = len(faces) - int(np.count_nonzero(sound))
    if flat > MAX_DEGENERATE_SHARE * len(faces):
        raise SessionError(f"{flat:,} of the {len(faces):,} triangles in {name} have no area: export the model again")
    if flat:
        notes.append(f"{flat:,} of {len(faces):,} triangles without area were removed")
    faces = faces[sound]
    used, faces = np.unique(faces, return_inverse=True)
    return vertices[used].astype(np.float32), faces.reshape(-1, 3).astype(np.int32)


def _orient_faces(vertices: np.ndarray, faces: np.ndarray, notes: list[str]) -> tuple[np.ndarray, bool]:
    """Return the faces wound consistently, outwards where the model is closed; and whether it is closed."""
    o3d = open3d()
    mesh = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(vertices.astype(np.float64)), o3d.utility.Vector3iVector(faces)
    )
    closed = bool(mesh.is_edge_manifold(allow_boundary_edges=False))
    directed = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).astype(np.int64)
    keys = directed[:, 0] * (len(vertices) + 1) + directed[:, 1]
    twice = len(keys) - len(np.unique(keys))  # neighbours that turn alike run along their side in opposite directions
    if twice:
        if mesh.orient_triangles():
            faces = _orient_by_majority(vertices, faces, np.asarray(mesh.triangles).astype(np.int32))
            notes.append("its triangles did not all turn one way: they were turned")
        else:
            notes.append(
                "its triangles do not all turn one way, and cannot be turned: some deviations may have the wrong sign"
            )
            return faces, False
    if closed:
        a, b, c = (vertices[faces[:, k]].astype(np.float64) - vertices.mean(axis=0) for k in range(3))
        if float(np.sum(a * np.cross(b, c))) < 0:
            faces = faces[:, ::-1].copy()
            notes.append("its triangles faced inwards: they were turned")
    else:
        notes.append("it is open: outside is where its triangles face")
    return faces, closed


def _orient_by_majority(vertices: np.ndarray, before: np.ndarray, turned: np.ndarray) -> np.ndarray:
    """Triangles (m, 3) that were turned alike, each part of the surface the way in which most of its area faced before:
    they are turned after the first one, which may be the one that was wrong."""
    from trimesh import graph

    first, second = (_area_vectors(vertices, faces) for faces in (before, turned))
    against = -np.sum(first * second, axis=1) / np.maximum(np.linalg.norm(first, axis=1), 1e-300)
    part = graph.connected_component_labels(graph.face_adjacency(before), node_count=len(before))
    wrong = np.bincount(part, against)[part] > 0
    return np.where(wrong[:, None], turned[:, ::-1], turned)


def _area_vectors(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return the normals (m, 3) of triangles, with a length of twice their area."""
    a, b, c = (vertices[faces[:, k]].astype(np.float64) for k in range(3))
    return np.cross(b - a, c - a)
