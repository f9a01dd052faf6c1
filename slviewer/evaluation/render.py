"""Rows of figures as text with aligned columns."""

from collections.abc import Sequence
from typing import Any

Row = dict[str, Any]
"""Column titles and cells; a title that ends in % or radius, or holds ratio, sets its column's decimals."""


def render(table: Sequence[Row]) -> str:
    """Format rows as text with aligned columns: names to the left, figures to the right, ``-`` for unknown values.

    Titles stand above their columns one word a line, so that wide tables stay narrow.
    """
    if not table:
        return ""
    titles = list(dict.fromkeys(title for row in table for title in row))
    words = [title.split() for title in titles]
    height = max(len(w) for w in words)
    head = [list(line) for line in zip(*([""] * (height - len(w)) + w for w in words), strict=True)]
    body = [[_format_cell(title, row.get(title)) for title in titles] for row in table]
    widths = [max(len(line[k]) for line in head + body) for k in range(len(titles))]

    def laid_out(line: list[str]) -> str:
        """Return one row as text: the first cell aligned to the left, the others to the right."""
        return "  ".join(
            text.rjust(width) if k else text.ljust(width)
            for k, (text, width) in enumerate(zip(line, widths, strict=True))
        ).rstrip()

    rule = "-" * (sum(widths) + 2 * (len(widths) - 1))
    lines = [*map(laid_out, head), rule, *map(laid_out, body)]
    if table[-1].get(titles[0]) == "mean":
        lines.insert(-1, rule)
    return "\n".join(lines)


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
