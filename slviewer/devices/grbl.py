"""A turntable whose motor is driven by G-code over a serial port: GRBL 1.1 and its descendants, or
Marlin.

GRBL: https://github.com/gnea/grbl/wiki/Grbl-v1.1-Interface and -Jogging. Marlin:
https://marlinfw.org/meta/gcode. An alarm is never unlocked by itself: only who looks at the table
knows that it may turn.
"""

import re
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import msgspec

from slviewer.devices.drivers import Driver
from slviewer.devices.protocols import Openable, check_angle
from slviewer.errors import InputError, TurntableError

Dialect = Literal["auto", "grbl", "marlin"]
Positive = Annotated[float, msgspec.Meta(gt=0, le=1e4)]

BOOT_S = 6.0
"""An Arduino restarts when its port is opened, and its boot loader then listens for about two
seconds."""
REPLY_S = 5.0
"""How long a command may take to be accepted."""
_ANSWER_S = 1.0  # to a question while it boots
_STOP_S = 2.0
_TOLERANCE_DEG = 0.1
_SPARE_S = 10.0  # that a motion may take longer than planned, beside twice the plan

_CHECK_TABLE = "see that the table turns freely"
_UNLOCK = "then unlock it with $X (or home it with $H) in a G-code sender"
ALARMS = {
    1: (
        f"a limit switch was hit, and the position is lost: {_CHECK_TABLE}, set $21=0 if it has no"
        f" switches, {_UNLOCK}"
    ),
    2: f"the angle is outside its soft limits: set $20=0, as a turntable has no end, {_UNLOCK}",
    3: f"it was reset while it turned, and the position is lost: {_CHECK_TABLE}, {_UNLOCK}",
    4: f"a probe was in the wrong state: remove it, {_UNLOCK}",
    5: f"a probe made no contact: remove it, {_UNLOCK}",
    6: f"homing was reset: {_CHECK_TABLE}, {_UNLOCK}",
    7: f"a door was opened during homing: close it, {_UNLOCK}",
    8: (
        "homing did not leave the limit switch: check the switch, or set $22=0 if there is none,"
        f" {_UNLOCK}"
    ),
    9: (
        "homing did not reach a limit switch: check the switch, or set $22=0 if there is none,"
        f" {_UNLOCK}"
    ),
}
"""What the alarms of GRBL 1.1 mean, and what to do."""

ERRORS = {
    1: "it received a damaged line: use a shorter, shielded cable",
    2: "it received a damaged number: use a shorter, shielded cable",
    3: "it does not know the command: its firmware must be GRBL 1.1 or newer",
    5: "homing is not enabled: set $22=1 if the table has a switch",
    7: "its settings could not be read and were reset: set the steps per unit ($100 for X) again",
    8: "it is not idle: wait until it stands still, and end other programs that use it",
    9: "it is locked by an alarm: look at the table, then unlock it with $X in a G-code sender",
    10: "soft limits need homing: set $20=0, as a turntable has no end",
    11: (
        "the line is too long: it received something else too; end other programs that use the port"
    ),
    12: "the step rate is too high: lower speed_deg_s",
    13: "its safety door is open: close it",
    15: "the angle is outside its soft limits: set $20=0, as a turntable has no end",
    16: "it does not accept a jog: its firmware must be GRBL 1.1 or newer",
    20: "it does not know the command: check `axis`, GRBL has X, Y and Z",
    22: "the feed rate is missing or zero: set speed_deg_s",
    33: "the motion is impossible: check `axis` and `degrees_per_unit`",
}
"""What the errors of GRBL 1.1 that may happen here mean, and what to do."""

_BLOCKED = {
    "Hold": ("is paused", "release the feed hold"),
    "Door": ("reports an open safety door", "close it"),
    "Check": ("is in check mode, in which nothing moves", "send $C in a G-code sender"),
    "Sleep": ("sleeps", "switch it off and on"),
}
"""States of GRBL in which it does not turn, and their remedies."""


@dataclass(frozen=True)
class ControllerTiming:
    """How a controller is waited for: how often it is asked for its state, how long it must be
    silent until everything that it had to say has been read, in s, and the clock.
    """

    poll_s: float = 0.1
    quiet_s: float = 0.2
    clock: Callable[[], float] = time.monotonic


