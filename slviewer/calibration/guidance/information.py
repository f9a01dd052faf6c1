"""What poses know together, how sure that makes points of the working volume, and what one more pose would add."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from slviewer.calibration.guidance.bench import GuidanceBench
from slviewer.calibration.splined.posterior import point_rows
from slviewer.calibration.splined.unknowns import State
from slviewer.calibration.splined.volume import Volume, better_axis, motion_free, working_volume


@dataclass(frozen=True, eq=False)
class Sight:
    """The working volume, and how its points' errors that no rigid motion explains answer to the unknowns."""

    volume: Volume
    jacobian: np.ndarray

    @classmethod
    def of(cls, bench: GuidanceBench, depths_mm: tuple[float, float], columns: int = 9, rows: int = 7) -> "Sight":
        """``depths_mm``: nearest and farthest that boards are held at."""
        volume = working_volume(bench.rig, depths_mm, columns=columns, rows=rows)
        state = State(bench.rig, np.zeros((0, 3, 3)), np.zeros((0, 3)), np.zeros(0), np.zeros((len(bench.points), 2)))
        rows_of = point_rows(state, better_axis(bench.rig, volume), volume.pixels, volume.z).toarray()
        known = np.isfinite(rows_of).all(axis=1).reshape(-1, 3).all(axis=1)
        volume = Volume(volume.pixels[known], volume.z[known], volume.points[known], volume.projector[known])
        rows_of = rows_of.reshape(len(known), 3, -1)[known].reshape(3 * len(volume.z), -1)
        full = np.zeros((len(rows_of), bench.layout.size))
        full[:, bench.layout.rig :] = motion_free(rows_of.T, volume.points).T
        return cls(volume, full)


@dataclass(frozen=True, eq=False)
class Information:
    """Of the poses had: the unknowns' ``covariance`` (n, n), and the points' ``variances`` (m,) mm^2."""

    covariance: np.ndarray
    variances: np.ndarray
    _both: np.ndarray

    @classmethod
    def of(cls, bench: GuidanceBench, rows: Sequence[np.ndarray], sight: Sight) -> "Information":
        """From what each pose tells (see ``GuidanceBench.rows``)."""
        A = bench.prior()
        for told in rows:
            A += told.T @ told
        scale = 1.0 / np.sqrt(np.diag(A))
        factor = cho_factor(A * scale * scale[:, None], lower=True, check_finite=False)
        covariance = cho_solve(factor, np.diag(scale), check_finite=False) * scale[:, None]
        answer = covariance @ sight.jacobian.T
        variances = np.einsum("mn,nm->m", sight.jacobian, answer).reshape(-1, 3).sum(axis=1)
        spread = answer @ answer.T / len(variances)
        return cls(covariance, variances, np.hstack([covariance, spread]))

    @property
    def sigma_mm(self) -> float:
        """Root mean square over the volume, in all directions together."""
        return float(np.sqrt(self.variances.mean()))

    def gain(self, rows: np.ndarray) -> float:
        """mm^2 by which a pose that tells these rows lowers the mean variance over the volume."""
        both = rows @ self._both
        n = len(self.covariance)
        inner = both[:, :n] @ rows.T
        inner[np.diag_indices(len(inner))] += 1.0
        return float(np.trace(cho_solve(cho_factor(inner, check_finite=False), both[:, n:] @ rows.T)))
