"""A camera's lens that the adjustment holds, what the poses say against it, and its part of the
uncertainty."""

import cv2
import numpy as np

from slviewer.calibration.known_camera import CameraCheck, KnownCamera
from slviewer.calibration.splined.normal import BlockFactor
from slviewer.calibration.splined.unknowns import LENS, Device
from slviewer.geometry.lens import Lens
from slviewer.geometry.rigid import Floats
from slviewer.geometry.splines import basis_matrix
from slviewer.geometry.vectors import finite_rows

MOST_PIXELS = 4000
EXACT_PX = 1e-3
EXACT_DISTORTION = 1e-6
"""Standard deviations of what files state without one: principal point, and distortion."""

Held = tuple[Floats, Floats, Floats]
"""What `hold_lens` took out of the normal equations."""


def lens_like_fields(device: Device, lens: Lens, pixels: Floats) -> Floats:
    """Return the unit rows (9, coefficients of both components) of a displacement field that at
    ``pixels`` (n, 2) do what changes of the lens's parameters do.

    A field without them changes neither focal length nor principal point nor Brown's distortion.
    """
    pixels = pixels[:: max(1, len(pixels) // MOST_PIXELS)]
    rays = lens.undistort(pixels)
    seen = finite_rows(rays)
    rays, pixels = rays[seen], pixels[seen]
    points, none = np.column_stack([rays, np.ones(len(rays))]), np.zeros(3)
    by_lens = cv2.projectPoints(points, none, none, lens.K, lens.D)[1][:, 6 : 6 + LENS]
    width, height = device.size
    rows, columns = device.coefficients.shape[1:]
    across = basis_matrix(pixels[:, 0], -0.5, width - 0.5, columns - 3)
    down = basis_matrix(pixels[:, 1], -0.5, height - 0.5, rows - 3)
    products = (down[:, :, None] * across[:, None, :]).reshape(len(pixels), -1)
    alike = np.hstack([by_lens[k::2].T @ products for k in range(2)])
    return np.linalg.qr(alike.T)[0].T


def hold_lens(A: Floats, b: Floats, first: int) -> Held:
    """Take the camera's lens, from unknown ``first`` on, out of the normal equations, of which A
    has the upper triangle; `release_lens` puts it back."""
    lens = slice(first, first + LENS)
    held = A[:first, lens].copy(), A[lens, first:].copy(), b[lens].copy()
    A[:first, lens] = A[lens, first:] = b[lens] = 0.0
    A[lens, lens] = np.eye(LENS)
    return held


def release_lens(
    A: Floats, b: Floats, held: Held, factor: BlockFactor, known: KnownCamera, first: int
) -> CameraCheck:
    """Put the lens back into the normal equations of the solution, with the uncertainty that it
    has; return how the poses agree with it.

    ``factor``: of the equations without it; ``first``: its first unknown. One step with a free lens
    is what the poses give.
    """
    last = first + LENS
    above, beside, own_gradient = held
    coupling = np.zeros((len(b), LENS))
    coupling[:first], coupling[last:] = above, beside[:, LENS:].T
    shared = coupling.T @ factor.solve(coupling)
    gradient = own_gradient - coupling.T @ factor.solve(b)
    own = np.triu(beside[:, :LENS])
    information = own + np.triu(own, 1).T - shared
    focal = np.diag(known.lens.K)[:2]
    relative = np.append(0.5 / focal, np.zeros(LENS - 2))
    check = CameraCheck(
        known.name,
        float(relative @ np.linalg.solve(information, gradient)),
        float(np.sqrt(relative @ np.linalg.solve(information, relative))),
        known.focal_sigma_px / float(focal[0]),
    )
    exact = np.array([EXACT_PX] * 4 + [EXACT_DISTORTION] * 5)
    scale = np.append(focal * check.uncertainty, np.zeros(LENS - 2))
    # what the others know of the lens counts, and of its own information the file's alone
    A[:first, first:last], A[first:last, first:] = above, beside
    stated = np.linalg.inv(np.diag(exact**2) + np.outer(scale, scale))
    A[first:last, first:last] = shared + stated
    return check
