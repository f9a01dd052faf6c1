"""HTML of a calibration: its verdict, excluded poses, and the comparison of its models."""

from collections.abc import Sequence

from slviewer.calibration.diagnosis.verdict import Finding, Verdict
from slviewer.evaluation.crossvalidation import CrossValidation
from slviewer.gui.widgets import Html, Tone, alert, coloured, paragraph, table, to_html
from slviewer.wizard.snapshot import CalibrationView, SplinedView

_LEVELS: dict[str, tuple[Tone, str, str]] = {
    "good": ("good", "Good", "no problems detected."),
    "doubtful": ("warning", "Doubtful", "use it with care, or correct this first:"),
    "rejected": ("error", "Rejected", "do not measure with it. Causes and remedies:"),
}
_MARKS: dict[Tone, str] = {
    "good": '<path d="M5 10.5l3.4 3.4L15 7"/>',
    "warning": '<path d="M10 4.5v7M10 15v.2"/>',
    "error": '<path d="M6 6l8 8M14 6l-8 8"/>',
}
MIN_WEIGHT = 0.7
"""Undisturbed poses have weights of 0.8 or more in the joint adjustment; those below this are listed."""


def verdict_html(verdict: Verdict, of_calibration: bool, calibration: CalibrationView | None) -> Html:
    """The level as text, colour and icon, then every finding with its remedy. `of_calibration`: whether the judged
    attempt made the current calibration."""
    tone, level, meaning = _LEVELS[verdict.level]
    lines = [
        f'<div style="display:flex;gap:0.5em;align-items:flex-start">{_icon(tone)}'
        f"<div>{coloured(level, tone, bold=True)}: {to_html(meaning)}</div></div>"
    ]
    lines += [_finding(finding) for finding in verdict.findings]
    if not of_calibration:
        left = (
            "This attempt gave no calibration."
            if calibration is None
            else "This attempt gave no calibration: the previous one is shown below."
        )
        lines.append(f'<div style="margin-top:0.5em">{to_html(left)}</div>')
    return alert(Html("".join(lines)), tone)


def named_poses(verdict: Verdict | None, calibration: CalibrationView | None) -> tuple[str, ...]:
    """Poses that the verdict or the joint adjustment names, each once."""
    names = [name for finding in verdict.findings for name in finding.poses] if verdict else []
    if calibration is not None and calibration.splined is not None:
        names += calibration.splined.excluded
    return tuple(dict.fromkeys(names))


def exclusions_html(calibration: CalibrationView) -> Html:
    """Excluded poses and features, each with its reason; empty where there are none."""
    n = calibration.stereo.features_set_aside
    features = (
        f"{n} outlying feature{'s' * (n != 1)} excluded (beyond 6 robust sigma): shadow or occlusion." if n else ""
    )
    note = paragraph(coloured(features, "dim")) if features else Html("")
    lines = [f"{name}: {why}" for name, why in calibration.stereo.left_out.items()]
    if calibration.splined is not None:
        lines += [f"{name}, in the splined model only: it {why}" for name, why in calibration.splined.excluded.items()]
    if not lines:
        return note
    items = "".join(f'<li style="margin:0.15em 0">{to_html(_capitalise(line))}</li>' for line in lines)
    listed = f'<ul style="margin:0.2em 0 0;padding-left:1.2em">{items}</ul>'
    return Html(alert(Html(f"{coloured('Excluded', 'warning', bold=True)}{listed}"), "warning") + note)


