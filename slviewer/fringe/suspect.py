"""A frame that stands out from the others of its capture."""

from dataclasses import dataclass
from typing import Literal

Fault = Literal[
    "late", "early", "swapped", "dropped", "lag", "strange", "exposure-drift", "flicker", "room-light", "gamma"
]  # fmt: skip
"""It shows the pattern before its own; the one after it; two have changed places; this one is lost and those that
follow come too early; all come too late from here on; it fits nothing that was to be shown. Of the light: frames are
brighter or darker than others; rows of a frame are; the room's light changed; it is not proportional to the pattern's
grey level.
"""
ORDER_FAULTS: tuple[Fault, ...] = ("late", "early", "swapped", "dropped", "lag")
"""Faults of the order in which the frames were taken."""
LIGHT_FAULTS: tuple[Fault, ...] = ("exposure-drift", "flicker", "room-light", "gamma")
"""Faults that decoding corrects, and that say nothing about the order of the frames."""


@dataclass(frozen=True)
class Suspect:
    """One finding: `frame` counts from 0, the sentence, for the operator, from 1."""

    frame: int
    fault: Fault
    sentence: str
