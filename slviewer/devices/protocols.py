"""Protocols of cameras, projectors and turntables: as little as a structured-light rig needs.

A device belongs to the thread that opened it. Every method raises `DeviceError` when the device
does not answer, is not open or was unplugged; after that, `close` and `open` are the way back, and
`close` never raises.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from typing import Literal, Protocol, TypeVar, get_args, runtime_checkable

import numpy as np

from slviewer.errors import DeviceError, InputError, SlviewerError
from slviewer.fringe.layout import clip_level
from slviewer.fringe.sequence import PatternSequence, Size


@dataclass(frozen=True)
class CameraSettings:
    """Exposure time in ms, and gain as a factor on the grey levels (1 = none).

    None: read from a device, it is unknown; given to `Camera.apply`, it stays as it is.
    """

    exposure_ms: float | None = None
    gain: float | None = None

    def __post_init__(self) -> None:
        if self.exposure_ms is not None and not 0 < self.exposure_ms <= 600_000:
            raise InputError(
                f"an exposure of {self.exposure_ms:g} ms is impossible",
                "give one above 0, up to 600,000",
            )
        if self.gain is not None and not 0 < self.gain <= 1e6:
            raise InputError(
                f"a gain of {self.gain:g} is impossible", "give a factor above 0, 1 for none"
            )


class Camera(Protocol):
    """Grabs single frames on request; `name`, `size` and `dtype` can be read before it is open.

    One of more than 8 bits may also have a `full_scale`, the grey level at which it clips, such as
    4095. It can be read before the camera is open, and is stored with its captures; without it the
    bit depth is taken from the brightest pixel, and a dark image may pass for a bright one of fewer
    bits. One that knows its focus, zoom or aperture may also have `read_lens`, as `CameraDriver`,
    and one whose shutter wears `preview_s`, the time between live images.
    """

    @property
    def name(self) -> str:
        """The operator's name for it, to start a sentence with, such as "the simulated camera"."""

    @property
    def size(self) -> Size:
        """(width, height) px of its frames."""

    @property
    def dtype(self) -> np.dtype:
        """uint8 or uint16."""

    def open(self) -> None:
        """Claim the device; opening it twice is an error, opening it again after `close` is not."""

    def close(self) -> None:
        """Release the device; nothing happens when it is not open."""

    def grab(self, out: np.ndarray) -> None:
        """Fill `out` (h, w) of `dtype` with a frame exposed after the projector last reported
        "shown"."""

    def settings(self) -> CameraSettings:
        """Read the current settings from the device."""

    def apply(self, settings: CameraSettings) -> CameraSettings:
        """Apply the settings, and return those in effect: the nearest that the device supports."""


@runtime_checkable
class ColourCamera(Camera, Protocol):
    """A camera that also sees colour: `grab` fills one channel, and a texture has all three."""

    def grab_colour(self) -> np.ndarray:
        """Grab a new (h, w, 3) RGB frame of `dtype`, exposed as `grab` requires."""


_SETTING_TOLERANCE = 0.1
"""Share by which an applied setting may differ from the requested one: cameras round to their
steps."""


def list_notes(camera: Camera) -> tuple[str, ...]:
    """Return a camera's own `notes`, one for each setting that it refused, where its driver has
    them."""
    return tuple(getattr(camera, "notes", ()))


def list_changed_settings(
    camera: Camera, wanted: CameraSettings, applied: CameraSettings
) -> tuple[str, ...]:
    """Return a sentence for each setting that the camera changed noticeably, unless its own `notes`
    report it."""
    settings = (
        ("an exposure", " ms", wanted.exposure_ms, applied.exposure_ms),
        ("a gain", "", wanted.gain, applied.gain),
    )
    return tuple(
        f"{camera.name} took {what} of {in_effect:g}{unit} in place of {value:g}{unit}: "
        "give one that it supports"
        for what, unit, value, in_effect in settings
        if value is not None
        and in_effect is not None
        and abs(in_effect - value) > _SETTING_TOLERANCE * value
        and not any(f"{value:g}{unit}" in note for note in list_notes(camera))
    )


def read_lens(camera: Camera) -> dict[str, float]:
    """Return what a camera reports of its "focus", "zoom" and "aperture", in its own units."""
    read = getattr(camera, "read_lens", dict)
    return {name: float(value) for name, value in read().items()}


def find_full_scale(camera: Camera, largest: int) -> float:
    """Return the grey level at which a camera clips: its own statement, else by the largest level
    of an image."""
    return clip_level(camera.dtype, largest, stated_full_scale(camera))


