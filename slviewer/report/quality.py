"""Sections on the quality of a calibration: verdict, comparison of models, acceptance tests."""

from slviewer.records.table import Mark
from slviewer.records.verdict import Verdict
from slviewer.report.data import ModelsView
from slviewer.report.page import Headline, Item, PageNotice, Section

_LEVELS: dict[str, tuple[str, str]] = {
    "good": ("Good: no problems detected.", "good"),
    "doubtful": ("Doubtful: use it with care, or correct the causes first.", "warning"),
    "rejected": ("Rejected: do not measure with this calibration.", "warning"),
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
    """The section about the model that is used, and corrections of scale."""
    items: list[Item] = [
        PageNotice(f"{model}: {words}.", "plain") for model, words in models.scales.items()
    ]
    used = f"Measured with {models.used}"
    used += (
        "."
        if models.used == models.recommended
        else f", as the operator has chosen; recommended: {models.recommended}."
    )
    return Section("Model in use", used, items)
