"""Places of scans by a machine, with their uncertainty, and how far the surfaces contradict
them."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import chdtri

from slviewer.geometry.rigid import (
    Floats,
    Uncertainty,
    adjoint,
    coverage_radius,
    invert,
    rigid_transform,
)

CONTRADICTS = float(chdtri(6, 1e-4))
"""Squared distance, in standard deviations, from which on a difference is not explained."""


@dataclass(frozen=True, eq=False)
class MachinePlace:
    """Where a machine has a scan: ``T`` (4, 4) T_base_scan, mm, and covariances (6, 6) of small
    motions (rad, mm) in the scan's frame: ``own``, drawn anew with each pose, and ``common`` to all
    scans, of the hand-eye calibration."""

    T: Floats
    own: Floats
    common: Floats

    @classmethod
    def from_robot(
        cls, robot: Floats, noise: Floats, X: Floats, covariance: Floats, in_hand: bool
    ) -> "MachinePlace":
        """Return the place by a robot's pose (4, 4), with its ``noise`` (6, 6) in the flange's
        frame, and the hand-eye transform with its covariance in the frame that it maps to."""
        T = (robot if in_hand else invert(robot)) @ X
        J, shared = adjoint(invert(X if in_hand else T)), adjoint(invert(X))
        return cls(T, J @ noise @ J.T, shared @ covariance @ shared.T)

    def relative(self, scan: "MachinePlace") -> tuple[Floats, Floats]:
        """Return T_self_scan (4, 4) mm of another scan, and its covariance (6, 6) in this one's
        frame."""
        T = invert(self.T) @ scan.T
        J = adjoint(T)
        shared = J - np.eye(6)
        return T, self.own + J @ scan.own @ J.T + shared @ scan.common @ shared.T


@dataclass(frozen=True, eq=False)
class PlaceCheck:
    """By how much the surfaces place a scan beside its place by the machine, at the overlap's
    middle, and U of the difference (k = 2)."""

    shift_mm: float
    turn_deg: float
    U_mm: float
    U_deg: float
    agrees: bool


def at_point(covariance: Floats, point: Floats) -> Floats:
    """Return the covariance (6, 6) of a small motion whose turn is about a point (3,) mm in place
    of the origin."""
    J = adjoint(rigid_transform(np.eye(3), -point))
    return J @ covariance @ J.T


def compare_place(
    by_machine: tuple[Floats, Floats], by_surfaces: Floats, uncertainty: Uncertainty
) -> PlaceCheck:
    """Compare the place of a scan by the machine, with its covariance, with the registered one."""
    T, covariance = by_machine
    difference, middle = by_surfaces @ invert(T), np.asarray(uncertainty.centre, float)
    turn = Rotation.from_matrix(difference[:3, :3]).as_rotvec()
    shift = difference[:3, :3] @ middle + difference[:3, 3] - middle
    C = at_point(covariance, middle) + uncertainty.covariance
    d = np.concatenate([turn, shift])
    return PlaceCheck(
        float(np.linalg.norm(shift)),
        float(np.degrees(np.linalg.norm(turn))),
        coverage_radius(C[3:, 3:]),
        float(np.degrees(coverage_radius(C[:3, :3]))),
        bool(d @ np.linalg.solve(C, d) <= CONTRADICTS),
    )
