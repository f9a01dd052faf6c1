"""The simulated rig as a calibration without errors."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from slviewer.fringe.phase import PhaseMap
from slviewer.fringe.sequence import Axis
from slviewer.simulation.rig import SimulatedRig
from slviewer.simulation.scenes import directions_of

_STEPS = 12

_SETTLED_PX = 1e-7

_NUDGE = 1e-4


@dataclass(frozen=True, eq=False)
class PerfectModel:
    """A simulated rig as a calibration: its errors are the floor that no calibration gets below."""

    rig: SimulatedRig

    name: ClassVar = "floor"
    axes: ClassVar[tuple[Axis, ...]] = ("x", "y")

    def points(self, phase: PhaseMap) -> np.ndarray:
        """(h, w, 3) float32 mm: where the rig's own lenses put each phase; NaN where it is
        invalid."""
        row = self.axes.index(phase.axis)
        valid = phase.mask
        rays = directions_of(self.rig.camera.rays())[valid]
        measured = phase.coordinate[valid].astype(float)
        # In 1/z the coordinate is nearly linear, so that secants need few steps.
        nearer, inverse = np.full(len(rays), 1 / 500), np.full(len(rays), 1 / 700)
        off = before = self._project_depths(rays, nearer, row) - measured
        for _ in range(_STEPS):
            off = self._project_depths(rays, inverse, row) - measured
            going = np.abs(off) > _SETTLED_PX
            if not going.any():
                break
            with np.errstate(divide="ignore", invalid="ignore"):
                step = off * (inverse - nearer) / (off - before)
            nearer, before, inverse = inverse, off, inverse - np.where(going, step, 0)
        out = np.full((*phase.phase.shape, 3), np.nan, np.float32)
        solved = (np.abs(off) <= _SETTLED_PX) & (inverse > 0)
        out[valid] = np.where(solved, 1 / np.where(solved, inverse, 1), np.nan)[:, None] * rays
        return out

    def sigma_z(self, phase: PhaseMap, points: np.ndarray) -> np.ndarray:
        """(h, w) mm: depth noise predicted from the phase noise, ``|dz/dphi| sigma_phi``."""
        row = self.axes.index(phase.axis)
        X = np.asarray(points, float)
        moved = np.abs(self.rig.project(X * (1 + _NUDGE))[..., row] - self.rig.project(X)[..., row])
        with np.errstate(divide="ignore", invalid="ignore"):
            per_px = _NUDGE * X[..., 2] / moved
        return (per_px * phase.period_px / (2 * np.pi) * phase.sigma_phase).astype(np.float32)

    def _project_depths(self, rays: np.ndarray, inverse: np.ndarray, row: int) -> np.ndarray:
        """Projector coordinate (n,) px, of one row, of points on the rays (n, 3) at inverse depths
        (n,) 1/mm."""
        with np.errstate(divide="ignore"):
            return np.asarray(self.rig.project(rays / inverse[:, None])[:, row])
