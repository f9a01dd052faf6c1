"""E57: binary, ASTM E2807, in metres, points and their colours (`pip install 'slviewer[e57]'`)."""

from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from slviewer.errors import InputError
from slviewer.session.atomic import arriving_path
from slviewer.session.ply import COLOURS, PLACE, to_ascii
from slviewer.session.shape_format import Columns, Shape, ShapeFormat, Sizes
from slviewer.surface.shapes import Mesh

_SIZES = Sizes(4000, 12, 3)


def _require_package(path: Path) -> None:
    if find_spec("pye57") is None:
        raise InputError(
            f"{path.name}: .e57 files need the package pye57",
            "install it with pip install 'slviewer[e57]'",
        )


def _write(path: Path, shape: Shape, scalars: Columns, notes: Sequence[str]) -> None:
    _require_package(path)
    import pye57

    assert not isinstance(shape, Mesh)
    x, y, z = 1e-3 * shape.points.T.astype(np.float64)
    fields = {"cartesianX": x, "cartesianY": y, "cartesianZ": z}
    if shape.colours is not None:
        fields |= dict(zip(("colorRed", "colorGreen", "colorBlue"), shape.colours.T, strict=True))
    size = _SIZES.estimate(len(x), 0, colours=shape.colours is not None, scalars=0)
    with arriving_path(path, size) as arriving:
        file = pye57.E57(str(arriving), mode="w")
        try:
            file.write_scan_raw(fields, name=to_ascii(notes[0]) if notes else None)
        finally:
            file.close()


def _read(path: Path, data: bytes) -> list[Columns]:
    """Return the columns of each scan in one frame, and its scanner's place."""
    _require_package(path)
    import pye57

    file, scans = pye57.E57(str(path)), list[Columns]()
    try:
        for i in range(file.scan_count):
            header = file.get_header(i)
            # transformed into the file's frame, in which the header states the scanner's place
            values = file.read_scan(i, colors=True, transform=True, ignore_missing_fields=True)
            fields = [(f"cartesian{each.upper()}", each) for each in PLACE]
            fields += [(f"color{each.title()}", each) for each in COLOURS]
            columns = {ours: values[theirs] for theirs, ours in fields if theirs in values}
            scans.append(columns | ({"sensor": header.translation} if header.has_pose() else {}))
    finally:
        file.close()
    if not scans:
        raise InputError(f"{path.name} holds no scans", "export the cloud again")
    return scans


FORMAT = ShapeFormat(
    "e57",
    "metres, as E57 demands; with colours",
    _SIZES,
    _write,
    takes_points=True,
    read=_read,
    unit="m",
)
