"""What one cloud of an artefact says."""

from dataclasses import dataclass
from itertools import permutations

import numpy as np

from slviewer.evaluation.acceptance.artefact import Artefact
from slviewer.evaluation.acceptance.figures import AcceptanceFigure
from slviewer.evaluation.incidence import incidence
from slviewer.evaluation.plane import PlaneResult, evaluate_plane
from slviewer.evaluation.sphere import SphereResult, evaluate_spheres
from slviewer.geometry.vectors import unit_vectors
from slviewer.reconstruction.cloud import Cloud

FORM, SIZE, SPACING, FLATNESS = "probing error of form", "probing error of size", "sphere-spacing error", "flatness"


@dataclass(frozen=True)
class Position:
    """The figures of an artefact at one position.

    ``rms_mm`` and ``floor_mm``: RMS of the points' deviations and what noise alone would leave, one a ball or the
    plane's; ``noise_mm``: standard uncertainty of a length here by the cloud's noise alone; ``incidence``: percent in
    R1, R2, R3, or None without a depth range; ``warnings``: what was set aside.
    """

    position: str
    capture: str
    figures: tuple[AcceptanceFigure, ...]
    rms_mm: tuple[float, ...]
    floor_mm: tuple[float, ...]
    noise_mm: float
    points: int
    incidence: dict[str, float] | None
    warnings: tuple[str, ...]

    @property
    def properties(self) -> set[str]:
        """Names of the properties that were measured here."""
        return {figure.property for figure in self.figures}

    def error(self, name: str) -> AcceptanceFigure:
        """The worst figure of a property at this position."""
        return max((f for f in self.figures if f.property == name), key=lambda f: abs(f.error_mm))


def measure_artefact(
    artefact: Artefact,
    cloud: Cloud,
    position: str,
    capture: str,
    depth_range: tuple[float, float] | None = None,
    plate: np.ndarray | None = None,
) -> Position:
    """Measure the figures of one position. ``plate`` (h, w) bool: the plane's pixels, if these are known.

    Raises InputError where the artefact is not found in the cloud.
    """
    shown: list[PlaneResult] | list[SphereResult]
    noise = 0.0
    if artefact.kind == "plane":
        shown = [evaluate_plane(cloud.points, plate, cloud.sigma_z)]
        figures = [AcceptanceFigure.of_form(FLATNESS, position, shown[0].error_map, artefact.form_U_mm)]
    else:
        nominal = float(np.mean([diameter.mm for diameter in artefact.diameters])) / 2
        shown = evaluate_spheres(cloud.points, len(artefact.diameters), cloud.sigma_z, nominal)
        figures, noise = _measure_balls(artefact, cloud, shown, position)
    region = np.logical_or.reduce([np.isfinite(result.error_map) for result in shown])
    return Position(
        position,
        capture,
        tuple(figures),
        tuple(result.rms_mm for result in shown),
        tuple(result.noise_floor_mm for result in shown),
        noise,
        int(np.count_nonzero(region)),
        None if depth_range is None else incidence(cloud.points, region, depth_range),
        tuple(result.warning for result in shown if result.warning),
    )


def _measure_balls(
    artefact: Artefact, cloud: Cloud, balls: list[SphereResult], position: str
) -> tuple[list[AcceptanceFigure], float]:
    """The figures of one ball or two, and the noise of a length between their centres (of a diameter, for one)."""
    known = [artefact.at_measurement(diameter) for diameter in artefact.diameters]
    # the certificate's order says nothing of left and right: the balls' own sizes do
    sizes = np.array([2 * ball.radius_mm for ball in balls])
    known = list(min(permutations(known), key=lambda order: float(np.abs(sizes - [mm for mm, _ in order]).sum())))
    spreads = [_fit_covariance(cloud.points, ball) for ball in balls]
    figures = []
    for ball, (diameter, u), spread in zip(balls, known, spreads, strict=True):
        figures.append(AcceptanceFigure.of_form(FORM, position, ball.error_map, artefact.form_U_mm))
        u_size = float(np.hypot(u, 2 * np.sqrt(spread[3, 3])))
        figures.append(AcceptanceFigure.of_length(SIZE, position, 2 * ball.radius_mm - diameter, u_size))
    if artefact.spacing is None:
        return figures, float(2 * np.sqrt(spreads[0][3, 3]))
    between = balls[1].sphere.centre - balls[0].sphere.centre
    length = float(np.linalg.norm(between))
    along = between / length
    noise = float(np.sqrt(sum(along @ spread[:3, :3] @ along for spread in spreads)))
    true, u = artefact.at_measurement(artefact.spacing)
    figures.append(AcceptanceFigure.of_length(SPACING, position, length - true, float(np.hypot(u, noise))))
    return figures, noise


def _fit_covariance(points: np.ndarray, ball: SphereResult) -> np.ndarray:
    """(4, 4) mm^2 of centre and radius, from the scatter of the points about the sphere."""
    offsets = points[ball.inliers].astype(np.float64) - ball.sphere.centre
    J = np.column_stack([unit_vectors(offsets), np.ones(len(offsets))])
    return ball.rms_mm**2 * np.linalg.inv(J.T @ J)
