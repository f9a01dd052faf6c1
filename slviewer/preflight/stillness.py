"""Did anything move while the rig was looked at?"""

import numpy as np

from slviewer.geometry.robust import robust_sigma
from slviewer.pipeline.examination import Check
from slviewer.preflight.light import Burst
from slviewer.preflight.rig_under_test import RigUnderTest

_BLOCK = 6  # sampled pixels
_SIGMAS = 8.0
_CHANGE = 0.04  # of the projector's light
_GAINS = (0.5, 2.0)
_SOME_MOTION, _MUCH_MOTION = 0.004, 0.05  # shares of what is illuminated


def check_motion(bench: RigUnderTest, burst: Burst, last_white: np.ndarray) -> Check:
    """White images of the beginning, the middle and the end, block by block, whatever the light as
    a whole did."""
    grids = np.stack(
        [
            _average_blocks(image, bench.illuminated)
            for image in (bench.white, *burst.white, last_white)
        ]
    )
    measured = np.isfinite(grids[0])
    if not measured.any():
        return Check("motion", "unknown", "Motion cannot be seen: too little is illuminated.")
    blocks = grids[:, measured]
    blocks = np.stack([_match_light(image, blocks[0]) for image in blocks])
    noise = robust_sigma(np.diff(blocks[1:-1], axis=0), 0.0) / np.sqrt(2)
    limit = max(_SIGMAS * np.sqrt(2) * noise, _CHANGE * bench.contrast)
    moved = (np.abs(blocks[1:] - blocks[0]) > limit).mean(axis=1)
    share = float(moved.max())
    figures = {"share_that_moved": round(share, 4), "limit_levels": round(limit, 2)}
    if share > _SOME_MOTION:
        return Check(
            "motion",
            "bad" if share > _MUCH_MOTION else "warning",
            f"{100 * share:.1f} % of the illuminated image changed while nothing should have:"
            " something moved.",
            "Let nothing move in front of the rig, stand it firmly, then check again.",
            figures,
        )
    edges = sum(np.count_nonzero(np.abs(np.diff(grids[0], axis=axis)) > limit) for axis in (0, 1))
    if edges <= _SOME_MOTION * blocks.shape[1]:
        return Check(
            "motion",
            "unknown",
            "Whether something moved cannot be seen: what is illuminated has too little contrast.",
            "Put something with edges or print in view, such as the board, then check again.",
            figures,
        )
    return Check("motion", "good", "Nothing moved.", "", figures)


def _match_light(image: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Block means with the projector and ambient light of the other image, fitted by robust
    regression.

    The gain is bounded: a scene without contrast determines none, and what comes into its view must
    not pass for light.
    """
    here = np.ones(len(image), bool)
    fitted = image
    for _ in range(3):
        mean, other_mean = image[here].mean(), other[here].mean()
        centred = image[here] - mean
        spread = float(centred @ centred)
        gain = float(centred @ (other[here] - other_mean)) / spread if spread > 0 else 1.0
        fitted = np.clip(gain, *_GAINS) * (image - mean) + other_mean
        rest = np.abs(fitted - other)
        here = rest <= 3 * np.median(rest) + 1e-6
    return fitted


def _average_blocks(image: np.ndarray, illuminated: np.ndarray) -> np.ndarray:
    """(rows, columns) means of square blocks; NaN where not all of a block is illuminated."""
    height, width = (size // _BLOCK * _BLOCK for size in image.shape)
    shape = (height // _BLOCK, _BLOCK, width // _BLOCK, _BLOCK)
    mean = image[:height, :width].reshape(shape).mean(axis=(1, 3), dtype=float)
    whole = illuminated[:height, :width].reshape(shape).all(axis=(1, 3))
    return np.where(whole, mean, np.nan)
