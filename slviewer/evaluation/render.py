"""Rows of figures as text with aligned columns."""

from collections.abc import Sequence
from typing import Any

from slviewer.records.table import align_columns

Row = dict[str, Any]
"""Column titles and cells; a title that ends in % or radius, or holds ratio, sets its column's
decimals."""


def render(table: Sequence[Row]) -> str:
    """Format rows as text with aligned columns: names to the left, figures to the right, ``-`` for
    unknown values.

    Titles stand above their columns one word a line, so that wide tables stay narrow.
    """
    if not table:
        return ""
    titles = list(dict.fromkeys(title for row in table for title in row))
    body = [[_format_cell(title, row.get(title)) for title in titles] for row in table]
    is_left = [index == 0 for index in range(len(titles))]
    return "\n".join(align_columns(titles, body, is_left, int(table[-1].get(titles[0]) == "mean")))


def _format_cell(title: str, value: Any) -> str:
    """Format a value for the table, with the digits that its column's title calls for."""
    if value is None or value != value:  # NaN
        return "-"
    if isinstance(value, str | int):
        return str(value)
    if "ratio" in title:
        return f"{value:.2f}"
    if title.endswith("radius"):
        return f"{value:.3f}"
    return f"{value:.1f}" if title.endswith("%") else f"{value:.3f}"


def format_count(count: int, noun: str) -> str:
    """Format a count and its noun, in the plural unless the count is 1."""
    return f"{count} {noun}{'' if count == 1 else 's'}"
