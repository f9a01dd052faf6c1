"""HTML of a merge: pairs, loops, excluded pixels, and why a merge failed."""

from collections.abc import Mapping, Sequence

from slviewer.evaluation import letter
from slviewer.gui.help_links import help_link
from slviewer.gui.widgets import Html, alert, coloured, paragraph, records_html, to_html, use_labels
from slviewer.pipeline.stored_records import Stored
from slviewer.records.merge import Merge
from slviewer.registration.refusal import Reason


def merge_html(merge: Stored[Merge], labels: Mapping[str, str]) -> Html:
    """Describe a merge: the registered pairs, their loops, and what was excluded."""
    html = records_html([merge], labels, named=False)
    if len(merge.record.scans) == 3:
        html += _letter_html(merge.record)
    return html + paragraph(help_link("merge")) if merge.record.refused else html


def merge_failure_html(
    why: str,
    labels: Mapping[str, str],
    merge: Stored[Merge] | None = None,
    refusal: Reason | None = None,
) -> Html:
    """Describe why the last merge failed, with its ``refusal``; ``merge``: the previous one, which
    is still shown."""
    still = "" if merge is None else " The previous merge is shown below."
    link = help_link(f"merge-{refusal}" if refusal else "merge")
    return alert(
        Html(f"<b>Not merged.</b> {to_html(use_labels(why, labels) + still)} {link}"), "error"
    )


def turntable_html(
    names: Sequence[str], table_deg: Sequence[float], labels: Mapping[str, str]
) -> Html:
    """List the turntable angle of each scan."""
    turned = [
        f"{labels.get(name, name)} at {deg:g}°" for name, deg in zip(names, table_deg, strict=True)
    ]
    if len(turned) > 4:
        turned = [*turned[:3], "…", turned[-1]]
    note = "Direction and axis of the turntable are estimated."
    return paragraph(coloured(f"{', '.join(turned)}. {note}", "dim"))


def _letter_html(merge: Merge) -> Html:
    """Compare the point-to-point RMS with the Letter's for its own three scans."""
    theirs = " and ".join(f"{mm:.2f}" for mm in letter.EXPERIMENT_3_ICP_RMS_MM.values())
    ours = [
        pair.point_to_point_rms_mm
        for pair in merge.registered
        if merge.reference in (pair.scan, pair.onto)
    ]
    here = " and ".join(f"{mm:.2f}" for mm in ours if mm is not None)
    here = f"; here {here} mm" if here else ""
    return paragraph(coloured(f"Point-to-point RMS: {theirs} mm in the Letter{here}.", "dim"))
