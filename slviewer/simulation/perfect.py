"""The instrument that knows its rig exactly: what it measures wrongly is noise, and nothing else."""

from dataclasses import dataclass

import numpy as np

from slviewer.fringe.phase import PhaseMap
from slviewer.fringe.sequence import Axis
from slviewer.simulation.rig import SimulatedRig

_STEPS = 12
_SETTLED_PX = 1e-7
_NUDGE = 1e-4


@dataclass(frozen=True, eq=False)
class PerfectModel:
    """A simulated rig as a calibration: its errors are the floor that no calibration gets below."""

    rig: SimulatedRig

    name = "floor"

    @property
    def axes(self) -> tuple[Axis, ...]:
        return ("x", "y")

    def points(self, phase: PhaseMap) -> np.ndarray:
        """(h, w, 3) float32 mm: where the rig's own lenses put each phase; NaN where it is invalid."""
        row = self.axes.index(phase.axis)
        valid = phase.mask
        rays = np.dstack([self.rig.camera.rays(), np.ones(phase.phase.shape)])[valid]
        measured = phase.coordinate[valid].astype(float)
        # In 1/z the coordinate is nearly linear, so that secants need few steps.
        nearer, inverse = np.full(len(rays), 1 / 500), np.full(len(rays), 1 / 700)
        before = self._coordinate(rays, nearer, row) - measured
        off = before
        for _ in range(_STEPS):
            off = self._coordinate(rays, inverse, row) - measured
            going = np.abs(off) > _SETTLED_PX
            if not going.any():
                break
            step = np.where(
                going & (off != before), off * (inverse - nearer) / np.where(off == before, 1, off - before), 0
            )
            nearer, before, inverse = inverse, off, inverse - step
        out = np.full((*phase.phase.shape, 3), np.nan, np.float32)
        found = (np.abs(off) <= _SETTLED_PX) & (inverse > 0)
        out[valid] = np.where(found, 1 / np.where(found, inverse, 1), np.nan)[:, None] * rays
        return out

    def sigma_z(self, phase: PhaseMap, points: np.ndarray) -> np.ndarray:
        """(h, w) mm: depth noise predicted from the phase noise, ``|dz/dphi| sigma_phi``."""
        row = self.axes.index(phase.axis)
        X = np.asarray(points, float)
        moved = np.abs(self.rig.project(X * (1 + _NUDGE))[..., row] - self.rig.project(X)[..., row])
        with np.errstate(divide="ignore", invalid="ignore"):
            per_px = _NUDGE * X[..., 2] / moved
        return (per_px * phase.period_px / (2 * np.pi) * phase.sigma_phase).astype(np.float32)

    def _coordinate(self, rays: np.ndarray, inverse: np.ndarray, row: int) -> np.ndarray:
        with np.errstate(divide="ignore"):
            return np.asarray(self.rig.project(rays / inverse[:, None])[:, row])
