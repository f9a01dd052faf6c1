"""Requests to scan all round on a turntable."""

from collections.abc import Sequence
from functools import partial

import numpy as np

from slviewer.devices.capture import capture_with_texture
from slviewer.devices.protocols import Rig
from slviewer.errors import DeviceError
from slviewer.pipeline.capture import save_frames
from slviewer.pipeline.feedback import Progress
from slviewer.pipeline.turn import (
    FULL_TURN_DEG,
    STEPS,
    capture_turn,
    missing_steps,
    next_turn,
    place_object,
    plan_turn,
    recorded_steps,
    require_turntable,
)
from slviewer.session.capture import TurnStep
from slviewer.wizard import tasks
from slviewer.wizard.capture_requests import CaptureRequests, scan_sequence
from slviewer.wizard.merge_requests import MERGING, MergeRequests
from slviewer.wizard.requests import request


class TurnRequests(CaptureRequests, MergeRequests):
    """Captures of all steps of a turn, each reconstructed while the table turns on."""

    @request("Scanning all round")
    def scan_all_round(
        self, steps: int = STEPS, range_deg: float = FULL_TURN_DEG, *, then_merge: bool = True
    ) -> None:
        """Capture and reconstruct the steps of a turn; `then_merge` merges them and makes a
        watertight mesh."""
        self._scan_turn(plan_turn(next_turn(self._engine.store), steps, range_deg), then_merge)

    @request("Resuming the turn")
    def resume_turn(self, *, then_merge: bool = True) -> None:
        """Capture the missing steps of the last turn."""
        self._scan_turn(missing_steps(self._engine.store), then_merge)

    def _scan_turn(self, steps: Sequence[TurnStep], then_merge: bool) -> None:
        """Queue the capture of steps of one turn."""
        engine, store, bench = self._engine, self._engine.store, self._engine.bench
        sequence, turn = scan_sequence(engine), steps[0].turn
        if bench is None:
            raise DeviceError("no rig is chosen: choose one in the step Rig")
        require_turntable(bench.rig)
        exposures, recorded = engine.reader.exposures_ms(), recorded_steps(store, turn)
        frames = len(sequence.frames) * max(1, len(exposures))
        self._check_space(turn, frames * len(steps))
        place_object(bench)

        def work(rig: Rig, progress: Progress) -> None:
            """Capture all steps into one buffer."""
            width, height = rig.camera.size
            buffer = np.empty((frames, height, width), rig.camera.dtype)

            def capture_step(step: TurnStep, progress: Progress) -> None:
                """Capture and save one step, and queue its reconstruction."""
                captured = capture_with_texture(
                    rig,
                    sequence,
                    exposures,
                    buffer,
                    lambda done, n: progress(done / n, f"frame {done} of {n}"),
                )
                save_frames(store, step.name, "scan", captured, turn_step=step)
                engine.queue_processing()
                self._finish_scan(step.name)

            capture_turn(rig, steps, capture_step, recorded, progress, self._warner("scans"))

        def done(_: None) -> None:
            """Report the captured turn, and queue its merge."""
            names = [step.name for step in recorded_steps(store, turn)]
            engine.notices.add("good", f"{turn}: {len(names)} scans all round")
            if then_merge:
                merge = partial(tasks.merge_scanned_turn, store, names, warn=self._warner("merge"))
                self._submit(MERGING, merge, tasks.describe_turn, self._begin_merge("turntable"))

        engine.acquisition.run_task("Scanning all round", work, done)
