"""Preparation of a scan for fusion: cleaning of flying pixels at depth edges, grazing pixels, and
small or distant groups; standard deviations along the normals, weights, and a pixel map."""

from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
from scipy.spatial import cKDTree

from slviewer.errors import InputError
from slviewer.geometry.polynomial import monomials
from slviewer.geometry.rigid import Mask, move_points
from slviewer.geometry.vectors import lengths, median_spacing, occupied_cubes, rms
from slviewer.reconstruction.cloud import Cloud, Map, Points, choose_pixels, keep_pixels
from slviewer.reconstruction.reconstruct import normals as grid_normals
from slviewer.surface.overlap_kernels import SurfaceGrid
from slviewer.surface.shapes import label_connected

LEAST_POINTS = 200
FEATHER = 0.02
"""Share of the image's diagonal over which a scan's weight rises from its border inwards."""
_DEGREE = 5  # of the polynomial from rays to pixels
_MAX_RMS_PX = 0.75  # of that polynomial, for points of one camera
_LEAST_WEIGHT = 1e-3
STEEPEST = 6.0
"""Largest depth step between neighbours of one surface, over their distance across the viewing
direction (80°)."""
MIN_VIEWING_COSINE = 0.12
"""Least cosine between normal and viewing direction of a measured surface (83°)."""
FAR_SPACINGS = 20.0
FAR_SHARE = 0.005
"""A cluster is excluded where it is more than 20 point spacings away from all others and has less
than 0.5 % of the points."""
LEAST_GROUP = 2e-4
"""Least share of a scan's pixels in a connected group."""


