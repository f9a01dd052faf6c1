"""Topology of a mesh: openings, edges, connected parts, and the enclosed volume."""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from slviewer.surface.shapes import Mesh


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
    if not len(mesh.faces):
        return Topology((), 0, 0, 0.0)
    half = half_edges(mesh.faces)
    low, high = half.min(axis=1).astype(np.int64), half.max(axis=1).astype(np.int64)
    forth = np.where(half[:, 0] < half[:, 1], 1, -1)
    _, which, count = np.unique(
        low * len(mesh.vertices) + high, return_inverse=True, return_counts=True
    )
    balance = np.bincount(which, weights=forth)
    corners = mesh.vertices[mesh.faces].astype(np.float64)
    corners -= mesh.vertices.mean(axis=0, dtype=np.float64)
    volume = float(
        np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6
    )
    return Topology(
        openings_mm=tuple(
            sorted(
                (extent_across(mesh.vertices[loop]) for loop in opening_loops(mesh.faces)),
                reverse=True,
            )
        ),
        crowded=int((count > 2).sum()),
        turned=int(((count == 2) & (balance != 0)).sum()),
        volume_mm3=volume,
    )


def half_edges(faces: np.ndarray) -> np.ndarray:
    """Return the directed edges (3 m, 2) of faces (m, 3): all first edges, then all second, then
    all third ones."""
    return np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])


def label_connected(pairs: np.ndarray, count: int) -> np.ndarray:
    """Return the connected part (count,) int of each of ``count`` nodes that ``pairs`` (k, 2) of
    them join."""
    graph = coo_array((np.ones(len(pairs), bool), tuple(pairs.T)), shape=(count, count))
    return np.asarray(connected_components(graph, directed=False)[1])


def face_groups(faces: np.ndarray, n_vertices: int, chosen: np.ndarray | None = None) -> np.ndarray:
    """Return the connected part (m,) int of each face, of those ``chosen`` (m,) bool alone; -1 for
    the others."""
    picked = faces if chosen is None else faces[chosen]
    labels = label_connected(picked[:, [0, 1, 1, 2]].reshape(-1, 2), n_vertices)
    groups = np.full(len(faces), -1)
    where = slice(None) if chosen is None else chosen
    _, groups[where] = np.unique(labels[picked[:, 0]], return_inverse=True)
    return groups


def face_vectors(mesh: Mesh) -> np.ndarray:
    """Return a vector (m, 3) along the normal of each face, as long as twice its area is large,
    mm2."""
    a, b, c = mesh.vertices[mesh.faces].astype(np.float64).swapaxes(0, 1)
    return np.cross(b - a, c - a)


def face_areas(mesh: Mesh) -> np.ndarray:
    """Return the area (m,) mm2 of each face."""
    return np.asarray(np.linalg.norm(face_vectors(mesh), axis=1) / 2)


def extent_across(points: np.ndarray) -> float:
    """Return the largest extent in mm of points (n, 3) over 13 directions: their diameter to within
    a few percent."""
    directions = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 0], [1, -1, 0], [1, 0, 1],
    [1, 0, -1], [0, 1, 1],
                           [0, 1, -1], [1, 1, 1], [1, 1, -1], [1, -1, 1], [-1, 1, 1]],
                           float)  # fmt: skip
    along = (
        points.astype(np.float64)
        @ (directions / np.linalg.norm(directions, axis=1, keepdims=True)).T
    )
    return float(np.ptp(along, axis=0).max())


def opening_loops(faces: np.ndarray) -> list[np.ndarray]:
    """Return the boundary loops of faces (m, 3): vertices (k,) each, in the direction of the faces'
    edges.

    A vertex that belongs to several openings, or to one twice, splits them into simple loops; open
    chains are skipped.
    """
    half = half_edges(faces)
    a, b = half[:, 0].astype(np.int64), half[:, 1].astype(np.int64)
    n = int(faces.max(initial=0)) + 1
    _, first, count = np.unique(
        np.minimum(a, b) * n + np.maximum(a, b), return_index=True, return_counts=True
    )
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
