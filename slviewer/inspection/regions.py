"""Which points of a surface are meant: a mask over an organised cloud, a set of points, a ball or a box in space."""

import base64
import zlib
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from slviewer.errors import InputError


@dataclass(frozen=True, eq=False)
class Region:
    """``chosen``: one bool a point of the surface it was made for, (h, w) or (n,), if it is a set; or the points within
    a ball (``centre`` and ``size`` = (radius,)) or a box with sides along the axes (``size`` = half sides), mm."""

    kind: Literal["set", "ball", "box"]
    chosen: np.ndarray | None = None
    centre: np.ndarray | None = None
    size: np.ndarray | None = None

    @classmethod
    def of_mask(cls, mask: np.ndarray) -> "Region":
        """The True ones of (h, w) or (n,) bool."""
        return cls("set", chosen=np.asarray(mask, bool))

    @classmethod
    def of_indices(cls, indices: np.ndarray, count: int) -> "Region":
        """Some of ``count`` points by their indices. Raises InputError for one that is not there."""
        indices = np.asarray(indices)
        if indices.size and not 0 <= indices.min() <= indices.max() < count:
            raise InputError(f"Point {int(indices.max())} was selected of a surface of {count}: select it anew.")
        mask = np.zeros(count, bool)
        mask[indices] = True
        return cls("set", chosen=mask)

    @classmethod
    def ball(cls, centre: ArrayLike, radius: float) -> "Region":
        """What lies within ``radius`` mm of ``centre`` (3,)."""
        return cls("ball", centre=_vector(centre), size=_positive([radius]))

    @classmethod
    def box(cls, low: ArrayLike, high: ArrayLike) -> "Region":
        """What lies between two corners (3,) mm."""
        a, b = _vector(low), _vector(high)
        return cls("box", centre=(a + b) / 2, size=_positive(np.abs(b - a) / 2))

    def within(self, points: np.ndarray) -> np.ndarray:
        """Bool like points (h, w, 3) or (n, 3) without their last axis; False for NaN. Raises InputError where it is a
        set of other points."""
        finite: np.ndarray = np.isfinite(points).all(axis=-1)
        if self.kind == "set":
            assert self.chosen is not None
            if self.chosen.shape != finite.shape:
                raise InputError(
                    f"The region was selected on a surface of {_sized(self.chosen)} and this one has {_sized(finite)}: "
                    "select it anew."
                )
            return finite & self.chosen
        assert self.centre is not None and self.size is not None
        offsets = np.where(finite[..., None], points, np.inf) - self.centre
        if self.kind == "ball":
            return np.asarray(np.linalg.norm(offsets, axis=-1) <= self.size[0])
        return np.asarray((np.abs(offsets) <= self.size).all(axis=-1))

    def text(self) -> str:
        """In words."""
        if self.kind == "set":
            assert self.chosen is not None
            return f"{int(np.count_nonzero(self.chosen))} selected points"
        assert self.centre is not None and self.size is not None
        at = ", ".join(f"{c:.1f}" for c in self.centre)
        if self.kind == "ball":
            return f"ball of radius {self.size[0]:.4g} mm at ({at})"
        return f"box of {' x '.join(f'{2 * s:.4g}' for s in self.size)} mm at ({at})"

    def to_json(self) -> dict[str, Any]:
        """The record of a measurement; the bits of a set are packed row by row, deflated, in base64."""
        if self.chosen is None:
            return {"kind": self.kind, "centre": self.centre, "size": self.size}
        bits = base64.b64encode(zlib.compress(np.packbits(self.chosen).tobytes(), 9)).decode()
        return {"kind": "set", "shape": self.chosen.shape, "bits": bits}


def _vector(values: object) -> np.ndarray:
    vector = np.asarray(values, np.float64)
    if vector.shape != (3,) or not np.isfinite(vector).all():
        raise InputError(f"{values!r} is no place: give x, y and z in mm.")
    return vector


def _positive(values: object) -> np.ndarray:
    size = np.asarray(values, np.float64)
    if not (np.isfinite(size).all() and (size > 0).all()):
        raise InputError("A region needs a size above 0 mm in every direction: draw it larger.")
    return size


def _sized(mask: np.ndarray) -> str:
    return " x ".join(str(n) for n in mask.shape[::-1]) + (" pixels" if mask.ndim == 2 else " points")
