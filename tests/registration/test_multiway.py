"""Many scans come together in one frame; loops close, and a pair that contradicts the others is
found."""

import numpy as np
import pytest
from bumpy_scans import CENTRE, NOISE, SIZE, bumpy, motion, organised, view
from facts import raises
from scipy.spatial.transform import Rotation

from slviewer.errors import Cancelled, InputError, SlviewerError
from slviewer.reconstruction.cloud import Cloud
from slviewer.registration import graph
from slviewer.registration.graph import Edge, select_consistent_edges
from slviewer.registration.multiway import MultiwayAlignment, Starts, register_all
from slviewer.registration.refusal import Refused
from slviewer.registration.scan import PreparedScan, away_from_edges, prepare_scan
from slviewer.registration.start import TurntableAxis, fit_turntable_axis

pytestmark = pytest.mark.computes

DEPTHS = {"object_r1": -120.0, "object_r2": 0.0, "object_r3": 120.0}


def pose(name: str) -> np.ndarray:
    """Where the object stands in the reference's frame: its scan is nearer or further, and
    turned."""
    T = motion(12.0 if name == "object_r1" else 9.0, 4.0, seed=len(name) + int(DEPTHS[name]) % 7)
    T[:3, 3] -= T[:3, :3] @ [0.0, 0.0, DEPTHS[name]]
    return T if name != "object_r2" else np.eye(4)


@pytest.fixture(scope="module")
def clouds() -> dict[str, Cloud]:
    made = {}
    for k, name in enumerate(DEPTHS):
        points = organised(bumpy(2), pose(name), seed=k)
        made[name] = Cloud(points, "x", "stereo", np.full(points.shape[:2], NOISE, np.float32))
    return made


def off(T: np.ndarray, true: np.ndarray) -> tuple[float, float]:
    """mm at the object's centre, and degrees."""
    D = T @ np.linalg.inv(true)
    shift = np.linalg.norm(D[:3, :3] @ CENTRE + D[:3, 3] - CENTRE)
    return float(shift), float(
        np.degrees(np.linalg.norm(Rotation.from_matrix(D[:3, :3]).as_rotvec()))
    )


def test_three_depths_come_into_one_frame(clouds: dict[str, Cloud]) -> None:
    told: list[float] = []
    found = register_all(clouds, "object_r2", progress=told.append)
    assert np.array_equal(found.T_reference_scan["object_r2"], np.eye(4))
    for name, pair in found.on_reference().items():
        shift, turn = off(pair.T_reference_scan, pose(name))
        assert shift < 0.02 and turn < 0.01
        assert 0.8 * NOISE < pair.rms_mm < 2.0 * NOISE
        # two pixels of this camera
        assert pair.overlap > 0.6 and pair.start == "features" and pair.gate_mm <= 2.0
        assert 0.0002 < pair.uncertainty.shift_mm < 0.02
    assert len(found.pairs) == 3 and len(found.loops) == 1 and not found.dropped
    assert found.loops[0].left_mm < found.loops[0].error_mm < 0.05
    assert told == sorted(told) and told[-1] == pytest.approx(1.0)


def test_known_poses_and_a_cancelled_search(clouds: dict[str, Cloud]) -> None:
    two = {name: clouds[name] for name in ("object_r1", "object_r2")}
    near = {name: pose(name) @ motion(2.0, 0.0) for name in two}
    found = register_all(two, "object_r1", Starts(poses=near))
    assert found.pairs["object_r2", "object_r1"].start == "initial"
    assert off(found.T_reference_scan["object_r2"], np.linalg.inv(pose("object_r1")))[0] < 0.02

    def stop(share: float) -> None:
        raise Cancelled("Stopped.")

    with pytest.raises(Cancelled):
        register_all(two, "object_r1", progress=stop)


