"""Unorganised point sets and triangle meshes: their attributes, normals, areas and topology."""

from dataclasses import dataclass, replace
from itertools import product
from typing import Any, TypeVar

import numpy as np
import scipy

from slviewer.errors import InputError
from slviewer.geometry.rigid import Floats, move_points
from slviewer.geometry.vectors import lengths, unit_vectors
from slviewer.registration.open3d_loader import open3d

_DTYPES: dict[str, type] = {
    "points": np.float32,
    "vertices": np.float32,
    "faces": np.int32,
    "normals": np.float32,
    "colours": np.uint8,
    "sigma_mm": np.float32,
    "origin": np.float64,
}
_DIRECTIONS = unit_vectors(np.array([d for d in product((-1, 0, 1), repeat=3) if d > (0, 0, 0)]))
"""(13, 3): the sides, edges and corners of a cube, one of opposite ones."""


@dataclass(frozen=True, eq=False)
class PointSet:
    """Points of a surface, in one frame.

    ``points`` (n, 3) float32 mm, finite. Where known: ``normals`` (n, 3) float32, of unit length,
    outwards; ``colours`` (n, 3) uint8 RGB; ``sigma_mm`` (n,) float32, the expected error of each
    point along its normal. ``origin`` (3,) float64 mm: where the points count from.
    """

    points: np.ndarray
    normals: np.ndarray | None = None
    colours: np.ndarray | None = None
    sigma_mm: np.ndarray | None = None
    origin: np.ndarray | None = None

    def __post_init__(self) -> None:
        _convert_arrays(self, len(self.points))

    def __len__(self) -> int:
        return len(self.points)


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles of a surface.

    ``vertices`` (n, 3) float32 mm; ``faces`` (m, 3) int32, counter-clockwise seen from outside. Of
    each vertex where known: ``normals`` (n, 3) float32, ``colours`` (n, 3) uint8 RGB, ``sigma_mm``
    (n,) float32. ``origin`` (3,) float64 mm: where the vertices count from.
    """

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray | None = None
    colours: np.ndarray | None = None
    sigma_mm: np.ndarray | None = None
    origin: np.ndarray | None = None

    def __post_init__(self) -> None:
        _convert_arrays(self, len(self.vertices))
        if len(self.faces) and not (
            self.faces.min() >= 0 and self.faces.max() < len(self.vertices)
        ):
            raise InputError(
                f"Faces name vertices outside the {len(self.vertices)} that there are."
            )


def pick_attributes(shape: PointSet | Mesh, which: np.ndarray) -> dict[str, Any]:
    """Return normals, colours and sigmas of some of the points, by index or mask; None where they
    are not known."""
    values = {name: getattr(shape, name) for name in ("normals", "colours", "sigma_mm")}
    return {name: None if value is None else value[which] for name, value in values.items()}


def _convert_arrays(shape: PointSet | Mesh, n: int) -> None:
    """Convert the arrays of a shape of ``n`` points to their dtypes; raises InputError where one
    has not the expected shape."""
    for name, value in vars(shape).items():
        if value is not None:
            array: np.ndarray = np.asarray(value, dtype=_DTYPES[name])
            rows = len(array) if name == "faces" else n
            expected = {"sigma_mm": (rows,), "origin": (3,)}.get(name, (rows, 3))
            if array.shape != expected:
                raise InputError(f"The {name} have shape {array.shape}", f"{expected} is needed.")
            vars(shape)[name] = array


def transfer_attributes(known: Mesh | PointSet, vertices: np.ndarray, faces: np.ndarray) -> Mesh:
    """Return a mesh of vertices (n, 3) mm and faces (m, 3) with colours and sigmas of the nearest
    known points.

    Normals are computed from the faces.
    """
    mesh = Mesh(vertices, faces)
    points = known.vertices if isinstance(known, Mesh) else known.points
    attributes: dict[str, Any] = {}
    if len(mesh.vertices) and (known.colours is not None or known.sigma_mm is not None):
        _, nearest = scipy.spatial.cKDTree(points).query(mesh.vertices)
        attributes = pick_attributes(known, nearest)
    return replace(mesh, **(attributes | {"normals": vertex_normals(mesh)}))


def select_faces(mesh: Mesh, mask: np.ndarray) -> Mesh:
    """Return the faces selected by a mask (m,) bool and the vertices that they use."""
    faces = mesh.faces[mask]
    used = np.zeros(len(mesh.vertices), bool)
    used[faces] = True
    number = np.cumsum(used, dtype=np.int32) - 1
    return Mesh(mesh.vertices[used], number[faces].reshape(-1, 3), **pick_attributes(mesh, used))


def vertex_normals(mesh: Mesh) -> np.ndarray:
    """Return the area-weighted mean normals (n, 3) float32 of the faces around each vertex; (0, 0,
    1) without faces."""
    normals = np.array(to_open3d_mesh(mesh).compute_vertex_normals().vertex_normals, np.float32)
    normals[~normals.any(axis=1), 2] = 1
    return normals


def to_open3d_mesh(mesh: Mesh) -> Any:
    """Convert to Open3D's triangle mesh; only vertices and faces."""
    o3d = open3d()
    return o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(mesh.vertices.astype(np.float64)),
        o3d.utility.Vector3iVector(mesh.faces),
    )


