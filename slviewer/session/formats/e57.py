"""E57: binary, ASTM E2807, in metres, points with colours and normals (`pip install
'slviewer[e57]'`)."""

from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from uuid import uuid4

import numpy as np

from slviewer.errors import InputError
from slviewer.session.atomic import arriving_path
from slviewer.session.columns import SENSOR, Columns
from slviewer.session.ply import replace_nan, to_ascii
from slviewer.session.shape_format import Shape, ShapeFormat, Sizes, split_shape
from slviewer.surface.shapes import Mesh

_SIZES = Sizes(4000, 24, 3)
_PLACE = ("cartesianX", "cartesianY", "cartesianZ")
_COLOURS = ("colorRed", "colorGreen", "colorBlue")
_NORMAL = ("nor:normalX", "nor:normalY", "nor:normalZ")
_NORMALS_URI = "http://www.libe57.org/E57_NOR_surface_normals.txt"
"""The extension of the standard that names normals."""
_LARGEST = float(np.finfo(np.float32).max)
_POLAR = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")


def _require_package(path: Path) -> None:
    if find_spec("pye57") is None:
        raise InputError(
            f"{path.name}: .e57 files need the package pye57",
            "install it with pip install 'slviewer[e57]'",
        )


def _write(path: Path, shape: Shape, scalars: Columns, notes: Sequence[str]) -> None:
    """Write one scan: places as float32, far from the origin as float64, colours, and normals by
    the extension for them. pye57 itself writes no normals."""
    _require_package(path)
    import pye57
    from pye57 import libe57

    assert not isinstance(shape, Mesh)
    places, _ = split_shape(shape)
    points = (1e-3 * places.astype(np.float64)).astype(places.dtype)
    count, colours = len(points), shape.colours
    columns = dict(zip(_PLACE, points.T, strict=True))
    if colours is not None:
        columns |= dict(zip(_COLOURS, colours.T, strict=True))
    if shape.normals is not None:
        normals = replace_nan("nx", shape.normals).astype(np.float32)
        columns |= dict(zip(_NORMAL, normals.T, strict=True))
    size = _SIZES.estimate(count, 0, colours=colours is not None, scalars=0)
    with arriving_path(path, size) as arriving:
        file = pye57.E57(str(arriving), mode="w")
        try:
            image = file.image_file
            image.extensionsAdd("nor", _NORMALS_URI)
            prototype, buffers = libe57.StructureNode(image), libe57.VectorSourceDestBuffer()
            for name, values in columns.items():
                if values.dtype == np.uint8:
                    node = libe57.IntegerNode(image, 0, 0, 255)
                elif values.dtype == np.float64:
                    node = libe57.FloatNode(image, 0.0, libe57.E57_DOUBLE)
                else:
                    node = libe57.FloatNode(image, 0.0, libe57.E57_SINGLE, -_LARGEST, _LARGEST)
                prototype.set(name, node)
                columns[name] = values = np.ascontiguousarray(values)
                buffers.append(libe57.SourceDestBuffer(image, name, values, count, True, True))
            scan = libe57.StructureNode(image)
            file.data3d.append(scan)
            scan.set("guid", libe57.StringNode(image, f"{{{uuid4()}}}"))
            scan.set("name", libe57.StringNode(image, to_ascii(notes[0]) if notes else "cloud"))
            _set_limits(image, scan, "cartesianBounds", libe57.FloatNode, points, "xyz")
            if colours is not None:
                ends = np.repeat([[0], [255]], 3, axis=1)
                _set_limits(image, scan, "colorLimits", libe57.IntegerNode, ends, _COLOURS)
            vector = libe57.CompressedVectorNode(image, prototype, libe57.VectorNode(image, True))
            scan.set("points", vector)
            writer = vector.writer(buffers)
            writer.write(count)
            writer.close()
        finally:
            file.close()


def _set_limits(
    image: Any, scan: Any, name: str, kind: Any, values: np.ndarray, columns: Sequence[str]
) -> None:
    """Write the smallest and the largest of each column of ``values`` (n, k) to the scan's entry
    ``name``; ``kind``: of libe57's nodes."""
    from pye57 import libe57

    node = libe57.StructureNode(image)
    for column, smallest, largest in zip(
        columns, values.min(axis=0), values.max(axis=0), strict=True
    ):
        node.set(f"{column}Minimum", kind(image, smallest.item()))
        node.set(f"{column}Maximum", kind(image, largest.item()))
    scan.set(name, node)


