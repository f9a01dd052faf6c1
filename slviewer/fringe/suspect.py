"""A frame that stands out from the others of its capture."""

from dataclasses import dataclass
from typing import Literal

Fault = Literal[
    "late", "early", "swapped", "dropped", "lag", "strange", "exposure-drift", "flicker",
    "room-light", "gamma"
]  # fmt: skip
"""Fault of a frame. "late": it shows the pattern before its own; "early": the one after it;
"swapped": two frames have changed places; "dropped": this frame is missing and those after it come
too early; "lag": all frames from here on come too late; "strange": it fits none of the patterns. Of
the light: "exposure-drift": frames are brighter or darker than others; "flicker": rows of a frame
are; "room-light": the room light changed; "gamma": the light is not proportional to the grey level
of the pattern.
"""
ORDER_FAULTS: tuple[Fault, ...] = ("late", "early", "swapped", "dropped", "lag")
"""Faults of the order in which the frames were captured."""
LIGHT_FAULTS: tuple[Fault, ...] = ("exposure-drift", "flicker", "room-light", "gamma")
"""Faults that decoding corrects, and that do not concern the order of the frames."""


@dataclass(frozen=True)
class Suspect:
    """Finding about one frame: `frame` counts from 0, the frame numbers in `sentence`, for the
    operator, from 1."""

    frame: int
    fault: Fault
    sentence: str
