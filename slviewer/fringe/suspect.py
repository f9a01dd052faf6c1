"""A frame that stands out from the others of its capture."""

from dataclasses import dataclass
from typing import Literal

Fault = Literal["late", "early", "swapped", "dropped", "lag", "light", "strange"]
"""It shows the pattern before its own; the one after it; two have changed places; this one is lost and those that
follow come too early; all come too late from here on; it is brighter or darker; it fits nothing that was to be shown.
"""


@dataclass(frozen=True)
class Suspect:
    """One finding: `frame` counts from 0, the sentence, for the operator, from 1."""

    frame: int
    fault: Fault
    sentence: str
