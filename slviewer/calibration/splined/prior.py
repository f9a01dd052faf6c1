"""Prior of the unknowns: normal distributions that regularise the adjustment."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from slviewer.calibration.splined.board_shape import (
    GAUGE_MM,
    HEIGHT_SIGMA_MM,
    OFFSET_SIGMA_MM,
    offset_gauge,
)
from slviewer.calibration.splined.fields import roughness
from slviewer.calibration.splined.normal import PoseData
from slviewer.calibration.splined.residual_noise import update_strength
from slviewer.calibration.splined.unknowns import State

POSE_SIGMA = np.array([1.0, 1.0, 1.0, 1e3, 1e3, 1e3])
"""rad and mm: holds a pose that was excluded as a whole."""


@dataclass(frozen=True, eq=False)
class Prior:
    """Normal distributions: of the fields' coefficients by their roughness (``forms``, times a
    strength), of the board's height and offsets by what boards are like, and of the poses widely.

    ``features_per_point``: how many of the board's features each offset of the state represents.
    """

    forms: tuple[np.ndarray, np.ndarray]
    gauge: np.ndarray
    features_per_point: float = 1.0

    @classmethod
    def build(cls, state: State, data: PoseData) -> "Prior":
        """Build the prior for the fields' knots and the board's features."""
        forms = [roughness(d.coefficients) for d in (state.rig.camera, state.rig.projector)]
        return cls((forms[0], forms[1]), offset_gauge(data.points))

    def add(self, A: np.ndarray, b: np.ndarray, state: State, strengths: Sequence[float]) -> None:
        """Add to the upper triangle and the right-hand side."""
        at, diagonal = state.layout, np.arange(len(b))
        pose = np.tile(POSE_SIGMA**-2.0, at.poses)
        A[diagonal[: at.height], diagonal[: at.height]] += pose
        height, offsets = diagonal[at.height : at.offsets], slice(at.offsets, at.rig)
        A[height, height] += HEIGHT_SIGMA_MM**-2.0
        b[height] -= state.heights / HEIGHT_SIGMA_MM**2
        form = (
            np.eye(at.rig - at.offsets) * self.features_per_point / OFFSET_SIGMA_MM**2
            + self.gauge.T @ self.gauge / GAUGE_MM**2
        )
        A[offsets, offsets] += form
        b[offsets] -= form @ state.offsets.ravel()
        for first, field, form, strength in self._fields(state, strengths):
            n = len(form)
            for k in range(2):
                block = slice(first + k * n, first + (k + 1) * n)
                A[block, block] += strength * form
                b[block] -= strength * (form @ field[k])

    def cost(self, state: State, strengths: Sequence[float]) -> float:
        """Half the prior's chi square at a state."""
        offsets = state.offsets.ravel()
        total = (
            np.sum((state.heights / HEIGHT_SIGMA_MM) ** 2) + np.sum(offsets**2) / OFFSET_SIGMA_MM**2
        )
        for _, field, form, strength in self._fields(state, strengths):
            total += strength * float(np.sum(field * (field @ form)))
        return 0.5 * float(total)

    def update_strengths(
        self, strengths: Sequence[float], state: State, solve: Callable[[np.ndarray], np.ndarray]
    ) -> list[float]:
        """The fields' strengths after one update."""
        size = state.layout.size
        return [
            update_strength(strength, form, field, first, solve, size)
            for first, field, form, strength in self._fields(state, strengths)
        ]

    def _fields(
        self, state: State, strengths: Sequence[float]
    ) -> Iterator[tuple[int, np.ndarray, np.ndarray, float]]:
        """Iterate over both fields: first unknown, coefficients (2, n), quadratic form (n, n), and
        strength."""
        at = state.layout
        firsts = at.camera_field, at.projector_field
        fields = [
            device.coefficients.reshape(2, -1) for device in (state.rig.camera, state.rig.projector)
        ]
        return zip(firsts, fields, self.forms, strengths, strict=True)
