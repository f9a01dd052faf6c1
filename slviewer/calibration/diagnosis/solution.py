"""Evidence from a stereo calibration: excluded poses, uncertainties, tilts, coverage of the image's
corners, and ripple.

Ripple are phase errors that repeat with the fringe, as of a non-linear response or of flicker. A
response that is not linear puts harmonics h into the fringe, and n phase steps read those with h
= k n +- 1 as an error of the phase with n k waves a period (Guo, He and Zhang, Opt. Lasers Eng. 43,
2005). Light that changes between the frames leaves one or two waves a period. A lens bends neither.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from slviewer.calibration.board_pose import intersect_board, solve_pose
from slviewer.calibration.diagnosis.evidence import ExcludedPose, Ripple, SolutionEvidence
from slviewer.calibration.observe import AXES, Observation, Samples, combine_observed
from slviewer.calibration.pixelwise import list_twins
from slviewer.calibration.squareness import Squareness, measure_skew, measure_squareness
from slviewer.calibration.stereo import DEVICES, StereoModel
from slviewer.errors import CalibrationRejected
from slviewer.fringe.image_area import ImageArea
from slviewer.fringe.sequence import Axis
from slviewer.geometry.polynomial import fit_polynomial, fit_slopes, grid_points
from slviewer.geometry.rigid import Floats, Mask, largest_angle_deg, move_points
from slviewer.geometry.robust import robust_sigma
from slviewer.geometry.vectors import finite_rows, lengths, rms

CORNERS = {"top left": (0, 0), "top right": (1, 0), "bottom left": (0, 1), "bottom right": (1, 1)}
CORNER_SHARE = (1 / 4, 1 / 3)
"""Width and height of a corner region, over those of the part of the image that changes."""
ILLUMINATED_SHARE = 0.6
"""Least illuminated share of a corner for poses to be requested there."""
EMPTY_SHARE = 0.3
"""A corner is empty where the poses cover less than this share of its illuminated part."""
SKEWED_PX = 0.3
"""Reprojection error of the projector above which its rows and columns may be other than at right
angles: half a degree of that over 900 px leaves 0.6."""
_GRID = 12  # test pixels along each side of a corner
MAX_WAVES = 8
"""Largest number of waves per fringe period that is fitted."""
DEGREE = 6
"""Degree of the polynomial in camera pixels that removes lens distortion from a pose's
residuals."""
OUTLIER_SIGMAS = 5.0
MIN_SAMPLES = 500
MIN_RESPONSE = 0.15
"""Waves that the mean over a sample's block attenuates to less than this share of their amplitude
are not fitted."""


def measure_solution(observations: Sequence[Observation], stereo: StereoModel) -> SolutionEvidence:
    """Measure the evidence of a stereo calibration; ``observations``: all, those that the fit
    excluded too."""
    used = [o for o in observations if o.name in stereo.poses]
    area = combine_observed(observations)
    focal = [np.diag(lens.K)[:2] for lens in (stereo.rig.camera, stereo.rig.projector)]
    normals = np.array([T[:3, 2] * np.sign(T[2, 2] or 1) for T in stereo.poses.values()])
    camera, projector = np.median([stereo.pose_rms_px[o.name] for o in used], axis=0).tolist()
    pixels = [  # of the features that the calibration used
        np.where(finite_rows(stereo.residuals_px[o.name])[:, None], o.camera, np.nan) for o in used
    ]
    return SolutionEvidence(
        used=tuple(stereo.poses),
        excluded={
            o.name: measure_excluded(o, stereo) for o in observations if o.name not in stereo.poses
        },
        reprojection_px=stereo.reprojection_rms_px["stereo"],
        median_pose_rms_px=(camera, projector),
        focal_sigma={
            device: stereo.focal_sigma_px[device] / float(min(f))
            for device, f in zip(DEVICES, focal, strict=True)
        },
        tilt_spread_deg=largest_angle_deg(normals),
        empty_corners=list_empty_corners(used, stereo, area),
        constant="" if area is None else area.describe(),
        aspects=(float(focal[0][1] / focal[0][0]), float(focal[1][1] / focal[1][0])),
        ripple=measure_ripple(used, stereo),
        squareness=_measure_squareness(used, stereo, pixels),
        places=int(np.count_nonzero(list_twins(used, stereo) < 0)),
    )


def _measure_squareness(
    used: Sequence[Observation], stereo: StereoModel, pixels: Sequence[Floats]
) -> Squareness:
    """Measure whether pixels and cells are square; ``pixels`` (n, 2) of each pose's features.

    The projector's skew is measured where its lens leaves more than noise: it takes as long as a
    calibration of the camera.
    """
    points = [o.points for o in used]
    poses = [stereo.poses[o.name] for o in used]
    squareness = measure_squareness(stereo.rig.camera, poses, points, pixels)
    if stereo.fixed_camera or stereo.reprojection_rms_px["projector"] < SKEWED_PX:
        return squareness
    projected = [o.projector for o in used]
    try:
        skew, limit = measure_skew(points, pixels, projected, stereo.rig.camera.size)
    except CalibrationRejected:  # the camera alone has no solution
        return squareness
    return replace(squareness, skew_deg=skew, skew_limit_deg=limit)


def measure_excluded(observation: Observation, stereo: StereoModel) -> ExcludedPose:
    """Measure the residuals of an excluded pose under the calibration; inf where its pose cannot be
    solved."""
    camera = stereo.rig.camera
    detected = finite_rows(observation.camera)
    features = observation.points[detected], observation.camera[detected]
    T = solve_pose(*features, camera.K, camera.D) if np.count_nonzero(detected) >= 6 else None
    if T is None:
        return ExcludedPose(np.inf, np.inf)
    X = move_points(T, observation.points)
    residuals = stereo.rig.project(X) - observation.projector
    return ExcludedPose(
        _trimmed_rms(camera.project(X) - observation.camera), _trimmed_rms(residuals)
    )


def list_empty_corners(
    observations: Sequence[Observation], stereo: StereoModel, area: ImageArea | None = None
) -> tuple[str, ...]:
    """List the corners of the image that no board covers, among those illuminated at the boards'
    depths. ``area``: the part of the image that changes, all of it if None."""
    if stereo.depth_range_mm is None:
        return ()
    size = stereo.rig.camera.size
    area = area or ImageArea.whole(size)
    covered = np.zeros(size[::-1], bool)
    for o in observations:
        u0, v0, u1, v1 = o.box
        covered[v0:v1, u0:u1] |= o.region
    empty = []
    u0, v0, u1, v1 = area.bounds
    for name, sides in CORNERS.items():
        along = [
            first + ((np.arange(_GRID) + 0.5) / _GRID * share + side * (1 - share)) * n
            for share, first, n, side in zip(
                CORNER_SHARE, (u0, v0), (u1 - u0, v1 - v0), sides, strict=True
            )
        ]
        pixels = grid_points(*along)
        illuminated = pixels[_is_illuminated(pixels, stereo) & area.contains(pixels)]
        if len(illuminated) < ILLUMINATED_SHARE * len(pixels):
            continue
        u, v = np.minimum(np.rint(illuminated).astype(int), np.array(size) - 1).T
        if covered[v, u].mean() < EMPTY_SHARE:
            empty.append(name)
    return tuple(empty)


def _is_illuminated(pixels: Floats, stereo: StereoModel) -> Mask:
    """(n,) bool: camera pixels (n, 2) on whose rays the projector illuminates two of three of the
    boards' depths."""
    near, far = stereo.depth_range_mm or (0.0, 0.0)
    rays = stereo.rig.camera.undistort(pixels)
    inside = []
    for z in (near, (near + far) / 2, far):
        projected = stereo.rig.project(np.column_stack([rays * z, np.full(len(rays), z)]))
        inside.append(stereo.rig.projector.contains(projected))
    return np.sum(inside, axis=0) >= 2


