"""Comparisons as rows of a table: our Table 1 and Table 2 with the Letter's figures beside ours."""

import re
from collections.abc import Mapping

import numpy as np

from slviewer.evaluation.compare import Comparison
from slviewer.evaluation.letter import (
    TABLE_1,
    TABLE_1_MEAN_MM,
    TABLE_1_RATIO_OF_MEANS,
    TABLE_2,
    TABLE_2_MEAN_MM,
    TABLE_2_RADIUS_MM,
    SpherePose,
)
from slviewer.evaluation.render import Row


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
    """Return the table row of one capture: each model's RMS, noise floor, radius and coverage."""
    row: Row = {"capture": name}
    if comparison.incidence is not None:
        row["R1/R2/R3 %"] = "/".join(
            f"{share:.1f}".removesuffix(".0") for share in comparison.incidence.values()
        )
    for model, result in comparison.results.items():
        row[f"{model} mm"] = result.rms_mm
        row[f"{model} floor"] = (
            result.noise_floor_mm if np.isfinite(result.noise_floor_mm) else None
        )
        if comparison.shape == "sphere":
            row[f"{model} radius"] = result.radius_mm
        if np.isfinite(comparison.coverage[model]):
            row[f"{model} coverage %"] = 100.0 * comparison.coverage[model]
        row[f"{model} set aside %"] = 100.0 * result.excluded_share
    return row | _rms_ratio(row, comparison)


def _rms_ratio(row: Row, comparison: Comparison) -> Row:
    """Return the ratio of the first model's RMS to that of the model to compare it with; {} for a
    single model."""
    first, *others = comparison.results
    if not others:
        return {}
    return {
        "ratio": (
            row[f"{first} mm"] / row[f"{'pixelwise' if 'pixelwise' in others else others[-1]} mm"]
        )
    }


def _letter_figures(capture: str, shape: str) -> Row:
    """Return the Letter's figures of the pose whose number the capture's name ends with; {} without
    one."""
    number = re.search(r"(\d+)$", capture)
    table = TABLE_1 if shape == "plane" else TABLE_2
    for theirs in table:
        if number and theirs.pose == int(number[1]):
            radii = None
            if isinstance(theirs, SpherePose):
                radii = theirs.stereo_radius_mm, theirs.pixelwise_radius_mm
            return _letter_row(theirs.stereo_mm, theirs.pixelwise_mm, radii)
    return {}


def _letter_row(stereo: float, pixelwise: float, radii: tuple[float, float] | None = None) -> Row:
    """Return the Letter's RMS of both models in mm, their ratio, and the sphere's radii if
    given."""
    row: Row = {
        "Letter stereo": stereo,
        "Letter pixelwise": pixelwise,
        "Letter ratio": stereo / pixelwise,
    }
    if radii is not None:
        row["Letter stereo radius"], row["Letter pixelwise radius"] = radii
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
        return row | _letter_row(*TABLE_1_MEAN_MM) | {"Letter ratio": TABLE_1_RATIO_OF_MEANS}
    return row | _letter_row(*TABLE_2_MEAN_MM, (TABLE_2_RADIUS_MM[0][0], TABLE_2_RADIUS_MM[1][0]))
