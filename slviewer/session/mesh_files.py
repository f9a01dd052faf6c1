"""Points and meshes for other programs; the suffix selects the format, and files keep the size of
the object.

=======  ===========================================================================================
`.ply`   binary, float32, mm: normals, colours, the expected errors (sigma) and other values of each
         point
`.stl`   binary, mm: triangles alone
`.obj`   text, mm: colours of the vertices, normals
`.glb`   binary glTF, whose unit is the metre: vertices are written in metres; colours, normals
`.3mf`   zipped XML, mm as it states: triangles alone, for printers and CAD (`pip install
         'slviewer[cad]'`)
`.e57`   binary, ASTM E2807, in metres: points and their colours (`pip install 'slviewer[e57]'`)
`.xyz`   text, mm: x y z of a point a line, and its red green blue; no other line, which most
         readers would not bear
=======  ===========================================================================================

Plugins add other formats, an `Exporter` each. Files appear whole or not at all. In glTF y points up
and the viewer looks along -z: its node turns the camera's frame, whose y points down and whose z
points away, by half a turn about x, so that an object stands as the camera saw it.
"""

import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from slviewer import __version__
from slviewer.entry_points import PluginGroup
from slviewer.errors import InputError
from slviewer.session.atomic import arriving_file, arriving_path, replace_file
from slviewer.session.cad import require_packages
from slviewer.session.ply import FACE, check_faces, replace_nan, to_ascii, write_ply
from slviewer.surface.shapes import Mesh, PointSet

POINT_FORMATS = ("ply", "xyz", "glb", "e57")
MESH_FORMATS = ("ply", "stl", "obj", "glb", "3mf", "xyz")
IN_WORDS = {
    "ply": "mm; with colours, normals and sigma",
    "stl": "mm; the triangles alone",
    "obj": "mm; with colours and normals",
    "glb": "metres, as glTF demands, so that programs show the true size; with colours",
    "3mf": "mm, as the file states; the triangles alone",
    "e57": "metres, as E57 demands; with colours",
    "xyz": "mm; text, x y z of a point a line, and its colour",
}
"""Units and content of each format."""
_GLB_LIMIT = 2**32 - 1
DECIMALS = 6
"""Of lengths in text: a nanometre, below what a float32 of some hundred mm resolves."""
_SIZES = {
    "ply": (300, 24, 3, 4, FACE.itemsize),
    "stl": (84, 0, 0, 0, 50),
    "glb": (1200, 24, 4, 0, 12),
    "e57": (4000, 12, 3, 0, 0),
    "3mf": (1500, 14, 0, 0, 7),
    "obj": (200, 66, 21, 0, 9),
    "xyz": (0, 33, 12, 0, 0),
}
"""Bytes of a file, of each of its points, their colours and scalars, and of each face."""


@dataclass(frozen=True)
class Exporter:
    """A file format that a plugin adds; ``name`` is its suffix in lower case, without the dot.

    ``what``: unit and content, in a few words. ``encode(shape, scalars, notes)`` returns the
    content of the file, of a `PointSet` or, with ``takes_meshes``, a `Mesh`, in mm; scalars and
    notes as in `write_shape`.
    """

    name: str
    what: str
    encode: Callable[[PointSet | Mesh, Mapping[str, np.ndarray], Sequence[str]], bytes]
    takes_points: bool = True
    takes_meshes: bool = False


EXPORTER_PLUGINS = PluginGroup("slviewer.exporters", Exporter, lambda: IN_WORDS)


def exporters() -> dict[str, Exporter]:
    """Return the formats of plugins by name."""
    return EXPORTER_PLUGINS.usable()


def point_formats() -> tuple[str, ...]:
    """Return the suffixes in which points can be written, those of plugins last."""
    return (*POINT_FORMATS, *(name for name, added in exporters().items() if added.takes_points))


def mesh_formats() -> tuple[str, ...]:
    """Return the suffixes in which meshes can be written, those of plugins last."""
    return (*MESH_FORMATS, *(name for name, added in exporters().items() if added.takes_meshes))


