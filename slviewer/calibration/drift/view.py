"""One view of the board, linearised in the board's pose, the projector's pose and the lens errors.

A view is a calibration pose or a later capture of the same board: its features in the camera, and
the projector's coordinates at a grid of the board's pixels. All unknowns are small (tenths of a
pixel), so that one linearisation at the calibration and at the board's pose by the camera is
sufficient.
"""

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
import scipy.sparse as sp

from slviewer.calibration.board_pose import intersect_board, solve_pose
from slviewer.calibration.observe import AXES, Observation
from slviewer.errors import InputError
from slviewer.fringe.sequence import Axis
from slviewer.geometry.rig import StereoRig
from slviewer.geometry.rigid import Floats, Mask, move_points, rigid_transform
from slviewer.geometry.splines import basis_matrix, second_differences
from slviewer.geometry.vectors import finite_rows, unit_vectors

SAMPLES = 1000
"""Number of pixels of the board at which the projector's coordinates are compared."""
CELLS_PER_WIDTH = 16
"""Spline cells across an image of the lens errors beyond Brown's model."""
KINDS = ("camera", "x", "y")
"""Kinds of observations: features in the camera, projector columns, projector rows."""
STEPS = np.array([1e-4, 1e-4, 1e-4, 0.05, 0.05, 0.05])
"""Half steps of the numerical derivatives, rad and mm: pixels move by about a tenth."""


@dataclass(frozen=True, eq=False)
class DriftView:
    """``camera`` (n, 2) px of board ``points`` (n, 3) mm; ``pixels`` (m, 2) px of the board in the
    camera, and the ``projector`` coordinates (m, 2) px there, a column of NaN for an axis that was
    not captured."""

    name: str
    points: Floats
    camera: Floats
    pixels: Floats
    projector: Floats

    @classmethod
    def from_observation(cls, observation: Observation) -> "DriftView":
        """Sample an observation of the board. Raises InputError where its region is empty."""
        u0, v0, _, _ = observation.box
        v, u = np.nonzero(observation.region)
        if not len(v):
            raise InputError(
                f"{observation.name}: no pixel of the board carries a readable pattern: illuminate"
                " the board"
            )
        step = max(1, int(np.sqrt(len(v) / SAMPLES)))
        on_grid = (u % step == 0) & (v % step == 0)
        pixels = np.stack([u[on_grid] + u0, v[on_grid] + v0], 1).astype(float)
        projector = np.full((len(pixels), 2), np.nan)
        for axis in observation.surfaces:
            projector[:, AXES.index(axis)] = observation.coordinate(axis, *pixels.T)
        return cls(observation.name, observation.points, observation.camera, pixels, projector)

    @property
    def axes(self) -> tuple[Axis, ...]:
        """The axes with known projector coordinates."""
        return tuple(axis for i, axis in enumerate(AXES) if np.isfinite(self.projector[:, i]).any())


@dataclass(frozen=True, eq=False)
class DisplacementField:
    """A cubic B-spline displacement field over an image of ``size`` px: ``cells`` (across,
    down)."""

    size: tuple[int, int]

    @property
    def cells(self) -> tuple[int, int]:
        """Cells (across, down): square ones."""
        return CELLS_PER_WIDTH, max(1, round(CELLS_PER_WIDTH * self.size[1] / self.size[0]))

    @property
    def unknowns(self) -> int:
        """Number of coefficients of one of the two components."""
        return (self.cells[0] + 3) * (self.cells[1] + 3)

    def basis(self, pixels: Floats) -> sp.csr_array:
        """Return the spline basis (n, unknowns) at pixels (n, 2): displacement by coefficients."""
        across, down = (
            basis_matrix(np.clip(pixels[:, k], -0.5, size - 0.5), -0.5, size - 0.5, cells)
            for k, (size, cells) in enumerate(zip(self.size, self.cells, strict=True))
        )
        return sp.csr_array((down[:, :, None] * across[:, None]).reshape(-1, self.unknowns))

    @cached_property
    def roughness(self) -> sp.csr_array:
        """Quadratic form (unknowns, unknowns) of the squared second differences of one component's
        coefficients."""
        across, down = (n + 3 for n in self.cells)
        u = sp.kron(sp.eye(down), second_differences(across))
        v = sp.kron(second_differences(down), sp.eye(across))
        return sp.csr_array(u.T @ u + v.T @ v)


