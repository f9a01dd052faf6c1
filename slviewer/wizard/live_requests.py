"""Requests to start, save and stop a live scan."""

from collections.abc import Callable
from dataclasses import replace

from slviewer.devices.capture import CapturedFrames
from slviewer.errors import InputError
from slviewer.fringe.presets import short
from slviewer.pipeline.capture import depth_axis, save_frames
from slviewer.wizard.capture_requests import CaptureRequests
from slviewer.wizard.live_scan import LiveCloud, LiveScan
from slviewer.wizard.requests import request


class LiveRequests(CaptureRequests):
    """Requests that start, save and stop live scans, and subscriptions to their clouds."""

    @request("Scanning live")
    def start_live(self) -> None:
        """Start a live scan, which ends at `stop_live`, a capture, another rig or session, or a
        fault."""
        engine = self._engine
        calibration = engine.publisher.refresh().calibration
        if calibration is None:
            raise InputError("calibrate first: a live scan needs a calibration")
        bench, store = engine.bench, engine.store
        if bench is None:
            raise InputError("no rig is chosen: choose one in the step Rig")
        if bench.reel is not None:
            raise InputError(
                "a recording holds only its own patterns: choose a real rig or the simulated one"
            )
        axis = depth_axis(calibration.stereo.rig)
        sequence = replace(short(bench.rig.projector.size, axis), levels=engine.reader.levels())
        live = LiveScan(
            store, axis, sequence, engine.acquisition, engine.notices, engine.live_listeners.call,
            engine.publisher.mark_changed,
        )  # fmt: skip
        live.start()
        engine.set_live(live)

    @request("Ending the live scan")
    def stop_live(self) -> None:
        """End the live scan, if one runs."""
        self._engine.acquisition.stop_stream()

    @request("Saving the live scan")
    def save_live(self, label: str = "") -> None:
        """Save the frames of the latest live cloud as a scan, and reconstruct it; the live scan
        goes on."""
        engine = self._engine
        live, store = engine.live, engine.store
        shot = live.stream.copy_latest() if live is not None and live.is_running else None
        if live is None or shot is None:
            raise InputError("no live scan runs: start one, and wait for a cloud")
        name = self._next_name("scan")
        self._check_space(name, len(shot.frames))
        source = engine.acquisition.view().name
        save_frames(
            store,
            name,
            "scan",
            CapturedFrames(shot.frames, shot.settings, live.stream.sequence, source),
        )
        self._set_label(name, label)
        engine.queue_processing()
        self._finish_scan(name)

    def subscribe_live(self, listener: Callable[[LiveCloud], None]) -> Callable[[], None]:
        """Call back with every live cloud, on the live scan's thread; returns a function that
        unsubscribes.

        A listener must return at once.
        """
        return self._engine.live_listeners.add(listener)

    @property
    def live_captures(self) -> int:
        """The number of short captures of the latest live scan, including those without a cloud."""
        return 0 if self._engine.live is None else self._engine.live.stream.captured

    def count_live_shown(self, cloud: LiveCloud) -> None:
        """Record that a cloud was sent to the browsers, which ends its latency."""
        if self._engine.live is not None:
            self._engine.live.count_shown(cloud)
