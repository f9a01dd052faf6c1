"""STL: binary, mm, triangles alone."""

from collections.abc import Sequence

from slviewer import __version__
from slviewer.session.shape_format import Shape, ShapeFormat, Sizes, to_trimesh, writing


def _encode(shape: Shape, notes: Sequence[str]) -> bytes:
    from trimesh.exchange.stl import export_stl

    # a header that began with "solid" would be read as a text file
    header = f"slviewer {__version__}, binary STL, units mm".encode("ascii").ljust(80)
    return header + export_stl(to_trimesh(shape))[80:]


FORMAT = ShapeFormat(
    "stl",
    "mm; the triangles alone",
    Sizes(84, 0, face=50),
    writing(_encode),
    takes_meshes=True,
    holds_origin=False,
)
