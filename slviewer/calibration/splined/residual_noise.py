"""Weights of observations and priors, estimated from the residuals."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from slviewer.calibration.splined.normal import ObservedValues
from slviewer.calibration.splined.residuals import PoseData
from slviewer.geometry.rigid import Floats
from slviewer.geometry.robust import tukey_weights

MIN_SIGMA_PX = 1e-4
MAX_RATIO = 100.0
"""Largest ratio of residuals to their predicted noise for which their difference is estimated."""
MAX_POSE_NOISE_RATIO = 2.5
"""How many times the features' common noise one pose may have of its own: a tilted or blurred board
is read less well. What exceeds that contradicts the other poses."""


@dataclass(frozen=True)
class Noise:
    """Standard deviations in px estimated from the residuals.

    ``camera_px``: of a feature's coordinate; ``excess_px``: of a sample's x and y beyond their
    predicted noise; ``sample_px``: of a sample's x and y in total.
    """

    camera_px: float
    excess_px: tuple[float, float]
    sample_px: tuple[float, float]

    @property
    def ratio(self) -> tuple[float, float]:
        """Ratio (x, y) of the samples' scatter to their predicted noise; 1 where noise explains
        it."""
        pairs = zip(self.sample_px, self.excess_px, strict=True)
        predicted = [
            np.sqrt(max(s * s - e * e, (s / MAX_RATIO) ** 2, MIN_SIGMA_PX**2)) for s, e in pairs
        ]
        x, y = (max(1.0, float(s / p)) for s, p in zip(self.sample_px, predicted, strict=True))
        return x, y

    def sigmas(self, sample_sigma: Floats) -> Floats:
        """Return the total standard deviations (m, 2) px of samples with predicted noise (m, 2)
        px."""
        return np.sqrt(sample_sigma**2 + np.square(self.excess_px))


def estimate_noise(features: Floats, samples: Floats, sample_sigma: Floats) -> Noise:
    """Estimate the noise robustly from residuals of features (n, 2) and samples (m, 2) px; NaN does
    not count."""
    camera = 1.4826 * float(np.nanmedian(np.abs(features)))
    excess = [_excess_sigma(samples[:, k], sample_sigma[:, k]) for k in range(2)]
    total = 1.4826 * np.nanmedian(np.abs(samples), axis=0)
    return Noise(
        max(camera, MIN_SIGMA_PX), (excess[0], excess[1]), (float(total[0]), float(total[1]))
    )


def _excess_sigma(residuals: Floats, sigma: Floats) -> float:
    """Solve for the sigma that, added in quadrature to the predicted one (m,), normalises the
    residuals (m,) to 1."""
    known = np.isfinite(residuals) & np.isfinite(sigma)
    if not known.any():
        return MIN_SIGMA_PX
    r, variance = np.abs(residuals[known]), sigma[known] ** 2
    # 1.4826 median(r / sqrt(variance + excess^2)) = 1: half of the residuals are on either side of
    # it
    excess = np.sqrt(max(float(np.median((1.4826 * r) ** 2 - variance)), 0.0))
    return float(np.clip(excess, MIN_SIGMA_PX, max(3.0 * float(np.median(r)), MIN_SIGMA_PX)))


def pose_sigmas(features: Floats, feature_from: np.ndarray, noise: Noise) -> Floats:
    """Return the sigma (n, 2) px of each feature: that of its pose, limited to 1 to 2.5 times the
    common one."""
    sigma = np.full_like(features, noise.camera_px)
    for first, last in pairwise(feature_from):
        residuals = np.abs(features[first:last])
        if np.isfinite(residuals).any():
            own = 1.4826 * float(np.nanmedian(residuals))
            sigma[first:last] = np.clip(
                own, noise.camera_px, MAX_POSE_NOISE_RATIO * noise.camera_px
            )
    return sigma


def robust_weights(features: Floats, samples: Floats, sigmas: ObservedValues) -> ObservedValues:
    """Return the weights of features (n, 2) and samples (m, 2) in 1/px^2: inverse variance times
    Tukey's biweight.

    The biweight is the product of both coordinates'. ``sigmas``: (n, 2) and (m, 2) px. Residuals
    with NaN weigh 0.
    """
    weights = []
    for r, s in zip((features, samples), sigmas, strict=True):
        trust = np.prod(tukey_weights(np.nan_to_num(r / s), 1.0), axis=1, keepdims=True)
        weights.append(np.where(np.isfinite(r / s), trust / s**2, 0.0))
    return weights[0], weights[1]


def pose_trust(weights: ObservedValues, sigmas: ObservedValues, data: PoseData) -> Floats:
    """Return the mean of Tukey's biweight over each pose's features and over its samples, (poses,
    2)."""
    features, samples = (
        np.nanmax(np.where(np.isfinite(s), w * s**2, 0.0), axis=1)
        for w, s in zip(weights, sigmas, strict=True)
    )
    return data.means(features, samples)
