"""Distances and angles between features, and what is known of them."""

from dataclasses import replace

import numpy as np
import pytest

from slviewer.inspection.features import KINDS, MEANINGS, Feature, distance, relation
from slviewer.inspection.uncertainty import Spread, propagate_covariance

X, Y, Z = np.eye(3)
A, B = np.array([1.0, 2.0, 600.0]), np.array([31.0, 42.0, 600.0])


def spread(feature: Feature, sigma: float = 0.01) -> Spread:
    return Spread(sigma**2 * np.eye(feature.parameters))


def read(a: Feature, b: Feature) -> dict[str, float]:
    return {q.name: q.value for q in relation(a, spread(a), b, spread(b))}


point, ball = Feature("point", A), Feature("sphere", B, None, 10.0)
flat, other = Feature("plane", A, -Z), Feature("plane", B + 5 * Z, -Z)
rod = Feature("cylinder", B, X, 4.0)


def test_every_pair_of_kinds_has_its_meaning_in_either_order() -> None:
    made = {"point": point, "plane": flat, "sphere": ball, "cylinder": rod}
    for i, a in enumerate(KINDS):
        for b in KINDS[i:]:
            there, back = read(made[a], made[b]), read(made[b], made[a])
            assert there.keys() == {m.name for m in MEANINGS[a, b]} and there == pytest.approx(back)


def test_figures_that_can_be_told_by_hand() -> None:
    assert read(point, Feature("point", B)) == {"distance": 50.0}
    assert read(point, ball) == pytest.approx(
        {"distance from the centre": 50.0, "distance from the surface": 40.0}
    )
    assert read(Feature("point", A - 7 * Z), flat) == {"height": 7.0}
    assert read(flat, other) == pytest.approx({"angle": 0.0, "distance": 5.0})
    tilted = Feature("plane", B, -Z * np.cos(0.1) + X * np.sin(0.1))
    assert read(flat, tilted)["angle"] == pytest.approx(np.degrees(0.1))
    assert read(flat, ball) == pytest.approx({"height of the centre": 0.0, "gap": -10.0})
    assert read(flat, rod) == pytest.approx({"angle": 0.0, "height of the axis": 0.0})
    assert read(ball, Feature("sphere", A, None, 5.0)) == pytest.approx(
        {"distance of the centres": 50.0, "gap": 35.0}
    )
    assert read(point, rod) == pytest.approx(
        {"distance from the axis": 40.0, "distance from the surface": 36.0}
    )
    crossing = Feature("cylinder", B + 12 * Z + 99 * Y, Y, 3.0)
    assert read(rod, crossing) == pytest.approx({"angle": 90.0, "distance of the axes": 12.0})
    beside = Feature("cylinder", B + 9 * Y + 70 * X, X * np.cos(0.02) + Z * np.sin(0.02), 3.0)
    # in the middle of the regions
    assert read(rod, beside)["distance of the axes"] == pytest.approx(9.05, abs=0.06)


def test_a_distances_uncertainty_is_that_along_it() -> None:
    along = (B - A) / 50.0
    sure_across = Spread(0.05**2 * np.outer(along, along))
    none = Spread(np.zeros((3, 3)))
    found = distance(A, B, sure_across, none)
    assert found.value == pytest.approx(50.0) and found.sigma == pytest.approx(0.05)
    assert found.format() == "50.000 ± 0.100 mm*"  # without the calibration's part
    assert replace(found, whole=True).format() == "50.000 ± 0.100 mm"
    across = np.cross(along, Z)
    assert distance(A, B, Spread(0.05**2 * np.outer(across, across)), none).sigma < 1e-4


def test_what_one_calibration_leaves_uncertain_of_both_cancels() -> None:
    shift = 0.2 * np.eye(3)  # a rigid shift that both points share
    a, b = (Spread(1e-6 * np.eye(3), shift, "one") for _ in range(2))
    assert distance(A, B, a, b).sigma == pytest.approx(np.sqrt(2) * 1e-3, rel=1e-3)
    stranger = Spread(1e-6 * np.eye(3), shift, "another")
    assert distance(A, B, a, stranger).sigma == pytest.approx(0.2 * np.sqrt(2), rel=1e-2)
    raised = Spread(1e-6 * np.eye(3), np.vstack([shift, 0.3 * np.eye(3)]), "one")
    assert distance(A, B, a, raised).sigma == pytest.approx(0.3, rel=1e-2)  # what one scan adds


def test_an_angle_of_zero_has_an_uncertainty() -> None:
    found = relation(flat, spread(flat, 1e-3), other, spread(other, 1e-3))[0]
    assert found.value == pytest.approx(0.0, abs=1e-9) and 0.05 < found.sigma < 0.2  # degrees
    assert propagate_covariance(
        lambda step: float(np.linalg.norm(step)), np.diag([9.0, 0.0])
    ) == pytest.approx(3.0)
