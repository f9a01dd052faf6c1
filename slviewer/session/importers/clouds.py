"""Clouds and meshes that other scanners made, as points in millimetres: the formats that
`session.formats` reads, and the meshes that `session.nominal` reads.
"""

import re
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy.spatial import KDTree

from slviewer.errors import InputError, SlviewerError
from slviewer.geometry.vectors import diagonal, finite_rows, lengths
from slviewer.session.columns import SENSOR, Columns, select_columns
from slviewer.session.nominal import FORMATS as MESHES
from slviewer.session.nominal import MAX_COORDINATE_MM, read_nominal
from slviewer.session.ply import COLOURS, NORMAL, PLACE
from slviewer.session.reading import MAX_CLOUD_BYTES, expand_user, read_input
from slviewer.session.results import digest_bytes
from slviewer.session.shape_files import own_formats
from slviewer.session.units import MM, Units, read_units
from slviewer.surface.shapes import Mesh, vertex_normals

_READ = {each: form for form in own_formats().values() if form.read for each in form.suffixes}
FORMATS = (*_READ, *(each for each in MESHES if each not in _READ))
LEAST_POINTS = 100
SMALLEST_MM, LARGEST_MM = 2.0, 2_000.0
"""Diagonals outside of which the unit may be another: a thousand times apart, as mm and m are."""
LONGEST_EDGE = 0.02
"""Of a mesh's diagonal: longer edges are divided, or a flat face would have its corners alone."""
_FACES = {
    ".ply": re.compile(rb"\A[^\0]{0,65536}?element face [ ]*[1-9]"),
    ".obj": re.compile(rb"^[ \t]*f[ \t]", re.MULTILINE),
    ".off": re.compile(rb"\A\s*\w*OFF(?:\s*#[^\n]*\n)*\s*\d+[ \t]+[1-9]"),
}
"""What shows that a file is of a mesh, in formats that may hold points alone."""


@dataclass(frozen=True, eq=False)
class ReadCloud:
    """Points of a file: ``points`` (n, 3) float64 mm, finite; where the file has them unit
    ``normals`` (n, 3), NaN where unknown, ``colours`` (n, 3) uint8, ``sigma_mm`` (n,), and the
    place of the ``sensor`` (3,) mm. ``unit``: that of its numbers; ``notes``: on what was dropped
    or added. ``scalars``: all other values (n,) by name, as the file has them."""

    points: np.ndarray
    unit: Units
    normals: np.ndarray | None = None
    colours: np.ndarray | None = None
    sigma_mm: np.ndarray | None = None
    sensor: np.ndarray | None = None
    notes: tuple[str, ...] = ()
    scalars: dict[str, np.ndarray] = field(default_factory=dict)


def read_cloud(path: Path | str, unit: Units | None = None) -> tuple[str, list[ReadCloud]]:
    """Return the hash of a file and its clouds, of which an E57 may hold several. ``unit``: of its
    numbers, by default mm, of an E57 m.

    Raises InputError, with the reason, for a file that cannot be used; SessionError for a mesh.
    """
    path = expand_user(path)
    suffix = path.suffix.lower()
    if suffix not in FORMATS:
        raise InputError(
            f"{path.name} is not a cloud that can be read", f"give {', '.join(FORMATS)}"
        )
    data = read_input(path, MAX_CLOUD_BYTES, "check its name, and that it is below 2 GiB")
    faces = _FACES.get(suffix)
    if suffix in MESHES and (faces is None or faces.search(data)):
        return digest_bytes(data).hex(), [_read_mesh(path, unit)]
    notes: list[str] = []
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            chosen = _READ[suffix]
            assert chosen.read is not None
            columns = chosen.read(path, data, notes)
    except SlviewerError:
        raise
    except Exception as error:  # a file from anywhere may make its reader fail in any way
        raise InputError(
            f"{path.name} cannot be read ({type(error).__name__}: {error})",
            "it is damaged, truncated or of a kind that is not read; export the cloud again",
        ) from error
    units = read_units(path.name, data, unit, notes) or chosen.unit
    clouds = [_check_points(path.name, each, units, notes) for each in columns]
    return digest_bytes(data).hex(), clouds


def unit_warning(name: str, points: np.ndarray, unit: Units) -> str:
    """Return a warning where points (n, 3) mm are so small or large that their unit may be another;
    empty otherwise."""
    size = diagonal(points)
    if SMALLEST_MM <= size <= LARGEST_MM:
        return ""
    fitting = [u for u, mm in MM.items() if SMALLEST_MM < size / MM[unit] * mm < LARGEST_MM]
    remedy = f"import it again with --force --unit {' or --unit '.join(fitting)}, if it is so"
    return (
        f"{name} measures {size:,.3g} mm across if its numbers are {unit}:"
        f" {remedy if fitting else 'see that it is a single object'}"
    )


