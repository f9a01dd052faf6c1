"""Numbers as text, by whole arrays: a million points in a second instead of half a minute."""

from collections.abc import Sequence

import numpy as np

from slviewer.errors import InputError

Field = bytes | tuple[np.ndarray, int]
"""What stands in every line: the same characters, or numbers (n,) with so many decimals."""
_LARGEST = 1e12
_GAP = 0  # a character that is dropped in the end


def lines(fields: Sequence[Field]) -> bytes:
    """A line of ASCII text for each record; ``fields`` from left to right, with at least one of numbers."""
    count = next(len(field[0]) for field in fields if isinstance(field, tuple))
    columns = [
        np.broadcast_to(np.frombuffer(field, np.uint8), (count, len(field)))
        if isinstance(field, bytes)
        else _characters(*field)
        for field in (*fields, b"\n")
    ]
    text = np.concatenate(columns, axis=1).ravel()
    return text[text != _GAP].tobytes()


def _characters(values: np.ndarray, decimals: int) -> np.ndarray:
    """(n, width) uint8: the digits of each number, to the right."""
    size = np.abs(values.astype(np.float64 if values.dtype.kind == "f" else np.int64))
    most = size.max(initial=0)
    if not most < _LARGEST:
        raise InputError(f"a value of {most:g} cannot be written as text: is it a measurement?")
    left = np.rint(size * 10**decimals).astype(np.int64)
    negative = (values < 0) & (left > 0)
    whole = len(str(int(most) + 1))
    width = 1 + whole + (decimals + 1 if decimals else 0)
    out = np.full((len(values), width), _GAP, np.uint8)
    column = width - 1
    for _ in range(decimals):
        left, digit = np.divmod(left, 10)
        out[:, column] = digit + ord("0")
        column -= 1
    if decimals:
        out[:, column] = ord(".")
        column -= 1
    first = True
    while column > 0:
        shown = (left > 0) | first
        left, digit = np.divmod(left, 10)
        out[:, column] = np.where(shown, digit + ord("0"), _GAP)
        column, first = column - 1, False
    out[negative, 0] = ord("-")  # what lies between it and the digits is dropped
    return out
