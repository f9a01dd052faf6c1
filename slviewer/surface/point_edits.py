"""Edits of a scan's points that are stored as operations: nothing is removed from the scan itself.

An operation names pixels of the camera, or a plane in its frame, not points: it applies in the same
way to the cloud that another calibration makes of the same frames.
"""

import zlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from slviewer.errors import InputError
from slviewer.geometry.vectors import finite_rows
from slviewer.surface.selection import Mask, SupportPlane

_MAX_PIXELS = 1 << 32


@dataclass(frozen=True, eq=False)
class Edit:
    """Points that are deleted: those at ``pixels`` (h, w) bool, or those on ``plane`` and below,
    one of both.

    ``what``: how they were selected, in words; ``points``: how many it deleted when it was made;
    ``made``: when, as text that sorts by time, the same for edits of several scans that were made
    together; empty where unknown.
    """

    what: str
    points: int
    pixels: Mask | None = None
    plane: SupportPlane | None = None
    made: str = ""

    def __post_init__(self) -> None:
        if (self.pixels is None) == (self.plane is None):
            raise InputError("an edit deletes pixels, or what is below a plane: give one of them")

    @property
    def kind(self) -> Literal["pixels", "plane"]:
        """What the edit names its points by."""
        return "plane" if self.pixels is None else "pixels"

    def select(self, points: np.ndarray) -> Mask:
        """Mask (h, w) of the points (h, w, 3) mm that the edit deletes. InputError for pixels of
        another size."""
        if self.plane is not None:
            return self.plane.select_below(points)
        assert self.pixels is not None
        if self.pixels.shape != points.shape[:2]:
            (h, w), (rows, columns) = self.pixels.shape, points.shape[:2]
            raise InputError(
                f"the edit {self.what!r} is of {w}x{h} pixels, the scan has {columns}x{rows}: undo"
                " the edit"
            )
        return self.pixels

    def text(self) -> str:
        """Describe the edit in a line."""
        return describe_edit(self.what, self.points)


def describe_edit(what: str, points: int) -> str:
    """Describe an edit in a line: how its points were selected, and how many it deleted."""
    return f"{what}: {points:,} points deleted"


@dataclass(frozen=True, eq=False)
class EditHistory:
    """The edits of a scan in the order in which they were made, of which the first ``applied`` are
    in effect; those after them were undone. A new edit replaces those that were undone."""

    edits: tuple[Edit, ...] = ()
    applied: int = 0

    def __post_init__(self) -> None:
        if not 0 <= self.applied <= len(self.edits):
            raise InputError(
                f"{self.applied} of {len(self.edits)} edits are stated to be in effect"
            )

    @property
    def active(self) -> tuple[Edit, ...]:
        """The edits in effect."""
        return self.edits[: self.applied]

    @property
    def undone(self) -> tuple[Edit, ...]:
        """The edits that `redo` brings back, the next one first."""
        return self.edits[self.applied :]

    def add(self, edit: Edit) -> "EditHistory":
        """Return the history with one more edit; what was undone is forgotten."""
        return EditHistory((*self.active, edit), self.applied + 1)

    def undo(self, count: int = 1) -> "EditHistory":
        """Return the history without the effect of its last edits. InputError where there are
        fewer."""
        if not 1 <= count <= self.applied:
            raise InputError(
                f"{self.applied} edits are in effect: {count} of them cannot be undone"
            )
        return replace(self, applied=self.applied - count)

    def redo(self, count: int = 1) -> "EditHistory":
        """Return the history with undone edits in effect again. InputError where there are
        fewer."""
        if not 1 <= count <= len(self.undone):
            raise InputError(
                f"{len(self.undone)} edits are undone: {count} of them cannot be redone"
            )
        return replace(self, applied=self.applied + count)

    def keep_mask(self, points: np.ndarray) -> Mask:
        """Mask (h, w) of the measured points (h, w, 3) mm that no edit in effect deletes."""
        kept = finite_rows(points)
        for edit in self.active:
            kept &= ~edit.select(points)
        return kept


def make_edit(
    points: np.ndarray, selected: Mask, what: str, plane: SupportPlane | None = None, made: str = ""
) -> Edit:
    """Return the edit that deletes the ``selected`` (h, w) ones of points (h, w, 3) mm: with every
    later calibration, also those at selected pixels that are NaN now.

    ``plane``: what the selection is everything below of, where it is; the edit is then stored as
    this plane. InputError where nothing is selected.
    """
    count = int(np.count_nonzero(selected & finite_rows(points)))
    if not count:
        raise InputError("no point is selected: select some first")
    return Edit(what, count, selected if plane is None else None, plane, made)


def pack_mask(mask: Mask) -> NDArray[np.uint8]:
    """Compress a mask (h, w) to bytes (n,), which `unpack_mask` reads."""
    return np.frombuffer(zlib.compress(np.packbits(mask).tobytes(), 6), np.uint8)


def unpack_mask(packed: np.ndarray, size: Sequence[int]) -> Mask:
    """Return the mask (h, w) of bytes (n,) from `pack_mask`; ``size`` is (w, h). InputError where
    they do not fit."""
    w, h = size
    if not 0 < w * h <= _MAX_PIXELS:
        raise InputError(f"a mask of {w}x{h} pixels is stated")
    needed = (w * h + 7) // 8
    reader = zlib.decompressobj()
    try:
        body = reader.decompress(np.asarray(packed, np.uint8).tobytes(), needed + 1)
    except zlib.error as error:
        raise InputError(f"the mask of an edit cannot be read ({error})") from error
    if len(body) != needed:
        raise InputError(
            f"the mask of an edit holds {len(body)} bytes, {needed} are needed for {w}x{h} pixels"
        )
    return np.unpackbits(np.frombuffer(body, np.uint8), count=w * h).astype(bool).reshape(h, w)
