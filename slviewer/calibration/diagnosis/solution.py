"""Evidence from a stereo calibration: excluded poses, uncertainties, tilts, and coverage of the
image's corners."""

from collections.abc import Sequence

import numpy as np

from slviewer.calibration.board_pose import solve_pose
from slviewer.calibration.diagnosis.evidence import ExcludedPose, SolutionEvidence
from slviewer.calibration.diagnosis.ripple import measure_ripple
from slviewer.calibration.observe import Observation
from slviewer.calibration.stereo import StereoModel
from slviewer.geometry.polynomial import grid_points
from slviewer.geometry.rigid import largest_angle_deg, move_points
from slviewer.geometry.vectors import finite_rows

CORNERS = {"top left": (0, 0), "top right": (1, 0), "bottom left": (0, 1), "bottom right": (1, 1)}
CORNER_SHARE = (1 / 4, 1 / 3)
"""Width and height of a corner region, over those of the image."""
ILLUMINATED_SHARE = 0.6
"""Least illuminated share of a corner for poses to be requested there."""
EMPTY_SHARE = 0.3
"""A corner is empty where the poses cover less than this share of its illuminated part."""
_GRID = 12  # test pixels along each side of a corner


def measure_solution(observations: Sequence[Observation], stereo: StereoModel) -> SolutionEvidence:
    """Measure the evidence of a stereo calibration; ``observations``: all, those that the fit
    excluded too."""
    used = [o for o in observations if o.name in stereo.poses]
    (fx, fy), (projector_fx, projector_fy) = (
        np.diag(lens.K)[:2].tolist() for lens in (stereo.rig.camera, stereo.rig.projector)
    )
    normals = np.array([T[:3, 2] * np.sign(T[2, 2] or 1) for T in stereo.poses.values()])
    camera, projector = np.array([stereo.pose_rms_px[o.name] for o in used]).T
    return SolutionEvidence(
        used=tuple(stereo.poses),
        excluded={
            o.name: measure_excluded(o, stereo) for o in observations if o.name not in stereo.poses
        },
        reprojection_px=stereo.reprojection_rms_px["stereo"],
        median_pose_rms_px=(float(np.median(camera)), float(np.median(projector))),
        focal_sigma={
            "camera": stereo.focal_sigma_px["camera"] / min(fx, fy),
            "projector": stereo.focal_sigma_px["projector"] / min(projector_fx, projector_fy),
        },
        tilt_spread_deg=largest_angle_deg(normals),
        empty_corners=list_empty_corners(used, stereo),
        aspects=(fy / fx, projector_fy / projector_fx),
        ripple=measure_ripple(used, stereo),
    )


def measure_excluded(observation: Observation, stereo: StereoModel) -> ExcludedPose:
    """Measure the residuals of an excluded pose under the calibration; inf where its pose cannot be
    solved."""
    camera = stereo.rig.camera
    detected = finite_rows(observation.camera)
    T = None
    if np.count_nonzero(detected) >= 6:
        T = solve_pose(
            observation.points[detected], observation.camera[detected], camera.K, camera.D
        )
    if T is None:
        return ExcludedPose(np.inf, np.inf)
    X = move_points(T, observation.points)
    residuals = (
        camera.project(X) - observation.camera,
        stereo.rig.project(X) - observation.projector,
    )
    return ExcludedPose(*map(_trimmed_rms, residuals))


def list_empty_corners(observations: Sequence[Observation], stereo: StereoModel) -> tuple[str, ...]:
    """List the corners of the image that no board covers, among those illuminated at the boards'
    depths."""
    width, height = stereo.rig.camera.size
    if stereo.depth_range_mm is None:
        return ()
    empty = []
    for name, (right, bottom) in CORNERS.items():
        along = [
            (np.arange(_GRID) + 0.5) / _GRID * share * size + side * (1 - share) * size
            for share, size, side in zip(
                CORNER_SHARE, (width, height), (right, bottom), strict=True
            )
        ]
        pixels = grid_points(*along)
        illuminated = _is_illuminated(pixels, stereo)
        if illuminated.mean() < ILLUMINATED_SHARE:
            continue
        covered = np.zeros(len(pixels), bool)
        for o in observations:
            covered |= _is_covered(o, pixels)
        if covered[illuminated].mean() < EMPTY_SHARE:
            empty.append(name)
    return tuple(empty)


def _is_illuminated(pixels: np.ndarray, stereo: StereoModel) -> np.ndarray:
    """(n,) bool: camera pixels (n, 2) on whose rays the projector illuminates two of three of the
    boards' depths."""
    near, far = stereo.depth_range_mm or (0.0, 0.0)
    rays = stereo.rig.camera.undistort(pixels)
    inside = []
    for z in (near, (near + far) / 2, far):
        projected = stereo.rig.project(np.column_stack([rays * z, np.full(len(rays), z)]))
        inside.append(stereo.rig.projector.contains(projected))
    return np.sum(inside, axis=0) >= 2


def _is_covered(observation: Observation, pixels: np.ndarray) -> np.ndarray:
    """(n,) bool: camera pixels (n, 2) inside the measured region of an observation."""
    u0, v0, u1, v1 = observation.box
    u, v = np.rint(pixels).astype(int).T
    inside = (u >= u0) & (u < u1) & (v >= v0) & (v < v1)
    covered = np.zeros(len(pixels), bool)
    covered[inside] = observation.region[v[inside] - v0, u[inside] - u0]
    return covered


def _trimmed_rms(residuals: np.ndarray) -> float:
    """RMS length of the smaller 90 % of residuals (n, 2), as single features may be wrong; inf
    without finite ones."""
    squares = np.sort(np.sum(residuals**2, axis=1))
    squares = squares[np.isfinite(squares)]
    trimmed = squares[: max(1, int(0.9 * len(squares)))]
    return float(np.sqrt(trimmed.mean())) if len(trimmed) else np.inf
