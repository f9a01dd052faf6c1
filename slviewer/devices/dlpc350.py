"""The protocol of Texas Instruments' DLPC350, the controller of the LightCrafter 4500, by USB HID.

Sources: DLPC350 Programmer's Guide (DLPU010), its sections 1.2 (packets), 2.1 (status) and those of
the pattern display, and TI's own `dlpc350_api.cpp` (in github.com/jakobwilm/slstudio), which has
the number of each command. Table 2-70 of revision G has the bit planes
of each pattern number.
"""

import struct
import time
from collections.abc import Callable, Sequence
from enum import IntEnum
from typing import Any, Protocol

from slviewer.errors import DeviceError

VENDOR, PRODUCT = 0x0451, 0x6401
PACKET_BYTES = 64
READ, REPLY, NACK = 0x80, 0x40, 0x20
_ANSWER_S = 2.0
_SETTLE_S = 5.0
"""How long it may take to wake up, to change its mode, or to validate a sequence."""

MIN_EXPOSURES_US = (235, 700, 1570, 1700, 2000, 2500, 4500, 8333)
"""Shortest exposure of a pattern of 1 ... 8 bits; the same table is in TI's own program."""
BLACK_US = 230
"""What a black fill after a pattern takes."""


class Command(IntEnum):
    """Commands used here: CMD2 and CMD3 of the guide as one number."""

    POWER = 0x0200
    LED_CURRENTS = 0x0B01
    FREEZE = 0x100A
    SOURCE = 0x1A00
    HARDWARE_STATUS = 0x1A0A
    SYSTEM_STATUS = 0x1A0B
    MAIN_STATUS = 0x1A0C
    VALIDATE = 0x1A1A
    DISPLAY_MODE = 0x1A1B
    TRIGGER_OUT_1 = 0x1A1D
    TRIGGER_OUT_2 = 0x1A1E
    PATTERN_SOURCE = 0x1A22
    TRIGGER_MODE = 0x1A23
    RUN = 0x1A24
    EXPOSURE = 0x1A29
    LUT_SIZE = 0x1A31
    MAILBOX_ADDRESS = 0x1A32
    MAILBOX = 0x1A33
    MAILBOX_DATA = 0x1A34


RUN_STOPPED, RUN_STARTED = 0, 2
"""Arguments of `Command.RUN`."""

_STATUS = (
    (Command.MAIN_STATUS, 0, 1, False, "has its mirrors parked", "switch it off and on"),
    (
        Command.MAIN_STATUS,
        1,
        0,
        True,
        "stopped its sequence",
        "check that 912x1140 arrives by HDMI",
    ),
    (Command.MAIN_STATUS, 2, 1, False, "has a frozen buffer", "end other programs that control it"),
    (Command.HARDWARE_STATUS, 0, 0, False, "did not start up", "switch it off and on"),
    (
        Command.HARDWARE_STATUS,
        2,
        1,
        False,
        "has a fault in the control of its mirrors",
        "return it",
    ),
    (Command.HARDWARE_STATUS, 3, 1, True, "was forced to change pictures", "check refresh_hz"),
    (Command.HARDWARE_STATUS, 6, 1, True, "aborted its sequence", "check the video signal"),
    (Command.HARDWARE_STATUS, 7, 1, True, "has an error in its sequence", "switch it off and on"),
    (Command.SYSTEM_STATUS, 0, 0, False, "failed its memory test", "switch it off and on"),
)
"""Command, bit, the value of the bit that is a fault, whether it is one of a sequence (and may be
left of an earlier one), what it means (guide, 2.1), and the remedy."""
_RUNNING = 0b010
"""Lower bits of the main status: mirrors not parked, sequence running, buffer not frozen."""

_INVALID = (
    "the exposure or the period is out of range",
    "a pattern number in the look-up table is invalid",
)
_WARNINGS = (
    "trigger out 1 stays high from one pattern to the next",
    "no black fill is between the last pattern and the next picture",
    "the exposure is less than 230 us shorter than the period",
)
"""Bits 0 and 1, then 2 ... 4 of the validation, as `dlpc350_api.cpp` describes them."""


