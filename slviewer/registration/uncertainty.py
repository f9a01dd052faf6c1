"""Uncertainty of a registered pose."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """Uncertainty of a registered pose (1 sigma).

    ``covariance`` (6, 6): of a small rotation vector (rad) about ``centre`` (3,) mm, the middle of
    the overlap in the reference's frame, and of the translation (mm) there.
    """

    covariance: np.ndarray
    centre: np.ndarray

    @property
    def shift_mm(self) -> float:
        """Root of the expected squared translation of the overlap's middle."""
        return float(np.sqrt(np.trace(self.covariance[3:, 3:])))

    @property
    def turn_deg(self) -> float:
        """Root of the expected squared rotation angle."""
        return float(np.degrees(np.sqrt(np.trace(self.covariance[:3, :3]))))