def write_shape(
    path: str | Path,
    shape: PointSet | Mesh,
    *,
    scalars: Mapping[str, np.ndarray] | None = None,
    notes: Sequence[str] = (),
) -> int:
    """Write points or a mesh in the format of the suffix, and return the file's size in bytes.

    ``scalars``: values (n,) of each point by name, such as ``sigma_noise`` mm or ``deviation`` mm,
    for the formats that hold them (PLY); the shape's own ``sigma_mm`` is called ``sigma``.
    ``notes``: sentences for the comments.

    Raises InputError for another suffix, for points where a format takes only triangles, for NaN
    points and for an empty shape; SessionError where the disk refuses (a file of that name stays
    unchanged).
    """
    path = Path(path)
    file_format = path.suffix.lower().removeprefix(".")
    points, faces = (
        (shape.vertices, shape.faces) if isinstance(shape, Mesh) else (shape.points, None)
    )
    _check_format(path, file_format, is_mesh=faces is not None)
    if not len(points) or (faces is not None and not len(faces)):
        raise InputError(f"{path.name} would be empty: there is nothing to write")
    if not np.isfinite(points).all():
        raise InputError(f"{path.name}: some points are NaN: select the valid ones first")
    values = dict(scalars or {})
    if shape.sigma_mm is not None:
        values.setdefault("sigma", shape.sigma_mm)
    if faces is not None:
        check_faces(faces, len(points))
    if file_format == "ply":
        write_ply(path, points, shape.colours, shape.normals, values, faces, notes)
    elif file_format == "xyz":
        _write_xyz(path, points, shape.colours)
    elif file_format == "e57":
        _write_e57(path, points, shape.colours, notes)
    elif added := exporters().get(file_format):
        replace_file(path, added.encode(shape, values, notes))
    else:
        encode = {"stl": _encode_stl, "obj": _encode_obj, "glb": _encode_glb, "3mf": _encode_3mf}[
            file_format
        ]
        replace_file(path, encode(shape, notes))
    return path.stat().st_size


def _check_format(path: Path, file_format: str, is_mesh: bool) -> None:
    """Raise InputError unless points or meshes can be written in the format."""
    formats = mesh_formats() if is_mesh else point_formats()
    if file_format not in formats:
        what = "a mesh" if is_mesh else "a cloud"
        why = ": it has no triangles" if file_format in mesh_formats() else ""
        listed = ", ".join(f".{each}" for each in formats)
        raise InputError(f"{path.name}: {what} cannot be written so{why}; choose one of {listed}")


def write_textured(
    path: str | Path, shape: Mesh, uv: np.ndarray, image: np.ndarray, notes: Sequence[str] = ()
) -> int:
    """Write a mesh with texture coordinates ``uv`` (n, 2) and its image (h, w, 3) uint8, and return
    the size in bytes.

    As .glb one file in metres; as .obj in mm with an .mtl and a .png of that name beside it. Raises
    InputError for another suffix.
    """
    from PIL import Image
    from trimesh.visual.material import PBRMaterial
    from trimesh.visual.texture import TextureVisuals

    path = Path(path)
    picture = Image.fromarray(image)
    if (file_format := path.suffix.lower()) == ".glb":
        material = PBRMaterial(
            baseColorTexture=picture, metallicFactor=0.0, roughnessFactor=1.0, doubleSided=True
        )
        replace_file(path, _encode_glb(shape, notes, TextureVisuals(uv=uv, material=material)))
        return path.stat().st_size
    if file_format != ".obj":
        raise InputError(
            f"{path.name}: a texture is kept by .glb and .obj: end its name in one of these"
        )
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


def estimated_bytes(
    file_format: str, points: int, faces: int = 0, *, colours: bool = True, scalars: int = 0
) -> int:
    """Estimate the size of a file of so many points and faces: within 1 % of binary files, some 20
    % of texts."""
    fixed, point, colour, scalar, face = _SIZES.get(file_format, _SIZES["xyz"])
    if file_format == "obj":
        face += 6 * len(str(points))
    return fixed + points * (point + colour * colours + scalar * scalars) + faces * face


def _write_xyz(path: Path, points: np.ndarray, colours: np.ndarray | None) -> None:
    """Write points (n, 3) mm, with colours (n, 3) if given, as text, one point a line."""
    columns = np.round(points.astype(np.float64), DECIMALS) + 0.0  # no "-0.000000"
    formats = [f"%.{DECIMALS}f"] * 3
    if colours is not None:
        columns, formats = np.hstack([columns, colours]), [*formats, "%d", "%d", "%d"]
    with arriving_file(
        path, estimated_bytes("xyz", len(points), colours=colours is not None)
    ) as file:
        np.savetxt(file, columns, formats)


def _write_e57(
    path: Path, points: np.ndarray, colours: np.ndarray | None, notes: Sequence[str]
) -> None:
    """Write points (n, 3) mm, with colours (n, 3) if given, as an E57 file in metres; needs the
    package pye57."""
    if find_spec("pye57") is None:
        raise InputError(
            f"{path.name}: .e57 files need the package pye57: install it with pip install"
            " 'slviewer[e57]'"
        )
    import pye57

    x, y, z = 1e-3 * points.T.astype(np.float64)
    fields = {"cartesianX": x, "cartesianY": y, "cartesianZ": z}
    if colours is not None:
        fields |= dict(zip(("colorRed", "colorGreen", "colorBlue"), colours.T, strict=True))
    with arriving_path(
        path, estimated_bytes("e57", len(points), colours=colours is not None)
    ) as arriving:
        file = pye57.E57(str(arriving), mode="w")
        try:
            file.write_scan_raw(fields, name=to_ascii(notes[0]) if notes else None)
        finally:
            file.close()


