"""Ripple: phase errors that repeat with the fringe, as of a non-linear response or of flicker.

A response that is not linear puts harmonics h into the fringe, and n phase steps read those with h
= k n +- 1 as an error of the phase with n k waves a period (Guo, He and Zhang, Opt. Lasers Eng. 43,
2005). Light that changes between the frames leaves one or two waves a period. A lens bends neither.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from slviewer.calibration.observe import AXES, Observation, Samples
from slviewer.calibration.stereo import StereoModel
from slviewer.fringe.sequence import Axis
from slviewer.geometry.polynomial import fit_polynomial, fit_slopes
from slviewer.geometry.robust import robust_sigma
from slviewer.geometry.vectors import finite_rows

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

MIN_DEPTH_SHARE = 3e-5
"""Depth errors of a smaller share of the depth do not matter: 18 um at 600 mm, half the Letter
rig's noise floor."""


@dataclass(frozen=True)
class Ripple:
    """Ripple of one axis in projector px.

    ``rms_px``: RMS of all residuals that repeat with the fringe; ``waves``: waves per period of
    their strongest component, ``strongest_px`` its RMS; ``noise_px``: predicted noise of one camera
    pixel, median over the samples; ``mm_per_px``: change of depth by one projector px, in the axis
    that gives the depth; ``depth_mm``: median depth of the samples.
    """

    rms_px: float
    waves: int
    strongest_px: float
    noise_px: float
    mm_per_px: float
    depth_mm: float

    @property
    def matters(self) -> bool:
        """Whether it is larger than the noise of a point and than `MIN_DEPTH_SHARE` of the
        depth."""
        return (
            self.rms_px > self.noise_px
            and self.rms_px * self.mm_per_px > MIN_DEPTH_SHARE * self.depth_mm
        )


def measure_ripple(observations: Sequence[Observation], stereo: StereoModel) -> dict[Axis, Ripple]:
    """Measure the ripple of each axis over the samples of all poses that the calibration used.

    Axes without fringes or with too few samples are missing from the result.
    """
    residuals: dict[Axis, list[np.ndarray]] = {axis: [] for axis in AXES}
    depths = []
    for o in observations:
        if o.samples is None or o.name not in stereo.poses:
            continue
        points = _intersect_board(o.samples, stereo, o.name)
        depths.append(_measure_depths(points, stereo))
        detrended = _detrend_residuals(o.samples, o.samples.projector - stereo.rig.project(points))
        for column, axis in enumerate(AXES):
            if axis in detrended and o.periods_px[axis] > 2.0:
                periods = o.samples.projector[:, column] / o.periods_px[axis]
                block = np.broadcast_to(
                    _measure_blocks(o.samples.camera, periods), (len(periods), 3)
                )
                residuals[axis].append(
                    np.column_stack([periods, detrended[axis], o.samples.sigma[:, column], block])
                )
    if not depths:
        return {}
    depth_mm, mm_per_px = np.nanmedian(np.concatenate(depths), axis=0).tolist()
    ripples = {
        axis: _fit_ripple(np.concatenate(rows), mm_per_px, depth_mm)
        for axis, rows in residuals.items()
        if rows
    }
    return {axis: ripple for axis, ripple in ripples.items() if ripple is not None}


def _intersect_board(samples: Samples, stereo: StereoModel, pose: str) -> np.ndarray:
    """Return where the camera rays of a pose's samples meet its board: (n, 3) mm in the camera's
    frame."""
    T = stereo.poses[pose]
    rays = np.column_stack(
        [stereo.rig.camera.undistort(samples.camera), np.ones(len(samples.camera))]
    )
    with np.errstate(invalid="ignore", divide="ignore"):
        return rays * ((T[:3, 2] @ T[:3, 3]) / (rays @ T[:3, 2]))[:, None]


def _measure_depths(points: np.ndarray, stereo: StereoModel) -> np.ndarray:
    """Return the depth in mm of points (n, 3), and how many mm it changes by one projector px along
    the ray: (n, 2)."""
    further = points * (1 + 1.0 / points[:, 2:])  # by 1 mm
    px_per_mm = np.abs(stereo.rig.project(further) - stereo.rig.project(points)).max(axis=1)
    with np.errstate(divide="ignore"):
        return np.column_stack([points[:, 2], 1.0 / px_per_mm])


def _detrend_residuals(samples: Samples, difference: np.ndarray) -> Mapping[Axis, np.ndarray]:
    """Return measured less predicted projector coordinates (n,) px of a pose's samples, by axis.

    A polynomial in camera pixels is removed, which takes the lens distortion. Axes with too few
    samples are missing. ``difference`` (n, 2) px.
    """
    u, v = samples.camera.T
    box = (u.min() - 0.5, v.min() - 0.5, u.max() + 0.5, v.max() + 0.5)
    detrended: dict[Axis, np.ndarray] = {}
    for column, axis in enumerate(AXES):
        known = np.isfinite(difference[:, column])
        if np.count_nonzero(known) < 4 * (DEGREE + 1) ** 2:
            continue
        values = difference[known, column]
        smooth = fit_polynomial(u[known], v[known], values, None, box, DEGREE, robust=True)
        detrended[axis] = np.full(len(u), np.nan)
        detrended[axis][known] = values - smooth.evaluate(u[known], v[known])
    return detrended


def _measure_blocks(camera: np.ndarray, periods: np.ndarray) -> np.ndarray:
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


def _fit_ripple(samples: np.ndarray, mm_per_px: float, depth_mm: float) -> Ripple | None:
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
    strongest = int(np.argmax(power))
    return Ripple(
        rms_px=float(np.sqrt(power.sum())),
        waves=int(waves[strongest]),
        strongest_px=float(np.sqrt(power[strongest])),
        # the noise of a block's mean, times the block's side
        noise_px=float(np.median(sigma * samples[:, 5])),
        mm_per_px=mm_per_px,
        depth_mm=depth_mm,
    )
