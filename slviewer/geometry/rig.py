"""The stereo rig: one camera, one projector, and the transform between them."""

from dataclasses import dataclass

import numpy as np

from slviewer.errors import InputError
from slviewer.geometry.jit import read_only
from slviewer.geometry.lens import Lens

LARGEST_BASELINE_MM = 1e6


@dataclass(frozen=True, eq=False)
class StereoRig:
    """Camera, projector, and the transform between them: X_projector = R X_camera + t (the Letter's
    R(theta_s), t_s).

    ``R``: (3, 3) rotation. ``t``: (3,) mm; OpenCV's (3, 1) is accepted. Kept as read-only float64
    copies.
    """

    camera: Lens
    projector: Lens
    R: np.ndarray
    t: np.ndarray

    def __post_init__(self) -> None:
        R = np.array(self.R, dtype=np.float64)
        t = np.array(self.t, dtype=np.float64).ravel()
        if (
            R.shape != (3, 3)
            or not np.allclose(R @ R.T, np.eye(3), atol=1e-5)
            or np.linalg.det(R) < 0
        ):
            raise InputError(
                f"The rotation from camera to projector is no 3x3 rotation matrix, {R.tolist()}",
                "check its key.",
            )
        if t.shape != (3,) or not np.isfinite(t).all():
            raise InputError(
                "The translation from camera to projector must be 3 numbers in mm, not"
                f" {t.tolist()}."
            )
        if not np.linalg.norm(t) <= LARGEST_BASELINE_MM:
            raise InputError(
                f"Camera and projector are {np.linalg.norm(t):.3g} mm apart",
                f"give the translation in mm, {LARGEST_BASELINE_MM:g} at most.",
            )
        vars(self).update(R=read_only(R), t=read_only(t))

    @property
    def baseline_mm(self) -> float:
        """Distance of the projector from the camera."""
        return float(np.linalg.norm(self.t))

    def to_projector(self, points: np.ndarray) -> np.ndarray:
        """Camera-frame points (..., 3) mm in the projector's frame, (..., 3) mm."""
        return np.asarray(points, dtype=np.float64) @ self.R.T + self.t

    def project(self, points: np.ndarray) -> np.ndarray:
        """Camera-frame points (..., 3) mm to projector pixels (..., 2); NaN behind the projector
        and past its fold."""
        return self.projector.project(self.to_projector(points))
