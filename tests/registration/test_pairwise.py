"""Registration finds a known motion to hundredths of a millimetre, and refuses what it cannot
know."""

import re

import numpy as np
import pytest
from bumpy_scans import CENTRE, NOISE, Height, bumpy, error, motion, register, view
from facts import raises

from slviewer.errors import InputError, SlviewerError
from slviewer.registration.pairwise import Registration
from slviewer.registration.refusal import Refused
from slviewer.registration.scan import prepare_scan
from slviewer.registration.start import Candidate, fit_picked_start

pytestmark = pytest.mark.computes


@pytest.mark.parametrize(
    ("deg", "mm"), [pytest.param(1.0, 2.0, marks=pytest.mark.slow), (60.0, 150.0)]
)
def test_a_known_motion_is_found(deg: float, mm: float) -> None:
    T = motion(deg, mm)
    result = register(view(bumpy(2), (-45, 75), 1, T), view(bumpy(2), (-75, 45), 2))
    shift, turn = error(result, T)
    assert shift < 0.03
    assert turn < 0.02
    # both scans' noise, sqrt(2) times one's, on tilted surfaces
    assert 0.9 * NOISE < result.rms_mm < 1.6 * NOISE
    assert result.inlier_rmse_mm > 3 * result.rms_mm  # the spacing of the points is in it
    # 90 of 120 mm, less the points beyond the gate across steep slopes
    assert 0.68 < result.overlap < 0.78
    assert result.agreement > 0.98


@pytest.mark.parametrize("scale", [0.05, 50.0])
def test_an_object_of_another_size_is_registered_alike(scale: float) -> None:
    usual = register(*SCANS)
    other = register(*(scale * points for points in SCANS))
    assert other.T_reference_scan[:3, 3] == pytest.approx(
        scale * usual.T_reference_scan[:3, 3], abs=1e-4 * scale
    )
    figures = [
        (each.overlap, each.agreement, *(mm / size for mm in (each.rms_mm, each.gate_mm)))
        for each, size in ((usual, 1.0), (other, scale))
    ]
    assert figures[1] == pytest.approx(figures[0], rel=1e-3)


SCANS = view(bumpy(2), (-45, 75), 1, motion(10, 30)), view(bumpy(2), (-75, 45), 2)


@pytest.fixture(scope="module")
def registered() -> Registration:
    return register(*SCANS)


@pytest.mark.slow
def test_the_same_scans_give_the_same_pose(registered: Registration) -> None:
    np.testing.assert_allclose(
        register(*SCANS).T_reference_scan, registered.T_reference_scan, atol=1e-7
    )


@pytest.mark.slow
def test_the_pose_maps_scan_to_reference_and_back(registered: Registration) -> None:
    back = register(*SCANS[::-1])
    shift, turn = error(registered, np.linalg.inv(back.T_reference_scan))
    assert shift < 0.03
    assert turn < 0.02


@pytest.mark.slow
def test_a_third_of_overlap_is_enough() -> None:
    T = motion(10, 30)
    result = register(view(bumpy(2), (-15, 75), 1, T), view(bumpy(2), (-75, 15), 2))
    shift, turn = error(result, T)
    assert shift < 0.03
    assert turn < 0.03
    assert 0.28 < result.overlap < 0.38


@pytest.mark.parametrize("scale", [0.2, pytest.param(5.0, marks=pytest.mark.slow)])
def test_gates_follow_the_size_of_the_object(scale: float) -> None:
    T = motion(10, 30 * scale)
    scan = view(bumpy(2), (-45, 75), 1, T, scale=scale)
    result = register(scan, view(bumpy(2), (-75, 45), 2, scale=scale))
    shift, turn = error(result, T)
    assert shift < 0.03 * scale
    assert turn < 0.02
    assert result.gate_mm < 10.0 if scale > 1 else result.gate_mm < 0.6


@pytest.mark.slow
@pytest.mark.parametrize(
    ("relief", "other"), [pytest.param(12.0, 52, marks=pytest.mark.slow), (3.0, 58)]
)
def test_unrelated_shapes_are_refused(other: int, relief: float) -> None:
    with pytest.raises(SlviewerError):
        register(
            view(bumpy(other, relief), (-45, 75), 1, points=10_000),
            view(bumpy(2, relief), (-75, 45), 2),
        )


def test_points_that_are_all_one_are_refused() -> None:
    with pytest.raises(InputError):
        register(np.tile(CENTRE, (1000, 1)), view(bumpy(2), (-75, 45), 2, points=1000))


def test_no_common_surface_is_refused() -> None:
    with pytest.raises(SlviewerError):
        register(view(bumpy(2), (10, 75), 1, motion(10, 30)), view(bumpy(2), (-75, -10), 2))


