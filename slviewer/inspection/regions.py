"""Regions of space whose points are measured: balls and boxes."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from slviewer.errors import InputError
from slviewer.geometry.rigid import Floats
from slviewer.geometry.vectors import finite_rows, lengths
from slviewer.surface.region_of_interest import box_edges

MARGIN = 1e-5
"""Of a box around points, over its longest side: they lie inside, not on its faces."""


@dataclass(frozen=True, eq=False)
class Region:
    """The points within a ball (``size`` = (radius,)) or a box (``size`` = half sides) about
    ``centre`` (3,), mm.

    ``axes`` (3, 3): the directions of a box's sides, one a row; None: those of the coordinates.
    """

    kind: Literal["ball", "box"]
    centre: Floats
    size: Floats
    axes: Floats | None = None

    def __post_init__(self) -> None:
        centre, size = np.asarray(self.centre, np.float64), np.asarray(self.size, np.float64)
        if centre.shape != (3,) or not np.isfinite(centre).all():
            raise InputError(f"{self.centre!r} is not a place: give x, y and z in mm.")
        wanted = 1 if self.kind == "ball" else 3
        if size.shape != (wanted,) or not ((size > 0) & (size < np.inf)).all():
            raise InputError(
                f"A {self.kind} needs {wanted} sizes above 0 mm, not {size.tolist()}: draw it"
                " larger."
            )
        if self.axes is not None and self.axes.shape != (3, 3):
            raise InputError("A region's axes are three directions (x, y, z).")
        object.__setattr__(self, "centre", centre)
        object.__setattr__(self, "size", size)

    @classmethod
    def ball(cls, centre: ArrayLike, radius: float) -> "Region":
        """Return the region within ``radius`` mm of ``centre`` (3,)."""
        return cls("ball", np.asarray(centre), np.array([radius]))

    @classmethod
    def box(cls, low: ArrayLike, high: ArrayLike, axes: Floats | None = None) -> "Region":
        """Return the region between two corners (3,) mm, given along ``axes`` where there are
        some."""
        a, b = np.asarray(low, np.float64), np.asarray(high, np.float64)
        middle = (a + b) / 2
        return cls("box", middle if axes is None else middle @ axes, np.abs(b - a) / 2, axes)

    @classmethod
    def around(cls, points: np.ndarray, axes: np.ndarray) -> "Region":
        """Return the smallest box with sides along the rows of ``axes`` (3, 3) that holds points
        (n, 3) mm."""
        along = points @ axes.T
        low, high = along.min(axis=0), along.max(axis=0)
        margin = MARGIN * float((high - low).max())
        return cls.box(low - margin, high + margin, axes)

    def moved(self, T: Floats) -> "Region":
        """Return the region after a rigid motion (4, 4), in the digits of a file."""
        axes = (np.eye(3) if self.axes is None else self.axes) @ T[:3, :3].T
        is_turned = self.kind == "box" and not np.allclose(axes, np.eye(3))
        centre = (T[:3, :3] @ self.centre + T[:3, 3]).round(6)
        return Region(self.kind, centre, self.size, axes.round(9) if is_turned else None)

    @property
    def widened(self) -> "Region":
        """The region with its least half side, or its radius, added all around."""
        return Region(self.kind, self.centre, self.size + self.size.min(), self.axes)

    def within(self, points: np.ndarray) -> np.ndarray:
        """Bool like points (h, w, 3) or (n, 3) without their last axis; False for NaN."""
        finite = finite_rows(points)
        offsets = np.where(finite[..., None], points - self.centre, 0.0)
        if self.kind == "ball":
            return finite & (lengths(offsets) <= self.size[0])
        offsets = offsets if self.axes is None else offsets @ self.axes.T
        return finite & (np.abs(offsets) <= self.size).all(axis=-1)

    def edges(self) -> Floats:
        """(12, 2, 3) mm: the edges of a box."""
        return box_edges(self.centre, 2 * self.size, np.eye(3) if self.axes is None else self.axes)

    def text(self) -> str:
        """Describe the region."""
        at = ", ".join(f"{c:.1f}" for c in self.centre)
        if self.kind == "ball":
            return f"ball of radius {self.size[0]:.4g} mm at ({at})"
        return f"box of {' x '.join(f'{2 * s:.4g}' for s in self.size)} mm at ({at})"
