"""A mesh with a texture: an image of its surface, projected from the scans that saw it.

Every texel takes the mean of the scans that see it, weighted by how squarely they look at it, by
their noise and by the distance to their border; scans in whose way something stands are excluded.
Exposures are equalised over what two scans saw. The image shows the surface's reflectance where the
light's place is known: what a scan sees falls with the cosine of the projector's angle and the
square of its distance, which is divided out.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from scipy.ndimage import distance_transform_edt

from slviewer.errors import InputError, SlviewerError
from slviewer.geometry.polynomial import monomials
from slviewer.geometry.rigid import move_points
from slviewer.geometry.vectors import finite_rows, lengths, unit_vectors
from slviewer.reconstruction.cloud import Cloud, Points
from slviewer.registration.open3d_loader import open3d
from slviewer.surface.fuse import Progress, Views, colour_gains, compare_views
from slviewer.surface.shapes import Mesh, count_edges, face_areas, pick_attributes
from slviewer.surface.view import View, prepare_view

SIZES_PX = (512, 8192)
"""Least and largest side of a texture."""
MOST_TRIANGLES = 150_000
"""More take minutes to unfold."""
_GUTTER_PX = 4.0
_STRETCH = 1 / 6
_DEGREE = 5  # of `View.to_pixel`
_MIN_COSINE = 0.15
_GATE = 3.0  # spacings of a scan within which its surface is the mesh's
_NOMINAL_MM = (
    600.0  # distance from the light of unchanged brightness; the image is scaled in the end
)
_CHUNK = 1 << 14  # OpenCV samples images of up to 32,767 rows


@dataclass(frozen=True, eq=False)
class TexturedMesh:
    """A mesh whose vertices repeat along seams, ``uv`` (n, 2) of each, from the image's lower left
    corner, and its ``image`` (h, w, 3) uint8 RGB.

    ``seen``: share of the surface that a scan shows; the rest takes the nearest colour.
    ``mm_per_texel``: mean side of a texel on the surface; ``charts``: pieces that it was unfolded
    into; ``seams``: share of edges along their borders.
    """

    mesh: Mesh
    uv: np.ndarray
    image: np.ndarray
    seen: float
    mm_per_texel: float
    charts: int
    seams: float

    def text(self) -> str:
        """Describe the texture in a sentence."""
        height, width = self.image.shape[:2]
        return (
            f"texture of {width}x{height} px, {self.mm_per_texel:.3f} mm per pixel, in"
            f" {self.charts} charts with seams along {100 * self.seams:.1f} % of the edges; no scan"
            f" sees {100 * (1 - self.seen):.1f} % of the surface"
        )


def texture_mesh(
    mesh: Mesh,
    scans: Mapping[str, Cloud],
    T_mesh_scan: Mapping[str, np.ndarray],
    size: int = 2048,
    light: np.ndarray | None = None,
    *,
    progress: Progress = lambda share: None,
) -> TexturedMesh:
    """Unfold a mesh, and project the scans' textures onto it.

    ``scans``: organised clouds with textures, by name; ``T_mesh_scan``: their poses (4, 4) mm in
    the mesh's frame. ``size``: side of the image, px. ``light`` (3,) mm: the projector's place in
    the cameras' frame, whose shading is removed; kept where it is None. Raises InputError for a
    scan without a texture, a mesh that is too large, or sizes out of range; SlviewerError where the
    mesh cannot be unfolded.
    """
    if not SIZES_PX[0] <= size <= SIZES_PX[1]:
        raise InputError(
            f"a texture of {size} px cannot be made", f"give {SIZES_PX[0]} to {SIZES_PX[1]}"
        )
    if len(mesh.faces) > MOST_TRIANGLES:
        raise InputError(
            f"the mesh has {len(mesh.faces):,} triangles, too many to unfold",
            f"thin it to {MOST_TRIANGLES:,} or fewer",
        )
    for name, scan in scans.items():
        if scan.texture is None:
            raise InputError(
                f"{name} has no texture", "capture it with a white image among its patterns"
            )
    views = {name: prepare_view(name, cloud, T_mesh_scan[name]) for name, cloud in scans.items()}
    gains = colour_gains(views, compare_views(views, lambda share: None)) or {}
    progress(0.2)
    unfolded, corners, charts = _unfold(mesh, size)
    progress(0.5)
    places, normals = _bake_places(unfolded, size)
    chart = np.isfinite(places[..., 0])
    colours, weight = _blend(
        places[chart], normals[chart], views, gains, light, lambda s: progress(0.5 + 0.4 * s)
    )
    image, seen = np.zeros((size, size, 3), np.float32), np.zeros((size, size), bool)
    image[chart], seen[chart] = colours, weight > 0
    if not seen.any():
        raise SlviewerError(
            "no scan shows the surface", "do the mesh and the scans belong together?"
        )
    share = float(np.mean(weight > 0))
    nearest = distance_transform_edt(~seen, return_distances=False, return_indices=True)
    image = image[tuple(nearest)]
    image *= 250.0 / max(float(np.percentile(image[seen], 99.5)), 1e-6)
    progress(0.95)
    faces, uv, kept = _split_vertices(mesh, corners)
    split = Mesh(mesh.vertices[kept], faces, **(pick_attributes(mesh, kept) | {"colours": None}))
    edges, split_edges = (len(count_edges(each)[1]) for each in (mesh.faces, faces))
    progress(1.0)
    return TexturedMesh(
        split,
        uv,
        np.clip(image + 0.5, 0, 255).astype(np.uint8),
        share,
        float(np.sqrt(face_areas(mesh).sum() / np.count_nonzero(chart))),
        charts,
        (split_edges - edges) / edges,
    )


def _unfold(mesh: Mesh, size: int) -> tuple[Any, np.ndarray, int]:
    """Return Open3D's mesh with an atlas, the texture coordinates (m, 3, 2) of its triangles, and
    its charts."""
    o3d = open3d()
    unfolded = o3d.t.geometry.TriangleMesh(
        np.ascontiguousarray(mesh.vertices, np.float32), np.ascontiguousarray(mesh.faces, np.int64)
    )
    try:
        _, charts, _ = unfolded.compute_uvatlas(size=size, gutter=_GUTTER_PX, max_stretch=_STRETCH)
    except RuntimeError as error:
        raise SlviewerError(
            "the mesh cannot be unfolded, as edges of it join more than two triangles",
            "mesh it with the method poisson",
        ) from error
    return unfolded, unfolded.triangle.texture_uvs.numpy().astype(np.float64), int(charts)


def _bake_places(unfolded: Any, size: int) -> tuple[Points, Points]:
    """Return the place (h, w, 3) mm of each texel and the unit normal there; NaN outside of the
    charts."""
    unfolded.compute_vertex_normals()
    baked = unfolded.bake_vertex_attr_textures(
        size, {"positions", "normals"}, margin=1, fill=float("nan"), update_material=False
    )
    normals = baked["normals"].numpy()
    return baked["positions"].numpy(), unit_vectors(normals)


def _blend(
    places: Points,
    normals: Points,
    views: Views,
    gains: Mapping[str, float],
    light: np.ndarray | None,
    report: Progress,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean colours (n, 3) float32 of texels and their weights (n,), 0 where no view sees
    them."""
    total, weight = np.zeros((len(places), 3), np.float64), np.zeros(len(places), np.float64)
    for k, (name, view) in enumerate(views.items()):
        for first in range(0, len(places), _CHUNK):
            report((k + first / len(places)) / len(views))
            part = slice(first, first + _CHUNK)
            colours, own = _look(places[part], normals[part], view, light)
            total[part] += gains[name] * own[:, None] * colours
            weight[part] += own
    return (total / np.maximum(weight, 1e-12)[:, None]).astype(np.float32), weight


