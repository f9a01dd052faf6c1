"""What can go wrong, by how the program ends.

Every message is one sentence that says what was seen and what to do about it; it is shown to the operator as it is.
"""


class SlviewerError(Exception):
    """Something was refused or failed, and the message says what was seen and what to do."""

    exit_status = 1


class UsageError(SlviewerError):
    """A command that was not told what it needs."""

    exit_status = 2


class InputError(SlviewerError):
    """Frames, files or settings that cannot be used as they are."""


class DetectionError(InputError):
    """A target that was not found in an image."""


class SessionError(SlviewerError):
    """A session folder that cannot be read or written."""


class DeviceError(SlviewerError):
    """A camera or projector that does not answer, was unplugged, or cannot do what was asked."""


class CalibrationRejected(SlviewerError):
    """A calibration that was computed, or could not be, and must not be used."""

    exit_status = 3


class Cancelled(SlviewerError):
    """The operator stopped the work."""

    exit_status = 130
