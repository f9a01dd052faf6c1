"""The result of the joint adjustment: the estimated unknowns and their information matrix."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from slviewer.calibration.splined.fields import Device
from slviewer.calibration.splined.posterior import compute_point_jacobian
from slviewer.calibration.splined.residual_noise import Noise
from slviewer.calibration.splined.unknowns import Arrangement, State
from slviewer.fringe.sequence import Axis
from slviewer.geometry.rigid import Floats
from slviewer.records.plain import from_plain, to_plain

_STATE_ARRAYS = ("R_board", "t_board", "heights", "offsets")
_OWN_ARRAYS = ("points", "camera_poses", "projector_poses")


@dataclass(frozen=True)
class PoseFit:
    """Residuals of one pose: RMS px of its features in the camera and of its samples in the
    projector, without outliers, and the trust in each, 0 ... 1; undisturbed poses reach 0.8."""

    camera_rms_px: float
    projector_rms_px: float
    camera_trust: float
    projector_trust: float


@dataclass(frozen=True, eq=False)
class Bundle:
    """Result of the joint adjustment of ``poses``.

    ``points`` (f, 3) mm: the board's features, without the offsets in the state. ``strengths``
    1/px^2: of the camera's and the projector's prior. ``excluded``: poses not used, with the
    reason. ``camera_poses`` and ``projector_poses``: how many poses illuminated each cell of the
    fields (rows, columns). ``half_turned_poses``: poses whose numbering was corrected by half a
    turn.

    ``packed_factor``: the lower triangle of ``factor``, row by row, float32.
    """

    state: State
    poses: tuple[str, ...]
    points: Floats
    noise: Noise
    strengths: tuple[float, float]
    fits: Mapping[str, PoseFit]
    excluded: Mapping[str, str]
    depth_range_mm: tuple[float, float]
    camera_poses: np.ndarray
    projector_poses: np.ndarray
    packed_factor: NDArray[np.float32]
    steps: int
    half_turned_poses: tuple[str, ...] = ()

    @cached_property
    def factor(self) -> NDArray[np.float32]:
        """(n, n) float32, lower triangular: factor @ factor.T is the information (inverse
        covariance) of the rig's n unknowns in the order of ``UnknownLayout`` from ``rig`` on, with
        poses and board marginalised out.
        """
        layout = self.state.layout
        n = layout.size - layout.rig
        factor = np.zeros((n, n), np.float32)
        factor[np.tri(n, dtype=bool)] = self.packed_factor
        return factor

    def point_jacobian(self, axis: Axis, pixels: np.ndarray, z: np.ndarray) -> sp.csr_matrix:
        """Return the Jacobian (3 n, unknowns) of measured points, mm per unit of the rig's
        unknowns.

        The points are those at camera ``pixels`` (n, 2) and depths ``z`` (n,) mm, measured from the
        phase of one axis; rows: x, y, z of the first point, then of the next. NaN where the
        projector cannot see the point.
        """
        return compute_point_jacobian(self.state, axis, pixels, z)

    def whiten(self, jacobian: sp.csr_matrix | np.ndarray) -> np.ndarray:
        """Return Y (unknowns, m), where Y.T @ Y is the covariance of the values with ``jacobian``
        (m, unknowns)."""
        dense = jacobian if isinstance(jacobian, np.ndarray) else jacobian.toarray()
        right = np.asarray(dense, self.factor.dtype).T
        return solve_triangular(self.factor, right, lower=True, check_finite=False)

    def to_dict(self) -> dict[str, Any]:
        """Return the fields that are not arrays, as JSON types."""
        keys = ("poses", "noise", "strengths", "fits", "depth_range_mm", "steps")
        data: dict[str, Any] = to_plain(
            {key: getattr(self, key) for key in keys}
            | {"turned": self.half_turned_poses, "left_out": self.excluded}
        )
        return data

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Return named arrays for saving; the factor packed, in float32."""
        rig = self.state.rig
        arrays = {
            f"{name}_{key}": value
            for name, device in (("camera", rig.camera), ("projector", rig.projector))
            for key, value in device._asdict().items()
        }
        arrays |= {name: getattr(self.state, name) for name in _STATE_ARRAYS}
        arrays |= {name: getattr(self, name) for name in _OWN_ARRAYS}
        return arrays | {"R": rig.R, "t": rig.t, "factor": self.packed_factor}

    @classmethod
    def from_arrays(cls, data: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> "Bundle":
        """Return the bundle that ``to_dict`` and ``to_arrays`` saved."""
        devices = [
            Device(*(np.ascontiguousarray(arrays[f"{name}_{key}"]) for key in Device._fields))
            for name in ("camera", "projector")
        ]
        a = {name: np.ascontiguousarray(values) for name, values in arrays.items()}
        rig = Arrangement(devices[0], devices[1], a["R"], a["t"])
        state = State(rig, *(a[name] for name in _STATE_ARRAYS))
        strengths, depths = data["strengths"], data["depth_range_mm"]
        return cls(
            state=state,
            poses=tuple(data["poses"]),
            **{name: a[name] for name in _OWN_ARRAYS},
            noise=from_plain(data["noise"], Noise),
            strengths=(strengths[0], strengths[1]),
            fits={name: PoseFit(**fit) for name, fit in data["fits"].items()},
            excluded=data["left_out"],
            depth_range_mm=(depths[0], depths[1]),
            packed_factor=a["factor"],
            steps=data["steps"],
            half_turned_poses=tuple(data.get("turned", ())),
        )
