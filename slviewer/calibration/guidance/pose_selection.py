"""Selection of the next pose: the visible one that lowers the predicted sigma over the working
volume most, by the information of target poses on the rig."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.linalg import cholesky, eigh, solve_triangular
from scipy.spatial.transform import Rotation

from slviewer.calibration.guidance.coarse_rig import BOARD_SAMPLES, GuidanceModel
from slviewer.calibration.next_pose import depth_range, place_board
from slviewer.calibration.splined.bundle import compute_point_jacobian
from slviewer.calibration.splined.normal import (
    dense_columns,
    fill_feature_fields,
    fill_sample_fields,
    set_feature_columns,
    set_sample_columns,
)
from slviewer.calibration.splined.residuals import (
    HEIGHT,
    ROW,
    allocate_workspace,
    feature_row,
    sample_row,
)
from slviewer.calibration.splined.volume import (
    Volume,
    remove_rigid_motion,
    select_depth_axis,
    working_volume,
)
from slviewer.geometry.jit import kernel
from slviewer.geometry.polynomial import grid_points
from slviewer.geometry.rigid import Floats, Floats32, rotation_angle
from slviewer.geometry.vectors import box_middle, finite_rows, lengths

DEPTHS = (0.0, 0.2, 0.45, 0.75, 1.1, 1.45)
"""Candidate depths, from nearest (0) to farthest (1) recommended depth, and beyond it."""
TILTS_DEG = ((0, 0), (16, 0), (-16, 0), (0, 16), (0, -16), (22, 22), (22, -22), (-22, 22),
(-22, -22), (32, 0),
             (-32, 0), (0, 32), (0, -32))  # fmt: skip
"""Candidate tilts about x and y."""
DIRECTIONS = tuple((x, y) for x, y in product((-1.0, 0.0, 1.0), repeat=2))
"""Directions from the image's centre in which the farthest visible pose is a candidate; (0, 0): the
most central."""
_OFFSETS = 15  # positions along each side of the image that are tested for visibility
TRIALS = 56
"""Default number of randomly drawn candidates whose gain is computed; a fifth as many more near the
best of them."""
NEGLIGIBLE = 1e-4
"""Share of the points' mean variance that gains neglect."""
POSE = HEIGHT
"""Number of a pose's unknowns; they come first in every row."""


@dataclass(frozen=True, eq=False)
class Guidance:
    """Recommended poses: T_camera_board (k, 4, 4) mm, the best first.

    ``sigma_mm``: predicted 3D standard deviation (RMS over the volume) from the poses so far;
    ``sigma_next_mm``: with the best pose added.
    """

    poses: Floats
    sigma_mm: float
    sigma_next_mm: float