def cap(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return -np.sqrt(110.0**2 - x**2 - y**2)


def barrel(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return -np.sqrt(90.0**2 - x**2) + 0.0 * y


def moulding(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return 5.0 * np.sin(x / 8.0) * np.exp(-((x - 10.0) ** 2) / 900.0) + 0.0 * y


@pytest.mark.slow
@pytest.mark.parametrize(
    ("shape", "reason", "free"),
    [
        (bumpy(2, 0.0), "plane", ("flat", "slides", "turns", "normal")),
        (cap, "sphere", ("turns", "centre")),
        (barrel, "cylinder", ("slides", "turns", "axis")),
        (moulding, "slides", ("slides",)),
    ],
)
def test_a_shape_that_slides_or_turns_is_refused_by_its_name(
    shape: Height, reason: str, free: tuple[str, ...]
) -> None:
    with raises(Refused, *free) as refusal:
        register(view(shape, (-45, 75), 1, motion(5, 10)), view(shape, (-75, 45), 2))
    assert refusal.value.reason == reason


@pytest.mark.slow
def test_two_poses_that_fit_alike_are_refused_unless_one_is_chosen() -> None:
    def twice(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """The same from both sides: turned by half a turn, it fits again."""
        height = bumpy(2)
        return height(x, y) + height(-x, -y)

    T = motion(5, 10)
    scan, reference = view(twice, (-70, 70), 1, T), view(twice, (-75, 75), 2)
    with raises(Refused, "RMS") as refusal:
        register(scan, reference)
    assert (
        refusal.value.reason == "ambiguous"
        and len(re.findall(r"[\d.]+ (?:mm|%)", str(refusal.value))) >= 3
    )
    corners = CENTRE + np.array([[50.0, 50.0, 0.0], [-50.0, 40.0, 0.0], [40.0, -50.0, 0.0]])
    picks = (corners - T[:3, 3]) @ T[:3, :3] + np.random.default_rng(0).normal(0, 2.0, (3, 3))
    start, apart = fit_picked_start(picks, corners)
    assert 0.1 < apart.max() < 6.0
    found = register(scan, reference, start)
    assert found.start == "picked" and error(found, T)[0] < 0.03
    # the other pose is half a turn away, and the result states that the start decided
    assert found.rival_mm is not None and 100 < found.rival_mm < 250
    nearer = np.linalg.inv(motion(20, 0)) @ T
    with raises(Refused, "mm", "start") as refusal:
        register(scan, reference, Candidate(nearer, "initial"))
    assert refusal.value.reason == "ambiguous"
    assert register(scan, reference, Candidate(T, "initial", is_decided=True)).rival_mm is None


@pytest.mark.slow
def test_a_start_that_leads_nowhere_is_refused_and_not_replaced() -> None:
    T = motion(60.0, 150.0)
    scan, reference = view(bumpy(2), (-45, 75), 1, T), view(bumpy(2), (-75, 45), 2)
    with pytest.raises(Refused):
        register(scan, reference, Candidate(np.eye(4), "initial"))
    found = register(scan, reference)
    assert found.start == "features" and error(found, T)[0] < 0.03 and found.rival_mm is None


def test_picks_that_fix_no_pose_are_refused() -> None:
    line = CENTRE + np.array([[0.0, 0, 0], [10, 0, 0], [30, 1, 0]])
    triangle = CENTRE + np.array([[0.0, 0, 0], [40, 0, 0], [0, 30, 0]])
    with raises(Refused, "scan", "line") as refusal:
        fit_picked_start(line, line)
    assert refusal.value.reason == "picks"
    with raises(Refused, "mm") as refusal:
        fit_picked_start(triangle, triangle[[1, 2, 0]])
    assert refusal.value.reason == "picks"
    with raises(InputError, "2 point pairs", 3):
        fit_picked_start(triangle[:2], triangle[:2])
    with raises(InputError, "(3, 3)", "(2, 3)"):
        fit_picked_start(triangle, triangle[:2])
    with pytest.raises(InputError):
        fit_picked_start(np.where(triangle == 40, np.nan, triangle), triangle)


@pytest.mark.slow
def test_the_predicted_uncertainty_is_the_true_one() -> None:
    T, shifts, turns, told = motion(10, 30), [], [], []
    for seed in range(5):
        scan = view(bumpy(seed), (-45, 75), 2 * seed, T, points=5000)
        reference = view(bumpy(seed), (-75, 45), 2 * seed + 1, points=5000)
        found = register(scan, reference, Candidate(T, "initial"))
        assert found.uncertainty.covariance.shape == (6, 6)
        D = found.T_reference_scan @ np.linalg.inv(T)
        centre = found.uncertainty.centre
        shifts.append(np.linalg.norm(D[:3, :3] @ centre + D[:3, 3] - centre))
        turns.append(error(found, T)[1])
        told.append((found.uncertainty.shift_mm, found.uncertainty.turn_deg))
    predicted = np.sqrt(np.mean(np.square(told), axis=0))
    true = np.sqrt(np.mean(np.square([shifts, turns]), axis=1))
    assert (predicted > 0.5 * true).all() and (
        predicted < 3.0 * true
    ).all()  # few, and not as dense as a camera's


def test_a_pose_handed_in_replaces_the_search() -> None:
    T = motion(60, 150)
    near = T.copy()
    near[:3, 3] += 1.0
    scan, reference = view(bumpy(2), (-45, 75), 1, T), view(bumpy(2), (-75, 45), 2)
    result = register(scan, reference, Candidate(near, "initial"))
    assert result.start == "initial"
    assert error(result, T)[0] < 0.03


def test_points_that_cannot_be_used_are_refused() -> None:
    good = view(bumpy(2), (-75, 45), 2)
    holed = good.copy()
    holed[5] = np.nan
    with raises(InputError, "scan", "finite"):
        register(holed, good)
    with pytest.raises(InputError):
        register(good[:20], good)
    with raises(InputError, "scan", "(n, 3)"):
        register(good.reshape(100, -1, 3), good)
    with raises(InputError, "scan", "normals"):
        prepare_scan("scan", good, good[:-1])
