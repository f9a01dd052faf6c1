"""A camera calibrated alone, from pictures of the board: pinhole and Brown, no projector."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from slviewer.calibration.board_pose import measure_focal_spread, solve_device
from slviewer.calibration.centres import centroid_shifts
from slviewer.calibration.diagnosis.rules import (
    FEW_POSES,
    HIGH_REPROJECTION_PX,
    MIN_TILT_DEG,
    describe_constant_pixels,
)
from slviewer.calibration.known_camera import MAX_FOCAL_UNCERTAINTY
from slviewer.calibration.squareness import judge_squareness, measure_squareness
from slviewer.calibration.stereo import MAX_FOCAL_SIGMA, check_pose_count
from slviewer.fringe.sequence import Size
from slviewer.geometry.lens import Lens
from slviewer.geometry.rigid import Floats, largest_angle_deg, move_points
from slviewer.geometry.vectors import rms_length
from slviewer.records.verdict import Finding, Verdict
from slviewer.target.board import Board, Detection

MAX_ERROR_RATIO = 3.0
"""Times the usual reprojection error, from which a picture is named: it was blurred, or its board
bent or moved."""


@dataclass(frozen=True, eq=False)
class CameraCalibration:
    """A calibrated camera, its reprojection errors, and a verdict on it.

    ``rms_px``: reprojection error of all pictures together, ``picture_rms_px`` of each one (RMS
    length of the residuals), ``features`` how many of the board's each one shows.
    ``focal_sigma_px``: standard deviations of fx and fy, by the residuals
    or by leaving pictures out, whichever is larger. ``excluded``:
    pictures not used, with the reason.
    """

    lens: Lens
    board: str
    rms_px: float
    picture_rms_px: Mapping[str, float]
    features: Mapping[str, int]
    focal_sigma_px: tuple[float, float]
    excluded: Mapping[str, str]
    verdict: Verdict

    def to_json(self) -> dict[str, Any]:
        """Return the plain values that ``calibrate --camera-only --json`` prints."""
        return {
            "K_camera": self.lens.K.tolist(),
            "D_camera": self.lens.D.tolist(),
            "camera_size": list(self.lens.size),
            "reprojection_rms_px": self.rms_px,
            "focal_sigma_px": list(self.focal_sigma_px),
            "pictures": dict(self.picture_rms_px),
            "features": dict(self.features),
            "excluded": dict(self.excluded),
            "verdict": self.verdict,
        }

    def text(self) -> str:
        """Return a report of several lines for the terminal."""
        K, D, (width, height) = self.lens.K, self.lens.D, self.lens.size
        total = len(self.picture_rms_px) + len(self.excluded)
        seen, on_board = [*self.features.values()], len(Board.parse(self.board).points)
        return "\n".join(
            [
                self.verdict.text(),
                f"pictures: {len(self.picture_rms_px)} of {total} used, {width}x{height} px",
                f"  the board's {on_board} features: {min(seen)} to {max(seen)} seen in a picture",
                *(f"  excluded: {name}: {why}" for name, why in self.excluded.items()),
                f"camera: reprojection RMS {self.rms_px:.3f} px",
                (
                    f"  focal length {K[0, 0]:.1f} +- {self.focal_sigma_px[0]:.1f}, {K[1, 1]:.1f}"
                    f" +- {self.focal_sigma_px[1]:.1f} px; principal point {K[0, 2]:.1f},"
                    f" {K[1, 2]:.1f} px"
                ),
                "  distortion k1 k2 p1 p2 k3: " + ", ".join(f"{d:.5f}" for d in D),
            ]
        )


def calibrate_camera(
    board: Board,
    detections: Mapping[str, Detection],
    size: Size,
    excluded: Mapping[str, str] | None = None,
    constant: str = "",
) -> CameraCalibration:
    """Calibrate a pinhole camera with Brown distortion (k1 k2 p1 p2 k3) from pictures of a board.

    ``detections``: the board's features by picture name; ``size``: (width, height) px of every
    picture. The images of circles are corrected from centroid to centre by a first calibration.
    ``excluded``: pictures without a board, with the reason; ``constant``: what never changes in the
    pictures. Raises CalibrationRejected for fewer
    than three pictures.
    """
    check_pose_count(len(detections), excluded or {})
    points = [board.points[each.ids] for each in detections.values()]
    pixels = [each.pixels for each in detections.values()]
    solved = solve_device("camera", points, pixels, size)
    radii = [each.radius_mm for each in detections.values()]
    if any(radii):
        pixels = [
            centroids - centroid_shifts(solved.lens, T, X, float(np.median(radii)))
            for centroids, T, X in zip(pixels, solved.poses, points, strict=True)
        ]
        solved = solve_device("camera", points, pixels, size)
    lens, poses = solved.lens, solved.poses
    spread = measure_focal_spread(points, pixels, lens)
    fx, fy = np.maximum(solved.focal_sigma_px, spread * np.diag(lens.K)[:2]).tolist()
    residuals = [
        lens.project(move_points(T, X)) - measured
        for X, T, measured in zip(points, poses, pixels, strict=True)
    ]
    picture_rms = {name: rms_length(r) for name, r in zip(detections, residuals, strict=True)}
    unjudged = CameraCalibration(
        lens,
        str(board),
        rms_length(np.concatenate(residuals)),
        picture_rms,
        {name: len(each.ids) for name, each in detections.items()},
        (fx, fy),
        dict(excluded or {}),
        Verdict(),
    )
    squareness = measure_squareness(lens, poses, points, pixels)
    findings = [*_judge_camera(unjudged, poses), *judge_squareness(str(board), squareness)]
    if constant:
        findings.append(describe_constant_pixels(constant))
    return replace(unjudged, verdict=Verdict.of(findings))


def _judge_camera(solved: CameraCalibration, poses: list[Floats]) -> Iterator[Finding]:
    """Judge a camera calibration by its number of pictures, their tilts, and the reprojection
    errors."""
    pictures = solved.picture_rms_px
    if len(pictures) < FEW_POSES:
        yield Finding(
            "too-few-poses",
            "doubtful",
            f"{len(pictures)} pictures",
            f"take {FEW_POSES} at least, better a dozen",
        )
    spread = largest_angle_deg(np.array([T[:3, 2] for T in poses]))
    if spread < MIN_TILT_DEG:
        yield Finding(
            "parallel-poses",
            "doubtful",
            f"all boards are nearly parallel (tilts differ by {spread:.1f} degrees)",
            "tilt the board by 15 to 30 degrees, in different directions",
        )
    relative_sigma = (np.array(solved.focal_sigma_px) / np.diag(solved.lens.K)[:2]).max()
    if not relative_sigma < MAX_FOCAL_UNCERTAINTY:
        yield Finding(
            "uncertain",
            "rejected" if not relative_sigma < MAX_FOCAL_SIGMA else "doubtful",
            f"the pictures leave the focal length uncertain by {100 * relative_sigma:.1f} %",
            "tilt the board by 15 to 30 degrees in different directions, and vary its distance",
        )
    if solved.rms_px > HIGH_REPROJECTION_PX:
        yield Finding(
            "residuals",
            "doubtful",
            f"the reprojection error is {solved.rms_px:.1f} px",
            "see that the board is flat, in focus and held still, and that its notation is right",
        )
    usual_px = float(np.median([*pictures.values()]))
    limit_px = max(MAX_ERROR_RATIO * usual_px, 0.1)
    outliers = tuple(name for name, px in pictures.items() if px > limit_px)
    if outliers:
        yield Finding(
            "outlier",
            "doubtful",
            f"in {', '.join(outliers)} the reprojection error is more than {MAX_ERROR_RATIO:g}"
            f" times the usual {usual_px:.2f} px",
            "check these pictures, and calibrate again with --exclude",
            outliers,
        )