def test_edges_are_not_trusted(clouds: dict[str, Cloud]) -> None:
    cloud = clouds["object_r2"]
    trusted = away_from_edges(cloud.points, cloud.sigma_z)
    at_rim = np.abs(cloud.points[..., :2]).max(axis=-1) > 74.5
    assert at_rim.any() and not trusted[at_rim].any() and trusted[cloud.mask].mean() > 0.9


@pytest.mark.slow
def test_a_scan_that_does_not_belong_is_named() -> None:
    scans = {
        "a": prepare_scan("a", view(bumpy(2), (-75, 45), 2)),
        "stranger": prepare_scan("stranger", view(bumpy(58), (-45, 75), 1)),
    }
    with raises(Refused, "stranger"):
        register_all(scans, "a")


def test_an_unknown_reference_and_a_single_scan_are_refused() -> None:
    scan = prepare_scan("a", view(bumpy(2), (-75, 45), 2, points=1000))
    with raises(InputError, "'c'", "a, b"):
        register_all({"a": scan, "b": scan}, "c")
    with raises(InputError, 1, 2, 255):
        register_all({"a": scan}, "a")


# around an object


BUMPS = np.random.default_rng(4).normal(size=(40, 3))


def knob(directions: np.ndarray) -> np.ndarray:
    """Points (n, 3) mm of a body without symmetry, about its own centre."""
    bumps = BUMPS / np.linalg.norm(BUMPS, axis=1, keepdims=True)
    heights = np.where(np.arange(len(bumps)) % 3, 4.0, -3.0)
    radius = 50.0 + np.exp((directions @ bumps.T - 1.0) / 0.03) @ heights
    return directions * radius[:, None]


TABLE = TurntableAxis(np.array([5.0, 0.0, 610.0]), np.array([0.05, -1.0, 0.1]))


