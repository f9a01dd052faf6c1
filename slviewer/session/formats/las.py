"""LAS and LAZ of the ASPRS, in the metres of their coordinate system; read alone (`pip install
'slviewer[las]'`)."""

import io
import re
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from slviewer.errors import InputError
from slviewer.session.columns import Columns
from slviewer.session.shape_format import ShapeFormat

_UNIT_KEY, _METRE = 3076, 9001
"""Of GeoTIFF: the key of the unit of projected coordinates, and its code of the metre."""
_FEET = {9002: "feet", 9003: "US survey feet"}


def _read(path: Path, data: bytes, notes: list[str]) -> list[Columns]:
    """Return the dimensions of all points that are not zero throughout."""
    if find_spec("laspy") is None or (path.suffix.lower() == ".laz" and find_spec("lazrs") is None):
        raise InputError(
            f"{path.name}: {path.suffix} files need the packages laspy and lazrs",
            "install them with pip install 'slviewer[las]'",
        )
    import laspy

    with laspy.open(io.BytesIO(data)) as file:
        count = file.header.point_count
        las = file.read()
    if len(las.points) < count:
        raise ValueError(f"it holds {len(las.points):,} of {count:,} points")
    if (unit := _find_unit(las.header.vlrs)) not in ("", "metre", "meter", "m"):
        raise InputError(
            f"{path.name}: its coordinates are in {unit}", "convert it to metres, and import that"
        )
    columns = {axis: np.asarray(getattr(las, axis)) for axis in "xyz"}
    for name in las.point_format.dimension_names:
        values = np.asarray(las[name])
        if name not in ("X", "Y", "Z") and values.any():
            columns[name] = values
    return [columns]


def _find_unit(records: Any) -> str:
    """Return the unit of length that the coordinate system of a LAS states; empty without any."""
    for record in records:
        for key in getattr(record, "geo_keys", ()):
            if key.id == _UNIT_KEY and key.value_offset != _METRE:
                return _FEET.get(key.value_offset, f"the unit {key.value_offset} of EPSG")
        units = re.findall(r'(?:LENGTH)?UNIT\["([^"]+)"', getattr(record, "string", ""))
        if lengths := [each.lower() for each in units if "deg" not in each.lower()]:
            return str(lengths[-1])
    return ""


FORMAT = ShapeFormat("las", "metres", read=_read, others=("laz",), unit="m")
