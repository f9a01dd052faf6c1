"""One scan as registration takes it: its points, and which of them can be trusted to lie on the
surface."""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import binary_erosion

from slviewer.geometry.vectors import lengths
from slviewer.reconstruction.cloud import Cloud, choose_pixels
from slviewer.reconstruction.reconstruct import normals as grid_normals

_RIM_PX = 2
"""So near to the edge of the measured surface, a pixel may have seen two surfaces at once."""
_STEEPEST = 6.0
"""Rise over the pixels' pitch beyond which neighbours do not belong to one surface, or to one seen
too obliquely."""
_NOISE = 4.0
"""Standard deviations that noise alone may add to a step."""


@dataclass(frozen=True)
class Scan:
    """The valid points of one scan, in its camera's frame.

    ``points`` (n, 3) mm and ``normals`` (n, 3) towards the camera, float32 without NaN in the
    points; a normal is NaN where the grid gives none. ``colours`` (n, 3) uint8 or None;
    ``sigma_mm`` the median expected error of a point. ``trusted`` (n,) bool: the points away from
    edges, which alone decide how the scan lies; None trusts all.
    """

    points: np.ndarray
    normals: np.ndarray | None = None
    colours: np.ndarray | None = None
    sigma_mm: float | None = None
    trusted: np.ndarray | None = None

    @classmethod
    def from_cloud(cls, cloud: Cloud) -> "Scan":
        """Return the measured pixels of an organised cloud, with the normals of its grid."""
        mask = cloud.mask
        sigma = cloud.sigma_z[mask]
        sigma = sigma[np.isfinite(sigma)]
        return cls(
            points=choose_pixels(cloud.points, mask),
            normals=choose_pixels(grid_normals(cloud.points), mask),
            colours=_rgb(cloud.colours()),
            sigma_mm=float(np.median(sigma)) if sigma.size else None,
            trusted=away_from_edges(cloud.points, cloud.sigma_z)[mask],
        )


def away_from_edges(points: np.ndarray, sigma_z: np.ndarray | None = None) -> np.ndarray:
    """Return the pixels (h, w) bool of an organised cloud (h, w, 3) mm that are two pixels or more
    inside the surface.

    Edges are invalid pixels, the image's border, and steps that are steep for the pixels' pitch and
    exceed the noise ``sigma_z`` (h, w) mm of both pixels, where it is known.
    """
    inside = np.isfinite(points[..., 2])
    noise = (
        np.zeros(inside.shape) if sigma_z is None else _NOISE * np.nan_to_num(sigma_z, posinf=0.0)
    )
    for axis in (0, 1):
        before, after = (np.s_[:-1], np.s_[1:]) if axis == 0 else (np.s_[:, :-1], np.s_[:, 1:])
        pitch = lengths((points[after] - points[before])[..., :2])
        known = pitch[np.isfinite(pitch)]
        if not known.size:
            continue
        rise = np.abs(points[after][..., 2] - points[before][..., 2])
        is_step = rise > _STEEPEST * float(np.median(known)) + np.hypot(noise[before], noise[after])
        inside[before] &= ~is_step
        inside[after] &= ~is_step
    return binary_erosion(inside, np.ones((3, 3), bool), _RIM_PX)


def _rgb(colours: np.ndarray | None) -> np.ndarray | None:
    """Return colours (n, 3) from grey values (n,) or colours (n, 3)."""
    return (
        np.repeat(colours[:, None], 3, axis=1)
        if colours is not None and colours.ndim == 1
        else colours
    )
