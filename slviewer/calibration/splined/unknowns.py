"""The unknowns of the adjustment, and their order in its vector."""

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from slviewer.calibration.splined.board_shape import HEIGHT_TERMS
from slviewer.calibration.splined.fields import Device
from slviewer.geometry.brown import fold_radius_squared
from slviewer.geometry.lens import Lens
from slviewer.geometry.rig import StereoRig
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


class UnknownLayout(NamedTuple):
    """Order of the unknowns: number of ``poses`` (6 each), then the index of the first unknown of
    ``height``, ``offsets`` (2 each), and the ``rig``: both lenses (9 each), rotation and
    translation, ``camera_field`` and ``projector_field`` (u's coefficients, then v's); and the
    number of unknowns.

    The rig's unknowns are last, so that the last block of a Cholesky factor is their information
    with all others marginalised out.
    """

    poses: int
    height: int
    offsets: int
    rig: int
    camera_field: int
    projector_field: int
    size: int

    @property
    def starts(self) -> NDArray[np.int64]:
        """(5,): the first unknown of height, offsets, rig, camera's field, and projector's field,
        for the kernels."""
        return np.array(self[1:-1], np.int64)

    @property
    def separable(self) -> tuple[slice, ...]:
        """Blocks of which no two share an observation or a prior: offsets, and u and v of the
        projector's field."""
        v = (self.projector_field + self.size) // 2
        return slice(self.offsets, self.rig), slice(self.projector_field, v), slice(v, self.size)


class State(NamedTuple):
    """The unknowns' values, for the compiled kernels too. ``R_board`` (p, 3, 3), ``t_board``
    (p, 3): board to camera; ``heights`` (12,) and ``offsets`` (f, 2) mm: the board's shape."""

    rig: Arrangement
    R_board: Floats
    t_board: Floats
    heights: Floats
    offsets: Floats

    @classmethod
    def from_rig(
        cls, rig: StereoRig, T: Floats, features: int, cells_across: int | None = None
    ) -> "State":
        """Return the initial state of a rig and poses ``T`` (p, 4, 4), board to camera: no
        displacement, a flat board.

        ``cells_across``: cells of each displacement field across its image; by default
        ``fields.CELLS_ACROSS``.
        """
        camera, projector = (
            Device.from_lens(lens, cells_across) for lens in (rig.camera, rig.projector)
        )
        return cls(
            Arrangement(camera, projector, rig.R.copy(), rig.t.copy()),
            np.ascontiguousarray(T[:, :3, :3]),
            np.ascontiguousarray(T[:, :3, 3]),
            np.zeros(HEIGHT_TERMS),
            np.zeros((features, 2)),
        )

    @property
    def layout(self) -> UnknownLayout:
        """Order of the unknowns."""
        poses, fields = len(self.t_board), [device.coefficients.size for device in self.rig[:2]]
        bounds = np.cumsum([6 * poses, HEIGHT_TERMS, 2 * len(self.offsets), RIG, *fields])
        return UnknownLayout(poses, *bounds.tolist())

    def step(self, step: Floats) -> "State":
        """Return the state after a step (N,) in the order of ``layout``; rotation vectors apply
        from the left."""
        at = self.layout
        pose = step[: at.height].reshape(-1, 6)
        rig, s = self.rig, step[at.rig :]
        fields = step[at.camera_field : at.projector_field], step[at.projector_field :]
        return self._replace(
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


def _step_device(device: Device, numbers: Floats, coefficients: Floats) -> Device:
    """Return a device with steps added to its nine lens parameters and its spline coefficients."""
    k = device.numbers[:LENS] + numbers
    return Device(
        np.append(k, fold_radius_squared(k[4:])),
        device.coefficients + coefficients.reshape(device.coefficients.shape),
        device.size,
    )
