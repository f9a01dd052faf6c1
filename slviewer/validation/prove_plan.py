"""Whether the uncertainty of each tolerance of a plan covers the truth, on synthesised clouds of known noise."""

from collections.abc import Callable

import numpy as np

from slviewer.inspection.features import Feature
from slviewer.inspection.fitting import fit_feature
from slviewer.inspection.form import form_error, orientation_error, position_error, profile_error
from slviewer.inspection.quantities import Quantity
from slviewer.pipeline.feedback import Progress, ignore_progress
from slviewer.validation.proof import BandCheck, Proof, prove_checks

REPEATS = 200
NOISE_MM = 0.02
BAND = (93.0, 97.0)
"""Percent of the repeats in which U (k = 2) must cover the truth."""
POINTS = 3000
CENTRE = np.array([0.03, 0.02, 0.01])
Clouds = tuple[np.ndarray, ...]


def prove_plan(
    scale: float = 1.0, *, repeats: int = REPEATS, seed: int = 0, progress: Progress = ignore_progress
) -> Proof:
    """Measure parts of known form repeatedly, with new noise along the surface's normals; compare U with the errors.

    ``scale``: as a share of the number of points along each direction. Real scans have errors of the calibration too,
    of which `prove --only uncertainty` judges the prediction.
    """
    n = int(POINTS * max(scale, 0.7) ** 2)
    rows, checks = [], []
    for k, (kind, (truth, make, measure)) in enumerate(CASES.items()):
        progress(k / len(CASES), kind)
        quantities = [measure(make(n, np.random.default_rng([seed, k, i]))) for i in range(repeats)]
        errors = np.array([q.value - truth for q in quantities])
        U = np.array([q.U or 0.0 for q in quantities])
        covered = 100 * float(np.mean(np.abs(errors) <= U))
        checks.append(BandCheck(kind, f"% of {repeats} repeats covered by U (k = 2)", covered, *BAND))
        rows.append(
            {
                "characteristic": kind,
                "true mm": round(truth, 4),
                "mean error mm": round(float(errors.mean()), 4),
                "std. dev. mm": round(float(errors.std()), 4),
                "U / 2 mm": round(float(U.mean()) / 2, 4),
                "covered %": round(covered, 1),
            }
        )
    progress(1.0, "proven")
    record = {"noise_mm": NOISE_MM, "points": n, "repeats": repeats, "rows": rows}
    return prove_checks(checks, scale, rows, record)


def make_bowed_plate(n: int, rng: np.random.Generator, noise: float = NOISE_MM) -> Clouds:
    """A plate of 40 x 40 mm that rises by 0.1 mm from its middle to its corners."""
    points = rng.uniform(-20, 20, (n, 3))
    u, v = points[:, 0] / 20, points[:, 1] / 20
    points[:, 2] = 0.05 * (u**2 + v**2) + noise * rng.normal(size=n)
    return (points,)


def make_tilted_plate(n: int, rng: np.random.Generator) -> Clouds:
    """A plate that rises by 0.08 mm along x, and a level one below it."""
    upper, lower = rng.uniform(-20, 20, (2, n, 3))
    upper[:, 2] = 0.002 * upper[:, 0] + NOISE_MM * rng.normal(size=n)
    lower[:, 2] = -20 + NOISE_MM * rng.normal(size=n)
    return upper, lower


def make_leaning_wall(n: int, rng: np.random.Generator) -> Clouds:
    """A wall that leans by 0.08 mm over 40 mm, and a level plate below it."""
    upper, lower = make_tilted_plate(n, rng)
    return upper[:, [2, 1, 0]], lower[:, [0, 1, 2]]


def make_lobed_cylinder(n: int, rng: np.random.Generator, noise: float = NOISE_MM) -> Clouds:
    """A cylinder of radius 10 mm and length 30 mm with three lobes of 0.05 mm, which grow towards one end."""
    t, h = rng.uniform(-np.pi, np.pi, n), rng.uniform(-15, 15, n)
    r = 10 + 0.05 * (1 + h / 30) * np.cos(3 * t) + noise * rng.normal(size=n)
    return (np.stack([r * np.cos(t), r * np.sin(t), h], axis=1),)


def make_sphere(n: int, rng: np.random.Generator) -> Clouds:
    """A cap of a sphere of radius 10 mm about `CENTRE`."""
    c, t = rng.uniform(np.cos(1.0), 1, n), rng.uniform(0, 2 * np.pi, n)
    q = np.sqrt(1 - c * c)
    out = np.stack([q * np.cos(t), q * np.sin(t), c], axis=1)
    return ((10 + NOISE_MM * rng.normal(size=(n, 1))) * out + CENTRE,)


def _flatness(clouds: Clouds) -> Quantity:
    """The flatness of the first cloud."""
    return form_error("flatness", fit_feature("plane", clouds[0]), clouds[0])


def _roundness(clouds: Clouds) -> Quantity:
    """The roundness of the middle section of the first cloud, a cylinder."""
    return form_error("roundness", fit_feature("cylinder", clouds[0]), clouds[0])


def _cylindricity(clouds: Clouds) -> Quantity:
    """The cylindricity of the first cloud."""
    return form_error("cylindricity", fit_feature("cylinder", clouds[0]), clouds[0])


def _parallelism(clouds: Clouds) -> Quantity:
    """The parallelism of the first cloud to the second."""
    return orientation_error("parallelism", fit_feature("plane", clouds[0]), clouds[0], fit_feature("plane", clouds[1]))


def _perpendicularity(clouds: Clouds) -> Quantity:
    """The perpendicularity of the first cloud to the second."""
    return orientation_error(
        "perpendicularity", fit_feature("plane", clouds[0]), clouds[0], fit_feature("plane", clouds[1])
    )


def _position(clouds: Clouds) -> Quantity:
    """The position of the first cloud, a sphere, about the origin."""
    return position_error(fit_feature("sphere", clouds[0]), clouds[0], Feature("sphere", np.zeros(3), None, 10.0))


def _profile(clouds: Clouds) -> Quantity:
    """The profile of the first cloud against the plane z = 0."""
    nominal = Feature("plane", np.zeros(3), np.array([0.0, 0.0, 1.0]))
    return profile_error(clouds[0], nominal.distance(clouds[0]), nominal.normals(clouds[0]))


CASES: dict[str, tuple[float, Callable[[int, np.random.Generator], Clouds], Callable[[Clouds], Quantity]]] = {
    "flatness": (0.1, make_bowed_plate, _flatness),
    "roundness": (0.1, make_lobed_cylinder, _roundness),
    "cylindricity": (0.15, make_lobed_cylinder, _cylindricity),
    "parallelism": (0.08, make_tilted_plate, _parallelism),
    "perpendicularity": (0.08, make_leaning_wall, _perpendicularity),
    "position": (2 * float(np.linalg.norm(CENTRE)), make_sphere, _position),
    "profile": (0.2, make_bowed_plate, _profile),
}
"""Of each characteristic its true value, mm, a part that has it, and how it is measured."""
