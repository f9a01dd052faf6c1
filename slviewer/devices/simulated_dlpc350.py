"""A simulated DLPC350 before a `SimulatedWorld`: it speaks the protocol of the real one, divides
the pictures of its video port by its look-up table, and triggers a simulated camera; with faults.

What it refuses, and which bit planes a pattern number means, is written here from TI's guide
(DLPU010), not shared with the driver.
"""

import struct
from collections import deque
from collections.abc import Sequence
from typing import Literal

import numpy as np

from slviewer.devices.dlpc350 import NACK, PACKET_BYTES, READ, RUN_STARTED, Command
from slviewer.devices.lightcrafter4500 import LightCrafter4500, PackedPicture, PatternTiming
from slviewer.devices.protocols import Rig
from slviewer.devices.simulated import SimulatedCamera, SimulatedProjector
from slviewer.devices.world import SimulatedWorld
from slviewer.fringe.patterns import profile
from slviewer.fringe.sequence import Axis, PatternSequence

Fault = Literal["unplugged", "in use", "busy", "invalid", "frozen", "trigger lost", "repeated"]
"""What is wrong from now on: it is gone; another program has it; its validation does not end, or
fails; it keeps its picture; every tenth trigger does not arrive; one picture of a burst stands for
two refreshes."""

_LOWEST_PLANES = {
    1: range(24),
    2: range(0, 24, 2),
    3: range(0, 24, 3),
    4: range(0, 24, 4),
    5: (1, 7, 13, 19),
    6: (0, 6, 12, 18),
    7: (1, 9, 17),
    8: (0, 8, 16),
}
"""Lowest plane of each pattern number by bits, of G0 ... G7, R0 ... R7, B0 ... B7 (table 2-70)."""
_SHORTEST_US = {1: 235, 2: 700, 3: 1570, 4: 1700, 5: 2000, 6: 2500, 7: 4500, 8: 8333}
_REFRESH_US = 16_667
_WHILE_STOPPED = (Command.PATTERN_SOURCE, Command.LUT_SIZE, Command.TRIGGER_MODE, Command.EXPOSURE)


class SimulatedTriggeredCamera(SimulatedCamera):
    """A simulated camera that also exposes a frame with each trigger."""

    def __init__(self, world: SimulatedWorld) -> None:
        super().__init__(world)
        self._frames: deque[np.ndarray] = deque()
        self._empty = 0

    def arm(self, frames: int) -> None:
        """Wait for up to `frames` triggers from now on."""
        self.check_open()
        self._frames.clear()
        self._empty = frames

    def trigger(self) -> None:
        """Expose a frame, if it waits for one."""
        if self._empty:
            frame = np.empty(self.size[::-1], self.dtype)
            self._fill(frame)
            self._frames.append(frame)
            self._empty -= 1

    def fetch(self, out: np.ndarray) -> bool:
        """Fill `out` (h, w) with the next triggered frame; False where none comes any more."""
        self.check_open()
        if self._frames:
            out[:] = self._frames.popleft()
            return True
        return False

    def disarm(self) -> None:
        """Stop waiting, and discard what is left."""
        self.arm(0)


