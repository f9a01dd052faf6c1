"""What an operator can ask of a live scan."""

from abc import abstractmethod
from collections.abc import Callable

from slviewer.wizard.live_scan import LiveCloud, keep_live, start_live
from slviewer.wizard.requests import Asked, request


class LiveRequests(Asked):
    """Starting, ending and keeping; and hearing of its clouds."""

    @abstractmethod
    def reconstruct(self, name: str, model: str | None = None) -> bool:
        """Reconstruct a capture."""

    @request("Scanning live")
    def start_live(self) -> None:
        """Show clouds while patterns run, until `stop_live`, a capture, another rig or session, or a fault."""
        start_live(self._engine)

    @request("Ending the live scan")
    def stop_live(self) -> None:
        """Scan live no longer; nothing happens where nothing does."""
        self._engine.acquisition.unstream()

    @request("Keeping the live scan")
    def keep_live(self, label: str = "") -> None:
        """Save what the latest live cloud was made of as a scan, and reconstruct it; the live scan goes on."""
        keep_live(self._engine, label, self.reconstruct)

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
