"""Suggest the next board poses: the visible one that lowers the predicted sigma over the working
volume most, by the information of target poses on the rig.

The rig is known approximately, from few poses; a coarse model of it predicts visibility and
information.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product

import cv2
import numpy as np
from scipy.linalg import cholesky, eigh, solve_triangular
from scipy.spatial.transform import Rotation

from slviewer.calibration.board_pose import SolvedDevice, solve_device
from slviewer.calibration.next_pose import depth_range, place_board
from slviewer.calibration.splined.bundle import compute_point_jacobian
from slviewer.calibration.splined.normal import (
    Prior,
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
from slviewer.calibration.splined.uncertainty import (
    remove_rigid_motion,
    select_depth_axis,
    working_volume,
)
from slviewer.calibration.splined.unknowns import (
    CELLS_ACROSS,
    RIDGE,
    State,
    UnknownLayout,
    board_frame,
)
from slviewer.calibration.stereo import DEVICES
from slviewer.errors import CalibrationRejected
from slviewer.fringe.sequence import Size
from slviewer.geometry.jit import kernel
from slviewer.geometry.polynomial import grid_points
from slviewer.geometry.rig import StereoRig
from slviewer.geometry.rigid import (
    Floats,
    Floats32,
    Mask,
    move_points,
    nearest_rotation,
    rotation_angle,
)
from slviewer.geometry.vectors import box_middle, finite_rows, lengths
from slviewer.target.board import Board

COARSE_CELLS = 10
"""Cells of the displacement fields across an image; the joint adjustment has more
(``unknowns.CELLS_ACROSS``)."""
FEATURES, SAMPLES = (5, 4), (9, 7)
"""Points (across, down) that represent all features of a board, and all its bright pixels."""
BOARD_SAMPLES = 4000
"""Bright pixels that a pose contributes to the joint adjustment."""
MARGIN = 0.006
"""Margin around the outermost features in a visible pose, in widths of the image."""
MIN_POSES, MIN_FEATURES = 3, 12
MAX_FEATURES = 60
"""Features of a pose from which a rig is estimated."""
POSES_FOR_TWO_COEFFICIENTS = 6
"""With fewer poses only one radial distortion coefficient is estimated."""
MAX_DISAGREEMENT = 0.05, 0.1
"""Largest median deviation of the poses' camera-projector transforms from the common one: rotation
in rad, and translation over its length."""
_FOCALS = 0.4, 12.0  # plausible focal lengths, in widths of the image
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


@dataclass(frozen=True)
class ExpectedNoise:
    """Expected noise and local lens distortion before a joint adjustment has measured them.

    ``feature`` and ``sample``: standard deviations of a coordinate, in widths of the image;
    ``strengths``: of the camera's and the projector's prior at the adjustment's own knots, for
    displacements in widths of the image.
    """

    feature: float = 2.5e-5
    sample: float = 1.5e-5
    strengths: tuple[float, float] = (4e8, 2e8)

    def with_noise(self, samples: Floats) -> "ExpectedNoise":
        """Return the expectation updated by the measured noise (n,) of some poses' samples, in
        widths of the image.

        NaN where a pose's noise is not known. Larger noise raises that of the features in
        proportion; smaller does not lower it.
        """
        if not np.isfinite(samples).any():
            return self
        measured = float(np.nanmedian(samples))
        return replace(
            self, sample=measured, feature=self.feature * max(measured / self.sample, 1.0)
        )


@dataclass(frozen=True, eq=False)
class GuidanceModel:
    """Coarse model of one rig and one board, for predicting which poses are visible and how
    informative they are."""

    stereo: StereoRig
    board: Board
    expected: ExpectedNoise = ExpectedNoise()

    @cached_property
    def points(self) -> Floats:
        """(f, 3) mm: features that represent all those of the board."""
        low, high = self.board.points.min(0), self.board.points.max(0)
        grid = grid_points(*(np.linspace(low[k], high[k], n) for k, n in enumerate(FEATURES)))
        nearest = np.argmin(lengths(self.board.points[None, :, :2] - grid[:, None]), axis=1)
        return np.ascontiguousarray(self.board.points[np.unique(nearest)])

    @cached_property
    def state(self) -> State:
        """Values of the unknowns without poses: a flat board, devices without local distortion on
        coarse knots."""
        return State.from_rig(self.stereo, np.zeros((0, 4, 4)), len(self.points), COARSE_CELLS)

    @property
    def layout(self) -> UnknownLayout:
        """Order of the unknowns, without poses."""
        return self.state.layout

    @property
    def features_per_point(self) -> float:
        """Number of the board's features that each of ``points`` represents."""
        return len(self.board.points) / len(self.points)

    def sample_pixels(self, T_camera_board: Floats) -> list[Floats]:
        """Return camera pixels (m, 2) on a regular grid of the board, as far as both devices see
        them, for each pose.

        ``T_camera_board``: (k, 4, 4) mm.
        """
        outline = self.board.outline()
        shares = grid_points(*((np.arange(n) + 0.5) / n for n in SAMPLES), np.zeros(1))
        points = outline[0] + shares * np.ptp(outline, axis=0)
        pixels, visible = self._project(T_camera_board, points, 0)
        return [p[v] for p, v in zip(pixels, visible, strict=True)]

    def is_visible(self, T_camera_board: Floats) -> Mask:
        """(k,) bool: poses (k, 4, 4) mm at which both devices see every feature of the board, with
        a margin."""
        margin = 0.25 * self.board.pitch_mm if self.board.kind in ("circles", "acircles") else None
        _, visible = self._project(T_camera_board, self.board.outline(margin), MARGIN)
        return np.asarray(visible.all(1))

    def _project(
        self, T_camera_board: Floats, points: Floats, margin: float
    ) -> tuple[Floats, Mask]:
        """Project board points (n, 3) mm at each pose (k, 4, 4).

        Returns the camera's pixels (k, n, 2) and whether they are inside both images, (k, n) bool,
        with a ``margin`` in widths of the image.
        """
        X = move_points(T_camera_board, points)
        camera, projector = self.stereo.camera, self.stereo.projector
        pixels = camera.project(X)
        seen = camera.contains(pixels, margin * camera.size[0])
        return pixels, seen & projector.contains(self.stereo.project(X), margin * projector.size[0])

    def prior(self) -> Floats:
        """Return the information matrix (unknowns, unknowns) before any pose, in the order of
        ``layout``."""
        at = self.layout
        A = np.zeros((at.size, at.size))
        cell_ratio = CELLS_ACROSS / COARSE_CELLS
        prior = Prior.build(self.state, self.points)
        # the same curvature energy of a field, and the same ridge, as on the adjustment's knots
        camera, projector = (
            form + RIDGE * (cell_ratio**4 - 1) * np.eye(len(form)) for form in prior.forms
        )
        of_camera, of_projector = (
            strength / device.size[0] ** 2 / cell_ratio**2
            for device, strength in zip(self.state.rig[:2], self.expected.strengths, strict=True)
        )
        prior = replace(
            prior,
            forms=(camera, projector),
            strengths=(of_camera, of_projector),
            features_per_point=self.features_per_point,
        )
        prior.add(A, np.zeros(at.size), self.state)
        rig = np.arange(at.rig, at.camera_field)
        # wide prior standard deviations of both lenses, rotation (rad) and translation (mm)
        lens = [
            [0.3 * K[[0, 1], [0, 1]].mean()] * 4 + [0.5, 0.5, 0.02, 0.02, 2.0]
            for K in (self.stereo.camera.K, self.stereo.projector.K)
        ]
        A[rig, rig] += np.concatenate([*lens, [0.3] * 3, [300.0] * 3]) ** -2.0
        return A


