"""Coarse model of the rig for guidance: lenses without local distortion, and the observations of a board in it."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from slviewer.calibration.guidance.information_rows import pose_rows
from slviewer.calibration.splined.board_shape import (
    GAUGE_MM,
    HEIGHT_SIGMA_MM,
    HEIGHT_TERMS,
    OFFSET_SIGMA_MM,
    board_frame,
    offset_gauge,
)
from slviewer.calibration.splined.fields import CELLS_ACROSS, RIDGE, Device, roughness
from slviewer.calibration.splined.unknowns import LENS, RIG, Arrangement, UnknownLayout
from slviewer.geometry.lens import Lens
from slviewer.geometry.rig import StereoRig
from slviewer.target.board import Board

COARSE_CELLS = 10
"""Cells across an image: half the wavelength of what guidance must tell apart, and a third of the adjustment's time a
pose."""
FEATURES, SAMPLES = (5, 4), (9, 7)
"""Places along and across a board that stand for all its features, and for all its bright pixels."""
BOARD_SAMPLES = 4000
"""Bright places that a pose is read at."""
MARGIN = 0.006
"""Of the image's width, left free around the outermost features."""


@dataclass(frozen=True)
class ExpectedNoise:
    """Standard deviations before a joint adjustment has measured them, and how far lenses depart from Brown's.

    ``feature`` and ``sample``: of a coordinate, in widths of the image; ``strengths``: of the two priors at the
    adjustment's own knots, for displacements in widths of the image.
    """

    feature: float = 2.5e-5
    sample: float = 1.5e-5
    strengths: tuple[float, float] = (4e8, 2e8)

    def with_noise(self, samples: np.ndarray) -> "ExpectedNoise":
        """What is expected where samples' noise is known of some poses (n,), in widths of the projector's image; NaN:
        not of this one. What makes phases noisy makes features so too; little noise of phases says nothing of them.
        """
        if not np.isfinite(samples).any():
            return self
        seen = float(np.nanmedian(samples))
        return replace(self, sample=seen, feature=self.feature * max(seen / self.sample, 1.0))


