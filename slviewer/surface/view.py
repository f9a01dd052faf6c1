"""Preparation of a scan for fusion: cleaning, standard deviations along the normals, weights, and a
pixel map."""

from dataclasses import dataclass, replace

import cv2
import numpy as np

from slviewer.errors import InputError
from slviewer.geometry.polynomial import monomials
from slviewer.geometry.rigid import move_points
from slviewer.reconstruction.cloud import Cloud
from slviewer.reconstruction.reconstruct import normals as grid_normals
from slviewer.surface.clean import ExcludedPixels, clean, close_pinholes, viewing_cosines
from slviewer.surface.overlap_kernels import SurfaceGrid

LEAST_POINTS = 200
FEATHER = 0.02
"""Share of the image's diagonal over which a scan's weight rises from its border inwards."""
_DEGREE = 5  # of the polynomial from rays to pixels
_MAX_RMS_PX = 0.75  # of that polynomial, for points of one camera
_LEAST_WEIGHT = 1e-3


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
    points: np.ndarray
    normals: np.ndarray
    noise: np.ndarray
    systematic: np.ndarray
    inner: np.ndarray
    quality: np.ndarray
    colours: np.ndarray | None
    to_pixel: np.ndarray
    spacing: float
    cleaned: ExcludedPixels

    @property
    def mask(self) -> np.ndarray:
        """(h, w) bool: pixels with a point."""
        return np.isfinite(self.points[..., 2])

    @property
    def grid(self) -> SurfaceGrid:
        """What the kernels need to interpolate the surface."""
        return SurfaceGrid(
            self.points,
            self.normals,
            self.noise,
            self.systematic,
            self.inner,
            self.quality,
            self.to_pixel,
        )

    def move_into(
        self, other: "View", points: np.ndarray, normals: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return points and normals (n, 3) of this view's frame in the frame of another one,
        contiguous."""
        T = np.linalg.inv(other.T) @ self.T
        return np.ascontiguousarray(move_points(T, points)), np.ascontiguousarray(
            normals @ T[:3, :3].T
        )

    def without(self, pixels: np.ndarray) -> "View":
        """Return the view without the points at ``pixels`` (h, w) bool."""
        return replace(self, points=np.where(pixels[..., None], np.float32(np.nan), self.points))


def prepare_view(name: str, cloud: Cloud, T_reference_scan: np.ndarray) -> View:
    """Prepare a scan with its pose (4, 4) for fusion.

    Raises InputError with the scan's ``name`` for an invalid pose, for too few pixels on a surface,
    and for points that were not measured by one camera at the origin.
    """
    T = np.asarray(T_reference_scan, dtype=np.float64)
    if T.shape != (4, 4) or not np.isfinite(T).all():
        raise InputError(
            f"{name}: its pose has shape {T.shape}: fusing needs a finite (4, 4) T_reference_scan."
        )
    normals = grid_normals(cloud.points)
    surface, cleaned = clean(cloud, normals)
    if np.count_nonzero(surface) < LEAST_POINTS:
        raise InputError(
            f"{name}: only {np.count_nonzero(surface)} of its pixels lie on a surface: "
            "reconstruct it again, or exclude it."
        )
    crop = _bounding_box(surface)
    surface, normals = surface[crop], normals[crop]
    points = np.where(surface[..., None], cloud.points[crop], np.float32(np.nan))
    cosine = viewing_cosines(points, normals)
    noise = _fill_noise(cloud.sigma_z[crop], points, cosine, surface)
    systematic = (
        np.zeros_like(noise) if cloud.sigma_systematic is None else cloud.sigma_systematic[crop]
    )
    # an error dz of depth moves the point by dz (x/z, y/z, 1) along its ray; its component along
    # the normal
    along = cosine * np.linalg.norm(points, axis=-1) / points[..., 2]
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
        colours=_crop_colours(cloud.texture, crop),
        to_pixel=_fit_pixel_map(name, points, surface),
        spacing=float(np.sqrt(np.nanmedian(area))),
        cleaned=cleaned,
    )


def _fill_noise(
    sigma_z: np.ndarray, points: np.ndarray, cosine: np.ndarray, surface: np.ndarray
) -> np.ndarray:
    """Return the depth noise (h, w) mm with unknown values filled in, in proportion to z^2 /
    cosine.

    The factor is fitted to the known values where these are the majority, else to the roughness of
    the surface.
    """
    known = surface & np.isfinite(sigma_z) & (sigma_z > 0)
    if known.sum() == surface.sum():
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


def _bounding_box(mask: np.ndarray) -> tuple[slice, slice]:
    """Return the rows and columns of the smallest rectangle around a mask (h, w) that is not
    empty."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    return slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)


def _border_weights(surface: np.ndarray) -> np.ndarray:
    """(h, w) float32: weights that rise smoothly from 0 at the border of a mask (h, w) to 1;
    pinholes are closed."""
    distance = cv2.distanceTransform(np.pad(close_pinholes(surface), 1), cv2.DIST_L2, 5)[1:-1, 1:-1]
    width = max(4.0, FEATHER * float(np.hypot(*surface.shape)))
    share = np.clip((distance - 0.5) / width, 0, 1)
    return np.where(surface, np.maximum(share * share * (3 - 2 * share), _LEAST_WEIGHT), 0).astype(
        np.float32
    )


def _pixel_areas(points: np.ndarray, cosine: np.ndarray) -> np.ndarray:
    """(h, w) mm2: the area of surface that each pixel covers."""
    z = points[..., 2]
    x, y = points[..., 0] / z, points[..., 1] / z
    pitch = float(np.nanmedian(np.abs(np.diff(x, axis=1)))) * float(
        np.nanmedian(np.abs(np.diff(y, axis=0)))
    )
    return np.asarray(pitch * z**2 / np.maximum(cosine, 0.05))


def _smooth(quality: np.ndarray, surface: np.ndarray) -> np.ndarray:
    """Average the quality (h, w) over 9 by 9 pixels of the surface, so that the best scan does not
    change by pixel."""
    size = (9, 9)
    total = cv2.blur(quality.astype(np.float64), size)
    share = cv2.blur(surface.astype(np.float64), size)
    return np.where(surface, total / np.maximum(share, 1e-9), 0).astype(np.float32)


def _crop_colours(texture: np.ndarray | None, crop: tuple[slice, slice]) -> np.ndarray | None:
    """Return the cropped texture as RGB (h, w, 3), from grey (H, W) or RGB; None without one."""
    if texture is None:
        return None
    cropped = texture[crop]
    return np.ascontiguousarray(
        np.repeat(cropped[..., None], 3, axis=2) if cropped.ndim == 2 else cropped
    )


def _fit_pixel_map(name: str, points: np.ndarray, surface: np.ndarray) -> np.ndarray:
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
    rms = float(np.sqrt(np.mean((A @ coefficients - pixels) ** 2)))
    if rms > _MAX_RMS_PX:
        raise InputError(
            f"{name}: its points do not lie on the lines of sight of one camera at the origin"
            f" ({rms:.1f} px off): give the organised cloud in the frame of the camera that"
            " took it."
        )
    return np.concatenate([middle, half, coefficients.T.ravel()])
