"""Evidence from the frames of one capture: light, patterns, and frame order."""

import cv2
import numpy as np

from slviewer.calibration.diagnosis.evidence import AxisEvidence
from slviewer.fringe.cosines import FEWEST, select_rows
from slviewer.fringe.layout import axis_layout, white_level
from slviewer.fringe.origin import measure_code_origin
from slviewer.fringe.phase import PhaseMap, Reason
from slviewer.fringe.response import measure_second_harmonic
from slviewer.fringe.sequence import Axis, PatternSequence
from slviewer.geometry.polynomial import fit_slopes
from slviewer.geometry.rigid import Floats
from slviewer.geometry.vectors import finite_rows, lengths

MIN_ORIGIN_PX = 0.2
"""px: a Gray code whose origin is nearer to a column's middle does not determine the period."""
_WHITE_LEVEL = 0.8  # of a pixel's brightest value over all frames
_WHITE_SHARE = 0.97  # share of the pixels above that level in a white frame
_ILLUMINATED_LEVEL = 0.5  # of the brightest pixels: illuminated by the projector


def measure_axis(
    sequence: PatternSequence, stack: np.ndarray, phase: PhaseMap, board: np.ndarray | None
) -> AxisEvidence:
    """Measure the evidence from one axis' frames.

    ``stack`` (n, h, w): all frames of the capture; ``board`` (h, w) bool: the detected board's
    pixels, None for the whole image.
    """
    reason = phase.reason if board is None else phase.reason[board]
    total = max(1.0, float(np.count_nonzero(reason != Reason.DARK)))
    return AxisEvidence(
        period_px=phase.period_px,
        steps=phase.steps,
        readable=np.count_nonzero(reason == Reason.VALID) / total,
        saturated=np.count_nonzero(reason == Reason.SATURATED) / total,
        harmonic=measure_second_harmonic(sequence, stack, phase.axis),
        period_seen_px=measure_period(sequence, stack, phase.axis),
    )


def measure_period(sequence: PatternSequence, stack: np.ndarray, axis: Axis) -> float:
    """Measure the fringe period in px from the phase at which the Gray code starts.

    The code's origin in px is known from the sequence's description, and its phase from the code's
    edges. NaN without both a phase shift and a Gray code, where the origin is too close to phase 0,
    or where the edges do not agree.
    """
    layout = axis_layout(sequence, axis)
    if not (layout.shifts and layout.gray) or abs(layout.gray_origin_px) < MIN_ORIGIN_PX:
        return np.nan
    white = white_level(sequence, stack, sequence.select(axis))
    found = measure_code_origin(layout, stack, white)
    origin = found.turns if found.is_exact else np.nan
    turns = layout.gray_origin_px / layout.period_px
    ratio = turns / origin if np.isfinite(origin) and abs(origin) > 1e-3 else np.nan
    return float(layout.period_px * ratio) if 0.1 < ratio < 10 else np.nan


def measure_white_delay(sequence: PatternSequence, stack: np.ndarray) -> int:
    """Return the delay of the white frame: 1 where it is one frame late, -1 where early, 0 where on
    time or unknown.

    Only a white frame next to pattern frames is decisive, as the projector may show white after the
    last one.
    """
    rows = select_rows(*stack.shape[1:])
    frames = stack[:, rows].reshape(len(stack), -1)
    brightest = frames.max(0)
    illuminated = brightest > _ILLUMINATED_LEVEL * float(np.quantile(brightest, 0.98))
    if np.count_nonzero(illuminated) < FEWEST:
        return 0
    frames, brightest = frames[:, illuminated], brightest[illuminated]
    white = np.mean(frames >= _WHITE_LEVEL * brightest, axis=1) > _WHITE_SHARE
    expected = [frame.kind in ("white", "texture") for frame in sequence.frames]
    for i in np.flatnonzero(expected):
        before, after = i - 1, i + 1
        if before >= 0 and not expected[before] and white[before]:
            return -1
        if not white[i] and after < len(expected) and not expected[after] and white[after]:
            return 1
    return 0


def measure_motion_px(
    sequence: PatternSequence, stack: np.ndarray, pixels: Floats, pitch: float
) -> float:
    """Measure the median motion in px of features at ``pixels`` (n, 2) between the frames of the
    two axes.

    ``pitch``: distance of neighbouring features, px. NaN where only one axis was captured, or where
    fewer than four features can be tracked.
    """
    images = (_scene_image(sequence, stack, axis) for axis in sequence.axes)
    scenes = [image for image in images if image is not None]
    if len(scenes) < 2 or len(pixels) < 4:
        return np.nan
    top = max(1.0, *(float(np.percentile(image[::4, ::4], 99.5)) for image in scenes))
    first, second = (cv2.convertScaleAbs(image, alpha=230 / top) for image in scenes)
    window = 2 * int(np.clip(0.6 * pitch, 4, 30)) + 1
    points = np.asarray(pixels, np.float32).reshape(-1, 1, 2)
    # Where circles are a few pixels apart, a coarser image of them is of other circles.
    levels = int(np.clip(np.log2(max(pitch, 1.0) / 12), 0, 3))
    tracked, status, _ = cv2.calcOpticalFlowPyrLK(
        first, second, points, points.copy(), winSize=(window, window), maxLevel=levels
    )
    shift = (tracked - points).reshape(-1, 2)[np.asarray(status).ravel() > 0]
    return float(np.median(lengths(shift))) if len(shift) >= 4 else np.nan


def _scene_image(sequence: PatternSequence, stack: np.ndarray, axis: Axis) -> np.ndarray | None:
    """Average the frames of one axis to an image (h, w) float32 without patterns; None where they
    do not cancel."""
    layout = axis_layout(sequence, axis)
    frames = [*layout.gray, *layout.inverse] if layout.inverse else []
    if layout.shifts:
        frames = list(layout.shifts[-1].indices)
    return np.asarray(stack[frames].mean(0, np.float32)) if frames else None


def fit_mean_turn(
    camera: Floats, projector: Floats
) -> tuple[tuple[float, float], tuple[float, float]] | None:
    """Fit the Jacobian (2, 2) of projector pixels (n, 2) by camera pixels (n, 2), least squares
    over all features.

    Rows with NaN do not count; None for fewer than four others.
    """
    known = finite_rows(camera, projector)
    if np.count_nonzero(known) < 4:
        return None
    (a, b), (c, d) = fit_slopes(camera, projector).T
    return (float(a), float(b)), (float(c), float(d))
