"""Rows of figures as text with aligned columns."""

from collections.abc import Sequence
from dataclasses import replace

from slviewer.records.record import Row, Table, render_text


def render(rows: Sequence[Row]) -> str:
    """Format rows as text with aligned columns: names to the left, figures to the right. Empty
    without rows."""
    return render_text(replace(Table.of(rows), repeats=True)) if rows else ""
