"""Prior of the unknowns: normal distributions that regularise the adjustment."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from slviewer.calibration.splined.board_shape import (
    GAUGE_MM,
    HEIGHT_SIGMA_MM,
    OFFSET_SIGMA_MM,
    offset_gauge,
)
from slviewer.calibration.splined.fields import roughness
from slviewer.calibration.splined.residuals import PoseData
from slviewer.calibration.splined.unknowns import State
from slviewer.geometry.rigid import Floats

POSE_SIGMA = np.array([1.0, 1.0, 1.0, 1e3, 1e3, 1e3])
"""rad and mm: holds a pose that was excluded as a whole."""
FIRST_STRENGTH = 10.0
"""Initial strength of the fields' priors in 1/px^2: displacements of some tenths of a pixel."""
PROBES = 24
"""Random vectors that estimate a trace: to a percent of it."""
STRENGTH_BOUNDS = (1e-1, 1e6)
"""Bounds of a prior's strength, 1/px^2: a field of px and no prior, or no field."""


@dataclass(frozen=True, eq=False)
class Prior:
    """Normal distributions: of the fields' coefficients by their roughness (``forms``, times
    ``strengths``), of the board's height and offsets by what boards are like, and of the poses
    widely.

    ``features_per_point``: how many of the board's features each offset of the state represents.
    """

    forms: tuple[Floats, Floats]
    gauge: Floats
    strengths: tuple[float, float] = (FIRST_STRENGTH, FIRST_STRENGTH)
    features_per_point: float = 1.0

    @classmethod
    def build(cls, state: State, data: PoseData) -> "Prior":
        """Build the prior for the fields' knots and the board's features."""
        camera, projector = (roughness(device.coefficients) for device in state.rig[:2])
        return cls((camera, projector), offset_gauge(data.points))

    def add(self, A: Floats, b: Floats, state: State) -> None:
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
        for first, field, form, strength in self._fields(state):
            n = len(form)
            for k in range(2):
                block = slice(first + k * n, first + (k + 1) * n)
                A[block, block] += strength * form
                b[block] -= strength * (form @ field[k])

    def cost(self, state: State) -> float:
        """Half the prior's chi square at a state."""
        offsets = state.offsets.ravel()
        total = (
            np.sum((state.heights / HEIGHT_SIGMA_MM) ** 2) + np.sum(offsets**2) / OFFSET_SIGMA_MM**2
        )
        for _, field, form, strength in self._fields(state):
            total += strength * float(np.sum(field * (field @ form)))
        return 0.5 * float(total)

    def update_strengths(self, state: State, solve: Callable[[Floats], Floats]) -> "Prior":
        """Return the prior with its strengths updated by MacKay's fixed point, which maximises the
        evidence.

        The prior is exp(-strength/2 c'Fc) for each component c of a field, F its form; ``solve``
        applies the inverse of the normal matrix.
        """
        updated = []
        for first, field, form, strength in self._fields(state):
            signs = np.random.default_rng(0).choice([-1.0, 1.0], (*field.shape, PROBES))
            right = np.zeros((state.layout.size, PROBES))
            part = slice(first, first + field.size)
            right[part] = signs.reshape(-1, PROBES)
            spread = solve(right)[part].reshape(signs.shape)
            trace = float(np.sum(spread * (form @ signs))) / PROBES
            determined = max(field.size - strength * trace, 1.0)
            energy = float(np.sum(field * (field @ form)))
            updated.append(float(np.clip(determined / max(energy, 1e-12), *STRENGTH_BOUNDS)))
        return replace(self, strengths=(updated[0], updated[1]))

    def _fields(self, state: State) -> Iterator[tuple[int, Floats, Floats, float]]:
        """Iterate over both fields: first unknown, coefficients (2, n), quadratic form (n, n), and
        strength."""
        firsts = state.layout.camera_field, state.layout.projector_field
        fields = [device.coefficients.reshape(2, -1) for device in state.rig[:2]]
        return zip(firsts, fields, self.forms, self.strengths, strict=True)
