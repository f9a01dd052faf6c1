"""A scan as fusing needs it: cleaned, with its errors along the normals, and a way from a place to its pixel."""

from dataclasses import dataclass, replace

import cv2
import numpy as np

from slviewer.errors import InputError
from slviewer.geometry.polynomial import monomials
from slviewer.reconstruction.cloud import Cloud
from slviewer.reconstruction.reconstruct import normals as grid_normals
from slviewer.surface.clean import ExcludedPixels, clean, close_pinholes, sight_cosines

LEAST_POINTS = 200
FEATHER = 0.02
"""Share of the image's diagonal over which a scan's weight rises from its border inwards."""
_DEGREE = 5
_OFF_PX = 0.75
_LEAST_WEIGHT = 1e-3


@dataclass(frozen=True, eq=False)
class View:
    """One scan's surface, cut to the pixels that hold it.

    ``T`` (4, 4) float64 is T_reference_scan. Of each pixel, (h, w, …) float32 in the camera's frame: ``points`` mm (NaN
    where nothing is), ``normals`` of unit length towards the camera, ``noise`` and ``lasting`` (h, w) mm, the standard
    deviations along the normal of this scan alone and of what its calibration does to every scan; ``inner`` 0 to 1,
    rising from the scan's border inwards; ``quality``, how much the scan knows per area, smooth; ``colours``
    (h, w, 3) uint8 or None. ``to_pixel`` maps lines of sight to pixels (see ``_fit_pixels``); ``spacing`` is the median
    distance of neighbours in mm.
    """

    T: np.ndarray
    points: np.ndarray
    normals: np.ndarray
    noise: np.ndarray
    lasting: np.ndarray
    inner: np.ndarray
    quality: np.ndarray
    colours: np.ndarray | None
    to_pixel: np.ndarray
    spacing: float
    cleaned: ExcludedPixels

    @property
    def mask(self) -> np.ndarray:
        """(h, w) bool: where there is a point."""
        return np.isfinite(self.points[..., 2])

    def without(self, pixels: np.ndarray) -> "View":
        """The view with the points at (h, w) bool left out."""
        return replace(self, points=np.where(pixels[..., None], np.float32(np.nan), self.points))


def prepare_view(name: str, cloud: Cloud, T_reference_scan: np.ndarray) -> View:
    """Prepare a scan. Raises InputError, naming it, where too little of it is a surface seen from one place."""
    T = np.asarray(T_reference_scan, dtype=np.float64)
    if T.shape != (4, 4) or not np.isfinite(T).all():
        raise InputError(f"{name}: its pose has shape {T.shape}: fusing needs a finite (4, 4) T_reference_scan.")
    normals = grid_normals(cloud.points)
    kept, cleaned = clean(cloud, normals)
    if np.count_nonzero(kept) < LEAST_POINTS:
        raise InputError(
            f"{name}: only {np.count_nonzero(kept)} of its pixels lie on a surface: "
            "reconstruct it again, or leave it out."
        )
    crop = _box(kept)
    kept, normals = kept[crop], normals[crop]
    points = np.where(kept[..., None], cloud.points[crop], np.float32(np.nan))
    cosine = sight_cosines(points, normals)
    noise = _known_noise(cloud.sigma_z[crop], points, cosine, kept)
    lasting = np.zeros_like(noise) if cloud.sigma_lasting is None else cloud.sigma_lasting[crop]
    # depth's error along the normal: moved by dz, a point moves by dz along its ray (x/z, y/z, 1)
    along = cosine * np.linalg.norm(points, axis=-1) / points[..., 2]
    noise, lasting = noise * along, np.nan_to_num(lasting) * along
    inner = _inwards(kept)
    area = _pixel_area(points, cosine)
    quality = np.where(kept, inner / ((noise**2 + lasting**2) * area), 0.0)
    return View(
        T=T,
        points=points,
        normals=normals,
        noise=noise.astype(np.float32),
        lasting=lasting.astype(np.float32),
        inner=inner,
        quality=_smooth(quality, kept),
        colours=_rgb(cloud.texture, crop),
        to_pixel=_fit_pixels(name, points, kept),
        spacing=float(np.sqrt(np.nanmedian(area))),
        cleaned=cleaned,
    )


