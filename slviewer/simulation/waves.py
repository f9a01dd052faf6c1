"""The local distortion of a simulated lens that no Brown polynomial can express.

A sum of plane waves in random directions, each coordinate with amplitudes of its own. Real lenses
and DMD optics leave such residuals of a tenth of a pixel or two after the best polynomial; they are
what the pixel-wise model is there to learn.
"""

import numpy as np

Waves = np.ndarray
"""(n, 6) float64: wave vector (rad per px, u then v), amplitudes (px) of sine and cosine in u, then
of both in v."""


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
    u, v = np.meshgrid(np.linspace(0, size[0] - 1, 81), np.linspace(0, size[1] - 1, 81))
    displacement = displace(waves, np.stack([u, v], -1))
    waves[:, 2:] *= np.repeat(rms_px / np.sqrt(np.mean(displacement**2, axis=(0, 1))), 2)
    return waves


def displace(waves: Waves, pixels: np.ndarray) -> np.ndarray:
    """Displacement (..., 2) px at `pixels` (..., 2) px; the definition that the lens's kernel
    agrees with."""
    angle = pixels[..., 0, None] * waves[:, 0] + pixels[..., 1, None] * waves[:, 1]
    sine, cosine = np.sin(angle), np.cos(angle)
    return np.stack(
        [sine @ waves[:, 2] + cosine @ waves[:, 3], sine @ waves[:, 4] + cosine @ waves[:, 5]], -1
    )
