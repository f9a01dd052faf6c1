"""A camera calibrated alone, from pictures of the board: pinhole and Brown, no projector."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from slviewer.calibration.centres import centroid_shifts
from slviewer.calibration.diagnosis.poses import FEW_POSES
from slviewer.calibration.diagnosis.spread_rules import HIGH_REPROJECTION_PX, MAX_FOCAL_UNCERTAINTY, MIN_TILT_DEG
from slviewer.calibration.diagnosis.verdict import Finding, Verdict
from slviewer.calibration.soundness import MIN_POSES
from slviewer.calibration.stereo import ITERATIONS, MAX_FOCAL_SIGMA
from slviewer.errors import CalibrationRejected
from slviewer.geometry.lens import Lens
from slviewer.target.board import Board
from slviewer.target.detect import Detection

MAX_ERROR_RATIO = 3.0
"""Times the usual reprojection error, from which a picture is named: it was blurred, or its board bent or moved."""


@dataclass(frozen=True, eq=False)
class CameraCalibration:
    """The ``lens``; ``rms_px``, the reprojection error of all pictures, and each picture's (lengths); standard
    deviations of fx and fy px; ``excluded`` pictures, and why; the verdict."""

    lens: Lens
    board: str
    rms_px: float
    picture_rms_px: Mapping[str, float]
    focal_sigma_px: tuple[float, float]
    excluded: Mapping[str, str]
    verdict: Verdict

    def to_json(self) -> dict[str, Any]:
        """The contract of ``calibrate --camera-only --json``."""
        return {
            "K_camera": self.lens.K.tolist(),
            "D_camera": self.lens.D.tolist(),
            "camera_size": list(self.lens.size),
            "reprojection_rms_px": self.rms_px,
            "focal_sigma_px": list(self.focal_sigma_px),
            "pictures": dict(self.picture_rms_px),
            "excluded": dict(self.excluded),
            "verdict": self.verdict.to_json(),
        }

    def text(self) -> str:
        """For people."""
        K, D, (width, height) = self.lens.K, self.lens.D, self.lens.size
        total = len(self.picture_rms_px) + len(self.excluded)
        return "\n".join(
            [
                f"pictures: {len(self.picture_rms_px)} of {total} used, {width}x{height} px",
                *(f"  excluded: {name}: {why}" for name, why in self.excluded.items()),
                f"camera: reprojection RMS {self.rms_px:.3f} px",
                f"  focal length {K[0, 0]:.1f} +- {self.focal_sigma_px[0]:.1f}, {K[1, 1]:.1f} +- "
                f"{self.focal_sigma_px[1]:.1f} px; principal point {K[0, 2]:.1f}, {K[1, 2]:.1f} px",
                "  distortion k1 k2 p1 p2 k3: " + ", ".join(f"{d:.5f}" for d in D),
                self.verdict.text(),
            ]
        )


def calibrate_camera(
    board: Board,
    detections: Mapping[str, Detection],
    size: tuple[int, int],
    excluded: Mapping[str, str] | None = None,
) -> CameraCalibration:
    """Pinhole and Brown (k1 k2 p1 p2 k3) from the board's features in pictures of ``size`` (width, height) px.

    Circles are corrected from the centroids of their images to their centres by a first calibration. ``excluded``:
    pictures without a board, and why. Raises CalibrationRejected for fewer than three pictures.
    """
    names = list(detections)
    if len(names) < MIN_POSES:
        why = "".join(f"; {name}: {reason}" for name, reason in (excluded or {}).items())
        raise CalibrationRejected(
            f"the board was detected in {len(names)} pictures, and at least {MIN_POSES} are needed{why}"
        )
    points = [board.points[detections[name].ids] for name in names]
    pixels = [np.asarray(detections[name].pixels, float) for name in names]
    found = _solve(points, pixels, size)
    radii = [detections[name].radius_mm for name in names]
    if any(radii):
        pixels = [
            seen - centroid_shifts(found[0], T, X, float(np.median(radii)))
            for seen, T, X in zip(pixels, found[1], points, strict=True)
        ]
        found = _solve(points, pixels, size)
    lens, poses, sigma = found
    residuals = [
        lens.project(X @ T[:3, :3].T + T[:3, 3]) - seen for X, T, seen in zip(points, poses, pixels, strict=True)
    ]
    rms = {name: _rms(r) for name, r in zip(names, residuals, strict=True)}
    whole = _rms(np.concatenate(residuals))
    verdict = _verdict(rms, whole, lens, poses, sigma)
    return CameraCalibration(lens, str(board), whole, rms, sigma, dict(excluded or {}), verdict)


def _solve(
    points: list[np.ndarray], pixels: list[np.ndarray], size: tuple[int, int]
) -> tuple[Lens, list[np.ndarray], tuple[float, float]]:
    """The lens, board poses (4, 4), and standard deviations of fx and fy px."""
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, ITERATIONS, 1e-9)
    objects, images = [p.astype(np.float32) for p in points], [p.astype(np.float32) for p in pixels]
    try:
        _, K, D, turns, shifts, deviations, _, _ = cv2.calibrateCameraExtended(
            objects, images, size, np.zeros((3, 3)), np.zeros(5), criteria=criteria
        )
    except cv2.error as error:
        raise CalibrationRejected(
            f"the camera's lens could not be solved from {len(points)} pictures: show the board in more positions and "
            f"tilts ({error.err})"
        ) from error
    poses = []
    for turn, shift in zip(turns, shifts, strict=True):
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = cv2.Rodrigues(np.array(turn))[0], np.array(shift).ravel()
        poses.append(T)
    fx, fy = (float(s) for s in deviations.ravel()[:2])
    return Lens(np.array(K), np.array(D).ravel()[:5], size), poses, (fx, fy)


def _verdict(
    rms: Mapping[str, float], whole: float, lens: Lens, poses: list[np.ndarray], sigma: tuple[float, float]
) -> Verdict:
    findings = []
    if len(rms) < FEW_POSES:
        findings.append(
            Finding("too-few-poses", "doubtful", f"{len(rms)} pictures", f"take {FEW_POSES} at least, better a dozen")
        )
    normals = np.array([T[:3, 2] for T in poses])
    spread = float(np.degrees(np.arccos(np.clip(normals @ normals.T, -1, 1).min())))
    if spread < MIN_TILT_DEG:
        findings.append(
            Finding(
                "parallel-poses",
                "doubtful",
                f"all boards are nearly parallel (tilts differ by {spread:.1f} degrees)",
                "tilt the board by 15 to 30 degrees, in different directions",
            )
        )
    share = max(sigma[0] / lens.K[0, 0], sigma[1] / lens.K[1, 1])
    if not share < MAX_FOCAL_UNCERTAINTY:
        findings.append(
            Finding(
                "uncertain",
                "rejected" if not share < MAX_FOCAL_SIGMA else "doubtful",
                f"the pictures leave the focal length uncertain by {100 * share:.1f} %",
                "tilt the board by 15 to 30 degrees in different directions, and vary its distance",
            )
        )
    if whole > HIGH_REPROJECTION_PX:
        findings.append(
            Finding(
                "residuals",
                "doubtful",
                f"the reprojection error is {whole:.1f} px",
                "see that the board is flat, in focus and held still, and that its notation is right",
            )
        )
    usual = float(np.median(list(rms.values())))
    bad = tuple(name for name, px in rms.items() if px > max(MAX_ERROR_RATIO * usual, 0.1))
    if bad:
        findings.append(
            Finding(
                "outlier",
                "doubtful",
                f"in {', '.join(bad)} the reprojection error is more than {MAX_ERROR_RATIO:g} times the usual "
                f"{usual:.2f} px",
                "check these pictures, and calibrate again with --exclude",
                bad,
            )
        )
    return Verdict.of(findings)


def _rms(residuals: np.ndarray) -> float:
    """Root mean square length."""
    return float(np.sqrt(np.mean(np.sum(residuals**2, axis=1))))