def _look(
    places: Points, normals: Points, view: View, light: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray]:
    """Return what a view shows of places (n, 3) with normals: colours (n, 3), and weights (n,), 0
    of what it misses."""
    points = move_points(np.linalg.inv(view.T), places.astype(np.float64))
    facing = normals @ view.T[:3, :3]
    cosine = -np.sum(facing * points, axis=1) / lengths(points)
    rays = (points[:, :2] / points[:, 2:] - view.to_pixel[:2]) / view.to_pixel[2:4]
    A = monomials(rays, _DEGREE)
    pixels = (A @ view.to_pixel[4:].reshape(2, -1).T).astype(np.float32)

    def sample(image: np.ndarray, how: int = cv2.INTER_LINEAR) -> np.ndarray:
        """Return an image at the pixels, NaN outside."""
        outside = (np.nan,) * 4
        return np.asarray(cv2.remap(image, pixels[:, :1], pixels[:, 1:], how, borderValue=outside))[
            :, 0
        ]

    away = np.sum((points - sample(view.points, cv2.INTER_NEAREST)) * facing, axis=1)
    inside = (np.abs(rays) <= 1.05).all(axis=1)
    sees = inside & (cosine > _MIN_COSINE) & (np.abs(away) < _GATE * view.spacing)
    assert view.colours is not None
    colours = sample(view.colours.astype(np.float32)).astype(np.float64)
    weight = (
        sample(view.inner).astype(np.float64)
        * cosine**2
        / sample(view.noise, cv2.INTER_NEAREST) ** 2
    )
    if light is not None:
        to_light = light - points
        distance = lengths(to_light)
        lit = np.sum(facing * to_light, axis=1) / distance
        sees &= lit > _MIN_COSINE
        colours *= ((distance / _NOMINAL_MM) ** 2 / np.maximum(lit, _MIN_COSINE))[:, None]
        weight *= np.maximum(lit, 0.0) ** 2  # the noise grows as the shading is divided out
    sees &= np.isfinite(weight) & finite_rows(colours)
    return np.where(sees[:, None], colours, 0.0), np.where(sees, weight, 0.0)


def _split_vertices(mesh: Mesh, corners: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the faces over vertices of which there is one for every uv of the mesh's, their uv (n,
    2), and which of the mesh's vertices each is."""
    every = np.column_stack(
        [mesh.faces.ravel(), np.round(corners.reshape(-1, 2) * (1 << 20))]
    ).astype(np.int64)
    unique, first, inverse = np.unique(every, axis=0, return_index=True, return_inverse=True)
    uv = corners.reshape(-1, 2)[first].astype(np.float32)
    return inverse.reshape(-1, 3), uv, unique[:, 0]