@dataclass(frozen=True, eq=False)
class Topology:
    """Topology of a mesh.

    ``openings_mm``: extent of each opening, the largest first. ``crowded``: number of edges with
    more than two triangles; ``turned``: number of edges whose two triangles have opposite
    orientations. ``volume_mm3``: enclosed volume, valid for a closed mesh only.
    """

    openings_mm: tuple[float, ...]
    crowded: int
    turned: int
    volume_mm3: float

    @property
    def watertight(self) -> bool:
        """Whether the mesh is closed and consistently oriented, with normals outwards."""
        return not self.openings_mm and not self.crowded and not self.turned and self.volume_mm3 > 0

    def faults(self) -> str:
        """Describe why the mesh is not watertight; "" if it is."""
        faults = []
        if self.openings_mm:
            n, largest = len(self.openings_mm), self.openings_mm[0]
            faults.append(f"{n} opening{'s' * (n > 1)}, the largest {largest:.1f} mm across")
        if self.crowded:
            faults.append(f"{self.crowded} edges where more than two triangles meet")
        if self.turned:
            faults.append(f"{self.turned} edges whose triangles wind against each other")
        if not faults and not self.volume_mm3 > 0:
            faults.append("its normals point inwards")
        return ", ".join(faults)


def analyse_topology(mesh: Mesh) -> Topology:
    """Analyse the topology of a mesh."""
    half, _, which, count = count_edges(mesh.faces)
    balance = np.bincount(which, weights=np.where(half[:, 0] < half[:, 1], 1, -1))
    corners = mesh.vertices[mesh.faces].astype(np.float64)
    corners -= mesh.vertices.mean(axis=0, dtype=np.float64)
    openings = [extent_across(mesh.vertices[loop]) for loop in opening_loops(mesh.faces)]
    return Topology(
        openings_mm=tuple(sorted(openings, reverse=True)),
        crowded=int((count > 2).sum()),
        turned=int(((count == 2) & (balance != 0)).sum()),
        volume_mm3=float(np.linalg.det(corners).sum() / 6),
    )


def count_edges(faces: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return the directed edges (3 m, 2) of faces (m, 3), and of the k edges without direction the
    first of these (k,), which one each of these is (3 m,), and their numbers (k,)."""
    half = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).astype(np.int64)
    keys = half.min(axis=1) * (faces.max(initial=0) + 1) + half.max(axis=1)
    return half, *np.unique(keys, return_index=True, return_inverse=True, return_counts=True)[1:]


def list_adjacent_faces(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the pairs (k, 2) of faces (m, 3) that share an edge with no third one, and whether
    both are wound alike (k,) bool: they run along that edge in opposite directions then."""
    half, _, edge, count = count_edges(faces)
    order = np.argsort(edge, kind="stable")
    order = order[count[edge[order]] == 2].reshape(-1, 2)
    return order % len(faces), np.ptp(half[order, 0], axis=1) != 0


def label_connected(pairs: np.ndarray, count: int) -> np.ndarray:
    """Return the connected part (count,) int of each of ``count`` nodes that ``pairs`` (k, 2) of
    them join."""
    graph = scipy.sparse.coo_array(
        (np.ones(len(pairs), bool), tuple(pairs.T)), shape=(count, count)
    )
    return scipy.sparse.csgraph.connected_components(graph, directed=False)[1]


def face_groups(faces: np.ndarray, n_vertices: int, chosen: np.ndarray | None = None) -> np.ndarray:
    """Return the connected part (m,) int of each face, of those ``chosen`` (m,) bool alone; -1 for
    the others."""
    picked = faces if chosen is None else faces[chosen]
    labels = label_connected(picked[:, [0, 1, 1, 2]].reshape(-1, 2), n_vertices)
    groups = np.full(len(faces), -1)
    where = slice(None) if chosen is None else chosen
    _, groups[where] = np.unique(labels[picked[:, 0]], return_inverse=True)
    return groups


def face_areas(mesh: Mesh) -> np.ndarray:
    """Return the area (m,) mm2 of each face."""
    a, b, c = mesh.vertices[mesh.faces].astype(np.float64).swapaxes(0, 1)
    return lengths(np.cross(b - a, c - a)) / 2


def extent_across(points: np.ndarray) -> float:
    """Return the largest extent in mm of points (n, 3) over 13 directions: their diameter to within
    a few percent."""
    return float(np.ptp(points.astype(np.float64) @ _DIRECTIONS.T, axis=0).max())


def opening_loops(faces: np.ndarray) -> list[np.ndarray]:
    """Return the boundary loops of faces (m, 3): vertices (k,) each, in the direction of the faces'
    edges.

    A vertex that belongs to several openings, or to one twice, splits them into simple loops; open
    chains are skipped.
    """
    half, first, _, count = count_edges(faces)
    onwards: dict[int, list[int]] = {}
    for start, end in half[first[count == 1]].tolist():
        onwards.setdefault(start, []).append(end)
    loops = []
    for begin in list(onwards):
        path, place = [begin], {begin: 0}
        while onwards.get(path[-1]):
            step = onwards[path[-1]].pop()
            if step in place:
                k = place[step]
                loops.append(np.array(path[k:]))
                for gone in path[k + 1 :]:
                    del place[gone]
                del path[k + 1 :]
            else:
                place[step] = len(path)
                path.append(step)
    return loops


_Surface = TypeVar("_Surface", PointSet, Mesh)


def move_shape(T: Floats, shape: _Surface) -> _Surface:
    """Return points or a mesh moved by a transform (4, 4) mm."""
    where = "points" if isinstance(shape, PointSet) else "vertices"
    moved = {where: move_points(T, getattr(shape, where))}
    if shape.normals is not None:
        moved["normals"] = shape.normals @ T[:3, :3].T
    return replace(shape, **{name: each.astype(np.float32) for name, each in moved.items()})
