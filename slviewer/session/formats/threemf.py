"""3MF: zipped XML, mm as it states, triangles alone, for printers and CAD (`pip install
'slviewer[cad]'`)."""

from collections.abc import Sequence

from slviewer.session.cad import require_packages
from slviewer.session.shape_format import Shape, ShapeFormat, Sizes, to_trimesh, writing


def _encode(shape: Shape, notes: Sequence[str]) -> bytes:
    """Raises SessionError where its packages are missing."""
    require_packages("3mf")
    from trimesh.exchange.threemf import export_3MF

    content: bytes = export_3MF(to_trimesh(shape))
    return content


FORMAT = ShapeFormat(
    "3mf",
    "mm, as the file states; the triangles alone",
    Sizes(1500, 14, face=7),
    writing(_encode),
    takes_meshes=True,
)
