"""Uncertainty of fitted parameters: from the points' scatter, and from the calibration, which all
fits share."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from slviewer.calibration.splined.bundle import Bundle
from slviewer.calibration.splined.uncertainty import (
    BestMotion,
    Volume,
    extrapolation_factor,
    view_pixels,
    working_volume,
)
from slviewer.fringe.sequence import Axis
from slviewer.geometry.polynomial import grid_points
from slviewer.geometry.rigid import Floats, Uncertainty, move_points
from slviewer.geometry.vectors import PATCHES, finite_rows, sum_by_cube
from slviewer.reconstruction.rig_change import PointResponse

Shared = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Called with points (m, 3) and how p parameters answer to their displacement (p, m, 3): (k, p),
whose product with itself is the parameters' covariance by errors that no averaging lessens. The k
of two calls are the same errors."""

DRAWS = 200
"""Of errors, where they are propagated by drawing them."""


@dataclass(frozen=True, eq=False)
class Spread:
    """Covariance of p parameters: ``scatter`` (p, p) of its own, and ``shared`` (k, p), the
    calibration's part, as ``Shared`` gives it; None where that is not known. ``calibration``: by
    whose errors; only one calibration's are the same. ``form`` (k, p): steps that are part of
    the scatter, by which the form of what was measured may shift the parameters, and noise does
    not."""

    scatter: Floats
    shared: Floats | None = None
    calibration: str = ""
    form: Floats | None = None

    @property
    def covariance(self) -> Floats:
        """(p, p): total covariance."""
        return self.scatter if self.shared is None else self.scatter + self.shared.T @ self.shared

    @property
    def noise(self) -> "Spread":
        """The spread without the form's part."""
        if self.form is None:
            return self
        return replace(self, scatter=self.scatter - self.form.T @ self.form, form=None)

    @property
    def whole(self) -> bool:
        """Whether the calibration's part is known."""
        return bool(self.calibration)

    @property
    def sigmas(self) -> Floats:
        """(p,): standard deviations."""
        return np.sqrt(np.diag(self.covariance))


@dataclass(frozen=True, eq=False)
class PointErrors:
    """What is known of the errors of a surface's points that their scatter does not show.

    ``shared``: those of the ``calibration`` of that name or hash; ``response``: how the points
    answer to changes of the rig; both where known.
    """

    shared: Shared | None = None
    calibration: str = ""
    response: PointResponse | None = None

    @property
    def is_predicted(self) -> bool:
        """Whether it is known by how much shapes miss the points beyond their scatter."""
        response = self.response
        return response is not None and (self.shared is not None or response.residual_px > 0)

    @property
    def raised(self) -> Shared | None:
        """``shared``, with what a misfit of the scan's axes adds to it."""
        shared, response = self.shared, self.response
        if response is None or response.misfit is None:
            return shared
        if shared is None:
            return response.raised
        return lambda points, answers: np.vstack(
            [shared(points, answers), response.raised(points, answers)]
        )

    @property
    def warnings(self) -> tuple[str, ...]:
        """What the scan's axes contradict in the calibration, in a sentence."""
        misfit = None if self.response is None else self.response.misfit
        return () if misfit is None else (misfit.text(),)

    def moved(self, T: Floats) -> "PointErrors":
        """Return the errors of the points moved by ``T`` (4, 4)."""
        shared, back = self.shared, np.linalg.inv(T).astype(np.float64)

        def moved(points: np.ndarray, answers: np.ndarray) -> np.ndarray:
            """Return ``shared`` of moved points and displacements."""
            assert shared is not None
            return shared(move_points(back, points), answers @ T[:3, :3])

        response = None if self.response is None else replace(self.response, T=T @ self.response.T)
        return replace(self, shared=None if shared is None else moved, response=response)


def draw_motions(motion: Uncertainty, rng: np.random.Generator) -> Callable[[Floats], Floats]:
    """Draw `DRAWS` motions of an uncertain pose; returns what displaces points (n, 3): (draws, n,
    3) mm."""
    steps = draw_steps(motion.covariance, rng)
    return lambda points: np.cross(steps[:, None, :3], points - motion.centre) + steps[:, None, 3:]


def joint_covariance(a: Spread, b: Spread) -> Floats:
    """(p + q, p + q): the covariance of two features' parameters; errors of a calibration that both
    have, are one."""
    p = len(a.scatter)
    whole = np.zeros((p + len(b.scatter),) * 2)
    whole[:p, :p], whole[p:, p:] = a.covariance, b.covariance
    if a.shared is not None and b.shared is not None and a.calibration == b.calibration:
        k = min(len(a.shared), len(b.shared))  # what a misfit adds to one of them comes last
        whole[:p, p:] = a.shared[:k].T @ b.shared[:k]
        whole[p:, :p] = whole[:p, p:].T
    return whole


