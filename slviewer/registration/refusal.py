"""Why two scans are not registered."""

from typing import Literal

from slviewer.errors import SlviewerError

Reason = Literal["overlap", "disagree", "plane", "sphere", "cylinder", "slides", "turns", "ambiguous", "picks"]


class Refused(SlviewerError):
    """A registration that cannot be trusted, with its ``reason``.

    overlap: too little of the surface is shared; disagree: no pose brings the surfaces together; plane, sphere,
    cylinder, slides (one direction), turns (one axis): the shared shape does not hold the pose; ambiguous: two poses
    fit alike; picks: picked points that fix no pose or contradict one another.
    """

    def __init__(self, reason: Reason, message: str) -> None:
        super().__init__(message)
        self.reason: Reason = reason

    def about(self, what: str) -> "Refused":
        """The same with the scans it is about in front."""
        return Refused(self.reason, f"{what} {self}")
