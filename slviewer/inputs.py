"""Inputs of operations and commands: what a field of settings or a parameter may be is declared in
its annotation, and held by terminal, Python and wizard."""

import inspect
import re
from collections.abc import Mapping
from dataclasses import Field, dataclass, fields
from functools import cache
from types import MappingProxyType
from typing import Any

from slviewer.errors import UsageError

LARGEST = 1e12
"""The largest number, of any unit, that is taken."""


@dataclass(frozen=True)
class Input:
    """What the numbers of an input may be: from ``low`` to ``high``, in ``unit``. In a panel it is
    called ``label``, by default by its name, and changes by ``step``.

    As metadata: ``radius: Annotated[float | None, Input(0.001, 1e6, "mm")] = None``.
    """

    low: float = -LARGEST
    high: float = LARGEST
    unit: str = ""
    label: str = ""
    step: float | None = None

    def check(self, name: str, value: object) -> None:
        """Raise UsageError for a number, also one of several, that is outside of the range,
        infinite, or none."""
        for number in value if isinstance(value, tuple | list) else (value,):
            if isinstance(number, float | int) and not self.low <= number <= self.high:
                stated = f"{number:g}" if abs(number) < LARGEST else str(number)[:20]
                raise UsageError(f"{name} is {stated}: give a number from {self.range}")

    @property
    def range(self) -> str:
        """From what to what, in words."""
        return f"{self.low:g} to {self.high:g} {self.unit}".rstrip()

    def title(self, name: str) -> str:
        """What a panel calls the input of that name."""
        label = self.label or name.replace("_", " ").capitalize()
        return f"{label}, {self.unit}" if self.unit else label


RADIUS = Input(0.001, 1e6, "mm")
EXPOSURE = Input(1e-6, 1e6, "ms")
GAIN = Input(0, 1e4)
SEED = Input(0, (1 << 32) - 1)


def find_input(annotation: Any) -> Input | None:
    """Return what an annotation declares; None where it declares nothing."""
    metadata = getattr(annotation, "__metadata__", ())
    return next((each for each in metadata if isinstance(each, Input)), None)


@cache
def find_inputs(settings: type) -> Mapping[str, tuple[Field[Any], Input]]:
    """Return the fields of settings that declare what they may be, by name."""
    declared = ((each, find_input(each.type)) for each in fields(settings))
    return MappingProxyType({each.name: (each, own) for each, own in declared if own})


def check_inputs(settings: Any) -> None:
    """Raise UsageError for a number of settings that is outside of its range."""
    kind: type = type(settings)
    for name, (_, declared) in find_inputs(kind).items():
        declared.check(name, getattr(settings, name))


def read_hint(settings: type, name: str) -> str:
    """Return what the docstrings of settings and their bases say of a field below ``Args:``."""
    docs = "\n\n".join(inspect.cleandoc(each.__doc__ or "") for each in settings.__mro__)
    said = re.search(rf"^ {{4}}{name}: (.*?)(?=\n {{4}}\S|\n\n|\Z)", docs, re.DOTALL | re.MULTILINE)
    return " ".join(said[1].split()) if said else ""
