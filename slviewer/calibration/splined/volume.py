"""The working volume: points at which uncertainty is evaluated, without the rigid motion that no measurement needs."""

from dataclasses import dataclass

import numpy as np

from slviewer.calibration.splined.fields import Device, distort_to_pixel, undistort_pixel
from slviewer.calibration.splined.unknowns import Arrangement
from slviewer.errors import InputError
from slviewer.fringe.sequence import Axis
from slviewer.geometry.jit import kernel

DEPTH_FACTORS = (0.87, 1.13)
"""Of the nearest and the farthest calibrated depth: in front of them (R1), inside (R2) and behind (R3), as the Letter
measured."""


@dataclass(frozen=True, eq=False)
class Volume:
    """Places that camera and projector both see: camera ``pixels`` (n, 2), depths ``z`` (n,) mm, ``points`` (n, 3) mm
    in the camera's frame, and where the ``projector`` (n, 2) px sees them."""

    pixels: np.ndarray
    z: np.ndarray
    points: np.ndarray
    projector: np.ndarray

    def supported(
        self, rig: Arrangement, camera_illuminated: np.ndarray, projector_illuminated: np.ndarray
    ) -> np.ndarray:
        """(n,) bool: those seen through cells (rows, columns) bool that target poses illuminated, in both devices."""
        return is_supported(rig.camera, self.pixels, camera_illuminated) & is_supported(
            rig.projector, self.projector, projector_illuminated
        )


def working_volume(
    rig: Arrangement,
    calibrated_mm: tuple[float, float],
    reach: tuple[float, float] = DEPTH_FACTORS,
    columns: int = 9,
    rows: int = 7,
    depths: int = 5,
) -> Volume:
    """What the projector sees of a regular grid: the whole image, its corners included, at depths evenly from
    ``reach[0]`` of the nearest calibrated depth to ``reach[1]`` of the farthest.

    Raises InputError where there is nothing: calibrated depths that are none, or no grid point that is seen.
    """
    near, far = reach[0] * calibrated_mm[0], reach[1] * calibrated_mm[1]
    if not 0 < near < far:
        raise InputError(f"calibrated depths {calibrated_mm} mm and a reach of {reach} leave no volume")
    width, height = rig.camera.size
    u, v, z = np.meshgrid(
        np.linspace(0, width - 1, columns),
        np.linspace(0, height - 1, rows),
        np.linspace(near, far, depths),
        indexing="ij",
    )
    found = select_visible(rig, np.column_stack([u.ravel(), v.ravel()]), z.ravel())
    if not len(found.z):
        raise InputError(f"camera and projector share nothing they both see at {near:.0f}-{far:.0f} mm")
    return found


def select_visible(rig: Arrangement, pixels: np.ndarray, z: np.ndarray) -> Volume:
    """Those of camera ``pixels`` (n, 2) at depths ``z`` (n,) mm that the projector's image holds."""
    pixels, z = np.ascontiguousarray(pixels, np.float64), np.ascontiguousarray(z, np.float64)
    points, projector = view_pixels(rig, pixels, z)
    seen = ((projector >= -0.5) & (projector <= rig.projector.size - 0.5)).all(axis=1)  # False for NaN
    return Volume(pixels[seen], z[seen], points[seen], projector[seen])


