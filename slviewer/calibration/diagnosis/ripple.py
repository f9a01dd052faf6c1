"""Residuals that repeat with the fringe: what light that is no cosine of the pattern leaves in the phase.

A response that is not linear puts harmonics h into the fringe, and n phase steps read those with h = k n +- 1 as an
error of the phase with n k waves a period (Guo, He and Zhang, Opt. Lasers Eng. 43, 2005). Light that changes between
the frames leaves one or two waves a period. A lens bends neither.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from slviewer.calibration.observe import AXES, Observation
from slviewer.calibration.stereo import StereoModel
from slviewer.fringe.sequence import Axis
from slviewer.geometry.polynomial import fit_polynomial

MAX_WAVES = 8
"""A period: the most that are searched for; four and fewer samples a wave would tell nothing."""
DEGREE = 6
"""Of the polynomial in camera pixels that takes what the lenses exclude of a pose's residuals."""
OUTLIER_SIGMAS = 5.0
MIN_SAMPLES = 500
MIN_RESPONSE = 0.15
"""Of a wave's amplitude, that must be left of it in the mean over a sample's block."""


@dataclass(frozen=True)
class Ripple:
    """One axis, px of the projector: RMS of the residuals that repeat with the fringe, the number of ``waves`` a period
    that is strongest among them, its RMS, and the noise that the samples are predicted to have (median)."""

    rms_px: float
    waves: int
    strongest_px: float
    noise_px: float


def measure_ripple(observations: Sequence[Observation], stereo: StereoModel) -> dict[Axis, Ripple]:
    """The ripple of each axis over the samples of all poses that the calibration used; axes without fringes, or with
    too few samples, are not in it."""
    residuals: dict[Axis, list[np.ndarray]] = {axis: [] for axis in AXES}
    for o in observations:
        if o.samples is None or o.name not in stereo.poses:
            continue
        smooth_free = _detrend_residuals(o, stereo)
        for column, axis in enumerate(AXES):
            if axis in smooth_free and o.periods_px[axis] > 2.0:
                turns = o.samples.projector[:, column] / o.periods_px[axis]
                block = np.broadcast_to(_block_periods(o.samples.camera, turns), (len(turns), 3))
                residuals[axis].append(np.column_stack([turns, smooth_free[axis], o.samples.sigma[:, column], block]))
    return {axis: found for axis, rows in residuals.items() if rows and (found := _fit_ripple(np.concatenate(rows)))}


def _detrend_residuals(o: Observation, stereo: StereoModel) -> Mapping[Axis, np.ndarray]:
    """(n,) px an axis: measured less predicted projector coordinates of a pose's samples, without their smooth part."""
    assert o.samples is not None
    T = stereo.poses[o.name]
    rays = np.column_stack([stereo.rig.camera.undistort(o.samples.camera), np.ones(len(o.samples.camera))])
    with np.errstate(invalid="ignore", divide="ignore"):
        points = rays * ((T[:3, 2] @ T[:3, 3]) / (rays @ T[:3, 2]))[:, None]
    difference = o.samples.projector - stereo.rig.project(points)
    u, v = o.samples.camera.T
    box = (u.min() - 0.5, v.min() - 0.5, u.max() + 0.5, v.max() + 0.5)
    found: dict[Axis, np.ndarray] = {}
    for column, axis in enumerate(AXES):
        known = np.isfinite(difference[:, column])
        if np.count_nonzero(known) < 4 * (DEGREE + 1) ** 2:
            continue
        values = difference[known, column]
        smooth = fit_polynomial(u[known], v[known], values, None, box, DEGREE, robust=True)
        left = np.full(len(u), np.nan)
        left[known] = values - smooth.evaluate(u[known], v[known])
        found[axis] = left
    return found


def _block_periods(camera: np.ndarray, turns: np.ndarray) -> np.ndarray:
    """(3,): periods a camera pixel, along the image's columns and its rows, and how many pixels a side a sample's block
    has; the mean over them flattens a ripple."""
    known = np.isfinite(turns)
    design = np.column_stack([camera[known], np.ones(np.count_nonzero(known))])
    slopes = np.linalg.lstsq(design, turns[known], rcond=None)[0][:2]
    places, counts = np.unique(np.round(2 * camera[:, 0]) / 2, return_counts=True)
    places = places[counts > 0.1 * counts.max()]  # whole blocks
    side = float(np.median(np.diff(places))) if len(places) > 1 else 1.0
    return np.array([abs(slopes[0]), abs(slopes[1]), max(1.0, round(side))])


def _fit_ripple(rows: np.ndarray) -> Ripple | None:
    rows = rows[np.isfinite(rows).all(axis=1)]
    if len(rows) < MIN_SAMPLES:
        return None
    turns, residual, sigma = rows.T[:3]
    spread = 1.4826 * float(np.median(np.abs(residual)))
    kept = np.abs(residual) < OUTLIER_SIGMAS * max(spread, 1e-9)
    turns, residual, block = turns[kept], residual[kept], rows[kept, 3:]
    waves = np.arange(1, MAX_WAVES + 1)
    angle = 2 * np.pi * turns[:, None] * waves
    flattened = np.ones((len(turns), MAX_WAVES))
    for slope in (block[:, :1], block[:, 1:2]):  # the mean of a wave over equally spaced pixels
        with np.errstate(invalid="ignore", divide="ignore"):
            mean = np.sinc(block[:, 2:] * slope * waves) / np.sinc(slope * waves)
        flattened *= np.nan_to_num(mean)
    flattened[:, np.median(np.abs(flattened), axis=0) < MIN_RESPONSE] = 0.0
    design = np.hstack([flattened * np.cos(angle), flattened * np.sin(angle)])
    solved = np.linalg.lstsq(design, residual, rcond=None)[0].reshape(2, MAX_WAVES)
    # less what independent noise gives: a variance of 2 s^2 / n in each coefficient
    power = np.maximum(np.sum(solved**2, axis=0) / 2 - 2 * spread**2 / len(residual), 0.0)
    strongest = int(np.argmax(power))
    return Ripple(
        float(np.sqrt(power.sum())), int(waves[strongest]), float(np.sqrt(power[strongest])), float(np.median(sigma))
    )
