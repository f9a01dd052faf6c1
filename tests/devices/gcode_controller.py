"""A controller at a pseudo-terminal that speaks GRBL 1.1 or Marlin, with faults."""

import array
import fcntl
import os
import re
import select
import termios
import threading
import time
import tty
from typing import Literal

Fault = Literal[
    "",
    "alarm",
    "error",
    "silent",
    "stuck",
    "unplugged",
    "garbage",
    "reset",
    "slow",
    "locked",
    "paused",
    "boots",
    "other baud",
    "stops",
]
"""What happens at the next motion; the last ones but "stops" from the start."""

HALFWAY = ("alarm", "stuck", "unplugged", "reset", "stops")
"""Faults that end a motion when half of the way is done, however late this program looks."""

BANNER = b"\r\nGrbl 1.1h ['$' for help]\r\n"


class Controller:
    """Turns nothing, but counts as if; `received` holds the lines and real-time bytes that came.

    A driver that uses `clock` waits for nothing that will not come: the time is over as soon as it
    would be in vain.
    """

    def __init__(self, dialect: Literal["grbl", "marlin"] = "grbl", fault: Fault = "") -> None:
        self.fault, self.dialect = fault, dialect
        self.position = 0.0
        self.received: list[str] = []
        self._begin, self._target, self._begun, self._duration = 0.0, 0.0, 0.0, 0.0
        self._state = {"locked": "Alarm", "paused": "Hold:0"}.get(fault, "Idle")
        self._waiting = False  # for the end of a motion, as M400 does
        self._relative, self._buffer = False, b""
        self._skipped_s, self._skip_once_read_s = 0.0, 0.0
        self._is_waited_for_in_vain = False
        self._main, self._end = os.openpty()
        tty.setraw(self._end)
        self.port = os.ttyname(self._end)
        self._closing = False
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def __enter__(self) -> "Controller":
        return self

    def __exit__(self, *_: object) -> None:
        self._closing = True
        self._thread.join(2.0)
        self._unplug()

    def clock(self) -> float:
        """Return the time, s."""
        return time.monotonic() + self._skipped_s

    def skip(self, seconds: float) -> None:
        """Let time pass."""
        self._skipped_s += seconds

    @property
    def is_stuck(self) -> bool:
        """Whether it is blocked half of the way."""
        return (
            self.fault == "stuck"
            and self.is_moving
            and self.position >= (self._begin + self._target) / 2
        )

    @property
    def is_moving(self) -> bool:
        """Whether it turns."""
        return self._state in ("Run", "Jog")

    def _serve(self) -> None:
        booted = self.fault != "boots"
        while not self._closing and self._main >= 0:
            if select.select([self._main], [], [], 0.005)[0]:
                data = os.read(self._main, 256)
                if booted:
                    self._receive(data)
                else:  # the first question is lost
                    booted = True
                    self._send(BANNER if self.dialect == "grbl" else b"start\n")
                    self._skip_once_read_s = 15.0  # the driver asks again
            if self._skip_once_read_s and self._is_read():
                self.skip(self._skip_once_read_s)
                self._skip_once_read_s = 0.0
            if self._is_waited_for_in_vain and self._is_read():
                self.skip(20.0)
            self._move()

    def _is_read(self) -> bool:
        """Whether all that was sent has been read."""
        waiting = array.array("i", [0])
        fcntl.ioctl(self._end, termios.FIONREAD, waiting)
        return waiting[0] == 0

    def _receive(self, data: bytes) -> None:
        self._is_waited_for_in_vain = False
        for byte in data:
            if self.dialect == "grbl" and byte in b"?!~\x18\x85":
                self.received.append({0x85: "cancel", 0x18: "reset"}.get(byte, chr(byte)))
                if byte == 0x85 and self.is_moving:
                    self._state = "Idle"
                elif byte == ord("?"):
                    self._send(
                        f"<{self._state}|MPos:{self.position:.3f},0.000,0.000|FS:0,0|WCO:5.000,0.000,0.000>\r\n".encode()
                    )
            elif byte == 0x0A:
                line, self._buffer = self._buffer.decode("latin1"), b""
                self.received.append(line)
                self._handle(line)
            else:
                self._buffer += bytes([byte])

    def _handle(self, line: str) -> None:
        if self.fault == "other baud":
            self._send(b"\xf8\x80\xfe\n")
            self._is_waited_for_in_vain = True
        elif self.dialect == "grbl":
            self._handle_grbl(line)
        else:
            self._handle_marlin(line)

    def _handle_grbl(self, line: str) -> None:
        if line == "$I" and self.fault == "paused":
            self._send(b"error:8\r\n")
        elif line == "$I":
            self._send(b"[VER:1.1h.20190825:]\r\n[OPT:V,15,128]\r\nok\r\n")
        elif match := re.fullmatch(r"\$J=G91 G21 X(-?[\d.]+) F([\d.]+)", line):
            if self._state == "Alarm":
                self._send(b"error:9\r\n")
            elif self.fault == "error":
                self._send(b"error:15\r\n")
            elif self._begin_motion(float(match[1]), float(match[2]), "Jog"):
                self._send(b"ok\r\n")
        else:
            self._send(b"error:20\r\n")

    def _handle_marlin(self, line: str) -> None:
        if line == "M115":
            self._send(
                b"FIRMWARE_NAME:Marlin 2.1.2 SOURCE_CODE_URL:github.com PROTOCOL_VERSION:1.0\nok\n"
            )
        elif line == "M114":
            self._send(
                f"X:{self.position:.2f} Y:0.00 Z:0.00 E:0.00 Count X:{80 * self.position:.0f} Y:0"
                " Z:0\nok\n".encode()
            )
        elif match := re.fullmatch(r"G1 X(-?[\d.]+) F([\d.]+)", line):
            assert self._relative
            if self.fault == "error":
                self._send(b"Error:Printer halted. kill() called!\n")
            elif self._begin_motion(float(match[1]), float(match[2]), "Run"):
                self._send(b"ok\n")
        elif line == "M400":
            self._waiting = True
            self._send(b"echo:busy: processing\n")
        elif line == "M410":
            self._state = "Idle"
            self._send(b"ok\n")
        elif line in ("G21", "G90", "G91"):
            self._relative = line == "G91" or (self._relative and line == "G21")
            self._send(b"ok\n")
        else:
            self._send(f'echo:Unknown command: "{line}"\nok\n'.encode())
            if line == "$I":
                self._skip_once_read_s = 5.0

    def _begin_motion(self, units: float, feed: float, state: str) -> bool:
        """Begin to move; whether that is confirmed."""
        if self.fault == "silent":
            self._is_waited_for_in_vain = True
            return False
        if self.fault == "slow":
            self.skip(25.0)
        self._begin, self._target = self.position, self.position + units
        self._begun, self._duration, self._state = time.monotonic(), 60.0 * abs(units) / feed, state
        return True

    def _move(self) -> None:
        if self.is_moving:
            share = min(1.0, (time.monotonic() - self._begun) / max(self._duration, 1e-6))
            if self.fault in HALFWAY:
                share = min(share, 0.5)
            self.position = self._begin + share * (self._target - self._begin)
            if share >= 0.5:
                self._break()
            if share == 1.0 and self.is_moving:
                self.position, self._state = self._target, "Idle"
        if self._waiting and not self.is_moving:
            self._waiting = False
            self._send(b"ok\n")

    def _break(self) -> None:
        """Half of the way is done: what fails now?"""
        fault = self.fault
        if fault in ("alarm", "reset", "unplugged", "stops", "garbage"):
            self.fault = ""
        if fault == "alarm":
            self._state = "Alarm"
            self._send(b"ALARM:1\r\n[MSG:Reset to continue]\r\n")
        elif fault == "reset":
            self._state, self.position, self._waiting = "Idle", 0.0, False
            self._send(BANNER if self.dialect == "grbl" else b"start\n")
        elif fault == "unplugged":
            self._state = "Idle"
            self._unplug()
        elif fault == "stops":
            self._state = "Idle"
        elif fault == "garbage":
            self._send(b"\x00\xff\xfe~\x8f\r\n<Idle|MP\r\n\r\nok\xc3\n")

    def _send(self, data: bytes) -> None:
        if self._main >= 0:
            os.write(self._main, data)

    def _unplug(self) -> None:
        main, end, self._main, self._end = self._main, self._end, -1, -1
        for descriptor in (main, end):
            if descriptor >= 0:
                os.close(descriptor)
