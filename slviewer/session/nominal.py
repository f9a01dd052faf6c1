"""A nominal model from a file: checked, cleaned, and in millimetres."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from slviewer.errors import InputError, SessionError
from slviewer.geometry.vectors import diagonal, lengths, thin_out
from slviewer.session import cad
from slviewer.session.columns import Columns
from slviewer.session.polygons import Polygons, read_polygons, to_polygons, triangulate_polygons
from slviewer.session.reading import expand_user, read_input
from slviewer.session.results import digest_bytes
from slviewer.session.units import MM, Units, find_origin, read_units
from slviewer.surface.shapes import Mesh, list_adjacent_faces

NOMINALS = "nominal"
"""Folder of a session with the nominal models that were uploaded."""
FORMATS = (".stl", ".ply", ".obj", ".off", ".step", ".stp", ".3mf")
MAX_BYTES = 1 << 28
MAX_SIZE_RATIO = 5.0
"""A scan's size over the nominal's, or its inverse, from which on the units must be given."""
MATCHING_SIZE_RATIO = 2.0
"""Units that bring the two so near are proposed."""
MAX_COORDINATE_MM = 1e5
MERGED_DECIMALS = 8
"""Vertices that agree to this place of a mm are one."""
MAX_DEGENERATE_SHARE = 0.5
"""Share of triangles without area from which on a file is refused."""


@dataclass(frozen=True, eq=False)
class Nominal:
    """A nominal model: its ``mesh`` in mm, the file's ``name`` and content ``hash``, the ``units``
    that it was read in (None: none were given, and mm assumed), whether it is ``closed``, and
    ``notes``, one for each repair. ``columns``: the numbers of the file's vertices by name, in its
    units; empty where there are none but places. ``origin_mm`` (3,): subtracted from the vertices.
    """

    mesh: Mesh
    name: str
    hash: str
    units: Units | None
    closed: bool
    notes: tuple[str, ...] = ()
    columns: Columns = field(default_factory=dict)
    origin_mm: np.ndarray = field(default_factory=lambda: np.zeros(3))

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
    """The model in an STL, PLY, OBJ or OFF file, whose numbers are in ``units``, or where none are
    given in those that it states, or mm; or in a STEP or 3MF file, which states its units.

    Raises SessionError for a file that cannot be used, with the reason: one that is absent, too
    large, damaged, truncated, of another format, without triangles, or with too many.
    """
    path = expand_user(path)
    if path.suffix.lower() not in FORMATS:
        raise SessionError(
            f"{path.name} is not a nominal model that can be read",
            "give an STL, PLY, OBJ, OFF, STEP or 3MF file",
        )
    remedy = f"give a file of up to {MAX_BYTES >> 20} MiB"
    data = read_input(path, MAX_BYTES, remedy, SessionError)
    notes: list[str] = []
    if (form := path.suffix.lower()[1:]) in cad.PACKAGES:
        vertices, faces = cad.load_triangles(path.name, form, data, notes)
        polygons = to_polygons(vertices, faces)
        units = "mm"
    else:
        units = read_units(path.name, data, units, notes)
        polygons = read_polygons(path.name, data, notes)
    columns = polygons.columns
    polygons, origin = _merge_vertices(path.name, polygons, MM[units or "mm"], notes)
    faces = triangulate_polygons(polygons, notes)
    mesh, closed = _repair(path.name, polygons.vertices, faces, notes)
    digest = digest_bytes(data).hex()
    return Nominal(mesh, path.name, digest, units, closed, tuple(notes), columns, origin)


def check_size(nominal: Nominal, points: np.ndarray) -> None:
    """Raise InputError where a model, without stated units, is so much smaller or larger than a
    scan's points (n, 3) mm that they may be others: the message states both sizes and the units
    that fit. Nothing is scaled.
    """
    if nominal.units is not None:
        return
    some = thin_out(points, 100_000)
    scan = diagonal(np.percentile(some, [1, 99], axis=0))
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
            f"{comparison}",
            f"give --units {' or --units '.join(fitting)} if it is so, else --units mm",
        )
    raise InputError(
        f"{comparison}",
        "see that it is the same part; give --units mm if its numbers are mm all the same",
    )


def _format_size(size: float) -> str:
    """A size in three digits or more, never with an exponent."""
    return f"{size:,.0f}" if size >= 100 else f"{size:#.3g}"


def _merge_vertices(
    name: str, polygons: Polygons, scale: float, notes: list[str]
) -> tuple[Polygons, np.ndarray]:
    """Return polygons in mm without duplicate vertices, and the origin (3,) that was subtracted as
    they are far from it. Raises SessionError where there are none, and for vertices that are
    missing, not numbers, or beyond what is read."""
    from trimesh.grouping import unique_rows

    vertices, corners, counts = polygons.vertices, polygons.corners, polygons.counts
    if not (counts > 2).any():
        raise SessionError(
            f"{name} holds no triangles, or is damaged", "export the model as a mesh"
        )
    if corners.min() < 0 or corners.max() >= len(vertices):
        raise SessionError(
            f"{name} has triangles whose points are missing", "export the model again"
        )
    if not np.isfinite(vertices).all():
        raise SessionError(
            f"{name} holds points that are not numbers (NaN or infinite)", "export the model again"
        )
    vertices = scale * vertices
    if any(origin := find_origin(vertices) or (0.0, 0.0, 0.0)):
        notes.append("less the origin {:.10g} {:.10g} {:.10g} mm".format(*origin))
        vertices = vertices - origin
    if not (size := np.ptp(vertices, axis=0).max()) < MAX_COORDINATE_MM:
        raise SessionError(
            f"{name} measures {size:.3g} mm across",
            f"models up to {MAX_COORDINATE_MM:g} mm are read; give its units",
        )
    first, same = unique_rows(vertices, digits=MERGED_DECIMALS)
    return Polygons(vertices[first], same[corners], counts), np.array(origin)


def _repair(
    name: str, vertices: np.ndarray, faces: np.ndarray, notes: list[str]
) -> tuple[Mesh, bool]:
    """Return the mesh of triangles that have an area, wound consistently, and whether it is closed.
    Triangles without area that join others along their sides close a surface, too."""
    sound = _have_area(vertices, faces)
    distinct = (faces != np.roll(faces, 1, axis=1)).all(axis=1)
    if (flat := np.count_nonzero(~sound)) > MAX_DEGENERATE_SHARE * len(faces):
        raise SessionError(
            f"{flat:,} of the {len(faces):,} triangles in {name} have no area",
            "export the model again",
        )
    for kept in (distinct, sound) if (distinct & ~sound).any() else (sound,):
        repairs: list[str] = []
        if removed := np.count_nonzero(~kept):
            repairs.append(f"{removed:,} of {len(faces):,} triangles without area were removed")
        found, closed = _orient_faces(vertices, _drop_repeated(faces[kept], repairs), repairs)
        if closed:
            break
    notes += repairs
    has_triangle = np.zeros(len(vertices), bool)
    has_triangle[faces] = True
    if loose := np.count_nonzero(~has_triangle):
        notes.append(f"not used: {loose:,} of {len(vertices):,} points, which no triangle has")
    used, found = np.unique(found[_have_area(vertices, found)], return_inverse=True)
    return Mesh(vertices[used].astype(np.float32), found.reshape(-1, 3).astype(np.int32)), closed


def _have_area(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return (m,) bool: whether triangles (m, 3) are more than a line."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    sides = np.maximum(lengths(b - a), lengths(c - a))
    return np.asarray(lengths(np.cross(b - a, c - a)) > 1e-9 * sides**2)


def _drop_repeated(faces: np.ndarray, notes: list[str]) -> np.ndarray:
    """Return the triangles (m, 3) without repetitions."""
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
    return faces[np.sort(first)]


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
    if (sides == 1).any():
        notes.append("it is open: outside is where its triangles face")
        return faces, False
    if trimesh.Trimesh(mesh.vertices, faces, process=False).volume < 0:
        faces = faces[:, ::-1].copy()
        notes.append("its triangles faced inwards: they were turned")
    return faces, True


def _turn_alike(mesh: Any) -> np.ndarray | None:
    """Faces (m, 3) of a manifold turned one way, each part of the surface the way in which most of
    its area faces; None where that is impossible."""
    pairs, alike = list_adjacent_faces(mesh.faces)
    (one, other), m = pairs.T, len(mesh.faces)
    # a node for each face as it is, and one for it turned: two components a part, which are its two
    # orientations
    start = np.concatenate([one, one + m])
    end = np.concatenate([np.where(alike, other, other + m), np.where(alike, other + m, other)])
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
