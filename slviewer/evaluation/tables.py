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
)
from slviewer.evaluation.render import Row
from slviewer.evaluation.sphere import SphereResult


def rows(comparisons: Mapping[str, Comparison], *, letter: bool = False) -> list[Row]:
    """One row a capture and, for more than one, a row of means; keys are the columns' titles, None is an empty cell.

    RMS and noise floor of each model in mm, for spheres the radius; ``ratio`` is the first model's RMS over the last's
    (in the last row, the ratio of the means). ``letter`` adds the Letter's figures of the pose whose number ends the
    capture's name (``plane_03``, ``sphere_3``), stereo and pixelwise, and takes the ratio over pixelwise's RMS too.
    """
    table = [_row(name, comparison, letter) for name, comparison in comparisons.items()]
    if letter:
        for row, comparison in zip(table, comparisons.values(), strict=True):
            row.update(_letter_figures(row["capture"], comparison.shape))
    if len(table) > 1:
        table.append(_means(table, comparisons, letter))
    return table


def _row(name: str, comparison: Comparison, letter: bool) -> Row:
    row: Row = {"capture": name}
    if comparison.incidence is not None:
        row["R1/R2/R3 %"] = "/".join(f"{share:.1f}".removesuffix(".0") for share in comparison.incidence.values())
    for model, result in comparison.results.items():
        row[f"{model} mm"] = result.rms_mm
        row[f"{model} floor"] = _or_none(result.noise_floor_mm)
        if isinstance(result, SphereResult):
            row[f"{model} radius"] = result.radius_mm
        if np.isfinite(comparison.coverage[model]):
            row[f"{model} coverage %"] = 100.0 * comparison.coverage[model]
        row[f"{model} set aside %"] = 100.0 * result.set_aside_share
    models = list(comparison.results)
    if len(models) > 1:
        row["ratio"] = row[f"{models[0]} mm"] / row[f"{_rival(models, letter)} mm"]
    return row


def _rival(models: list[str], letter: bool) -> str:
    """The model that the first one's RMS is divided by."""
    return "pixelwise" if letter and "pixelwise" in models else models[-1]


def _letter_figures(capture: str, shape: str) -> Row:
    number = re.search(r"(\d+)$", capture)
    pose = int(number[1]) if number else 0
    if shape == "plane":
        for plane in TABLE_1:
            if plane.pose == pose:
                return _letter_row(plane.stereo_mm, plane.pixelwise_mm)
    else:
        for sphere in TABLE_2:
            if sphere.pose == pose:
                radii = (sphere.stereo_radius_mm, sphere.pixelwise_radius_mm)
                return _letter_row(sphere.stereo_mm, sphere.pixelwise_mm, radii)
    return {}


def _letter_row(stereo: float, pixelwise: float, radii: tuple[float, float] | None = None) -> Row:
    row: Row = {"Letter stereo": stereo, "Letter pixelwise": pixelwise, "Letter ratio": stereo / pixelwise}
    if radii is not None:
        row["Letter stereo radius"], row["Letter pixelwise radius"] = radii
    return row


def _means(table: list[Row], comparisons: Mapping[str, Comparison], letter: bool) -> Row:
    row: Row = {"capture": "mean"}
    for title in dict.fromkeys(title for line in table for title in line):
        values = [line[title] for line in table if isinstance(line.get(title), float)]
        if values and "ratio" not in title and not title.startswith("Letter"):
            row[title] = float(np.mean(values))
    models = list(next(iter(comparisons.values())).results)
    if len(models) > 1:
        row["ratio"] = row[f"{models[0]} mm"] / row[f"{_rival(models, letter)} mm"]
    if letter:
        plane = next(iter(comparisons.values())).shape == "plane"
        radii = None if plane else (TABLE_2_RADIUS_MM[0][0], TABLE_2_RADIUS_MM[1][0])
        row.update(_letter_row(*(TABLE_1_MEAN_MM if plane else TABLE_2_MEAN_MM), radii))
        if plane:
            row["Letter ratio"] = TABLE_1_RATIO_OF_MEANS
    return row


def _or_none(value: float) -> float | None:
    return value if np.isfinite(value) else None
