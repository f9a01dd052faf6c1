"""One worker that computes, one job after the other, and never blocks the operator.

A job's `work(reporter)` runs in a thread of its own. Cancelling is cooperative first: the next `reporter(share, stage)`
raises Cancelled. Work that is inside a call that cannot be interrupted (OpenCV, Open3D) is abandoned after
`PATIENCE_S`: the worker goes on with the next job, and the abandoned thread ends at its next report.

Abandoned work never saves anything afterwards: jobs get the session as `session.guarded(reporter.saving)`, and write
exports through `export_files.staged_export`; both call `saving` right before a save takes effect. Conversely, work that
has begun to save is no longer cancelled but awaited, so that a calibration of two models is never half saved.
`done(result)` runs on the worker if the job was not cancelled.
"""

import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from slviewer.errors import Cancelled
from slviewer.wizard.notices import Notices, log
from slviewer.wizard.snapshot import JobView

PATIENCE_S = 0.5
"""How long cancelled work may take to end by itself."""


class Reporter:
    """A job's `Progress`, which raises Cancelled once the operator has cancelled."""

    def __init__(self, changed: Callable[[], None]) -> None:
        self._changed = changed
        self._lock = threading.Lock()
        self._cancelled, self._saving = False, False
        self.share, self.stage = 0.0, ""

    def __call__(self, share: float, stage: str) -> None:
        if share < 1:  # with the last report everything is saved
            with self._lock:
                self._saving = False
            self.check()
        self.share, self.stage = min(max(float(share), 0.0), 1.0), stage
        self._changed()

    def check(self) -> None:
        """Raise Cancelled if the work was cancelled."""
        if self._cancelled:
            raise Cancelled("cancelled")

    def saving(self) -> None:
        """Called right before a save takes effect: raises Cancelled, or defers cancelling until the next report."""
        with self._lock:
            if self._cancelled and not self._saving:
                raise Cancelled("cancelled")
            self._saving = True

    def cancel(self) -> None:
        """Make the next report raise Cancelled."""
        with self._lock:
            self._cancelled = True

    def within(self, start: float, end: float) -> "Reporter":
        """The reporter of one part of the work, whose own share goes from 0 to 1."""
        return _PartReporter(self, start, min(end, 0.999))  # the last report is the whole work's own

    @property
    def cancelled(self) -> bool:
        return self._cancelled

    @property
    def has_saved(self) -> bool:
        """Whether results are being saved, or were."""
        return self._saving


class _PartReporter(Reporter):
    def __init__(self, whole: Reporter, start: float, end: float) -> None:
        super().__init__(whole._changed)
        self._whole, self._start, self._end = whole, start, end

    def __call__(self, share: float, stage: str) -> None:
        self._whole(self._start + (self._end - self._start) * share, stage)

    def check(self) -> None:
        self._whole.check()

    def saving(self) -> None:
        self._whole.saving()


@dataclass(eq=False)
class _Job:
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


class Jobs:
    """The worker and what waits for it. Every method may be called from any thread."""

    def __init__(self, notices: Notices, changed: Callable[[], None]) -> None:
        self._notices, self._changed = notices, changed
        self._condition = threading.Condition()
        self._waiting: deque[_Job] = deque()
        self._waiting_behind: deque[_Job] = deque()
        self._running: _Job | None = None
        self._closing = False
        self._worker = threading.Thread(target=self._serve, name="slviewer worker", daemon=True)
        self._worker.start()

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

        Background work waits until no other job does, and cannot be cancelled by the operator. `failed(error)` runs on
        the worker in place of a notice.
        """
        job = _Job(name, work, done, failed, background, Reporter(self._changed))
        with self._condition:
            if self._closing:
                return
            (self._waiting_behind if background else self._waiting).append(job)
            self._condition.notify_all()
        self._changed()

    def cancel(self) -> None:
        """Cancel the job that the operator sees, if there is one; those that wait behind it go on."""
        with self._condition:
            if self._running is not None and not self._running.background:
                self._running.reporter.cancel()
                self._condition.notify_all()
            elif self._waiting:
                self._notices.add("info", f"{self._waiting.popleft().name}: cancelled")
        self._changed()

    def cancel_all(self) -> None:
        """Cancel the running job and drop those that wait, background work too."""
        with self._condition:
            self._waiting.clear()
            self._waiting_behind.clear()
            if self._running is not None:
                self._running.reporter.cancel()
            self._condition.notify_all()

    def view(self) -> JobView | None:
        """The job that runs, or None."""
        with self._condition:
            job, waiting = self._running, len(self._waiting)
        if job is None:
            return None
        reporter = job.reporter
        can_cancel = not job.background and not reporter.cancelled
        return JobView(
            job.name, reporter.share, reporter.stage, time.monotonic() - job.begun, can_cancel, job.background, waiting
        )

    @property
    def idle(self) -> bool:
        """Whether nothing runs and nothing waits."""
        with self._condition:
            return self._running is None and not self._waiting and not self._waiting_behind

    def wait_until_idle(self, timeout_s: float) -> bool:
        """Wait for that; False where it took longer."""
        with self._condition:
            return self._condition.wait_for(
                lambda: self._running is None and not self._waiting and not self._waiting_behind, timeout_s
            )

    def close(self) -> None:
        """Cancel everything and end the worker; returns within a second or so."""
        with self._condition:
            self._closing = True
        self.cancel_all()
        self._worker.join(4 * PATIENCE_S)

    def _serve(self) -> None:
        while True:
            with self._condition:
                self._running = None
                self._condition.notify_all()
            self._changed()
            with self._condition:
                self._condition.wait_for(lambda: self._closing or self._waiting or self._waiting_behind)
                if self._closing:
                    return
                job = (self._waiting or self._waiting_behind).popleft()
                job.begun = time.monotonic()
                self._running = job
            self._changed()
            try:
                self._run(job)
            except Exception as error:  # whatever it was, the worker lives on
                self._notices.add_failure(job.name, error)

    def _run(self, job: _Job) -> None:
        thread = threading.Thread(target=self._work, args=(job,), name=f"slviewer: {job.name}", daemon=True)
        thread.start()
        reporter = job.reporter
        with self._condition:
            self._condition.wait_for(lambda: job.ended.is_set() or reporter.cancelled)
        if reporter.cancelled:
            job.ended.wait(PATIENCE_S)
            while reporter.has_saved and not job.ended.wait(0.05):
                pass
            if not job.ended.is_set():
                log.info("%s: abandoned in the middle of a call that cannot be interrupted", job.name)
        if reporter.cancelled and not (job.ended.is_set() and job.error is None and reporter.has_saved):
            if not job.background:
                self._notices.add("info", f"{job.name}: cancelled")
        elif job.error is not None and job.failed is not None:
            job.failed(job.error)
        elif job.error is not None:
            self._notices.add_failure(job.name, job.error)
        elif job.done is not None:
            job.done(job.result)

    def _work(self, job: _Job) -> None:
        try:
            job.result = job.work(job.reporter)
        except BaseException as error:
            job.error = error
        with self._condition:
            job.ended.set()
            self._condition.notify_all()
