"""Delay from the projector's change to the camera's image, and whether its images are fresh."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from slviewer.examination.limits import LEAST_LIT
from slviewer.pipeline.examination import Check
from slviewer.preflight.rig_under_test import RigUnderTest

_CHANGE_COUNT = 8
_NEAR, _NEAREST = 0.05, 0.4
"""Share of a change that may be missing from one that has arrived, and under flicker."""
_TIMEOUT_S = 1.2
_STALE_TRIALS = 3
_LONG_MS = 250.0


@dataclass(frozen=True)
class _Change:
    """Start times of the images after a change, in s since the projector showed it, until one shows
    the change."""

    begin_s: tuple[float, ...]
    arrived: bool

    def arrival_ms(self, stale: int) -> float:
        """Start time, ms, of the first image that shows the change, ``stale`` images earlier; 0 for
        the very first."""
        place = len(self.begin_s) - 1 - stale
        return 1000 * self.begin_s[place] if place > 0 else 0.0


def measure_latency(bench: RigUnderTest) -> tuple[Check, float | None]:
    """Measure the delay between projector and camera; return the check and `settle_ms` (None: not
    measurable).

    Stores frame time, delay and stale images in the bench.
    """
    if bench.illuminated.mean() < LEAST_LIT:
        text = "The delay cannot be measured: no change of light is visible."
        return Check("latency", "unknown", text), None
    begin_s = [bench.grab_timed()[0] for _ in range(6)]
    bench.frame_ms = max(1000 * float(np.median(np.diff(begin_s))), 1e-3)
    changes = [_time_change(bench, i) for i in range(_CHANGE_COUNT)]
    lost = sum(not change.arrived for change in changes)
    if lost:
        text = (
            f"After {lost} of {_CHANGE_COUNT} changes the camera saw nothing new within"
            f" {_TIMEOUT_S:g} s."
        )
        remedy = (
            "Check that the projector really changes its picture, and that the camera sends fresh"
            " images."
        )
        figures: dict[str, Any] = {"changes": _CHANGE_COUNT, "unseen": lost}
        return Check("latency", "bad", text, remedy, figures), None
    settle = _compute_settle_ms([change.arrival_ms(0) for change in changes], bench.frame_ms)
    bench.stale = max(_count_stale(bench, settle, i) for i in range(_STALE_TRIALS))
    fresh = [change.arrival_ms(bench.stale) for change in changes]
    settle = bench.settle_ms = _compute_settle_ms(fresh, bench.frame_ms)
    images = [len(change.begin_s) - 1 - bench.stale for change in changes]
    figures = {
        "latency_ms": round(max(fresh), 1),
        "median_ms": round(float(np.median(fresh)), 1),
        "latency_frames": round(max(fresh) / bench.frame_ms, 2),
        "images_before_it": max(0, *images),
        "frame_ms": round(bench.frame_ms, 2),
        "settle_ms": settle,
        "stale_images": bench.stale,
    }
    return _judge_delay(bench, max(fresh), figures), settle


def _judge_delay(bench: RigUnderTest, latest_ms: float, figures: dict[str, Any]) -> Check:
    """The check of the measured delay, whose fresh images began ``latest_ms`` late at most."""
    if bench.stale:
        many = "one image" if bench.stale == 1 else f"{bench.stale} images"
        text = (
            f"The camera is {many} behind: it hands out images that are older than the request,"
            " however long one waits."
        )
        remedy = (
            "Switch the camera's buffering off, or let its driver discard old images; a longer wait"
            " does not help."
        )
        return Check("latency", "bad", text, remedy, figures)
    text = (
        f"Light arrives up to {latest_ms:.0f} ms ({latest_ms / bench.frame_ms:.1f} camera frames)"
        f" after the projector reports the image as shown; captures wait {bench.settle_ms:g} ms."
    )
    if bench.settle_ms == 0:
        text = (
            "Light arrives as soon as the projector reports it: the first image after each change"
            " is right."
        )
    if bench.settle_ms <= _LONG_MS:
        return Check("latency", "good", text, "", figures)
    remedy = (
        "Switch the projector's picture processing off (game mode), so that captures are quicker."
    )
    return Check("latency", "warning", text, remedy, figures)


def _time_change(bench: RigUnderTest, i: int) -> _Change:
    """One change from dark to white or back; each begins at another moment of the camera's own
    clock."""
    target = 0.0 if i % 2 == 0 else 1.0  # the references leave it white
    bench.clock.sleep(bench.frame_ms / 1000 * i / _CHANGE_COUNT)
    bench.show(255 if target else None, "delay of the light")
    shown, begin_s = bench.clock.now(), []
    while True:
        start, image = bench.grab_timed()
        begin_s.append(start - shown)
        if abs(bench.share(image, bench.illuminated) - target) < _compute_tolerance(bench):
            return _Change(tuple(begin_s), True)
        if start - shown > _TIMEOUT_S:
            return _Change(tuple(begin_s), False)


def _count_stale(bench: RigUnderTest, settle_ms: float, i: int) -> int:
    """Number of images that still show the old light after a sufficiently long wait."""
    target = 0.0 if i % 2 == 0 else 1.0
    bench.show(255 if target else None, "freshness of the images")
    bench.clock.sleep((2 * settle_ms + bench.frame_ms) / 1000)
    old = 0
    while old < 8 and abs(
        bench.share(bench.grab(), bench.illuminated) - target
    ) >= _compute_tolerance(bench):
        old += 1
    return old


def _compute_tolerance(bench: RigUnderTest) -> float:
    """Largest deviation from the new level, as a share of white, at which an image counts as
    showing the change."""
    return min(_NEAREST, max(_NEAR, 5 * bench.unsteady))


def _compute_settle_ms(arrivals_ms: list[float], frame_ms: float) -> float:
    """Settling time, ms: the latest arrival plus half a frame as margin; 0 if every first image was
    right."""
    worst = max(arrivals_ms)
    return float(math.ceil(worst + 0.5 * frame_ms)) if worst else 0.0
