"""The simulated lens: pinhole, Brown distortion, and a local distortion that Brown cannot express.

The local distortion is a sum of plane waves in random directions, each coordinate with amplitudes
of its own. Real lenses and DMD optics leave such residuals of a tenth of a pixel or two after the
best polynomial; they are what the pixel-wise model is there to learn.

Written apart from the calibration's lens on purpose: an error in one must show against the other.
"""

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numba
import numpy as np

from slviewer.errors import InputError
from slviewer.geometry.jit import kernel
from slviewer.geometry.vectors import rms

Waves = np.ndarray
"""(n, 6) float64: wave vector (rad per px, u then v), amplitudes (px) of sine and cosine in u, then
of both in v."""


@dataclass(frozen=True, eq=False)
class SimulatedLens:
    """A lens described at full resolution and used at `scale`.

    Pixel p = Brown(pinhole) in px of the full resolution, then p + W(p) with the waves W, then (p +
    0.5) scale - 0.5: pixel centres at whole numbers, and the image's outer edges stay where they
    are.

    full_size: (width, height); focal_px, centre_px: (x, y) at full resolution; brown: k1, k2, p1,
    p2, k3.
    """

    full_size: tuple[int, int]
    focal_px: tuple[float, float]
    centre_px: tuple[float, float]
    brown: tuple[float, float, float, float, float]
    waves: Waves = field(default_factory=lambda: np.zeros((0, 6)), repr=False)
    scale: float = 1.0

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) px at `scale`."""
        return round(self.full_size[0] * self.scale), round(self.full_size[1] * self.scale)

    def project(self, points: np.ndarray) -> np.ndarray:
        """Pixels (..., 2) of `points` (..., 3) mm in this device's frame; NaN where z <= 0 or a
        coordinate is NaN."""
        points = _check_shape(points, 3)
        with np.errstate(invalid="ignore", divide="ignore"):
            z = np.where(points[..., 2:] > 0, points[..., 2:], np.nan)
            return self._map_points(_project_kernel, points[..., :2] / z)

    def undistort(self, pixels: np.ndarray) -> np.ndarray:
        """Normalised (..., 2) = (x/z, y/z) that project to `pixels` (..., 2), by Newton; NaN if it
        fails."""
        return self._map_points(_undistort_kernel, _check_shape(pixels, 2))

    def rays(self, margin: int = 0) -> np.ndarray:
        """(h + 2 margin, w + 2 margin, 2) float64: (x/z, y/z) of every pixel, and of so many beyond
        each edge."""
        if margin not in self._ray_grids:
            u, v = np.meshgrid(
                *(np.arange(-margin, extent + margin, dtype=float) for extent in self.size)
            )
            self._ray_grids[margin] = self.undistort(np.stack([u, v], -1))
        return self._ray_grids[margin]

    @cached_property
    def _ray_grids(self) -> dict[int, np.ndarray]:
        """Cache of ray grids by margin in px, empty at first."""
        return {}

    def _map_points(self, function: Any, values: np.ndarray) -> np.ndarray:
        """Values (..., 2) mapped by a compiled kernel with this lens's parameters."""
        pinhole = np.array([*self.focal_px, *self.centre_px, self.scale])
        flat = np.ascontiguousarray(values.reshape(-1, 2))
        return function(flat, pinhole, np.array(self.brown), self.waves).reshape(values.shape)


def _check_shape(values: np.ndarray, last: int) -> np.ndarray:
    """The values as a float array; raises InputError unless the last axis has the length
    ``last``."""
    values = np.asarray(values, float)
    if values.ndim < 1 or values.shape[-1] != last:
        raise InputError(f"expected an array (..., {last}), got the shape {values.shape}")
    return values


def displace(u: np.ndarray, v: np.ndarray, waves: Waves) -> tuple[np.ndarray, np.ndarray]:
    """Displacement in u and v, px, by the waves at places u and v, px."""
    du, dv = 0.0 * u, 0.0 * v
    for i in range(waves.shape[0]):
        angle = waves[i, 0] * u + waves[i, 1] * v
        sine, cosine = np.sin(angle), np.cos(angle)
        du += waves[i, 2] * sine + waves[i, 3] * cosine
        dv += waves[i, 4] * sine + waves[i, 5] * cosine
    return du, dv


