"""Rows of figures as text with aligned columns."""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import replace

from slviewer.records.table import Row, Table, render_text


def render(rows: Sequence[Row]) -> str:
    """Format rows as text with aligned columns: names to the left, figures to the right. Empty
    without rows."""
    return render_text(replace(Table.of(rows), repeats=True)) if rows else ""


def format_count(count: int, noun: str) -> str:
    """Format a count and its noun, in the plural unless the count is 1."""
    return f"{count} {noun}{'' if count == 1 else 's'}"


def format_counts(purposes: Iterable[str]) -> str:
    """Format how many captures there are of each purpose: "8 poses, 3 scans, 1 plane"; planes and
    spheres only where there are any."""
    n = {"pose": 0, "scan": 0, **Counter(purposes)}
    return ", ".join(format_count(count, purpose) for purpose, count in n.items())
