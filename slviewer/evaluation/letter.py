"""The Letter's own figures, as records of the same kind as ours.

Vargas, Romero, Zhang and Marrugo, *Pixel-wise rational model for a structured light system*, Optics
Letters 2023. Its R2 is 500 to 700 mm; its target has 16x21 circles, taken in 25 poses.
"""

import re
from collections.abc import Sequence

from slviewer.records.record import DEPTHS
from slviewer.records.verification import ModelFit, Shape, Verification

MODELS = ("stereo", "pixelwise")
DEPTH_RANGE_MM = (500.0, 700.0)
SPHERE_RADIUS_MM = 98.0  # nominal; "a sphere of 196 mm diameter"


def _record(
    shape: Shape,
    incidence: tuple[float, float, float],
    rms_mm: tuple[float, float],
    radii_mm: Sequence[float | None] = (None, None),
) -> Verification:
    """Return a row of the Letter's tables: percent in R1, R2 and R3, RMS and radius by stereo and
    pixelwise."""
    fits = {
        model: ModelFit(0, 0, rms, radius_mm=radius)
        for model, rms, radius in zip(MODELS, rms_mm, radii_mm, strict=True)
    }
    shares = dict(zip(DEPTHS, incidence, strict=True))
    return Verification(shape=shape, models=fits, incidence=shares)


_R1, _R2, _R3 = (100.0, 0.0, 0.0), (0.0, 100.0, 0.0), (0.0, 0.0, 100.0)
TABLE_1 = (
    _record("plane", _R1, (0.188, 0.068)),
    _record("plane", (91.2, 8.8, 0.0), (0.237, 0.066)),
    _record("plane", _R2, (0.144, 0.070)),
    _record("plane", _R2, (0.127, 0.056)),
    _record("plane", (0.0, 47.6, 52.4), (0.172, 0.091)),
    _record("plane", (0.0, 0.7, 99.3), (0.205, 0.104)),
    _record("plane", _R3, (0.270, 0.163)),
    _record("plane", _R3, (0.214, 0.118)),
    _record("plane", (2.1, 97.9, 0.0), (0.138, 0.053)),
    _record("plane", (0.0, 87.0, 13.0), (0.146, 0.076)),
)
"""Means 0.184 and 0.087 mm, 2.13 times better; the best pose 3.59, the Letter's "3.6 times"."""
TABLE_2 = (
    _record("sphere", _R1, (0.109, 0.080), (98.44, 98.01)),
    _record("sphere", _R1, (0.096, 0.074), (98.28, 98.00)),
    _record("sphere", _R2, (0.086, 0.062), (98.27, 98.08)),
    _record("sphere", _R2, (0.076, 0.056), (98.20, 98.06)),
    _record("sphere", _R3, (0.092, 0.076), (98.25, 98.15)),
    _record("sphere", _R3, (0.085, 0.085), (98.10, 98.06)),
)
"""Means 0.091 and 0.072 mm; radius 98.256 ± 0.111 and 98.060 ± 0.053 mm (standard deviation)."""
MEANS_MM = {"Letter stereo radius": 98.256, "Letter pixelwise radius": 98.060}
"""As printed, by the titles of the terminal's table: 98.256 is cut, not rounded."""

EXPERIMENT_3_POINTS = {"R1": 1_642_179, "R2": 1_476_327, "R3": 1_034_094}
EXPERIMENT_3_ICP_RMS_MM = {"R1": 0.26, "R2": 0.25}  # with R3 as the reference

REPROJECTION_RMS_PX = {"camera": 0.253, "projector": 0.141}


def find_pose(capture: str, shape: Shape) -> Verification:
    """Return the Letter's figures of the pose whose number ends the capture's name (``plane_03``,
    ``sphere_3``); a record without models where it has none."""
    number = re.search(r"\d+$", capture)
    index = int(number[0]) - 1 if number else -1
    table = TABLE_1 if shape == "plane" else TABLE_2
    return table[index] if 0 <= index < len(table) else Verification(shape=shape, models={})
