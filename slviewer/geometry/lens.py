"""A camera or a projector as a pinhole with Brown distortion: from points to pixels and from pixels
to rays."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from slviewer.errors import InputError
from slviewer.geometry.brown import distort_all, fold_radius_squared, project_all, undistort_all
from slviewer.geometry.jit import POINTS, read_only, run_rows

FOCAL_PX = 1.0, 1e7
"""Focal lengths that a lens may have; the principal point is as near to the image as the
longest."""
LARGEST_PX = 100_000
LARGEST_DISTORTION = 1e9
"""Of k3 of a telephoto lens, which multiplies the sixth power of a small angle."""

CACHED_BYTES = 64_000_000
"""Largest size of the rays of an image, of 4 megapixels, that are kept for the next lens that is
equal: a calibration is read again for each scan."""
_LAST_RAYS: list[tuple[tuple[bytes, tuple[int, int]], np.ndarray]] = []


@dataclass(frozen=True, eq=False)
class Lens:
    """Pinhole and Brown distortion of one device (Letter eq. 1-5).

    ``K``: (3, 3), px, without skew. ``D``: (5,), OpenCV's order (k1, k2, p1, p2, k3); four
    coefficients, or more of which the rest are zero, are accepted. ``size``: (width, height) px.
    The arrays are kept as read-only float64 copies.

    Raises InputError for matrices that are not those of a pinhole, and for distortion models other
    than Brown's.
    """

    K: np.ndarray
    D: np.ndarray
    size: tuple[int, int]

    def __post_init__(self) -> None:
        K = np.array(self.K, dtype=np.float64)
        D = np.array(self.D, dtype=np.float64).ravel()
        if K.shape != (3, 3) or not np.isfinite(K).all():
            raise InputError(
                f"A camera matrix must be 3x3 finite numbers, this one is {K.shape}",
                "give K as OpenCV does.",
            )
        form = np.array([[K[0, 0], 0, K[0, 2]], [0, K[1, 1], K[1, 2]], [0, 0, 1]])
        if K[0, 0] <= 0 or K[1, 1] <= 0 or not np.allclose(K, form, rtol=0, atol=1e-9 * K[0, 0]):
            raise InputError(
                "A camera matrix must read [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], this one is"
                f" {K.tolist()}",
                "check the key and calibrate without skew.",
            )
        if D.size in (1, 2, 3) or D[5:].any() or not np.isfinite(D).all():
            raise InputError(
                f"{D.size} distortion coefficients were given, {D.tolist()}, and this lens has five"
                " (k1, k2, p1, p2, k3)",
                "calibrate without the rational, thin-prism and tilted models.",
            )
        D = np.concatenate([D, np.zeros(5)])[:5]
        width, height = map(int, self.size)
        if not (1 <= width <= LARGEST_PX and 1 <= height <= LARGEST_PX):
            raise InputError(
                f"An image of {width}x{height} px was given",
                f"its size is width x height, 1 to {LARGEST_PX} px each.",
            )
        low, high = FOCAL_PX
        if not (low <= K[0, 0] <= high and low <= K[1, 1] <= high) or np.abs(K[:2, 2]).max() > high:
            raise InputError(
                f"The focal lengths {K[0, 0]:.6g} and {K[1, 1]:.6g} px and the principal point"
                f" ({K[0, 2]:.6g}, {K[1, 2]:.6g}) px belong to no lens (focal lengths are {low:g}"
                f" to {high:g} px)",
                "give K in pixels.",
            )
        if np.abs(D).max() > LARGEST_DISTORTION:
            raise InputError(
                f"The distortion coefficients {D.tolist()} belong to no lens",
                "check them, or calibrate again.",
            )
        vars(self).update(K=read_only(K), D=read_only(D), size=(width, height))

    @classmethod
    def from_parameters(cls, parameters: Iterable[float], size: tuple[int, int]) -> "Lens":
        """Return the lens of fx, fy, cx, cy in px, and distortion coefficients in OpenCV's order,
        if any."""
        fx, fy, cx, cy, *D = parameters
        return cls(np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]]), np.array(D), size)

    @cached_property
    def parameters(self) -> np.ndarray:
        """(10,) float64: the parameters of the compiled kernels (see ``geometry.brown``)."""
        K = self.K
        return np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2], *self.D, fold_radius_squared(self.D)])

    def project(self, points: np.ndarray) -> np.ndarray:
        """Points (..., 3) mm in this device's frame to pixels (..., 2) (eq. 1-3).

        NaN for NaN points, behind the device, and past the radius where the distortion polynomial
        folds over.
        """
        return self._map(project_all, points, 3)

    def distort(self, normalised: np.ndarray) -> np.ndarray:
        """Undistorted normalised coordinates (..., 2) to pixels (..., 2) (eq. 3); NaN past the
        fold."""
        return self._map(distort_all, normalised, 2)

    def undistort(self, pixels: np.ndarray) -> np.ndarray:
        """Pixels (..., 2) to undistorted normalised coordinates (..., 2) (eq. 4, 5), exact to 1e-9.

        NaN for NaN pixels, and where no ray within the fold of the distortion polynomial meets the
        pixel.
        """
        return self._map(undistort_all, pixels, 2)

    def _map(self, fill: Callable[..., None], values: np.ndarray, last: int) -> np.ndarray:
        """Map values (..., last) to (..., 2) float64 by a compiled function of ``geometry.brown``;
        InputError where the last dimension differs."""
        values = np.ascontiguousarray(values, dtype=np.float64)
        if values.shape[-1:] != (last,):
            raise InputError(
                f"An array of shape {values.shape} was given", f"the last dimension must be {last}."
            )
        flat, mapped = values.reshape(-1, last), np.empty((*values.shape[:-1], 2))
        run_rows(fill, len(flat), flat, self.parameters, mapped.reshape(-1, 2), multiple=POINTS)
        return mapped

    def contains(self, pixels: np.ndarray, margin_px: float = 0.0) -> np.ndarray:
        """(...,) bool: pixels (..., 2) inside the image less a margin; False for NaN."""
        inside = (pixels > margin_px - 0.5) & (pixels < np.array(self.size) - 0.5 - margin_px)
        return np.asarray(inside.all(axis=-1))

    def rays(self) -> np.ndarray:
        """(h, w, 2) float64: undistorted normalised coordinates of every pixel; computed once,
        read-only."""
        return self._rays

    @cached_property
    def _rays(self) -> np.ndarray:
        """(h, w, 2) float64: undistorted normalised coordinates of every pixel, read-only."""
        key = self.parameters.tobytes(), self.size
        for parameters, rays in _LAST_RAYS:
            if parameters == key:
                return rays
        width, height = self.size
        v, u = np.mgrid[:height, :width]
        rays = read_only(self.undistort(np.stack([u, v], axis=-1)))
        if rays.nbytes <= CACHED_BYTES:
            _LAST_RAYS[:] = [(key, rays)]
        return rays

    def resize(self, factor: float) -> "Lens":
        """Return the same lens at another resolution: pixel centres stay at whole numbers, so c' =
        (c + 0.5) factor - 0.5."""
        K = self.K.copy()
        K[:2, :2] *= factor
        K[:2, 2] = (K[:2, 2] + 0.5) * factor - 0.5
        width, height = self.size
        return Lens(K, self.D, (round(width * factor), round(height * factor)))
