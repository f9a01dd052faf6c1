"""What the adjustment holds: a camera's lens, with what the poses say against it, and its part of
the uncertainty; or all but the projector, as two cameras were calibrated."""

import cv2
import numpy as np

from slviewer.calibration.known_camera import CameraCheck, KnownCamera
from slviewer.calibration.splined.normal import BlockFactor
from slviewer.calibration.splined.unknowns import LENS, Device, UnknownLayout
from slviewer.geometry.lens import Lens
from slviewer.geometry.rigid import Floats
from slviewer.geometry.splines import image_basis
from slviewer.geometry.vectors import finite_rows, thin_out

MOST_PIXELS = 4000
EXACT = np.array([1e-3] * 4 + [1e-6] * 5)
"""(9,): standard deviations of the lens's parameters, which files do not state, beside that of the
focal length."""


class HeldLens:
    """A known lens in the normal equations, whose unknowns from ``first`` on it holds where it is
    fixed; nothing where ``known`` is None.

    ``gauge``: what the camera's field must lack then (see `lens_like_fields`).
    """

    def __init__(
        self, known: KnownCamera | None, device: Device, pixels: Floats, first: int
    ) -> None:
        self.known, self.lens = known, slice(first, first + LENS)
        self.gauge = None if known is None else lens_like_fields(device, known.lens, pixels)

    def take(self, A: Floats, b: Floats) -> None:
        """Take the lens out of the equations, of which A has the upper triangle."""
        if self.known is None:
            return
        lens, first = self.lens, self.lens.start
        self.taken = A[:first, lens].copy(), A[lens, first:].copy(), b[lens].copy()
        A[:first, lens] = A[lens, first:] = b[lens] = 0.0
        A[lens, lens] = np.eye(LENS)

    def release(self, A: Floats, b: Floats, factor: BlockFactor) -> CameraCheck | None:
        """Put the lens back into the equations of the solution, with the uncertainty that it has;
        return how the poses agree with it.

        ``factor``: of the equations without it. One step with a free lens is what the poses give.
        """
        if self.known is None:
            return None
        known, lens, first = self.known, self.lens, self.lens.start
        above, beside, gradient = self.taken
        coupling = np.zeros((len(b), LENS))
        coupling[:first], coupling[lens.stop :] = above, beside[:, LENS:].T
        shared = coupling.T @ factor.solve(coupling)
        own = np.triu(beside[:, :LENS])
        information = own + np.triu(own, 1).T - shared
        focal = np.diag(known.lens.K)[:2]
        relative = np.append(0.5 / focal, np.zeros(LENS - 2))
        step = np.linalg.solve(information, gradient - coupling.T @ factor.solve(b))
        check = CameraCheck(
            known.name,
            float(relative @ step),
            float(np.sqrt(relative @ np.linalg.solve(information, relative))),
            known.focal_sigma_px / float(focal[0]),
        )
        scale = np.append(focal * check.uncertainty, np.zeros(LENS - 2))
        stated = np.linalg.inv(np.diag(EXACT**2) + np.outer(scale, scale))
        # what the others know of the lens counts, and of its own information the file's alone
        A[:first, lens], A[lens, first:] = above, beside
        A[lens, lens] = shared + stated
        return check


class HeldCamera:
    """The camera, the board and its poses in the normal equations, all held: the projector is
    solved in their frame of reference, and may bend nothing of it."""

    gauge = None

    def __init__(self, layout: UnknownLayout) -> None:
        self.held = np.r_[: layout.rig + LENS, layout.camera_field : layout.projector_field]

    def take(self, A: Floats, b: Floats) -> None:
        """Take all but the projector out of the equations, of which A has the upper triangle."""
        self.taken = A.copy()
        A[self.held] = A[:, self.held] = b[self.held] = 0.0
        A[self.held, self.held] = 1.0

    def release(self, A: Floats, b: Floats, factor: BlockFactor) -> None:
        """Put back what the camera and the projector say of everything: their uncertainty."""
        A[:] = self.taken


def lens_like_fields(device: Device, lens: Lens, pixels: Floats) -> Floats:
    """Return the unit rows (9, coefficients of both components) of a displacement field that at
    ``pixels`` (n, 2) do what changes of the lens's parameters do.

    A field without them changes neither focal length nor principal point nor Brown's distortion.
    """
    pixels = thin_out(pixels, MOST_PIXELS)
    rays = lens.undistort(pixels)
    seen = finite_rows(rays)
    rays, pixels = rays[seen], pixels[seen]
    points, none = np.column_stack([rays, np.ones(len(rays))]), np.zeros(3)
    by_lens = cv2.projectPoints(points, none, none, lens.K, lens.D)[1][:, 6 : 6 + LENS]
    rows, columns = device.coefficients.shape[1:]
    products = image_basis(pixels, device.size, (columns - 3, rows - 3))
    alike = np.hstack([by_lens[k::2].T @ products for k in range(2)])
    return np.linalg.qr(alike.T)[0].T
