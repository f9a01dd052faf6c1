"""Computes the plan of the next pose, which takes about a second, on a thread of its own."""

import threading
from collections.abc import Callable
from dataclasses import replace

from slviewer.wizard.notices import log
from slviewer.wizard.pose_plan import PlanInput, PosePlan, plan_next_pose, quick_plan
from slviewer.wizard.preview_watcher import LatestWorker

MOST_PLANS = 8
"""Plans cached, so that excluding a pose and including it again does not compute one twice."""


class Planner:
    """Provides the best plan available; `changed()` is called, on the planner's thread, when a
    better one is ready.

    Only the latest request is computed. `compute` and `quick` are `plan_next_pose` and
    `quick_plan`.
    """

    def __init__(
        self,
        changed: Callable[[], None],
        compute: Callable[[PlanInput], PosePlan] = plan_next_pose,
        quick: Callable[[PlanInput, PosePlan | None], PosePlan] = quick_plan,
    ) -> None:
        self._changed, self._compute, self._quick = changed, compute, quick
        self._lock = threading.Lock()
        self._plans: dict[object, tuple[PosePlan, bool]] = {}  # and whether it is final
        # the last one that was computed and looked up
        self._latest: tuple[PlanInput, PosePlan] | None = None
        self._requested: object = None
        self._worker = LatestWorker("slviewer planner", self._compute_plan)

    def look_up(self, given: PlanInput) -> tuple[PosePlan, bool]:
        """Return (the best plan available, whether it is final). One that is not final is improved
        by `request`.

        Until then its poses are those of the last final plan for the same board and devices, and
        its suggestion and sigma are that plan's as long as poses were only added.
        """
        with self._lock:
            if cached := self._plans.get(given.key):
                if cached[1] and given.takes_time:
                    self._latest = given, cached[0]
                return cached
            latest = self._latest
        if not given.takes_time:
            return self._cache_plan(given, self._compute(given), True)
        if latest is None or latest[0].rig_key != given.rig_key:
            return self._cache_plan(given, self._quick(given, None), False)
        earlier, plan = latest
        same = {name for name, _ in {*earlier.hashes} & {*given.hashes}}
        poses = {name: T for name, T in plan.poses.items() if name in same}
        interim = self._quick(given, replace(plan, poses=poses))
        if earlier.features.keys() <= same:
            suggestion = plan.suggestion or interim.suggestion
            interim = replace(interim, sigma_mm=plan.sigma_mm, suggestion=suggestion)
        return self._cache_plan(given, interim, False)

    def request(self, given: PlanInput) -> None:
        """Compute the plan for this input in the background, in place of an earlier request."""
        with self._lock:
            if self._requested == given.key or self._plans.get(given.key, (None, False))[1]:
                return
            self._requested = given.key
        self._worker.offer(given)

    def close(self) -> None:
        """End the thread."""
        self._worker.close()

    def _compute_plan(self, given: PlanInput) -> None:
        """Compute the requested plan on the planner's thread and store it; an interim plan where
        computing fails."""
        if given.key != self._requested:
            return
        try:
            computed = self._compute(given)
        except Exception:  # the operator can go on without a suggestion
            log.exception("the next pose could not be computed")
            computed, _ = self.look_up(given)
        self._cache_plan(given, computed, True)
        self._changed()

    def _cache_plan(self, given: PlanInput, plan: PosePlan, final: bool) -> tuple[PosePlan, bool]:
        """Cache a plan under its input's key, dropping the oldest where the cache is full; returns
        what `look_up` does."""
        with self._lock:
            while len(self._plans) >= MOST_PLANS:
                self._plans.pop(next(iter(self._plans)))
            self._plans[given.key] = plan, final
        return plan, final
