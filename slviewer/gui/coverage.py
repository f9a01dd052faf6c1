"""What the poses cover so far, as a picture: the image's cells, near to far, and the ways the board was tilted."""

import numpy as np

from slviewer.calibration.next_pose import GOAL, Coverage
from slviewer.gui.widgets import Html, block, cell, toned

_COLOURS = ("var(--mantine-color-gray-light)", "var(--mantine-color-green-3)", "var(--mantine-color-green-6)")
_ARROWS = {"facing": (1, 1, "●"), "top away": (0, 1, "▲"), "right away": (1, 2, "▶"), "bottom away": (2, 1, "▼"),
           "left away": (1, 0, "◀")}  # fmt: skip


def coverage_chart(coverage: Coverage) -> Html:
    """Three small charts side by side; a field is full once GOAL poses cover it."""
    image = _grid(coverage.cells, 17, 17)
    depths = "".join(
        f'<div style="display:flex;align-items:center;gap:0.4em">{_field(n, 44, 15)}<span>{name}</span></div>'
        for name, n in zip(("near", "middle", "far"), coverage.depths, strict=True)
    )
    tilts = np.full((3, 3), -1)
    for (row, column, _), n in zip(_ARROWS.values(), coverage.tilts, strict=True):
        tilts[row, column] = n
    arrows = {(row, column): arrow for row, column, arrow in _ARROWS.values()}
    tilted = _grid(tilts, 17, 17, arrows)
    near, far = coverage.range_mm
    charts = "".join(
        f'<div><div style="color:var(--mantine-color-dimmed);margin-bottom:0.2em">{cell(title)}</div>{chart}</div>'
        for title, chart in (
            ("In the image", image),
            (f"Depth, {near:.0f} to {far:.0f} mm", depths),
            ("Tilted away", tilted),
        )
    )
    share = 100 * coverage.share
    title = toned(f"Coverage {share:.0f} %", "good" if share > 90 else "plain", bold=True)
    return block(
        Html(f'<div>{title}</div><div style="display:flex;justify-content:space-between;gap:0.8em">{charts}</div>')
    )


def _grid(counts: np.ndarray, width: int, height: int, marks: dict[tuple[int, int], str] | None = None) -> str:
    rows = "".join(
        '<div style="display:flex;gap:2px;margin-bottom:2px">'
        + "".join(_field(n, width, height, (marks or {}).get((i, j), "")) for j, n in enumerate(row))
        + "</div>"
        for i, row in enumerate(counts)
    )
    return f"<div>{rows}</div>"


def _field(count: int, width: int, height: int, mark: str = "") -> str:
    colour = "transparent" if count < 0 else _COLOURS[min(int(count), GOAL)]
    style = (
        f"width:{width}px;height:{height}px;border-radius:2px;background:{colour};font-size:9px;line-height:{height}px"
    )
    return f'<div style="{style};text-align:center">{mark}</div>'