def _known_noise(sigma_z: np.ndarray, points: np.ndarray, cosine: np.ndarray, kept: np.ndarray) -> np.ndarray:
    """The noise of depth; where it is not known, from the scan's roughness, larger far away and at grazing sight."""
    known = kept & np.isfinite(sigma_z) & (sigma_z > 0)
    if known.sum() == kept.sum():
        return sigma_z
    z = points[..., 2].astype(np.float64)
    shape = z**2 / np.maximum(cosine, 0.05)
    if known.sum() > 0.5 * kept.sum():
        scale = float(np.median(sigma_z[known] / shape[known]))
    else:
        bend = z[1:-1, 1:-1] - 0.25 * (z[:-2, 1:-1] + z[2:, 1:-1] + z[1:-1, :-2] + z[1:-1, 2:])
        ratio = np.abs(bend / shape[1:-1, 1:-1])
        # of five equal, independent errors the difference has the standard deviation sqrt(1.25)
        scale = 1.4826 / np.sqrt(1.25) * float(np.nanmedian(ratio))
    scale = max(scale, 1e-7 / float(np.nanmedian(z)))  # a perfect plane has none, and a weight needs one
    return np.where(known, sigma_z, scale * shape)


def _box(mask: np.ndarray) -> tuple[slice, slice]:
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    return slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)


def _inwards(kept: np.ndarray) -> np.ndarray:
    """(h, w) float32: 0 outside, rising smoothly to 1; pinholes are no border."""
    distance = cv2.distanceTransform(np.pad(close_pinholes(kept), 1), cv2.DIST_L2, 5)[1:-1, 1:-1]
    width = max(4.0, FEATHER * float(np.hypot(*kept.shape)))
    share = np.clip((distance - 0.5) / width, 0, 1)
    return np.where(kept, np.maximum(share * share * (3 - 2 * share), _LEAST_WEIGHT), 0).astype(np.float32)


def _pixel_area(points: np.ndarray, cosine: np.ndarray) -> np.ndarray:
    """(h, w) mm2 of surface that a pixel covers."""
    z = points[..., 2]
    x, y = points[..., 0] / z, points[..., 1] / z
    pitch = float(np.nanmedian(np.abs(np.diff(x, axis=1)))) * float(np.nanmedian(np.abs(np.diff(y, axis=0))))
    return np.asarray(pitch * z**2 / np.maximum(cosine, 0.05))


def _smooth(quality: np.ndarray, kept: np.ndarray) -> np.ndarray:
    """Its mean over a window: who is best at a place shall not change from pixel to pixel."""
    size = (9, 9)
    total = cv2.blur(quality.astype(np.float64), size)
    share = cv2.blur(kept.astype(np.float64), size)
    return np.where(kept, total / np.maximum(share, 1e-9), 0).astype(np.float32)


def _rgb(texture: np.ndarray | None, crop: tuple[slice, slice]) -> np.ndarray | None:
    if texture is None:
        return None
    cut = texture[crop]
    return np.ascontiguousarray(np.repeat(cut[..., None], 3, axis=2) if cut.ndim == 2 else cut)


def _fit_pixels(name: str, points: np.ndarray, kept: np.ndarray) -> np.ndarray:
    """(2 + 2 + 42,) float64: middle and half width of the lines of sight (x/z, y/z), then the coefficients of a
    polynomial of degree 5 in the normalised ones for the column and for the row, in the order of ``monomials``.

    Good to a fraction of a pixel whatever the lens: what is found there is then taken for where it lies, not for where
    it was expected.
    """
    v, u = np.nonzero(kept)
    every = slice(None, None, max(1, len(u) // 20_000))
    u, v = u[every], v[every]
    p = points[v, u].astype(np.float64)
    rays = p[:, :2] / p[:, 2:]
    low, high = rays.min(axis=0), rays.max(axis=0)
    middle, half = (low + high) / 2, np.maximum((high - low) / 2, 1e-9)
    A = monomials((rays - middle) / half, _DEGREE)
    pixels = np.stack([u, v], axis=1).astype(np.float64)
    coefficients, *_ = np.linalg.lstsq(A, pixels, rcond=1e-10)
    off = float(np.sqrt(np.mean((A @ coefficients - pixels) ** 2)))
    if off > _OFF_PX:
        raise InputError(
            f"{name}: its points do not lie on the lines of sight of one camera at the origin ({off:.1f} px off): "
            "give the organised cloud in the frame of the camera that took it."
        )
    return np.concatenate([middle, half, coefficients.T.ravel()])