def stated_full_scale(camera: Camera) -> int | None:
    """Return the grey level at which a camera states that it clips; None where it states none."""
    stated = getattr(camera, "full_scale", None)
    return None if stated is None else int(stated)


def preview_interval(camera: Camera) -> float:
    """Return the s that a camera wants between live images; 0 where it states none."""
    return float(getattr(camera, "preview_s", 0.0))


def scene_state(camera: Camera) -> object:
    """Return all that a camera's image depends on, apart from noise; None where its driver does not
    know: the image may change at any time."""
    return getattr(camera, "scene_state", None)


_MAX_ANGLE_DEG = 1e5
"""What the controllers of turntables count exactly."""

Channel = Literal["red", "green", "blue", "grey"]
"""What a colour camera decodes; green has the most pixels under a Bayer mosaic, and the most light
of most lamps."""


def check_channel(channel: str) -> None:
    """Raise InputError unless `channel` is one of `Channel`."""
    if channel not in get_args(Channel):
        raise InputError(
            f"no channel is called {channel!r}", f"use one of {', '.join(get_args(Channel))}"
        )


def check_image_size(what: str, size: Sequence[int], most_px: int = 2**16) -> Size:
    """Return the (width, height) px of `what`, a camera or a projector. Raises InputError for
    anything else."""
    if len(size) != 2 or not all(isinstance(side, int) and 0 < side <= most_px for side in size):
        raise InputError(
            f"{size!r} is not the size of a {what}",
            "give its width and height in px, such as [1280, 720]",
        )
    return size[0], size[1]


def extract_channel(rgb: np.ndarray, channel: Channel, out: np.ndarray) -> None:
    """Fill `out` (h, w) with one channel of (h, w, 3) RGB, or with their mean."""
    if channel == "grey":
        np.copyto(out, rgb.mean(axis=2) + 0.5, casting="unsafe")
    else:
        np.copyto(out, rgb[..., ("red", "green", "blue").index(channel)])


class Projector(Protocol):
    """Shows one image until another is requested; `name` and `size` can be read before it is
    open."""

    @property
    def name(self) -> str:
        """The operator's name for it, to start a sentence with."""

    @property
    def size(self) -> Size:
        """(width, height) px."""

    def open(self) -> None:
        """Claim the device; it shows dark."""

    def close(self) -> None:
        """Release the device; nothing happens when it is not open."""

    def load(self, sequence: PatternSequence) -> None:
        """Load `sequence`, so that `show` is immediate; replaces the previous sequence, and shows
        nothing yet.

        Raises InputError for patterns that are not of the projector's size.
        """

    def show(self, index: int) -> None:
        """Show frame `index` of the loaded sequence; returns when its light reaches the scene."""

    def show_level(self, grey: int | None) -> None:
        """Show even light of grey level 0 ... 255, None for dark; returns when shown. The sequence
        stays loaded."""


@runtime_checkable
class ImageProjector(Projector, Protocol):
    """A projector that can also show any image, pixel by pixel."""

    def show_image(self, image: np.ndarray) -> None:
        """Show an image (h, w, 3) uint8 RGB of the projector's size; returns when shown. The
        sequence need not stay loaded. Raises InputError for an image of another size."""


@dataclass(frozen=True)
class PatternBurst:
    """A sequence that is shown at once, with a trigger for each pattern: dark, `marker` white ones,
    `length` patterns of which each frame has its place in `places`, `marker` white ones, dark;
    `most` triggers in all. `seconds`: how long patterns and markers last.
    """

    places: tuple[int, ...]
    marker: int
    length: int
    period_ms: float
    seconds: float
    most: int


@runtime_checkable
class BurstProjector(Projector, Protocol):
    """A projector that shows a sequence by itself, and triggers a camera with each pattern."""

    def prepare(self) -> PatternBurst:
        """Stop, dark and without triggers; returns what `run` shows of the loaded sequence."""

    def run(self) -> None:
        """Show what was prepared once; returns when it has ended."""


@runtime_checkable
class TriggeredCamera(Camera, Protocol):
    """A camera that exposes frames by triggers at a line, and buffers them."""

    def arm(self, frames: int) -> None:
        """Wait for up to `frames` triggers from now on."""

    def fetch(self, out: np.ndarray) -> bool:
        """Fill `out` (h, w) with the next triggered frame; False where none comes any more."""

    def disarm(self) -> None:
        """Stop waiting, and discard what is left."""