def suggest_poses(
    model: GuidanceModel, poses: Sequence[Floats], trials: int = TRIALS
) -> Guidance | None:
    """Recommend the next poses after ``poses``, T_camera_board (4, 4) mm each; None where no pose
    is visible.

    ``trials``: number of drawn candidates.
    """
    candidates = list_candidate_poses(model)
    if not len(candidates):
        return None
    sensitivity = VolumeSensitivity.from_model(model, depth_range(model.board, model.stereo.camera))
    rows = information_rows(model, np.reshape(poses, (-1, 4, 4)))
    information = RigInformation.from_rows(model, rows, sensitivity)

    def compute_gains(indices: list[int]) -> dict[int, float]:
        """Return the gain of each of these candidates by its index."""
        return {
            i: information.gain(rows)
            for i, rows in zip(indices, information_rows(model, candidates[indices]), strict=True)
        }

    gains = compute_gains(
        np.random.default_rng(len(poses)).permutation(len(candidates))[:trials].tolist()
    )
    best = candidates[max(gains, key=lambda i: gains[i])]
    # shifts over 0.1 depth, plus turns over 15 degrees
    apart = lengths(best[:3, 3] - candidates[:, :3, 3]) / (0.1 * best[2, 3])
    apart += rotation_angle(best[:3, :3].T @ candidates[:, :3, :3]) / np.radians(15)
    nearest = np.argsort(apart)[: trials // 5]
    gains |= compute_gains([i for i in nearest.tolist() if i not in gains])
    order = sorted(gains, key=lambda i: -gains[i])
    next_variance = max(float(information.variances.mean()) - gains[order[0]], 0.0)
    return Guidance(candidates[order], information.sigma_mm, float(np.sqrt(next_variance)))


def list_candidate_poses(model: GuidanceModel) -> Floats:
    """Return visible poses T_camera_board (k, 4, 4) mm at several depths and tilts.

    At each depth and tilt: the most central pose, and the farthest visible ones towards the image's
    corners and edges.
    """
    camera, board = model.stereo.camera, model.board
    near, far = depth_range(board, camera)
    steps = np.linspace(0, 1, _OFFSETS)
    pixels = grid_points(*(steps * (n - 1) for n in camera.size))
    places = 2 * pixels / (np.array(camera.size) - 1) - 1
    shares, tilts = zip(*product(DEPTHS, TILTS_DEG), strict=True)
    R = Rotation.from_rotvec([(*tilt, 0.0) for tilt in tilts], degrees=True).as_matrix()
    depths = near + (far - near) * np.array(shares)
    T = place_board(board, camera, R[:, None], depths[:, None], pixels)
    candidates = [np.zeros((0, 4, 4))]
    is_visible = model.is_visible(T.reshape(-1, 4, 4)).reshape(T.shape[:2])
    for poses, visible in zip(T, is_visible, strict=True):
        if visible.any():
            candidates.append(poses[visible][_select_extremes(places[visible])])
    return np.concatenate(candidates)


def _select_extremes(places: Floats) -> list[int]:
    """Return the indices of the places (n, 2), in image units of -1 to 1, farthest in each of
    ``DIRECTIONS``.

    For direction (0, 0): the place nearest to the centre of their bounding box.
    """
    penalty = 0.01 * (places**2).sum(1)  # of two equally far places the more central one
    off_centre = ((places - box_middle(places)) ** 2).sum(1)
    return sorted(
        {
            int(np.argmax(places @ np.array(d) - penalty) if any(d) else np.argmin(off_centre))
            for d in DIRECTIONS
        }
    )


@dataclass(frozen=True, eq=False)
class VolumeSensitivity:
    """Points of the working volume and the Jacobian (3 m, unknowns) of their errors, less their
    common rigid motion."""

    volume: Volume
    jacobian: Floats

    @classmethod
    def from_model(
        cls, model: GuidanceModel, depths_mm: tuple[float, float]
    ) -> "VolumeSensitivity":
        """Compute the Jacobian of a regular grid of points; ``depths_mm``: nearest and farthest
        board."""
        volume = working_volume(model.rig, depths_mm)
        by_rig = compute_point_jacobian(
            model.state, select_depth_axis(model.rig, volume), volume.pixels, volume.z
        ).toarray()
        known = finite_rows(by_rig.reshape(len(volume.z), -1))
        volume = volume.select(known)
        by_rig = by_rig[np.repeat(known, 3)]
        jacobian = np.zeros((len(by_rig), model.layout.size))
        jacobian[:, model.layout.rig :] = remove_rigid_motion(by_rig.T, volume.points).T
        return cls(volume, jacobian)


@dataclass(frozen=True, eq=False)
class RigInformation:
    """Uncertainty of the rig after some poses.

    ``variances`` (m,) mm^2 of the volume's points. ``modes`` (n, n) float32: a factor of the
    unknowns' covariance, ``modes @ modes.T``, whose columns act on the volume independently of each
    other and with increasing effect; ``mode_rms_mm`` (k,) float32: RMS error over the volume's
    points by each of the last k modes.
    """

    variances: Floats
    modes: Floats32
    mode_rms_mm: Floats32

    @classmethod
    def from_rows(
        cls, model: GuidanceModel, rows: Sequence[Floats], sensitivity: VolumeSensitivity
    ) -> "RigInformation":
        """Combine the prior with the rows of each pose (see ``information_rows``)."""
        A = model.prior()
        if len(rows):
            J = np.concatenate(rows)
            A += J.T @ J
        scale = 1.0 / np.sqrt(np.diag(A))
        L = cholesky(A * scale * scale[:, None], lower=True, check_finite=False)
        factor = solve_triangular(L, np.diag(scale), lower=True, check_finite=False).T
        errors = sensitivity.jacobian @ factor
        variances = (errors**2).sum(axis=1).reshape(-1, 3).sum(axis=1)
        mode_variances, rotation = eigh(errors.T @ errors / len(variances), check_finite=False)
        mode_variances = np.maximum(mode_variances, 0.0)
        count = int((np.cumsum(mode_variances) > NEGLIGIBLE * mode_variances.sum()).sum())
        mode_rms = np.sqrt(mode_variances[-count:])
        return cls(variances, (factor @ rotation).astype(np.float32), mode_rms.astype(np.float32))

    @property
    def sigma_mm(self) -> float:
        """3D standard deviation of the volume's points, RMS over the volume."""
        return float(np.sqrt(self.variances.mean()))

    def gain(self, rows: Floats) -> float:
        """Return the decrease in mm^2 of the points' mean variance by one more pose with these
        information rows."""
        by_mode = rows.astype(np.float32) @ self.modes
        inner = (by_mode @ by_mode.T).astype(np.float64)
        inner[np.diag_indices(len(inner))] += 1.0
        weighted = by_mode[:, -len(self.mode_rms_mm) :] * self.mode_rms_mm
        L = cholesky(inner, lower=True, check_finite=False)
        weighted = weighted.astype(np.float64)
        return float((solve_triangular(L, weighted, lower=True, check_finite=False) ** 2).sum())


def information_rows(model: GuidanceModel, T_camera_board: Floats) -> list[Floats]:
    """Compute the information of a flat board at each pose (k, 4, 4) mm on all unknowns but the
    pose itself.

    Returns J (rows, unknowns) of each pose: derivatives of features and samples over their standard
    deviations, with the pose projected out, so that J.T @ J is the information. Rows of what a
    device does not see are 0.
    """
    at = model.layout
    starts = at.starts + POSE
    widths = model.stereo.camera.size[0], model.stereo.projector.size[0]
    feature_sigma = model.expected.feature * widths[0] / np.sqrt(model.features_per_point)
    information = []
    for T, pixels in zip(T_camera_board, model.sample_pixels(T_camera_board), strict=True):
        sample_sigma = (
            model.expected.sample * widths[1] / np.sqrt(BOARD_SAMPLES / max(len(pixels), 1))
        )
        state = model.state._replace(
            R_board=np.ascontiguousarray(T[None, :3, :3]), t_board=T[None, :3, 3].copy()
        )
        rows = np.zeros((2 * (len(model.points) + len(pixels)), POSE + at.size))
        weights = 1.0 / feature_sigma, 1.0 / sample_sigma
        board = model.points, model.frame
        _fill_rows(state, *board, np.ascontiguousarray(pixels), weights, starts, rows)
        basis, _ = np.linalg.qr(rows[:, :POSE])
        by_others = rows[:, POSE:]
        information.append(by_others - basis @ (basis.T @ by_others))
    return information


@kernel()
def _fill_rows(state, points, frame, pixels, weights, at, rows):
    """Fill ``rows`` with the weighted derivatives of a board's features (two rows each), then of
    its sample pixels.

    ``weights``: of a feature and of a sample; ``at``: indices at which height, offsets, rig, camera
    field and projector field start in a row.
    """
    work = allocate_workspace()
    columns = dense_columns(at)
    columns[:POSE] = np.arange(POSE)
    for n in range(points.shape[0]):
        u, _ = feature_row(state, 0, points, frame, n, work)
        if np.isfinite(u):
            set_feature_columns(columns, state.rig, n, work.cells, at)
            fill_feature_fields(work)
            _scatter_row(work.row, columns, weights[0], rows[2 * n : 2 * n + 2])
    samples = rows[2 * points.shape[0] :]
    for n in range(pixels.shape[0]):
        u, _ = sample_row(state, 0, frame, pixels[n], work)
        if np.isfinite(u):
            set_sample_columns(columns, state.rig, work.cells, at)
            fill_sample_fields(work)
            _scatter_row(work.row, columns, weights[1], samples[2 * n : 2 * n + 2])


@kernel()
def _scatter_row(row, columns, weight, out):
    """Add the weighted derivatives (2, ROW) of an observation to full rows (2, unknowns), each to
    its column."""
    for k in range(2):
        for c in range(ROW):
            out[k, columns[c]] += weight * row[k, c]