def _check_points(name: str, columns: Columns, unit: Units, about_file: Sequence[str]) -> ReadCloud:
    """Return the columns of a file, whose ``sensor`` is a place, as points without NaN."""
    notes = [*about_file]
    values, scalars = select_columns(name, columns, notes)
    points = values[PLACE]
    if not len(points):
        raise InputError(f"{name} holds no points", "export the cloud again")
    known = finite_rows(points)
    if not (count := int(known.sum())):
        raise InputError(f"all {len(points):,} points of {name} are NaN", "export the cloud again")
    if dropped := len(known) - count:
        notes.append(f"{dropped:,} of {len(known):,} points were NaN, and dropped")
    once = np.unique(points[known], axis=0, return_index=True)[1]
    if repeated := count - len(once):
        notes.append(f"{repeated:,} of {count:,} points were repetitions, and dropped")
        known = np.flatnonzero(known)[np.sort(once)]
    values = {kind: each[known] for kind, each in values.items()}
    scalars = {each: numbers[known] for each, numbers in scalars.items()}
    points = MM[unit] * values[PLACE].astype(np.float64)
    check_extent(name, points)
    normals, sigma = values.get(NORMAL), values.get(("sigma",))
    if normals is not None:
        long = lengths(normals := normals.astype(np.float64))
        normals = np.where(long > 0, normals.T / np.maximum(long, 1e-12), np.nan).T
        if not (long > 0).any():
            normals = None
            notes.append("not used: its normals, which are all 0")
    return ReadCloud(
        points,
        unit,
        normals,
        values.get(COLOURS),
        None if sigma is None else MM[unit] * sigma[:, 0],
        MM[unit] * columns[SENSOR] if SENSOR in columns else None,
        tuple(notes),
        scalars,
    )


def check_extent(name: str, points: np.ndarray) -> None:
    """Raise InputError for points (n, 3) mm that are too few, in one place, or too far apart."""
    if len(points) < LEAST_POINTS or not diagonal(points) > 0:
        raise InputError(
            f"{name} holds {len(points)} points, {diagonal(points):.3g} mm across",
            f"at least {LEAST_POINTS} in different places are needed",
        )
    if not (size := np.ptp(points, axis=0).max()) < MAX_COORDINATE_MM:
        raise InputError(
            f"{name} measures {size:.3g} mm across",
            f"clouds up to {MAX_COORDINATE_MM:g} mm are read; give its --unit, or delete points"
            " that do not belong to it",
        )


def _read_mesh(path: Path, unit: Units | None) -> ReadCloud:
    """Return the vertices of a mesh, with the normals of its faces, and places on faces that are
    large."""
    from trimesh.remesh import subdivide_to_size

    nominal = read_nominal(path, unit)
    mesh, notes = nominal.mesh, list(nominal.notes)
    values, scalars = dict[tuple[str, ...], np.ndarray](), dict[str, np.ndarray]()
    if nominal.columns:
        values, scalars = select_columns(path.name, nominal.columns, notes)
    if NORMAL in values:
        notes.append("not used: the normals of its vertices, but those of its faces")
    longest = LONGEST_EDGE * diagonal(mesh.vertices)
    corners = mesh.vertices[mesh.faces]
    if lengths(corners - np.roll(corners, 1, axis=1)).max() > longest:
        places, faces = subdivide_to_size(mesh.vertices, mesh.faces, longest, 20)
        once, which = np.unique(places, axis=0, return_inverse=True)
        divided = Mesh(once, which.ravel()[faces])
        notes.append(
            f"its triangles are larger than {longest:.3g} mm: to its {len(mesh.vertices):,}"
            f" vertices {len(divided.vertices) - len(mesh.vertices):,} places on them were added"
        )
        mesh = divided
    check_extent(path.name, mesh.vertices)
    normals = vertex_normals(mesh).astype(np.float64)
    points, colours, unit = nominal.origin_mm + mesh.vertices, None, nominal.units or "mm"
    if COLOURS in values or scalars:  # of the nearest vertex, which may be one of several there
        nearest = KDTree(MM[unit] * values[PLACE].astype(np.float64)).query(points)[1]
        colours = values[COLOURS][nearest] if COLOURS in values else None
        scalars = {each: numbers[nearest] for each, numbers in scalars.items()}
    return ReadCloud(points, unit, normals, colours, notes=tuple(notes), scalars=scalars)
