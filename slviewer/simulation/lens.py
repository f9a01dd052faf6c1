"""The simulated lens: pinhole, Brown distortion, and a local distortion that Brown cannot express.

Written apart from the calibration's lens on purpose: an error in one must show against the other.
"""

import math
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from slviewer.errors import InputError
from slviewer.geometry.jit import POINTS, kernel, run_rows
from slviewer.simulation.waves import Waves


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
            width, height = self.size
            u, v = np.meshgrid(
                *(np.arange(-margin, n + margin, dtype=float) for n in (width, height))
            )
            self._ray_grids[margin] = self.undistort(np.stack([u, v], -1))
        return self._ray_grids[margin]

    @cached_property
    def _ray_grids(self) -> dict[int, np.ndarray]:
        """Cache of ray grids by margin in px, empty at first."""
        return {}

    def _map_points(self, function: Any, values: np.ndarray) -> np.ndarray:
        """Values (..., 2) mapped by a compiled kernel with this lens's parameters."""
        numbers = np.array([*self.focal_px, *self.centre_px, *self.brown, self.scale])
        flat = np.ascontiguousarray(values.reshape(-1, 2))
        mapped = np.empty_like(flat)
        run_rows(function, len(flat), flat, numbers, self.waves, mapped, multiple=POINTS)
        return mapped.reshape(values.shape)


def _check_shape(values: np.ndarray, last: int) -> np.ndarray:
    """The values as a float array; raises InputError unless the last axis has the length
    ``last``."""
    values = np.asarray(values, float)
    if values.ndim < 1 or values.shape[-1] != last:
        raise InputError(f"expected an array (..., {last}), got the shape {values.shape}")
    return values


@kernel()
def _project_point(x, y, numbers, waves):
    """Pixel (u, v) at the lens's scale, and its derivatives by x and y (4 numbers), for one
    normalised point."""
    fx, fy, cx, cy, k1, k2, p1, p2, k3, scale = numbers
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    # d radial / d r2, twice: times x or y it is d radial / dx or dy
    slope = 2 * (k1 + r2 * (2 * k2 + r2 * 3 * k3))
    u = cx + fx * (x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x))
    v = cy + fy * (y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y)
    ux = fx * (radial + x * x * slope + 2 * p1 * y + 6 * p2 * x)
    uy = fx * (x * y * slope + 2 * p1 * x + 2 * p2 * y)
    vx = fy * (x * y * slope + 2 * p1 * x + 2 * p2 * y)
    vy = fy * (radial + y * y * slope + 6 * p1 * y + 2 * p2 * x)
    wu, wv, wuu, wuv, wvu, wvv = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(waves.shape[0]):
        angle = waves[i, 0] * u + waves[i, 1] * v
        sine, cosine = math.sin(angle), math.cos(angle)
        wu += waves[i, 2] * sine + waves[i, 3] * cosine
        wv += waves[i, 4] * sine + waves[i, 5] * cosine
        au = waves[i, 2] * cosine - waves[i, 3] * sine
        av = waves[i, 4] * cosine - waves[i, 5] * sine
        wuu += au * waves[i, 0]
        wuv += au * waves[i, 1]
        wvu += av * waves[i, 0]
        wvv += av * waves[i, 1]
    return (
        (u + wu + 0.5) * scale - 0.5,
        (v + wv + 0.5) * scale - 0.5,
        scale * (ux * (1 + wuu) + vx * wuv),
        scale * (uy * (1 + wuu) + vy * wuv),
        scale * (ux * wvu + vx * (1 + wvv)),
        scale * (uy * wvu + vy * (1 + wvv)),
    )


@kernel()
def _project_kernel(first, last, normalised, numbers, waves, out):
    """Fill ``out`` (n, 2) with the pixels at the lens's scale of normalised points (n, 2)."""
    for i in range(first, last):
        u, v, _, _, _, _ = _project_point(normalised[i, 0], normalised[i, 1], numbers, waves)
        out[i, 0], out[i, 1] = u, v


@kernel()
def _undistort_kernel(first, last, pixels, numbers, waves, out):
    """Fill ``out`` (n, 2) with the normalised points of pixels (n, 2) by Newton's method; NaN where
    it does not converge."""
    fx, fy, cx, cy, scale = numbers[0], numbers[1], numbers[2], numbers[3], numbers[9]
    for i in range(first, last):
        x = ((pixels[i, 0] + 0.5) / scale - 0.5 - cx) / fx
        y = ((pixels[i, 1] + 0.5) / scale - 0.5 - cy) / fy
        error = np.inf
        for _ in range(20):
            u, v, ux, uy, vx, vy = _project_point(x, y, numbers, waves)
            du, dv = pixels[i, 0] - u, pixels[i, 1] - v
            determinant = ux * vy - uy * vx
            x += (vy * du - uy * dv) / determinant
            y += (ux * dv - vx * du) / determinant
            error = abs(du) + abs(dv)
            # the step just taken squares this: 1e-12 px and better; also leaves on NaN
            if not error > 1e-6:
                break
        if error <= 1e-6:
            out[i, 0], out[i, 1] = x, y
        else:
            out[i, 0], out[i, 1] = np.nan, np.nan
