"""Which value a client may give to an input: of its type, inside its range or among its options."""

import math
from typing import Any

import viser

TEXT_LIMIT = 20_000
"""Characters; no input of the wizard needs a tenth of it."""


class ValueRefused(Exception):
    """A message that is dropped; `correct` where the client should be shown the true value again.

    A number outside its range is not corrected: whoever types 50 into a field that starts at 10 passes through 5.
    """

    def __init__(self, reason: str, correct: bool = False) -> None:
        super().__init__(reason)
        self.correct = correct


def check_value(handle: Any, value: Any) -> None:
    """Refused unless the input takes this value, as it stands in the message."""
    match handle:
        case viser.GuiButtonHandle():
            _require(value is True, "a button is pressed, nothing else")
        case viser.GuiCheckboxHandle():
            _require(isinstance(value, bool), "not yes or no")
        case viser.GuiDropdownHandle() | viser.GuiButtonGroupHandle():
            _require(isinstance(value, str) and value in handle.options, "not an option", correct=True)
        case viser.GuiTextHandle():
            _require(isinstance(value, str) and _plain(value, handle.multiline), "not plain text")
        case viser.GuiNumberHandle() | viser.GuiSliderHandle():
            _number(value, handle.value, handle.min, handle.max)
        case viser.GuiVector2Handle() | viser.GuiVector3Handle():
            _length(value, handle.value)
            low = handle.min or (None,) * len(value)
            high = handle.max or (None,) * len(value)
            for each in zip(value, handle.value, low, high, strict=True):
                _number(*each)
        case viser.GuiMultiSliderHandle():
            _length(value, handle.value)
            for new, old in zip(value, handle.value, strict=True):
                _number(new, old, handle.min, handle.max)
            _require(list(value) == sorted(value), "handles out of order")
            ends = [(value[i], handle.value[i]) for i in (0, -1)] if len(value) else []
            _require(not handle.fixed_endpoints or all(a == b for a, b in ends), "fixed end moved", correct=True)
        case viser.GuiRgbHandle() | viser.GuiRgbaHandle():
            _length(value, handle.value)
            for channel in value:
                _number(channel, 0, 0, 255)
        case _:  # an upload button's file arrives as an upload, and what is unknown changes nothing
            raise ValueRefused("this input takes no value")


def _require(condition: bool, reason: str, correct: bool = False) -> None:
    if not condition:
        raise ValueRefused(reason, correct)


def _length(value: Any, current: tuple) -> None:
    _require(isinstance(value, list | tuple) and len(value) == len(current), "not as many numbers", correct=True)


def _number(value: Any, current: float, low: float | None, high: float | None) -> None:
    _require(isinstance(value, int | float) and not isinstance(value, bool), "not a number", correct=True)
    _require(abs(value) < 2**53 and math.isfinite(value), "not a finite number", correct=True)
    # viser would cut the fraction off in silence.
    _require(isinstance(current, float) or value == int(value), "not a whole number", correct=True)
    _require((low is None or value >= low) and (high is None or value <= high), "outside its range")


def _plain(text: str, multiline: bool) -> bool:
    allowed = "\n\r\t" if multiline else "\t"
    return len(text) <= TEXT_LIMIT and all(c.isprintable() or c in allowed or ord(c) > 159 for c in text)
