"""What can go wrong, by how the program ends.

Every error states what happened and what to do; both are shown to the operator as they are.
"""

import re
from typing import Any, Self, TypeVar

AnyError = TypeVar("AnyError", bound=Exception)

# up to the last @, as passwords hold all kinds of characters
_CREDENTIALS = re.compile(r"(?<=://)[^\s\"']+(?=@)")


def hide_passwords(text: str) -> str:
    """Return the text with user and password in addresses, such as rtsp://user:password@camera,
    replaced by "…".

    Whatever is shown, logged or exported passes through here.
    """
    return _CREDENTIALS.sub("…", text)


class SlviewerError(Exception):
    """Base of all errors of slviewer, as text "place: observation: remedy" without passwords.

    ``observation``: what happened; ``remedy``: what to do, "" where the observation says it;
    ``place``: where it happened, such as the name of a capture, or "".
    """

    exit_status = 1
    observation = remedy = place = ""

    def __init__(self, observation: str = "", remedy: str = "", place: str = "") -> None:
        super().__init__(observation)
        # plugins may pass other things than text
        parts = map(str, (observation, remedy, place))
        self.observation, self.remedy, self.place = map(hide_passwords, parts)

    def __str__(self) -> str:
        stated = _join(self.located_observation, self.remedy)
        return stated or hide_passwords(super().__str__())  # of a constructor that calls no other

    def __reduce__(self) -> Any:
        return _make_again, (type(self), self.args, vars(self))

    @property
    def located_observation(self) -> str:
        """The observation, after its place where it has one."""
        return _join(self.place, self.observation)

    def within(self, place: str) -> Self:
        """Return a copy of the error with a ``place`` in front of its own."""
        place = _join(hide_passwords(place), self.place)
        return _make_again(type(self), self.args, vars(self) | {"place": place})


def _join(*parts: str) -> str:
    """Return the parts of a message that are not empty, as one."""
    return ": ".join(filter(None, parts))


def _make_again(
    kind: type[AnyError], arguments: tuple[Any, ...], state: dict[str, Any]
) -> AnyError:
    """Return an error without a call of its constructor, whatever that takes."""
    error = kind.__new__(kind, *arguments)
    vars(error).update(state)
    return error


class UsageError(SlviewerError):
    """A command that lacks a required option or argument."""

    exit_status = 2


class InputError(SlviewerError):
    """Frames, files or settings that cannot be used as they are."""


class UnknownLayoutError(InputError):
    """A folder of images whose names no layout knows, and that nothing describes."""


class DetectionError(InputError):
    """A target that was not detected in an image."""


class BoardError(DetectionError):
    """A target that was detected, and contradicts its description or is a mirror image; ``cause``:
    that of the finding."""

    def __init__(
        self, observation: str = "", remedy: str = "", place: str = "", *, cause: str = ""
    ) -> None:
        super().__init__(observation, remedy, place)
        self.cause = cause


class SessionError(SlviewerError):
    """A session folder that cannot be read or written."""


class DamagedError(SessionError):
    """A stored capture or result that is not what was saved: a file of it is missing, cut short or
    altered."""


class DeviceError(SlviewerError):
    """A camera or projector that does not answer, was unplugged, or cannot do what was
    requested."""


class TurntableError(DeviceError):
    """A turntable that did not reach its angle; camera and projector are not affected."""


class CalibrationRejected(SlviewerError):
    """A calibration that was computed, or could not be, and must not be used."""

    exit_status = 3


class Cancelled(SlviewerError):
    """The operator stopped the work."""

    exit_status = 130
