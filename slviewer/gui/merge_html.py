"""HTML of a merge: pairs, loops, excluded pixels, and why a merge failed."""

import re
from collections.abc import Mapping, Sequence

from slviewer.evaluation import letter
from slviewer.gui.help_links import help_link
from slviewer.gui.widgets import Html, Tone, alert, coloured, meter, paragraph, table, to_html
from slviewer.registration.refusal import Reason
from slviewer.wizard.snapshot import MergedLoop, MergedPair, MergeView
from slviewer.wizard.steps import MIN_OVERLAP

_MOST_LOOPS = 3
_STRAY = {
    "edges": "at depth edges",
    "grazing": "at grazing angles",
    "groups": "in small groups",
    "far": "isolated",
    "unconfirmed": "contradicted by other scans",
}


def merge_html(merge: MergeView, labels: Mapping[str, str]) -> Html:
    """Describe a merge: the alignment of the scans, their loops, and the excluded pixels."""
    onto = sorted(merge.registered, key=lambda pair: merge.reference not in (pair.scan, pair.onto))
    parts = [_pairs_table(onto, labels)]
    if len(merge.scans) == 3:
        parts.append(_letter_html(merge))
    if merge.loops:
        parts.append(_loops_table(merge.loops, labels))
    if merge.markers:
        common = "; ".join(
            f"{_get_label(scan, labels)} → {_get_label(onto, labels)} {count}, {rms_mm:.3f} mm"
            for scan, onto, count, rms_mm in merge.markers
        )
        parts.append(paragraph(coloured(f"Common markers, and RMS distance of their corners: {common}.", "dim")))
    parts += [alert(use_labels(why, labels), "warning") for why in merge.dropped]
    if merge.refused:
        pairs = "".join(f"<li>{to_html(use_labels(why, labels))}</li>" for why in merge.refused)
        title = "Pairs that could not be registered"
        pairs += f"<li>{help_link('merge')}</li>"
        parts.append(
            paragraph(Html(f'<details><summary>{title}</summary><ul style="padding-left:1.4em">{pairs}</ul></details>'))
        )
    stale = coloured("Out of date: merge again.", "warning") if merge.stale else ""
    whole = f"<b>{merge.points:,} points</b> in the frame of {to_html(_get_label(merge.reference, labels))}"
    if merge.shared is not None:
        whole += f", {100 * merge.shared:.0f}&nbsp;% measured by several scans"
    parts.append(paragraph(Html(f"{whole}. {stale}")))
    if stray := [f"{count:,} {_STRAY.get(what, what)}" for what, count in merge.stray.items() if count]:
        parts.append(paragraph(coloured(f"Excluded pixels: {', '.join(stray)}.", "dim")))
    return Html("".join(parts))


def merge_failure_html(
    why: str, labels: Mapping[str, str], merge: MergeView | None = None, refusal: Reason | None = None
) -> Html:
    """Describe why the last merge failed, with its ``refusal``; ``merge``: the previous one, which is still shown."""
    still = "" if merge is None else " The previous merge is shown below."
    link = help_link(f"merge-{refusal}" if refusal else "merge")
    return alert(Html(f"<b>Not merged.</b> {to_html(use_labels(why, labels) + still)} {link}"), "error")


def turntable_html(names: Sequence[str], table_deg: Sequence[float], labels: Mapping[str, str]) -> Html:
    """List the turntable angle of each scan."""
    turned = [f"{_get_label(name, labels)} at {deg:g}°" for name, deg in zip(names, table_deg, strict=True)]
    if len(turned) > 4:
        turned = [*turned[:3], "…", turned[-1]]
    note = "Direction and axis of the turntable are estimated."
    return paragraph(coloured(f"{', '.join(turned)}. {note}", "dim"))


def use_labels(sentence: str, labels: Mapping[str, str]) -> str:
    """Replace the captures' names in a sentence by the operator's labels."""
    names = [re.escape(name) for name, label in labels.items() if label != name]
    return re.sub(rf"(?<![\w.-])({'|'.join(names)})(?![\w-])", lambda m: labels[m[1]], sentence) if names else sentence


def _get_label(name: str, labels: Mapping[str, str]) -> str:
    """Return the operator's label of a capture, or its name."""
    return labels.get(name, name)


def _pairs_table(pairs: Sequence[MergedPair], labels: Mapping[str, str]) -> Html:
    """Return a table of the registered pairs: RMS, overlap, standard deviation and motion."""
    rows = []
    for pair in pairs:
        tone: Tone = "good" if pair.overlap >= MIN_OVERLAP else "warning"
        moved = (
            [f"{pair.turned_deg:.2f}°"]
            if pair.moved_mm is None
            else [f"{pair.moved_mm:.2f} mm", f"{pair.turned_deg:.2f}°"]
        )
        sigma = ["–"]
        if pair.sigma_mm is not None and pair.sigma_deg is not None:
            sigma = [f"{pair.sigma_mm:.4f} mm", f"{pair.sigma_deg:.4f}°"]
        rows.append(
            (
                _join_lines(_get_label(pair.scan, labels), f"to {_get_label(pair.onto, labels)}"),
                coloured(f"{pair.rms_mm:.3f} mm", "plain", bold=True),
                Html(f"{to_html(f'{100 * pair.overlap:.0f} %')}{meter(pair.overlap, tone)}"),
                _join_lines(*sigma),
                _join_lines(*moved),
            )
        )
    html = table(("Scan", "RMS", "Overlap", "Sigma", "Motion"), rows)
    return Html(f'<div style="max-height:21em;overflow-y:auto">{html}</div>')


def _letter_html(merge: MergeView) -> Html:
    """Compare the point-to-point RMS with the Letter's for its own three scans."""
    theirs = " and ".join(f"{mm:.2f}" for mm in letter.EXPERIMENT_3_ICP_RMS_MM.values())
    ours = [pair.point_mm for pair in merge.registered if merge.reference in (pair.scan, pair.onto)]
    here = " and ".join(f"{mm:.2f}" for mm in ours if mm is not None)
    here = f"; here {here} mm" if here else ""
    return paragraph(coloured(f"Point-to-point RMS: {theirs} mm in the Letter{here}.", "dim"))


def _loops_table(loops: Sequence[MergedLoop], labels: Mapping[str, str]) -> Html:
    """Return a table of the worst loops: closure error before and after the joint adjustment."""
    rows = []
    for loop in loops[:_MOST_LOOPS]:
        through = [_get_label(name, labels) for name in loop.scans]
        if len(through) > 4:
            through = [*through[:2], "…", through[-1]]
        rows.append(
            (
                " – ".join([*through, through[0]]),
                _join_lines(f"{loop.error_mm:.3f} mm", f"{loop.error_deg:.4f}°"),
                _join_lines(f"{loop.adjusted_mm:.3f} mm", f"{loop.adjusted_deg:.4f}°"),
            )
        )
    worst = f" (worst of {len(loops)})" if len(loops) > 1 else ""
    return table((f"Loop closure{worst}", "Before", "After"), rows)


def _join_lines(*texts: str) -> Html:
    """Join texts by HTML line breaks."""
    return Html("<br>".join(map(to_html, texts)))
