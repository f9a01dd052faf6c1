"""The PTS format of laser scanners: the number of points, then x y z intensity red green blue, in
metres."""

import io
from collections.abc import Mapping, Sequence

import numpy as np

from slviewer.plugins import Exporter, PointSet


def encode(shape: PointSet, scalars: Mapping[str, np.ndarray], notes: Sequence[str]) -> bytes:
    """Return the points of a shape as the content of a PTS file."""
    colours = np.full((len(shape), 3), 128) if shape.colours is None else shape.colours
    intensity = colours.mean(axis=1).round()
    buffer = io.BytesIO()
    buffer.write(f"{len(shape)}\n".encode("ascii"))
    rows = np.column_stack([1e-3 * shape.points.astype(np.float64), intensity, colours])
    np.savetxt(buffer, rows, ["%.7f"] * 3 + ["%d"] * 4)
    return buffer.getvalue()


EXPORTER = Exporter("pts", "metres; text, x y z intensity and colour of a point a line", encode)