def view_pixels(rig: Arrangement, pixels: np.ndarray, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(n, 3) mm: what camera ``pixels`` (n, 2) float64 see at depths ``z`` (n,); (n, 2) px: where the projector has it,
    inside its image or not. NaN where a lens has no answer."""
    points, projector = np.empty((len(z), 3)), np.empty((len(z), 2))
    _view_all(rig, pixels, z, points, projector)
    return points, projector


def is_supported(device: Device, pixels: np.ndarray, illuminated: np.ndarray) -> np.ndarray:
    """(n,) bool: whether the cells of ``pixels`` (n, 2) are among those (rows, columns) bool that target poses
    illuminated; beyond the image, those at its edge. False for NaN."""
    shape = np.array([illuminated.shape[1], illuminated.shape[0]])
    known = np.isfinite(pixels).all(axis=1)
    place = np.where(known[:, None], (pixels + 0.5) / device.size * shape, 0.0)
    cells = np.clip(place, 0, shape - 1).astype(int)
    return np.asarray(illuminated[cells[:, 1], cells[:, 0]] & known)


def depth_axis(rig: Arrangement, volume: Volume) -> Axis:
    """The projector coordinate that depth moves more, in the median over the volume."""
    _, later = view_pixels(rig, volume.pixels, 1.001 * volume.z)
    across, down = np.nanmedian(np.abs(later - volume.projector), axis=0)
    return "y" if down > across else "x"


@dataclass(frozen=True, eq=False)
class BestMotion:
    """The small rigid motion that fits errors of some points best: errors (3 n,) times ``weights`` (3 n, 6) are three
    shifts, and three turns about ``centre`` times ``arm`` mm."""

    weights: np.ndarray
    centre: np.ndarray
    arm: float

    @classmethod
    def fit(cls, points: np.ndarray, fitted: np.ndarray | None = None) -> "BestMotion":
        """For errors of ``points`` (n, 3), or of those that are ``fitted`` (n,) bool; the others weigh nothing.

        Raises InputError where these are fewer than three.
        """
        chosen = np.ones(len(points), bool) if fitted is None else np.asarray(fitted, bool)
        if np.count_nonzero(chosen) < 3:
            raise InputError(f"{np.count_nonzero(chosen)} points were given: a rigid motion needs three")
        centre = points[chosen].mean(axis=0)
        arm = max(float(np.sqrt(np.mean((points[chosen] - centre) ** 2))), 1e-12)
        held = _motion_basis(points, centre, arm) * np.repeat(chosen, 3)[:, None]
        return cls(np.linalg.lstsq(held.T @ held, held.T, rcond=None)[0].T, centre, arm)

    def displace(self, points: np.ndarray) -> np.ndarray:
        """(3 n, 6): how points (n, 3) move; x, y, z of the first, then of the next."""
        return _motion_basis(points, self.centre, self.arm)


def motion_free(whitened: np.ndarray, points: np.ndarray, fitted: np.ndarray | None = None) -> np.ndarray:
    """(m, 3 n): ``whitened`` (m, 3 n; x, y, z of the first of ``points`` (n, 3), then of the next) without the rigid
    motion of the points, to which measurements of a shape are invariant.

    The motion is that which fits the points best, or those of them that are ``fitted`` (n,) bool; it is taken from all.
    A Jacobian by the unknowns is given transposed. Raises InputError where fewer than three points are fitted.
    """
    motion = BestMotion.fit(points, fitted)
    weights, moved = motion.weights.astype(whitened.dtype), motion.displace(points).astype(whitened.dtype)
    return np.asarray(whitened - (whitened @ weights) @ moved.T)


def sigma_3d(whitened: np.ndarray) -> np.ndarray:
    """(n,) mm: the standard deviation of each point, in all directions together, from its whitened factor (m, 3 n)."""
    squares = np.einsum("mn,mn->n", whitened, whitened, dtype=np.float64)
    return np.asarray(np.sqrt(squares.reshape(-1, 3).sum(axis=1)))


def _motion_basis(points: np.ndarray, centre: np.ndarray, arm: float) -> np.ndarray:
    x, y, z = ((points - centre) / arm).T
    none, one = np.zeros(len(points)), np.ones(len(points))
    along = np.array(
        [
            [one, none, none, none, z, -y],
            [none, one, none, -z, none, x],
            [none, none, one, y, -x, none],
        ]
    )
    return np.asarray(along.transpose(2, 0, 1).reshape(-1, 6))


@kernel()
def _view_all(rig, pixels, depths, points, projector):
    basis = np.zeros((4, 4))
    for n in range(depths.shape[0]):
        x, y = undistort_pixel(rig.camera, pixels[n, 0], pixels[n, 1], basis)
        z = depths[n]
        points[n, 0], points[n, 1], points[n, 2] = x * z, y * z, z
        X0 = z * (rig.R[0, 0] * x + rig.R[0, 1] * y + rig.R[0, 2]) + rig.t[0]
        X1 = z * (rig.R[1, 0] * x + rig.R[1, 1] * y + rig.R[1, 2]) + rig.t[1]
        X2 = z * (rig.R[2, 0] * x + rig.R[2, 1] * y + rig.R[2, 2]) + rig.t[2]
        u = v = np.nan
        if X2 > 0.0:  # False for NaN
            u, v = distort_to_pixel(rig.projector, X0 / X2, X1 / X2, basis)
        projector[n, 0], projector[n, 1] = u, v
