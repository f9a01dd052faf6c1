"""Dataclasses to and from plain values: the one codec for what is written as JSON or TOML.

`to_plain(record)` is nested dicts, lists, tuples, numbers, strings and None, keyed by the names of
the fields; arrays become nested lists, paths strings. `from_plain(data, Kind)` is the inverse: it
checks every field's type, ignores keys that the dataclass does not have, gives absent fields their
defaults, and leaves checks of values to `__post_init__`::

    @dataclass(frozen=True, eq=False)
    class CutPlane:
        origin: NDArray[np.float64]
        up: NDArray[np.float64] | None = None

    data = to_plain(plane)              # {"origin": [0.0, 0.0, 580.0], "up": None}
    plane = from_plain(data, CutPlane)  # arrays of the annotated dtype, else InputError

Records nest: a field may be another dataclass, a tuple, a mapping or an optional of these. Name
fields after their keys on disk, and no method is needed. Where a published record holds computed
figures too, add them to the plain fields: `to_plain(self) | {"decision": self.decision}`.
`session.atomic.to_json` and the commands' `--json` take dataclasses as they are.
Properties are not written.
"""

import os
from collections.abc import Mapping
from typing import Any, TypeVar, get_args

import msgspec
import numpy as np

from slviewer.errors import InputError

T = TypeVar("T")


def to_plain(value: Any) -> Any:
    """Convert a dataclass, or values that contain some, to plain values for JSON. Raises TypeError
    where impossible."""
    return msgspec.to_builtins(value, enc_hook=plain_leaf)


def from_plain(data: Any, kind: type[T]) -> T:
    """Rebuild the value of type `kind` from the `data` of `to_plain`. Raises InputError that names
    the field."""
    try:
        return msgspec.convert(data, kind, dec_hook=_array)
    except msgspec.ValidationError as error:
        reason, _, place = str(error).replace("`", "").partition(" - at $")
        raise InputError(
            f"{place.strip('.') or 'its content'}: {reason[:1].lower()}{reason[1:]}"
        ) from error


def plain_leaf(value: Any) -> Any:
    """Convert a NumPy value, path or mapping one step towards plain values; the hook of every JSON
    writer."""
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    if isinstance(value, Mapping):
        return dict(value)
    raise TypeError(f"{type(value).__name__} has no plain form")


def _array(kind: Any, value: Any) -> Any:
    """Convert to an array of the dtype that a field is annotated with, of the values' own where it
    names none."""
    if kind is not np.ndarray and getattr(kind, "__origin__", None) is not np.ndarray:
        raise NotImplementedError(f"{kind} is not a type of records")
    dtype = next(iter(get_args(get_args(kind)[1])), None) if get_args(kind) else None
    array = np.asarray(value, None if dtype is Any else dtype)
    if array.dtype.kind not in "biuf":
        raise ValueError("Expected numbers")
    return array