@dataclass(frozen=True, eq=False)
class GuidanceBench:
    """One rig and one board, as far as they are known."""

    stereo: StereoRig
    board: Board
    expected: ExpectedNoise = ExpectedNoise()

    @cached_property
    def rig(self) -> Arrangement:
        """Both devices without displacement, on coarse knots."""
        camera, projector = (_coarse_device(lens) for lens in (self.stereo.camera, self.stereo.projector))
        return Arrangement(camera, projector, np.array(self.stereo.R), np.array(self.stereo.t))

    @cached_property
    def points(self) -> np.ndarray:
        """(f, 3) mm: features that stand for all."""
        low, high = self.board.points.min(0), self.board.points.max(0)
        x, y = np.meshgrid(*(np.linspace(low[k], high[k], n) for k, n in enumerate(FEATURES)))
        places = np.column_stack([x.ravel(), y.ravel()])
        nearest = np.argmin(np.linalg.norm(self.board.points[None, :, :2] - places[:, None], axis=2), axis=1)
        return np.ascontiguousarray(self.board.points[np.unique(nearest)])

    @cached_property
    def frame(self) -> np.ndarray:
        return board_frame(self.board.points)

    @cached_property
    def layout(self) -> UnknownLayout:
        knots = [device.coefficients[0].size for device in (self.rig.camera, self.rig.projector)]
        return UnknownLayout(0, len(self.points), knots[0], knots[1])

    @property
    def features_per_point(self) -> float:
        """Features that each of ``points`` stands for."""
        return len(self.board.points) / len(self.points)

    def rows(self, T_camera_board: np.ndarray) -> list[np.ndarray]:
        """(rows, unknowns) for each of the poses (k, 4, 4): what the board tells there; see ``pose_rows``."""
        width = self.stereo.camera.size[0], self.stereo.projector.size[0]
        feature = self.expected.feature * width[0] / np.sqrt(self.features_per_point)
        told = []
        for T, pixels in zip(T_camera_board, self._pixels(T_camera_board), strict=True):
            sample = self.expected.sample * width[1] / np.sqrt(BOARD_SAMPLES / max(len(pixels), 1))
            told.append(pose_rows(self.rig, self.layout, T, self.points, self.frame, pixels, (feature, sample)))
        return told

    def _pixels(self, T: np.ndarray) -> list[np.ndarray]:
        """(m, 2) for each pose: camera pixels at regular places of the board that camera and projector both see."""
        outline = self.board.outline()
        middles = [(np.arange(n) + 0.5) / n for n in SAMPLES]
        x, y = np.meshgrid(*(outline[0, k] + m * np.ptp(outline[:, k]) for k, m in enumerate(middles)))
        places = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
        points = np.einsum("kij,nj->kni", T[:, :3, :3], places) + T[:, None, :3, 3]
        pixels = self.stereo.camera.project(points)
        seen = _is_inside(pixels, self.stereo.camera, 0) & _is_inside(
            self.stereo.project(points), self.stereo.projector, 0
        )
        return [p[s] for p, s in zip(pixels, seen, strict=True)]

    def in_view(self, T: np.ndarray) -> np.ndarray:
        """(k,) bool: poses T (k, 4, 4) at which both devices see every feature, with some margin."""
        margin = 0.25 * self.board.pitch_mm if self.board.kind in ("circles", "acircles") else None
        corners = self.board.outline(margin)
        points = np.einsum("kij,nj->kni", T[:, :3, :3], corners) + T[:, None, :3, 3]
        here, there = self.stereo.camera.project(points), self.stereo.project(points)
        seen = _is_inside(here, self.stereo.camera, MARGIN) & _is_inside(there, self.stereo.projector, MARGIN)
        return np.asarray(seen.all(1))

    def prior(self) -> np.ndarray:
        """(unknowns, unknowns): the information there is before any pose."""
        at = self.layout
        A = np.zeros((at.size, at.size))
        diagonal = np.arange(at.size)
        A[diagonal[:HEIGHT_TERMS], diagonal[:HEIGHT_TERMS]] = HEIGHT_SIGMA_MM**-2.0
        offsets = slice(at.offsets, at.rig)
        each = np.eye(at.rig - at.offsets) * self.features_per_point / OFFSET_SIGMA_MM**2
        gauge = offset_gauge(self.points)
        A[offsets, offsets] = each + gauge.T @ gauge / GAUGE_MM**2
        A[diagonal[at.rig : at.camera_field], diagonal[at.rig : at.camera_field]] = self._weak_prior_sigmas() ** -2.0
        widths = self.stereo.camera.size[0], self.stereo.projector.size[0]
        starts = at.camera_field, at.projector_field
        for device, start, strength, width in zip(self.rig[:2], starts, self.expected.strengths, widths, strict=True):
            n = device.coefficients[0].size
            # the same energy of a field's curvature, and the same ridge, on other knots
            grown = CELLS_ACROSS / COARSE_CELLS
            form = roughness(device.coefficients) + RIDGE * (grown**4 - 1) * np.eye(n)
            for k in range(2):
                block = slice(start + k * n, start + (k + 1) * n)
                A[block, block] = strength / width**2 / grown**2 * form
        return A

    def _weak_prior_sigmas(self) -> np.ndarray:
        """(24,): standard deviations of the rig's numbers that hold what few poses leave open."""
        lens = [
            np.concatenate([np.repeat(0.3 * K[[0, 1], [0, 1]].mean(), 4), [0.5, 0.5, 0.02, 0.02, 2.0]])
            for K in (self.stereo.camera.K, self.stereo.projector.K)
        ]
        wide = np.concatenate([*lens, [0.3] * 3, [300.0] * 3])
        assert len(wide) == RIG == 2 * LENS + 6
        return wide


def _coarse_device(lens: Lens) -> Device:
    width, height = lens.size
    down = int(np.clip(round(COARSE_CELLS * height / width), 4, 2 * COARSE_CELLS))
    return Device(lens.parameters, np.zeros((2, down + 3, COARSE_CELLS + 3)), np.array(lens.size, float))


def _is_inside(pixels: np.ndarray, lens: Lens, free: float) -> np.ndarray:
    """(...) bool: of pixels (..., 2); NaN is not."""
    room = free * lens.size[0]
    with np.errstate(invalid="ignore"):
        return np.asarray(((pixels > room - 0.5) & (pixels < np.array(lens.size) - 0.5 - room)).all(-1))
