"""What an operator waits for, measured by running the whole wizard on the simulated rig without a browser."""

import statistics
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

from slviewer.pipeline.feedback import Progress, ignore_progress
from slviewer.pipeline.reconstruct import reconstruct
from slviewer.validation.bench_rows import median, row
from slviewer.wizard.autopilot import RIG, Autopilot
from slviewer.wizard.operator import Operator
from slviewer.wizard.snapshot import Snapshot

POSES = 8
LIMITS = {
    "suggestion of the next pose, from the third on": 1.0,
    "last frame of a scan to its cloud": 0.7,
    "verify a plane or a sphere with all models": 2.0,
    f"calibrate {POSES} poses": 6.0,
    "Autopilot": 60.0,
    "reconstruct again in the same process": 0.1,
    "`slviewer reconstruct` as a command": 1.2,
}
"""Seconds that a person may have to wait, at 800x600 on two cores."""


@dataclass
class _Stopwatch:
    """Waiting times, s, by their names, from the snapshots of a wizard at work.

    A listener of the operator's, which is called on one thread only.
    """

    seconds: dict[str, list[float]] = field(default_factory=lambda: {name: [] for name in LIMITS})
    _last_frame: float | None = None
    _pose: float | None = None
    _before: Snapshot | None = None

    def note(self, snapshot: Snapshot) -> None:
        """Note the time of what differs from the snapshot before."""
        now, before, self._before = time.perf_counter(), self._before, snapshot
        if before is None or before.session is None or snapshot.session is None:
            return
        if before.rig.capture is not None and snapshot.rig.capture is None:
            self._last_frame = now
        if len(snapshot.session.poses) > len(before.session.poses):
            self._pose = self._last_frame
        planned = before.session.pending_plan is not None and snapshot.session.pending_plan is None
        if planned and self._pose is not None and len(snapshot.session.poses) >= 3:
            self.seconds["suggestion of the next pose, from the third on"].append(now - self._pose)
            self._pose = None
        clouds = [sum(scan.cloud == "fresh" for scan in each.session.scans) for each in (before, snapshot)]  # type: ignore[union-attr]
        if self._last_frame is not None:
            if len(snapshot.session.verifications) > len(before.session.verifications):
                self.seconds["verify a plane or a sphere with all models"].append(now - self._last_frame)
            elif clouds[1] > clouds[0] and any(scan.purpose == "scan" for scan in snapshot.session.scans):
                self.seconds["last frame of a scan to its cloud"].append(now - self._last_frame)


def time_wizard(scale: float = 0.5, progress: Progress = ignore_progress) -> list[dict[str, Any]]:
    """Rows of what an operator waits for, with the seconds of each act of the Autopilot.

    ``scale``: resolution of the camera, as a share of 1600x1200. Kernels are compiled before anything is measured.
    """
    acts: list[tuple[str, float]] = []

    def begin(act: str) -> None:
        """Note when an act begins."""
        acts.append((act, time.perf_counter()))
        progress(min(0.9, 0.02 * len(acts)), act)

    with tempfile.TemporaryDirectory(prefix="slviewer-bench-") as folder:
        for name in ("warm", "session"):  # the first run compiles what is not compiled yet
            acts.clear()
            watch, session = _Stopwatch(), Path(folder, name)
            with Operator(session, {**RIG, "scale": scale if name == "session" else min(scale, 0.25)}) as operator:
                stop = operator.subscribe(watch.note)
                Autopilot(operator, poses=POSES, before=begin).run()
                begin("")
                stop()
        lasted = [(act, after - at) for (act, at), (_, after) in pairwise(acts)]
        watch.seconds["Autopilot"].append(acts[-1][1] - acts[0][1])
        watch.seconds[f"calibrate {POSES} poses"] += [seconds for act, seconds in lasted if act == "Calibrating"]
        progress(0.92, "reconstructing again")
        watch.seconds["reconstruct again in the same process"].append(
            median(lambda: reconstruct(session, "scan_01", out=Path(folder, "again.ply")), 5)
        )
        command = [sys.executable, "-m", "slviewer.cli", "reconstruct", str(session), "scan_01"]
        watch.seconds["`slviewer reconstruct` as a command"].append(
            median(lambda: subprocess.run(command, check=True, capture_output=True), 3)
        )
    progress(1.0, "measured")
    rows = []
    for stage, limit in LIMITS.items():
        times = watch.seconds[stage]
        note = "not measured" if not times else "holds" if max(times) <= limit else "missed"
        rows.append(
            row(
                stage,
                statistics.median(times or [float("nan")]),
                target=f"{1e3 * limit:.0f} ms",
                note=f"{note}, of {len(times)}",
            )
        )
    slowest = sorted(lasted, key=lambda each: -each[1])[:8]
    return rows + [row(f"Autopilot: {act}", seconds) for act, seconds in slowest]
