"""What is said of a calibration: its verdict, what was left out of it, and how its models compare."""

from collections.abc import Sequence

from slviewer.calibration.diagnosis.verdict import Finding, Verdict
from slviewer.gui.widgets import Html, Tone, block, boxed, cell, table, toned
from slviewer.wizard.snapshot import CalibrationView, ComparisonView, SplinedView

_LEVELS: dict[str, tuple[Tone, str, str]] = {
    "good": ("good", "Good", "nothing that was seen speaks against this calibration."),
    "doubtful": ("warning", "Doubtful", "it may be used with care; better mend this first:"),
    "rejected": ("error", "Rejected", "do not measure with this. What is wrong, and how to mend it:"),
}
_MARKS: dict[Tone, str] = {
    "good": '<path d="M5 10.5l3.4 3.4L15 7"/>',
    "warning": '<path d="M10 4.5v7M10 15v.2"/>',
    "error": '<path d="M6 6l8 8M14 6l-8 8"/>',
}
LEAST_TRUST = 0.7
"""Undisturbed poses are trusted 0.8 or more by the joint adjustment; below this, a pose is told of."""


def verdict_words(verdict: Verdict, of_calibration: bool, calibration: CalibrationView | None) -> Html:
    """The level in words, colour and an icon, then every finding with what to do. `of_calibration`: whether the attempt
    that was judged made the calibration at hand."""
    tone, level, meaning = _LEVELS[verdict.level]
    lines = [
        f'<div style="display:flex;gap:0.5em;align-items:flex-start">{_icon(tone)}'
        f"<div>{toned(level, tone, bold=True)}: {cell(meaning)}</div></div>"
    ]
    lines += [_finding(finding) for finding in verdict.findings]
    if not of_calibration:
        left = (
            "Nothing came of this attempt."
            if calibration is None
            else "Nothing came of this attempt: what is shown below is the calibration from before."
        )
        lines.append(f'<div style="margin-top:0.5em">{cell(left)}</div>')
    return boxed(Html("".join(lines)), tone)


def named_poses(verdict: Verdict | None, calibration: CalibrationView | None) -> tuple[str, ...]:
    """Poses that the verdict or the joint adjustment speak of, each once."""
    names = [name for finding in verdict.findings for name in finding.poses] if verdict else []
    if calibration is not None and calibration.splined is not None:
        names += calibration.splined.left_out
    return tuple(dict.fromkeys(names))


def set_aside_words(calibration: CalibrationView) -> Html:
    """Poses and features that were left out, each with its reason; empty where there are none."""
    features = ""
    if n := calibration.features_set_aside:
        features = (
            f"{n} feature{'s' * (n != 1)} of the board set aside, beyond 6 robust sigma: shaded, or hidden in part."
        )
    lines = [f"{name}: {why}" for name, why in calibration.left_out.items()]
    if calibration.splined is not None:
        lines += [f"{name}, of the splined model alone: it {why}" for name, why in calibration.splined.left_out.items()]
    aside = block(toned(features, "dim")) if features else Html("")
    if not lines:
        return aside
    items = "".join(f'<li style="margin:0.15em 0">{cell(_sentence(line))}</li>' for line in lines)
    listed = f'<ul style="margin:0.2em 0 0;padding-left:1.2em">{items}</ul>'
    return Html(boxed(Html(f"{toned('Left out', 'warning', bold=True)}{listed}"), "warning") + aside)


