"""What the joint adjustment found, and how sure it is of it."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import scipy.sparse as sp
from scipy.linalg import solve_triangular

from slviewer.calibration.splined.board_shape import board_frame, board_heights
from slviewer.calibration.splined.evidence import Noise
from slviewer.calibration.splined.fields import Device
from slviewer.calibration.splined.posterior import point_rows
from slviewer.calibration.splined.uncertainty import volume_sigma
from slviewer.calibration.splined.unknowns import Arrangement, State
from slviewer.fringe.sequence import Axis


@dataclass(frozen=True)
class PoseFit:
    """One pose: RMS px of its features in the camera and of its samples in the projector (outliers set aside), and how
    far each is trusted, 0 ... 1; undisturbed ones reach 0.8."""

    camera_rms_px: float
    projector_rms_px: float
    camera_trust: float
    projector_trust: float


@dataclass(frozen=True, eq=False)
class Bundle:
    """The unknowns of ``poses``, and their information.

    ``points`` (f, 3) mm: the board's features, whose offsets the state has. ``strengths`` 1/px^2: of the camera's and
    the projector's prior. ``left_out``: poses set aside, with the reason. ``camera_poses`` and ``projector_poses``:
    how many poses lit each cell of the fields (rows, columns). ``turned``: poses whose board was numbered from the
    other end, and is no more.

    ``packed_factor``: the lower triangle of ``factor``, row by row, float32.
    """

    state: State
    poses: tuple[str, ...]
    points: np.ndarray
    noise: Noise
    strengths: tuple[float, float]
    fits: Mapping[str, PoseFit]
    left_out: Mapping[str, str]
    depth_range_mm: tuple[float, float]
    camera_poses: np.ndarray
    projector_poses: np.ndarray
    packed_factor: np.ndarray
    steps: int
    turned: tuple[str, ...] = ()

    @cached_property
    def factor(self) -> np.ndarray:
        """(n, n) float32, lower triangular: factor @ factor.T is the information (inverse covariance) of the rig's n
        unknowns in the order of ``Layout`` from ``rig`` on, with poses and board marginalised out."""
        layout = self.state.layout
        n = layout.size - layout.rig
        factor = np.zeros((n, n), np.float32)
        factor[np.tri(n, dtype=bool)] = self.packed_factor
        return factor

    def point_jacobian(self, axis: Axis, pixels: np.ndarray, z: np.ndarray) -> sp.csr_matrix:
        """(3 n, unknowns) mm a unit: how the points measured at camera ``pixels`` (n, 2) and depths ``z`` (n,) from the
        phase of one axis answer to the rig's unknowns; x, y, z of the first point, then of the next. NaN where the
        projector cannot see the point.
        """
        return point_rows(self.state, axis, pixels, z)

    def whitened(self, jacobian: sp.csr_matrix | np.ndarray) -> np.ndarray:
        """(unknowns, m) Y with Y.T @ Y the covariance of what has ``jacobian`` (m, unknowns) by the rig's unknowns."""
        dense = jacobian if isinstance(jacobian, np.ndarray) else jacobian.toarray()
        right = np.asarray(dense, self.factor.dtype).T
        return np.asarray(solve_triangular(self.factor, right, lower=True, check_finite=False))

    @cached_property
    def sigma_volume(self) -> dict[str, Any]:
        """How sure the rig is of its working volume, as ``uncertainty.volume_sigma`` says."""
        return volume_sigma(self)

    def summary(self) -> dict[str, Any]:
        """The figures that ``text`` tells, JSON-able."""
        fields = {
            device: float(np.sqrt(np.mean(part.coefficients[:, 1:-1, 1:-1] ** 2)))
            for device, part in (("camera", self.state.rig.camera), ("projector", self.state.rig.projector))
        }
        height = board_heights(self.points, board_frame(self.points), self.state.heights)
        return {
            "steps": self.steps,
            "residuals_over_noise": {"x": self.noise.ratio[0], "y": self.noise.ratio[1]},
            "noise_px": {"camera": self.noise.camera_px, "x": self.noise.sample_px[0], "y": self.noise.sample_px[1]},
            "local_distortion_rms_px": fields,
            "board_height_mm": [float(height.min()), float(height.max())],
            "board_offsets_rms_mm": float(np.sqrt(np.mean(self.state.offsets**2))),
            "cells_lit": {
                "camera": float(np.mean(self.camera_poses > 0)),
                "projector": float(np.mean(self.projector_poses > 0)),
            },
            "sigma_volume_mm": self.sigma_volume,
            "left_out": dict(self.left_out),
            "turned": list(self.turned),
        }

    def text(self) -> str:
        """For people."""
        s = self.summary()
        noise, local, lit = s["noise_px"], s["local_distortion_rms_px"], s["cells_lit"]
        low, high = s["board_height_mm"]
        sure = s["sigma_volume_mm"]
        near, far = sure["depths_mm"]
        u, v, z = sure["worst_at"]
        return "\n".join(
            [
                f"splined: residuals camera {noise['camera']:.4f} px, projector x {noise['x']:.4f}, "
                f"y {noise['y']:.4f} px (robust; {max(self.noise.ratio):.1f} times the predicted noise), "
                f"after {s['steps']} steps",
                f"  local distortion {local['camera']:.3f} px RMS in the camera, "
                f"{local['projector']:.3f} px in the projector",
                f"  board: height {low:+.4f} ... {high:+.4f} mm, features misplaced by "
                f"{s['board_offsets_rms_mm']:.4f} mm RMS",
                *(
                    [f"  board turned by 180 degrees in {', '.join(self.turned)}: numbered as in the others"]
                    * bool(self.turned)
                ),
                f"  lit by target poses: {100 * lit['camera']:.0f} % of the camera's cells, "
                f"{100 * lit['projector']:.0f} % of the projector's",
                f"  3D uncertainty at {near:.0f}-{far:.0f} mm, rigid motion apart (1 sigma): median "
                f"{sure['median']:.4f} mm and 95 % below {sure['p95']:.4f} mm over the {100 * sure['supported']:.0f} % "
                f"that the poses support; worst {sure['worst']:.3f} mm, at pixel ({u:.0f}, {v:.0f}) and {z:.0f} mm",
            ]
        )

    def to_dict(self) -> dict[str, Any]:
        """What is not an array, JSON-able."""
        return {
            "poses": list(self.poses),
            "noise": vars(self.noise),
            "strengths": list(self.strengths),
            "fits": {name: vars(fit) for name, fit in self.fits.items()},
            "left_out": dict(self.left_out),
            "depth_range_mm": list(self.depth_range_mm),
            "steps": self.steps,
            "turned": list(self.turned),
        }

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Flat named arrays, for saving; the factor packed, in float32."""
        rig = self.state.rig
        arrays = {
            f"{name}_{key}": value
            for name, device in (("camera", rig.camera), ("projector", rig.projector))
            for key, value in device._asdict().items()
        }
        return arrays | {
            "R": rig.R,
            "t": rig.t,
            "R_board": self.state.R_board,
            "t_board": self.state.t_board,
            "heights": self.state.heights,
            "offsets": self.state.offsets,
            "points": self.points,
            "camera_poses": self.camera_poses,
            "projector_poses": self.projector_poses,
            "factor": self.packed_factor,
        }

    @classmethod
    def restored(cls, data: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> "Bundle":
        """The inverse of ``to_dict`` and ``to_arrays``."""
        devices = [
            Device(*(np.ascontiguousarray(arrays[f"{name}_{key}"]) for key in Device._fields))
            for name in ("camera", "projector")
        ]
        a = {name: np.ascontiguousarray(values) for name, values in arrays.items()}
        rig = Arrangement(devices[0], devices[1], a["R"], a["t"])
        state = State(rig, a["R_board"], a["t_board"], a["heights"], a["offsets"])
        strengths, depths, noise = data["strengths"], data["depth_range_mm"], data["noise"]
        pairs = {key: (noise[key][0], noise[key][1]) for key in ("excess_px", "sample_px")}
        return cls(
            state=state,
            poses=tuple(data["poses"]),
            points=a["points"],
            noise=Noise(noise["camera_px"], **pairs),
            strengths=(strengths[0], strengths[1]),
            fits={name: PoseFit(**fit) for name, fit in data["fits"].items()},
            left_out=data["left_out"],
            depth_range_mm=(depths[0], depths[1]),
            camera_poses=a["camera_poses"],
            projector_poses=a["projector_poses"],
            packed_factor=a["factor"],
            steps=data["steps"],
            turned=tuple(data.get("turned", ())),
        )
