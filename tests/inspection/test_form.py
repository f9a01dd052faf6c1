"""Form, orientation, position and profile against constructed truth."""

import numpy as np
import pytest
from facts import raises

from slviewer.errors import InputError
from slviewer.geometry.shapes import fit_sphere
from slviewer.inspection.features import Feature
from slviewer.inspection.fitting import fit_feature
from slviewer.inspection.form import form_error, orientation_error, position_error, profile_error
from slviewer.inspection.tolerance import judge_limits
from slviewer.records.measurement import Quantity
from tests.proofs.plan import CASES

pytestmark = pytest.mark.computes

N, NOISE = 3000, 0.02


def plate(
    seed: int, bow: float = 0.0, slope: float = 0.0, noise: float = NOISE, upright: bool = False
) -> np.ndarray:
    """A plate of 40 x 40 mm, bowed by so much from its middle to its corners."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-20, 20, (N, 3))
    u, v = points[:, 0].copy(), points[:, 1].copy()
    points[:, 2] = bow * (u**2 + v**2) / 800 + slope * u + noise * rng.normal(size=N)
    return points[:, [2, 0, 1]] if upright else points


def cylinder(seed: int, lobes: float, noise: float = NOISE, tilt: float = 0.0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    t, h = rng.uniform(-np.pi, np.pi, N), rng.uniform(-15, 15, N)
    r = 10 + lobes * np.cos(3 * t) + noise * rng.normal(size=N)
    return np.stack([r * np.cos(t) + tilt * h, r * np.sin(t), h], 1)


def assert_covers(q: Quantity, truth: float, widest: float) -> None:
    """3 sigma (1.5 U) must cover the truth, and U must not be useless."""
    assert q.U is not None and 0 < q.U < widest
    assert abs(q.value - truth) < 1.5 * q.U


def test_flatness_is_the_bow_and_not_the_noise() -> None:
    points = plate(1, bow=0.1)
    raw = np.ptp(fit_feature("plane", points).feature.distance(points))
    q = form_error("flatness", fit_feature("plane", points), points)
    assert_covers(q, 0.1, 0.03)
    assert raw > 0.18
    flat = form_error("flatness", fit_feature("plane", plate(2)), plate(2))
    assert_covers(flat, 0.0, 0.03)
    assert flat.value < NOISE


def test_lobes_are_roundness_and_cylindricity() -> None:
    points = cylinder(3, 0.05)
    fit = fit_feature("cylinder", points)
    assert_covers(form_error("cylindricity", fit, points), 0.1, 0.03)
    assert_covers(form_error("roundness", fit, points), 0.1, 0.03)
    with raises(InputError, "cylinder", "flatness", "plane"):
        form_error("flatness", fit, points)


def test_a_tilted_plate_is_out_of_parallel_by_its_rise() -> None:
    below = fit_feature("plane", plate(5))
    tilted, side = plate(6, slope=0.002), plate(7, slope=0.002, upright=True)
    assert_covers(
        orientation_error("parallelism", fit_feature("plane", tilted), tilted, below), 0.08, 0.03
    )
    # the side leans along the datum alone, so that it is out of square only by its rise along the
    # datum's normal
    upright = orientation_error("perpendicularity", fit_feature("plane", side), side, below)
    assert upright.U is not None and upright.value < 0.05
    with raises(InputError, "degrees", "parallelism"):
        orientation_error("parallelism", fit_feature("plane", side), side, below)


def test_an_axis_is_out_of_square_by_its_lean() -> None:
    points = cylinder(8, 0.0, tilt=0.004)
    q = orientation_error(
        "perpendicularity", fit_feature("cylinder", points), points, fit_feature("plane", plate(9))
    )
    assert_covers(q, 0.004 * 30, 0.03)


def directions(rng: np.random.Generator, angle: float) -> np.ndarray:
    """Unit vectors (N, 3), evenly over the cap of this half angle (rad) about z."""
    c, t = rng.uniform(np.cos(angle), 1, N), rng.uniform(0, 2 * np.pi, N)
    return np.stack([np.sqrt(1 - c**2) * np.cos(t), np.sqrt(1 - c**2) * np.sin(t), c], 1)


def test_position_is_the_diameter_of_the_zone() -> None:
    rng = np.random.default_rng(10)
    out = directions(rng, 1.0)
    points = (10 + NOISE * rng.normal(size=(N, 1))) * out + [0.03, 0.02, 0.01]
    q = position_error(
        fit_feature("sphere", points), points, Feature("sphere", np.zeros(3), None, 10.0)
    )
    assert_covers(q, 2 * np.linalg.norm([0.03, 0.02, 0.01]), 0.015)


@pytest.mark.parametrize("seed", range(8))
def test_a_dent_that_moves_a_dome_is_within_the_uncertainty_of_its_position(seed: int) -> None:
    rng = np.random.default_rng([14, seed])
    out = directions(rng, np.pi / 2)
    off = np.arccos(np.clip(out @ out[0], -1, 1))
    depth = rng.uniform(2, 3.5) * np.exp(-((off / rng.uniform(0.08, 0.12)) ** 2))
    true = 2 * float(np.linalg.norm(fit_sphere((10 - depth[:, None]) * out).centre))
    points = (10 - depth[:, None] + NOISE * rng.normal(size=(N, 1))) * out
    nominal = Feature("sphere", np.zeros(3), None, 10.0)
    q = position_error(fit_feature("sphere", points), points, nominal)
    assert q.U is not None and abs(true - q.value) < 0.7 * q.U
    assert q.value + q.U < 4 * true


def test_position_of_an_axis_is_that_of_its_ends() -> None:
    points = cylinder(8, 0.0, tilt=0.004)
    fit = fit_feature("cylinder", points)
    nominal = Feature("cylinder", np.zeros(3), np.array([0.0, 0.0, 1.0]), fit.feature.radius)
    ends = np.abs(points[:, 2]).max()
    assert_covers(position_error(fit, points, nominal), 2 * 0.004 * ends, 0.03)


def test_profile_is_twice_the_largest_deviation() -> None:
    points = plate(11, bow=0.1)
    nominal = Feature("plane", np.zeros(3), np.array([0.0, 0.0, 1.0]))
    assert_covers(
        profile_error(points, nominal.distance(points), nominal.normals(points)), 0.2, 0.06
    )


def test_a_dent_too_fine_for_the_smooth_part_widens_the_uncertainty() -> None:
    points = plate(12)
    fit = fit_feature("plane", points)
    known = form_error("flatness", fit, points).U
    points[np.linalg.norm(points[:, :2] - [5, 5], axis=1) < 3.0, 2] -= 0.08
    dented = form_error("flatness", fit_feature("plane", points), points)
    assert known is not None and dented.U is not None
    assert 1.5 * known < dented.U
    assert dented.value + dented.U > 0.07


def test_too_few_points_are_refused() -> None:
    points = plate(13)[:100]
    with raises(InputError, "100 measured points"):
        form_error("flatness", fit_feature("plane", points), points)


@pytest.mark.parametrize(
    ("value", "decision"),
    [(5.0, "pass"), (5.95, "undecided"), (6.05, "undecided"), (6.2, "fail"), (3.8, "fail")],
)
def test_limits_are_decided_with_a_guard_band(value: float, decision: str) -> None:
    assert judge_limits(value, 0.1, 4.0, 6.0) == decision
    assert judge_limits(float("nan"), 0.1, 4.0, 6.0) == "undecided"


@pytest.mark.slow
@pytest.mark.parametrize(
    "kind", ["flatness", "roundness", "cylindricity", "parallelism", "position", "profile"]
)
def test_uncertainty_covers_the_truth_of_drawn_parts(kind: str) -> None:
    cases = [CASES[kind](40, np.random.default_rng([77, i])) for i in range(30)]
    errors = np.array([(q.value - truth) / (q.U or np.inf) for truth, q in cases])
    assert np.mean(np.abs(errors) <= 1) >= 0.8  # 95 % of 30, less five standard deviations
    assert 0.25 < np.sqrt(np.mean(errors**2)) < 0.85  # half of U is one standard deviation


def test_dense_and_sparse_parts_of_a_region_weigh_by_area() -> None:
    rng = np.random.default_rng(3)
    u, v = rng.uniform(-20, 20, (2, 6000))
    kept = (u < 0) | (rng.uniform(size=6000) < 0.2)  # five times as many points on the left
    u, v = u[kept], v[kept]
    points = np.column_stack([u, v, 0.05 * (u / 20) ** 2 + 0.002 * rng.normal(size=len(u))])
    q = form_error("flatness", fit_feature("plane", points), points)
    assert abs(q.value - 0.05) < 0.004
