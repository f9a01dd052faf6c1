"""Sections on the quality of a calibration: verdict, comparison of models, acceptance tests."""

from collections.abc import Mapping, Sequence
from typing import Any

from slviewer.calibration.diagnosis.verdict import Verdict
from slviewer.evaluation.crossvalidation import CrossValidation
from slviewer.records.table import Cell, Column, Mark, Table
from slviewer.report.data import AcceptanceView, ModelsView
from slviewer.report.page import Headline, Item, PageNotice, Section
from slviewer.report.tables import UNKNOWN, format_number

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
        items.append(PageNotice(f"{finding.sentence}. {what}", "plain" if is_corrected else "warning"))
    text = "" if of_calibration else "This verdict is on the last attempt to calibrate, which gave no calibration."
    return Section("Verdict", text, items)


def verdict_headline(verdict: Verdict) -> Headline:
    """The headline with the verdict's level and the number of findings."""
    mark: Mark = "better" if verdict.level == "good" else "worse"
    count = len(verdict.findings)
    return Headline(verdict.level, "verdict on the calibration", f"{count} finding{'s' * (count != 1)}", mark)


def models_section(models: ModelsView) -> Section:
    """The section about the models: comparison on held-out poses, and results of the joint adjustment."""
    items: list[Item] = [PageNotice(f"{model}: {words}.", "plain") for model, words in models.scales.items()]
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
    """Table of the models' RMS on held-out poses; the model ``bold`` in bold, the smallest errors marked."""
    figures = {
        "plane_mm": (Column("plane", "mm"), 4),
        "board_mm": (Column("board", "mm"), 4),
        "scale_ppm": (Column("scale", "ppm"), 0),
        "camera_px": (Column("camera", "px"), 3),
        "projector_px": (Column("projector", "px"), 3),
    }
    rms = {figure: {model: compared.rms(model, figure) for model in compared.models} for figure in figures}
    rows: list[list[str | Cell]] = []
    for model in compared.models:
        row: list[str | Cell] = [Cell(model, "strong") if model == bold else model]
        for figure, (_, digits) in figures.items():
            text, comparable = f"{rms[figure][model]:.{digits}f}", figure in ("plane_mm", "board_mm", "camera_px")
            is_least = len(compared.models) > 1 and rms[figure][model] == min(rms[figure].values())
            row.append(Cell(text, "better") if comparable and is_least else text)
        rows.append(row)
    notes = [
        f"{len(next(iter(compared.poses.values())))} poses, each measured by calibrations without it "
        f"({len(compared.folds)} folds). Plane: distance of the board's features from their plane; board: from their "
        "true positions.",
        *(f"{model} could not be compared: {why}." for model, why in compared.failed.items()),
    ]
    columns = [Column("model", align="left"), *(column for column, _ in figures.values())]
    return Table(columns, rows, "RMS on held-out poses", notes)


def splined_table(summary: Mapping[str, Any]) -> Table:
    """Table of the results of the joint adjustment, as `SplinedModel.summary` gives them."""
    noise, local, covered = summary["noise_px"], summary["local_distortion_rms_px"], summary["cells_lit"]
    low, high = summary["board_height_mm"]
    rows = [
        ["Residual noise, camera", f"{noise['camera']:.4f} px"],
        ["Residual noise, projector x / y", f"{noise['x']:.4f} / {noise['y']:.4f} px"],
        ["Local distortion, camera / projector", f"{local['camera']:.3f} / {local['projector']:.3f} px RMS"],
        ["Board height, peak to valley", f"{high - low:.3f} mm"],
        ["Board feature offsets", f"{summary['board_offsets_rms_mm']:.4f} mm RMS"],
        ["Covered, camera / projector", f"{100 * covered['camera']:.0f} / {100 * covered['projector']:.0f} %"],
    ]
    columns = [Column("quantity", align="left"), Column("value")]
    return Table(columns, rows, "Joint adjustment (splined)", ["Pixels outside the calibrated region are masked."])


