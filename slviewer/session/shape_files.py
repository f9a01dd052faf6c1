"""Points and meshes for other programs; the suffix selects the format, and files keep the size of
the object.

Each format is a module of `session.formats`; plugins add others, an `Exporter` each. Files appear
whole or not at all.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from slviewer.entry_points import PluginGroup, import_modules
from slviewer.errors import InputError
from slviewer.session import formats
from slviewer.session.atomic import replace_file
from slviewer.session.columns import Columns
from slviewer.session.formats.glb import encode_glb
from slviewer.session.formats.obj import write_textured_obj
from slviewer.session.names import join_names
from slviewer.session.ply import check_faces
from slviewer.session.shape_format import Shape, ShapeFormat, split_shape
from slviewer.surface.shapes import Mesh, PointSet


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


@cache
def own_formats() -> dict[str, ShapeFormat]:
    """Return slviewer's formats by name, PLY first."""
    found = [module.FORMAT for module in import_modules(formats)]
    return {each.name: each for each in sorted(found, key=lambda f: (f.name != "ply", f.name))}


EXPORTER_PLUGINS = PluginGroup("slviewer.exporters", Exporter, own_formats)


def all_formats() -> dict[str, ShapeFormat]:
    """Return all formats by name, those of plugins last."""
    return own_formats() | {
        name: _adapt(added) for name, added in EXPORTER_PLUGINS.usable().items()
    }


def _adapt(added: Exporter) -> ShapeFormat:
    """Return the format of a plugin."""

    def write(path: Path, shape: Shape, scalars: Columns, notes: Sequence[str]) -> None:
        """Write the plugin's content."""
        replace_file(path, added.encode(shape, scalars, notes))

    return ShapeFormat(
        added.name,
        added.what,
        write=write,
        takes_points=added.takes_points,
        takes_meshes=added.takes_meshes,
        holds_scalars=True,
        holds_origin=False,
    )


def point_formats() -> tuple[str, ...]:
    """Return the suffixes in which points can be written, those of plugins last."""
    return tuple(name for name, each in all_formats().items() if each.takes_points)


def mesh_formats() -> tuple[str, ...]:
    """Return the suffixes in which meshes can be written, those of plugins last."""
    return tuple(name for name, each in all_formats().items() if each.takes_meshes)


def write_shape(
    path: str | Path,
    shape: PointSet | Mesh,
    *,
    scalars: Mapping[str, np.ndarray] | None = None,
    notes: Sequence[str] = (),
) -> int:
    """Write points or a mesh in the format of the suffix, and return the file's size in bytes.

    ``scalars``: values (n,) of each point by name, such as ``sigma_noise`` mm or ``deviation`` mm,
    for the formats that hold them (PLY, PCD); the shape's own ``sigma_mm`` is called ``sigma``.
    ``notes``: sentences for the comments. `describe_loss` says what a format does not hold.

    Raises InputError for another suffix, for points where a format takes only triangles, for NaN
    points and for an empty shape; SessionError where the disk refuses (a file of that name stays
    unchanged).
    """
    path = Path(path)
    points, faces = split_shape(shape)
    chosen = _find_format(path, is_mesh=faces is not None)
    if not len(points) or (faces is not None and not len(faces)):
        raise InputError(f"{path.name} would be empty: there is nothing to write")
    if not np.isfinite(points).all():
        raise InputError(f"{path.name}: some points are NaN", "select the valid ones first")
    values = dict(scalars or {})
    if shape.sigma_mm is not None:
        values.setdefault("sigma", shape.sigma_mm)
    if faces is not None:
        check_faces(faces, len(points))
    assert chosen.write is not None
    if loss := describe_loss(path, shape):
        shape, notes = replace(shape, origin=None), [*notes, loss]
    chosen.write(path, shape, values, notes)
    return path.stat().st_size


def describe_loss(path: str | Path, shape: PointSet | Mesh, scalars: Collection[str] = ()) -> str:
    """Describe which of a shape's origin and scalars the format of a suffix does not hold; empty
    where it holds all."""
    chosen = all_formats()[Path(path).suffix.lower().removeprefix(".")]
    lost = list[str]()
    if scalars and not chosen.holds_scalars:
        holding = ", ".join(f".{n}" for n, each in all_formats().items() if each.holds_scalars)
        lost.append(f"without {join_names(sorted(scalars), 30)}, which {holding} hold")
    if shape.origin is not None and not chosen.holds_origin:
        x, y, z = shape.origin
        lost.append(f"coordinates less the origin {x:.10g} {y:.10g} {z:.10g} mm")
    return "; ".join(lost)


def _find_format(path: Path, is_mesh: bool) -> ShapeFormat:
    """Return the format of a file's suffix. Raises InputError unless points or meshes can be
    written in it."""
    name = path.suffix.lower().removeprefix(".")
    possible = mesh_formats() if is_mesh else point_formats()
    if name not in possible:
        what = "a mesh" if is_mesh else "a cloud"
        why = ": it has no triangles" if name in mesh_formats() else ""
        listed = ", ".join(f".{each}" for each in possible)
        raise InputError(
            f"{path.name}", f"{what} cannot be written so{why}; choose one of {listed}"
        )
    return all_formats()[name]


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
        replace_file(path, encode_glb(shape, notes, TextureVisuals(uv=uv, material=material)))
        return path.stat().st_size
    if file_format != ".obj":
        raise InputError(
            f"{path.name}: a texture is kept by .glb and .obj", "end its name in one of these"
        )
    return write_textured_obj(path, shape, uv, picture, notes)


def estimated_bytes(
    file_format: str, points: int, faces: int = 0, *, colours: bool = True, scalars: int = 0
) -> int:
    """Estimate the size of a file of so many points and faces: within 1 % of binary files, some 20
    % of texts."""
    return all_formats()[file_format].sizes.estimate(points, faces, colours, scalars)


def read_mesh_file(path: Path) -> Any:
    """Return the mesh of a file that was written here (.stl, .ply, .obj, .glb) as a
    `trimesh.Trimesh` in mm, in the frame of the camera, with its colours or texture."""
    import trimesh

    mesh: Any = trimesh.load(path, force="mesh", process=False)
    if path.suffix == ".glb":  # metres, and turned by its node
        mesh.vertices = 1e3 * mesh.vertices * (1.0, -1.0, -1.0)
    return mesh
