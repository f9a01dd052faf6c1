"""What an operator waits for, measured by running the whole wizard on the simulated rig without a
browser."""

import os
import statistics
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

from slviewer.geometry.jit_prepare import Preparation
from slviewer.pipeline.operation import Progress
from slviewer.pipeline.reconstruct import reconstruct
from slviewer.records.verification import Verification
from slviewer.validation.bench_rows import Row, median, row, run_python
from slviewer.wizard.autopilot import RIG, Autopilot
from slviewer.wizard.operator import Operator
from slviewer.wizard.snapshot import SessionView, Snapshot

POSES = 8
LIMITS = {
    "suggestion of the next pose, from the third on": 1.0,
    "last frame of a scan to its cloud": 0.7,
    "verify a plane or a sphere with all models": 2.0,
    f"calibrate {POSES} poses": 6.0,
    "Autopilot": 60.0,
    "reconstruct again in the same process": 0.1,
    "`slviewer reconstruct` as a command": 1.2,
    f"`slviewer validate` on {POSES} poses": 60.0,
    "`slviewer --help`": 0.25,
    "first judged pose after installation": 8.0,
    "Autopilot after installation": 90.0,
    "`slviewer reproduce --quick` after installation": 60.0,
    "`slviewer reproduce --quick` again": 30.0,
}
"""Seconds that a person may have to wait, at 800x600 on two cores. After installation no kernel is
compiled yet."""
_SAMPLING_S = 0.02
_FUNCTIONS = 8
"""Shown of the slowest act."""


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
        if self._last_frame is not None and (
            stage := _get_new_result(before.session, snapshot.session)
        ):
            self.seconds[stage].append(now - self._last_frame)

    def time_after_installation(self, folder: Path, scale: float) -> None:
        """Time the Autopilot and ``reproduce`` with folders for compiled kernels that are empty."""
        code = (
            f"from {__name__} import run_autopilot as run; run({str(folder / 'first')!r}, {scale})"
        )
        environment = {"NUMBA_CACHE_DIR": str(folder / "autopilot"), _STARTED: str(time.time())}
        first, whole = map(float, run_python("-c", code, **environment).split()[-2:])
        self.seconds["first judged pose after installation"].append(first)
        self.seconds["Autopilot after installation"].append(whole)
        for name in ("after installation", "again"):
            begun = time.perf_counter()
            command = "reproduce", "--quick", "--out", str(folder / name)
            run_python("-m", "slviewer.cli", *command, NUMBA_CACHE_DIR=str(folder / "reproduction"))
            self.seconds[f"`slviewer reproduce --quick` {name}"].append(time.perf_counter() - begun)


def _get_new_result(before: SessionView, after: SessionView) -> str:
    """The stage whose result a session has and did not have before: a verification, or a scan's
    cloud; else empty."""
    if len(after.list_records(Verification)) > len(before.list_records(Verification)):
        return "verify a plane or a sphere with all models"
    clouds = [sum(scan.cloud == "fresh" for scan in session.scans) for session in (before, after)]
    if clouds[1] > clouds[0] and any(scan.purpose == "scan" for scan in after.scans):
        return "last frame of a scan to its cloud"
    return ""


def _is_counted(module: str) -> bool:
    """Whether samples are counted for a module's functions: the package's, but for the wrapper of
    every kernel."""
    return module.startswith("slviewer.") and module != "slviewer.geometry.jit"


class _Sampler:
    """Samples, on a thread of its own, which of the counted functions every other thread is in, act
    by act."""

    def __init__(self) -> None:
        self.act = ""
        self.samples: dict[str, Counter[str]] = {}
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._run, name="slviewer sampler", daemon=True)

    def __enter__(self) -> "_Sampler":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stopped.set()
        self._thread.join()

    def _run(self) -> None:
        """Count the innermost function that is counted in every thread that is not waiting."""
        while not self._stopped.wait(_SAMPLING_S):
            for thread, frame in sys._current_frames().items():
                if thread == self._thread.ident or frame.f_code.co_filename.endswith(_WAITING):
                    continue
                inner: Any = frame
                while inner is not None and not _is_counted(inner.f_globals.get("__name__", "")):
                    inner = inner.f_back
                if inner is not None:
                    name = f"{inner.f_globals['__name__']}.{inner.f_code.co_qualname}".replace(
                        ".<locals>", ""
                    )
                    self.samples.setdefault(self.act, Counter())[name] += 1


