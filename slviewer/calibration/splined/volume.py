"""The working volume: points at which uncertainty is evaluated, and removal of their common rigid
motion."""

from dataclasses import dataclass

import numpy as np

from slviewer.calibration.splined.fields import Device, project_point, undistort_pixel
from slviewer.calibration.splined.unknowns import Arrangement
from slviewer.errors import InputError
from slviewer.fringe.sequence import Axis
from slviewer.geometry.jit import kernel
from slviewer.geometry.rigid import Floats, Mask, motion_jacobian
from slviewer.geometry.vectors import finite_rows, rms

DEPTH_FACTORS = (0.87, 1.13)
"""Of the nearest and the farthest calibrated depth: in front of them (R1), inside (R2) and behind
(R3), as the Letter measured."""


@dataclass(frozen=True, eq=False)
class Volume:
    """Points in the view of camera and projector.

    Camera ``pixels`` (n, 2), depths ``z`` (n,) mm, ``points`` (n, 3) mm in the camera's frame, and
    ``projector`` pixels (n, 2).
    """

    pixels: Floats
    z: Floats
    points: Floats
    projector: Floats

    def select(self, which: np.ndarray) -> "Volume":
        """Return some of the points."""
        return Volume(*(values[which] for values in vars(self).values()))

    def supported(
        self, rig: Arrangement, camera_illuminated: Mask, projector_illuminated: Mask
    ) -> Mask:
        """(n,) bool: points in cells (rows, columns) bool that target poses illuminated, in both
        devices."""
        return in_illuminated_cells(
            rig.camera, self.pixels, camera_illuminated
        ) & in_illuminated_cells(rig.projector, self.projector, projector_illuminated)


def working_volume(
    rig: Arrangement,
    calibrated_mm: tuple[float, float],
    columns: int = 9,
    rows: int = 7,
    depths: int = 5,
) -> Volume:
    """Return the points of a regular grid over the camera's image and depths that the projector's
    image contains.

    ``calibrated_mm``: nearest and farthest calibrated depth, multiplied by ``DEPTH_FACTORS``;
    ``columns``, ``rows``, ``depths`` of the grid. Raises InputError for an empty range of depths,
    and where the projector's image contains no point.
    """
    near, far = (factor * mm for factor, mm in zip(DEPTH_FACTORS, calibrated_mm, strict=True))
    if not 0 < near < far:
        raise InputError(f"calibrated depths {calibrated_mm} mm leave no volume")
    width, height = rig.camera.size
    u, v = np.linspace(0, width - 1, columns), np.linspace(0, height - 1, rows)
    grid = np.stack(np.meshgrid(u, v, np.linspace(near, far, depths), indexing="ij"), axis=-1)
    volume = select_visible(rig, grid[..., :2].reshape(-1, 2), grid[..., 2].ravel())
    if not len(volume.z):
        raise InputError(
            f"camera and projector share nothing they both see at {near:.0f}-{far:.0f} mm"
        )
    return volume


def select_visible(rig: Arrangement, pixels: Floats, z: Floats) -> Volume:
    """Select the camera ``pixels`` (n, 2) at depths ``z`` (n,) mm whose points project into the
    projector's image."""
    pixels, z = np.ascontiguousarray(pixels, np.float64), np.ascontiguousarray(z, np.float64)
    points, projector = view_pixels(rig, pixels, z)
    visible = np.flatnonzero(in_image(rig.projector, projector))
    return Volume(pixels, z, points, projector).select(visible)


def view_pixels(rig: Arrangement, pixels: Floats, z: Floats) -> tuple[Floats, Floats]:
    """Return points (n, 3) mm of camera ``pixels`` (n, 2) at depths ``z`` (n,) mm, and their
    projector pixels (n, 2).

    Projector pixels may be outside its image; NaN where a distortion cannot be inverted or a point
    is behind a device.
    """
    points, projector = np.empty((len(z), 3)), np.empty((len(z), 2))
    _view_all(rig, pixels, z, points, projector)
    return points, projector


def in_image(device: Device, pixels: Floats) -> Mask:
    """(n,) bool: whether ``pixels`` (n, 2) are in a device's image; False for NaN."""
    return np.asarray(((pixels >= -0.5) & (pixels <= device.size - 0.5)).all(axis=1))


