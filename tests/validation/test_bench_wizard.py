"""Waiting times of an operator, from the snapshots that a wizard publishes."""

import threading
import time
from collections.abc import Callable
from types import SimpleNamespace

import pytest

from slviewer.validation import bench_wizard
from slviewer.validation.bench_wizard import _Sampler, _Stopwatch


def test_waiting_begins_with_the_last_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    seconds = iter(range(100))
    session = {"poses": (), "scans": (), "verifications": (), "pending_plan": None}
    clock = SimpleNamespace(perf_counter=lambda: float(next(seconds)))
    monkeypatch.setattr(bench_wizard, "time", clock)
    watch = _Stopwatch()

    def publish(capture: object = None, **changes: object) -> None:
        session.update(changes)
        records = session["verifications"]
        shown = SimpleNamespace(**session, list_records=lambda kind: records)
        watch.note(SimpleNamespace(rig=SimpleNamespace(capture=capture), session=shown))  # type: ignore[arg-type]

    def scans(*states: str) -> tuple[object, ...]:
        return tuple(SimpleNamespace(cloud=state, purpose="scan") for state in states)

    for count in (2, 3):  # of two poses nobody is told anything yet
        publish("frame 3 of 26")
        publish()
        publish(poses=("pose",) * count, pending_plan="computing")
        publish(pending_plan=None)
    publish("frame 3 of 26")
    publish(scans=scans("absent"))
    publish(scans=scans("fresh"))
    publish("frame 3 of 26")
    publish()
    publish()
    publish(verifications=("plane",))
    found = {stage: seconds for stage, seconds in watch.seconds.items() if seconds}
    assert found == {
        "suggestion of the next pose, from the third on": [2.0],
        "last frame of a scan to its cloud": [1.0],
        "verify a plane or a sphere with all models": [2.0],
    }
    assert set(found) <= set(bench_wizard.LIMITS)


def test_the_functions_of_an_act_are_sampled(monkeypatch: pytest.MonkeyPatch) -> None:
    stop = []

    def work() -> None:
        while not stop:  # an event's own function would be taken for waiting
            sum(range(1000))

    thread = threading.Thread(target=work)
    thread.start()
    monkeypatch.setattr(bench_wizard, "_is_counted", lambda module: module == __name__)
    sampler = _Sampler()
    sampler.act = "working"
    try:
        with sampler:
            until(lambda: any("work" in name for name in list(sampler.samples.get("working", ()))))
    finally:
        stop.append(True)
        thread.join()
    assert set(sampler.samples) == {"working"} and sampler.act == "working"


def until(condition: Callable[[], bool], limit_s: float = 60.0) -> None:
    """Wait for a condition; the limit is for what hangs."""
    deadline = time.monotonic() + limit_s
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)
