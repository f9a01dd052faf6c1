"""A camera on the network: an HTTP server that sends what it sees, picture after picture, on
127.0.0.1."""

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import cv2
import numpy as np


class NetworkCamera(ThreadingHTTPServer):
    """Looks at `picture`, (h, w) or (h, w, 3) BGR, `fps` times a second, and sends `clump` pictures
    at a time.

    Once it was told to `take` pictures, it sends each of these instead, when it is taken. `sent`
    counts the pictures that it has sent, or is about to.
    """

    daemon_threads = True
    allow_reuse_address = True

    def __init__(
        self, picture: np.ndarray, fps: float = 30.0, clump: int = 1, port: int = 0
    ) -> None:
        super().__init__(("127.0.0.1", port), _Sender)
        self.picture, self.fps, self.clump = picture, fps, clump
        self.going = threading.Event()
        self.going.set()
        self.dead = False
        self.taken = 0
        self.sent = 0
        self._shutter = threading.Condition()
        self._thread = threading.Thread(
            target=self.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True
        )
        self._thread.start()

    @property
    def port(self) -> int:
        return self.server_address[1]

    @property
    def url(self) -> str:
        return f"http://somebody:secret@127.0.0.1:{self.port}/video"

    def take(self, picture: np.ndarray) -> None:
        """Send this picture to whoever looks now."""
        with self._shutter:
            self.picture, self.taken = picture, self.taken + 1
            self._shutter.notify_all()

    def wait_for_another(self, taken: int) -> int:
        """Wait until another picture than number `taken` is there; its number."""
        with self._shutter:
            self._shutter.wait_for(lambda: self.taken != taken, 0.5)
            return self.taken

    def die(self) -> None:
        """End all connections and listen no more."""
        self.dead = True
        self.going.set()
        self.shutdown()
        self.server_close()
        self._thread.join(2)


class _Sender(BaseHTTPRequestHandler):
    server: NetworkCamera

    def log_message(self, *args: object) -> None:
        pass

    def do_GET(self) -> None:
        self.send_response(200)
        self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=picture")
        self.end_headers()
        clump, due = b"", time.monotonic()
        sent = 0
        taken = self.server.taken
        while not self.server.dead:
            if self.server.taken:
                taken = self.server.wait_for_another(taken)
            jpeg = cv2.imencode(".jpg", self.server.picture)[1].tobytes()
            head = b"--picture\r\nContent-Type: image/jpeg\r\n"
            head += f"Content-Length: {len(jpeg)}\r\n\r\n".encode()
            clump += head + jpeg + b"\r\n"
            sent += 1
            self.server.sent += 1
            due = max(due + 1 / self.server.fps, time.monotonic() - 0.1)
            time.sleep(max(0.0, due - time.monotonic()))
            self.server.going.wait()
            try:
                if sent % self.server.clump == 0:
                    self.wfile.write(clump)
                    clump = b""
            except OSError:
                return


@contextmanager
def network_camera(
    picture: np.ndarray, fps: float = 30.0, clump: int = 1, port: int = 0
) -> Iterator[NetworkCamera]:
    camera = NetworkCamera(picture, fps, clump, port)
    try:
        yield camera
    finally:
        if not camera.dead:
            camera.die()