_WAITING = ("threading.py", "selectors.py", "socket.py", "queue.py", "subprocess.py")
"""Files of the standard library in which a thread waits."""


def time_wizard(scale: float, progress: Progress) -> list[Row]:
    """Rows of what an operator waits for, with the seconds of the slowest acts of the Autopilot and
    of the functions that the slowest one spent them in.

    ``scale``: resolution of the camera, as a share of 1600x1200. Kernels are compiled before the
    wizard is measured.
    """
    acts: list[tuple[str, float]] = []

    def begin(act: str) -> None:
        """Note when an act begins."""
        acts.append((act, time.perf_counter()))
        sampler.act = act
        progress(min(0.3, 0.01 * len(acts)), act)

    with tempfile.TemporaryDirectory(prefix="slviewer-bench-") as folder, _Sampler() as sampler:
        for name in ("warm", "session"):  # the first run compiles what is not compiled yet
            acts.clear()
            watch, session = _Stopwatch(), Path(folder, name)
            _run_autopilot(
                session, scale if name == "session" else min(scale, 0.25), watch.note, begin
            )
        lasted = [(act, after - at) for (act, at), (_, after) in pairwise(acts)]
        watch.seconds["Autopilot"].append(acts[-1][1] - acts[0][1])
        watch.seconds[f"calibrate {POSES} poses"] += [
            seconds for act, seconds in lasted if act == "Calibrating"
        ]
        progress(0.3, "reconstructing again")
        watch.seconds["reconstruct again in the same process"].append(
            median(lambda: reconstruct(session, "scan_01", out=Path(folder, "again.ply")), 5)
        )
        progress(0.35, "commands")
        for name, times, *arguments in (
            ("`slviewer reconstruct` as a command", 3, "reconstruct", str(session), "scan_01"),
            (f"`slviewer validate` on {POSES} poses", 1, "validate", str(session)),
            ("`slviewer --help`", 5, "--help"),
        ):
            watch.seconds[name].append(
                median(partial(run_python, "-m", "slviewer.cli", *arguments), times, times > 1)
            )
        progress(0.5, "after installation")
        watch.time_after_installation(Path(folder), scale)
    progress(1.0, "measured")
    rows = []
    for stage, limit in LIMITS.items():
        measured = watch.seconds[stage] or [float("nan")]
        note = f"median of {len(measured)}, the longest {1e3 * max(measured):.0f} ms"
        note *= len(measured) > 1
        rows.append(row(stage, statistics.median(measured), target=limit, note=note))
        if max(measured) > limit:  # of every time, not of their median
            rows[-1]["holds"] = "no"
    slowest = sorted(lasted, key=lambda each: -each[1])[:_FUNCTIONS]
    rows += [row(f"Autopilot: {act}", seconds) for act, seconds in slowest]
    inside = sampler.samples.get(slowest[0][0], Counter())
    return rows + [
        row(
            f"  {name.removeprefix('slviewer.')}",
            slowest[0][1] * count / inside.total(),
            note=f"in {slowest[0][0]}",
        )
        for name, count in inside.most_common(_FUNCTIONS)
    ]


def _run_autopilot(
    session: Path, scale: float, note: Callable[[Snapshot], None], begin: Callable[[str], None]
) -> None:
    """Run the Autopilot; ``note`` gets the snapshots, ``begin`` the name of each act and, at the
    end, an empty one."""
    with Operator(session, {**RIG, "scale": scale}) as operator:
        stop = operator.subscribe(note)
        Autopilot(operator, poses=POSES, before=begin).run()
        begin("")
        stop()


def run_autopilot(session: str, scale: float) -> None:
    """Run the Autopilot, and print the seconds since the process was started: at the first pose,
    and at the end."""
    started = time.time() - float(os.environ[_STARTED])
    first: list[float] = []

    def note(snapshot: Snapshot) -> None:
        """Note the time of the first pose."""
        if not first and snapshot.session is not None and snapshot.session.poses:
            first.append(time.perf_counter() - begun)

    begun = time.perf_counter()
    with Preparation():
        _run_autopilot(Path(session), scale, note, lambda act: None)
    print(started + first[0], started + time.perf_counter() - begun)


_STARTED = "SLVIEWER_BENCH_STARTED"
