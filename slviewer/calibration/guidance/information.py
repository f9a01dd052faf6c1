"""Information of poses: the uncertainty it leaves in the working volume, and the gain of one more pose."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cholesky, eigh, solve_triangular

from slviewer.calibration.guidance.coarse_rig import GuidanceBench
from slviewer.calibration.splined.posterior import point_rows
from slviewer.calibration.splined.unknowns import State
from slviewer.calibration.splined.volume import Volume, depth_axis, motion_free, working_volume

NEGLIGIBLE = 1e-4
"""Of the points' mean variance, that gains need not tell."""


@dataclass(frozen=True, eq=False)
class Sensitivity:
    """The working volume, and how its points' errors that no rigid motion explains answer to the unknowns."""

    volume: Volume
    jacobian: np.ndarray

    @classmethod
    def from_bench(
        cls, bench: GuidanceBench, depths_mm: tuple[float, float], columns: int = 9, rows: int = 7
    ) -> "Sensitivity":
        """``depths_mm``: nearest and farthest that boards are held at."""
        volume = working_volume(bench.rig, depths_mm, columns=columns, rows=rows)
        state = State(bench.rig, np.zeros((0, 3, 3)), np.zeros((0, 3)), np.zeros(0), np.zeros((len(bench.points), 2)))
        rows_of = point_rows(state, depth_axis(bench.rig, volume), volume.pixels, volume.z).toarray()
        known = np.isfinite(rows_of).all(axis=1).reshape(-1, 3).all(axis=1)
        volume = Volume(volume.pixels[known], volume.z[known], volume.points[known], volume.projector[known])
        rows_of = rows_of.reshape(len(known), 3, -1)[known].reshape(3 * len(volume.z), -1)
        full = np.zeros((len(rows_of), bench.layout.size))
        full[:, bench.layout.rig :] = motion_free(rows_of.T, volume.points).T
        return cls(volume, full)


@dataclass(frozen=True, eq=False)
class Information:
    """Of the poses had: the points' ``variances`` (m,) mm^2, and what the unknowns may still do.

    ``free`` (n, n) float32: each column is a way in which the unknowns are off by one sigma, independent of the others,
    the last ones those that matter most for the points; ``counts`` (k,) float32 mm: what each of the last k adds to the
    points' error, root mean square.
    """

    variances: np.ndarray
    free: np.ndarray
    counts: np.ndarray

    @classmethod
    def from_rows(cls, bench: GuidanceBench, rows: Sequence[np.ndarray], sight: Sensitivity) -> "Information":
        """From what each pose tells (see ``GuidanceBench.rows``)."""
        A = bench.prior()
        if len(rows):
            told = np.concatenate(rows)
            A += told.T @ told
        scale = 1.0 / np.sqrt(np.diag(A))
        L = cholesky(A * scale * scale[:, None], lower=True, check_finite=False)
        free = solve_triangular(L, np.diag(scale), lower=True, check_finite=False).T
        answer = sight.jacobian @ free
        variances = (answer**2).sum(axis=1).reshape(-1, 3).sum(axis=1)
        shares, ways = eigh(answer.T @ answer / len(variances), check_finite=False)
        shares = np.maximum(shares, 0.0)
        most = int((np.cumsum(shares) > NEGLIGIBLE * shares.sum()).sum())
        return cls(variances, (free @ ways).astype(np.float32), np.sqrt(shares[-most:]).astype(np.float32))

    @property
    def sigma_mm(self) -> float:
        """Root mean square over the volume, in all directions together."""
        return float(np.sqrt(self.variances.mean()))

    def gain(self, rows: np.ndarray) -> float:
        """mm^2 by which a pose that tells these rows lowers the mean variance over the volume."""
        seen = rows.astype(np.float32) @ self.free
        inner = (seen @ seen.T).astype(np.float64)
        inner[np.diag_indices(len(inner))] += 1.0
        told = seen[:, -len(self.counts) :] * self.counts
        L = cholesky(inner, lower=True, check_finite=False)
        return float((solve_triangular(L, told.astype(np.float64), lower=True, check_finite=False) ** 2).sum())