def comparison_table(comparison: ComparisonView, best: str) -> Html:
    """The models on poses that they were not made from; the one in use in bold."""
    least = {
        figure: min(getattr(row, figure) for row in comparison.models)
        for figure in ("plane_mm", "board_mm", "camera_px")
    }

    def shown(value: float, figure: str) -> Html:
        good = len(comparison.models) > 1 and value == least.get(figure)
        return toned(f"{value:.3f}", "good" if good else "plain", bold=good)

    rows = [
        (
            toned(row.model, "plain", bold=row.model == best),
            shown(row.plane_mm, "plane_mm"),
            shown(row.board_mm, "board_mm"),
            f"{row.scale_ppm:.0f}",
            shown(row.camera_px, "camera_px"),
            f"{row.projector_px:.3f}",
        )
        for row in comparison.models
    ]
    said = table(
        ("On poses left out", "plane RMS, mm", "board RMS, mm", "scale, ppm", "camera, px", "projector, px"), rows
    )
    note = (
        f"Each of {comparison.poses} poses was measured by calibrations made without it and its fold "
        f"({comparison.folds} folds). Board: how far its features lie from where they are on it."
    )
    failed = "".join(boxed(f"{model} is not judged: {why}", "warning") for model, why in comparison.failed.items())
    return Html(said + block(toned(note, "dim")) + failed)


def choice_words(calibration: CalibrationView) -> Html:
    """Which model is used, and why."""
    if calibration.chosen and calibration.chosen != calibration.recommended:
        return boxed(
            f"{calibration.chosen} is used, as you have chosen; {calibration.recommended} is recommended.", "warning"
        )
    if len(calibration.models) < 2:
        return Html("")
    if calibration.comparison is None:
        why = "the usual choice; compare the models to be sure."
    elif calibration.recommended in {row.model for row in calibration.comparison.models}:
        why = "it measures boards best that it was not made from."
    else:
        why = "the usual choice."
    return block(Html(f"{toned(calibration.best, 'good', bold=True)} is used: {cell(why)}"))


def splined_table(splined: SplinedView) -> Html:
    """The joint adjustment's figures, in words."""
    noise, local, lit = splined.noise_px, splined.local_px, splined.lit
    low, high = splined.height_mm
    rows: list[tuple[object, object]] = [
        ("noise left in the camera", f"{noise['camera']:.4f} px"),
        ("noise left in the projector, x / y", f"{noise['x']:.4f} / {noise['y']:.4f} px"),
        ("local distortion learnt, camera / projector", f"{local['camera']:.3f} / {local['projector']:.3f} px"),
        ("the board's bow, lowest to highest", f"{high - low:.3f} mm"),
        ("its features, misplaced by (RMS)", f"{splined.misplaced_mm:.3f} mm"),
        (
            "seen by target poses, camera / projector",
            f"{100 * lit['camera']:.0f} / {100 * lit['projector']:.0f} %",
        ),
    ]
    if suspect := [f"{name} {min(pair):.2f}" for name, pair in splined.trust.items() if min(pair) < LEAST_TRUST]:
        rows.append((f"poses trusted below {LEAST_TRUST:g}", ", ".join(suspect)))
    if splined.turned:
        rows.append(("board turned by 180°, numbered as in the others", ", ".join(splined.turned)))
    note = "Pixels that look where no target pose was are masked."
    return Html(table(("Joint adjustment", ""), rows) + block(toned(note, "dim")))


def _finding(finding: Finding) -> str:
    said = cell(_sentence(finding.sentence, finding.poses))
    if finding.severity == "note":
        return f'<div style="margin-top:0.5em">{toned("Mended already:", "dim")} {said}.</div>'
    remedy = toned(f"{finding.remedy[:1].upper()}{finding.remedy[1:]}.", "plain", bold=True)
    return f'<div style="margin-top:0.5em">{said}.<br>→ {remedy}</div>'


def _sentence(text: str, names: Sequence[str] = ()) -> str:
    """With a capital at its head, unless it begins with a name."""
    named = any(text.startswith(name) for name in names) or text.split(":")[0].count("_")
    return text if named else text[:1].upper() + text[1:]


def _icon(tone: Tone) -> str:
    colour = {"good": "green-7", "warning": "orange-7", "error": "red-7"}[tone]
    return (
        '<svg viewBox="0 0 20 20" width="22" height="22" style="flex:none" fill="none" stroke="#fff" '
        'stroke-width="2.2" stroke-linecap="round" stroke-linejoin="round">'
        f'<circle cx="10" cy="10" r="10" stroke="none" fill="var(--mantine-color-{colour})"/>{_MARKS[tone]}</svg>'
    )
