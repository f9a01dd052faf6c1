"""OBJ: text, mm, with colours of the vertices and normals; and with a texture in an image beside
it. OFF is read too."""

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from slviewer import __version__
from slviewer.session.atomic import arriving_file, replace_file
from slviewer.session.columns import Columns
from slviewer.session.ply import to_ascii
from slviewer.session.polygons import read_polygons
from slviewer.session.shape_format import (
    DECIMALS,
    Shape,
    ShapeFormat,
    Sizes,
    to_trimesh,
    writing,
)
from slviewer.surface.shapes import Mesh


def _encode(shape: Shape, notes: Sequence[str]) -> bytes:
    from trimesh.exchange.obj import export_obj

    header = "\n# ".join(to_ascii(line) for line in (f"slviewer {__version__}: units mm", *notes))
    has_normals = shape.normals is not None
    text: str = export_obj(
        to_trimesh(shape), include_normals=has_normals, digits=DECIMALS, header=header
    )
    return text.encode("ascii")


def write_textured_obj(
    path: Path, shape: Mesh, uv: np.ndarray, picture: Any, notes: Sequence[str]
) -> int:
    """Write a mesh with texture coordinates ``uv`` (n, 2), and an .mtl and the picture as .png of
    that name beside it; returns the size of all three in bytes."""
    buffer = io.BytesIO()
    picture.save(buffer, format="PNG")
    png, mtl = path.with_suffix(".png"), path.with_suffix(".mtl")
    described = f"newmtl surface\nKa 1 1 1\nKd 1 1 1\nKs 0 0 0\nmap_Kd {png.name}\n"
    for beside, content in ((png, buffer.getvalue()), (mtl, described.encode())):
        replace_file(beside, content)
    lines = [f"# {to_ascii(line)}" for line in (f"slviewer {__version__}: units mm", *notes)]
    lines += [f"mtllib {mtl.name}", "usemtl surface"]
    with arriving_file(path) as file:
        file.write(("\n".join(lines) + "\n").encode("ascii"))
        np.savetxt(file, shape.vertices, f"v %.{DECIMALS}f %.{DECIMALS}f %.{DECIMALS}f")
        np.savetxt(file, uv, "vt %.7f %.7f")
        np.savetxt(file, np.repeat(shape.faces + 1, 2, axis=1), "f %d/%d %d/%d %d/%d")
    return sum(each.stat().st_size for each in (path, mtl, png))


def _read(path: Path, data: bytes, notes: list[str]) -> list[Columns]:
    """Return the numbers of the vertices, of a file without faces."""
    return [read_polygons(path.name, data, notes).columns]


FORMAT = ShapeFormat(
    "obj",
    "mm; with colours and normals",
    Sizes(200, 66, 21, face=9, digit=6),
    writing(_encode),
    takes_meshes=True,
    read=_read,
    others=("off",),
)
