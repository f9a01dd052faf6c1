"""What ordinary cameras make of the light on their sensors: tone curves, sharpening, denoising,
compression, and an exposure of their own."""

from collections.abc import Callable, Mapping
from functools import partial

import cv2
import numpy as np

from tests.proofs.hostile_frames import compress_jpeg, row_phase, scale_frames

Rng = np.random.Generator
Pipeline = Callable[[np.ndarray, Rng], np.ndarray]
"""From signals (n, h, w) float32, 1 for a full pixel, noise included, to images (n, h, w)."""


def code_srgb(signal: np.ndarray) -> np.ndarray:
    """Signals after the tone curve of sRGB (IEC 61966-2-1)."""
    clipped = np.clip(signal, 0, 1)
    return np.where(clipped <= 0.0031308, 12.92 * clipped, 1.055 * clipped ** (1 / 2.4) - 0.055)


def _to_bytes(coded: np.ndarray, low: float = 0.0, high: float = 255.0) -> np.ndarray:
    """Coded signals as grey levels of 8 bits from ``low`` to ``high``."""
    return np.rint(low + (high - low) * np.clip(coded, 0, 1)).astype(np.uint8)


def _photograph(signal: np.ndarray, rng: Rng) -> np.ndarray:
    """Of sRGB."""
    return _to_bytes(code_srgb(signal))


def _gamma(signal: np.ndarray, rng: Rng, gamma: float) -> np.ndarray:
    """Of a power law."""
    return _to_bytes(np.clip(signal, 0, 1) ** (1 / gamma))


def _compress(signal: np.ndarray, rng: Rng, quality: int) -> np.ndarray:
    """Of sRGB, as JPEG."""
    return compress_jpeg(_photograph(signal, rng), quality)


def _sharpen(signal: np.ndarray, rng: Rng) -> np.ndarray:
    """Of sRGB, with an unsharp mask of 1.2 pixels, and as JPEG."""
    coded = code_srgb(signal).astype(np.float32)
    for frame in coded:
        frame += 0.6 * (frame - cv2.GaussianBlur(frame, (0, 0), 1.2))
    return compress_jpeg(_to_bytes(coded), 90)


def _denoise(signal: np.ndarray, rng: Rng) -> np.ndarray:
    """Of sRGB, with the noise removed by non-local means."""
    return np.stack([cv2.fastNlMeansDenoising(f, None, 5, 5, 11) for f in _photograph(signal, rng)])


def _demosaic(signal: np.ndarray, rng: Rng) -> np.ndarray:
    """Of a Bayer mosaic under bluish light, balanced, and as luminance of sRGB."""
    light = np.array([0.55, 1.0, 0.8], np.float32)  # red, green, blue
    mosaic = signal.copy()
    mosaic[:, 0::2, 0::2] *= light[0]
    mosaic[:, 1::2, 1::2] *= light[2]
    raw = np.rint(4095 * np.clip(mosaic, 0, 1)).astype(np.uint16)
    out = np.empty(signal.shape, np.uint8)
    for frame, image in zip(raw, out, strict=True):
        colours = cv2.cvtColor(frame, cv2.COLOR_BayerRGGB2RGB) / 4095 / light
        image[:] = cv2.cvtColor(_to_bytes(code_srgb(colours)), cv2.COLOR_RGB2GRAY)
    return out


def _expose(signal: np.ndarray, rng: Rng) -> np.ndarray:
    """Of sRGB, with an exposure and a white balance that follow each image."""
    means = signal.mean(axis=(1, 2))
    gains = (means.mean() / means.clip(1e-3)) ** 0.3 * rng.uniform(0.98, 1.02, len(means))
    return _photograph(scale_frames(signal, gains.clip(0.7, 1.4)), rng)


def _film(signal: np.ndarray, rng: Rng) -> np.ndarray:
    """A video's frames, from 16 to 235, compressed."""
    return compress_jpeg(_to_bytes(code_srgb(signal), 16, 235), 80)


def _vignette(signal: np.ndarray, rng: Rng) -> np.ndarray:
    """Of sRGB, at the corners with less than half of the light."""
    h, w = signal.shape[1:]
    y, x = np.mgrid[:h, :w]
    square = ((x - w / 2) ** 2 + (y - h / 2) ** 2) / (w / 1.6) ** 2
    return _photograph(signal * (1 / (1 + square) ** 2).astype(np.float32), rng)


def _flicker(signal: np.ndarray, rng: Rng) -> np.ndarray:
    """Of sRGB, read out row by row under lamps that flicker by 6 %."""
    starts = rng.uniform(0, 2 * np.pi, (len(signal), 1))
    return _photograph(
        signal * (1 + 0.06 * np.sin(row_phase(signal, 2.3, starts))).astype(np.float32), rng
    )


def _shift_bits(signal: np.ndarray, rng: Rng) -> np.ndarray:
    """Linear, of ten bits in the upper ones of sixteen."""
    return (np.rint(1023 * np.clip(signal, 0, 1)) * 64).astype(np.uint16)


PIPELINES: Mapping[str, Pipeline] = {
    "sRGB": _photograph,
    "gamma 1.8": partial(_gamma, gamma=1.8),
    "JPEG 95": partial(_compress, quality=95),
    "JPEG 70": partial(_compress, quality=70),
    "sharpened": _sharpen,
    "denoised": _denoise,
    "demosaiced": _demosaic,
    "automatic": _expose,
    "video": _film,
    "vignette": _vignette,
    "mains": _flicker,
    "10 of 16 bits": _shift_bits,
}
TRUE_OF: Mapping[str, frozenset[str]] = {
    "automatic": frozenset({"exposure-drift"}),
    "mains": frozenset({"flicker", "exposure-drift"}),
}
"""Causes beside the tone curve that are true of every capture of a pipeline."""
LINEAR = "10 of 16 bits"
"""The only one without a tone curve."""
