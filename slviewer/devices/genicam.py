"""USB3 Vision and GigE Vision cameras, through the GenTL producer that their maker installs."""

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from slviewer.devices.drivers import Driver
from slviewer.devices.genicam_features import Features, Trigger
from slviewer.devices.gentl import ListedCamera, list_cameras
from slviewer.devices.gentl_link import Image, Link, open_node_map
from slviewer.devices.protocols import (
    CameraSettings,
    Channel,
    Openable,
    check_channel,
    check_frame,
    extract_channel,
)
from slviewer.errors import DeviceError, InputError

IN_FLIGHT = 2
"""Frames of a camera that runs by its own clock, or a line's, that may have begun before a call and
arrive after it: one that is being exposed, and the one before, which is being read out and sent."""

_ANSWER_TIMEOUT_S = 2.0


@dataclass(eq=False)
class GenicamCamera(Openable):
    """The connected camera of that serial number or model, or the only one there is: it delivers
    grey levels unprocessed, uint8, or uint16 with its 10 or 12 bits at the bottom.

    With a software trigger each grab starts its own exposure. Of a camera that runs free, or by a
    line whose pulses repeat (a projector's frame clock), buffers are discarded until one comes
    whose exposure began after the call. A frame that is late or incomplete is a DeviceError, and
    never mistaken for the next: the stream is restarted after it.

    `producer` is the .cti file of its maker's software, None: all that are installed. `exposure_ms`
    and `gain` are set when it is opened, None: unchanged. `pixel_format` None: the deepest mono of
    up to 12 bits that comes unpacked; of a colour camera its colours, of which `grab` decodes the
    `channel`, and `grab_colour` all three. `trigger` "software" (where it has one), "hardware" with
    the name of its `line`, or "free". Raises InputError for what the camera has not, or where
    several fit; DeviceError where none is connected.
    """

    producer: str | None = None
    serial: str | int | None = None
    model: str | None = None
    exposure_ms: float | None = None
    gain: float | None = None
    pixel_format: str | None = None
    channel: Channel = "green"
    trigger: Trigger | None = None
    line: str | None = None

    def __post_init__(self) -> None:
        check_channel(self.channel)
        serial = None if self.serial is None else str(self.serial)
        self._camera = _choose_camera(list_cameras(self.producer), serial, self.model)
        super().__init__(f"the camera {self._camera}")
        self._first = CameraSettings(self.exposure_ms, self.gain)
        with open_node_map(self._camera) as node_map:
            features = Features(node_map, self.name)
            self.pixels = features.choose_format(self.pixel_format)
            self._trigger = features.choose_trigger(self.trigger, self.line)
            features.check_settings(self._first)
            self.size = features.size()
        self.dtype, self.full_scale = self.pixels.dtype, 2**self.pixels.bits - 1
        if self.pixels.colour:
            self.grab_colour = self._grab_colour  # which makes it a `ColourCamera`
        self._link: Link | None = None
        self._timeout_s = _ANSWER_TIMEOUT_S

    def _start(self) -> None:
        """Claim the camera and start it. Raises DeviceError where it is gone, in use or was
        reconfigured."""
        self._link = Link(self._camera)
        features = self._get_features()
        features.prepare(self.pixels, self._trigger, self.line)
        if features.size() != self.size:
            (width, height), (columns, rows) = features.size(), self.size
            raise DeviceError(
                f"{self.name} has images of {width}x{height} px, no longer {columns}x{rows}: choose"
                " it anew"
            )
        self.apply(self._first)
        self._link.start()

    def close(self) -> None:
        """Release the camera, in free-running mode."""
        super().close()
        link, self._link = self._link, None
        if link is not None:
            link.stop()
            with contextlib.suppress(Exception):
                Features(link.node_map, self.name).release()
            link.close()

    def grab(self, out: np.ndarray) -> None:
        """Grab a frame whose exposure began after the call into `out` (h, w)."""
        self.check_open()
        check_frame(self, out)
        with self._grab_fresh() as image:
            if self.pixels.colour:
                extract_channel(self._convert_rgb(image), self.channel, out)
            else:
                self.pixels.unpack(image.data, out, image.padding)

    def _grab_colour(self) -> np.ndarray:
        """Grab a frame whose exposure began after the call, (h, w, 3) RGB."""
        self.check_open()
        with self._grab_fresh() as image:
            return np.array(self._convert_rgb(image))

    def _convert_rgb(self, image: Image) -> np.ndarray:
        """Convert the bytes of an image to (h, w, 3) RGB."""
        return self.pixels.rgb(self.pixels.view_samples(image.data, image.size, image.padding))

    def settings(self) -> CameraSettings:
        """Read the current settings; None for those that the camera lacks, and for a gain in
        device-specific steps."""
        self.check_open()
        return self._get_features().settings()

    def apply(self, settings: CameraSettings) -> CameraSettings:
        """Set the nearest supported values, and return them; None for settings that the camera
        lacks."""
        self.check_open()
        features = self._get_features()
        features.apply(settings)
        applied = features.settings()
        self._timeout_s = _ANSWER_TIMEOUT_S + (applied.exposure_ms or 0.0) / 1000
        return applied

    @contextlib.contextmanager
    def _grab_fresh(self) -> Iterator[Image]:
        """Yield an image whose exposure began after the call; after an error the stream is
        stopped."""
        link = self._link
        assert link is not None
        try:
            if not link.streaming:
                link.start()
            link.drop_filled()
            if self._trigger == "software":
                self._get_features().fire()
            else:
                for _ in range(IN_FLIGHT):
                    link.drop_next(self._timeout_s)
            with link.next(self._timeout_s, self.pixels.nbytes) as image:
                if image.size != self.size:
                    raise DeviceError(
                        f"{self.name} sent a frame of {image.size}, not {self.size}: choose it anew"
                    )
                yield image
        except BaseException:
            link.stop()  # what is still on its way must not be the next grab's
            raise

    def _get_features(self) -> Features:
        """Return the features of the open camera."""
        assert self._link is not None
        return Features(self._link.node_map, self.name)


def _choose_camera(
    cameras: list[ListedCamera], serial: str | None, model: str | None
) -> ListedCamera:
    """Return the only camera of that serial number and model. Raises InputError or DeviceError with
    a list."""
    listed = "; ".join(map(str, cameras))
    matching = [
        camera
        for camera in cameras
        if serial in (None, camera.serial)
        and (model is None or model.casefold() == camera.model.casefold())
    ]
    if len(matching) == 1:
        return matching[0]
    if matching:
        raise InputError(
            f"{len(matching)} cameras match ({listed}): choose one by its `serial` number"
        )
    if cameras:
        raise DeviceError(
            f"no such camera is connected, only {listed}: choose one of them, or plug yours in"
        )
    raise DeviceError(
        "no camera is connected: plug one in, wait until it has started, and close other programs"
    )


def list_genicam_cameras() -> list[str]:
    """List the connected cameras: maker, model, serial number. Raises DeviceError without
    producers."""
    return [str(camera) for camera in list_cameras()]


_INSTALL = "pip install 'slviewer[genicam]'"
DRIVER = Driver(
    "genicam",
    "a USB3 Vision or GigE Vision camera (FLIR, Basler, IDS, …)",
    needs="the software of the camera's maker, which brings a GenTL producer (a .cti file)",
    packages={"harvesters": _INSTALL, "genicam": _INSTALL},
    camera=GenicamCamera,
    list_connected=list_genicam_cameras,
)