def in_illuminated_cells(device: Device, pixels: Floats, illuminated: Mask) -> Mask:
    """(n,) bool: whether ``pixels`` (n, 2) are in cells (rows, columns) bool that target poses
    illuminated.

    Pixels outside the image count to the cell at its edge; False for NaN.
    """
    shape = np.array(illuminated.shape[::-1])
    known = finite_rows(pixels)
    place = np.where(known[:, None], (pixels + 0.5) / device.size * shape, 0.0)
    cells = np.clip(place, 0, shape - 1).astype(int)
    return illuminated[cells[:, 1], cells[:, 0]] & known


def select_depth_axis(rig: Arrangement, volume: Volume) -> Axis:
    """Return the projector axis whose coordinate changes more with depth, in the median over the
    volume."""
    _, later = view_pixels(rig, volume.pixels, 1.001 * volume.z)
    across, down = np.nanmedian(np.abs(later - volume.projector), axis=0)
    return "y" if down > across else "x"


@dataclass(frozen=True, eq=False)
class BestMotion:
    """Least-squares estimator of a small rigid motion from errors of points.

    Errors (3 n,) times ``weights`` (3 n, 6) are three translations (mm), and three rotations about
    ``centre`` (3,) mm times ``arm`` mm.
    """

    weights: Floats
    centre: Floats
    arm: float

    @classmethod
    def fit(cls, points: Floats, fitted: Mask | None = None) -> "BestMotion":
        """Build the estimator for ``points`` (n, 3) mm; only those in ``fitted`` (n,) bool have
        weights.

        Raises InputError for fewer than three points.
        """
        chosen = np.ones(len(points), bool) if fitted is None else np.asarray(fitted, bool)
        if np.count_nonzero(chosen) < 3:
            raise InputError(
                f"{np.count_nonzero(chosen)} points were given: a rigid motion needs three"
            )
        centre = points[chosen].mean(axis=0)
        arm = max(rms(points[chosen] - centre), 1e-12)
        held = _motion_basis(points, centre, arm) * np.repeat(chosen, 3)[:, None]
        return cls(np.linalg.lstsq(held.T @ held, held.T, rcond=None)[0].T, centre, arm)

    def displace(self, points: Floats) -> Floats:
        """Return the displacements (3 n, 6) of points (n, 3) mm by the six motions; x, y, z of each
        point in turn."""
        return _motion_basis(points, self.centre, self.arm)


def remove_rigid_motion(
    whitened: np.ndarray, points: Floats, fitted: Mask | None = None
) -> np.ndarray:
    """Remove the common rigid motion, to which measurements of a shape are invariant, from
    ``whitened`` (m, 3 n).

    The columns are x, y, z of the first of ``points`` (n, 3) mm, then of the next; pass a Jacobian
    by the unknowns transposed. The motion is the best fit to all points, or to those that are
    ``fitted`` (n,) bool, and is removed from all. Raises InputError where fewer than three points
    are fitted.
    """
    motion = BestMotion.fit(points, fitted)
    weights, moved = (
        each.astype(whitened.dtype) for each in (motion.weights, motion.displace(points))
    )
    return whitened - (whitened @ weights) @ moved.T


def sigma_3d(whitened: np.ndarray) -> Floats:
    """Return the 3D standard deviation (n,) mm of each point from a factor (m, 3 n) of the points'
    covariance."""
    squares = np.einsum("mn,mn->n", whitened, whitened, dtype=np.float64)
    return np.sqrt(squares.reshape(-1, 3).sum(axis=1))


def _motion_basis(points: Floats, centre: Floats, arm: float) -> Floats:
    """Return the displacements (3 n, 6) of points (n, 3) by translations and by rotations about
    ``centre``."""
    J = motion_jacobian((points - centre) / arm)
    return J[:, :, [3, 4, 5, 0, 1, 2]].reshape(-1, 6)


@kernel()
def _view_all(rig, pixels, depths, points, projector):
    """Fill ``points`` (n, 3) mm and ``projector`` (n, 2) px of camera pixels (n, 2) at depths (n,)
    mm."""
    basis = np.zeros((4, 4))
    for n in range(depths.shape[0]):
        x, y = undistort_pixel(rig.camera, pixels[n, 0], pixels[n, 1], basis)
        z = depths[n]
        points[n, 0], points[n, 1], points[n, 2] = x * z, y * z, z
        projector[n, 0], projector[n, 1] = project_point(rig, x, y, z, basis)
