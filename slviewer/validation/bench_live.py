"""How fast live clouds reach those who look, measured with the wizard itself and with viewers on
real connections."""

import contextlib
import socket
import statistics
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
import viser
import zstandard
from websockets.exceptions import WebSocketException
from websockets.sync.client import ClientConnection, connect
from websockets.sync.connection import Connection

from slviewer.errors import SlviewerError
from slviewer.gui.app import App
from slviewer.pipeline.operation import Progress, ignore_progress
from slviewer.pipeline.simulate import save_true_stereo
from slviewer.server.secure import SafeServer, Serving
from slviewer.session.store import Session
from slviewer.simulation.rig import letter
from slviewer.wizard.operator import Operator
from slviewer.wizard.snapshot import LiveView, Snapshot

_VIEWPOINT = {
    "wxyz": [1.0, 0.0, 0.0, 0.0],
    "position": [0.0, 0.0, -500.0],
    "fov": 0.75,
    "near": 1.0,
    "far": 10_000.0,
    "image_height": 720,
    "image_width": 1280,
    "look_at": [0.0, 0.0, 500.0],
    "up_direction": [0.0, -1.0, 0.0],
}
_PATIENCE_S = 600.0  # kernels may have to be compiled first
_WARM_S = 1.0
_STALLED_AFTER_S = 60.0
MAX_GROWTH_MB = 20.0
"""More than this between the beginning and the end of a live scan, and memory is not flat."""


@dataclass(frozen=True)
class LiveFigures:
    """A live scan of `seconds` by a camera of `size` px, with one viewer that draws and, after a
    third of the time or a minute, one that has stalled.

    Captures a second before and after that; clouds a second decoded, reconstructed and sent to the
    viewer that draws; `latency_ms`: the median from the first frame's light until a cloud is sent,
    NaN where none was. `growth_mb`, `growth_files`, `growth_threads`: how much more memory, open
    files and threads the program had in the last tenth of the time than in a tenth of it soon after
    the stalled viewer came, None where the system does not report it.
    """

    size: tuple[int, int]
    seconds: float
    captures_per_s: float
    captures_per_s_stalled: float
    clouds_per_s: float
    shown_per_s: float
    latency_ms: float
    points: int
    growth_mb: float | None
    growth_files: float | None
    growth_threads: float | None

    def text(self) -> str:
        """Return the figures as lines for the terminal."""
        growth = "memory unknown"
        if self.growth_mb is not None:
            flat = "yes" if self.growth_mb <= MAX_GROWTH_MB else "no"
            growth = f"memory {self.growth_mb:+.1f} MB (flat within {MAX_GROWTH_MB:g} MB: {flat})"
            growth += f", files {self.growth_files:+g}, threads {self.growth_threads:+g}"
        return (
            f"live at {self.size[0]}x{self.size[1]} for {self.seconds:.0f} s:"
            f" {self.shown_per_s:.1f} clouds/s sent to a viewer, {self.latency_ms:.0f} ms behind"
            f" the light ({self.clouds_per_s:.1f}/s made of {self.points:,} points); captures"
            f" {self.captures_per_s:.1f}/s, beside a stalled viewer"
            f" {self.captures_per_s_stalled:.1f}/s; {growth}"
        )


def live_rate(scale: float, seconds: float, progress: Progress = ignore_progress) -> LiveFigures:
    """Scan the demo object live on the simulated rig, its camera 1600x1200 times `scale`, settled
    at once.

    Clouds are reconstructed by the stereo model of the true lenses; the figures begin a
    second after the first one. Raises SlviewerError where live scanning fails.
    """
    progress(0.0, "preparing the rig")
    with tempfile.TemporaryDirectory() as folder:
        session = Path(folder) / "session"
        with Session.create(session) as store:
            save_true_stereo(store, letter(scale))
        with (
            Operator(session, {"driver": "simulated", "scale": scale}) as operator,
            contextlib.closing(App(operator, Serving(port=0))) as app,
        ):
            app.shell.go("scan")
            _wait_for(operator, lambda now: now.rig.state == "open")
            operator.place("object")
            with _viewing(app.server, draws=True):
                operator.start_live()
                _wait_for(operator, lambda now: now.live is not None and now.live.shown_per_s > 0)
                time.sleep(_WARM_S)
                return _measure(operator, app.server, seconds, progress)


