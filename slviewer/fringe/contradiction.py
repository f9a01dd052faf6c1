"""One point in which the frames of a capture contradict its description."""

from dataclasses import dataclass

from slviewer.fringe.sequence import Axis


@dataclass(frozen=True)
class Contradiction:
    """``cause`` in one of the agreed words; ``message``: what was seen and what to do; ``axis`` None for both;
    ``value`` that fits instead of the described one, in the unit of the message, None where it is no number.
    """

    cause: str
    message: str
    axis: Axis | None
    value: float | None
