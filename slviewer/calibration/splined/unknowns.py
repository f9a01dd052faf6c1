"""The unknowns of the adjustment, and their order in its vector."""

from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from slviewer.calibration.splined.board_shape import HEIGHT_TERMS
from slviewer.calibration.splined.fields import Device, no_displacement
from slviewer.calibration.stereo import StereoModel
from slviewer.geometry.brown import fold_radius_squared
from slviewer.geometry.lens import Lens
from slviewer.geometry.rigid import Floats

LENS = 9
"""fx fy cx cy k1 k2 p1 p2 k3."""
RIG = 2 * LENS + 6
"""Both lenses, then rotation and translation."""


class Arrangement(NamedTuple):
    """Camera and projector, with X_p = R X_c + t, for the compiled kernels."""

    camera: Device
    projector: Device
    R: Floats
    t: Floats


@dataclass(frozen=True)
class UnknownLayout:
    """Order of the unknowns: poses (6 each), height, offsets (2 each), then the rig: both lenses (9
    each), rotation and translation, the camera's field and the projector's (u's coefficients, then
    v's).

    The rig's unknowns are last, so that the last block of a Cholesky factor is their information
    with all others marginalised out.
    """

    poses: int
    features: int
    camera_knots: int
    projector_knots: int

    @property
    def height(self) -> int:
        """Index of the first coefficient of the board's height."""
        return 6 * self.poses

    @property
    def offsets(self) -> int:
        """Index of the first feature's offset."""
        return self.height + HEIGHT_TERMS

    @property
    def rig(self) -> int:
        """Index of the first parameter of the camera's lens."""
        return self.offsets + 2 * self.features

    @property
    def camera_field(self) -> int:
        """Index of the first coefficient of the camera's field."""
        return self.rig + RIG

    @property
    def projector_field(self) -> int:
        """Index of the first coefficient of the projector's field."""
        return self.camera_field + 2 * self.camera_knots

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return self.projector_field + 2 * self.projector_knots

    @property
    def starts(self) -> NDArray[np.int64]:
        """(5,): the first unknown of height, offsets, rig, camera's field, and projector's field,
        for the kernels."""
        return np.array(
            [self.height, self.offsets, self.rig, self.camera_field, self.projector_field], np.int64
        )

    @property
    def separable(self) -> tuple[slice, ...]:
        """Blocks of which no two share an observation or a prior: offsets, and u and v of the
        projector's field."""
        v = self.projector_field + self.projector_knots
        return slice(self.offsets, self.rig), slice(self.projector_field, v), slice(v, self.size)


@dataclass(frozen=True, eq=False)
class State:
    """The unknowns' values. ``R_board`` (p, 3, 3), ``t_board`` (p, 3): board to camera; ``heights``
    (12,) and ``offsets`` (f, 2) mm: the board's shape."""

    rig: Arrangement
    R_board: Floats
    t_board: Floats
    heights: Floats
    offsets: Floats

    @classmethod
    def from_stereo(
        cls, stereo: StereoModel, poses: list[str], features: int, cells_across: int | None = None
    ) -> "State":
        """Return the initial state from a stereo calibration: no displacement, a flat board.

        ``cells_across``: cells of each displacement field across its image; by default
        ``fields.CELLS_ACROSS``.
        """
        rig = stereo.rig
        devices = [
            Device(
                lens.parameters,
                no_displacement(lens.size, cells_across),
                np.array(lens.size, float),
            )
            for lens in (rig.camera, rig.projector)
        ]
        T = np.array([stereo.poses[name] for name in poses])
        return cls(
            Arrangement(devices[0], devices[1], rig.R.copy(), rig.t.copy()),
            np.ascontiguousarray(T[:, :3, :3]),
            np.ascontiguousarray(T[:, :3, 3]),
            np.zeros(HEIGHT_TERMS),
            np.zeros((features, 2)),
        )

    @property
    def layout(self) -> UnknownLayout:
        """Order of the unknowns."""
        knots = [device.coefficients[0].size for device in (self.rig.camera, self.rig.projector)]
        return UnknownLayout(len(self.t_board), len(self.offsets), knots[0], knots[1])

    def step(self, step: Floats) -> "State":
        """Return the state after a step (N,) in the order of ``layout``; rotation vectors apply
        from the left."""
        at = self.layout
        pose = step[: at.height].reshape(-1, 6)
        rig, s = self.rig, step[at.rig :]
        fields = np.split(step[at.camera_field :], [2 * at.camera_knots])
        return replace(
            self,
            rig=Arrangement(
                _step_device(rig.camera, s[:LENS], fields[0]),
                _step_device(rig.projector, s[LENS : 2 * LENS], fields[1]),
                rotate_left(rig.R, s[2 * LENS : 2 * LENS + 3]),
                rig.t + s[2 * LENS + 3 : RIG],
            ),
            R_board=np.array(
                [rotate_left(R, w) for R, w in zip(self.R_board, pose[:, :3], strict=True)]
            ),
            t_board=self.t_board + pose[:, 3:],
            heights=self.heights + step[at.height : at.offsets],
            offsets=self.offsets + step[at.offsets : at.rig].reshape(-1, 2),
        )


def pinhole_lens(device: Device) -> Lens:
    """Return the pinhole and Brown lens of a device, without its displacement field."""
    return Lens.from_parameters(device.numbers[:LENS], (int(device.size[0]), int(device.size[1])))


def rotate_left(R: Floats, vector: Floats) -> Floats:
    """Rotate R (3, 3) from the left by a rotation vector (3,); the result is orthonormalised."""
    u, _, v = np.linalg.svd(cv2.Rodrigues(np.ascontiguousarray(vector))[0] @ R)
    return u @ v


def _step_device(device: Device, numbers: np.ndarray, coefficients: np.ndarray) -> Device:
    """Return a device with steps added to its nine lens parameters and its spline coefficients."""
    k = device.numbers[:LENS] + numbers
    return Device(
        np.append(k, fold_radius_squared(k[4:])),
        device.coefficients + coefficients.reshape(device.coefficients.shape),
        device.size,
    )
