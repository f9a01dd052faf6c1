"""Clouds of the step Merge: the scans, and the merged surface."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from slviewer.gui.scene import Colour
from slviewer.gui.widgets import Html, coloured, paint, paragraph, to_html
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

    ``scans``: for clouds of scans, in the same order, what they were made from, and their poses (4,
    4) in the view.
    """

    view: str
    clouds: Mapping[str, tuple[np.ndarray, np.ndarray | Colour]]
    legend: Html
    scans: tuple[tuple[result_views.ScanCloud, np.ndarray], ...] = ()

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
    scans = tuple(
        (result_views.load_scan_cloud(session, name), places.get(name, np.eye(4))) for name in names
    )
    clouds: dict[str, tuple[np.ndarray, np.ndarray | Colour]] = {}
    for i, (cloud, T) in enumerate(scans):
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
    source, sigma, own = (
        surface.scalars.get("source"),
        surface.scalars.get("sigma"),
        surface.colours,
    )
    if view == BY_SCAN and source is not None:
        palette = np.array(SCAN_COLOURS, np.uint8)
        return _format_patches(titles), palette[source.astype(np.int64) % len(palette)]
    if view == BY_SIGMA and sigma is not None:
        known = np.where(sigma > 0, sigma, np.nan)
        title = "uncertainty along the normal (1 sigma)" + (
            "" if np.isfinite(known).all() else "; grey: unknown"
        )
        painted, bar = paint(known, "mm", 3, title)
        return bar, painted
    if view == OWN and own is not None:
        return Html(""), own
    missing = (
        "Not stored with this merge: merge again." if view != OWN else "The scans have no texture."
    )
    return paragraph(coloured(missing, "warning")), _GREY


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
    return paragraph(Html(row)) if items else Html("")