class Turntable(Protocol):
    """Turns what stands before the rig about an axis; `name` and `limits_deg` can be read before it
    is open.

    Its errors are `TurntableError`: the rig can capture without it.
    """

    @property
    def name(self) -> str:
        """The operator's name for it, to start a sentence with."""

    @property
    def limits_deg(self) -> tuple[float, float] | None:
        """The angles between which it turns; None: without end."""

    @property
    def is_absolute(self) -> bool:
        """Whether it still knows its angle after it was switched off."""

    def open(self) -> None:
        """Claim the device, without turning it. It keeps the angle that it stands at where it knows
        it, else 0."""

    def close(self) -> None:
        """Stop, and release the device; nothing happens when it is not open."""

    def position_deg(self) -> float:
        """Read the angle that it stands at, as far as the device knows it."""

    def turn_to(self, deg: float, check: Callable[[], None] = lambda: None) -> None:
        """Turn to an angle by the way in between, of several turns too, and return when it stands
        still.

        `check()` is called while it turns, and may raise (Cancelled), which stops it. Raises
        InputError for an angle outside its limits, TurntableError where it raises an alarm, stops
        before the angle, takes too long or was unplugged; it is then told to stop.
        """


class Openable:
    """A device that works only while it is open; `_start` claims it, and leaves in `_claimed` what
    releases it."""

    def __init__(self, name: str) -> None:
        self.name = name
        self._open = False
        self._claimed = ExitStack()

    def open(self) -> None:
        """Open the device. Raises DeviceError if it is open already, or does not start; it is
        closed then."""
        if self._open:
            raise DeviceError(f"{self.name} is open already", "close it first")
        self._open = True
        try:
            self._start()
        except BaseException:
            self.close()
            raise

    def _start(self) -> None:
        """Claim the device, which is marked as open already."""

    def close(self) -> None:
        """Close the device; nothing happens when it is not open. Never raises."""
        with suppress(Exception):  # of a device that was unplugged
            self._claimed.close()
        self._open = False

    def check_open(self) -> None:
        """Raise DeviceError unless it is open."""
        if not self._open:
            raise DeviceError(f"{self.name} is not open", "open it before using it")


@dataclass(frozen=True)
class Rig:
    """A camera and a projector that view the same scene, under the name that the operator chose.

    Of two cameras, the `second` takes a frame of each pattern after the first, and is calibrated in
    the projector's place. `settle_ms` passes between "shown" and the grab: the measured delay of
    the light after the projector's report. A `turntable` is opened by what uses it: captures do not
    need it. `bursts`: whether a capture may be a burst, where camera and projector can.
    """

    name: str
    camera: Camera
    projector: Projector
    settle_ms: float = 0.0
    turntable: Turntable | None = None
    second: Camera | None = None
    bursts: bool = True

    @property
    def cameras(self) -> tuple[Camera, ...]:
        """Its cameras, the first one first."""
        return (self.camera,) if self.second is None else (self.camera, self.second)

    @contextmanager
    def opened(self) -> Iterator["Rig"]:
        """Open the devices for a `with` block, and close them after it in any case."""
        self.open()
        try:
            yield self
        finally:
            self.close()

    def open(self) -> None:
        """Open all devices, or none. Raises DeviceError."""
        with ExitStack() as opened:
            devices: tuple[Camera | Projector, ...] = (self.projector, *self.cameras)
            for device in devices:
                with report_driver_faults(device):
                    device.open()
                opened.callback(device.close)
            opened.pop_all()

    def close(self) -> None:
        """Close all devices; never raises, whatever a plugin's driver does: what was captured is
        still to be saved."""
        devices: tuple[Camera | Projector, ...] = (*self.cameras, self.projector)
        for device in devices:
            with suppress(SlviewerError), report_driver_faults(device):
                device.close()


@contextmanager
def report_driver_faults(device: Camera | Projector | Turntable) -> Iterator[None]:
    """Raise DeviceError, which names the device, for what its driver may not raise: anything but
    our own errors."""
    try:
        yield
    except SlviewerError:
        raise
    except Exception as error:  # a driver's own fault, as of a plugin
        raise DeviceError(
            f"the driver of {device.name} failed with {type(error).__name__}: {error}",
            "report it to the driver's maker",
        ) from error


def check_frame(camera: Camera, out: np.ndarray) -> None:
    """Raise InputError unless `out` is a contiguous, writable (h, w) array that `camera.grab` can
    fill in place."""
    width, height = camera.size
    if out.shape != (height, width) or out.dtype != camera.dtype:
        raise InputError(
            f"{camera.name} fills frames of shape {(height, width)} {camera.dtype}, got {out.shape}"
            f" {out.dtype}",
            "make the array by its size",
        )
    if not (out.flags.c_contiguous and out.flags.writeable):
        raise InputError(
            f"{camera.name} fills frames row by row", "give a contiguous array that can be written"
        )


