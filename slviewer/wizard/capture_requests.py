"""Requests to capture: what is projected, the name under which it is saved, and what follows."""

from collections.abc import Callable
from dataclasses import replace
from typing import Literal

from slviewer.devices.capture import CapturedFrames
from slviewer.errors import DeviceError, InputError
from slviewer.fringe.sequence import PatternSequence, one_axis
from slviewer.pipeline.capture import check_space, choose_sequence, depth_axis, save_frames
from slviewer.session.names import clean_label
from slviewer.wizard.acquisition import CaptureRequest
from slviewer.wizard.engine import Engine
from slviewer.wizard.requests import request
from slviewer.wizard.result_requests import ResultRequests

Purpose = Literal["scan", "plane", "sphere"]


class CaptureRequests(ResultRequests):
    """Captures of the target, of objects, planes and spheres."""

    @request("Capturing the pose")
    def capture_pose(self) -> None:
        """Capture the board where it is; its features are evaluated in the background."""
        # first: a capture that fails is not repeated with every preview
        self._engine.hands_free.note_capture()
        self._capture_pose(self._next_name("pose"), retake=False)

    @request("Retaking the pose")
    def retake_pose(self, name: str) -> None:
        """Capture the board in place of a pose; the old one goes to the trash once the new one is
        saved."""
        if self._engine.store.load_capture(name).role != "calibration":
            raise InputError(f"{name} is not a target pose: capture another scan instead")
        self._engine.hands_free.note_capture()
        self._capture_pose(name, retake=True)

    @request("Capturing the scan")
    def capture_scan(self, label: str = "") -> None:
        """Capture an object and reconstruct it; `label` is the operator's name for it, any text."""
        self._capture_scan("scan", label, self._finish_scan)

    @request("Capturing the plane")
    def capture_plane(self, label: str = "") -> None:
        """Capture a flat plate and compare the models on it."""
        self._capture_scan("plane", label, lambda name: self.verify([name], "plane"))

    @request("Capturing the sphere")
    def capture_sphere(self, label: str = "") -> None:
        """Capture a sphere and compare the models on it."""
        self._capture_scan("sphere", label, lambda name: self.verify([name], "sphere"))

    @request("Switching hands-free capture")
    def set_hands_free(self, on: bool) -> None:
        """Capture a pose whenever the board is held still in a new place."""
        self._engine.hands_free.switch(on)

    def _capture_pose(self, name: str, retake: bool) -> None:
        """Queue the capture of a target pose; `retake` replaces the one of that name."""
        engine, store, target = self._engine, self._engine.store, self._engine.reader.target()
        if not target:
            raise InputError("choose the target first: a pose is judged by it")
        sequence = pose_sequence(engine)

        def save(captured: CapturedFrames) -> None:
            """Save the captured frames as a target pose; a retaken pose is included again."""
            save_frames(store, name, "pose", captured, board=target, force=retake)
            if retake and name in store.excluded():
                store.include(name)

        self._queue_capture(name, sequence, save)

    def _capture_scan(self, purpose: Purpose, label: str, follow: Callable[[str], object]) -> None:
        """Queue the capture of a scan, plane or sphere; `follow(name)` is called once it is
        saved."""
        engine, store = self._engine, self._engine.store
        sequence = scan_sequence(engine)
        name = self._next_name(purpose)

        def save(captured: CapturedFrames) -> None:
            """Save the captured frames as a scan, with the operator's label."""
            save_frames(store, name, purpose, captured)
            self._set_label(name, label)

        self._queue_capture(name, sequence, save, lambda: follow(name))

    def _queue_capture(
        self,
        name: str,
        sequence: PatternSequence,
        save: Callable[[CapturedFrames], None],
        follow: Callable[[], object] = lambda: None,
    ) -> None:
        """Queue a capture; `follow()` is called once it is saved. Raises SessionError where the
        disk is too full."""
        engine, bench = self._engine, self._engine.bench
        exposures = engine.reader.exposures_ms()
        self._check_space(name, len(sequence.frames) * max(1, len(exposures)))

        def saved() -> None:
            """Queue the processing of the saved capture, call `follow`, and advance a replayed
            recording."""
            engine.queue_processing()
            follow()
            engine.publisher.mark_changed(session=True)
            if bench is not None and bench.reel is not None:
                # the next recording may lack these
                if engine.acquisition.view().light in (
                    "dark",
                    "pattern",
                ):
                    engine.acquisition.set_light("white")
                bench.reel.wind_on()

        engine.acquisition.capture(CaptureRequest(name, sequence, save, saved, exposures))

    def _set_label(self, name: str, label: str) -> None:
        """Store the operator's label of a capture, unless it is blank."""
        store = self._engine.store
        if label.strip():
            store.decide("names", {**(store.decision("names") or {}), name: clean_label(label)})

    def _check_space(self, name: str, frames: int) -> None:
        """Raise SessionError where the disk has no room for so many frames."""
        if self._engine.bench is not None:
            check_space(self._engine.store, self._engine.bench.rig.camera, frames, name)

    def _next_name(self, kind: str) -> str:
        """Return the next unused name, such as pose_07, counting saved and queued captures."""
        used_names = [*self._engine.store.taken_names(), *self._engine.acquisition.names()]
        numbers = [
            name.removeprefix(f"{kind}_") for name in used_names if name.startswith(f"{kind}_")
        ]
        number = max((int(number) for number in numbers if number.isdecimal()), default=0) + 1
        return f"{kind}_{number:02d}"


def pose_sequence(engine: Engine) -> PatternSequence:
    """Return the sequence for target poses: the session's pattern sequence along both axes, or that
    of a recording."""
    if engine.bench is None:
        raise DeviceError("no rig is chosen: choose one in the step Rig")
    sequence = choose_sequence(engine.bench, engine.reader.patterns())
    levels = engine.reader.levels()
    return sequence if levels is None else replace(sequence, levels=levels)


def scan_sequence(engine: Engine) -> PatternSequence:
    """Return the sequence for scans: that of poses along the one axis that measures depth.
    InputError before a calibration."""
    calibration = engine.publisher.refresh().calibration
    if calibration is None:
        raise InputError("calibrate first: a capture cannot be measured without a calibration")
    sequence = pose_sequence(engine)
    if engine.bench is None or engine.bench.reel is not None:
        return sequence
    return one_axis(sequence, depth_axis(calibration.stereo.rig))  # half of the frames