@dataclass(frozen=True, eq=False)
class View:
    """A cleaned scan, cropped to its surface.

    ``T`` (4, 4) float64: T_reference_scan. Images (h, w, ...) float32 in the camera's frame:
    ``points`` mm, NaN where there is no surface; unit ``normals`` towards the camera; ``noise`` and
    ``systematic`` mm, the random and the calibration's standard deviation along the normal;
    ``inner``, a weight that rises from 0 at the scan's border to 1; ``quality``, smoothed
    information per area in 1/mm^4; ``colours`` (h, w, 3) uint8 or None. ``to_pixel`` maps rays to
    pixels (see ``_fit_pixel_map``); ``spacing``: median distance of neighbouring points, mm;
    ``cleaned``: numbers of the excluded pixels.
    """

    T: np.ndarray
    points: Points
    normals: Points
    noise: Map
    systematic: Map
    inner: Map
    quality: Map
    colours: np.ndarray | None
    to_pixel: np.ndarray
    spacing: float
    cleaned: dict[str, int]

    @property
    def mask(self) -> Mask:
        """(h, w) bool: pixels with a point."""
        return np.isfinite(self.points[..., 2])

    @property
    def grid(self) -> SurfaceGrid:
        """What the kernels need to interpolate the surface."""
        return SurfaceGrid(*(getattr(self, name) for name in SurfaceGrid._fields))

    def move_into(
        self, other: "View", points: Points, normals: Points
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return points and normals (n, 3) of this view's frame in the frame of another one,
        contiguous."""
        T = np.linalg.inv(other.T) @ self.T
        return np.ascontiguousarray(move_points(T, points)), np.ascontiguousarray(
            normals @ T[:3, :3].T
        )


def prepare_view(name: str, cloud: Cloud, T_reference_scan: np.ndarray) -> View:
    """Prepare a scan with its pose (4, 4) for fusion.

    Raises InputError with the scan's ``name`` for an invalid pose, for too few pixels on a surface,
    and for points that were not measured by one camera at the origin.
    """
    T = np.asarray(T_reference_scan, dtype=np.float64)
    if T.shape != (4, 4) or not np.isfinite(T).all():
        raise InputError(
            f"{name}: its pose has shape {T.shape}",
            "fusing needs a finite (4, 4) T_reference_scan.",
        )
    normals = grid_normals(cloud.points)
    surface, cleaned = clean(cloud, normals)
    if np.count_nonzero(surface) < LEAST_POINTS:
        raise InputError(
            f"{name}: only {np.count_nonzero(surface)} of its pixels lie on a surface",
            "reconstruct it again, or exclude it.",
        )
    x, y, width, height = cv2.boundingRect(surface.astype(np.uint8))
    crop = np.s_[y : y + height, x : x + width]
    surface, normals = surface[crop], normals[crop]
    points = keep_pixels(cloud.points[crop], surface)
    cosine = viewing_cosines(points, normals)
    noise = _fill_noise(cloud.sigma_z[crop], points, cosine, surface)
    systematic = (
        np.zeros_like(noise) if cloud.sigma_systematic is None else cloud.sigma_systematic[crop]
    )
    # an error dz of depth moves the point by dz (x/z, y/z, 1) along its ray; its component along
    # the normal
    along = cosine * lengths(points) / points[..., 2]
    noise, systematic = noise * along, np.nan_to_num(systematic) * along
    inner = _border_weights(surface)
    area = _pixel_areas(points, cosine)
    quality = np.where(surface, inner / ((noise**2 + systematic**2) * area), 0.0)
    return View(
        T=T,
        points=points,
        normals=normals,
        noise=noise.astype(np.float32),
        systematic=systematic.astype(np.float32),
        inner=inner,
        quality=_smooth(quality, surface),
        colours=None if (rgb := cloud.rgb) is None else np.ascontiguousarray(rgb[crop]),
        to_pixel=_fit_pixel_map(name, points, surface),
        spacing=float(np.sqrt(np.nanmedian(area))),
        cleaned=cleaned,
    )


def _fill_noise(sigma_z: Map, points: Points, cosine: Map, surface: Mask) -> Map:
    """Return the depth noise (h, w) mm with unknown values filled in, in proportion to z^2 /
    cosine.

    The factor is fitted to the known values where these are the majority, else to the roughness of
    the surface.
    """
    known = surface & np.isfinite(sigma_z) & (sigma_z > 0)
    if (known == surface).all():
        return sigma_z
    z = points[..., 2].astype(np.float64)
    shape = z**2 / np.maximum(cosine, 0.05)
    if known.sum() > 0.5 * surface.sum():
        scale = float(np.median(sigma_z[known] / shape[known]))
    else:
        bend = z[1:-1, 1:-1] - 0.25 * (z[:-2, 1:-1] + z[2:, 1:-1] + z[1:-1, :-2] + z[1:-1, 2:])
        ratio = np.abs(bend / shape[1:-1, 1:-1])
        # of five equal, independent errors the difference has the standard deviation sqrt(1.25)
        scale = 1.4826 / np.sqrt(1.25) * float(np.nanmedian(ratio))
    # positive for a perfect plane too, as weights divide by it
    scale = max(scale, 1e-7 / float(np.nanmedian(z)))
    return np.where(known, sigma_z, scale * shape)


def _border_weights(surface: Mask) -> Map:
    """(h, w) float32: weights that rise smoothly from 0 at the border of a mask (h, w) to 1;
    pinholes are closed."""
    distance = cv2.distanceTransform(np.pad(close_pinholes(surface), 1), cv2.DIST_L2, 5)[1:-1, 1:-1]
    width = max(4.0, FEATHER * float(np.hypot(*surface.shape)))
    share = np.clip((distance - 0.5) / width, 0, 1)
    return np.where(surface, np.maximum(share * share * (3 - 2 * share), _LEAST_WEIGHT), 0).astype(
        np.float32
    )


def _pixel_areas(points: Points, cosine: Map) -> Map:
    """(h, w) mm2: the area of surface that each pixel covers."""
    z = points[..., 2]
    across, down = (
        float(np.nanmedian(np.abs(np.diff(points[..., k] / z, axis=1 - k)))) for k in (0, 1)
    )
    return across * down * z**2 / np.maximum(cosine, 0.05)


def _smooth(quality: Map, surface: Mask) -> Map:
    """Average the quality (h, w) over 9 by 9 pixels of the surface, so that the best scan does not
    change by pixel."""
    size = (9, 9)
    total = cv2.blur(quality.astype(np.float64), size)
    share = cv2.blur(surface.astype(np.float64), size)
    return np.where(surface, total / np.maximum(share, 1e-9), 0).astype(np.float32)


def _fit_pixel_map(name: str, points: Points, surface: Mask) -> np.ndarray:
    """Fit the map from rays (x/z, y/z) to pixels: a polynomial of degree 5, accurate to a fraction
    of a pixel.

    Returns (46,) float64: centre (2) and half width (2) of the rays, then the coefficients (21
    each) for column and row in the normalised rays, in the order of ``monomials``. Raises
    InputError where the points are not those of one camera at the origin.
    """
    v, u = np.nonzero(surface)
    every = slice(None, None, max(1, len(u) // 20_000))
    u, v = u[every], v[every]
    p = points[v, u].astype(np.float64)
    rays = p[:, :2] / p[:, 2:]
    low, high = rays.min(axis=0), rays.max(axis=0)
    middle, half = (low + high) / 2, np.maximum((high - low) / 2, 1e-9)
    A = monomials((rays - middle) / half, _DEGREE)
    pixels = np.stack([u, v], axis=1).astype(np.float64)
    coefficients, *_ = np.linalg.lstsq(A, pixels, rcond=1e-10)
    error_px = rms(A @ coefficients - pixels)
    if error_px > _MAX_RMS_PX:
        raise InputError(
            f"{name}: its points do not lie on the lines of sight of one camera at the origin"
            f" ({error_px:.1f} px off)",
            "give the organised cloud in the frame of the camera that took it.",
        )
    return np.concatenate([middle, half, coefficients.T.ravel()])


def clean(cloud: Cloud, normals: Points) -> tuple[Mask, dict[str, int]]:
    """Select the pixels of a cloud on a surface, (h, w) bool, and count the excluded ones: at
    ``edges`` (border and depth jumps), ``grazing`` or without a normal, in small ``groups``, and in
    ``far`` clusters.

    ``normals``: (h, w, 3), towards the camera, NaN where unknown.
    """
    mask = cloud.mask
    inside = mask & ~detect_jumps(cloud.points, cloud.sigma_z)
    # the area of a pixel at the border is covered in part only, half in shadow, or mixed with the
    # background
    inside &= cv2.erode(close_pinholes(inside), np.ones((3, 3), np.uint8), borderValue=1) > 0
    # False for NaN
    facing = inside & (np.abs(viewing_cosines(cloud.points, normals)) > MIN_VIEWING_COSINE)
    grouped = _select_large_groups(facing)
    surface = grouped & ~detect_far_clusters(cloud.points, grouped)
    counts = [int(np.count_nonzero(each)) for each in (mask, inside, facing, grouped, surface)]
    reasons = "edges", "grazing", "groups", "far"
    return surface, {why: a - b for why, (a, b) in zip(reasons, pairwise(counts), strict=True)}


def viewing_cosines(points: Points, normals: Points) -> Map:
    """(h, w): cosine between normals (h, w, 3) and directions from points (h, w, 3) to the camera
    at the origin."""
    with np.errstate(invalid="ignore", divide="ignore"):
        return -np.einsum("ijk,ijk->ij", points, normals) / lengths(points)


def close_pinholes(mask: np.ndarray) -> np.ndarray:
    """Close gaps of up to four pixels in a mask (h, w) bool; returns (h, w) uint8, 0 or 1."""
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (5, 5))
    return cv2.morphologyEx(np.pad(mask, 2).astype(np.uint8), cv2.MORPH_CLOSE, disc)[2:-2, 2:-2]


def detect_jumps(points: Points, sigma_z: Map) -> Mask:
    """Detect the pixels (h, w) bool of organised points (h, w, 3) mm on either side of a depth
    jump.

    A jump exceeds ``STEEPEST`` times the neighbours' distance across the viewing direction plus six
    times their noise ``sigma_z`` (h, w) mm, where that is known.
    """
    noise = 6 * np.nan_to_num(sigma_z, posinf=0.0, neginf=0.0)
    jumps = np.zeros(points.shape[:2], bool)
    if not np.isfinite(points[..., 2]).any():
        return jumps
    for here, there in ((np.s_[:-1], np.s_[1:]), (np.s_[:, :-1], np.s_[:, 1:])):
        step = np.abs(points[there] - points[here])
        across = np.hypot(step[..., 0], step[..., 1])
        # on an oblique ray a depth jump moves the point across as well: limit that distance
        across = across.clip(max=2 * np.nanmedian(across))
        is_jump = step[..., 2] > STEEPEST * across + np.maximum(noise[here], noise[there])
        jumps[here] |= is_jump
        jumps[there] |= is_jump
    return jumps


def detect_far_clusters(points: Points, mask: Mask) -> Mask:
    """(h, w) bool: of the points (h, w, 3) mm in a ``mask`` (h, w), those in small clusters far
    from all others."""
    far = np.zeros(mask.shape, bool)
    chosen = choose_pixels(points, mask).astype(np.float64)
    if len(chosen) < 2:
        return far
    spacing = median_spacing(cKDTree(chosen, balanced_tree=False, compact_nodes=False), 5000)
    if not spacing > 0:
        return far
    cubes, which = occupied_cubes(chosen, FAR_SPACINGS * spacing)
    pairs = cKDTree(cubes).query_pairs(1.8, output_type="ndarray")  # all 26 neighbours
    cluster = label_connected(pairs, len(cubes))[which]
    far[mask] = (np.bincount(cluster) < FAR_SHARE * len(chosen))[cluster]
    return far


def _select_large_groups(mask: Mask) -> Mask:
    """Select the connected groups of a mask (h, w) bool with at least 20 pixels and a share of
    LEAST_GROUP."""
    least = max(20.0, LEAST_GROUP * np.count_nonzero(mask))
    _, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=4)
    large = stats[:, cv2.CC_STAT_AREA] >= least
    large[0] = False
    return large[labels]
