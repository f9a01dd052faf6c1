"""Per-pixel normal equations of a quadratic correction ``e = a0 + a1 s + a2 s^2``, and the prior that holds it.

Memory is a few images, whatever the number of poses.
"""

from dataclasses import dataclass, field

import numpy as np
from numba import prange

from slviewer.errors import CalibrationRejected
from slviewer.geometry.jit import kernel

MIN_POSES = 4
"""Pixels of fewer poses say nothing of how far pixels scatter, and are held by the prior for most of what they are."""
SUMS = 9
"""Of s^0 ... s^4, of e s^0 ... e s^2, of e^2."""
SAMPLE = 5_000
"""Pixels that the prior is estimated from; more change it by a hundredth."""
ROUNDS = 60
OUTLYING = 5.0
"""Pixels whose correction or misfit lies this many times farther out than most do not widen the prior."""


@dataclass(frozen=True)
class Solved:
    """``coefficients`` (3, h, w) float32 px, NaN where no pose was seen; ``rms_px`` (h, w) float32 of what they leave
    over; ``prior`` (3, 3) px^2, their covariance over the pixels; ``noise_px``, of one pose's e."""

    coefficients: np.ndarray
    rms_px: np.ndarray
    prior: np.ndarray
    noise_px: float


@dataclass
class QuadraticSums:
    """Sums for the pixels of ``centre`` and ``half`` (h, w) px: ``s = (c - centre)/half`` of a coordinate c px.

    ``least`` and ``most`` (h, w) float32 px are the coordinates that each pixel saw.
    """

    centre: np.ndarray
    half: np.ndarray
    values: np.ndarray = field(init=False)
    least: np.ndarray = field(init=False)
    most: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        shape = self.centre.shape
        self.values = np.zeros((*shape, SUMS))
        self.least = np.full(shape, np.inf, np.float32)
        self.most = np.full(shape, -np.inf, np.float32)

    @property
    def poses(self) -> np.ndarray:
        """(h, w) uint16: how many each pixel saw."""
        return self.values[..., 0].astype(np.uint16)

    def add(self, measured: np.ndarray, expected: np.ndarray, origin: tuple[int, int]) -> None:
        """Add one pose: (h', w') px coordinates at ``origin`` = (v0, u0); NaN pixels are passed over."""
        _add(measured, expected, *origin, self.centre, self.half, self.values, self.least, self.most)

    def solve(self) -> Solved:
        """The likeliest coefficients of each pixel, given what all pixels say of the prior.

        Raises CalibrationRejected when no pixel saw 4 poses.
        """
        prior, noise = _prior(self.values[self.values[..., 0] >= MIN_POSES])
        coefficients = np.empty((3, *self.centre.shape), np.float32)
        rms = np.empty(self.centre.shape, np.float32)
        _solve(self.values, np.linalg.inv(prior) * noise**2, coefficients, rms)
        return Solved(coefficients, rms, prior, noise)


def _prior(sums: np.ndarray) -> tuple[np.ndarray, float]:
    """(3, 3) px^2 covariance of the pixels' coefficients about zero, and px standard deviation of one pose's e.

    By expectation and maximisation over a sample of pixels: what the coefficients of each are likely to be, given the
    covariance, and then the covariance that they have.
    """
    if not len(sums):
        raise CalibrationRejected(
            f"no pixel saw the board in {MIN_POSES} poses or more: let the poses overlap in the image"
        )
    sums = sums[:: max(1, len(sums) // SAMPLE)]
    n, ee, b = sums[:, 0], sums[:, 8], sums[:, 5:8]
    A = sums[:, np.add.outer(np.arange(3), np.arange(3))]
    noise2, prior = max(float(np.median(ee / n)), 1e-12), np.eye(3) * max(float(np.median(ee / n)), 1e-12)
    kept = np.ones(len(n), bool)
    for _ in range(ROUNDS):
        V = np.linalg.inv(A / noise2 + np.linalg.inv(prior))
        m = np.einsum("nij,nj->ni", V, b) / noise2
        left = ee - 2 * np.einsum("ni,ni->n", m, b) + np.einsum("ni,nij,nj->n", m, A, m)
        left = np.maximum(left, 0) + np.einsum("nij,nji->n", A, V)
        second = np.einsum("ni,nj->nij", m, m) + V
        size = np.einsum("nij,ji->n", second, np.linalg.inv(prior))
        kept = (left / n < OUTLYING**2 * np.median(left / n)) & (size < OUTLYING**2 * np.median(size))
        prior = second[kept].mean(0) + 1e-12 * np.eye(3)
        noise2 = max(float(left[kept].sum() / n[kept].sum()), 1e-12)
    return prior, float(np.sqrt(noise2))


@kernel()
def _add(measured, expected, v0, u0, centre, half, sums, least, most):  # type: ignore[no-untyped-def]
    for i in range(measured.shape[0]):
        for j in range(measured.shape[1]):
            c = measured[i, j]
            s = (c - centre[v0 + i, u0 + j]) / half[v0 + i, u0 + j]
            e = expected[i, j] - c
            if not (np.isfinite(s) and np.isfinite(e)):
                continue
            a = sums[v0 + i, u0 + j]
            a[0] += 1.0
            a[1] += s
            a[2] += s * s
            a[3] += s * s * s
            a[4] += s * s * s * s
            a[5] += e
            a[6] += e * s
            a[7] += e * s * s
            a[8] += e * e
            least[v0 + i, u0 + j] = min(least[v0 + i, u0 + j], c)
            most[v0 + i, u0 + j] = max(most[v0 + i, u0 + j], c)


@kernel(parallel=True)
def _solve(sums, stiffness, coefficients, rms):  # type: ignore[no-untyped-def]
    """Each pixel's likeliest coefficients: Cholesky of its 3x3 normal matrix plus the prior's."""
    for v in prange(sums.shape[0]):
        for u in range(sums.shape[1]):
            a = sums[v, u]
            if not a[0] > 0:
                coefficients[:, v, u] = np.nan
                rms[v, u] = np.nan
                continue
            l00 = np.sqrt(a[0] + stiffness[0, 0])
            l10, l20 = (a[1] + stiffness[1, 0]) / l00, (a[2] + stiffness[2, 0]) / l00
            l11 = np.sqrt(a[2] + stiffness[1, 1] - l10 * l10)
            l21 = (a[3] + stiffness[2, 1] - l20 * l10) / l11
            l22 = np.sqrt(a[4] + stiffness[2, 2] - l20 * l20 - l21 * l21)
            y0 = a[5] / l00
            y1 = (a[6] - l10 * y0) / l11
            y2 = (a[7] - l20 * y0 - l21 * y1) / l22
            x2 = y2 / l22
            x1 = (y1 - l21 * x2) / l11
            x0 = (y0 - l10 * x1 - l20 * x2) / l00
            coefficients[0, v, u], coefficients[1, v, u], coefficients[2, v, u] = x0, x1, x2
            explained = 2 * (x0 * a[5] + x1 * a[6] + x2 * a[7]) - (
                x0 * (x0 * a[0] + x1 * a[1] + x2 * a[2])
                + x1 * (x0 * a[1] + x1 * a[2] + x2 * a[3])
                + x2 * (x0 * a[2] + x1 * a[3] + x2 * a[4])
            )
            rms[v, u] = np.sqrt(max(0.0, a[8] - explained) / a[0])
