"""Per-pixel normal equations of ``z = (c0 + c1 phi)/(1 + c2 phi)``, accumulated pose by pose.

Depth and phase are taken from a reference point of each pixel (``zeta = z - z_ref``, ``s = phi - phi_ref``), which
leaves the rational family as it is, ``zeta = (a0 + a1 s)/(1 + a2 s)``, and keeps the float64 sums well conditioned.
Memory is a few images, whatever the number of poses.
"""

from dataclasses import dataclass, field

import numpy as np

from slviewer.geometry.jit import kernel

SUMS = 10
"""Upper triangle of the 3x3 normal matrix (6), right-hand side (3), squared residuals or values (1)."""


@dataclass
class RationalMoments:
    """Sums for one axis; ``coefficients`` (3, h, w) hold a0, a1, a2 once solved."""

    phase_ref: np.ndarray
    z_ref: float
    sums: np.ndarray = field(init=False)
    poses: np.ndarray = field(init=False)
    phase_min: np.ndarray = field(init=False)
    phase_max: np.ndarray = field(init=False)
    coefficients: np.ndarray = field(init=False)
    condition: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        shape = self.phase_ref.shape
        self.sums = np.zeros((*shape, SUMS))
        self.poses = np.zeros(shape, np.uint16)
        self.phase_min = np.full(shape, np.inf, np.float32)
        self.phase_max = np.full(shape, -np.inf, np.float32)
        self.coefficients = np.zeros((3, *shape))
        self.condition = np.full(shape, np.nan, np.float32)

    def add(self, phase: np.ndarray, z: np.ndarray, origin: tuple[int, int]) -> None:
        """Add one pose: (h', w') phase rad and depth mm at ``origin`` = (v0, u0); NaN pixels are passed over.

        Minimises the equation's own residual, which is linear: ``zeta = a0 + a1 s - a2 zeta s``.
        """
        _add_linear(
            phase, z, origin[0], origin[1], self.phase_ref, self.z_ref,
            self.sums, self.poses, self.phase_min, self.phase_max,
        )  # fmt: skip

    def solve(self, min_poses: int) -> None:
        """Coefficients from the linear sums; NaN at pixels of fewer than ``min_poses`` poses. Sums start afresh."""
        _solve(self.sums, self.poses, min_poses, self.coefficients, self.condition, False)
        self.sums[:] = 0

    def add_refinement(self, phase: np.ndarray, z: np.ndarray, origin: tuple[int, int]) -> None:
        """Second pass: sums of the depth residual's linearisation at the coefficients found."""
        _add_gauss_newton(
            phase, z, origin[0], origin[1], self.phase_ref, self.z_ref, self.coefficients, self.sums
        )  # fmt: skip

    def refine(self, min_poses: int) -> np.ndarray:
        """One Gauss-Newton step in depth; returns the fit's RMS (h, w) float32 mm."""
        _solve(self.sums, self.poses, min_poses, self.coefficients, self.condition, True)
        with np.errstate(invalid="ignore", divide="ignore"):
            rms = np.sqrt(self.sums[..., 9] / self.poses).astype(np.float32)
        rms[self.poses < min_poses] = np.nan
        return rms


@kernel()
def _add_linear(phase, z, v0, u0, phase_ref, z_ref, sums, poses, phase_min, phase_max):  # type: ignore[no-untyped-def]
    for i in range(phase.shape[0]):
        for j in range(phase.shape[1]):
            p = phase[i, j]
            s = p - phase_ref[v0 + i, u0 + j]
            zeta = z[i, j] - z_ref
            if not (np.isfinite(s) and np.isfinite(zeta)):
                continue
            a = sums[v0 + i, u0 + j]
            q = -zeta * s
            a[0] += 1.0
            a[1] += s
            a[2] += q
            a[3] += s * s
            a[4] += s * q
            a[5] += q * q
            a[6] += zeta
            a[7] += s * zeta
            a[8] += q * zeta
            poses[v0 + i, u0 + j] += 1
            phase_min[v0 + i, u0 + j] = min(phase_min[v0 + i, u0 + j], p)
            phase_max[v0 + i, u0 + j] = max(phase_max[v0 + i, u0 + j], p)


@kernel()
def _add_gauss_newton(phase, z, v0, u0, phase_ref, z_ref, coefficients, sums):  # type: ignore[no-untyped-def]
    for i in range(phase.shape[0]):
        for j in range(phase.shape[1]):
            v, u = v0 + i, u0 + j
            s = phase[i, j] - phase_ref[v, u]
            a0, a1, a2 = coefficients[0, v, u], coefficients[1, v, u], coefficients[2, v, u]
            w = 1.0 / (1.0 + a2 * s)
            model = (a0 + a1 * s) * w
            r = z[i, j] - z_ref - model
            if not (np.isfinite(s) and np.isfinite(r)):
                continue
            j0, j1, j2 = w, s * w, -s * w * model
            a = sums[v, u]
            a[0] += j0 * j0
            a[1] += j0 * j1
            a[2] += j0 * j2
            a[3] += j1 * j1
            a[4] += j1 * j2
            a[5] += j2 * j2
            a[6] += j0 * r
            a[7] += j1 * r
            a[8] += j2 * r
            a[9] += r * r


@kernel()
def _solve(sums, poses, min_poses, coefficients, condition, step):  # type: ignore[no-untyped-def]
    """Cholesky of the normalised 3x3 matrix; ``step`` adds to the coefficients and leaves the residual in sums[9]."""
    for v in range(sums.shape[0]):
        for u in range(sums.shape[1]):
            a = sums[v, u]
            if poses[v, u] < min_poses or a[0] <= 0 or a[3] <= 0 or a[5] <= 0:
                coefficients[:, v, u] = np.nan
                continue
            d0, d1, d2 = 1 / np.sqrt(a[0]), 1 / np.sqrt(a[3]), 1 / np.sqrt(a[5])
            m01, m02, m12 = a[1] * d0 * d1, a[2] * d0 * d2, a[4] * d1 * d2
            b0, b1, b2 = a[6] * d0, a[7] * d1, a[8] * d2
            l11s = 1 - m01 * m01
            if not l11s > 1e-12:
                coefficients[:, v, u] = np.nan
                continue
            l11 = np.sqrt(l11s)
            l21 = (m12 - m01 * m02) / l11
            l22s = 1 - m02 * m02 - l21 * l21
            if not l22s > 1e-12:
                coefficients[:, v, u] = np.nan
                continue
            l22 = np.sqrt(l22s)
            y0 = b0
            y1 = (b1 - m01 * y0) / l11
            y2 = (b2 - m02 * y0 - l21 * y1) / l22
            x2 = y2 / l22
            x1 = (y1 - l21 * x2) / l11
            x0 = y0 - m01 * x1 - m02 * x2
            condition[v, u] = 1 / min(l11, l22)
            if step:
                a[9] = max(0.0, a[9] - (y0 * y0 + y1 * y1 + y2 * y2))
                coefficients[0, v, u] += x0 * d0
                coefficients[1, v, u] += x1 * d1
                coefficients[2, v, u] += x2 * d2
            else:
                coefficients[0, v, u] = x0 * d0
                coefficients[1, v, u] = x1 * d1
                coefficients[2, v, u] = x2 * d2
