"""Evidence of a stereo calibration and of the poses it excluded."""

from collections.abc import Sequence

import cv2
import numpy as np

from slviewer.calibration.diagnosis.evidence import ExcludedPose, SolutionEvidence
from slviewer.calibration.diagnosis.ripple import measure_ripple
from slviewer.calibration.observe import Observation
from slviewer.calibration.stereo import StereoModel

CORNERS = {"top left": (0, 0), "top right": (1, 0), "bottom left": (0, 1), "bottom right": (1, 1)}
CORNER_SHARE = (1 / 4, 1 / 3)
"""Of the image's width and height, that a corner takes up."""
ILLUMINATED_SHARE = 0.6
"""Share of a corner that the projector must reach for poses to be requested there."""
EMPTY_SHARE = 0.3
"""A corner of which the poses cover less than so much of what the projector reaches is empty."""
_GRID = 12  # places along each side of a corner that are examined


def measure_solution(observations: Sequence[Observation], stereo: StereoModel) -> SolutionEvidence:
    """``observations``: all that the fit was given, those that it excluded included."""
    used = [o for o in observations if o.name in stereo.poses]
    K = stereo.rig.projector.K
    width, height = stereo.rig.projector.size
    normals = np.array([T[:3, 2] * np.sign(T[2, 2] or 1) for T in stereo.poses.values()])
    cosines = np.clip(normals @ normals.T, -1, 1)
    camera, projector = np.array([stereo.pose_rms_px[o.name] for o in used]).T
    return SolutionEvidence(
        used=tuple(stereo.poses),
        strayed={o.name: measure_excluded(o, stereo) for o in observations if o.name not in stereo.poses},
        reprojection_px=stereo.reprojection_rms_px["stereo"],
        usual_px=(float(np.median(camera)), float(np.median(projector))),
        focal_sigma={
            "camera": stereo.focal_sigma_px["camera"] / float(min(np.diag(stereo.rig.camera.K)[:2])),
            "projector": stereo.focal_sigma_px["projector"] / float(min(np.diag(K)[:2])),
        },
        tilt_spread_deg=float(np.degrees(np.arccos(cosines.min()))),
        empty_corners=find_empty_corners(used, stereo),
        aspect=float(K[1, 1] / K[0, 0]),
        centre_off=(float(K[0, 2] / (width - 1) - 0.5), float(K[1, 2] / (height - 1) - 0.5)),
        ripple=measure_ripple(used, stereo),
    )


def measure_excluded(observation: Observation, stereo: StereoModel) -> ExcludedPose:
    """Residuals of an excluded pose under the calibration from the others; inf where its pose cannot be solved."""
    camera = stereo.rig.camera
    seen = np.isfinite(observation.camera).all(1)
    if np.count_nonzero(seen) < 6:
        return ExcludedPose(np.inf, np.inf)
    found, rotation, t = cv2.solvePnP(
        observation.points[seen], observation.camera[seen], camera.K, camera.D, flags=cv2.SOLVEPNP_ITERATIVE
    )
    if not found:
        return ExcludedPose(np.inf, np.inf)
    X = observation.points @ cv2.Rodrigues(rotation)[0].T + t.ravel()
    misfits = camera.project(X) - observation.camera, stereo.rig.project(X) - observation.projector
    return ExcludedPose(*map(_rms, misfits))


def find_empty_corners(observations: Sequence[Observation], stereo: StereoModel) -> tuple[str, ...]:
    """The corners of the image that no board reached, of those that the projector lights at the boards' depths."""
    width, height = stereo.rig.camera.size
    if stereo.depth_range_mm is None:
        return ()
    empty = []
    for name, (right, bottom) in CORNERS.items():
        along = [
            (np.arange(_GRID) + 0.5) / _GRID * share * size + side * (1 - share) * size
            for share, size, side in zip(CORNER_SHARE, (width, height), (right, bottom), strict=True)
        ]
        pixels = np.stack(np.meshgrid(*along), axis=-1).reshape(-1, 2)
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
    """(n,) bool: whether the projector reaches what the camera's pixels see, at most of the boards' depths."""
    near, far = stereo.depth_range_mm or (0.0, 0.0)
    rays = stereo.rig.camera.undistort(pixels)
    size = np.array(stereo.rig.projector.size)
    reached = []
    for z in (near, (near + far) / 2, far):
        seen = stereo.rig.project(np.column_stack([rays * z, np.full(len(rays), z)]))
        with np.errstate(invalid="ignore"):
            reached.append(((seen > -0.5) & (seen < size - 0.5)).all(1))
    return np.asarray(np.sum(reached, axis=0) >= 2)


def _is_covered(observation: Observation, pixels: np.ndarray) -> np.ndarray:
    u0, v0, u1, v1 = observation.box
    u, v = np.rint(pixels).astype(int).T
    inside = (u >= u0) & (u < u1) & (v >= v0) & (v < v1)
    covered = np.zeros(len(pixels), bool)
    covered[inside] = observation.region[v[inside] - v0, u[inside] - u0]
    return covered


def _rms(residuals: np.ndarray) -> float:
    """Root mean square length, of the better nine tenths: some features may be wrong where a board is right."""
    squares = np.sort(np.sum(residuals**2, axis=1))
    squares = squares[np.isfinite(squares)]
    kept = squares[: max(1, int(0.9 * len(squares)))]
    return float(np.sqrt(kept.mean())) if len(kept) else np.inf
