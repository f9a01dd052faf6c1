"""What one cloud of an artefact says."""

from itertools import permutations

import numpy as np

from slviewer.evaluation.acceptance.artefact import Artefact
from slviewer.evaluation.acceptance.figures import make_form_error, make_length_error
from slviewer.evaluation.fit import ShapeResult, evaluate_plane, evaluate_spheres
from slviewer.evaluation.incidence import incidence
from slviewer.geometry.vectors import unit_vectors
from slviewer.reconstruction.cloud import Cloud
from slviewer.records.acceptance import PositionErrors, PropertyError

FORM, SIZE, SPACING, FLATNESS = (
    "probing error of form",
    "probing error of size",
    "sphere-spacing error",
    "flatness",
)


def measure_artefact(
    artefact: Artefact,
    cloud: Cloud,
    position: str,
    capture: str,
    depth_range: tuple[float, float] | None = None,
    plate: np.ndarray | None = None,
) -> PositionErrors:
    """Measure the figures of one position. ``plate`` (h, w) bool: the plane's pixels, if these are
    known.

    Raises InputError where the artefact is not found in the cloud.
    """
    noise = 0.0
    if artefact.kind == "plane":
        shown = [evaluate_plane(cloud.points, plate, cloud.sigma_z)]
        figures = [make_form_error(FLATNESS, position, shown[0].error_map, artefact.form_U_mm)]
    else:
        nominal = float(np.mean([diameter.mm for diameter in artefact.diameters])) / 2
        shown = evaluate_spheres(cloud.points, len(artefact.diameters), cloud.sigma_z, nominal)
        figures, noise = _measure_balls(artefact, cloud, shown, position)
    region = np.logical_or.reduce([np.isfinite(result.error_map) for result in shown])
    return PositionErrors(
        position=position,
        capture=capture,
        figures=figures,
        rms_mm=[result.rms_mm for result in shown],
        floor_mm=[
            None if np.isnan(result.noise_floor_mm) else result.noise_floor_mm for result in shown
        ],
        points=int(np.count_nonzero(region)),
        noise_mm=noise,
        incidence=None if depth_range is None else incidence(cloud.points, region, depth_range),
        warnings=[result.warning for result in shown if result.warning],
    )


def _measure_balls(
    artefact: Artefact, cloud: Cloud, balls: list[ShapeResult], position: str
) -> tuple[list[PropertyError], float]:
    """The figures of one ball or two, and the noise of a length between their centres (of a
    diameter, for one)."""
    known = [artefact.at_measurement(diameter) for diameter in artefact.diameters]
    # the certificate's order says nothing of left and right: the balls' own sizes do
    sizes = np.array([2 * ball.radius_mm for ball in balls])
    known = list(
        min(
            permutations(known),
            key=lambda order: float(np.abs(sizes - [mm for mm, _ in order]).sum()),
        )
    )
    spreads = [_fit_covariance(cloud.points, ball) for ball in balls]
    figures = []
    for ball, (diameter, u), spread in zip(balls, known, spreads, strict=True):
        figures.append(make_form_error(FORM, position, ball.error_map, artefact.form_U_mm))
        u_size = float(np.hypot(u, 2 * np.sqrt(spread[3, 3])))
        figures.append(make_length_error(SIZE, position, 2 * ball.radius_mm - diameter, u_size))
    if artefact.spacing is None:
        return figures, float(2 * np.sqrt(spreads[0][3, 3]))
    between = balls[1].sphere.centre - balls[0].sphere.centre
    length = float(np.linalg.norm(between))
    along = between / length
    noise = float(np.sqrt(sum(along @ spread[:3, :3] @ along for spread in spreads)))
    true, u = artefact.at_measurement(artefact.spacing)
    figures.append(make_length_error(SPACING, position, length - true, float(np.hypot(u, noise))))
    return figures, noise


def _fit_covariance(points: np.ndarray, ball: ShapeResult) -> np.ndarray:
    """(4, 4) mm^2 of centre and radius, from the scatter of the points about the sphere."""
    offsets = points[ball.inliers].astype(np.float64) - ball.sphere.centre
    J = np.column_stack([unit_vectors(offsets), np.ones(len(offsets))])
    return ball.rms_mm**2 * np.linalg.inv(J.T @ J)