def read_mesh_file(path: Path) -> Any:
    """Return the mesh of a file that was written here (.stl, .ply, .obj, .glb) as a
    `trimesh.Trimesh` in mm, in the frame of the camera, with its colours or texture."""
    import trimesh

    mesh: Any = trimesh.load(path, force="mesh", process=False)
    if path.suffix == ".glb":  # metres, and turned by its node
        mesh.vertices = 1e3 * mesh.vertices * (1.0, -1.0, -1.0)
    return mesh


def _to_trimesh(shape: PointSet | Mesh, scale: float = 1.0) -> Any:
    """A trimesh.Trimesh or PointCloud with colours and normals, which are zero where unknown."""
    import trimesh

    if isinstance(shape, PointSet):
        return trimesh.PointCloud(scale * shape.points.astype(np.float64), shape.colours)
    normals = None if shape.normals is None else replace_nan("nx", shape.normals)
    return trimesh.Trimesh(
        scale * shape.vertices.astype(np.float64),
        shape.faces,
        vertex_normals=normals,
        vertex_colors=shape.colours,
        process=False,
    )


def _encode_stl(shape: PointSet | Mesh, notes: Sequence[str]) -> bytes:
    """Return a mesh as the bytes of a binary STL file in mm."""
    from trimesh.exchange.stl import export_stl

    # a header that began with "solid" would be read as a text file
    header = f"slviewer {__version__}, binary STL, units mm".encode("ascii").ljust(80)
    return header + export_stl(_to_trimesh(shape))[80:]


def _encode_obj(shape: PointSet | Mesh, notes: Sequence[str]) -> bytes:
    """Return a shape as the bytes of an OBJ file in mm, with the notes as comments."""
    from trimesh.exchange.obj import export_obj

    header = "\n# ".join(to_ascii(line) for line in (f"slviewer {__version__}: units mm", *notes))
    has_normals = shape.normals is not None
    text: str = export_obj(
        _to_trimesh(shape), include_normals=has_normals, digits=DECIMALS, header=header
    )
    return text.encode("ascii")


def _encode_3mf(shape: PointSet | Mesh, notes: Sequence[str]) -> bytes:
    """Return a mesh as the bytes of a 3MF file in mm; SessionError where its packages are
    missing."""
    require_packages("3mf")
    from trimesh.exchange.threemf import export_3MF

    content: bytes = export_3MF(_to_trimesh(shape))
    return content


def _encode_glb(shape: PointSet | Mesh, notes: Sequence[str], texture: Any = None) -> bytes:
    """Binary glTF 2.0 in metres; normals only if all are known, since glTF has no unknown ones.
    ``texture``: trimesh's visual that replaces the colours of the vertices."""
    import trimesh
    from trimesh.exchange.gltf import export_glb

    points, faces = (shape.vertices, shape.faces) if isinstance(shape, Mesh) else (shape.points, ())
    size = estimated_bytes("glb", len(points), len(faces))
    if size > _GLB_LIMIT:
        raise InputError(
            f"{size / 1e9:.1f} GB do not fit into a .glb, which ends at 4.3: write a .ply instead"
        )

    def describe(tree: dict[str, Any]) -> None:
        """Add generator, notes, material and axis convention to the glTF tree in place."""
        words = [
            "vertices in metres, in the frame of the camera",
            "the node turns y up and z towards the viewer",
        ]
        tree["asset"] |= {
            "generator": f"slviewer {__version__}",
            "extras": {"notes": [*words, *notes]},
        }
        # scanned surfaces are open: they have no inside that need not be drawn
        roughness = {"metallicFactor": 0, "roughnessFactor": 1}
        if texture is None:
            tree["materials"] = [{"doubleSided": True, "pbrMetallicRoughness": roughness}]
        for mesh in tree["meshes"]:
            mesh["primitives"][0]["material"] = 0

    scene, surface = trimesh.Scene(), _to_trimesh(shape, 1e-3)
    if texture is not None:
        surface.visual = texture
    scene.add_geometry(surface, "surface", transform=np.diag([1.0, -1.0, -1.0, 1.0]))
    has_normals = shape.normals is not None and bool(np.isfinite(shape.normals).all())
    content: bytes = export_glb(scene, include_normals=has_normals, tree_postprocessor=describe)
    return content
