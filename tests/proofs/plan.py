"""Whether the uncertainty of each tolerance of a plan covers the truth, on synthesised clouds of
known noise.

Every repeat is another part: its form is drawn anew, of all wavelengths that a region resolves, as
machining leaves it.
"""

from collections.abc import Callable
from functools import partial

import numpy as np
from numpy.polynomial import legendre

from slviewer.inspection.features import Feature
from slviewer.inspection.fitting import fit_feature
from slviewer.inspection.form import (
    OrientationKind,
    form_error,
    orientation_error,
    position_error,
    profile_error,
)
from slviewer.pipeline.operation import Progress, track
from slviewer.records.measurement import Quantity
from tests.proofs.proof import BandCheck, Proof, prove_checks

REPEATS = 200
NOISE_MM = 0.02
BAND = (93.0, 97.0)
"""Percent of the repeats in which U (k = 2) must cover the truth, give or take the standard
deviation that so many repeats have."""
SIDE = 55
"""Points along either direction of a region, in a grid as a camera sees them."""
FORM_MM, DECAY = 0.03, 0.7
"""Of the drawn form: standard deviation of its coarsest components, and the ratio from one degree
to the next."""
DEGREES = range(2, 7)
TILT = 0.002
RADIUS, HALF = 10.0, 15.0
Case = tuple[float, Quantity]
Rng = np.random.Generator


def prove_plan(scale: float, seed: int, progress: Progress) -> Proof:
    """Measure parts of known form repeatedly, with new noise along the surface's normals; compare U
    with the errors.

    ``scale``: as a share of the number of points along each direction, at least 0.7. Real scans
    have errors of the calibration too, of which the proof of uncertainty judges the prediction.
    """
    side = int(SIDE * max(scale, 0.7))
    rows, checks = [], []
    for k, (kind, measure, _) in enumerate(track(progress, CASES)):
        cases = [measure(side, np.random.default_rng([seed, k, i])) for i in range(REPEATS)]
        truths, values, U = np.array([(truth, q.value, q.U or 0.0) for truth, q in cases]).T
        errors = values - truths
        covered = 100 * float(np.mean(np.abs(errors) <= U))
        chance = 100 * float(np.sqrt(0.95 * 0.05 / REPEATS))
        least, most = BAND[0] - chance, BAND[1] + chance
        what = f"% of {REPEATS} repeats covered by U (k = 2)"
        checks.append(BandCheck(kind, what, covered, least, most))
        figures = {
            "mean true mm": truths.mean(),
            "mean error mm": errors.mean(),
            "std. dev. mm": errors.std(),
            "U / 2 mm": U.mean() / 2,
        }
        rounded = {title: round(float(value), 4) for title, value in figures.items()}
        rows.append({"characteristic": kind, **rounded, "covered %": round(covered, 1)})
    record = {"noise_mm": NOISE_MM, "points": side**2, "repeats": REPEATS, "rows": rows}
    return prove_checks(checks, scale, rows, record)


def draw_form(rng: Rng) -> np.ndarray:
    """Draw the coefficients (7, 7) of a form, mm: of degrees `DEGREES` in sum, decaying with the
    degree."""
    degree = np.add.outer(np.arange(7), np.arange(7))
    amplitude = FORM_MM * DECAY ** (degree - DEGREES[0]) * rng.normal(size=degree.shape)
    return np.where(np.isin(degree, DEGREES), amplitude, 0.0)


def make_grid(side: int) -> np.ndarray:
    """Coordinates (side^2, 2) of a grid in -1 to 1."""
    along = (np.arange(side) + 0.5) / side * 2 - 1
    return np.stack(np.meshgrid(along, along), axis=-1).reshape(-1, 2)


