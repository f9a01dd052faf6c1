"""Contradiction between the frames of a capture and its description."""

from dataclasses import dataclass

from slviewer.fringe.sequence import Axis


@dataclass(frozen=True)
class Contradiction:
    """Contradiction between the frames of a capture and its description.

    ``cause``: one of a fixed set of labels; ``message``: what was observed and what to do;
    ``axis``: None for both; ``value``: the value that fits instead of the described one, in the
    unit of the message, None where it is not a number.
    """

    cause: str
    message: str
    axis: Axis | None
    value: float | None