class Transport(Protocol):
    """Packets of 64 bytes to and from the device; every method raises OSError where it is gone."""

    def write(self, packet: bytes) -> None:
        """Send a packet."""

    def read(self, timeout_s: float) -> bytes:
        """Return the next packet; empty where none comes in time."""

    def close(self) -> None:
        """Release the device."""


class HidTransport:
    """A device at a path of `hidapi`. Raises OSError where it is in use, or not permitted."""

    def __init__(self, path: bytes) -> None:
        import hid  # lazily: an optional package

        self._device = hid.device()
        self._device.open_path(path)

    def write(self, packet: bytes) -> None:
        """Send a packet after its report number, 0."""
        if self._device.write(b"\0" + packet) < 0:
            raise OSError("write error")

    def read(self, timeout_s: float) -> bytes:
        """Return the next packet; empty where none comes in time."""
        # 0 ms would wait for ever
        return bytes(self._device.read(PACKET_BYTES, max(1, int(1000 * timeout_s))))

    def close(self) -> None:
        """Release the device."""
        self._device.close()


def list_devices() -> list[dict[str, Any]]:
    """List the connected devices as `hidapi` describes them; the first interface has commands."""
    import hid  # lazily: an optional package

    listed = hid.enumerate(VENDOR, PRODUCT)
    return [info for info in listed if info.get("interface_number", 0) in (-1, 0)]


def open_hid(serial: str | None) -> HidTransport:
    """Open the connected device, of that serial number. Raises DeviceError where there is none,
    OSError where it is in use."""
    devices = [each for each in list_devices() if serial in (None, each["serial_number"])]
    if not devices:
        raise DeviceError(
            "no LightCrafter 4500 is connected by"
            f" USB{'' if serial is None else f' with the serial number {serial}'}",
            "plug it in and switch it on; `slviewer devices` lists what is connected",
        )
    return HidTransport(devices[0]["path"])


def lut_entry(number: int, bits: int, leds: int, *, first: bool, black: bool) -> bytes:
    """Return the entry of a pattern in the look-up table, 3 bytes.

    `leds`: 1 red, 2 green, 4 blue. The first pattern of a picture waits for its VSYNC, the others
    follow; `black`: a black fill comes after it.
    """
    trigger = 1 if first else 3
    word = trigger | number << 2 | bits << 8 | leds << 12 | black << 17
    return word.to_bytes(3, "little")


