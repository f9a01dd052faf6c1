"""Clouds and meshes that other scanners made, as points in millimetres: the formats that
`session.formats` reads, and the meshes that `session.nominal` reads.
"""

import re
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from slviewer.errors import InputError
from slviewer.geometry.vectors import diagonal, finite_rows, lengths
from slviewer.session.nominal import FORMATS as MESHES
from slviewer.session.nominal import MAX_COORDINATE_MM, MM, Units, read_nominal
from slviewer.session.ply import COLOURS, NORMAL, PLACE
from slviewer.session.reading import MAX_CLOUD_BYTES, expand_user, read_input
from slviewer.session.results import digest_bytes
from slviewer.session.shape_files import own_formats
from slviewer.surface.shapes import Mesh, vertex_normals

_READ = {each: form for form in own_formats().values() if form.read for each in form.suffixes}
FORMATS = (*_READ, *(each for each in MESHES if each not in _READ))
LEAST_POINTS = 100
SMALLEST_MM, LARGEST_MM = 2.0, 10_000.0
"""Diagonals outside of which the unit may be another."""
LONGEST_EDGE = 0.02
"""Of a mesh's diagonal: longer edges are divided, or a flat face would have its corners alone."""
_SIGMAS = ("sigma", "sigma_noise")


@dataclass(frozen=True, eq=False)
class ReadCloud:
    """Points of a file: ``points`` (n, 3) float64 mm, finite; where the file has them unit
    ``normals`` (n, 3), NaN where unknown, ``colours`` (n, 3) uint8, ``sigma_mm`` (n,), and the
    place of the ``sensor`` (3,) mm. ``unit``: that of its numbers; ``notes``: on what was dropped
    or added."""

    points: np.ndarray
    unit: Units
    normals: np.ndarray | None = None
    colours: np.ndarray | None = None
    sigma_mm: np.ndarray | None = None
    sensor: np.ndarray | None = None
    notes: tuple[str, ...] = ()


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
    is_mesh = suffix in MESHES
    if suffix == ".ply":
        is_mesh = re.search(rb"element face [1-9]", data[:65536]) is not None
    if is_mesh:
        return digest_bytes(data).hex(), [_read_mesh(path, unit)]
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            chosen = _READ[suffix]
            assert chosen.read is not None
            columns = chosen.read(path, data)
    except InputError:
        raise
    except Exception as error:  # a file from anywhere may make its reader fail in any way
        raise InputError(
            f"{path.name} cannot be read ({type(error).__name__}: {error})",
            "it is damaged or truncated; export the cloud again",
        ) from error
    units = unit or chosen.unit
    return digest_bytes(data).hex(), [_check_points(path.name, each, units) for each in columns]


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


def _check_points(name: str, columns: Mapping[str, np.ndarray], unit: Units) -> ReadCloud:
    """Return the columns of a file, whose ``sensor`` is a place, as points without NaN."""
    points = _stack(columns, PLACE)
    if points is None or not len(points):
        raise InputError(f"{name} holds no points", "export the cloud again")
    known = finite_rows(points)
    if not (count := int(known.sum())):
        raise InputError(f"all {len(points):,} points of {name} are NaN", "export the cloud again")
    dropped = len(known) - count
    notes = [f"{dropped:,} of {len(known):,} points were NaN, and dropped"] if dropped else []
    once = np.unique(points[known], axis=0, return_index=True)[1]
    if repeated := count - len(once):
        notes.append(f"{repeated:,} of {count:,} points were repetitions, and dropped")
        known = np.flatnonzero(known)[np.sort(once)]
    points = MM[unit] * points[known].astype(np.float64)
    check_extent(name, points)
    normals, colours = (_stack(columns, each) for each in (NORMAL, COLOURS))
    if normals is not None:
        long = lengths(normals := normals[known].astype(np.float64))
        normals = np.where(long > 0, normals.T / np.maximum(long, 1e-12), np.nan).T
    colours = None if colours is None or colours.dtype != np.uint8 else colours[known]
    sigma = next((MM[unit] * columns[each][known] for each in _SIGMAS if each in columns), None)
    sensor = MM[unit] * columns["sensor"] if "sensor" in columns else None
    return ReadCloud(points, unit, normals, colours, sigma, sensor, tuple(notes))


def check_extent(name: str, points: np.ndarray) -> None:
    """Raise InputError for points (n, 3) mm that are too few, in one place, or too far away."""
    if len(points) < LEAST_POINTS or not diagonal(points) > 0:
        raise InputError(
            f"{name} holds {len(points)} points, {diagonal(points):.3g} mm across",
            f"at least {LEAST_POINTS} in different places are needed",
        )
    if not (far := np.abs(points).max()) < MAX_COORDINATE_MM:
        raise InputError(
            f"{name} reaches {far:.3g} mm",
            f"points up to {MAX_COORDINATE_MM:g} mm are read; give its --unit, or move it to its"
            " origin",
        )


def _stack(columns: Mapping[str, np.ndarray], names: tuple[str, ...]) -> np.ndarray | None:
    """Return columns (n, k) by their names; None where one is missing."""
    if not set(names) <= columns.keys():
        return None
    return np.stack([np.ravel(columns[name]) for name in names], axis=1)


def _read_mesh(path: Path, unit: Units | None) -> ReadCloud:
    """Return the vertices of a mesh, with the normals of its faces, and places on faces that are
    large."""
    from trimesh.remesh import subdivide_to_size

    nominal = read_nominal(path, unit)
    mesh, notes = nominal.mesh, list(nominal.notes)
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
    points = mesh.vertices.astype(np.float64)
    return ReadCloud(points, nominal.units or "mm", normals, notes=tuple(notes))