TIMING = ControllerTiming()
"""For real controllers."""


@dataclass(eq=False)
class GcodeTurntable(Openable):
    """A turntable on one axis of a GRBL or Marlin controller at a serial port, such as /dev/ttyUSB0
    or COM3. It is open while its port is; a motion is stopped by `turn_to` itself.

    `degrees_per_unit`: degrees that the table turns for one unit (mm) of the axis, 1 where the
    controller's steps per mm were set to steps per degree; negative to reverse it. `settle_ms`
    passes after it stands still. `boot_s`, `reply_s`: how long it may take to start, and to accept
    a command, in seconds of the clock of `timing`. Raises InputError.
    """

    port: str
    baud: Annotated[int, msgspec.Meta(ge=1200, le=4_000_000)] = 115_200
    dialect: Dialect = "auto"
    axis: Literal["X", "Y", "Z", "A", "B", "C", "E"] = "X"
    degrees_per_unit: Annotated[float, msgspec.Meta(ge=-1e4, le=1e4)] = 1.0
    speed_deg_s: Positive = 20.0
    settle_ms: Annotated[float, msgspec.Meta(ge=0, le=60_000)] = 300.0
    limits_deg: tuple[float, float] | None = None
    boot_s: Positive = BOOT_S
    reply_s: Positive = REPLY_S
    timing: ControllerTiming = TIMING

    is_absolute = False

    def __post_init__(self) -> None:
        if self.degrees_per_unit == 0:
            raise InputError(
                "degrees_per_unit = 0 turns nothing", "give the degrees per unit of the axis"
            )
        if (limits := self.limits_deg) is not None:
            if not (len(limits) == 2 and limits[0] < limits[1]):
                raise InputError(
                    f"limits_deg = {list(limits)} are not limits", "give two, the lower one first"
                )
            self.limits_deg = float(limits[0]), float(limits[1])
        super().__init__(f"the turntable at {self.port}")
        self._clock = self.timing.clock
        self._serial: Any = None
        self._buffer = b""
        self._unreadable = 0  # bytes that are not text, since it was opened
        self._is_marlin = False

    def _start(self) -> None:
        """Open the port, and wait for the controller. Raises TurntableError where it does not
        answer or is locked."""
        import serial  # lazily: an optional package

        try:
            self._serial = serial.Serial(
                self.port,
                self.baud,
                timeout=self.timing.poll_s / 2,
                write_timeout=self.reply_s,
                exclusive=True,
            )
        except (OSError, ValueError) as error:
            raise TurntableError(
                f"{self.name} cannot be opened ({error})",
                "plug it in, end other programs that use it, and check the port; `slviewer devices`"
                " lists those that are connected",
            ) from error
        self._claimed.callback(self._serial.close)
        self._buffer, self._unreadable = b"", 0
        self._probe()
        self.position_deg()  # raises where it is locked

    def position_deg(self) -> float:
        """Ask the controller for the angle that it counts."""
        self.check_open()
        return (
            self._read_marlin() if self._is_marlin else self._read_grbl()[1]
        ) * self.degrees_per_unit

    def turn_to(self, deg: float, check: Callable[[], None] = lambda: None) -> None:
        """Turn to an angle, wait until it stands still, and `settle_ms` more."""
        self.check_open()
        check_angle(self, deg)
        change_deg = deg - self.position_deg()
        units = change_deg / self.degrees_per_unit
        feed = 60.0 * self.speed_deg_s / abs(self.degrees_per_unit)  # units a minute
        end = (
            self._clock()
            + 2.0 * abs(change_deg) / self.speed_deg_s
            + _SPARE_S * self.reply_s / REPLY_S
        )
        # Relative to what it counts now: the reported and the commanded angle may have different
        # origins (G92, G54).
        move = f"{self.axis}{units:.4f} F{feed:.2f}"
        try:
            check()
            if self._is_marlin:
                for line in ("G21", "G91", f"G1 {move}", "G90"):
                    self._command(line)
                self._command("M400", end, check)
            else:
                # A jog leaves the modes as they are, and is stopped without an alarm.
                self._command(f"$J=G91 G21 {move}")
                while self._read_grbl()[0] != "Idle":
                    check()
                    if self._clock() > end:
                        raise TurntableError(
                            f"{self.name} did not reach {deg:g} degrees in time", _CHECK_TABLE
                        )
                    time.sleep(self.timing.poll_s)
            reached_deg = self.position_deg()
            if abs(reached_deg - deg) > max(_TOLERANCE_DEG, 0.01 * abs(self.degrees_per_unit)):
                raise TurntableError(
                    f"{self.name} stopped at {reached_deg:.2f} instead of {deg:g} degrees",
                    f"{_CHECK_TABLE}, and end other programs that use it",
                )
        except BaseException:
            self._stop()
            raise
        time.sleep(self.settle_ms / 1000)

    def _probe(self) -> None:
        """Ask who is there, GRBL or Marlin, until it answers. Raises TurntableError where it does
        not, or not readably."""
        end = self._clock() + self.boot_s
        while self._clock() < end:
            for question, dialect, answer in (
                ("$I", "grbl", "[VER:"),
                ("M115", "marlin", "FIRMWARE_NAME"),
            ):
                if self.dialect not in ("auto", dialect):
                    continue
                self._write(f"{question}\n".encode())
                until = min(end, self._clock() + _ANSWER_S * self.boot_s / BOOT_S)
                while (line := self._read_line(until)) is not None:
                    # it is GRBL, but paused
                    refused = dialect == "grbl" and line.startswith("error:")
                    if answer in line or refused:
                        self._drain()
                        self._is_marlin = dialect == "marlin"
                        return
                    if line.startswith(("ok", "error:")):
                        break
        if self._unreadable:
            raise TurntableError(
                f"{self.name} sends unreadable characters at {self.baud} baud", "set its own `baud`"
            )
        raise TurntableError(
            f"{self.name} does not answer as"
            f" {'GRBL or Marlin' if self.dialect == 'auto' else self.dialect} within"
            f" {self.boot_s:g} s",
            "switch it on, and check `port`, `baud` and `dialect`",
        )

    def _drain(self) -> None:
        """Discard lines until none comes: late answers to earlier questions must not confirm a
        command."""
        while self._read_line(self._clock() + self.timing.quiet_s) is not None:
            pass

    def _command(
        self, command: str, end: float | None = None, check: Callable[[], None] = lambda: None
    ) -> None:
        """Send a line, and wait until it is accepted; `check()` is called meanwhile."""
        for line in self._ask(f"{command}\n", f"confirm {command!r}", end, check):
            if line.startswith("ok"):
                return

    def _read_grbl(self) -> tuple[str, float]:
        """Ask GRBL for its state and its axis, in units. Raises TurntableError in a state in which
        it cannot turn."""
        for line in self._ask("?", "report its state"):
            if match := re.fullmatch(r"<(\w+)[^|]*\|[MW]Pos:([-\d.,]+)(\|.*)?>", line):
                state, positions = match[1], match[2].split(",")
                if state == "Alarm":
                    raise TurntableError(
                        f"{self.name} is locked by an alarm", f"{_CHECK_TABLE}, {_UNLOCK}"
                    )
                if state in _BLOCKED:
                    blocked, remedy = _BLOCKED[state]
                    raise TurntableError(f"{self.name} {blocked}", remedy)
                index = "XYZABC".find(self.axis)
                try:
                    return state, float(positions[index] if index >= 0 else "")
                except (IndexError, ValueError):
                    raise TurntableError(
                        f"{self.name} has no axis {self.axis}, it has {'XYZABC'[: len(positions)]}",
                        "set `axis`",
                    ) from None
        raise AssertionError

    def _read_marlin(self) -> float:
        """Ask Marlin for the position of the axis, in units."""
        position = None
        for line in self._ask("M114\n", "report its angle"):
            match = re.search(rf"(?<!\w){self.axis}:\s*(-?\d+(?:\.\d+)?)", line.split("Count")[0])
            position = float(match[1]) if match else position
            if line.startswith("ok"):
                if position is None:
                    raise TurntableError(f"{self.name} has no axis {self.axis}", "set `axis`")
                return position
        raise AssertionError

    def _ask(
        self,
        question: str,
        what: str,
        end: float | None = None,
        check: Callable[[], None] = lambda: None,
    ) -> Iterator[str]:
        """Send a line, and yield those that come until `end`, by default for so long as a reply may
        take. Raises TurntableError where one reports a fault, and where none is taken for the
        answer in time; then it did not do `what`."""
        self._write(question.encode())
        until = self._clock() + self.reply_s if end is None else end
        while self._clock() < until:
            check()
            line = self._read_line(min(until, self._clock() + self.timing.poll_s))
            if line is None:
                continue
            self._check_line(line, question.strip())
            # it says every two seconds that it is alive
            if line.startswith("echo:busy") and end is None:
                until = self._clock() + self.reply_s
            yield line
        raise TurntableError(
            f"{self.name} did not {what} in time", "switch it off and on, and check its cable"
        )

    def _check_line(self, line: str, command: str) -> None:
        """Raise TurntableError for a line that reports an alarm, an error or a restart."""
        if match := re.match(r"(ALARM|error):(\d+)", line):
            kind, number = match[1], int(match[2])
            if kind == "ALARM":
                meaning = ALARMS.get(
                    number, f"see the alarms of its firmware; {_CHECK_TABLE}, {_UNLOCK}"
                )
                raise TurntableError(f"{self.name} raised alarm {number}", meaning)
            meaning = ERRORS.get(number, "see the errors of its firmware")
            raise TurntableError(f"{self.name} refused {command!r} with error {number}", meaning)
        if line.startswith(("Error:", "!!")):
            raise TurntableError(
                f"{self.name} reports {line!r}", "correct that, and switch it off and on"
            )
        if line.startswith("Grbl ") or line == "start":
            raise TurntableError(
                f"{self.name} restarted",
                "check its power supply and its cable; its count of the angle is lost",
            )

    def _stop(self) -> None:
        """Stop a motion, as far as the controller still listens: it must not turn on unattended."""
        try:
            self._write(b"M410\n" if self._is_marlin else b"\x85")
            end = self._clock() + _STOP_S
            while not self._is_marlin and self._clock() < end and self._read_grbl()[0] != "Idle":
                time.sleep(self.timing.poll_s)
            self._drain()
        except TurntableError:  # what made it stop is reported
            return

    def _write(self, data: bytes) -> None:
        """Send bytes. Raises TurntableError where the port is gone."""
        try:
            self._serial.write(data)
        except OSError as error:  # also SerialException
            raise self._describe_loss(error) from error

    def _read_line(self, end: float) -> str | None:
        """Return the next line without its end; None where none is complete at `end`, s of the
        clock."""
        while True:
            line, newline, rest = self._buffer.partition(b"\n")
            if newline:
                self._buffer = rest
                text = line.strip(b"\r\x00 ")
                if text and all(32 <= byte < 127 or byte == 9 for byte in text):
                    return text.decode("ascii")
                self._unreadable += len(text)
                continue
            if len(self._buffer) > 4096:  # no controller sends such lines
                self._unreadable, self._buffer = self._unreadable + len(self._buffer), b""
            if self._clock() >= end:
                return None
            try:
                self._buffer += self._serial.read(max(1, self._serial.in_waiting))
            except OSError as error:
                raise self._describe_loss(error) from error

    def _describe_loss(self, error: OSError) -> TurntableError:
        """Return the error of a port that is gone."""
        return TurntableError(f"{self.name} was unplugged ({error})", "plug it in again")


def list_serial_ports() -> list[str]:
    """List the serial ports of this machine, with what is behind them."""
    from serial.tools.list_ports import comports

    return [f"{port.device}: {port.description}" for port in comports()]


DRIVER = Driver(
    "grbl",
    "a turntable on a GRBL or Marlin controller at a serial port",
    packages={"serial": "pip install 'slviewer[turntable]'"},
    turntable=GcodeTurntable,
    list_connected=list_serial_ports,
)
