"""Who chooses the next pose, which takes about a second: a thread of its own, so that no snapshot waits for it."""

import threading
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

from slviewer.wizard.notices import log
from slviewer.wizard.pose_plan import PosePlan
from slviewer.wizard.preview_watcher import Latest

KEPT = 8
"""Plans remembered: who excludes a pose and includes it again need not wait twice."""


class PlanRequest(NamedTuple):
    """What a plan depends on: the board's notation, the sizes of camera and projector, (name, hash) of each pose's
    frames, the hash of the calibration (empty: none), the nominal focal length, and how many poses were refused."""

    target: str
    camera: tuple[int, int]
    projector: tuple[int, int]
    poses: tuple[tuple[str, str], ...]
    model: str
    focal_px: float | None
    refused: int


@dataclass(frozen=True, eq=False)
class _Task:
    asked: PlanRequest
    think: Callable[[], PosePlan]
    at_hand: PosePlan


class Planner:
    """Answers with the best plan there is. `changed()` is called, on the planner's thread, when a better one is found.

    Only the latest question is thought about, on that thread: what it is about must not change.
    """

    def __init__(self, changed: Callable[[], None]) -> None:
        self._changed = changed
        self._lock = threading.Lock()
        self._plans: dict[PlanRequest, PosePlan] = {}
        self._last: tuple[PlanRequest, PosePlan] | None = None
        self._task: _Task | None = None
        self._thread = Latest("slviewer planner", self._work)

    def plan(
        self, asked: PlanRequest, at_hand: Callable[[PosePlan | None], PosePlan], think: Callable[[], PosePlan]
    ) -> tuple[PosePlan, bool]:
        """(the plan, whether `think()` is still at it).

        Meanwhile `at_hand(before)` answers, where `before` is the last plan for the same board and devices, with those
        of its poses that are still the same. What that one suggested and foretold holds while poses are only added.
        """
        with self._lock:
            found = self._plans.get(asked)
            if found is not None:
                self._task, self._last = None, (asked, found)
                return found, False
            if self._task is not None and self._task.asked == asked:
                return self._task.at_hand, True
            last = self._last
        before, grown = None, False
        if last is not None and last[0][:3] == asked[:3]:
            same = {name for name, _ in {*last[0].poses} & {*asked.poses}}
            before = replace(last[1], poses={name: T for name, T in last[1].poses.items() if name in same})
            grown = len(same) == len(last[0].poses)
        found = at_hand(before)
        if before is not None and grown:
            found = replace(found, sigma_mm=before.sigma_mm, suggestion=before.suggestion or found.suggestion)
        task = _Task(asked, think, found)
        with self._lock:
            self._task = task
        self._thread.offer(task)
        return found, True

    def close(self) -> None:
        """End the thread."""
        self._thread.close()

    def _work(self, task: _Task) -> None:
        if task is not self._task:  # poses changed since
            return
        try:
            found = task.think()
        except Exception:  # the operator's own poses decide
            log.exception("the next pose could not be chosen")
            found = task.at_hand
        with self._lock:
            while len(self._plans) >= KEPT:
                self._plans.pop(next(iter(self._plans)))
            self._plans[task.asked] = found
        self._changed()
