"""Approximate rig from few poses, and the coarse model with which guidance predicts visibility and
information."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from slviewer.calibration.splined.board_shape import HEIGHT_TERMS, board_frame, offset_gauge
from slviewer.calibration.splined.fields import CELLS_ACROSS, RIDGE, Device, roughness
from slviewer.calibration.splined.prior import Prior
from slviewer.calibration.splined.unknowns import Arrangement, State, UnknownLayout
from slviewer.geometry.lens import Lens
from slviewer.geometry.polynomial import grid_points
from slviewer.geometry.rig import StereoRig
from slviewer.geometry.rigid import (
    Floats,
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

    def with_noise(self, samples: np.ndarray) -> "ExpectedNoise":
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
        camera, projector = (
            _coarse_device(lens) for lens in (self.stereo.camera, self.stereo.projector)
        )
        return Arrangement(camera, projector, np.array(self.stereo.R), np.array(self.stereo.t))

    @cached_property
    def points(self) -> np.ndarray:
        """(f, 3) mm: features that represent all those of the board."""
        low, high = self.board.points.min(0), self.board.points.max(0)
        grid = grid_points(*(np.linspace(low[k], high[k], n) for k, n in enumerate(FEATURES)))
        nearest = np.argmin(lengths(self.board.points[None, :, :2] - grid[:, None]), axis=1)
        return np.ascontiguousarray(self.board.points[np.unique(nearest)])

    @cached_property
    def frame(self) -> np.ndarray:
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
        shares = [(np.arange(n) + 0.5) / n for n in SAMPLES]
        grid = grid_points(
            *(outline[0, k] + share * np.ptp(outline[:, k]) for k, share in enumerate(shares))
        )
        pixels, visible = self._project(T_camera_board, np.pad(grid, ((0, 0), (0, 1))), 0)
        return [p[v] for p, v in zip(pixels, visible, strict=True)]

    def is_visible(self, T_camera_board: Floats) -> NDArray[np.bool_]:
        """(k,) bool: poses (k, 4, 4) mm at which both devices see every feature of the board, with
        a margin."""
        margin = 0.25 * self.board.pitch_mm if self.board.kind in ("circles", "acircles") else None
        return np.asarray(
            self._project(T_camera_board, self.board.outline(margin), MARGIN)[1].all(1)
        )

    def _project(
        self, T_camera_board: Floats, points: Floats, margin: float
    ) -> tuple[Floats, NDArray[np.bool_]]:
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
        forms, strengths = [], []
        for device, strength in zip(self.rig[:2], self.expected.strengths, strict=True):
            # the same curvature energy of a field, and the same ridge, as on the adjustment's knots
            form = roughness(device.coefficients)
            forms.append(form + RIDGE * (cell_ratio**4 - 1) * np.eye(len(form)))
            strengths.append(strength / device.size[0] ** 2 / cell_ratio**2)
        prior = Prior((forms[0], forms[1]), offset_gauge(self.points), self.features_per_point)
        prior.add(A, np.zeros(at.size), self.state, strengths)
        rig = np.arange(at.rig, at.camera_field)
        A[rig, rig] += self._weak_prior_sigmas() ** -2.0
        return A

    def _weak_prior_sigmas(self) -> Floats:
        """(24,): wide prior standard deviations of both lenses, rotation (rad) and translation
        (mm)."""
        lens = [
            np.concatenate(
                [np.repeat(0.3 * K[[0, 1], [0, 1]].mean(), 4), [0.5, 0.5, 0.02, 0.02, 2.0]]
            )
            for K in (self.stereo.camera.K, self.stereo.projector.K)
        ]
        return np.concatenate([*lens, [0.3] * 3, [300.0] * 3])


def _coarse_device(lens: Lens) -> Device:
    """Return a device with the lens's parameters and a zero displacement field on coarse knots."""
    width, height = lens.size
    down = int(np.clip(round(COARSE_CELLS * height / width), 4, 2 * COARSE_CELLS))
    return Device(
        lens.parameters, np.zeros((2, down + 3, COARSE_CELLS + 3)), np.array(lens.size, float)
    )


def estimate_rig(
    points: Sequence[np.ndarray],
    camera: Sequence[np.ndarray],
    projector: Sequence[np.ndarray],
    sizes: tuple[tuple[int, int], tuple[int, int]],
) -> tuple[StereoRig, list[Floats]] | None:
    """Estimate an approximate rig and T_camera_board (4, 4) mm of every pose; None where the poses
    do not determine it.

    Of each pose: ``points`` (n, 3) mm on the board, and their ``camera`` and ``projector`` pixels
    (n, 2), NaN where unknown. ``sizes``: (width, height) px of camera and projector.
    """
    features = [_select_features(*each) for each in zip(points, camera, projector, strict=True)]
    if len(features) < MIN_POSES or any(len(each[0]) < MIN_FEATURES for each in features):
        return None
    boards, *images = zip(*features, strict=True)
    devices = [
        _calibrate_device(boards, seen, size) for seen, size in zip(images, sizes, strict=True)
    ]
    if devices[0] is None or devices[1] is None:
        return None
    lenses, poses = zip(*devices, strict=True)
    T = np.array(poses[1]) @ np.linalg.inv(poses[0])  # T_projector_camera by each pose
    t = np.median(T[:, :3, 3], axis=0)
    R = nearest_rotation(np.median(T[:, :3, :3], axis=0))
    rotation = np.median(rotation_angle(T[:, :3, :3] @ R.T))
    translation = np.median(lengths(T[:, :3, 3] - t)) / max(float(np.linalg.norm(t)), 1e-9)
    is_behind = any(pose[2, 3] <= 0 for pose in poses[0])
    if rotation > MAX_DISAGREEMENT[0] or translation > MAX_DISAGREEMENT[1] or is_behind:
        return None
    return StereoRig(lenses[0], lenses[1], R, t), poses[0]


def _select_features(
    points: np.ndarray, camera: np.ndarray, projector: np.ndarray
) -> list[NDArray[np.float32]]:
    """Return at most MAX_FEATURES of a pose's points and pixels (k, ...) float32, of those that
    both devices see."""
    known = np.nonzero(finite_rows(camera, projector))[0]
    if len(known):
        known = known[np.unique(np.linspace(0, len(known) - 1, MAX_FEATURES).astype(int))]
    return [np.ascontiguousarray(each[known], np.float32) for each in (points, camera, projector)]


def _calibrate_device(
    points: Sequence[np.ndarray], pixels: Sequence[np.ndarray], size: tuple[int, int]
) -> tuple[Lens, list[Floats]] | None:
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
        return None
    if not (
        np.isfinite(K).all()
        and all(_FOCALS[0] < f / size[0] < _FOCALS[1] for f in (K[0, 0], K[1, 1] / 2))
    ):
        return None
    return Lens(K, np.ravel(D)[:5], size), [
        transform_from_rvec(r, t) for r, t in zip(rvecs, tvecs, strict=True)
    ]
