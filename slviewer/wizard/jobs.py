"""One worker that computes, one job after the other, and never blocks the operator; and the
messages for the operator, one sentence each.

A job's `work(reporter)` runs in a thread of its own. Cancelling is cooperative first: the next
`reporter(share, stage)` raises Cancelled. Work that is inside a call that cannot be interrupted
(OpenCV, Open3D) is abandoned after `PATIENCE_S`: the worker goes on with the next job, and the
abandoned thread ends at its next report.

Abandoned work never saves anything afterwards: jobs get the session as
`session.guarded(reporter.saving)`, and write exports through its `staged_export`; both call
`saving` right before a save takes effect. Conversely, work that has begun to save is no longer
cancelled but awaited, so that a calibration of two models is never half saved. `done(result)` runs
on the worker if the job was not cancelled.
"""

import contextlib
import ctypes
import logging
import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import datetime
from functools import partial
from typing import Any

from slviewer.errors import Cancelled, SlviewerError, hide_passwords
from slviewer.wizard.service import Service, log
from slviewer.wizard.snapshot import JobView, Level, Notice, WrittenFile

MOST_NOTICES = 100


class Notices:
    """The latest notices, oldest first. Every method may be called from any thread."""

    def __init__(self, changed: Callable[[], None]) -> None:
        self._changed = changed
        self._lock = threading.Lock()
        self._latest: deque[Notice] = deque(maxlen=MOST_NOTICES)
        self._count = 0

    def add(
        self, level: Level, text: str, section: str = "", file: WrittenFile | None = None
    ) -> None:
        """Add a notice and log it, without passwords; one of the same text before it is removed.
        `section`: of the help's page of findings; `file`: that it announces."""
        text = hide_passwords(text)
        log.log(logging.getLevelNamesMapping().get(level.upper(), logging.INFO), "%s", text)
        with self._lock:
            self._count += 1
            same = next((each for each in self._latest if each.text == text), None)
            if same is not None:
                self._latest.remove(same)
            self._latest.append(
                Notice(self._count, level, text, datetime.now().astimezone(), section, file)
            )
        self._changed()

    def add_failure(self, action: str, error: BaseException) -> None:
        """Add what `describe_failure` returns for the error that ended an action
        ("Calibrating")."""
        self.add("error", describe_failure(action, error))

    def clear(self) -> None:
        """Forget the notices: those of another session."""
        with self._lock:
            self._latest.clear()
        self._changed()

    def all(self) -> tuple[Notice, ...]:
        """Return the latest notices, oldest first."""
        with self._lock:
            return tuple(self._latest)


def describe_failure(action: str, error: BaseException) -> str:
    """Describe an error to the operator in one sentence; an unexpected one is logged with its
    traceback."""
    if isinstance(error, SlviewerError):
        return str(error)
    log.error("%s failed", action, exc_info=error)
    if isinstance(error, MemoryError):
        return (
            f"{action} failed: out of memory. Close other programs, or use a smaller camera image"
        )
    if isinstance(error, OSError):
        where = f" ({error.filename})" if error.filename else ""
        return f"{action} failed: {error.strerror or error}{where}"
    return (
        f"{action} failed because of an error in the program ({type(error).__name__}); see the log"
        " for details"
    )


PATIENCE_S = 0.5
"""How long cancelled work may take to end by itself."""


def release_memory() -> None:
    """Return freed memory to the system: glibc keeps what was freed between blocks in use, some MB
    a minute of live scanning on a busy machine. Does nothing with other C libraries."""
    if sys.platform == "linux":
        with contextlib.suppress(OSError, AttributeError):
            ctypes.CDLL(None).malloc_trim(0)


class Reporter:
    """A job's `Progress`, which raises Cancelled once the operator has cancelled."""

    def __init__(self, changed: Callable[[], None]) -> None:
        self._changed = changed
        self._lock = threading.Lock()
        self.cancelled, self._saving = False, False
        self.share, self.stage = 0.0, ""

    def __call__(self, share: float, stage: str) -> None:
        """Report progress: `share` 0 ... 1 and the `stage` in words. Raises Cancelled once the job
        was cancelled."""
        if share < 1:  # with the last report everything is saved
            with self._lock:
                self._saving = False
                if self.cancelled:
                    raise Cancelled("cancelled")
        self.share, self.stage = min(max(float(share), 0.0), 1.0), stage
        self._changed()

    def saving(self) -> None:
        """Mark the start of a save: raises Cancelled, or defers cancelling until the next
        report."""
        with self._lock:
            if self.cancelled and not self._saving:
                raise Cancelled("cancelled")
            self._saving = True

    def cancel(self) -> None:
        """Make the next report raise Cancelled."""
        with self._lock:
            self.cancelled = True

    @property
    def has_saved(self) -> bool:
        """Whether a save has begun since the last report of a share below 1."""
        return self._saving


