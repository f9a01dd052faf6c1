"""What an operator can ask of a live scan."""

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import replace

from slviewer.devices.capture import Taken
from slviewer.errors import InputError
from slviewer.fringe.presets import short
from slviewer.pipeline.capture import keep
from slviewer.wizard.capture_requests import check_space, depth_axis, next_name
from slviewer.wizard.live_scan import Live, LiveCloud
from slviewer.wizard.requests import RequestHandler, request


class LiveRequests(RequestHandler):
    """Starting, ending and keeping; and hearing of its clouds."""

    @abstractmethod
    def reconstruct(self, name: str, model: str | None = None) -> bool:
        """Reconstruct a capture."""

    @request("Scanning live")
    def start_live(self) -> None:
        """Show clouds while patterns run, until `stop_live`, a capture, another rig or session, or a fault."""
        engine = self._engine
        view = engine.publisher.now().session
        if view is None or view.calibration is None:
            raise InputError("calibrate first: without a calibration nothing can be measured live")
        bench, store = engine.bench, engine.store
        if bench is None:
            raise InputError("no rig is chosen: choose one in the step Rig")
        if bench.reel is not None:
            raise InputError("a recording answers to its own patterns alone: choose a real rig or the simulated one")
        axis = depth_axis(view.calibration)
        sequence = replace(short(bench.rig.projector.size, axis), levels=engine.reader.levels())
        live = Live(
            store, axis, sequence, engine.acquisition, engine.notices, engine.publish_live, engine.publisher.changed
        )
        live.start()
        engine.live = live

    @request("Ending the live scan")
    def stop_live(self) -> None:
        """Scan live no longer; nothing happens where nothing does."""
        self._engine.acquisition.unstream()

    @request("Keeping the live scan")
    def keep_live(self, label: str = "") -> None:
        """Save what the latest live cloud was made of as a scan, and reconstruct it; the live scan goes on."""
        engine = self._engine
        live, store = engine.live, engine.store
        shot = live.stream.kept() if live is not None and live.running else None
        if live is None or shot is None:
            raise InputError("nothing is scanned live: press Live first, and wait for a cloud")
        name = next_name(engine, "scan")
        check_space(engine, name, len(shot.frames))
        taken = Taken(shot.frames, shot.settings)
        source = engine.acquisition.view().name
        keep(store, name, "scan", live.stream.sequence, taken, source=source, purpose="scan")
        if label.strip():
            store.decide("names", {**(store.decision("names") or {}), name: label.strip()})
        engine.queue_unfinished()
        self.reconstruct(name)

    def on_live(self, listener: Callable[[LiveCloud], None]) -> Callable[[], None]:
        """Hear of every live cloud, on the thread that makes them; returns how to stop. A listener returns at once."""
        engine = self._engine
        with engine.lock:
            engine.live_listeners = [*engine.live_listeners, listener]

        def stop() -> None:
            with engine.lock:
                engine.live_listeners = [each for each in engine.live_listeners if each is not listener]

        return stop

    @property
    def live_captures(self) -> int:
        """How many short captures the latest live scan has taken, those included that nobody made a cloud of."""
        return 0 if self._engine.live is None else self._engine.live.stream.taken

    def live_shown(self, cloud: LiveCloud) -> None:
        """Whoever heard of a live cloud has sent it to those who look: what the latency is counted to."""
        if self._engine.live is not None:
            self._engine.live.shown(cloud)