@dataclass(frozen=True, eq=False)
class LinearView:
    """A view's linear equations ``residuals = pose a + change b + shared c``, one row per observed
    coordinate (px).

    ``kinds`` (k,): index into KINDS of each row; ``usable`` (k,) bool: the rows that were measured.
    Derivatives: ``pose`` (k, 6) by the board's pose; ``change`` (k, 6) by the projector's rotation
    about its own centre and axes (rad) and its translation (mm); ``scale`` (k,) by the board's
    relative growth; ``shared`` (k, unknowns) by what all views share: the change again, as the
    calibration's own error, then the lens errors, u and v components of the camera's field, then of
    the projector's. ``across`` (k,): weight of each projector coordinate in the offset across the
    epipolar lines.
    """

    name: str
    kinds: np.ndarray
    residuals: Floats
    usable: Mask
    pose: Floats
    change: Floats
    scale: Floats
    shared: sp.csr_array
    across: Floats


def linearise_view(rig: StereoRig, view: DriftView) -> LinearView:
    """Linearise a view at the board's pose by the camera alone.

    Raises InputError where that pose cannot be solved.
    """
    T = solve_pose(view.points, rig.camera.undistort(view.camera), np.eye(3), np.zeros(5))
    if T is None:
        raise InputError(
            f"{view.name}: no pose of the board fits its features: is it the calibration's board?"
        )
    middle = view.points.mean(0)

    def model(at: Floats, moved: Floats | float = 0.0) -> tuple[Floats, Floats]:
        """Predict features (n, 2) and samples (m, 2) px at changes ``at`` (13,) of board pose,
        projector, scale."""
        moved_T = rigid_transform(cv2.Rodrigues(at[:3])[0] @ T[:3, :3], T[:3, 3] + at[3:6])
        on_board = intersect_board(moved_T, rig.camera.undistort(view.pixels + moved))
        in_projector = rig.to_projector(on_board) @ cv2.Rodrigues(at[6:9])[0].T + at[9:12]
        points = middle + (view.points - middle) * (1 + at[12])
        features = rig.camera.project(move_points(moved_T, points))
        return features, rig.projector.project(in_projector)

    derivatives = np.column_stack(
        [
            _flatten(*(a - b for a, b in zip(model(step), model(-step), strict=True)))
            / (2 * step.sum())
            for step in np.diag(np.r_[STEPS, STEPS, 1e-4])
        ]
    )
    features, samples = model(np.zeros(13))
    residuals = _flatten(view.camera - features, view.projector - samples)
    usable = finite_rows(residuals[:, None], derivatives[:, 6:12])
    derivatives = np.nan_to_num(derivatives)
    pose, change, scale = derivatives[:, :6], derivatives[:, 6:12], derivatives[:, 12]
    # (m, 2, 2): how the sample in the projector moves with the pixel in the camera
    moved = [
        (model(np.zeros(13), 0.1 * unit)[1] - model(np.zeros(13), -0.1 * unit)[1]) / 0.2
        for unit in np.eye(2)
    ]
    J = np.nan_to_num(np.stack(moved, axis=2))
    camera, projector = DisplacementField(rig.camera.size), DisplacementField(rig.projector.size)
    on_features, at_pixels = camera.basis(view.camera), camera.basis(view.pixels)
    on_samples = projector.basis(np.nan_to_num(samples))
    interleaved = [sp.kron(on_features, unit[:, None]) for unit in np.eye(2)]
    columns, rows = ([-sp.diags(J[:, row, k]) @ at_pixels for k in (0, 1)] for row in (0, 1))
    lens_errors = sp.block_array(
        [
            [*interleaved, None, None],
            [*columns, on_samples, None],
            [*rows, None, on_samples],
        ]
    )
    n, m = len(view.camera), len(view.pixels)
    by_shift = (derivatives[2 * n :, 3:6] @ T[:3, 2]).reshape(2, m)  # along the board's normal
    towards = unit_vectors(by_shift.T)
    return LinearView(
        view.name,
        np.repeat([0, 1, 2], [2 * n, m, m]),
        np.where(usable, residuals, 0.0),
        usable,
        pose,
        change,
        scale,
        sp.csr_array(sp.hstack([sp.csr_array(change), lens_errors])),
        np.concatenate([np.zeros(2 * n), -towards[:, 1], towards[:, 0]]),
    )


def _flatten(camera: Floats, projector: Floats) -> Floats:
    """Flatten values of features (n, 2) and of samples (m, 2) in the order of KINDS, (2 n + 2
    m,)."""
    return np.concatenate([camera.ravel(), *projector.T])
