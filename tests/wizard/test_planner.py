"""The next pose is computed on another thread: a quick plan holds meanwhile, and only the latest
request counts."""

import threading
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from wizard_events import HANG_S

from slviewer.calibration.next_pose import count_coverage, describe_suggestion, nominal_lens
from slviewer.calibration.stereo import StereoModel
from slviewer.geometry.rig import StereoRig
from slviewer.target.board import Board
from slviewer.wizard import pose_plan
from slviewer.wizard.pose_plan import PlanInput, Planner, PoseFeatures, PosePlan

BOARD = Board.parse("circles:15x12:12")
SIZE = (400, 300)


def plan_of(poses: tuple[str, ...], sigma: float | None = None, depth: float = 600.0) -> PosePlan:
    lens, T = nominal_lens(SIZE), np.eye(4)
    T[2, 3] = depth
    placed = dict.fromkeys(poses, T)
    return PosePlan(
        lens,
        placed,
        count_coverage(BOARD, lens, [T] * len(poses)),
        describe_suggestion(BOARD, lens, T),
        0.03,
        sigma,
        sigma,
    )


def given(*poses: str, hashes: str = "", target: str = str(BOARD)) -> PlanInput:
    """An input whose plan takes time: that of a calibrated camera."""
    rig = StereoRig(
        nominal_lens(SIZE), nominal_lens((912, 1140)), np.eye(3), np.array([180.0, 0, 0])
    )
    stereo = StereoModel(rig, target, ("x",), {}, {}, {}, {}, None, {})
    features = {name: PoseFeatures(*np.zeros((3, 4, 3))) for name in poses}
    keys = tuple((name, name + hashes) for name in poses)
    return PlanInput(Board.parse(target), SIZE, (912, 1140), features, stereo, hashes=keys)


class Plans:
    """Stands in for the computation of plans: each final one is computed once it `may_end`."""

    def __init__(self) -> None:
        self.begun: list[PlanInput] = []
        self.has_begun, self.may_end = threading.Event(), threading.Event()
        self.final, self.quick = plan_of(()), plan_of(())
        self.before: list[PosePlan | None] = []

    def compute(self, given: PlanInput, trials: int) -> PosePlan:
        self.begun.append(given)
        self.has_begun.set()
        assert self.may_end.wait(HANG_S)
        return replace(self.final, poses=dict.fromkeys(given.features, np.eye(4)))

    def compute_quickly(self, given: PlanInput, before: PosePlan | None) -> PosePlan:
        self.before.append(before)
        return plan_of(tuple(given.features)) if given.features else self.quick


@pytest.fixture
def plans(monkeypatch: pytest.MonkeyPatch) -> Plans:
    plans = Plans()
    monkeypatch.setattr(pose_plan, "plan_next_pose", plans.compute)
    monkeypatch.setattr(pose_plan, "quick_plan", plans.compute_quickly)
    return plans


@pytest.fixture
def changes() -> threading.Semaphore:
    return threading.Semaphore(0)


@pytest.fixture
def planner(changes: threading.Semaphore, plans: Plans) -> Iterator[Planner]:
    planner = Planner(changes.release)
    yield planner
    plans.may_end.set()
    planner.close()


def test_the_quick_plan_holds_until_the_final_one_is_ready(
    planner: Planner, plans: Plans, changes: threading.Semaphore
) -> None:
    three = given("a", "b", "c")
    quick, is_final = planner.look_up(three)
    assert not is_final and set(quick.poses) == {"a", "b", "c"} and not plans.begun
    planner.request(three)
    assert plans.has_begun.wait(HANG_S)
    assert planner.look_up(given("a", "b", "c")) == (quick, False) and len(plans.before) == 1, (
        "computed once"
    )
    plans.final = plan_of((), 0.05, depth=700)
    plans.may_end.set()
    assert changes.acquire(timeout=HANG_S)
    good, is_final = planner.look_up(three)
    assert is_final and good.sigma_mm == 0.05

    # one pose more: the predicted sigma and the suggestion still hold; one pose less: they do not
    more, is_final = planner.look_up(given("a", "b", "c", "d"))
    assert (
        not is_final
        and more.sigma_mm == 0.05
        and more.suggestion is good.suggestion
        and len(more.poses) == 4
    )
    assert plans.before[1] is not None and set(plans.before[1].poses) == {"a", "b", "c"}
    less, _ = planner.look_up(given("a", "b"))
    assert (
        less.sigma_mm is None
        and plans.before[2] is not None
        and set(plans.before[2].poses) == {"a", "b"}
    )
    retaken, _ = planner.look_up(given("a", "b", "c", hashes="2"))
    assert retaken.sigma_mm is None and plans.before[3] is not None and not plans.before[3].poses
    planner.look_up(given("a", "b", "c", target="circles:9x7:20"))
    assert plans.before[4] is None, "another board"
    assert planner.look_up(three) == (good, True), "cached"


def test_only_the_latest_request_is_computed(
    planner: Planner, plans: Plans, changes: threading.Semaphore
) -> None:
    planner.request(given("a"))
    assert plans.has_begun.wait(HANG_S)
    planner.request(given("b"))
    planner.request(given("c"))
    plans.final = plan_of((), 0.1)
    plans.may_end.set()
    for _ in range(2):
        assert changes.acquire(timeout=HANG_S)
    assert [list(each.features) for each in plans.begun] == [["a"], ["c"]]
    assert planner.look_up(given("c"))[0].sigma_mm == 0.1


def test_where_computing_fails_the_quick_plan_remains(
    plans: Plans,
    changes: threading.Semaphore,
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def fail(given: PlanInput, trials: int) -> PosePlan:
        raise np.linalg.LinAlgError("singular")

    monkeypatch.setattr(pose_plan, "plan_next_pose", fail)
    planner = Planner(changes.release)
    quick = planner.look_up(given("a"))
    planner.request(given("a"))
    assert changes.acquire(timeout=HANG_S)
    assert quick[1] is False and planner.look_up(given("a")) == (quick[0], True)
    assert [record.exc_info[0] for record in caplog.records if record.exc_info] == [
        np.linalg.LinAlgError
    ]
    planner.close()
