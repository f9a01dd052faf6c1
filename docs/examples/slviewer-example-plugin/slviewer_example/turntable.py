"""A turntable that a controller turns by lines of text over TCP: `TURN 30.000`, `WHERE?`, `STOP`.

The controller answers each line with `OK ANGLE`, or `MOVING ANGLE` until it stands still.
"""

import socket
import time
from collections.abc import Callable
from contextlib import suppress

from slviewer.plugins import Driver, Openable, TurntableError, check_angle


class TcpTurntable(Openable):
    """A turntable at `host`:`port`. `timeout_s`: how long a turn may take."""

    limits_deg = None
    is_absolute = False

    def __init__(self, host: str, port: int = 5025, timeout_s: float = 60.0) -> None:
        super().__init__("the TCP turntable")
        self._address, self._timeout_s = (host, port), timeout_s
        self._connection: socket.socket | None = None

    def open(self) -> None:
        """Connect to the controller."""
        super().open()
        try:
            self._connection = socket.create_connection(self._address, timeout=2.0)
        except OSError as error:
            super().close()
            raise TurntableError(
                f"{self.name} does not answer at {self._address[0]}:{self._address[1]} ({error})",
                "is it switched on?",
            ) from error

    def close(self) -> None:
        """Disconnect."""
        if self._connection is not None:
            self._connection.close()
        self._connection = None
        super().close()

    def position_deg(self) -> float:
        """Read the angle."""
        self.check_open()
        return self._request("WHERE?")[1]

    def turn_to(self, deg: float, check: Callable[[], None] = lambda: None) -> None:
        """Turn to an angle, and wait until it stands still."""
        self.check_open()
        check_angle(self, deg)
        end = time.monotonic() + self._timeout_s
        try:
            state, _ = self._request(f"TURN {deg:.3f}")
            check()
            while state == "MOVING":
                if time.monotonic() > end:
                    raise TurntableError(
                        f"{self.name} is still turning after {self._timeout_s:g} s",
                        "is it blocked?",
                    )
                check()
                time.sleep(0.02)
                state, _ = self._request("WHERE?")
        except BaseException:
            self._stop()
            raise

    def _stop(self) -> None:
        """Stop turning, as far as it can be reached."""
        with suppress(TurntableError):
            self._request("STOP")

    def _request(self, line: str) -> tuple[str, float]:
        """Send a line, and return the state and the angle of the answer."""
        assert self._connection is not None
        try:
            self._connection.sendall(f"{line}\n".encode("ascii"))
            answer = b""
            while not answer.endswith(b"\n"):
                received = self._connection.recv(256)
                if not received:
                    raise OSError("the connection was closed")
                answer += received
            state, angle = answer.decode("ascii").split()
            if state not in ("OK", "MOVING"):
                raise ValueError(state)
            return state, float(angle)
        except (OSError, ValueError) as error:
            raise TurntableError(
                f"{self.name} did not answer {line!r} properly ({error})", "check its cable"
            ) from error


DRIVER = Driver(
    "tcpturntable",
    "turntables whose controller takes lines of text over TCP",
    turntable=TcpTurntable,
)
