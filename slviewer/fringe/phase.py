"""Phase map of one capture along one axis, and the reasons for masked pixels."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import IntEnum
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from slviewer.errors import InputError
from slviewer.fringe.sequence import Axis

if TYPE_CHECKING:
    from slviewer.fringe.edge_blur import EdgeDisplacement

GRAY_SIGMA_CELLS = 12**-0.5
"""Standard deviation of a coordinate known only to its Gray cell, 0.29 px where cells are projector
columns."""


Noise = tuple[float, float]
"""(a, b): the variance of one frame's grey level is a + b * level."""


class Reason(IntEnum):
    """Reason why a pixel has no absolute phase."""

    VALID = 0
    DARK = 1
    """Too little modulation for its noise: shadow, black surface, or out of the projector's
    light."""
    SATURATED = 2
    """The camera clipped the fringes."""
    INCONSISTENT = 3
    """A bit that could not be decided, or an order that contradicts the phase or the
    neighbourhood."""
    OUTSIDE = 4
    """The coordinate lies outside the projector."""
    INDIRECT = 5
    """The frames contradict a single reflection: much of the light came from other surfaces or
    through the material."""
    UNSEEN = 6
    """The second camera does not see the point, or sees an edge there."""


@dataclass(frozen=True)
class PhaseMap:
    """Decoded frames of one axis; every map is (h, w).

    ``phase`` float32 rad, absolute (2 pi u / period_px), NaN where ``reason`` (uint8, a `Reason`)
    is not VALID. ``wrapped`` float32 rad of the finest period, in -pi ... pi, also where masked;
    all NaN for Gray code alone. ``modulation`` and ``background`` float32 grey levels. ``noise`` =
    (a, b): the variance of one frame's grey level is a + b * level, measured from this capture.
    ``steps``: phase steps of the finest period, 0 for Gray code alone, whose ``period_px`` is the
    width of its cells. ``unambiguous_px``: the coordinate is known only modulo so many px of the
    projector; infinite where it is absolute. ``model_error_rad``: rms error of the phase that gamma
    leaves, beside noise. ``sigma_scale``: factor by which neighbouring pixels scatter more than
    both predict, 1 where they do not (see `scatter`). ``sigma_known``: (h, w) float32 rad, the
    standard deviation of a phase that was not decoded from these maps (see
    `reconstruction.camera_match`), whose ``light`` are the decoded ones, by axis.
    """

    axis: Axis
    period_px: float
    phase: np.ndarray
    wrapped: np.ndarray
    modulation: np.ndarray
    background: np.ndarray
    reason: np.ndarray
    noise: Noise
    steps: int
    unambiguous_px: float = np.inf
    model_error_rad: float = 0.0
    sigma_scale: float = 1.0
    sigma_known: np.ndarray | None = None
    light: PhaseMaps | None = None

    def __post_init__(self) -> None:
        """Raise InputError unless all maps have the same shape (h, w)."""
        maps = (self.phase, self.wrapped, self.modulation, self.background, self.reason)
        if any(m.ndim != 2 or m.shape != self.phase.shape for m in maps):
            raise InputError(
                f"the maps of a phase map have shapes {[m.shape for m in maps]}",
                "they must all be one (h, w)",
            )

    @property
    def mask(self) -> np.ndarray:
        """(h, w) bool, True where the absolute phase is valid."""
        return self.reason == Reason.VALID

    @property
    def illuminated(self) -> np.ndarray:
        """(h, w) bool, illuminated and modulated: what a perfect decoder could measure; the
        denominator of coverage."""
        return self.reason != Reason.DARK

    def share(self, reason: Reason) -> float:
        """Return the share of the illuminated pixels that have a reason; 0 without any."""
        reasons = self.reason[self.illuminated]
        return float(np.mean(reasons == reason)) if reasons.size else 0.0

    @property
    def is_relative(self) -> bool:
        """Whether the coordinate is known only modulo ``unambiguous_px``."""
        return bool(np.isfinite(self.unambiguous_px))

    @property
    def px_per_rad(self) -> float:
        """Projector px over which the finest phase grows by 1 rad."""
        return self.period_px / (2 * np.pi)

    @property
    def coordinate(self) -> np.ndarray:
        """(h, w) float32 px: the projector column (axis x) or row (axis y), NaN where invalid."""
        return self.phase * np.float32(self.px_per_rad)

    @property
    def sigma_phase(self) -> np.ndarray:
        """(h, w) float32 rad: standard deviation of the phase. NaN where the phase is.

        sqrt(2 / n) sigma_I / B and `model_error_rad` in quadrature, times `sigma_scale`; 2 pi /
        sqrt(12) for Gray code alone.
        """
        if self.sigma_known is not None:
            sigma = self.sigma_known
        elif self.steps == 0:
            sigma = np.full_like(self.phase, 2 * np.pi * GRAY_SIGMA_CELLS)
        else:
            a, b = self.noise
            variance = np.float32(a) + np.float32(b) * self.background
            sigma = np.sqrt(variance * np.float32(2 / self.steps)) / np.maximum(
                self.modulation, np.float32(1e-6)
            )
            if self.model_error_rad:
                sigma = np.hypot(sigma, np.float32(self.model_error_rad))
            if self.sigma_scale != 1:
                sigma *= np.float32(self.sigma_scale)
        return np.where(self.mask, sigma, np.float32(np.nan))

    @property
    def sigma_px(self) -> np.ndarray:
        """(h, w) float32 px: `sigma_phase` as standard deviation of the coordinate."""
        return self.sigma_phase * np.float32(self.px_per_rad)

    @cached_property
    def edge_displacement(self) -> EdgeDisplacement:
        """Displacement of the phase, rad, by the camera's blur where the surface's brightness
        jumps.

        See `edge_blur`; 0 for Gray code alone.
        """
        from slviewer.fringe.edge_blur import EdgeDisplacement, estimate_displacement  # loads numba

        if self.steps == 0:
            return EdgeDisplacement(self.phase * 0, np.zeros(self.phase.shape, bool))
        a, b = self.noise
        some = np.s_[::8, ::8]
        level = (
            float(np.mean(self.background[some], where=self.mask[some]))
            if self.mask[some].any()
            else 0.0
        )
        return estimate_displacement(
            self.phase, self.modulation, float(np.sqrt(max(a + b * level, 0.0) * 2 / self.steps))
        )

    @property
    def edge_error_px(self) -> np.ndarray:
        """(h, w) float32 px: error of the coordinate due to the camera's blur, NaN where the phase
        is."""
        return np.abs(self.edge_displacement.shift) * np.float32(self.px_per_rad)

    def correct_edges(self) -> tuple[PhaseMap, np.ndarray]:
        """Return the phase map without the displacement by the camera's blur where the surface
        continues across an edge, and the error of its coordinate that remains, (h, w) float32 px,
        NaN where the phase is.
        """
        moved = self.edge_displacement
        corrected = np.where(moved.is_continuous, self.phase - moved.shift, self.phase)
        return replace(self, phase=corrected), moved.remaining * np.float32(self.px_per_rad)


PhaseMaps = Mapping[Axis, PhaseMap]
"""The phase maps of a capture, of one axis or both."""