def estimate_rig(
    points: Sequence[Floats],
    camera: Sequence[Floats],
    projector: Sequence[Floats],
    sizes: tuple[Size, Size],
) -> tuple[StereoRig, list[Floats]] | None:
    """Estimate an approximate rig and T_camera_board (4, 4) mm of every pose; None where the poses
    do not determine it.

    Of each pose: ``points`` (n, 3) mm on the board, and their ``camera`` and ``projector`` pixels
    (n, 2), NaN where unknown. ``sizes``: (width, height) px of camera and projector.
    """
    features = []
    for pose in zip(points, camera, projector, strict=True):
        known = np.nonzero(finite_rows(*pose[1:]))[0]  # that both devices see
        if len(known):
            known = known[np.unique(np.linspace(0, len(known) - 1, MAX_FEATURES).astype(int))]
        features.append([np.ascontiguousarray(each[known], np.float32) for each in pose])
    if len(features) < MIN_POSES or any(len(each[0]) < MIN_FEATURES for each in features):
        return None
    boards, *images = zip(*features, strict=True)
    flags = cv2.CALIB_FIX_K3 | cv2.CALIB_ZERO_TANGENT_DIST
    if len(boards) < POSES_FOR_TWO_COEFFICIENTS:
        flags |= cv2.CALIB_FIX_K2
    try:
        of_camera, of_projector = (
            solve_device(device, boards, seen, size, flags=flags)
            for device, seen, size in zip(DEVICES, images, sizes, strict=True)
        )
    except CalibrationRejected:
        return None
    if not (_is_plausible(of_camera) and _is_plausible(of_projector)):
        return None
    poses = of_camera.poses
    T = np.array(of_projector.poses) @ np.linalg.inv(poses)  # T_projector_camera by each pose
    t = np.median(T[:, :3, 3], axis=0)
    R = nearest_rotation(np.median(T[:, :3, :3], axis=0))
    rotation = np.median(rotation_angle(T[:, :3, :3] @ R.T))
    translation = np.median(lengths(T[:, :3, 3] - t)) / max(float(np.linalg.norm(t)), 1e-9)
    is_behind = any(pose[2, 3] <= 0 for pose in poses)
    if rotation > MAX_DISAGREEMENT[0] or translation > MAX_DISAGREEMENT[1] or is_behind:
        return None
    return StereoRig(of_camera.lens, of_projector.lens, R, t), poses


