"""A camera and a projector that exchange images with other programs through folders.

The camera suits whatever writes each picture into a folder, such as the tethering program of a
still camera, with a command that takes one. The projector suits whatever displays a file when it
changes.
"""

import os
import shlex
import subprocess
import time
from pathlib import Path

import cv2
import numpy as np

from slviewer.plugins import (
    CameraSettings,
    DeviceError,
    Driver,
    InputError,
    Openable,
    PatternSequence,
    check_frame,
    check_index,
    check_level,
    check_sequence,
    render,
)

_SUFFIXES = {".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp"}


class HotfolderCamera(Openable):
    """Takes the first picture that appears in `folder` after `trigger`, a command that takes one,
    has been started.

    Pictures are (height, width) of `size`; green is used of those in colour. `timeout_s`: how long
    to wait for one.
    """

    dtype = np.dtype(np.uint8)

    def __init__(
        self, folder: str, size: tuple[int, int], trigger: str = "", timeout_s: float = 10.0
    ) -> None:
        super().__init__("the hot-folder camera")
        self.size = (int(size[0]), int(size[1]))
        self._folder, self._trigger, self._timeout_s = Path(folder), shlex.split(trigger), timeout_s

    def open(self) -> None:
        """Open the camera. Raises DeviceError if its folder does not exist."""
        if not self._folder.is_dir():
            raise DeviceError(
                f"{self._folder} is no folder",
                "create it, or name the one that receives the pictures",
            )
        super().open()

    def grab(self, out: np.ndarray) -> None:
        """Take one picture, and wait until it is written."""
        self.check_open()
        check_frame(self, out)
        before = self._list_pictures()
        if self._trigger:
            self._start_trigger()
        end = time.monotonic() + self._timeout_s
        while time.monotonic() < end:
            for path in sorted(self._list_pictures() - before):
                image = cv2.imread(str(path), cv2.IMREAD_COLOR)
                if image is not None:  # None: it is still being written
                    self._copy(path, image, out)
                    return
            time.sleep(0.01)
        raise DeviceError(
            f"no picture arrived in {self._folder} within {self._timeout_s:g} s",
            "is the program that writes them running?",
        )

    def settings(self) -> CameraSettings:
        """Return unknown settings: they are those of the other program."""
        self.check_open()
        return CameraSettings()

    def apply(self, settings: CameraSettings) -> CameraSettings:
        """Change nothing, which is what the result states."""
        self.check_open()
        return CameraSettings()

    def _list_pictures(self) -> set[Path]:
        """Return the pictures that are in the folder now."""
        return {path for path in self._folder.iterdir() if path.suffix.lower() in _SUFFIXES}

    def _start_trigger(self) -> None:
        """Run the command that takes a picture."""
        try:
            subprocess.run(self._trigger, check=True, capture_output=True, timeout=self._timeout_s)
        except (OSError, subprocess.SubprocessError) as error:
            raise DeviceError(
                f"the trigger {self._trigger[0]} failed ({error})", "try it in a terminal"
            ) from error

    def _copy(self, path: Path, image: np.ndarray, out: np.ndarray) -> None:
        """Copy the green channel of a picture (h, w, 3) BGR."""
        if image.shape[:2] != out.shape:
            height, width = image.shape[:2]
            raise DeviceError(
                f"{path.name} is {width}x{height} px",
                f"correct the size of the camera, {self.size}",
            )
        out[:] = image[..., 1]


class HotfolderProjector(Openable):
    """Leaves each pattern as `file`, a PNG that another program displays; `settle_s` later it is
    taken as shown."""

    def __init__(self, file: str, size: tuple[int, int], settle_s: float = 0.2) -> None:
        super().__init__("the hot-folder projector")
        self.size = (int(size[0]), int(size[1]))
        self._file, self._settle_s = Path(file), settle_s
        self._sequence: PatternSequence | None = None
        if self._file.suffix.lower() != ".png":
            raise InputError(
                f"{self._file.name} is no PNG", "give the projector a file that ends in .png"
            )

    def open(self) -> None:
        """Open the projector: dark, nothing loaded."""
        super().open()
        self._sequence = None
        self.show_level(None)

    def load(self, sequence: PatternSequence) -> None:
        """Load a sequence."""
        self.check_open()
        check_sequence(self, sequence)
        self._sequence = sequence

    def show(self, index: int) -> None:
        """Show a frame of the loaded sequence."""
        self.check_open()
        self._write(render(check_index(self, self._sequence, index), index))

    def show_level(self, grey: int | None) -> None:
        """Show even light."""
        self.check_open()
        width, height = self.size
        self._write(np.full((height, width), check_level(grey), np.uint8))

    def _write(self, image: np.ndarray) -> None:
        """Replace the file in one step, so that no half of it is displayed, and wait until it is
        shown."""
        done, data = cv2.imencode(".png", image)
        if not done:
            raise DeviceError("the pattern could not be encoded as PNG")
        part = self._file.with_suffix(".part")
        try:
            part.write_bytes(data.tobytes())
            os.replace(part, self._file)
        except OSError as error:
            raise DeviceError(
                f"{self._file} cannot be written ({error.strerror})", "choose another file"
            ) from error
        time.sleep(self._settle_s)


DRIVER = Driver(
    "hotfolder",
    "a camera and a projector that exchange images with other programs through folders",
    needs="a program that writes pictures into a folder, or one that displays a file",
    camera=HotfolderCamera,
    projector=HotfolderProjector,
)
