"""The worker: order, progress, cancelling what cannot be interrupted, and failures that stay
sentences."""

import os
import platform
import threading
from collections.abc import Iterator
from pathlib import Path

import clocks
import pytest
from facts import missing_facts
from wizard_events import HANG_S, until

from slviewer.errors import CalibrationRejected, Cancelled
from slviewer.wizard.jobs import Jobs, Notices, Reporter, release_memory


@pytest.fixture
def notices() -> Notices:
    return Notices(lambda: None)


@pytest.fixture
def jobs(notices: Notices) -> Iterator[Jobs]:
    jobs = Jobs(notices, lambda: None, lambda: None)
    yield jobs
    jobs.close()


def the_only(notices: Notices, level: str) -> str:
    """Return the text of the only notice, which has this level."""
    (notice,) = notices.all()
    assert notice.level == level
    return notice.text


def test_jobs_run_in_order_and_the_operators_before_the_background(jobs: Jobs) -> None:
    order: list[str] = []
    gate = threading.Event()
    jobs.submit("first", lambda report: gate.wait(HANG_S))
    for name in ("b1", "b2"):
        jobs.submit(name, lambda report, name=name: order.append(name), background=True)
    for name in ("f1", "f2"):
        jobs.submit(name, lambda report, name=name: name, lambda result: order.append(result))
    gate.set()
    assert clocks.until(lambda: jobs.idle)
    assert order == ["f1", "f2", "b1", "b2"] and jobs.view() is None


def test_progress_is_seen(jobs: Jobs) -> None:
    half, go_on = threading.Event(), threading.Event()

    def work(report):
        report(0.5, "halfway")
        half.set()
        go_on.wait(HANG_S)

    jobs.submit("Working", work)
    jobs.submit("Next", lambda report: None)
    assert half.wait(HANG_S)
    view = jobs.view()
    assert view is not None
    assert (view.name, view.share, view.stage, view.can_cancel, view.waiting) == (
        "Working",
        0.5,
        "halfway",
        True,
        1,
    )
    go_on.set()
    assert clocks.until(lambda: jobs.idle)


def test_cooperative_work_stops_at_its_next_report(jobs: Jobs, notices: Notices) -> None:
    started, stopped, pause, done = threading.Event(), threading.Event(), threading.Event(), []

    def work(report):
        started.set()
        try:
            while True:
                report(0.1, "on and on")
                pause.wait(0.01)
        except Cancelled:
            stopped.set()
            raise

    jobs.submit("Counting", work, done.append)
    assert started.wait(HANG_S)
    jobs.cancel()
    assert clocks.until(lambda: jobs.idle) and stopped.is_set() and done == []
    assert missing_facts(the_only(notices, "info"), "Counting", "cancelled") == []


def test_what_cannot_be_interrupted_is_abandoned_and_never_saves(
    jobs: Jobs, notices: Notices
) -> None:
    started, wake, woke, saved, done = (
        threading.Event(),
        threading.Event(),
        threading.Event(),
        [],
        [],
    )

    def sleeping(report):
        started.set()
        assert wake.wait(HANG_S)  # as a call into OpenCV does
        try:
            report.saving()
            saved.append(True)
        finally:
            woke.set()

    jobs.submit("Sleeping", sleeping, done.append)
    jobs.submit("Next", lambda report: "next", done.append)
    assert started.wait(HANG_S)
    jobs.cancel()
    assert clocks.until(lambda: jobs.idle)
    assert not woke.is_set() and done == ["next"], "the next job did not wait for it"
    wake.set()
    assert woke.wait(HANG_S) and saved == []
    assert missing_facts(the_only(notices, "info"), "Sleeping", "cancelled") == []


def test_a_save_that_has_begun_is_awaited_and_counts(
    jobs: Jobs, notices: Notices, monkeypatch: pytest.MonkeyPatch
) -> None:
    saving, done = threading.Event(), []
    polls = threading.Semaphore(0)

    def has_saved(reporter: Reporter) -> bool:
        polls.release()
        return reporter._saving

    monkeypatch.setattr(Reporter, "has_saved", property(has_saved))

    def work(report):
        report(0.9, "saving")
        report.saving()
        saving.set()
        for _ in range(3):  # it was cancelled, and the worker waits
            assert polls.acquire(timeout=HANG_S)
        report.saving()  # the second of two files
        report(1.0, "saved")
        return "saved"

    jobs.submit("Saving", work, done.append)
    assert saving.wait(HANG_S)
    jobs.cancel()
    assert clocks.until(lambda: jobs.idle) and done == ["saved"] and notices.all() == ()


@pytest.mark.parametrize(
    ("error", "facts"),
    [
        (
            CalibrationRejected("2 usable poses, and at least 3 are needed"),
            ["2 usable poses, and at least 3 are needed"],
        ),
        (KeyError("x"), ["Failing", "KeyError", "log"]),
        (MemoryError(), ["Failing", "memory"]),
        (
            OSError(28, "No space left on device", "/x"),
            ["Failing", "No space left on device", "/x"],
        ),
    ],
)
def test_a_failure_becomes_a_notice_and_later_jobs_go_on(
    jobs: Jobs,
    notices: Notices,
    caplog: pytest.LogCaptureFixture,
    error: Exception,
    facts: list[str],
) -> None:
    def work(report):
        raise error

    done: list[int] = []
    jobs.submit("Failing", work)
    jobs.submit("Failing when done", lambda report: None, lambda result: 1 / 0)
    jobs.submit("Next", lambda report: 1, done.append)
    assert clocks.until(lambda: jobs.idle) and done == [1]
    first, second = notices.all()
    assert first.level == "error" and missing_facts(first.text, *facts) == []
    assert missing_facts(second.text, "Failing when done") == []
    assert ("Traceback" in caplog.text) and (
        ("KeyError: 'x'" in caplog.text) == isinstance(error, KeyError)
    )


def test_closing_ends_everything(notices: Notices) -> None:
    jobs = Jobs(notices, lambda: None, lambda: None)
    started, wake, woke = threading.Event(), threading.Event(), threading.Event()

    def sleep(report):
        started.set()
        assert wake.wait(HANG_S)
        woke.set()

    jobs.submit("Sleeping", sleep)
    assert started.wait(HANG_S)
    jobs.close()
    jobs.submit("Too late", lambda report: None)
    until(
        lambda: (
            not any(
                thread.name == "slviewer worker" and thread.is_alive()
                for thread in threading.enumerate()
            )
        )
    )
    assert not woke.is_set(), "closing did not wait for it"
    wake.set()


def read_memory_mb() -> float:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


@pytest.mark.slow
@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="other C libraries are left alone")
def test_memory_freed_between_blocks_in_use_is_returned() -> None:
    release_memory()  # what other tests left
    # smaller than what the system gives in whole pages
    blocks = [b"x" * 100_000 for _ in range(2000)]
    in_use = blocks[::20]
    del blocks
    before = read_memory_mb()
    release_memory()
    assert 100 < before - read_memory_mb() < 250, len(in_use)
