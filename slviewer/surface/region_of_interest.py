"""The region of interest: a box in the camera's frame, outside of which scans are ignored."""

from dataclasses import dataclass
from itertools import product

import numpy as np
import scipy
from numpy.typing import ArrayLike

from slviewer.errors import InputError
from slviewer.geometry.rigid import Floats, Mask, rigid_transform
from slviewer.geometry.vectors import finite_rows

MARGIN = 0.05
"""Of the size of a cloud: how far its automatic box extends beyond it."""
OUTLIERS_PERCENT = 0.1
"""Of the points at either end of an axis that the automatic box does not have to hold."""
_MAX_MM = 1e6
Triple = tuple[float, float, float]


@dataclass(frozen=True)
class RegionOfInterest:
    """A box about ``centre_mm`` of ``size_mm`` (whole sides), turned by ``rotation_deg`` about the
    camera's x, then y, then z axis. All are (3,), in the camera's frame; InputError unless they are
    finite, sizes above 0.
    """

    centre_mm: Triple
    size_mm: Triple
    rotation_deg: Triple = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        for name in ("centre_mm", "size_mm", "rotation_deg"):
            values = tuple(float(value) for value in getattr(self, name))
            if len(values) != 3 or not all(abs(value) < _MAX_MM for value in values):
                raise InputError(
                    f"the region's {name} is {values}", f"give three numbers below {_MAX_MM:g}"
                )
            object.__setattr__(self, name, values)
        if min(self.size_mm) <= 0:
            raise InputError(
                f"the region's sides are {_times(self.size_mm)} mm", "each must be above 0"
            )

    @classmethod
    def between(cls, low: ArrayLike, high: ArrayLike) -> "RegionOfInterest":
        """Return the box with sides along the axes between two corners (3,) mm."""
        a, b = np.asarray(low, np.float64), np.asarray(high, np.float64)
        return cls(_triple((a + b) / 2), _triple(b - a))

    @classmethod
    def around(cls, points: np.ndarray) -> "RegionOfInterest":
        """Return the box, along the axes, around all points (..., 3) mm but outliers; InputError
        without points."""
        flat = points[finite_rows(points)].astype(np.float64)
        if not len(flat):
            raise InputError(
                "there are no points to put a region around", "reconstruct a scan first"
            )
        low, high = np.percentile(flat, [OUTLIERS_PERCENT, 100 - OUTLIERS_PERCENT], axis=0)
        margin = MARGIN * max(float(np.linalg.norm(high - low)), 1e-3)
        return cls.between(low - margin, high + margin)

    @classmethod
    def placed(cls, T_camera_box: np.ndarray, size_mm: Triple) -> "RegionOfInterest":
        """Return the box of a size at T (4, 4), from the box's frame to the camera's."""
        angles = scipy.spatial.transform.Rotation.from_matrix(T_camera_box[:3, :3]).as_euler(
            "xyz", degrees=True
        )
        return cls(_triple(T_camera_box[:3, 3]), size_mm, _triple(angles))

    @property
    def T_camera_box(self) -> Floats:
        """(4, 4): from the frame of the box, in its middle along its sides, to the camera's."""
        turn = scipy.spatial.transform.Rotation.from_euler("xyz", self.rotation_deg, degrees=True)
        return rigid_transform(turn.as_matrix(), np.array(self.centre_mm))

    def contains(self, points: np.ndarray) -> Mask:
        """Bool like points (..., 3) mm without their last axis: whether they lie in the box; False
        for NaN."""
        T = self.T_camera_box
        inside = np.abs((points - T[:3, 3]) @ T[:3, :3]) <= np.array(self.size_mm) / 2
        return np.asarray(inside.all(axis=-1))

    def edges(self) -> Floats:
        """(12, 2, 3) mm: the edges of the box, in the camera's frame."""
        T = self.T_camera_box
        return box_edges(T[:3, 3], np.array(self.size_mm), T[:3, :3].T)

    def text(self) -> str:
        """Describe the box: its size, centre, and where it is turned its angles."""
        centre, turned = (
            ", ".join(f"{value:.1f}" for value in values)
            for values in (self.centre_mm, self.rotation_deg)
        )
        turned = f", turned by {turned} degrees about x, y, z" if any(self.rotation_deg) else ""
        return f"{_times(self.size_mm)} mm about ({centre}) mm{turned}"


def crop_mask(name: str, points: np.ndarray, region: RegionOfInterest) -> Mask:
    """Bool (...): the points (..., 3) mm of a scan in the region. InputError, with where they are,
    if none is."""
    inside = region.contains(points)
    flat = points[finite_rows(points)]
    if len(flat) and not inside.any():
        spans = (f"{axis} {low:.0f} to {high:.0f}" for axis, low, high in zip(
            "xyz", flat.min(axis=0), flat.max(axis=0), strict=True))  # fmt: skip
        raise InputError(
            f"{name}: none of its {len(flat)} points lies in the region of interest of"
            f" {region.text()}; they span {', '.join(spans)} mm",
            "move or enlarge the region, or switch it off (--roi off)",
        )
    return inside


def _triple(values: np.ndarray) -> Triple:
    """Return an array (3,) as a tuple of floats."""
    x, y, z = values.tolist()
    return x, y, z


def _times(values: Triple) -> str:
    """Format three lengths."""
    return " x ".join(f"{value:.1f}" for value in values)


def box_edges(centre: np.ndarray, size: np.ndarray, axes: np.ndarray) -> np.ndarray:
    """(12, 2, 3) mm: the edges of a box of sides ``size`` (3,) along the rows of ``axes`` (3,
    3)."""
    corners = np.array(list(product((-0.5, 0.5), repeat=3)))
    apart = np.abs(corners[:, None] - corners).sum(axis=-1)
    pairs = np.argwhere(np.tril(apart == 1))
    return (corners[pairs] * size) @ axes + centre