class CameraDriver(Openable):
    """A camera that is opened before it is used, and whose frames fit what they are written to:
    `_fill`, `_read_settings` and `_write_settings` are called of an open one only."""

    size: Size
    dtype: np.dtype

    def grab(self, out: np.ndarray) -> None:
        """Fill `out` (h, w) with a frame exposed after this call."""
        self.check_open()
        check_frame(self, out)
        self._fill(out)

    def settings(self) -> CameraSettings:
        """Read the current settings; None for those that are not known."""
        self.check_open()
        return self._read_settings()

    def read_lens(self) -> dict[str, float]:
        """Read "focus", "zoom" and "aperture" from the device, those that it reports, in its own
        units."""
        self.check_open()
        return self._read_lens()

    def apply(self, settings: CameraSettings) -> CameraSettings:
        """Set the nearest values that the camera has, and return those in effect."""
        self.check_open()
        self._write_settings(settings)
        return self._read_settings()

    def _fill(self, out: np.ndarray) -> None:
        raise NotImplementedError

    def _read_settings(self) -> CameraSettings:
        return CameraSettings()

    def _read_lens(self) -> dict[str, float]:
        return {}

    def _write_settings(self, settings: CameraSettings) -> None:
        pass


Listed = TypeVar("Listed")


def choose_only(cameras: Sequence[Listed], fits: Callable[[Listed], bool], key: str) -> Listed:
    """Return the only camera that fits. Raises InputError where several do, to be told apart by
    ``key``, else DeviceError, with a list."""
    listed = "; ".join(map(str, cameras))
    matching = list(filter(fits, cameras))
    if len(matching) == 1:
        return matching[0]
    if matching:
        raise InputError(f"{len(matching)} cameras match ({listed})", f"choose one by its {key}")
    if cameras:
        raise DeviceError(
            f"no such camera is connected, only {listed}", "choose one of them, or plug yours in"
        )
    raise DeviceError(
        "no camera is connected",
        "plug one in, wait until it has started, disable its power saving, and close other"
        " programs",
    )


def check_sequence(projector: Projector, sequence: PatternSequence) -> None:
    """Raise InputError unless `sequence` has frames, and the projector's size."""
    if not sequence.frames:
        raise InputError("the pattern sequence has no frames", "choose one that has")
    if tuple(sequence.projector) != tuple(projector.size):
        (w, h), (columns, rows) = sequence.projector, projector.size
        raise InputError(
            f"the patterns are {w}x{h} px and {projector.name} has {columns}x{rows}",
            "make them for this projector",
        )


def check_angle(turntable: Turntable, deg: float) -> None:
    """Raise InputError unless the turntable can turn to the angle."""
    low, high = turntable.limits_deg or (-_MAX_ANGLE_DEG, _MAX_ANGLE_DEG)
    if not low <= deg <= high:
        raise InputError(
            f"{turntable.name} turns from {low:g} to {high:g} degrees, not to {deg:g}",
            "choose others",
        )


def check_index(
    projector: Projector, sequence: PatternSequence | None, index: int
) -> PatternSequence:
    """Return the loaded sequence if it has frame `index`. Raises DeviceError if none is loaded,
    else InputError."""
    if sequence is None:
        raise DeviceError(
            f"{projector.name} has no patterns", "load a sequence before showing a frame"
        )
    if not 0 <= index < len(sequence.frames):
        raise InputError(f"frame {index} of {len(sequence.frames)} does not exist", "count from 0")
    return sequence


def check_image(projector: Projector, image: np.ndarray) -> np.ndarray:
    """Return an image (h, w, 3) uint8 that fits the projector. Raises InputError for another."""
    width, height = projector.size
    if image.shape != (height, width, 3) or image.dtype != np.uint8:
        raise InputError(
            f"the image is {image.shape} {image.dtype}, and {projector.name} shows"
            f" {(height, width, 3)} uint8",
            "make it for this projector",
        )
    return image


def check_level(grey: int | None) -> int:
    """Return the grey level 0 ... 255 to show, 0 for dark. Raises InputError."""
    if grey is None:
        return 0
    if not 0 <= grey <= 255:
        raise InputError(
            f"a grey level of {grey} cannot be projected", "give 0 to 255, or None for dark"
        )
    return grey
