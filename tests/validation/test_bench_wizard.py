"""Waiting times of an operator, from the snapshots that a wizard publishes."""

import threading
import time
from collections import Counter
from types import SimpleNamespace

import pytest

from slviewer.validation import bench_wizard
from slviewer.validation.bench_wizard import _Sampler, _Stopwatch


def test_waiting_begins_with_the_last_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = iter(range(100))
    monkeypatch.setattr(time, "perf_counter", lambda: float(next(clock)))
    session = {"poses": (), "scans": (), "verifications": (), "pending_plan": None}
    watch = _Stopwatch()

    def publish(capture: object = None, **changes: object) -> None:
        session.update(changes)
        watch.note(SimpleNamespace(rig=SimpleNamespace(capture=capture), session=SimpleNamespace(**session)))  # type: ignore[arg-type]

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
    monkeypatch.setattr(bench_wizard, "_is_counted", lambda module: module == __name__)
    done = threading.Event()

    def work() -> None:
        while not done.is_set():
            sum(range(1000))

    thread = threading.Thread(target=work)
    thread.start()
    with _Sampler() as sampler:
        sampler.act = "working"
        deadline = time.monotonic() + 60.0
        while sampler.samples.get("working", Counter()).total() < 3 and time.monotonic() < deadline:
            time.sleep(0.01)
    done.set()
    thread.join()
    assert any("work" in name for name in sampler.samples["working"])
    assert sampler.act == "working"