def draw_steps(covariance: Floats, rng: np.random.Generator) -> Floats:
    """Draw `DRAWS` steps (draws, p) of parameters of a covariance (p, p)."""
    values, vectors = np.linalg.eigh(covariance)
    return rng.normal(size=(DRAWS, len(values))) * np.sqrt(np.maximum(values, 0)) @ vectors.T


def propagate_covariance(f: Callable[[Floats], float], covariance: Floats) -> float:
    """Return the standard deviation of f(step) at step 0, for steps (p,) of a covariance.

    Along each principal direction f is asked one standard deviation to both sides, which also holds
    where f has a kink there (an angle at zero, a distance at zero).
    """
    values, vectors = np.linalg.eigh(covariance)
    middle = f(np.zeros(len(values)))
    variance = 0.0
    for value, vector in zip(values, vectors.T, strict=True):
        step = np.sqrt(max(value, 0.0)) * vector
        variance += 0.5 * ((f(step) - middle) ** 2 + (f(-step) - middle) ** 2)
    return float(np.sqrt(variance))


def scatter_covariance(points: Floats, jacobian: Floats, residuals: Floats) -> Floats:
    """Return the covariance (p, p) of parameters fitted to points (n, 3) by least squares, from the
    fit's residuals.

    The residuals (n,) of one patch count together: form and smooth errors do not average out over
    neighbours as noise does. Never below what independent residuals would give.
    """
    n, p = jacobian.shape
    inverse = np.linalg.pinv(jacobian.T @ jacobian, hermitian=True)
    plain = inverse * float(residuals @ residuals) / max(n - p, 1)
    low = points.min(axis=0)
    side = max(float(np.ptp(points, axis=0).max()) / PATCHES, 1e-12)
    sums = sum_by_cube(jacobian * residuals[:, None], points - low, side)
    count = len(sums)
    if count <= 2 * p:
        return plain
    together = inverse @ (sums.T @ sums) @ inverse * count / (count - p)
    # elementwise larger standard deviations, with the correlations of the patches
    ratio = np.sqrt(np.maximum(np.diag(plain) / np.maximum(np.diag(together), 1e-300), 1.0))
    return together * np.outer(ratio, ratio)


def splined_shared(
    bundle: Bundle, axis: Axis, scale: float = 1.0, scale_sigma: float = 0.0
) -> Shared:
    """Return the function for the uncertainty that a splined calibration causes in points measured
    through one axis, without the rigid motion of the working volume, so that distances and angles
    are not affected by it; raised where the calibration's residuals exceed their noise.
    ``scale``: by what factor the points were enlarged after their reconstruction, and
    ``scale_sigma`` the standard uncertainty of that factor."""
    rig, raised = bundle.state.rig, bundle.noise.ratio["xy".index(axis)]
    reference = working_volume(rig, bundle.depth_range_mm, 7, 5, 4, bundle.area)
    motion = BestMotion.fit(reference.points)
    moved = motion.weights.T @ bundle.point_jacobian(axis, reference.pixels, reference.z).toarray()

    def shared(points: np.ndarray, answers: Floats) -> Floats:
        """Return (k, p): the calibration's part of the parameters' covariance, as its square
        root."""
        places = np.asarray(points, np.float64) / scale
        pixels = _pixels(bundle, places)
        jacobian = bundle.point_jacobian(axis, pixels, places[:, 2])
        jacobian.data[~np.isfinite(jacobian.data)] = 0.0
        volume = Volume(pixels, places[:, 2], *view_pixels(rig, pixels, places[:, 2]))
        weights = scale * raised * extrapolation_factor(bundle, volume)
        weighed = (answers * weights[:, None]).reshape(len(answers), -1)
        free = weighed @ jacobian - (weighed @ motion.displace(places)) @ moved
        larger = np.einsum("pni,ni->p", answers, scale_sigma * (places - motion.centre))
        return np.vstack([np.asarray(bundle.whiten(np.asarray(free)), np.float64), larger])

    return shared


def _pixels(bundle: Bundle, points: Floats) -> Floats:
    """Return the camera pixels (n, 2) of points (n, 3), by Newton steps on the rays of the
    pixels."""
    rig = bundle.state.rig
    width, height = (float(n) for n in rig.camera.size)
    # the rays of a coarse grid give a start that is linear in the normalised point
    grid = grid_points(np.linspace(0, width - 1, 9), np.linspace(0, height - 1, 7))
    rays = view_pixels(rig, grid, np.ones(len(grid)))[0]
    known = finite_rows(rays)
    linear = np.linalg.lstsq(rays[known], grid[known], rcond=None)[0]
    pixels = points / points[:, 2:] @ linear
    for _ in range(6):
        viewed = view_pixels(rig, pixels, points[:, 2])[0]
        wrong = np.nan_to_num(points - viewed) / points[:, 2:]
        pixels = pixels + wrong[:, :2] @ linear[:2]
    return pixels