def comparison_table(comparison: CrossValidation, best: str) -> Html:
    """The models on held-out poses; the one in use in bold."""
    figures = {"plane_mm": 3, "board_mm": 3, "scale_ppm": 0, "camera_px": 3, "projector_px": 3}
    rms = {model: {figure: comparison.rms(model, figure) for figure in figures} for model in comparison.models}
    rows: list[list[Html]] = []
    for model, values in rms.items():
        row = [coloured(model, "plain", bold=model == best)]
        for figure, digits in figures.items():
            least = figure in ("plane_mm", "board_mm", "camera_px") and len(rms) > 1
            good = least and values[figure] == min(each[figure] for each in rms.values())
            row.append(coloured(f"{values[figure]:.{digits}f}", "good" if good else "plain", bold=good))
        rows.append(row)
    titles = ("Held-out RMS", "Plane, mm", "Board, mm", "Scale, ppm", "Camera, px", "Projector, px")
    note = (
        f"{len(next(iter(comparison.poses.values())))} poses, each measured by calibrations without it "
        f"({len(comparison.folds)} folds). Board: distance of its features from their true positions."
    )
    failed = "".join(
        alert(f"{model} could not be compared: {why}", "warning") for model, why in comparison.failed.items()
    )
    return Html(table(titles, rows) + paragraph(coloured(note, "dim")) + failed)


def model_choice_html(calibration: CalibrationView) -> Html:
    """Which model is used, and why."""
    if calibration.chosen and calibration.chosen != calibration.recommended:
        return alert(
            f"{calibration.chosen} is used (your choice); {calibration.recommended} is recommended.", "warning"
        )
    if len(calibration.models) < 2:
        return Html("")
    if calibration.comparison is None:
        why = "default; compare the models to confirm it."
    elif calibration.recommended in calibration.comparison.models:
        why = "smallest error on held-out boards."
    else:
        why = "default."
    return paragraph(Html(f"{coloured(calibration.best, 'good', bold=True)} is used: {to_html(why)}"))


def splined_table(splined: SplinedView) -> Html:
    """The figures of the joint adjustment."""
    noise, distortion, covered = splined.noise_px, splined.distortion_px, splined.covered
    low, high = splined.height_mm
    rows: list[tuple[object, object]] = [
        ("Residual noise, camera", f"{noise['camera']:.4f} px"),
        ("Residual noise, projector x / y", f"{noise['x']:.4f} / {noise['y']:.4f} px"),
        ("Local distortion, camera / projector", f"{distortion['camera']:.3f} / {distortion['projector']:.3f} px"),
        ("Board height, peak to valley", f"{high - low:.3f} mm"),
        ("Board feature offsets, RMS", f"{splined.offset_mm:.3f} mm"),
        ("Covered, camera / projector", f"{100 * covered['camera']:.0f} / {100 * covered['projector']:.0f} %"),
    ]
    if suspect := [f"{name} {min(pair):.2f}" for name, pair in splined.weights.items() if min(pair) < MIN_WEIGHT]:
        rows.append((f"Poses with weight below {MIN_WEIGHT:g}", Html("<br>".join(map(to_html, suspect)))))
    if splined.turned:
        rows.append(("Board turned by 180°, corrected", Html("<br>".join(map(to_html, splined.turned)))))
    note = "Pixels outside the calibrated region are masked."
    return Html(table(("Joint adjustment", ""), rows) + paragraph(coloured(note, "dim")))


def _finding(finding: Finding) -> str:
    text = to_html(_capitalise(finding.sentence, finding.poses))
    if finding.severity == "note":
        return f'<div style="margin-top:0.5em">{coloured("Corrected:", "dim")} {text}.</div>'
    remedy = coloured(f"{finding.remedy[:1].upper()}{finding.remedy[1:]}.", "plain", bold=True)
    return f'<div style="margin-top:0.5em">{text}.<br>→ {remedy}</div>'


def _capitalise(text: str, names: Sequence[str] = ()) -> str:
    """The text with a capital first letter, unless it begins with a name."""
    named = any(text.startswith(name) for name in names) or text.split(":")[0].count("_")
    return text if named else text[:1].upper() + text[1:]


def _icon(tone: Tone) -> str:
    colour = {"good": "green-7", "warning": "orange-7", "error": "red-7"}[tone]
    return (
        '<svg viewBox="0 0 20 20" width="22" height="22" style="flex:none" fill="none" stroke="#fff" '
        'stroke-width="2.2" stroke-linecap="round" stroke-linejoin="round">'
        f'<circle cx="10" cy="10" r="10" stroke="none" fill="var(--mantine-color-{colour})"/>{_MARKS[tone]}</svg>'
    )