def _trimmed_rms(residuals: Floats) -> float:
    """RMS length of the smaller 90 % of residuals (n, 2), as single features may be wrong; inf
    without finite ones."""
    sizes = np.sort(lengths(residuals[finite_rows(residuals)]))
    return rms(sizes[: max(1, int(0.9 * len(sizes)))]) if len(sizes) else np.inf


def measure_ripple(observations: Sequence[Observation], stereo: StereoModel) -> dict[Axis, Ripple]:
    """Measure the ripple of each axis over the samples of all poses that the calibration used.

    Axes without fringes or with too few samples are missing from the result.
    """
    residuals: dict[Axis, list[Floats]] = {axis: [] for axis in AXES}
    depths = []
    for o in observations:
        if o.samples is None or o.name not in stereo.poses:
            continue
        samples, rays = o.samples, stereo.rig.camera.undistort(o.samples.camera)
        points = intersect_board(stereo.poses[o.name], rays)
        predicted = stereo.rig.project(points)
        further = stereo.rig.project(points * (1 + 1.0 / points[:, 2:]))  # by 1 mm
        with np.errstate(divide="ignore"):
            mm_per_px = 1.0 / np.abs(further - predicted).max(axis=1)
        depths.append(np.column_stack([points[:, 2], mm_per_px]))
        for axis, rows in _detrend_residuals(o, samples, predicted):
            residuals[axis].append(rows)
    if not depths:
        return {}
    depth_mm, median_mm_per_px = np.nanmedian(np.concatenate(depths), axis=0).tolist()
    return {
        axis: ripple
        for axis, rows in residuals.items()
        if rows and (ripple := _fit_ripple(np.concatenate(rows), median_mm_per_px, depth_mm))
    }