def _measure(
    operator: Operator, server: SafeServer, seconds: float, progress: Progress
) -> LiveFigures:
    """Figures of the running live scan over so many seconds, with a second viewer that stops
    reading."""
    begun, first = time.monotonic(), operator.live_captures
    samples: list[tuple[float, LiveView, tuple[float, ...]]] = []
    alone = min(seconds / 3, _STALLED_AFTER_S)
    with contextlib.ExitStack() as stack:
        halfway, then = 0.0, 0
        while (passed := time.monotonic() - begun) < seconds or not halfway:
            if not halfway and passed > alone:
                halfway, then = passed, operator.live_captures
                stack.enter_context(_viewing(server, draws=False))
            time.sleep(min(0.25, seconds / 20))
            live = operator.snapshot().live
            if live is None:
                raise SlviewerError(f"the live scan ended: {_get_last_notice(operator)}")
            samples.append((passed, live, _measure_use()))
            progress(min(passed / seconds, 0.999), f"live: {live.shown_per_s:.1f} clouds/s")
    captures = operator.live_captures
    camera = operator.snapshot().rig.camera
    assert camera is not None
    growth: list[float | None] = [None] * 3
    first_uses, last_uses = (
        [use for at, _, use in samples if low < at <= low + seconds / 10]
        for low in (1.5 * alone, 0.9 * seconds)
    )
    if first_uses and last_uses and not np.isnan(first_uses).any():
        growth = (np.median(last_uses, axis=0) - np.median(first_uses, axis=0)).tolist()
    lives = [live for _, live, _ in samples]
    made, shown = np.median(
        [(live.clouds_per_s, live.shown_per_s) for live in lives], axis=0
    ).tolist()
    behind = [live.latency_ms for live in lives if live.latency_ms is not None]
    return LiveFigures(
        camera,
        seconds,
        (then - first) / halfway,
        (captures - then) / (time.monotonic() - begun - halfway),
        made,
        shown,
        statistics.median(behind or [float("nan")]),
        lives[-1].points,
        *growth,
    )


@contextlib.contextmanager
def _viewing(server: SafeServer, draws: bool) -> Iterator[None]:
    """A browser's connection: with `draws` it receives and acknowledges everything, otherwise it
    reads nothing."""
    closing = threading.Event()
    thread = threading.Thread(
        target=_run_viewer, args=(server, draws, closing), name="viewer", daemon=True
    )
    thread.start()
    try:
        yield
    finally:
        closing.set()
        thread.join(5.0)


def _run_viewer(server: SafeServer, draws: bool, closing: threading.Event) -> None:
    """Connect again and again until closed, and draw or stall according to ``draws``."""
    while not closing.is_set():
        with contextlib.suppress(WebSocketException, OSError), _connect(server) as connection:
            connection.send(msgspec.msgpack.encode({"type": "ViewerCameraMessage", **_VIEWPOINT}))
            if draws:
                _answer_requests(connection, closing)
            else:  # until the server gives it up, and once more then
                while not closing.wait(0.1) and connection.state.name == "OPEN":
                    pass


def _answer_requests(connection: Connection, closing: threading.Event) -> None:
    """Receive messages until closed, and answer the server's requests for acknowledgement."""
    unpack = zstandard.ZstdDecompressor()
    while not closing.is_set():
        try:
            raw = connection.recv(timeout=0.2)
        except TimeoutError:
            continue
        assert isinstance(raw, bytes)
        whole, packed = (int.from_bytes(raw[at : at + 8], "little") for at in (0, 8))
        received = msgspec.msgpack.decode(unpack.decompress(raw[16 : 16 + packed], whole))
        for message in received["messages"]:
            if message["type"] == "LocalStorageGetItemRequestMessage":
                answer = {"value": None, "error": None, "request_uuid": message["request_uuid"]}
                kind = "LocalStorageGetItemResponseMessage"
                connection.send(msgspec.msgpack.encode({"type": kind, **answer}))


def _connect(server: SafeServer) -> ClientConnection:
    """Open a WebSocket to the server with the view token, as viser's page does."""
    grant, host = server.access.grants["watch"], f"127.0.0.1:{server.port}"
    return connect(
        f"ws://{host}{grant.path}/",
        sock=socket.create_connection(("127.0.0.1", server.port), timeout=5),
        additional_headers=[
            ("Cookie", f"{grant.cookie_name}={grant.value}"),
            ("Origin", f"http://{host}"),
        ],
        subprotocols=[f"viser-v{viser.__version__}"],  # type: ignore[list-item]
        max_size=2**26,
        ping_interval=None,  # who stalls does not give up by itself
    )


def _wait_for(operator: Operator, condition: Callable[[Snapshot], bool]) -> None:
    """Wait until the condition holds; raises SlviewerError when it takes too long."""
    if operator.wait_for(condition, _PATIENCE_S) is None:
        raise SlviewerError(
            f"the live scan did not begin within {_PATIENCE_S:.0f} s: {_get_last_notice(operator)}"
        )


def _get_last_notice(operator: Operator) -> str:
    """Text of the operator's last notice."""
    notices = operator.snapshot().notices
    return notices[-1].text if notices else "nobody said why"


def _measure_use() -> tuple[float, float, float]:
    """Memory, MB, open files and threads of this process; NaN where the system does not report
    them."""
    if sys.platform == "win32":
        return (float("nan"),) * 3
    import resource

    try:
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
        files = len(list(Path("/proc/self/fd").iterdir()))
    except OSError:
        return (float("nan"),) * 3
    return pages * resource.getpagesize() / 1e6, files, threading.active_count()
