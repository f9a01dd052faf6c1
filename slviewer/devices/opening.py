"""Base class of devices without hardware: they are open or closed."""

from slviewer.errors import DeviceError


class Openable:
    """A device that works only while it is open."""

    def __init__(self, name: str) -> None:
        self.name = name
        self._open = False

    def open(self) -> None:
        """Open the device. Raises DeviceError if it is open already."""
        if self._open:
            raise DeviceError(f"{self.name} is open already: close it first")
        self._open = True

    def close(self) -> None:
        """Close the device; nothing happens when it is not open."""
        self._open = False

    def check_open(self) -> None:
        """Raise DeviceError unless it is open."""
        if not self._open:
            raise DeviceError(f"{self.name} is not open: open it before using it")