class SimulatedDlpc350:
    """The controller at its USB port, a transport of `devices.dlpc350`, and at its video port
    (`refresh`). `fault` may be set at any time."""

    def __init__(self, projector: SimulatedProjector, camera: SimulatedTriggeredCamera) -> None:
        self._projector, self._camera = projector, camera
        self.fault: Fault | None = None
        self.received: list[tuple[Command, bytes]] = []
        self._registers: dict[int, bytes] = {}
        self._lut: list[int] = []
        self._message, self._answers = b"", deque[bytes]()
        self._picture = PackedPicture("x", np.zeros((projector.size[0], 3), np.uint8))
        self._triggers = 0

    def connect(self) -> "SimulatedDlpc350":
        """Open it. Raises OSError where another program has it, or it is gone."""
        if self.fault in ("in use", "unplugged"):
            raise OSError("open failed")
        return self

    def close(self) -> None:
        """Release it."""
        self._message = b""
        self._answers.clear()

    def write(self, packet: bytes) -> None:
        """Receive a packet, and carry out the command that it completes."""
        self._check_plugged()
        assert len(packet) == PACKET_BYTES
        self._message += packet
        flags, number, length, command = struct.unpack_from("<BBHH", self._message)
        if len(self._message) < 4 + length:
            return
        data, self._message = self._message[6 : 4 + length], b""
        answer = self._read(command) if flags & READ else self._write(command, data)
        flags |= NACK * (answer is None)
        head = struct.pack("<BBH", flags, number, len(answer or b""))
        self._answers.append((head + (answer or b"")).ljust(PACKET_BYTES, b"\0"))

    def read(self, timeout_s: float) -> bytes:
        """Return the next answer, or nothing."""
        self._check_plugged()
        return self._answers.popleft() if self._answers else b""

    def refresh(self, picture: PackedPicture, preview: bool = False) -> None:
        """Receive a picture of the video port, and show its patterns."""
        if self.fault != "frozen":
            self._picture = picture
        axis, rgb = self._picture
        planes = rgb[:, 1].astype(np.uint32) | rgb[:, 0].astype(np.uint32) << 8
        planes |= rgb[:, 2].astype(np.uint32) << 16
        if not self._get(Command.DISPLAY_MODE):
            self._show(axis, rgb[:, 1], preview)
        elif self._is_running:
            for entry in self._lut:
                bits = entry >> 8 & 0xF
                lowest = _LOWEST_PLANES[bits][entry >> 2 & 0x3F]
                levels = (planes >> lowest & 2**bits - 1) * (255 / (2**bits - 1))
                self._show(axis, np.rint(levels).astype(np.uint8), preview)
                self._triggers += 1
                if self.fault != "trigger lost" or self._triggers % 10:
                    self._camera.trigger()

    @property
    def _is_running(self) -> bool:
        return self._get(Command.RUN) == RUN_STARTED

    def _check_plugged(self) -> None:
        if self.fault == "unplugged":
            raise OSError("no such device")

    def _show(self, axis: Axis, levels: np.ndarray, preview: bool) -> None:
        self._projector.show_pattern((axis, levels), preview)

    def _get(self, command: int) -> int:
        """Return the first byte of a register."""
        return self._registers.get(command, b"\0")[0]

    def _read(self, command: int) -> bytes | None:
        """Return what a command reads, None where it refuses."""
        if command == Command.HARDWARE_STATUS or command == Command.SYSTEM_STATUS:
            return b"\1"
        if command == Command.MAIN_STATUS:
            return bytes([self._is_running << 1 | (self.fault == "frozen") << 2])
        if command == Command.VALIDATE:
            return bytes([0x80 if self.fault == "busy" else self._validate()])
        return self._registers.get(command, b"\0") if command in list(Command) else None

    def _write(self, command: int, data: bytes) -> bytes | None:
        """Carry out a command; returns its empty answer, None where it refuses."""
        if command not in list(Command) or (self._is_running and command in _WHILE_STOPPED):
            return None
        self.received.append((Command(command), data))
        if command == Command.MAILBOX_DATA:
            if self._get(Command.MAILBOX) != 2 or len(data) % 3:
                return None
            self._lut = [int.from_bytes(data[k : k + 3], "little") for k in range(0, len(data), 3)]
        self._registers[command] = data
        return b""

    def _validate(self) -> int:
        """Return the bits of what is wrong with the sequence."""
        exposure_us, period_us = struct.unpack("<II", self._registers[Command.EXPOSURE])
        blacks = [entry >> 17 & 1 for entry in self._lut]
        bad_numbers, too_short = False, self.fault == "invalid" or exposure_us != period_us
        for entry in self._lut:
            bits = entry >> 8 & 0xF
            bad_numbers |= entry >> 2 & 0x3F >= len(_LOWEST_PLANES[bits])
            too_short |= exposure_us < _SHORTEST_US[bits]
        too_short |= period_us * len(self._lut) + 230 * sum(blacks) > _REFRESH_US
        bad_numbers |= self._get(Command.LUT_SIZE) != len(self._lut) - 1
        return too_short | bad_numbers << 1 | (not blacks[-1]) << 3


class SimulatedVideo:
    """The pictures of the video port of a simulated controller, one each refresh."""

    def __init__(self, projector: SimulatedProjector, controller: SimulatedDlpc350) -> None:
        self.name, self.size = projector.name, projector.size
        self._projector, self._controller = projector, controller
        self._pictures: Sequence[PackedPicture] = ()

    def open(self) -> None:
        """Claim the world's projector."""
        self._projector.open()

    def close(self) -> None:
        """Release the world's projector, dark."""
        self._projector.close()

    def load(self, sequence: PatternSequence) -> None:
        """Load grey pictures."""
        self._projector.load(sequence)  # which begins the noise of a capture
        profiles = (profile(sequence, k) for k in range(len(sequence.frames)))
        self._pictures = [_make_grey(axis, levels) for axis, levels in profiles]

    def show(self, index: int) -> None:
        """Show a loaded picture."""
        self._controller.refresh(self._pictures[index])

    def show_level(self, grey: int | None) -> None:
        """Show even grey."""
        picture = _make_grey(None, np.full(self.size[0], grey or 0, np.uint8))
        self._controller.refresh(picture, preview=True)

    def load_pictures(self, pictures: Sequence[PackedPicture]) -> None:
        """Load pictures of 24 bits."""
        self._pictures = pictures

    def play(self) -> None:
        """Show each once."""
        for k, picture in enumerate(self._pictures):
            self._controller.refresh(picture)
            if self._controller.fault == "repeated" and k == len(self._pictures) // 2:
                self._controller.refresh(picture)


def _make_grey(axis: Axis | None, levels: np.ndarray) -> PackedPicture:
    return PackedPicture(axis or "x", np.repeat(levels[:, None], 3, axis=1))


def simulated_lightcrafter(
    world: SimulatedWorld, timing: PatternTiming
) -> tuple[Rig, SimulatedDlpc350]:
    """Return the rig that views `world` with a simulated LightCrafter 4500, and its controller."""
    camera, projector = SimulatedTriggeredCamera(world), SimulatedProjector(world)
    controller = SimulatedDlpc350(projector, camera)
    video = SimulatedVideo(projector, controller)
    return Rig("simulated", camera, LightCrafter4500(video, controller.connect, timing)), controller


def simulated_lightcrafter_rig(world: SimulatedWorld) -> Rig:
    """Return the rig that views `world` with a simulated LightCrafter 4500 of 8 bits at 60 Hz."""
    return simulated_lightcrafter(world, PatternTiming())[0]
