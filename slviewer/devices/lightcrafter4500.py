"""A LightCrafter 4500 that shows patterns, not video: linear light, exact times, a trigger each.

Its video port gets pictures from the projector page; USB commands tell it which of their bit planes
are patterns. One by one, patterns are grey pictures, each shown several times a refresh. A burst
shows the whole sequence: each picture of 24 bits carries as many patterns as fit one refresh.
Trigger out 1 rises with each, for the camera's trigger line; exposure and light are the same in
both. White pictures before and after the patterns let `devices.capture` count them.
"""

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Literal, NamedTuple, Protocol

import msgspec
import numpy as np
from numpy.typing import NDArray

from slviewer.devices.browser import BrowserProjector, ProjectorChannel
from slviewer.devices.dlpc350 import (
    BLACK_US,
    MIN_EXPOSURES_US,
    RUN_STOPPED,
    Command,
    Dlpc350,
    Transport,
    list_devices,
    lut_entry,
    open_hid,
)
from slviewer.devices.drivers import Driver
from slviewer.devices.protocols import (
    Openable,
    PatternBurst,
    Projector,
    check_index,
    check_sequence,
)
from slviewer.errors import DeviceError, InputError
from slviewer.fringe.patterns import profile
from slviewer.fringe.sequence import Axis, PatternSequence

SIZE = (912, 1140)
Bits = Literal[1, 2, 4, 7, 8]
"""Those of which each colour of a picture holds whole patterns."""

_TRIGGER_STEP_US, _NO_DELAY, _LONGEST_DELAY = 0.1072, 0xBB, 0xD5
"""Register of the trigger delays: step, and its values for 0 and for the longest delay."""
_LEAD, _SPARE = 3, 20
"""Dark pictures before and after a burst (the controller shows a picture one refresh after it
arrived), and how many refreshes starting and stopping may take."""
_Current = Annotated[int, msgspec.Meta(ge=0, le=255)]
_PARALLEL_24_BIT = 0x08
"""Input source: the parallel port, to which the board leads HDMI, 24 bits."""


class PackedPicture(NamedTuple):
    """A picture of 24 bits that varies along an axis: (extent, 3) RGB."""

    axis: Axis
    rgb: NDArray[np.uint8]


class Pictures(Projector, Protocol):
    """What feeds the video port: a projector that can also play 24-bit pictures."""

    def load_pictures(self, pictures: Sequence[PackedPicture]) -> None:
        """Load pictures of 24 bits, in place of a sequence."""

    def play(self) -> None:
        """Show each for one refresh; returns when the last one is on its way."""


