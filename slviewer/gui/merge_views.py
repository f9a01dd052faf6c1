"""What the step Merge shows: clouds of the scans and of the merged surface, the merge in figures,
and why one failed."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from slviewer.evaluation import letter
from slviewer.gui.scene import Colour
from slviewer.gui.widgets import (
    Html,
    alert,
    help_link,
    note,
    paint,
    paragraph,
    records_html,
    to_html,
    use_labels,
)
from slviewer.pipeline.stored_records import Stored
from slviewer.records.merge import Merge
from slviewer.registration.refusal import Reason
from slviewer.session.ply import Ply
from slviewer.session.store import Session
from slviewer.wizard import result_views

AFTER, BEFORE = "scans, aligned", "scans, as captured"
OWN = "merged, texture"
BY_SCAN = "merged, by scan"
BY_SIGMA = "merged, uncertainty"
MERGED = (OWN, BY_SCAN, BY_SIGMA)
SCAN_COLOURS: tuple[Colour, ...] = (
    (91, 143, 208), (224, 161, 60), (99, 178, 138), (200, 113, 143), (143, 131, 201),
    (120, 120, 120),
)  # fmt: skip
_GREY: Colour = (150, 150, 150)
SHOWN = 60_000
"""Points of each cloud that are drawn."""


@dataclass(frozen=True, eq=False)
class ColouredClouds:
    """Clouds by name, points (..., 3) mm and colours each, with a legend; `view` changes with their
    positions.

    ``scans``: for clouds of scans, in the same order, what they were made from.
    """

    view: str
    clouds: Mapping[str, tuple[np.ndarray, np.ndarray | Colour]]
    legend: Html
    scans: tuple[result_views.ScanCloud, ...] = ()

    @cached_property
    def points(self) -> np.ndarray | None:
        """All points (n, 3) mm; None where there are none."""
        return (
            np.concatenate([points.reshape(-1, 3) for points, _ in self.clouds.values()])
            if self.clouds
            else None
        )


def colour_scans(
    session: Session,
    names: Sequence[str],
    places: Mapping[str, np.ndarray],
    titles: Mapping[str, str],
) -> ColouredClouds:
    """Load scans, each in a colour, at their ``places`` (4, 4), or as captured where they have
    none."""
    scans = tuple(result_views.load_scan_cloud(session, name) for name in names)
    clouds: dict[str, tuple[np.ndarray, np.ndarray | Colour]] = {}
    for i, cloud in enumerate(scans):
        T = places.get(cloud.name, np.eye(4))
        points = (cloud.points @ T[:3, :3].T + T[:3, 3]).astype(np.float32)
        clouds[cloud.name] = (points, SCAN_COLOURS[i % len(SCAN_COLOURS)])
    legend = _format_patches([titles.get(name, name) for name in names])
    return ColouredClouds("after" if places else "before", clouds, legend, scans)


def colour_merge(session: Session, merge: str, view: str, titles: Sequence[str]) -> ColouredClouds:
    """Load the surface of a merge, coloured by one of MERGED; ``titles`` are those of its scans, in
    order."""
    surface = result_views.merged_cloud(session, merge)
    legend, painted = _colour_surface(surface, view, titles)
    return ColouredClouds("merged", {"merged": (surface.points, painted)}, legend)


def patch(colour: Colour) -> Html:
    """Return a square of a colour, for a legend."""
    return Html(f'<span style="color:rgb{colour};font-size:1.3em">■</span>')


def _colour_surface(
    surface: Ply, view: str, titles: Sequence[str]
) -> tuple[Html, np.ndarray | Colour]:
    """Return (legend, colours (n, 3)) of a merged surface by texture, scan or uncertainty; grey
    where not stored."""
    source, sigma = surface.scalars.get("source"), surface.scalars.get("sigma")
    if view == BY_SCAN and source is not None:
        palette = np.array(SCAN_COLOURS, np.uint8)
        return _format_patches(titles), palette[source.astype(np.int64) % len(palette)]
    if view == BY_SIGMA and sigma is not None:
        known = np.where(sigma > 0, sigma, np.nan)
        unknown = "" if np.isfinite(known).all() else "; grey: unknown"
        title = f"uncertainty along the normal (1 sigma){unknown}"
        painted, bar = paint(known, "mm", 3, title)
        return bar, painted
    if view != OWN:
        return note("Not stored with this merge: merge again.", "warning"), _GREY
    if surface.colours is None:
        return note("The scans have no texture.", "warning"), _GREY
    return Html(""), surface.colours


def _format_patches(titles: Sequence[str]) -> Html:
    """Return a legend with a coloured square and a title for each scan."""
    items = [
        f"<span>{patch(SCAN_COLOURS[i % len(SCAN_COLOURS)])} {to_html(title)}</span>"
        for i, title in enumerate(titles)
    ]
    row = (
        '<div style="display:flex;flex-wrap:wrap;gap:0'
        f' 1em;align-items:center">{"".join(items)}</div>'
    )
    return paragraph(Html(row) if items else "")


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
    return note(f"{', '.join(turned)}. Direction and axis of the turntable are estimated.")


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
    return note(f"Point-to-point RMS: {theirs} mm in the Letter{here}.")