@dataclass(eq=False)
class _Job:
    """A queued or running job: its callbacks, its reporter, and its result or error once `ended` is
    set."""

    name: str
    work: Callable[[Reporter], Any]
    done: Callable[[Any], None] | None
    failed: Callable[[BaseException], None] | None
    background: bool
    reporter: Reporter
    begun: float = 0.0
    ended: threading.Event = field(default_factory=threading.Event)
    result: Any = None
    error: BaseException | None = None


class Jobs(Service):
    """A worker thread with a foreground and a background queue. Every method may be called from any
    thread. `ended()` is called after each job, whatever became of it."""

    def __init__(
        self, notices: Notices, changed: Callable[[], None], ended: Callable[[], None]
    ) -> None:
        super().__init__("slviewer worker")
        self._notices, self._changed, self._ended = notices, changed, ended
        self._waiting: list[_Job] = []
        self._running: _Job | None = None
        self._thread.start()

    def submit(
        self,
        name: str,
        work: Callable[[Reporter], Any],
        done: Callable[[Any], None] | None = None,
        *,
        failed: Callable[[BaseException], None] | None = None,
        background: bool = False,
    ) -> None:
        """Queue `work`, named as the operator reads it ("Calibrating").

        Background work waits until no other job does, and cannot be cancelled by the operator.
        `failed(error)` runs on the worker in place of a notice.
        """
        job = _Job(name, work, done, failed, background, Reporter(self._changed))
        with self._condition:
            if self._closing:
                return
            self._waiting.append(job)
            self._condition.notify_all()
        self._changed()

    def cancel(self) -> None:
        """Cancel the running foreground job, else the first waiting one; other jobs continue."""
        dropped = list[_Job]()
        with self._condition:
            if self._running and not self._running.background:
                self._running.reporter.cancel()
                self._condition.notify_all()
            else:
                dropped = [job for job in self._waiting if not job.background][:1]
                self._waiting = [job for job in self._waiting if job not in dropped]
        for job in dropped:
            self._notices.add("info", f"{job.name}: cancelled")
        self._changed()

    def cancel_all(self) -> None:
        """Cancel the running job and drop the waiting ones, background work too."""
        with self._condition:
            self._waiting.clear()
            if self._running:
                self._running.reporter.cancel()
            self._condition.notify_all()

    def view(self) -> JobView | None:
        """Return the running job; None where none runs."""
        with self._condition:
            job = self._running
            waiting = sum(not each.background for each in self._waiting)
        if job is None:
            return None
        reporter = job.reporter
        can_cancel = not job.background and not reporter.cancelled
        return JobView(
            job.name,
            reporter.share,
            reporter.stage,
            time.monotonic() - job.begun,
            can_cancel,
            job.background,
            waiting,
        )

    @property
    def idle(self) -> bool:
        """Whether no job runs and none waits, background work included."""
        with self._condition:
            return self._running is None and not self._waiting

    def close(self) -> None:
        """Cancel everything and end the worker; returns within a second or so."""
        self.cancel_all()
        super().close()

    def _serve(self) -> None:
        """Run the worker loop until closing: take the next job, foreground jobs first, and run
        it."""
        while True:
            with self._condition:
                self._running = None
                self._condition.notify_all()
            self._ended()
            with self._condition:
                self._condition.wait_for(lambda: self._closing or self._waiting)
                if self._closing:
                    return
                job = min(self._waiting, key=lambda each: each.background)
                self._waiting.remove(job)
                job.begun = time.monotonic()
                self._running = job
            self._changed()
            try:
                self._supervise_job(job)
            except Exception as error:  # whatever it was, the worker lives on
                self._notices.add_failure(job.name, error)
            release_memory()

    def _supervise_job(self, job: _Job) -> None:
        """Run a job on its own thread until it ends or is cancelled, then call `done` or `failed`,
        or add a notice."""
        thread = threading.Thread(
            target=self._execute_job, args=(job,), name=f"slviewer: {job.name}", daemon=True
        )
        thread.start()
        reporter = job.reporter
        with self._condition:
            self._condition.wait_for(lambda: job.ended.is_set() or reporter.cancelled)
        if reporter.cancelled:
            job.ended.wait(PATIENCE_S)
            while reporter.has_saved and not job.ended.wait(0.05):
                pass
            if not job.ended.is_set():
                log.info(
                    "%s: abandoned in the middle of a call that cannot be interrupted", job.name
                )
        if reporter.cancelled and not (
            job.ended.is_set() and job.error is None and reporter.has_saved
        ):
            if not job.background:
                self._notices.add("info", f"{job.name}: cancelled")
        elif job.error:
            (job.failed or partial(self._notices.add_failure, job.name))(job.error)
        elif job.done:
            job.done(job.result)

    def _execute_job(self, job: _Job) -> None:
        """Execute a job on its own thread, store its result or error, and mark it as ended."""
        try:
            job.result = job.work(job.reporter)
        except BaseException as error:
            job.error = error
        with self._condition:
            job.ended.set()
            self._condition.notify_all()