def turned_scans(count: int, step: float) -> dict[str, PreparedScan]:
    """What a camera sees of the body as the table turns."""
    scans = {}
    for k in range(count):
        rng = np.random.default_rng(k)
        directions = rng.normal(size=(16_000, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        T = TABLE.rotation(step * k)
        normals = directions @ T[:3, :3].T  # nearly: enough to say what the camera sees
        points = (knob(directions) + TABLE.point) @ T[:3, :3].T + T[:3, 3]
        points += (
            rng.normal(0, NOISE, (len(points), 1))
            * points
            / np.linalg.norm(points, axis=1, keepdims=True)
        )
        seen = np.sum(normals * points, axis=1) < -0.35 * np.linalg.norm(points, axis=1)
        name = f"turn_{k + 1:02d}"
        scans[name] = prepare_scan(name, points[seen])
    return scans


@pytest.fixture(scope="module")
def turn() -> MultiwayAlignment:
    scans = turned_scans(6, 60.0)
    return register_all(
        scans, "turn_03", Starts(table_deg=dict(zip(scans, 60.0 * np.arange(6), strict=True)))
    )


@pytest.mark.slow
def test_a_turn_closes(turn: MultiwayAlignment) -> None:
    for k, T in enumerate(turn.T_reference_scan.values()):
        shift, deg = off(T, TABLE.rotation(60.0 * (2 - k)))
        assert shift < 0.03 and deg < 0.06
    longest = max(turn.loops, key=lambda loop: len(loop.scans))
    assert len(longest.scans) > 3
    assert turn.loops[0].error_mm < 0.1
    assert max(loop.left_mm for loop in turn.loops) < 0.05
    assert len(turn.pairs) >= 6 and not turn.dropped
    # the third scan and its neighbours are one pair apart, the sixth is three: it is the least
    # sure, and told so
    sure = {name: pair.uncertainty.shift_mm for name, pair in turn.on_reference().items()}
    assert (
        0.005 < sure["turn_02"] < sure["turn_06"] < 0.05
        and max(sure, key=lambda name: sure[name]) == "turn_06"
    )
    assert {pair.start for pair in turn.pairs.values()} <= {"turntable", "features", "initial"}


def test_the_axis_is_found_from_two_steps_and_a_wrong_angle_is_told() -> None:
    steps = [TABLE.rotation(-40.0)] * 2
    axis = fit_turntable_axis(steps, 40.0)
    np.testing.assert_allclose(axis.rotation(25.0), TABLE.rotation(25.0), atol=1e-9)
    np.testing.assert_allclose(
        fit_turntable_axis(steps, -40.0).rotation(-25.0), TABLE.rotation(25.0), atol=1e-9
    )
    with raises(InputError, "40.0 degrees", 30):
        fit_turntable_axis(steps, 30.0)
    for angle in (0.0, 180.0):
        with raises(InputError, f"{angle:g} degrees", "axis"):
            fit_turntable_axis([TABLE.rotation(-angle)] * 2, angle)


# contradictions, and what poses are worth, on poses alone


def ring(count: int) -> tuple[list[np.ndarray], list[Edge]]:
    poses = [TABLE.rotation(-30.0 * k) for k in range(count)]
    covariance = np.diag([1e-10] * 3 + [1e-5] * 3)
    edges = []
    for k in range(count):
        for hop in (1, 2):
            other = (k + hop) % count
            T = np.linalg.inv(poses[k]) @ poses[other] @ motion(0.002, 0.004, seed=9 * k + hop)
            edges.append(Edge(other, k, T, covariance, CENTRE, SIZE))
    return poses, edges


def test_poses_are_as_sure_as_the_pairs_that_lead_there() -> None:
    sigma, floor = 0.02, graph._FLOOR * SIZE
    covariance = np.diag([1e-16] * 3 + [sigma**2] * 3)
    poses = np.stack([motion(0.0, 0.0)] * 4)
    chain = [Edge(k + 1, k, np.eye(4), covariance, CENTRE, SIZE) for k in range(3)]
    one = np.sqrt(3 * (sigma**2 + floor**2))
    open_end = [each.shift_mm for each in graph.pose_uncertainties(poses, chain, 1)]
    assert open_end == pytest.approx([one, 0.0, one, np.sqrt(2) * one], rel=1e-3, abs=1e-9)
    closed = graph.pose_uncertainties(
        poses, [*chain, Edge(0, 3, np.eye(4), covariance, CENTRE, SIZE)], 0
    )
    assert [each.shift_mm for each in closed] == pytest.approx(
        [0.0, np.sqrt(3 / 4) * one, one, np.sqrt(3 / 4) * one], rel=1e-3, abs=1e-9
    )


def never(edge: Edge, poses: np.ndarray) -> bool:
    return False


@pytest.mark.slow
def test_one_bad_edge_among_many_is_dropped() -> None:
    poses, edges = ring(8)
    bad = edges[5]
    edges[5] = Edge(bad.scan, bad.onto, bad.T @ motion(20.0, 5.0), bad.covariance, bad.centre, SIZE)
    kept, dropped = select_consistent_edges(8, edges, 0, never)
    assert list(dropped) == [5] and sorted([*kept, 5]) == list(range(16))
    assert dropped[5][0] > 3.0 and dropped[5][1] == pytest.approx(20.0, abs=0.1)
    good = [edges[k] for k in kept]
    start, _ = graph.spanning_poses(8, good, 0)
    for found, true in zip(graph.optimise_poses(start, good, 0), poses, strict=True):
        assert off(found, true)[0] < 0.01


def test_of_three_that_contradict_the_surfaces_decide_or_it_is_refused() -> None:
    poses, edges = ring(3)
    three = edges[::2]
    bad = three[1]
    three[1] = Edge(bad.scan, bad.onto, bad.T @ motion(20.0, 5.0), bad.covariance, bad.centre, SIZE)
    with pytest.raises(SlviewerError):
        select_consistent_edges(3, three, 0, never)

    def lies_well(edge: Edge, tried: np.ndarray) -> bool:
        T, true = (np.linalg.inv(each[edge.onto]) @ each[edge.scan] for each in (tried, poses))
        return off(T, true)[0] < 0.1

    assert list(select_consistent_edges(3, three, 0, lies_well)[1]) == [1]
