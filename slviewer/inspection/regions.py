"""Regions of space whose points are measured: balls and boxes."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from slviewer.errors import InputError
from slviewer.geometry.vectors import finite_rows, lengths
from slviewer.surface.region_of_interest import box_edges

MARGIN_MM = 1e-3
"""Of a box around points: they lie inside, not on its faces."""


@dataclass(frozen=True, eq=False)
class Region:
    """The points within a ball (``size`` = (radius,)) or a box (``size`` = half sides) about
    ``centre`` (3,), mm.

    ``axes`` (3, 3): the directions of a box's sides, one a row; None: those of the coordinates.
    """

    kind: Literal["ball", "box"]
    centre: np.ndarray
    size: np.ndarray
    axes: np.ndarray | None = None

    @classmethod
    def ball(cls, centre: ArrayLike, radius: float) -> "Region":
        """Return the region within ``radius`` mm of ``centre`` (3,)."""
        return cls("ball", _check_place(centre), _check_size([radius]))

    @classmethod
    def box(cls, low: ArrayLike, high: ArrayLike, axes: np.ndarray | None = None) -> "Region":
        """Return the region between two corners (3,) mm, given along ``axes`` where there are
        some."""
        a, b = _check_place(low), _check_place(high)
        middle = (a + b) / 2
        return cls(
            "box", middle if axes is None else middle @ axes, _check_size(np.abs(b - a) / 2), axes
        )

    @classmethod
    def around(cls, points: np.ndarray, axes: np.ndarray) -> "Region":
        """Return the smallest box with sides along the rows of ``axes`` (3, 3) that holds points
        (n, 3) mm."""
        along = points @ axes.T
        low, high = along.min(axis=0), along.max(axis=0)
        return cls(
            "box",
            _check_place((low + high) / 2 @ axes),
            _check_size((high - low) / 2 + MARGIN_MM),
            axes,
        )

    def within(self, points: np.ndarray) -> np.ndarray:
        """Bool like points (h, w, 3) or (n, 3) without their last axis; False for NaN."""
        finite = finite_rows(points)
        offsets = np.where(finite[..., None], points - self.centre, 0.0)
        if self.kind == "ball":
            return finite & (lengths(offsets) <= self.size[0])
        offsets = offsets if self.axes is None else offsets @ self.axes.T
        return finite & (np.abs(offsets) <= self.size).all(axis=-1)

    def edges(self) -> np.ndarray:
        """(12, 2, 3) mm: the edges of a box."""
        return box_edges(self.centre, 2 * self.size, np.eye(3) if self.axes is None else self.axes)

    def text(self) -> str:
        """Describe the region."""
        at = ", ".join(f"{c:.1f}" for c in self.centre)
        if self.kind == "ball":
            return f"ball of radius {self.size[0]:.4g} mm at ({at})"
        return f"box of {' x '.join(f'{2 * s:.4g}' for s in self.size)} mm at ({at})"


def _check_place(values: object) -> np.ndarray:
    """Return a place (3,) float64 mm; InputError for another shape or values that are not
    finite."""
    vector = np.asarray(values, np.float64)
    if vector.shape != (3,) or not np.isfinite(vector).all():
        raise InputError(f"{values!r} is not a place: give x, y and z in mm.")
    return vector


def _check_size(values: object) -> np.ndarray:
    """Return a size in mm as float64; InputError unless all its values are finite and above 0."""
    size = np.asarray(values, np.float64)
    if not (np.isfinite(size).all() and (size > 0).all()):
        raise InputError("A region needs a size above 0 mm in every direction: draw it larger.")
    return size
