"""The worker: order, progress, cancelling what cannot be interrupted, and failures that stay sentences."""

import os
import platform
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from slviewer.errors import CalibrationRejected, Cancelled
from slviewer.wizard.jobs import Jobs, release_memory
from slviewer.wizard.notices import Notices


@pytest.fixture
def notices() -> Notices:
    return Notices(lambda: None)


@pytest.fixture
def jobs(notices: Notices) -> Iterator[Jobs]:
    jobs = Jobs(notices, lambda: None)
    yield jobs
    jobs.close()


def texts(notices: Notices) -> list[str]:
    return [notice.text for notice in notices.all()]


def test_jobs_run_in_order_and_the_operators_before_the_background(jobs: Jobs) -> None:
    order: list[str] = []
    gate = threading.Event()
    jobs.submit("first", lambda report: gate.wait(5))
    for name in ("b1", "b2"):
        jobs.submit(name, lambda report, name=name: order.append(name), background=True)
    for name in ("f1", "f2"):
        jobs.submit(name, lambda report, name=name: name, lambda result: order.append(result))
    gate.set()
    assert jobs.wait_until_idle(5)
    assert order == ["f1", "f2", "b1", "b2"] and jobs.view() is None


def test_progress_is_seen(jobs: Jobs) -> None:
    half, go_on = threading.Event(), threading.Event()

    def work(report):
        report(0.5, "halfway")
        half.set()
        go_on.wait(5)

    jobs.submit("Working", work)
    jobs.submit("Next", lambda report: None)
    assert half.wait(5)
    view = jobs.view()
    assert view is not None
    assert (view.name, view.share, view.stage, view.can_cancel, view.waiting) == ("Working", 0.5, "halfway", True, 1)
    go_on.set()
    assert jobs.wait_until_idle(5)


def test_cooperative_work_stops_at_its_next_report(jobs: Jobs, notices: Notices) -> None:
    started, stopped, done = threading.Event(), threading.Event(), []

    def work(report):
        started.set()
        try:
            while True:
                report(0.1, "on and on")
                time.sleep(0.01)
        except Cancelled:
            stopped.set()
            raise

    jobs.submit("Counting", work, done.append)
    assert started.wait(5)
    jobs.cancel()
    assert jobs.wait_until_idle(1) and stopped.is_set() and done == []
    assert texts(notices) == ["Counting: cancelled"]


def test_what_cannot_be_interrupted_is_abandoned_within_a_second_and_never_saves(jobs: Jobs, notices: Notices) -> None:
    started, woke, saved, done = threading.Event(), threading.Event(), [], []

    def sleeping(report):
        started.set()
        time.sleep(5)  # as a call into OpenCV does
        try:
            report.saving()
            saved.append(True)
        finally:
            woke.set()

    jobs.submit("Sleeping", sleeping, done.append)
    jobs.submit("Next", lambda report: "next", done.append)
    assert started.wait(5)
    begun = time.monotonic()
    jobs.cancel()
    assert jobs.wait_until_idle(4)
    assert time.monotonic() - begun < 4 and done == ["next"]
    assert woke.wait(20) and saved == [] and texts(notices) == ["Sleeping: cancelled"]


def test_a_save_that_has_begun_is_awaited_and_counts(jobs: Jobs, notices: Notices) -> None:
    saving, done = threading.Event(), []

    def work(report):
        report(0.9, "saving")
        report.saving()
        saving.set()
        time.sleep(0.8)
        report.saving()  # the second of two files
        report(1.0, "saved")
        return "saved"

    jobs.submit("Saving", work, done.append)
    assert saving.wait(5)
    jobs.cancel()
    assert jobs.wait_until_idle(5) and done == ["saved"] and texts(notices) == []


@pytest.mark.parametrize(
    ("error", "says"),
    [
        (CalibrationRejected("2 usable poses, and at least 3 are needed"), "2 usable poses, and at least 3 are needed"),
        (KeyError("x"), "Failing failed because of an error in the program (KeyError); see the log for details"),
        (MemoryError(), "out of memory"),
        (OSError(28, "No space left on device", "/x"), "Failing failed: No space left on device (/x)"),
    ],
)
def test_a_failure_becomes_a_notice_and_later_jobs_go_on(
    jobs: Jobs, notices: Notices, caplog: pytest.LogCaptureFixture, error: Exception, says: str
) -> None:
    def work(report):
        raise error

    done: list[int] = []
    jobs.submit("Failing", work)
    jobs.submit("Failing when done", lambda report: None, lambda result: 1 / 0)
    jobs.submit("Next", lambda report: 1, done.append)
    assert jobs.wait_until_idle(5) and done == [1]
    first, second = notices.all()
    assert first.level == "error" and says in first.text and "Failing when done" in second.text
    assert ("Traceback" in caplog.text) and (("KeyError: 'x'" in caplog.text) == isinstance(error, KeyError))


def test_closing_ends_everything(notices: Notices) -> None:
    jobs = Jobs(notices, lambda: None)
    jobs.submit("Sleeping", lambda report: time.sleep(15))
    time.sleep(0.05)
    begun = time.monotonic()
    jobs.close()
    assert time.monotonic() - begun < 10
    jobs.submit("Too late", lambda report: None)
    assert not any(thread.name == "slviewer worker" and thread.is_alive() for thread in threading.enumerate())


def read_memory_mb() -> float:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="other C libraries are left alone")
def test_memory_freed_between_blocks_in_use_is_returned() -> None:
    blocks = [b"x" * 100_000 for _ in range(2000)]  # smaller than what the system gives in whole pages
    in_use = blocks[::20]
    del blocks
    before = read_memory_mb()
    release_memory()
    assert 100 < before - read_memory_mb() < 250, len(in_use)
