"""GLB: binary glTF, whose unit is the metre, with colours and normals.

In glTF y points up and the viewer looks along -z: its node turns the camera's frame, whose y points
down and whose z points away, by half a turn about x, so that an object stands as the camera saw it.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from slviewer import __version__
from slviewer.errors import InputError
from slviewer.session.shape_format import (
    Shape,
    ShapeFormat,
    Sizes,
    split_shape,
    to_trimesh,
    writing,
)

_LIMIT = 2**32 - 1
_SIZES = Sizes(1200, 24, 4, face=12)


def encode_glb(shape: Shape, notes: Sequence[str], texture: Any = None) -> bytes:
    """Binary glTF 2.0 in metres; normals only if all are known, since glTF has no unknown ones.
    ``texture``: trimesh's visual that replaces the colours of the vertices."""
    import trimesh
    from trimesh.exchange.gltf import export_glb

    points, faces = split_shape(shape)
    count = 0 if faces is None else len(faces)
    size = _SIZES.estimate(len(points), count, colours=True, scalars=0)
    if size > _LIMIT:
        raise InputError(
            f"{size / 1e9:.1f} GB do not fit into a .glb, which ends at 4.3", "write a .ply instead"
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

    scene, surface = trimesh.Scene(), to_trimesh(shape, 1e-3)
    if texture is not None:
        surface.visual = texture
    scene.add_geometry(surface, "surface", transform=np.diag([1.0, -1.0, -1.0, 1.0]))
    has_normals = shape.normals is not None and bool(np.isfinite(shape.normals).all())
    content: bytes = export_glb(scene, include_normals=has_normals, tree_postprocessor=describe)
    return content


FORMAT = ShapeFormat(
    "glb",
    "metres and y up, as glTF demands, so that programs show the true size; with colours",
    _SIZES,
    writing(encode_glb),
    takes_points=True,
    takes_meshes=True,
    unit="m",
    holds_origin=False,
)