def _detrend_residuals(
    o: Observation, samples: Samples, predicted: Floats
) -> Iterator[tuple[Axis, Floats]]:
    """Yield the rows (n, 6) for ``_fit_ripple`` of a pose's samples, by axis.

    A polynomial in camera pixels is removed from measured less ``predicted`` (n, 2) px, which takes
    the lens distortion. Axes without fringes or with too few samples are missing.
    """
    u, v = samples.camera.T
    box = (u.min() - 0.5, v.min() - 0.5, u.max() + 0.5, v.max() + 0.5)
    for axis, measured, expected, sigma in zip(
        AXES, samples.projector.T, predicted.T, samples.sigma.T, strict=True
    ):
        difference = measured - expected
        known = np.isfinite(difference)
        if np.count_nonzero(known) < 4 * (DEGREE + 1) ** 2 or not o.periods_px[axis] > 2.0:
            continue
        values = difference[known]
        smooth = fit_polynomial(u[known], v[known], values, None, box, DEGREE, robust=True)
        difference[known] = values - smooth.evaluate(u[known], v[known])
        periods = measured / o.periods_px[axis]
        block = np.broadcast_to(_measure_blocks(samples.camera, periods), (len(periods), 3))
        yield axis, np.column_stack([periods, difference, sigma, block])


def _measure_blocks(camera: Floats, periods: Floats) -> Floats:
    """Return the change of the phase in periods per camera pixel along u and along v, and the
    blocks' side in px, (3,).

    ``camera`` (n, 2) px: centres of a pose's blocks; ``periods`` (n,): their projector coordinates
    in fringe periods.
    """
    slopes = np.abs(fit_slopes(camera, periods[:, None]))
    columns, counts = np.unique(np.round(2 * camera[:, 0]) / 2, return_counts=True)
    columns = columns[counts > 0.1 * counts.max()]  # whole blocks
    side = float(np.median(np.diff(columns))) if len(columns) > 1 else 1.0
    return np.array([*slopes[:, 0], max(1.0, round(side))])


def _fit_ripple(samples: Floats, mm_per_px: float, depth_mm: float) -> Ripple | None:
    """Fit waves of 1 to MAX_WAVES per fringe period to residuals, by least squares; None for fewer
    than MIN_SAMPLES.

    ``samples`` (n, 6): projector coordinate in periods, residual px, predicted noise px, and the
    three numbers of ``_measure_blocks``, by which the mean over a block attenuates each wave. Rows
    with NaN do not count.
    """
    samples = samples[finite_rows(samples)]
    if len(samples) < MIN_SAMPLES:
        return None
    periods, residual, sigma = samples.T[:3]
    spread = robust_sigma(residual, about=0.0)
    inlier = np.abs(residual) < OUTLIER_SIGMAS * max(spread, 1e-9)
    periods, residual, block = periods[inlier], residual[inlier], samples[inlier, 3:]
    waves = np.arange(1, MAX_WAVES + 1)
    angle = 2 * np.pi * periods[:, None] * waves
    response = np.ones((len(periods), MAX_WAVES))
    for slope in (block[:, :1], block[:, 1:2]):  # the mean of a wave over equally spaced pixels
        with np.errstate(invalid="ignore", divide="ignore"):
            mean = np.sinc(block[:, 2:] * slope * waves) / np.sinc(slope * waves)
        response *= np.nan_to_num(mean)
    response[:, np.median(np.abs(response), axis=0) < MIN_RESPONSE] = 0.0
    design = np.hstack([response * np.cos(angle), response * np.sin(angle)])
    amplitudes = np.linalg.lstsq(design, residual, rcond=None)[0].reshape(2, MAX_WAVES)
    # less the expectation from independent noise: a variance of 2 s^2 / n in each coefficient
    power = np.maximum(np.sum(amplitudes**2, axis=0) / 2 - 2 * spread**2 / len(residual), 0.0)
    return Ripple(
        rms_px=float(np.sqrt(power.sum())),
        waves=int(waves[power.argmax()]),
        # the noise of a block's mean, times the block's side
        noise_px=float(np.median(sigma * samples[:, 5])),
        mm_per_px=mm_per_px,
        depth_mm=depth_mm,
    )