_displace_point = kernel()(displace)


@kernel()
def _distort(x, y, brown):
    """Brown's distortion of one normalised point, and its derivatives: of x by x, of x by y, which
    is that of y by x, and of y by y."""
    k1, k2, p1, p2, k3 = brown
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    # d radial / d r2, twice: times x or y it is d radial / dx or dy
    slope = 2 * (k1 + r2 * (2 * k2 + r2 * 3 * k3))
    return (
        x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
        y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
        radial + x * x * slope + 2 * p1 * y + 6 * p2 * x,
        x * y * slope + 2 * p1 * x + 2 * p2 * y,
        radial + y * y * slope + 6 * p1 * y + 2 * p2 * x,
    )


@kernel(parallel=True)
def _project_kernel(normalised, pinhole, brown, waves):
    """Pixels (n, 2) at the lens's scale of normalised points (n, 2)."""
    out = np.empty_like(normalised)
    fx, fy, cx, cy, scale = pinhole
    for i in numba.prange(normalised.shape[0]):
        x, y, _, _, _ = _distort(normalised[i, 0], normalised[i, 1], brown)
        u, v = cx + fx * x, cy + fy * y
        du, dv = _displace_point(u, v, waves)
        out[i, 0], out[i, 1] = (u + du + 0.5) * scale - 0.5, (v + dv + 0.5) * scale - 0.5
    return out


@kernel(parallel=True)
def _undistort_kernel(pixels, pinhole, brown, waves):
    """Normalised points (n, 2) of pixels (n, 2): without the waves, which are gentle, by a fixed
    point, then by Newton's method; NaN where it does not converge."""
    out = np.empty_like(pixels)
    fx, fy, cx, cy, scale = pinhole
    for i in numba.prange(pixels.shape[0]):
        from_u, from_v = (pixels[i, 0] + 0.5) / scale - 0.5, (pixels[i, 1] + 0.5) / scale - 0.5
        u, v = from_u, from_v
        for _ in range(30):
            du, dv = _displace_point(u, v, waves)
            left = abs(from_u - du - u) + abs(from_v - dv - v)
            u, v = from_u - du, from_v - dv
            if not left > 1e-8:
                break
        from_x, from_y = (u - cx) / fx, (v - cy) / fy
        x, y = from_x, from_y
        error = np.inf
        for _ in range(20):
            X, Y, xx, xy, yy = _distort(x, y, brown)
            dx, dy = from_x - X, from_y - Y
            determinant = xx * yy - xy * xy
            x += (yy * dx - xy * dy) / determinant
            y += (xx * dy - xy * dx) / determinant
            error = abs(dx) + abs(dy)
            # the step just taken squares this; also leaves on NaN
            if not error > 1e-9:
                break
        if not (error <= 1e-9 and left <= 1e-6):
            x, y = np.nan, np.nan
        out[i, 0], out[i, 1] = x, y
    return out


def random_waves(
    rng: np.random.Generator,
    size: tuple[int, int],
    aspect: float,
    count: int,
    wavelengths: tuple[float, float],
    rms_px: float,
) -> Waves:
    """Waves whose displacement has exactly `rms_px` in each coordinate over an image of `size`
    (width, height) px.

    `wavelengths` is their range as shares of the width; `aspect` = fy / fx keeps them isotropic in
    space where pixels are not square. Returns an empty (0, 6) array if `rms_px` is 0, so that the
    lens is exactly pinhole and Brown.
    """
    # Drawn even when switched off, so that the rig's other random parameters stay the same.
    direction = rng.uniform(0, 2 * np.pi, count)
    length = size[0] * np.exp(rng.uniform(np.log(wavelengths[0]), np.log(wavelengths[1]), count))
    amplitudes = rng.normal(size=(count, 4))
    if rms_px == 0:
        return np.zeros((0, 6))
    k = 2 * np.pi / length
    waves = np.column_stack([k * np.cos(direction), k * np.sin(direction) / aspect, amplitudes])
    u, v = np.meshgrid(*(np.linspace(0, extent - 1, 81) for extent in size))
    waves[:, 2:] *= np.repeat([rms_px / rms(each) for each in displace(u, v, waves)], 2)
    return waves