def _is_plausible(device: SolvedDevice) -> bool:
    """Whether a lens has focal lengths as lenses have them."""
    low, high = _FOCALS
    focals = np.array([device.K[0, 0], device.K[1, 1] / 2]) / device.size[0]
    return bool(np.isfinite(device.K).all() and (low < focals).all() and (focals < high).all())


@dataclass(frozen=True, eq=False)
class Guidance:
    """Recommended poses: T_camera_board (k, 4, 4) mm, the best first.

    ``sigma_mm``: predicted 3D standard deviation (RMS over the volume) from the poses so far;
    ``sigma_next_mm``: with the best pose added.
    """

    poses: Floats
    sigma_mm: float
    sigma_next_mm: float


def suggest_poses(model: GuidanceModel, poses: Sequence[Floats], trials: int) -> Guidance | None:
    """Recommend the next poses after ``poses``, T_camera_board (4, 4) mm each; None where no pose
    is visible.

    ``trials``: number of drawn candidates.
    """
    candidates = list_candidate_poses(model)
    if not len(candidates):
        return None
    jacobian = volume_jacobian(model, depth_range(model.board, model.stereo.camera))
    rows = information_rows(model, np.reshape(poses, (-1, 4, 4)))
    information = RigInformation.from_rows(model, rows, jacobian)

    gains = np.full(len(candidates), -np.inf)  # of those that are not tried

    def try_candidates(indices: np.ndarray) -> None:
        """Fill in the gains of candidates."""
        for i, rows in zip(indices, information_rows(model, candidates[indices]), strict=True):
            gains[i] = information.gain(rows)

    try_candidates(np.random.default_rng(len(poses)).permutation(len(candidates))[:trials])
    best = candidates[gains.argmax()]
    # shifts over 0.1 depth, plus turns over 15 degrees
    apart = lengths(best[:3, 3] - candidates[:, :3, 3]) / (0.1 * best[2, 3])
    apart += rotation_angle(best[:3, :3].T @ candidates[:, :3, :3]) / np.radians(15)
    nearest = np.argsort(apart)[: trials // 5]
    try_candidates(nearest[np.isinf(gains[nearest])])
    order = np.argsort(-gains)[: np.isfinite(gains).sum()]
    next_variance = max(float(information.variances.mean()) - gains.max(), 0.0)
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


def volume_jacobian(model: GuidanceModel, depths_mm: tuple[float, float]) -> Floats:
    """Return the Jacobian (3 m, unknowns) of the errors of a regular grid of the working volume's
    points, less their common rigid motion; ``depths_mm``: nearest and farthest board."""
    rig = model.state.rig
    volume = working_volume(rig, depths_mm)
    by_rig = compute_point_jacobian(
        model.state, select_depth_axis(rig, volume), volume.pixels, volume.z
    ).toarray()
    known = finite_rows(by_rig.reshape(len(volume.z), -1))
    by_rig = by_rig[np.repeat(known, 3)]
    jacobian = np.zeros((len(by_rig), model.layout.size))
    jacobian[:, model.layout.rig :] = remove_rigid_motion(by_rig.T, volume.points[known]).T
    return jacobian


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
        cls, model: GuidanceModel, rows: Sequence[Floats], jacobian: Floats
    ) -> "RigInformation":
        """Combine the prior with the rows of each pose (see ``information_rows``); ``jacobian``: of
        the volume's points (see ``volume_jacobian``)."""
        A = model.prior()
        if len(rows):
            J = np.concatenate(rows)
            A += J.T @ J
        scale = 1.0 / np.sqrt(np.diag(A))
        L = cholesky(A * scale * scale[:, None], lower=True, check_finite=False)
        factor = solve_triangular(L, np.diag(scale), lower=True, check_finite=False).T
        errors = jacobian @ factor
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
        seen = rows.any(axis=0)  # most coefficients of the fields are elsewhere in the images
        by_mode = rows[:, seen].astype(np.float32) @ self.modes[seen]
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
        board = model.points, board_frame(model.board.points)
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
    for c in range(POSE):
        columns[c] = c
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