def _read_fields(file: Any, header: Any, notes: list[str]) -> dict[str, np.ndarray]:
    """Return all fields of a scan, of the points that no state calls invalid, as float64."""
    from pye57 import libe57

    arrays = {name: np.empty(header.point_count) for name in header.point_fields}
    buffers = libe57.VectorSourceDestBuffer()
    for name, array in arrays.items():
        buffers.append(
            libe57.SourceDestBuffer(file.image_file, name, array, len(array), True, True)
        )
    header.points.reader(buffers).read()
    valid = np.ones(header.point_count, bool)
    for state in [name for name in arrays if name.endswith("InvalidState")]:
        valid &= arrays.pop(state) == 0
    if invalid := np.count_nonzero(~valid):
        notes.append(f"{invalid:,} of {len(valid):,} points are marked as invalid, and dropped")
    return {name: values[valid] for name, values in arrays.items()}


def _place_fields(file: Any, header: Any, fields: dict[str, np.ndarray]) -> None:
    """Replace places and normals, in place, by those in the file's frame, in which the header
    states the scanner's place; places by angles and distance become x y z."""
    from pye57.utils import convert_spherical_to_cartesian

    if _POLAR[0] in fields:
        polar = np.stack([fields.pop(name) for name in _POLAR], axis=1)
        if _PLACE[0] not in fields:
            fields |= dict(zip(_PLACE, convert_spherical_to_cartesian(polar).T, strict=True))
    if not header.has_pose():
        return
    for names, shift in ((_PLACE, header.translation), (_NORMAL, np.zeros(3))):
        if set(names) <= fields.keys():
            values = np.stack([fields[name] for name in names], axis=1)
            placed = file.to_global(values, header.rotation, shift)
            fields |= dict(zip(names, placed.T, strict=True))


def _scale_colours(header: Any, fields: dict[str, np.ndarray], notes: list[str]) -> None:
    """Replace colours, in place, by levels of 8 bits: by the limits that the scan states, else
    those of the field's whole numbers. Values outside of these stay as they are."""
    if not set(_COLOURS) <= fields.keys():
        return
    values = np.stack([fields[name] for name in _COLOURS], axis=1)
    low, high = np.array([_find_limits(header, name) for name in _COLOURS]).T
    if not (low < high).all() or not ((low <= values) & (values <= high)).all():
        return
    levels = np.rint(255 * (values - low) / (high - low)).astype(np.uint8)
    fields |= dict(zip(_COLOURS, levels.T, strict=True))
    if (count := (high - low).max() + 1) > 256:
        notes.append(f"its colours of {count:.0f} levels were scaled to 8 bits")


def _find_limits(header: Any, name: str) -> tuple[float, float]:
    """Return the least and the largest value that a colour may have; (0, 0) where nothing says."""
    from pye57 import libe57

    if header.node.isDefined("colorLimits"):
        limits = header.node["colorLimits"]
        ends = [f"{name}{end}" for end in ("Minimum", "Maximum")]
        if all(map(limits.isDefined, ends)):
            low, high = (limits[end].value() for end in ends)
            return low, high
    number = libe57.StructureNode(header.points.prototype())[name]
    if isinstance(number, libe57.IntegerNode):
        return number.minimum(), number.maximum()
    return 0, 0


def _read(path: Path, data: bytes, notes: list[str]) -> list[Columns]:
    """Return the columns of each scan in one frame, and its scanner's place."""
    _require_package(path)
    import pye57

    file, scans = pye57.E57(str(path)), list[Columns]()
    try:
        for i in range(file.scan_count):
            header = file.get_header(i)
            fields = _read_fields(file, header, notes)
            _place_fields(file, header, fields)
            _scale_colours(header, fields, notes)
            values = {name.rpartition(":")[2]: each for name, each in fields.items()}
            scans.append(values | ({SENSOR: header.translation} if header.has_pose() else {}))
    finally:
        file.close()
    if not scans:
        raise InputError(f"{path.name} holds no scans", "export the cloud again")
    return scans


FORMAT = ShapeFormat(
    "e57",
    "metres, as E57 demands; with colours and normals",
    _SIZES,
    _write,
    takes_points=True,
    read=_read,
    unit="m",
)
