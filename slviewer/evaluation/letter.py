"""The Letter's own figures, and tables of comparisons that show them beside ours.

Vargas, Romero, Zhang and Marrugo, *Pixel-wise rational model for a structured light system*, Optics
Letters 2023. Its R2 is 500 to 700 mm; its target has 16x21 circles, taken in 25 poses.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from slviewer.evaluation.fit import Comparison, finite_or_none
from slviewer.evaluation.render import Row

DEPTH_RANGE_MM = (500.0, 700.0)
SPHERE_RADIUS_MM = 98.0  # nominal; "a sphere of 196 mm diameter"


@dataclass(frozen=True)
class PlanePose:
    """A row of Table 1, in the order of the poses: shares of the board in R1, R2, R3 in percent;
    RMS in mm."""

    incidence: tuple[float, float, float]
    stereo_mm: float
    pixelwise_mm: float


@dataclass(frozen=True)
class SpherePose:
    """A row of Table 2, in the order of the poses: position of the sphere; RMS and fitted radius in
    mm."""

    region: str
    stereo_mm: float
    pixelwise_mm: float
    stereo_radius_mm: float
    pixelwise_radius_mm: float


TABLE_1 = (
    PlanePose((100.0, 0.0, 0.0), 0.188, 0.068),
    PlanePose((91.2, 8.8, 0.0), 0.237, 0.066),
    PlanePose((0.0, 100.0, 0.0), 0.144, 0.070),
    PlanePose((0.0, 100.0, 0.0), 0.127, 0.056),
    PlanePose((0.0, 47.6, 52.4), 0.172, 0.091),
    PlanePose((0.0, 0.7, 99.3), 0.205, 0.104),
    PlanePose((0.0, 0.0, 100.0), 0.270, 0.163),
    PlanePose((0.0, 0.0, 100.0), 0.214, 0.118),
    PlanePose((2.1, 97.9, 0.0), 0.138, 0.053),
    PlanePose((0.0, 87.0, 13.0), 0.146, 0.076),
)
TABLE_1_MEAN_MM = (0.184, 0.087)  # stereo, pixelwise
TABLE_1_RATIO_OF_MEANS = 2.13  # before rounding; the best row is 3.59, the Letter's "3.6 times"

TABLE_2 = (
    SpherePose("R1", 0.109, 0.080, 98.44, 98.01),
    SpherePose("R1", 0.096, 0.074, 98.28, 98.00),
    SpherePose("R2", 0.086, 0.062, 98.27, 98.08),
    SpherePose("R2", 0.076, 0.056, 98.20, 98.06),
    SpherePose("R3", 0.092, 0.076, 98.25, 98.15),
    SpherePose("R3", 0.085, 0.085, 98.10, 98.06),
)
TABLE_2_MEAN_MM = (0.091, 0.072)
# mean and standard deviation: stereo, pixelwise
TABLE_2_RADIUS_MM = (
    (98.256, 0.111),
    (98.060, 0.053),
)

EXPERIMENT_3_POINTS = {"R1": 1_642_179, "R2": 1_476_327, "R3": 1_034_094}
EXPERIMENT_3_ICP_RMS_MM = {"R1": 0.26, "R2": 0.25}  # with R3 as the reference

REPROJECTION_RMS_PX = {"camera": 0.253, "projector": 0.141}


def letter_rows(comparisons: Mapping[str, Comparison]) -> list[Row]:
    """Return one row a capture and, for more than one, a row of means; keys are the columns'
    titles, None is an empty cell.

    RMS and noise floor of each model in mm, for spheres the radius; ``ratio`` is the first model's
    RMS over pixelwise's or, without that, the last one's (in the last row, the ratio of the means).
    Beside them the Letter's figures of the pose whose number ends the capture's name (``plane_03``,
    ``sphere_3``), stereo and pixelwise.
    """
    table = [
        _make_row(name, comparison) | _letter_figures(name, comparison.shape)
        for name, comparison in comparisons.items()
    ]
    return [*table, _average_rows(table, comparisons)] if len(table) > 1 else table


def _make_row(name: str, comparison: Comparison) -> Row:
    """Return the table row of one capture: each model's RMS, noise floor and radius."""
    row: Row = {"capture": name}
    if comparison.incidence is not None:
        row["R1/R2/R3 %"] = "/".join(
            f"{share:.1f}".removesuffix(".0") for share in comparison.incidence.values()
        )
    for model, result in comparison.results.items():
        row[f"{model} mm"] = result.rms_mm
        row[f"{model} floor"] = finite_or_none(result.noise_floor_mm)
        if comparison.shape == "sphere":
            row[f"{model} radius"] = result.radius_mm
    return row | _rms_ratio(row, comparison)


def _rms_ratio(row: Row, comparison: Comparison) -> Row:
    """Return the ratio of the first model's RMS to that of the model to compare it with; {} for a
    single model."""
    first, *others = comparison.results
    if not others:
        return {}
    other = "pixelwise" if "pixelwise" in others else others[-1]
    return {"ratio": row[f"{first} mm"] / row[f"{other} mm"]}


def _letter_figures(capture: str, shape: str) -> Row:
    """Return the Letter's figures of the pose whose number the capture's name ends with; {} without
    one."""
    number = re.search(r"(\d+)$", capture)
    table: Sequence[PlanePose | SpherePose] = TABLE_1 if shape == "plane" else TABLE_2
    if not number or not 0 < int(number[1]) <= len(table):
        return {}
    return _letter_row(table[int(number[1]) - 1])


def _letter_row(theirs: PlanePose | SpherePose) -> Row:
    """Return the Letter's RMS of both models in mm, their ratio, and a sphere's radii."""
    row: Row = {
        "Letter stereo": theirs.stereo_mm,
        "Letter pixelwise": theirs.pixelwise_mm,
        "Letter ratio": theirs.stereo_mm / theirs.pixelwise_mm,
    }
    if isinstance(theirs, SpherePose):
        row["Letter stereo radius"] = theirs.stereo_radius_mm
        row["Letter pixelwise radius"] = theirs.pixelwise_radius_mm
    return row


def _average_rows(table: list[Row], comparisons: Mapping[str, Comparison]) -> Row:
    """Return the row of the columns' means, ratios recomputed from the means."""
    row: Row = {"capture": "mean"}
    for title in dict.fromkeys(title for line in table for title in line):
        values = [line[title] for line in table if isinstance(line.get(title), float)]
        if values and "ratio" not in title and not title.startswith("Letter"):
            row[title] = float(np.mean(values))
    first = next(iter(comparisons.values()))
    row |= _rms_ratio(row, first)
    if first.shape == "plane":
        means = _letter_row(PlanePose((0.0, 0.0, 0.0), *TABLE_1_MEAN_MM))
        return row | means | {"Letter ratio": TABLE_1_RATIO_OF_MEANS}
    radii = (mean for mean, _ in TABLE_2_RADIUS_MM)
    return row | _letter_row(SpherePose("", *TABLE_2_MEAN_MM, *radii))
