"""Sections on the quality of a calibration: verdict, comparison of models, acceptance tests."""

from collections.abc import Mapping
from typing import Any

from slviewer.calibration.diagnosis.verdict import Verdict
from slviewer.evaluation.crossvalidation import CrossValidation
from slviewer.records.table import Cell, Column, Mark, Table
from slviewer.report.data import ModelsView
from slviewer.report.page import Headline, Item, PageNotice, Section

_LEVELS: dict[str, tuple[str, str]] = {
    "good": ("Good: no problems detected.", "good"),
    "doubtful": ("Doubtful: use it with care, or correct the causes first.", "warning"),
    "rejected": ("Rejected: do not measure with this calibration.", "warning"),
}
_DECISIONS: dict[str | None, tuple[str, Mark]] = {
    "pass": ("pass", "better"),
    "fail": ("fail", "worse"),
    "undecided": ("undecided", "strong"),
    None: ("no limit given", "muted"),
}


def verdict_section(verdict: Verdict, of_calibration: bool) -> Section:
    """The section with the verdict's level, and every finding with its remedy."""
    words, kind = _LEVELS[verdict.level]
    items: list[Item] = [PageNotice(words, kind)]  # type: ignore[arg-type]
    for finding in verdict.findings:
        is_corrected = finding.severity == "note"
        what = "Already corrected." if is_corrected else f"What to do: {finding.remedy}."
        items.append(
            PageNotice(f"{finding.sentence}. {what}", "plain" if is_corrected else "warning")
        )
    text = (
        ""
        if of_calibration
        else "This verdict is on the last attempt to calibrate, which gave no calibration."
    )
    return Section("Verdict", text, items)


def verdict_headline(verdict: Verdict) -> Headline:
    """The headline with the verdict's level and the number of findings."""
    mark: Mark = "better" if verdict.level == "good" else "worse"
    count = len(verdict.findings)
    return Headline(
        verdict.level, "verdict on the calibration", f"{count} finding{'s' * (count != 1)}", mark
    )


def models_section(models: ModelsView) -> Section:
    """The section about the models: comparison on held-out poses, and results of the joint
    adjustment."""
    items: list[Item] = [
        PageNotice(f"{model}: {words}.", "plain") for model, words in models.scales.items()
    ]
    used = f"Measured with {models.used}"
    used += (
        "."
        if models.used == models.recommended
        else f", as the operator has chosen; recommended: {models.recommended}."
    )
    compared = models.comparison
    if compared is not None:
        items.append(comparison_table(compared, compared.recommended))
    if models.splined is not None:
        items.append(splined_table(models.splined))
        items += [
            PageNotice(f"{name} is excluded from the splined model: it {why}")
            for name, why in models.splined["left_out"].items()
        ]
    return Section("Models", used, items)


def comparison_table(compared: CrossValidation, bold: str) -> Table:
    """Table of the models' RMS on held-out poses; the model ``bold`` in bold, the smallest errors
    marked."""
    figures = {
        "plane_mm": (Column("plane", "mm"), 4),
        "board_mm": (Column("board", "mm"), 4),
        "scale_ppm": (Column("scale", "ppm"), 0),
        "camera_px": (Column("camera", "px"), 3),
        "projector_px": (Column("projector", "px"), 3),
    }
    rms = {
        figure: {model: compared.rms(model, figure) for model in compared.models}
        for figure in figures
    }
    rows: list[list[str | Cell]] = []
    for model in compared.models:
        row: list[str | Cell] = [Cell(model, "strong") if model == bold else model]
        for figure, (_, digits) in figures.items():
            text, comparable = (
                f"{rms[figure][model]:.{digits}f}",
                figure
                in (
                    "plane_mm",
                    "board_mm",
                    "camera_px",
                ),
            )
            is_least = len(compared.models) > 1 and rms[figure][model] == min(rms[figure].values())
            row.append(Cell(text, "better") if comparable and is_least else text)
        rows.append(row)
    notes = [
        (
            f"{len(next(iter(compared.poses.values())))} poses, each measured by calibrations"
            f" without it ({len(compared.folds)} folds). Plane: distance of the board's features"
            " from their plane; board: from their true positions."
        ),
        *(f"{model} could not be compared: {why}." for model, why in compared.failed.items()),
    ]
    columns = [Column("model", align="left"), *(column for column, _ in figures.values())]
    return Table(columns, rows, "RMS on held-out poses", notes)


def splined_table(summary: Mapping[str, Any]) -> Table:
    """Table of the results of the joint adjustment, as `SplinedModel.summary` gives them."""
    noise, local, covered = (
        summary["noise_px"],
        summary["local_distortion_rms_px"],
        summary["cells_lit"],
    )
    low, high = summary["board_height_mm"]
    rows = [
        ["Residual noise, camera", f"{noise['camera']:.4f} px"],
        ["Residual noise, projector x / y", f"{noise['x']:.4f} / {noise['y']:.4f} px"],
        [
            "Local distortion, camera / projector",
            f"{local['camera']:.3f} / {local['projector']:.3f} px RMS",
        ],
        ["Board height, peak to valley", f"{high - low:.3f} mm"],
        ["Board feature offsets", f"{summary['board_offsets_rms_mm']:.4f} mm RMS"],
        [
            "Covered, camera / projector",
            f"{100 * covered['camera']:.0f} / {100 * covered['projector']:.0f} %",
        ],
    ]
    columns = [Column("quantity", align="left"), Column("value")]
    return Table(
        columns,
        rows,
        "Joint adjustment (splined)",
        ["Pixels outside the calibrated region are masked."],
    )