class Dlpc350:
    """A controller called `name` at an open transport. Every method raises DeviceError where it
    does not answer, refuses a command, or is gone."""

    def __init__(
        self, transport: Transport, name: str, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._transport, self._name, self._clock = transport, name, clock
        self._sequence = 0

    def close(self) -> None:
        """Release the device; never raises."""
        try:
            self._transport.close()
        except OSError:
            return

    def read(self, command: Command) -> int:
        """Return the first byte that a command reads."""
        return self._transact(READ | REPLY, command, b"")[0]

    def write(self, command: Command, data: bytes) -> None:
        """Write a command's data, and wait until it is accepted."""
        self._transact(REPLY, command, data)

    def set(self, command: Command, value: int) -> None:
        """Write a value again and again until it reads so: a change of mode takes its time."""
        end = self._clock() + _SETTLE_S
        while True:
            self.write(command, bytes([value]))
            if self.read(command) & 0x03 == value:
                return
            if self._clock() > end:
                raise DeviceError(
                    f"{self._name} did not set {command.name} to {value} within {_SETTLE_S:g} s",
                    "switch it off and on",
                )

    def start(self) -> None:
        """Start the sequence, and wait until it runs."""
        self.set(Command.RUN, RUN_STARTED)
        end = self._clock() + _SETTLE_S
        while not self.read(Command.MAIN_STATUS) & _RUNNING and self._clock() < end:
            pass
        self.check_running()

    def check_running(self) -> None:
        """Raise DeviceError unless it shows pictures as they come."""
        if self.read(Command.MAIN_STATUS) & 0b111 != _RUNNING:
            raise self.describe_faults(self.list_faults(is_running=True))

    def describe_faults(self, faults: Sequence[tuple[str, str]]) -> DeviceError:
        """Return the error of faults, each with its remedy."""
        *others, (last, remedy) = faults or [("", "")]
        clauses = [*(f"{fault}: {cure}" for fault, cure in others), last]
        return DeviceError(f"{self._name} {'; it '.join(clauses)}", remedy)

    def list_faults(self, is_running: bool) -> list[tuple[str, str]]:
        """Return a clause and the remedy for each fault that its status reports, those of a
        sequence where one runs."""
        read = {command: self.read(command) for command in {row[0] for row in _STATUS}}
        return [
            (clause, remedy)
            for command, bit, fault, of_sequence, clause, remedy in _STATUS
            if read[command] >> bit & 1 == fault and (is_running or not of_sequence)
        ]

    def send_sequence(self, entries: list[bytes], period_us: int, triggers: bytes) -> list[str]:
        """Send a look-up table that every picture of the video port is shown by, `period_us` a
        pattern; returns warnings. It is stopped then.

        `triggers`: delays of trigger out 1, rising and falling, and of trigger out 2, as registers.
        In this mode a pattern is exposed for its whole period.
        """
        n = len(entries)
        self.set(Command.RUN, RUN_STOPPED)
        self.set(Command.DISPLAY_MODE, 1)
        for command, data in (
            (Command.PATTERN_SOURCE, b"\0"),
            (Command.LUT_SIZE, bytes([n - 1, 1, n - 1, 0])),
            (Command.TRIGGER_MODE, b"\0"),
            (Command.EXPOSURE, struct.pack("<II", period_us, period_us)),
            (Command.TRIGGER_OUT_1, b"\0" + triggers[:2]),
            (Command.TRIGGER_OUT_2, b"\0" + triggers[2:]),
            (Command.MAILBOX, b"\2"),
            (Command.MAILBOX_ADDRESS, b"\0"),
            (Command.MAILBOX_DATA, b"".join(entries)),
            (Command.MAILBOX, b"\0"),
        ):
            self.write(command, data)
        return self._validate()

    def _validate(self) -> list[str]:
        """Let it check the sequence; returns what it warns of. Raises DeviceError for what is
        wrong."""
        self.write(Command.VALIDATE, b"\0")
        end = self._clock() + _SETTLE_S
        while (result := self.read(Command.VALIDATE)) & 0x80:
            if self._clock() > end:
                raise DeviceError(
                    f"{self._name} is busy, its check of the sequence has not ended within"
                    f" {_SETTLE_S:g} s",
                    "switch it off and on",
                )
        wrong = [words for bit, words in enumerate(_INVALID) if result >> bit & 1]
        if wrong:
            raise DeviceError(
                f"{self._name} refused the sequence, {' and '.join(wrong)}",
                "lower per_picture or bits",
            )
        return [words for bit, words in enumerate(_WARNINGS, 2) if result >> bit & 1]

    def _transact(self, flags: int, command: Command, data: bytes) -> bytes:
        """Send a command in packets of 64 bytes, and return the data of its answer, in one packet.

        Header (guide, 1.2.1): flags, sequence number, length of what follows, little endian; then
        the command, low byte first. Answers to earlier commands are discarded.
        """
        self._sequence = self._sequence + 1 & 0xFF
        message = struct.pack("<BBHH", flags, self._sequence, 2 + len(data), command) + data
        try:
            for start in range(0, len(message), PACKET_BYTES):
                packet = message[start : start + PACKET_BYTES]
                self._transport.write(packet.ljust(PACKET_BYTES, b"\0"))
            end = self._clock() + _ANSWER_S
            while answer := self._transport.read(max(0.0, end - self._clock())):
                if len(answer) >= 4 and answer[1] == self._sequence:
                    break
        except (OSError, ValueError) as error:  # ValueError: hidapi's of a device that is closed
            raise DeviceError(
                f"{self._name} was unplugged or switched off ({error})", "plug it in again"
            ) from error
        if not answer:
            raise DeviceError(
                f"{self._name} did not answer {command.name} within {_ANSWER_S:g} s",
                "switch it off and on",
            )
        length = int.from_bytes(answer[2:4], "little")
        if answer[0] & NACK or (flags & READ and not length):
            raise DeviceError(
                f"{self._name} refused {command.name}",
                "stop what it shows in other programs, and update its firmware to 3.0 or newer",
            )
        return answer[4 : 4 + length]
