"""One camera frame: light on the surface, through the camera's lens, with noise, to 8 or 16
bits."""

import numpy as np
from scipy.special import ive, ndtri

from slviewer.geometry.jit import kernel
from slviewer.simulation.light import OVERSAMPLING

# rows per task: small enough for the cache, large enough that the PSF's overlap costs little
ROWS = 24

NORMAL_QUANTILES = ndtri((np.arange(65536) + 0.5) / 65536).astype(np.float32)
"""A standard normal deviate for each 16 random bits."""


def psf_taps(sigma_px: float) -> np.ndarray:
    """(2 r + 1,) float32: the discrete Gaussian, whose variance is sigma^2 at any sampling, also
    for small sigma."""
    radius = 0 if sigma_px == 0 else max(2, int(np.ceil(3 * sigma_px)))
    taps = ive(np.abs(np.arange(-radius, radius + 1)), sigma_px**2)
    return (taps / taps.sum()).astype(np.float32)


@kernel()
def _hash_bits(x):
    """Hash 32 bits to 32 bits (Wellons' lowbias32)."""
    x ^= x >> np.uint32(16)
    x = np.uint32(x * np.uint32(0x7FEB352D))
    x ^= x >> np.uint32(15)
    x = np.uint32(x * np.uint32(0x846CA68B))
    x ^= x >> np.uint32(16)
    return x


@kernel(fastmath=True)
def image_light(first_row, last_row, coordinate, level, gain, table, offset, taps, stray, out):
    """Write the light of one frame into `out` (h, w) float32 grey levels above dark.

    Light gain * table(level, coordinate) is blurred by `taps` (2 r + 1) in both directions;
    coordinate, level and gain (h + 2 r, w + 2 r) reach r pixels beyond the frame. `stray` (h, w),
    blurred before, is added.
    """
    w = out.shape[1]
    radius = taps.size // 2
    last = np.float32(table.shape[1] - 1.001)
    start, scale = np.float32(offset), np.float32(OVERSAMPLING)
    for first in range(first_row, last_row, ROWS):
        end = min(first + ROWS, last_row)
        blurred = np.zeros((ROWS + 2 * radius, w), np.float32)
        line = np.empty(w + 2 * radius, np.float32)
        for k in range(end - first + 2 * radius):
            i = first + k
            for j in range(w + 2 * radius):
                place = min(max(coordinate[i, j] * scale + start, np.float32(0)), last)
                left = int(place)
                share = place - np.float32(left)
                sharp = int(level[i, j])
                wide = min(sharp + 1, table.shape[0] - 1)
                mix = level[i, j] - np.float32(sharp)
                a = table[sharp, left] + share * (table[sharp, left + 1] - table[sharp, left])
                b = table[wide, left] + share * (table[wide, left + 1] - table[wide, left])
                line[j] = gain[i, j] * (a + mix * (b - a))
            for tap in range(taps.size):
                weight = taps[tap]
                for j in range(w):
                    blurred[k, j] += weight * line[tap + j]
        for i in range(first, end):
            for j in range(w):
                out[i, j] = stray[i, j]
            for tap in range(taps.size):
                weight = taps[tap]
                source = blurred[i - first + tap]
                for j in range(w):
                    out[i, j] += weight * source[j]


@kernel(fastmath=True)
def digitise(first, last, light, noise, top, quantiles, keys, out):
    """Write `light` (h, w) float32 with its noise into `out` (h, w) uint8 or uint16, clipped at 0
    and `top`.

    noise: dark level, read variance, shot variance, in units of `out`. The noise depends on the
    pixel and on `keys` (two uint32) alone, not on how the rows are shared among threads.
    """
    w = out.shape[1]
    dark, read, shot = np.float32(noise[0]), np.float32(noise[1]), np.float32(noise[2])
    full = np.float32(top)
    key0, key1 = keys[0], keys[1]
    for i in range(first, last):
        bits = np.empty(w, np.uint32)
        for j in range(w):
            x = _hash_bits(np.uint32(np.uint32(i * w + j) ^ key0))
            bits[j] = _hash_bits(np.uint32(x + key1)) >> np.uint32(16)
        for j in range(w):
            spread = np.sqrt(read + shot * max(light[i, j], np.float32(0)))
            value = dark + light[i, j] + spread * quantiles[bits[j]] + np.float32(0.5)
            out[i, j] = int(min(max(value, np.float32(0)), full))
