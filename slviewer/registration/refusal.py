"""Why two scans are not registered."""

from typing import Literal

from slviewer.errors import SlviewerError

Reason = Literal[
    "overlap", "disagree", "plane", "sphere", "cylinder", "slides", "turns", "ambiguous", "picks"
]


class Refused(SlviewerError):
    """A refused registration, with its ``reason``.

    overlap: the overlap is too small; disagree: the surfaces agree at no pose; plane, sphere,
    cylinder, slides (along one direction), turns (about one axis): the shared shape leaves the pose
    undetermined; ambiguous: two poses fit equally well; picks: picked points that determine no pose
    or contradict one another.
    """

    def __init__(self, reason: Reason, message: str) -> None:
        super().__init__(message)
        self.reason: Reason = reason

    def with_context(self, context: str) -> "Refused":
        """Return a copy of the error with a sentence put in front of its message."""
        return Refused(self.reason, f"{context} {self}")


class WrongPart(Refused):
    """A scan that fits another model by far better than the nominal one: its mirror image, or the
    model at another scale, as the message says."""

    def __init__(self, message: str) -> None:
        super().__init__("disagree", message)
