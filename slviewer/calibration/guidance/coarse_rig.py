"""Approximate rig from few poses, and the coarse model with which guidance predicts visibility and
information."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np

from slviewer.calibration.splined.board_shape import HEIGHT_TERMS, board_frame, offset_gauge
from slviewer.calibration.splined.fields import CELLS_ACROSS, RIDGE, Device, roughness
from slviewer.calibration.splined.prior import Prior
from slviewer.calibration.splined.unknowns import Arrangement, State, UnknownLayout
from slviewer.geometry.lens import Lens
from slviewer.geometry.polynomial import grid_points
from slviewer.geometry.rig import StereoRig
from slviewer.geometry.rigid import (
    Floats,
    Mask,
    move_points,
    nearest_rotation,
    rotation_angle,
    transform_from_rvec,
)
from slviewer.geometry.vectors import finite_rows, lengths
from slviewer.target.board import Board

COARSE_CELLS = 10
"""Cells of the displacement fields across an image; the joint adjustment has more
(``fields.CELLS_ACROSS``)."""
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
    def rig(self) -> Arrangement:
        """Both devices without local distortion, on coarse knots."""
        rig = self.stereo
        camera, projector = (
            Device.from_lens(lens, COARSE_CELLS) for lens in (rig.camera, rig.projector)
        )
        return Arrangement(camera, projector, np.array(rig.R), np.array(rig.t))

    @cached_property
    def points(self) -> Floats:
        """(f, 3) mm: features that represent all those of the board."""
        low, high = self.board.points.min(0), self.board.points.max(0)
        grid = grid_points(*(np.linspace(low[k], high[k], n) for k, n in enumerate(FEATURES)))
        nearest = np.argmin(lengths(self.board.points[None, :, :2] - grid[:, None]), axis=1)
        return np.ascontiguousarray(self.board.points[np.unique(nearest)])

    @cached_property
    def frame(self) -> Floats:
        """(4,) mm: the rectangle of the board's features, as ``board_frame`` returns it."""
        return board_frame(self.board.points)

    @cached_property
    def state(self) -> State:
        """Values of the unknowns without poses: a flat board."""
        flat, offsets = np.zeros(HEIGHT_TERMS), np.zeros((len(self.points), 2))
        return State(self.rig, np.zeros((0, 3, 3)), np.zeros((0, 3)), flat, offsets)

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
        # the same curvature energy of a field, and the same ridge, as on the adjustment's knots
        forms = [roughness(device.coefficients) for device in self.rig[:2]]
        camera, projector = (
            form + RIDGE * (cell_ratio**4 - 1) * np.eye(len(form)) for form in forms
        )
        of_camera, of_projector = (
            strength / device.size[0] ** 2 / cell_ratio**2
            for device, strength in zip(self.rig[:2], self.expected.strengths, strict=True)
        )
        prior = Prior(
            (camera, projector),
            offset_gauge(self.points),
            (of_camera, of_projector),
            self.features_per_point,
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
    sizes: tuple[tuple[int, int], tuple[int, int]],
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
    devices = (
        _calibrate_device(boards, seen, size) for seen, size in zip(images, sizes, strict=True)
    )
    (camera_lens, poses), (projector_lens, projector_poses) = devices
    if camera_lens is None or projector_lens is None:
        return None
    T = np.array(projector_poses) @ np.linalg.inv(poses)  # T_projector_camera by each pose
    t = np.median(T[:, :3, 3], axis=0)
    R = nearest_rotation(np.median(T[:, :3, :3], axis=0))
    rotation = np.median(rotation_angle(T[:, :3, :3] @ R.T))
    translation = np.median(lengths(T[:, :3, 3] - t)) / max(float(np.linalg.norm(t)), 1e-9)
    is_behind = any(pose[2, 3] <= 0 for pose in poses)
    if rotation > MAX_DISAGREEMENT[0] or translation > MAX_DISAGREEMENT[1] or is_behind:
        return None
    return StereoRig(camera_lens, projector_lens, R, t), poses


def _calibrate_device(
    points: Sequence[Floats], pixels: Sequence[np.ndarray], size: tuple[int, int]
) -> tuple[Lens | None, list[Floats]]:
    """Estimate a lens and T_device_board (4, 4) mm of each pose; None without a plausible
    solution."""
    flags = cv2.CALIB_FIX_K3 | cv2.CALIB_ZERO_TANGENT_DIST
    if len(points) < POSES_FOR_TWO_COEFFICIENTS:
        flags |= cv2.CALIB_FIX_K2
    try:
        _, K, D, rvecs, tvecs = cv2.calibrateCamera(
            points, pixels, size, np.eye(3), np.zeros(5), flags=flags
        )
    except cv2.error:
        return None, []
    focals = np.array([K[0, 0], K[1, 1] / 2]) / size[0]
    if not (np.isfinite(K).all() and (_FOCALS[0] < focals).all() and (focals < _FOCALS[1]).all()):
        return None, []
    poses = [transform_from_rvec(r, t) for r, t in zip(rvecs, tvecs, strict=True)]
    return Lens(K, np.ravel(D)[:5], size), poses