def remove_fit(values: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Values (n,) without what columns (n, p) explain of them by least squares."""
    return np.asarray(values - columns @ np.linalg.lstsq(columns, values, rcond=None)[0])


def make_plate(side: int, rng: Rng, tilt: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Points (n, 3) of a plate of 40 x 40 mm with drawn form, which rises by ``tilt`` along x, and
    its true heights."""
    uv = make_grid(side)
    heights = legendre.legval2d(uv[:, 0], uv[:, 1], draw_form(rng)) + 20 * tilt * uv[:, 0]
    return np.column_stack([20 * uv, heights + NOISE_MM * rng.normal(size=len(uv))]), heights


def make_cylinder(uv: np.ndarray, form: np.ndarray, rng: Rng) -> np.ndarray:
    """Points (n, 3) of a cylinder at places ``uv`` (n, 2), around it and along it, -1 to 1, with
    deviations ``form`` (n,)."""
    angles = np.pi * uv[:, 0]
    r = RADIUS + form + NOISE_MM * rng.normal(size=len(uv))
    return np.stack([r * np.cos(angles), r * np.sin(angles), HALF * uv[:, 1]], axis=1)


def _flatness(side: int, rng: Rng) -> Case:
    """The flatness of a plate."""
    points, heights = make_plate(side, rng)
    truth = np.ptp(remove_fit(heights, np.column_stack([points[:, :2], np.ones(len(points))])))
    return float(truth), form_error("flatness", fit_feature("plane", points), points)


def _roundness(side: int, rng: Rng) -> Case:
    """The roundness of a thin ring, which has the form of one section."""
    uv, form = make_grid(side), np.zeros(side**2)
    harmonics, amplitudes = np.arange(2, 7), FORM_MM * DECAY ** np.arange(5)
    for wave in (np.cos, np.sin):
        waves = wave(np.outer(np.pi * uv[:, 0], harmonics))
        form += waves @ (amplitudes * rng.normal(size=5))
    points = make_cylinder(uv, form, rng)
    return float(np.ptp(form)), form_error("roundness", fit_feature("cylinder", points), points)


def _cylindricity(side: int, rng: Rng) -> Case:
    """The cylindricity of a cylinder, whose waves about its axis change along it."""
    uv, form = make_grid(side), np.zeros(side**2)
    along = legendre.legvander(uv[:, 1], 6)
    for wave in (np.cos, np.sin):
        waves = wave(np.outer(np.pi * uv[:, 0], np.arange(7)))
        form += np.einsum("nk,km,nm->n", waves, draw_form(rng), along)
    points = make_cylinder(uv, form, rng)
    c, s, h = np.cos(np.pi * uv[:, 0]), np.sin(np.pi * uv[:, 0]), uv[:, 1]
    truth = np.ptp(remove_fit(form, np.column_stack([np.ones(len(c)), c, s, h * c, h * s])))
    return float(truth), form_error("cylindricity", fit_feature("cylinder", points), points)


def _orientation(side: int, rng: Rng, kind: OrientationKind) -> Case:
    """The parallelism of a tilted plate, or the perpendicularity of a leaning wall, to a plate
    without form."""
    points, heights = make_plate(side, rng, TILT)
    datum = np.column_stack([20 * make_grid(side), -20 + NOISE_MM * rng.normal(size=len(points))])
    if kind == "perpendicularity":
        points = points[:, [2, 1, 0]]
    fit, flat = fit_feature("plane", points), fit_feature("plane", datum)
    return float(np.ptp(heights)), orientation_error(kind, fit, points, flat)


def _position(side: int, rng: Rng) -> Case:
    """The position of a cap of a sphere about a drawn centre, against the origin."""
    c, t = rng.uniform(np.cos(1.0), 1, side**2), rng.uniform(0, 2 * np.pi, side**2)
    q = np.sqrt(1 - c * c)
    out = np.stack([q * np.cos(t), q * np.sin(t), c], axis=1)
    centre = 0.03 * rng.normal(size=3)
    points = (RADIUS + NOISE_MM * rng.normal(size=(len(c), 1))) * out + centre
    nominal = Feature("sphere", np.zeros(3), None, RADIUS)
    return 2 * float(np.linalg.norm(centre)), position_error(
        fit_feature("sphere", points), points, nominal
    )


def _profile(side: int, rng: Rng) -> Case:
    """The profile of a plate against the plane z = 0."""
    points, heights = make_plate(side, rng)
    nominal = Feature("plane", np.zeros(3), np.array([0.0, 0.0, 1.0]))
    return 2 * float(np.abs(heights).max()), profile_error(
        points, nominal.distance(points), nominal.normals(points)
    )


CASES: dict[str, Callable[[int, Rng], Case]] = {
    "flatness": _flatness,
    "roundness": _roundness,
    "cylindricity": _cylindricity,
    "parallelism": partial(_orientation, kind="parallelism"),
    "perpendicularity": partial(_orientation, kind="perpendicularity"),
    "position": _position,
    "profile": _profile,
}
"""Of each characteristic: measure a part that is drawn; returns its true value, mm, and what was
measured."""
