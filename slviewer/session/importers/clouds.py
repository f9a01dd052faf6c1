"""Clouds and meshes that other scanners made, as points in millimetres: PLY, PCD, E57, text with x
y z and more a line, and the meshes that `session.nominal` reads.
"""

import io
import re
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from slviewer.errors import InputError
from slviewer.geometry.vectors import diagonal, finite_rows, lengths
from slviewer.registration.open3d_loader import open3d
from slviewer.session.nominal import FORMATS as MESHES
from slviewer.session.nominal import MAX_COORDINATE_MM, MM, Units, read_nominal
from slviewer.session.ply import COLOURS, NORMAL, PLACE
from slviewer.session.reading import MAX_CLOUD_BYTES, expand_user, read_input
from slviewer.session.results import digest_bytes
from slviewer.surface.shapes import Mesh, vertex_normals

TEXTS = (".xyz", ".txt", ".asc", ".pts", ".csv")
FORMATS = (".ply", ".pcd", ".e57", *TEXTS, *(each for each in MESHES if each != ".ply"))
LEAST_POINTS = 100
SMALLEST_MM, LARGEST_MM = 2.0, 10_000.0
"""Diagonals outside of which the unit may be another."""
LONGEST_EDGE = 0.02
"""Of a mesh's diagonal: longer edges are divided, or a flat face would have its corners alone."""
_SIGMAS = ("sigma", "sigma_noise")
_PCD_NAMES = dict(zip(("normal_x", "normal_y", "normal_z"), NORMAL, strict=True))
_PCD_TYPES = {"F": "f", "I": "i", "U": "u"}


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
        raise InputError(f"{path.name} is not a cloud that can be read: give {', '.join(FORMATS)}")
    data = read_input(path, MAX_CLOUD_BYTES, "check its name, and that it is below 2 GiB")
    is_mesh = suffix in MESHES
    if suffix == ".ply":
        is_mesh = re.search(rb"element face [1-9]", data[:65536]) is not None
    if is_mesh:
        return digest_bytes(data).hex(), [_read_mesh(path, unit)]
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            if suffix == ".e57":
                columns = _read_e57(path)
            else:
                read = {".ply": _read_ply, ".pcd": _read_pcd}.get(suffix, _read_text)
                columns = [read(path, data)]
    except InputError:
        raise
    except Exception as error:  # a file from anywhere may make its reader fail in any way
        raise InputError(
            f"{path.name} cannot be read ({type(error).__name__}: {error}): it is damaged or"
            " truncated; export the cloud again"
        ) from error
    chosen = unit or ("m" if suffix == ".e57" else "mm")
    return digest_bytes(data).hex(), [_check_points(path.name, each, chosen) for each in columns]


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
        raise InputError(f"{name} holds no points: export the cloud again")
    known = finite_rows(points)
    if not (count := int(known.sum())):
        raise InputError(f"all {len(points):,} points of {name} are NaN: export the cloud again")
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
            f"{name} holds {len(points)} points, {diagonal(points):.3g} mm across: at least"
            f" {LEAST_POINTS} in different places are needed"
        )
    if not (far := np.abs(points).max()) < MAX_COORDINATE_MM:
        raise InputError(
            f"{name} reaches {far:.3g} mm: points up to {MAX_COORDINATE_MM:g} mm are read; give its"
            " --unit, or move it to its origin"
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


def _read_ply(path: Path, data: bytes) -> dict[str, np.ndarray]:
    """Return the properties of a PLY's vertices by name."""
    import trimesh

    loaded: Any = trimesh.load(io.BytesIO(data), file_type="ply", process=False)
    vertices = loaded.metadata["_ply_raw"]["vertex"]
    values = vertices["data"]
    names = values if isinstance(values, dict) else values.dtype.names
    return {name: np.ravel(values[name])[: vertices["length"]] for name in names}


def _read_pcd(path: Path, data: bytes) -> dict[str, np.ndarray]:
    """Return the fields of a PCD by name, and its sensor's place."""
    match = re.search(rb"^DATA[ \t]+(\w+)[ \t]*\r?\n", data, re.MULTILINE)
    if match is None:
        raise ValueError("it has no line DATA")
    rows = map(str.split, data[: match.start()].decode("ascii", "replace").splitlines())
    header = {words[0].upper(): words[1:] for words in rows if words}
    count, form, body = int(header["POINTS"][0]), match[1].lower(), data[match.end() :]
    names, repeats = header["FIELDS"], header.get("COUNT", ["1"] * len(header["FIELDS"]))
    fields = [
        (f"{name}{'_' * i if name == '_' else ''}", f"<{_PCD_TYPES[kind]}{size}", int(times))
        for i, (name, kind, size, times) in enumerate(
            zip(names, header["TYPE"], header["SIZE"], repeats, strict=True), 1
        )
    ]
    if form == b"binary_compressed":
        if len(body) < 8 + int.from_bytes(body[:4], "little"):
            raise ValueError("it breaks off")
        cloud = open3d().io.read_point_cloud(str(path))
        columns = dict(zip(PLACE, np.asarray(cloud.points).T, strict=True))
        columns |= dict(zip(NORMAL, np.asarray(cloud.normals).T, strict=False))
    elif form == b"binary":
        values = np.frombuffer(body, np.dtype(fields), count)
        columns = {_PCD_NAMES.get(name, name): values[name] for name in values.dtype.names or ()}
    else:
        columns, start = {}, 0
        table = np.loadtxt(io.BytesIO(body), ndmin=2, max_rows=count)
        for name, _, times in fields:
            columns[_PCD_NAMES.get(name, name)] = table[:, start : start + times]
            start += times
    if len(columns["x"]) != count:
        raise ValueError(f"it has {len(columns['x'])} of {count} points")
    sensor = np.array(header.get("VIEWPOINT", [0, 0, 0])[:3], np.float64)
    return columns | ({"sensor": sensor} if sensor.any() else {})


def _read_text(path: Path, data: bytes) -> dict[str, np.ndarray]:
    """Return the columns of a text: x y z first, then normals and colours where numbers are
    such."""
    lines = data.decode("utf-8-sig", "replace").splitlines()
    first = next((i for i, line in enumerate(lines) if _is_row(line)), None)
    if first is None:
        raise InputError(
            f"{path.name} has no line of three numbers: write x y z of a point a line, with decimal"
            " points"
        )
    separator = next((each for each in ";," if each in lines[first]), None)
    rows = np.loadtxt(lines[first:], delimiter=separator, comments=("#", "//"), ndmin=2)
    columns, k = dict(zip(PLACE, rows.T[:3], strict=True)), 3
    while k + 3 <= rows.shape[1]:
        triple = rows[:, k : k + 3]
        names: tuple[str, ...] = ()
        some = triple[finite_rows(triple)]
        if len(some) and np.percentile(np.abs(lengths(some) - 1), 99) < 0.01:
            names = NORMAL
        elif len(some) and (some == np.rint(some)).all() and 0 <= some.min() < 2 < some.max() < 256:
            names, triple = COLOURS, np.nan_to_num(triple).astype(np.uint8)
        columns |= dict(zip(names, triple.T, strict=False))
        k += len(names) or 1
    return columns


def _is_row(line: str) -> bool:
    """Whether a line holds three numbers or more, with decimal points."""
    words = re.split(r"[;\s]\s*" if ";" in line or "," not in line else r",\s*", line.strip())
    try:
        return len([float(word) for word in words if word]) >= 3
    except ValueError:
        return False


def _read_e57(path: Path) -> list[dict[str, np.ndarray]]:
    """Return the columns of each scan of an E57 in one frame, and its scanner's place."""
    if find_spec("pye57") is None:
        raise InputError(
            f"{path.name}: .e57 files need the package pye57: install it with pip install"
            " 'slviewer[e57]'"
        )
    import pye57

    file, scans = pye57.E57(str(path)), []
    try:
        for i in range(file.scan_count):
            header = file.get_header(i)
            values = file.read_scan(i, colors=True, ignore_missing_fields=True)
            names = [(f"cartesian{each.upper()}", each) for each in PLACE]
            names += [(f"color{each.title()}", each) for each in COLOURS]
            columns = {ours: values[theirs] for theirs, ours in names if theirs in values}
            scans.append(columns | ({"sensor": header.translation} if header.has_pose() else {}))
    finally:
        file.close()
    if not scans:
        raise InputError(f"{path.name} holds no scans: export the cloud again")
    return scans
