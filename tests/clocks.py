"""Waiting for events, and clocks that a test moves."""

import time
from collections.abc import Callable
from typing import Any

from slviewer.preflight.rig_under_test import Clock

HANG_S = 600.0
"""After so long a test that waits for an event has failed: no machine is as slow."""


def until(condition: Callable[[], Any], seconds: float = HANG_S) -> bool:
    """Wait until a condition holds, and return whether it does."""
    end = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > end:
            return bool(condition())
        time.sleep(0.005)
    return True


class SteppingClock:
    """A clock that nothing but its use moves: each look at it by ``step_s``, each wait by its
    duration."""

    def __init__(self, step_s: float = 0.0) -> None:
        self._now_s, self._step_s = 1000.0, step_s

    @property
    def clock(self) -> Clock:
        """The clock as the preflight takes it."""
        return Clock(self.now, self.sleep)

    def now(self) -> float:
        """Return the time, s, and move on by a step."""
        self._now_s += self._step_s
        return self._now_s

    def sleep(self, seconds: float) -> None:
        """Move on at once."""
        self._now_s += max(0.0, seconds)
