"""What changes of a rig after its calibration do to measured points, and what misfits say of them.

A focus ring that was touched, or a device that was knocked, moves all points by a smooth field that
neither noise nor the calibration's own uncertainty holds. A misfit, of the axes or of a known
shape, says how large each change may have been; so large it is part of the uncertainty.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal

import cv2
import numpy as np

from slviewer.calibration.splined.uncertainty import BestMotion
from slviewer.geometry.lens import Lens
from slviewer.geometry.rig import StereoRig
from slviewer.geometry.rigid import Floats, move_points
from slviewer.geometry.triangulation import triangulate_pixels
from slviewer.geometry.vectors import subsample
from slviewer.reconstruction.cloud import Cloud, Misfit, number_tiles

SIZES = np.array([5e-3, 5e-3, 1e-3, 1e-3, 1e-3, 0.1, 0.1, 0.1])
"""Standard deviations of changes that occur: the focal lengths of camera and projector (share), the
projector's turn about its axes (rad), its shift along them (mm)."""
CHANGES = len(SIZES)
MAX_REFERENCE_POINTS, LEAST_REFERENCE_POINTS = 400, 3
"""Points of a scan, whose common motion is not an error."""
EXPLAINED = 0.5
"""Share of the squares of a misfit, above which a change explains it."""
MAX_TIMES = 5.0
"""Times the smallest change that explains a misfit, in units of `SIZES`: what takes a larger one
is not what occurred."""


def change_rig(rig: StereoRig, change: Floats) -> StereoRig:
    """Return the rig after a change (8,), in units of `SIZES`."""
    step = SIZES * change
    camera, projector = (
        Lens(lens.K @ np.diag([1 + longer, 1 + longer, 1]), lens.D, lens.size)
        for lens, longer in ((rig.camera, step[0]), (rig.projector, step[1]))
    )
    return StereoRig(camera, projector, cv2.Rodrigues(step[2:5])[0] @ rig.R, rig.t + step[5:])


def differentiate(rig: StereoRig, measure: Callable[[StereoRig], Floats]) -> Floats:
    """Return how what ``measure`` returns of a rig, (...), changes with each of `SIZES`,
    (..., 8)."""
    units = np.eye(CHANGES)
    changes = [measure(change_rig(rig, unit)) - measure(change_rig(rig, -unit)) for unit in units]
    return np.stack(changes, axis=-1) / 2


def bound_change(effects: Floats, misfit: Floats, sigma: Floats) -> Floats:
    """Return the root mean square (8,) that each of `SIZES` may have, alone, by a ``misfit`` (n,)
    of noise ``sigma`` (n,) and its ``effects`` (n, 8): its estimate, and what that leaves open.
    What it does not explain counts as noise."""
    A, b = effects / sigma[:, None], misfit / sigma
    squares = np.maximum(np.sum(A**2, axis=0), 1e-300)
    alone = A.T @ b / squares
    noise = np.maximum(1.0, np.sqrt(np.mean((b[:, None] - A * alone) ** 2, axis=0)))
    information, sizes = squares / noise**2, np.abs(alone)
    explains = noise**2 < (1 - EXPLAINED) * np.mean(b**2)
    limit = MAX_TIMES * (sizes[explains].min() if explains.any() else 1.0)
    seen = np.where(sizes <= limit, sizes * information / (1 + information), 0.0)
    largest = min(1.0, 2.0 * float(seen.max())) or 1.0  # of changes that are not seen
    return np.hypot(seen, largest / np.sqrt(1 + information))


@dataclass(frozen=True, eq=False)
class PointResponse:
    """How points measured through one ``axis`` of a ``rig`` answer to its changes, apart from the
    common motion of ``reference`` (m, 3) mm, points of the scan in the camera's frame.

    The points are enlarged by ``scale`` and moved by ``T`` (4, 4) from the camera's frame.
    ``residual_px``: by how much the calibration's own poses miss it beyond noise.
    """

    rig: StereoRig
    axis: Literal["x", "y"]
    reference: Floats
    scale: float = 1.0
    residual_px: float = 0.0
    misfit: Misfit | None = None
    T: Floats = field(default_factory=lambda: np.eye(4))

    @classmethod
    def from_cloud(
        cls, cloud: Cloud, rig: StereoRig, residual_px: float, scale: float
    ) -> "PointResponse | None":
        """Return the response of a cloud's points, enlarged by ``scale``; None for too few."""
        reference = subsample(cloud.measured, MAX_REFERENCE_POINTS).astype(np.float64) / scale
        if len(reference) < LEAST_REFERENCE_POINTS:
            return None
        return cls(rig, cloud.axis, reference, scale, residual_px, cloud.misfit)

    def by_change(self, points: Floats) -> Floats:
        """(n, 3, 8) mm: displacements of points (n, 3) mm by each of `SIZES`; 0 where the projector
        does not see them."""
        places = self._place(points)
        common = BestMotion.fit(self.reference).displace(places) @ self._motion
        apart = self._displace(places) - common.reshape(-1, 3, CHANGES)
        return np.einsum("ij,njk->nik", self.scale * self.T[:3, :3], np.nan_to_num(apart))

    def by_px(self, points: Floats) -> Floats:
        """(n, 3) mm: displacements of points (n, 3) mm by 1 px of the measured coordinate."""
        pixels, coordinate = self._view(self._place(points))
        ends = (
            triangulate_pixels(self.rig, pixels, coordinate + half, self.axis)
            for half in (0.5, -0.5)
        )
        up, down = ends
        return np.nan_to_num(up - down) @ (self.scale * self.T[:3, :3]).T

    def raised(self, points: np.ndarray, answers: Floats) -> Floats:
        """Return (k, p) as `inspection.uncertainty.Shared`: what the misfit of the axes adds to the
        uncertainty of p parameters that answer to displacements by ``answers`` (p, n, 3)."""
        assert self.misfit is not None
        points = np.asarray(points, np.float64)
        if self.misfit.change is not None:
            effects = np.einsum("pni,nik->kp", answers, self.by_change(points))
            return self.misfit.change[:, None] * effects
        pixels, _ = self._view(self._place(points))
        excess = self.misfit.excess_px
        tile = number_tiles(pixels, self.rig.camera.size, excess.shape)
        each = np.einsum("pni,ni->np", answers, self.by_px(points)) * excess.flat[tile][:, None]
        rows = np.zeros((excess.size, len(answers)))
        np.add.at(rows, tile, each)
        return rows

    @cached_property
    def _motion(self) -> Floats:
        """(6, 8): the common motion by each of `SIZES`."""
        displaced = np.nan_to_num(self._displace(self.reference)).reshape(-1, CHANGES)
        return BestMotion.fit(self.reference).weights.T @ displaced

    def _place(self, points: Floats) -> Floats:
        """Return points (n, 3) mm in the camera's frame, as they were before they were enlarged."""
        return move_points(np.linalg.inv(self.T).astype(np.float64), points) / self.scale

    def _view(self, places: Floats) -> tuple[Floats, Floats]:
        """Return camera pixels (n, 2) and measured coordinate (n,) px of places (n, 3)."""
        return self.rig.camera.project(places), self.rig.project(places)[:, "xy".index(self.axis)]

    def _displace(self, places: Floats) -> Floats:
        """(n, 3, 8) mm: displacements of places (n, 3) in the camera's frame."""
        pixels, coordinate = self._view(places)
        return differentiate(
            self.rig, lambda rig: triangulate_pixels(rig, pixels, coordinate, self.axis)
        )
