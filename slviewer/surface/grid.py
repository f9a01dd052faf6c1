"""A single scan's mesh: triangles between neighbouring pixels, with all that the pixels know."""

import numpy as np

from slviewer.errors import InputError
from slviewer.reconstruction.cloud import Cloud
from slviewer.reconstruction.mesh import grid_triangles
from slviewer.reconstruction.reconstruct import JUMP
from slviewer.reconstruction.reconstruct import normals as grid_normals
from slviewer.surface.clean import clean, sight
from slviewer.surface.shapes import Mesh
from slviewer.surface.tools import compact


def grid_mesh(cloud: Cloud) -> Mesh:
    """Triangles of an organised cloud in its camera's frame, cut at depth jumps, without flying and stray pixels.

    Vertices carry the pixels' normals, colours and sigmas (along the normal). Raises InputError where no two
    neighbouring pixels lie on a surface.
    """
    normals = grid_normals(cloud.points)
    kept, _ = clean(cloud, normals)
    points = np.where(kept[..., None], cloud.points, np.float32(np.nan))
    faces = grid_triangles(points, JUMP * float(np.median(points[..., 2][kept]))) if kept.any() else np.zeros((0, 3))
    if not len(faces):
        raise InputError("No two neighbouring pixels of this scan lie on a surface: reconstruct it again.")
    along = sight(points, normals) * np.linalg.norm(points, axis=-1) / points[..., 2]
    sigma = (cloud.sigma * along)[kept]
    colours = None if cloud.texture is None else cloud.texture[kept]
    if colours is not None and colours.ndim == 1:
        colours = np.repeat(colours[:, None], 3, axis=1)
    mesh = Mesh(points[kept], faces, normals[kept], colours, sigma if np.isfinite(sigma).all() else None)
    return compact(mesh, np.ones(len(faces), bool))
