"""All checks of one rig, in the order in which they need each other."""

import time
from collections.abc import Callable

from slviewer.devices.protocols import Rig
from slviewer.pipeline.check_results import Check, Preflight
from slviewer.pipeline.feedback import Progress, ignore_progress
from slviewer.preflight import burst
from slviewer.preflight.exposure import exposure
from slviewer.preflight.gamma import gamma
from slviewer.preflight.latency import latency
from slviewer.preflight.light import ambient, flicker
from slviewer.preflight.order import order
from slviewer.preflight.rig_under_test import RigUnderTest
from slviewer.preflight.screen import screen
from slviewer.preflight.sharpness import sharpness
from slviewer.preflight.stillness import stillness

_LOOKS = 52
"""How often about the bench shows something: what progress is measured by."""
_MEAN = 8  # images
_LONG_MS = 300.0  # of patience where the delay is unknown
_ALL = ("latency", "exposure", "flicker", "gamma", "pixels", "order", "repeats", "ambient", "motion")


def preflight(rig: Rig, *, say: Callable[[str], None] | None = None, progress: Progress | None = None) -> Preflight:
    """Look at an open rig, on the thread that owns its devices; about 10 s.

    `say` hears of each check as it is done, in a sentence. `progress` may raise Cancelled. Raises DeviceError where a
    device does not answer. Patterns are loaded and light is shown; what was loaded and shown before is for the caller
    to restore.
    """
    began, shown = time.monotonic(), 0
    checks: list[Check] = []
    heard = progress or ignore_progress

    def tick(doing: str) -> None:
        nonlocal shown
        heard(min(0.99, shown / _LOOKS), doing)
        shown += 1

    def add(*found: Check) -> None:
        for check in found:
            checks.append(check)
            if say is not None:
                say(check.sentence if not check.remedy else f"{check.sentence} {check.remedy}")

    bench = RigUnderTest(rig, tick)
    bench.find_references()
    delay, settle_ms = latency(bench)
    if settle_ms is None:
        bench.settle_ms = _LONG_MS
    seen = screen(bench)
    if seen.verdict == "bad" or settle_ms is None:
        # What else was measured would be another screen's.
        add(seen)
        if seen.verdict != "bad":
            add(delay)
        unseen = "It was not looked at, because the camera does not see what the projector is told to show."
        rest = [name for name in _ALL if name not in {check.name for check in checks}]
        checks += [Check(name, "unknown", unseen, "", {}) for name in rest]
        return Preflight(tuple(checks), None, None, None, time.monotonic() - began)
    add(seen, delay)
    right, exposure_ms = exposure(bench)
    add(right)
    images = burst.take(bench)
    add(flicker(bench, images))
    response, levels, middle = gamma(bench)
    add(response, sharpness(bench, middle), *order(bench))
    last_dark, last_white = (bench.look(grey, "what changed meanwhile", _MEAN) for grey in (None, 255))
    add(ambient(bench, last_dark), stillness(bench, images, last_white))
    heard(1.0, "checked")
    return Preflight(tuple(checks), settle_ms, levels, exposure_ms, time.monotonic() - began)