@dataclass(frozen=True)
class PatternTiming:
    """How a picture is divided: `bits` a pattern, and `per_picture` patterns a refresh, None: as
    many as fit, each for `pattern_us`, None: as long as fits.

    `led_currents`: red, green and blue, 0 ... 255, None: as they are. `trigger_delays_us`: of
    trigger out 1, its rising and falling edge, and of trigger out 2, -20 to 2.7. Raises InputError
    for what does not fit.
    """

    bits: Bits = 8
    per_picture: int | None = None
    pattern_us: int | None = None
    refresh_hz: float = 60.0
    led_currents: tuple[int, int, int] | None = None
    trigger_delays_us: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        shortest = MIN_EXPOSURES_US[self.bits - 1]
        if not 1 <= self.count <= self._most or self._least_us < shortest:
            raise InputError(
                f"per_picture = {self.per_picture} and pattern_us = {self.pattern_us} do not fit",
                f"a pattern of {self.bits} bits takes {shortest} us or longer, and a picture at"
                f" {self.refresh_hz:g} Hz has room for {self._most} of {self._least_us} us",
            )
        if self.led_currents == (0, 0, 0):
            raise InputError("led_currents of 0 give no light", "switch one LED on at least")
        if not all(0 <= register <= _LONGEST_DELAY for register in self._delay_registers):
            raise InputError(
                f"trigger_delays_us = {self.trigger_delays_us} are impossible", "give -20 to 2.7 us"
            )

    @property
    def count(self) -> int:
        """Patterns of a picture."""
        return self._most if self.per_picture is None else self.per_picture

    @property
    def has_black(self) -> bool:
        """Whether time is left for a black fill before the next picture."""
        return self.count * self._least_us + BLACK_US <= self._refresh_us

    @property
    def period_us(self) -> int:
        """Exposure of a pattern, which is also its period."""
        longest = (self._refresh_us - BLACK_US * self.has_black) // self.count
        return self.pattern_us or longest

    @property
    def triggers(self) -> bytes:
        """The registers of the trigger delays."""
        return bytes(self._delay_registers)

    @property
    def _refresh_us(self) -> int:
        return int(1e6 / self.refresh_hz)

    @property
    def _least_us(self) -> int:
        return self.pattern_us or MIN_EXPOSURES_US[self.bits - 1]

    @property
    def _plane_step(self) -> int:
        """Bit planes from one pattern to the next; of 7 bits the lowest is unused."""
        return 8 if self.bits == 7 else self.bits

    @property
    def _most(self) -> int:
        """Patterns that fit a picture."""
        return min(24 // self._plane_step, self._refresh_us // self._least_us)

    @property
    def _delay_registers(self) -> list[int]:
        return [_NO_DELAY + round(us / _TRIGGER_STEP_US) for us in self.trigger_delays_us]

    def list_entries(self, is_burst: bool) -> list[bytes]:
        """Return the look-up table of a picture: its patterns, or the uppermost bits of green as
        often, so that each is exposed as in a burst."""
        leds = sum(1 << k for k, current in enumerate(self.led_currents or (1, 1, 1)) if current)
        green, last = 8 // self._plane_step - 1, self.count - 1
        return [
            lut_entry(
                k if is_burst else green,
                self.bits,
                leds,
                first=k == 0,
                black=self.has_black and k == last,
            )
            for k in range(self.count)
        ]

    def pack(self, patterns: list[NDArray[np.uint8]]) -> NDArray[np.uint8]:
        """Return a picture (extent, 3) RGB whose bit planes G0 ... G7, R0 ... R7, B0 ... B7 are the
        levels (extent,) of up to `count` patterns, rounded to `bits`.
        """
        step, full = self._plane_step, 2**self.bits - 1
        word = np.zeros(len(patterns[0]), np.uint32)
        for k, levels in enumerate(patterns):
            rounded = np.rint(levels * (full / 255)).astype(np.uint32)
            word |= rounded << (step * k + step - self.bits)
        return np.stack([word >> shift & 0xFF for shift in (8, 0, 16)], axis=1).astype(np.uint8)

    def divide(self, sequence: PatternSequence) -> tuple[list[PackedPicture], tuple[int, ...]]:
        """Return the pictures of a sequence, and the place among their patterns of each frame.

        A picture varies along one axis: places may stay empty. Raises InputError for grey levels in
        one bit.
        """
        groups: list[tuple[Axis | None, list[NDArray[np.uint8]]]] = []
        places = []
        for k in range(len(sequence.frames)):
            along, levels = profile(sequence, k)
            if self.bits == 1 and not np.isin(levels, (0, 255)).all():
                raise InputError("a pattern of one bit has no grey levels", "set bits to 7 or 8")
            axis, patterns = groups.pop() if groups else (None, [])
            if len(patterns) == self.count or (axis and along and axis != along):
                groups.append((axis, patterns))
                axis, patterns = None, []
            places.append(len(groups) * self.count + len(patterns))
            groups.append((axis or along, [*patterns, levels]))
        pictures = []
        for axis, patterns in groups:
            # even light is as long as the projector is wide
            extent = sequence.extent(axis or "x")
            rgb = self.pack([np.resize(levels, extent) for levels in patterns])
            pictures.append(PackedPicture(axis or "x", rgb))
        return pictures, tuple(places)


class LightCrafter4500(Openable):
    """A LightCrafter 4500 whose pictures come from `pictures`; `connect` opens its control by USB.

    A capture ends with a DeviceError where the control is unplugged or refuses a command, where its
    sequence stops or its buffer is frozen. `notes`: what it warned of.
    """

    def __init__(
        self, pictures: Pictures, connect: Callable[[], Transport], timing: PatternTiming
    ) -> None:
        """Raises InputError for pictures that are not of one pixel a mirror."""
        super().__init__("the LightCrafter 4500")
        self.size = pictures.size
        if tuple(self.size) != SIZE:
            raise InputError(
                f"the LightCrafter 4500 has 912x1140 mirrors, and its pictures {self.size} px",
                "give it pictures of its size",
            )
        self._pictures, self._connect, self._timing = pictures, connect, timing
        self._control: Dlpc350 | None = None
        self._sequence: PatternSequence | None = None
        self._is_loaded = self._is_stepping = False
        self.notes: tuple[str, ...] = ()

    def _start(self) -> None:
        """Claim control and pictures, wake it up, and show dark."""
        try:
            transport = self._connect()
        except OSError as error:
            raise DeviceError(
                f"{self.name} cannot be opened ({error})",
                "close other programs that use it, and on Linux permit its USB device by a udev"
                " rule",
            ) from error
        control = self._control = Dlpc350(transport, self.name)
        self._is_stepping = False
        self._pictures.open()
        control.set(Command.POWER, 0)
        control.write(Command.FREEZE, b"\0")
        if faults := control.list_faults(is_running=False):
            raise control.describe_faults(faults)
        control.write(Command.SOURCE, bytes([_PARALLEL_24_BIT]))
        if (currents := self._timing.led_currents) is not None:
            # the board's drivers give most current at 0
            control.write(Command.LED_CURRENTS, bytes(255 - current for current in currents))
        self.show_level(None)

    def close(self) -> None:
        """Stop the sequence, and be a display again."""
        control, self._control, self._sequence = self._control, None, None
        if control:
            with contextlib.suppress(DeviceError):
                control.set(Command.RUN, RUN_STOPPED)
                control.set(Command.DISPLAY_MODE, 0)
            control.close()
        self._pictures.close()
        super().close()

    def load(self, sequence: PatternSequence) -> None:
        """Load the sequence; its pictures are sent by `show` or `run`, which need other ones."""
        self.check_open()
        check_sequence(self, sequence)
        self._sequence, self._is_loaded = sequence, False

    def show(self, index: int) -> None:
        """Show frame `index` as a grey picture."""
        sequence = check_index(self, self._sequence, index)
        control = self._step()
        if not self._is_loaded:
            self._pictures.load(sequence)
            self._is_loaded = True
        self._pictures.show(index)
        control.check_running()

    def show_level(self, grey: int | None) -> None:
        """Show even light."""
        control = self._step()
        self._pictures.show_level(grey)
        control.check_running()

    def prepare(self) -> PatternBurst:
        """Divide the loaded sequence into pictures, and stop, dark, until `run`."""
        sequence = check_index(self, self._sequence, 0)
        control, timing = self._require_control(), self._timing
        pictures, places = timing.divide(sequence)
        dark, white = (
            PackedPicture("x", np.full((self.size[0], 3), level, np.uint8)) for level in (0, 255)
        )
        dim = [dark] * _LEAD
        self._pictures.show_level(None)
        self._pictures.load_pictures([*dim, white, *pictures, white, *dim])
        self._is_loaded = self._is_stepping = False
        self._send(control, is_burst=True)
        count, n = timing.count, len(pictures)
        most = (n + 2 + 2 * _LEAD + _SPARE) * count
        seconds = (n + 2) / timing.refresh_hz
        return PatternBurst(places, count, n * count, timing.period_us / 1000, seconds, most)

    def run(self) -> None:
        """Show what was prepared once."""
        control = self._require_control()
        control.start()
        self._pictures.play()
        control.check_running()
        control.set(Command.RUN, RUN_STOPPED)

    def _step(self) -> Dlpc350:
        """Return the control, which shows each picture as one pattern from now on."""
        control = self._require_control()
        if not self._is_stepping:
            self._send(control, is_burst=False)
            control.start()
            self._is_stepping = True
        return control

    def _send(self, control: Dlpc350, is_burst: bool) -> None:
        """Send how pictures are divided, and note what the controller warns of."""
        timing = self._timing
        entries = timing.list_entries(is_burst)
        warnings = control.send_sequence(entries, timing.period_us, timing.triggers)
        self.notes = tuple(f"{self.name} warns: {words}" for words in warnings)

    def _require_control(self) -> Dlpc350:
        """Return the control. Raises DeviceError unless the projector is open."""
        self.check_open()
        assert self._control
        return self._control


def _connect(
    bits: Bits = 8,
    per_picture: Annotated[int, msgspec.Meta(ge=1, le=24)] | None = None,
    pattern_us: Annotated[int, msgspec.Meta(ge=1, le=50_000)] | None = None,
    refresh_hz: Annotated[float, msgspec.Meta(ge=20, le=120)] = 60.0,
    led_currents: tuple[_Current, _Current, _Current] | None = None,
    trigger_delays_us: tuple[float, float, float] = (0.0, 0.0, 0.0),
    serial: str | None = None,
    page: ProjectorChannel | None = None,
) -> LightCrafter4500:
    """Return the connected projector, of that serial number; `page` leads to its picture."""
    timing = PatternTiming(
        bits, per_picture, pattern_us, refresh_hz, led_currents, trigger_delays_us
    )
    return LightCrafter4500(BrowserProjector(SIZE, page), partial(open_hid, serial), timing)


def list_lightcrafters() -> list[str]:
    """List the connected devices."""
    return [f"LightCrafter 4500, serial {each['serial_number']}" for each in list_devices()]


DRIVER = Driver(
    "lightcrafter4500",
    "a LightCrafter 4500 (DLPC350) in pattern mode, with a trigger for the camera",
    needs="its HDMI as a display of 912x1140 px that shows the projector page, and its USB",
    packages={"hid": "pip install 'slviewer[lightcrafter]'"},
    projector=_connect,
    page=True,
    list_connected=list_lightcrafters,
)
