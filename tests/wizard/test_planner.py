"""The next pose is thought of elsewhere: what is at hand answers meanwhile, and only the latest question counts."""

import threading
import time
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from slviewer.calibration.next_pose import coverage, describe_suggestion, nominal_lens
from slviewer.target.board import Board
from slviewer.wizard.planner import Planner, PlanRequest
from slviewer.wizard.pose_plan import PosePlan

BOARD = Board.parse("circles:15x12:12")
SIZE = (400, 300)


def plan_of(poses: tuple[str, ...], sigma: float | None = None, depth: float = 600.0) -> PosePlan:
    lens, T = nominal_lens(SIZE), np.eye(4)
    T[2, 3] = depth
    placed = dict.fromkeys(poses, T)
    return PosePlan(
        lens, placed, coverage(BOARD, lens, [T] * len(poses)), describe_suggestion(BOARD, lens, T), 0.03, sigma, sigma
    )


def asked(*poses: str, hashes: str = "", target: str = str(BOARD)) -> PlanRequest:
    return PlanRequest(target, SIZE, (912, 1140), tuple((name, name + hashes) for name in poses), "", None, 0)


class Mind:
    """Thinks until it is told what it found."""

    def __init__(self) -> None:
        self.begun, self.may_end, self.found = threading.Event(), threading.Event(), plan_of(())

    def __call__(self) -> PosePlan:
        self.begun.set()
        assert self.may_end.wait(10)
        return self.found

    def finds(self, found: PosePlan) -> None:
        self.found = found
        self.may_end.set()


@pytest.fixture
def changes() -> threading.Semaphore:
    return threading.Semaphore(0)


@pytest.fixture
def planner(changes: threading.Semaphore) -> Iterator[Planner]:
    planner = Planner(changes.release)
    yield planner
    planner.close()


def test_what_is_at_hand_answers_until_the_plan_is_there(planner: Planner, changes: threading.Semaphore) -> None:
    mind, quick = Mind(), plan_of(("a", "b", "c"))
    begun = time.monotonic()
    assert planner.plan(asked("a", "b", "c"), lambda before: quick, mind) == (quick, True)
    assert time.monotonic() - begun < 0.1 and mind.begun.wait(5)
    assert planner.plan(asked("a", "b", "c"), lambda before: pytest.fail("asked again"), mind) == (quick, True)
    good = plan_of(("a", "b", "c"), 0.05, depth=700)
    mind.finds(good)
    assert changes.acquire(timeout=5)
    assert planner.plan(asked("a", "b", "c"), lambda before: quick, mind) == (good, False)

    # one pose more: what was foretold and suggested still holds; one pose less: it does not
    told: list[PosePlan | None] = []

    def at_hand(before: PosePlan | None) -> PosePlan:
        told.append(before)
        return plan_of(("a", "b", "c", "d"))

    more, thinking = planner.plan(asked("a", "b", "c", "d"), at_hand, Mind())
    assert thinking and more.sigma_mm == 0.05 and more.suggestion is good.suggestion and len(more.poses) == 4
    assert told[0] is not None and set(told[0].poses) == {"a", "b", "c"}
    less, _ = planner.plan(asked("a", "b"), at_hand, Mind())
    assert less.sigma_mm is None and told[1] is not None and set(told[1].poses) == {"a", "b"}
    retaken, _ = planner.plan(asked("a", "b", "c", hashes="2"), at_hand, Mind())
    assert retaken.sigma_mm is None and told[2] is not None and not told[2].poses
    planner.plan(asked("a", "b", "c", target="circles:9x7:20"), at_hand, Mind())
    assert told[3] is None, "another board"
    assert planner.plan(asked("a", "b", "c"), at_hand, Mind()) == (good, False), "taken back: remembered"


def test_only_the_latest_question_is_thought_of(planner: Planner, changes: threading.Semaphore) -> None:
    minds = {name: Mind() for name in "abc"}
    for name, mind in minds.items():
        planner.plan(asked(name), lambda before: plan_of(()), mind)
        if name == "a":
            assert mind.begun.wait(5)
    for name, mind in minds.items():
        mind.finds(plan_of((name,), 0.1))
    for _ in range(2):
        assert changes.acquire(timeout=5)
    assert not minds["b"].begun.is_set() and minds["c"].begun.is_set()
    assert planner.plan(asked("c"), lambda before: plan_of(()), minds["c"])[0].sigma_mm == 0.1


def test_where_thinking_fails_what_is_at_hand_remains(
    planner: Planner, changes: threading.Semaphore, caplog: pytest.LogCaptureFixture
) -> None:
    def fails() -> PosePlan:
        raise np.linalg.LinAlgError("singular")

    quick = replace(plan_of(("a",)), sigma_mm=None)
    assert planner.plan(asked("a"), lambda before: quick, fails) == (quick, True)
    assert changes.acquire(timeout=5)
    assert planner.plan(asked("a"), lambda before: quick, fails) == (quick, False)
    assert "could not be chosen" in caplog.text
