"""The wizard without a browser: every request returns at once, and never raises.

A request that cannot be granted becomes a notice, and returns False. Devices are used on the
acquisition thread and the worker computes, so that requests may come from any thread, a browser's
callbacks too.
"""

import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

from slviewer.errors import InputError, SlviewerError
from slviewer.pipeline.rig_choice import Choice, SetUp, set_up
from slviewer.wizard.capture_requests import CaptureRequests
from slviewer.wizard.engine import request
from slviewer.wizard.service import Service, Timing
from slviewer.wizard.snapshot import PreviewView, Snapshot


class Operator(CaptureRequests):
    """The wizard: requests in, snapshots out. Close it, or use it in a `with` block."""

    def __init__(
        self,
        session: Path | str | None = None,
        rig: Choice | None = None,
        *,
        set_up: SetUp = set_up,
        timing: Timing | None = None,
    ) -> None:
        """Open or create `session`, with `rig`, by default the one that the session remembers."""
        super().__init__(set_up, self.capture_pose, timing or Timing())
        self._autopilot: Service | None = None
        if session is not None:
            self.open_session(session, rig)
        elif rig is not None:
            self.choose_rig(rig)

    def __enter__(self) -> "Operator":
        """Return the operator itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the operator."""
        self.close()

    def snapshot(self) -> Snapshot:
        """Return the latest snapshot."""
        return self._publisher.latest

    def preview(self) -> PreviewView | None:
        """Return the latest preview; None until there is one."""
        return self._preview

    def subscribe(
        self,
        callback: Callable[[Snapshot], None],
        preview: Callable[[PreviewView], None] | None = None,
    ) -> Callable[[], None]:
        """Call back with every new snapshot, and with every preview, each always on the same
        thread.

        Returns a function that unsubscribes. A callback must return soon, and must not wait for
        another snapshot.
        """
        unsubscribe = ExitStack()
        unsubscribe.callback(self._publisher.listeners.add(callback))
        if preview:
            unsubscribe.callback(self._preview_listeners.add(preview))
        return unsubscribe.close

    def wait_until_idle(self, timeout_s: float = 60.0) -> Snapshot:
        """Wait until all captures, jobs and the plan of the next pose are complete; returns the
        snapshot.

        Raises SlviewerError after `timeout_s`.
        """
        end = time.monotonic() + timeout_s
        while True:
            # captures first: each submits its jobs before it ends
            idle = self.wait_for(
                lambda now: self._acquisition.idle and self._jobs.idle and not _is_planning(now),
                end - time.monotonic(),
            )
            if idle is None:
                raise SlviewerError(
                    f"work is still running after {timeout_s:g} s: cancel it, or wait longer"
                )
            now = self._publisher.refresh()
            if not _is_planning(now) and self._publisher.is_current:
                return now

    @request("Cancelling")
    def cancel(self) -> None:
        """Cancel the running capture, else the running job; an autopilot stops too."""
        if self._autopilot:
            self._autopilot.stop()
        if not self._acquisition.idle:
            self._acquisition.cancel()
        else:
            self._jobs.cancel()

    @request("Starting autopilot")
    def start_autopilot(self, autopilot: Service) -> None:
        """Start an autopilot, which sends requests until it is done or `cancel` stops it."""
        with self._lock:
            if self._autopilot and self._autopilot.running:
                raise InputError("an autopilot is running already: cancel it first")
            self._autopilot = autopilot
            autopilot.start()

    def close(self) -> None:
        """Stop everything and close the session; captures are saved already."""
        if self._autopilot:
            self._autopilot.stop()
        super().close()


def _is_planning(snapshot: Snapshot) -> bool:
    """Whether the plan of the next pose is still being computed."""
    return snapshot.session is not None and snapshot.session.pending_plan is not None