def acceptance_section(acceptances: Sequence[AcceptanceView]) -> Section:
    """The section with every acceptance test: decisions, scale, budget, repeatability; the last one first."""
    items: list[Item] = []
    for view in reversed(acceptances):
        items += _acceptance_items(view)
    text = (
        "Artefacts with known lengths, measured in several places. A property passes where its error and the test's "
        "own uncertainty together stay within the limit, fails where the error exceeds it by more than that, "
        "and is undecided between. These tests follow the ideas of VDI/VDE 2634 part 2 and ISO 10360-13, and claim "
        "conformity with neither."
    )
    return Section("Acceptance", text, items)


def _acceptance_items(view: AcceptanceView) -> list[Item]:
    """Verdict, tables and notices of one acceptance test."""
    result = view.found
    artefact = result["artefact"]
    named = (
        f"{artefact['name']}, certificate {artefact['certificate']}, measured by {result['model']} on {view.time[:10]}"
    )
    decided, _ = _DECISIONS[result["decision"]]
    items: list[Item] = [
        PageNotice(f"{named}: {decided.upper() if result['decision'] else decided}.",
               "good" if result["decision"] == "pass" else "plain" if result["decision"] is None else "warning")
    ]  # fmt: skip
    if view.stale:
        items.append(PageNotice("The calibration or the captures have changed since this test: test again."))
    items += [PageNotice(f"Incomplete: {what}.") for what in result["lacks"]]
    rows: list[list[str | Cell]] = []
    for each in result["judgements"]:
        worst, limit = each["worst"], each["limit_mm"]
        rows.append(
            [
                each["property"],
                format_number(worst["error_mm"], 4, signed=True),
                worst["position"],
                format_number(worst["U_mm"], 4),
                " ... ".join(f"{v:+.4f}".replace("-", "−") for v in worst["within_95_mm"]),
                UNKNOWN if limit is None else f"{limit:g}",
                Cell(*_DECISIONS[each["decision"]]),
            ]
        )
    columns = [Column("property", align="left"), Column("worst", "mm"), Column("at", align="left")]
    columns += [Column("uncertainty U, k = 2", "mm"), Column("95 % lie within", "mm", align="centre")]
    columns += [Column("limit", "mm"), Column("decision", align="left")]
    notes = [f"{len(result['positions'])} positions."]
    if scale := result["scale"]:
        U = 2 * scale["u_ppm"]
        notes.append(
            f"Scale: {scale['ppm']:+.0f} ppm ± {U:.0f} ppm (k = 2) over {scale['length_mm']:.3f} mm.".replace("-", "−")
        )
    if result["scale_applied"] is not None:
        ppm = f"{1e6 * (result['scale_applied'] - 1):+.0f}".replace("-", "−")
        notes.append(f"The scale was corrected by {ppm} ppm from this test on.")
    elif result["scale_factor"] != 1:
        ppm = f"{1e6 * (result['scale_factor'] - 1):+.0f}".replace("-", "−")
        notes.append(f"A scale correction of {ppm} ppm was in force during the test.")
    if steady := result["repeatability"]:
        notes.append(
            f"Repeatability over {steady['captures']} captures of a still object: {steady['sigma_mm']:.4f} mm (median "
            f"over the pixels), {steady['predicted_mm']:.4f} mm expected from noise; the mean depth drifted by "
            f"{steady['wandering_mm']:.4f} mm. This is not a measure of accuracy."
        )
    items.append(Table(columns, rows, artefact["name"], notes))
    if result["budget"]:
        items.append(_budget_table(result["budget"]))
    return items


def _budget_table(budget: Mapping[str, Any]) -> Table:
    """Table of the uncertainty budget: contributions in mm, and the expanded uncertainty below."""
    rows: list[list[str | Cell]] = [
        [c["source"], UNKNOWN if c["u_mm"] is None else f"{c['u_mm']:.4f}", c["kind"], c["how"]]
        for c in budget["contributions"]
    ]
    columns = [Column("source", align="left"), Column("standard uncertainty", "mm"), Column("type", align="centre")]
    columns.append(Column("from", align="left"))
    without = f" Unknown: {' and '.join(budget['unknown'])}; U excludes it." if budget["unknown"] else ""
    notes = [f"Type A: from repeated observations; B: from anything else.{without}"]
    footer = [["expanded, k = 2", f"{budget['U_mm']:.4f}", "", ""]]
    return Table(columns, rows, f"Uncertainty of a length of {budget['length_mm']:.0f} mm", notes, footer)
