"""HTML of a calibration: its verdict, excluded poses, and the comparison of its models."""

from collections.abc import Sequence

from slviewer.gui.help_links import help_link
from slviewer.gui.widgets import Html, Tone, alert, coloured, paragraph, to_html
from slviewer.records.model_comparison import ModelComparison
from slviewer.records.verdict import Finding, Verdict
from slviewer.wizard.snapshot import CalibrationView

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


def verdict_html(
    verdict: Verdict, of_calibration: bool, calibration: CalibrationView | None
) -> Html:
    """Return the verdict as text, colour and icon, then every finding with its remedy.

    `of_calibration`: whether the judged attempt made the current calibration.
    """
    tone, level, meaning = _LEVELS[verdict.level]
    lines = [
        f'<div style="display:flex;gap:0.5em;align-items:flex-start">{_draw_icon(tone)}'
        f"<div>{coloured(level, tone, bold=True)}: {to_html(meaning)}</div></div>"
    ]
    lines += [_format_finding(finding) for finding in verdict.findings]
    if not of_calibration:
        consequence = (
            "This attempt gave no calibration."
            if calibration is None
            else "This attempt gave no calibration: the previous one is shown below."
        )
        lines.append(f'<div style="margin-top:0.5em">{to_html(consequence)}</div>')
    return alert(Html("".join(lines)), tone)


def named_poses(verdict: Verdict | None, calibration: CalibrationView | None) -> tuple[str, ...]:
    """List the poses that the verdict or the joint adjustment names, each once."""
    names = [name for finding in verdict.findings for name in finding.poses] if verdict else []
    if calibration is not None and calibration.splined is not None:
        names += calibration.splined.excluded
    return tuple(dict.fromkeys(names))


def exclusions_html(calibration: CalibrationView) -> Html:
    """List excluded poses and features, each with its reason; empty where there are none."""
    n = calibration.stereo.features_excluded
    features = (
        f"{n} outlying feature{'s' * (n != 1)} excluded (beyond 6 robust sigma): shadow or"
        " occlusion."
        if n
        else ""
    )
    note = paragraph(coloured(features, "dim")) if features else Html("")
    lines = [f"{name}: {why}" for name, why in calibration.stereo.excluded.items()]
    if calibration.splined is not None:
        lines += [
            f"{name}, in the splined model only: it {why}"
            for name, why in calibration.splined.excluded.items()
        ]
    if not lines:
        return note
    items = "".join(
        f'<li style="margin:0.15em 0">{to_html(_capitalise(line))}</li>' for line in lines
    )
    listed = f'<ul style="margin:0.2em 0 0;padding-left:1.2em">{items}</ul>'
    return Html(
        alert(Html(f"{coloured('Excluded', 'warning', bold=True)}{listed}"), "warning") + note
    )


def model_choice_html(calibration: CalibrationView, compared: ModelComparison | None) -> Html:
    """Describe which model is used, and why, by their comparison if there is one; empty where there
    is one model."""
    if calibration.chosen and calibration.chosen != calibration.recommended:
        return alert(
            f"{calibration.chosen} is used (your choice); {calibration.recommended} is"
            " recommended.",
            "warning",
        )
    if len(calibration.models) < 2:
        return Html("")
    if compared is None:
        why = "default; compare the models to confirm it."
    elif calibration.recommended in compared.models:
        why = "smallest error on held-out boards."
    else:
        why = "default."
    return paragraph(
        Html(f"{coloured(calibration.best, 'good', bold=True)} is used: {to_html(why)}")
    )


def _format_finding(finding: Finding) -> str:
    """Return the HTML of a finding and its remedy."""
    text, link = to_html(_capitalise(finding.sentence, finding.poses)), help_link(finding.cause)
    if finding.severity == "note":
        return f'<div style="margin-top:0.5em">{coloured("Corrected:", "dim")} {text}. {link}</div>'
    remedy = coloured(f"{finding.remedy[:1].upper()}{finding.remedy[1:]}.", "plain", bold=True)
    return f'<div style="margin-top:0.5em">{text}.<br>→ {remedy} {link}</div>'


def _capitalise(text: str, names: Sequence[str] = ()) -> str:
    """Return the text with a capital first letter, unless it begins with a name."""
    named = any(text.startswith(name) for name in names) or text.split(":")[0].count("_")
    return text if named else text[:1].upper() + text[1:]


def _draw_icon(tone: Tone) -> str:
    """Return the SVG icon of a tone: a disc with a check mark, an exclamation mark or a cross."""
    colour = {"good": "green-7", "warning": "orange-7", "error": "red-7"}[tone]
    return (
        '<svg viewBox="0 0 20 20" width="22" height="22" style="flex:none" fill="none"'
        ' stroke="#fff" stroke-width="2.2" stroke-linecap="round" stroke-linejoin="round"><circle'
        ' cx="10" cy="10" r="10" stroke="none"'
        f' fill="var(--mantine-color-{colour})"/>{_MARKS[tone]}</svg>'
    )
