"""Tables of figures with units: what the terminal, pages, panels and CSV files draw."""

import math
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

from slviewer.errors import InputError

Mark = Literal["", "better", "worse", "strong", "muted"]
"""How a value compares with its rivals; colour and weight follow it, and the text beside it says so
in words."""
Value = str | int | float | None
"""Of a cell; None and NaN are unknown."""
UNKNOWN = "–"
EQUAL = 0.02
"""Two errors that differ by less than this share are called equal."""


@dataclass(frozen=True)
class Cell:
    """A table cell whose value is marked."""

    value: Value
    mark: Mark = ""


Rows = list[list[Value | Cell]]
Row = dict[Any, Any]
"""{column, or its title: value or cell}."""


@dataclass(frozen=True)
class Column:
    """A column's heading, its unit, the group of neighbours that it shares a heading with, and the
    decimals of its numbers. ``align``: by default a `Table` puts texts to the left, numbers to the
    right. ``detail``: left out where a table is narrow."""

    title: str
    unit: str = ""
    group: str = ""
    align: Literal["", "left", "right", "centre"] = ""
    digits: int = 3
    detail: bool = False

    @property
    def heading(self) -> str:
        """Group, title and unit in one line."""
        return " ".join(filter(None, (self.group, self.title, self.unit)))

    def format(self, value: Value) -> str:
        """Return a value as text: numbers with the column's decimals, halves rounded up and no
        minus before nothing; a dash for unknown ones."""
        if value is None or (isinstance(value, float) and not math.isfinite(value)):
            return UNKNOWN
        if isinstance(value, str):
            return value
        if isinstance(value, int):
            return f"{value:,}"
        rounded = round(value * (1 + 1e-9), self.digits) + 0.0
        return f"{rounded:.{self.digits}f}".replace("-", "−")


@dataclass(frozen=True)
class Table:
    """Rows of values or cells under columns; ``footer`` rows (means) stand apart below, then
    ``notes``. ``repeats``: names that repeat the one above are shown."""

    columns: Sequence[Column]
    rows: Sequence[Sequence[Value | Cell]]
    caption: str
    notes: Sequence[str] = ()
    footer: Sequence[Sequence[Value | Cell]] = ()
    repeats: bool = False

    def __post_init__(self) -> None:
        for row in (*self.rows, *self.footer):
            if len(row) != len(self.columns):
                raise InputError(
                    f"a row of the table '{self.caption}' has {len(row)} cells and the table"
                    f" {len(self.columns)} columns: give one cell a column"
                )
        aligned = [
            column if column.align else replace(column, align="left" if is_text else "right")
            for column, is_text in zip(self.columns, self._find_texts(), strict=True)
        ]
        object.__setattr__(self, "columns", aligned)

    @classmethod
    def of(
        cls,
        rows: Sequence[Row],
        caption: str = "",
        notes: Sequence[str] = (),
        footer: Sequence[Row] = (),
    ) -> "Table":
        """Return the table of rows by column; a value that a row lacks is unknown. A title that
        ends in % or holds ratio sets its column's decimals."""
        headings = list(dict.fromkeys(heading for row in rows for heading in row))
        columns = [each if isinstance(each, Column) else _make_column(each) for each in headings]
        cells = [list(map(row.get, headings)) for row in rows]
        below = [[row.get(heading, "") for heading in headings] for row in footer]
        return cls(columns, cells, caption, notes, below)

    @classmethod
    def of_figures(
        cls, figures: Mapping[str, str], caption: str, notes: Sequence[str] = ()
    ) -> "Table":
        """Return the table of some figures, as text with their units, by name."""
        rows = [
            {"quantity": name, Column("value", align="right"): text}
            for name, text in figures.items()
        ]
        return cls.of(rows, caption, notes)

    def _find_texts(self) -> list[bool]:
        """Return whether each column holds texts, and no numbers."""
        rows = list(map(self.values, self.rows))
        kinds = [{type(row[k]) for row in rows} - {type(None)} for k in range(len(self.columns))]
        return [found == {str} for found in kinds]

    @property
    def groups(self) -> list[tuple[str, int]]:
        """The headings above the columns' own, with how many columns each spans; empty where no
        column has one."""
        spans: list[tuple[str, int]] = []
        for column in self.columns:
            if spans and spans[-1][0] == column.group:
                spans[-1] = (column.group, spans[-1][1] + 1)
            else:
                spans.append((column.group, 1))
        return spans if any(name for name, _ in spans) else []

    def format(
        self, rows: Sequence[Sequence[Value | Cell]]
    ) -> list[list[tuple[Column, str, Mark]]]:
        """Return column, text and mark of each cell of some rows; a name that repeats the one above
        it is blank, unless ``repeats``."""
        lines: list[list[tuple[Column, str, Mark]]] = []
        above = ""
        for row in rows:
            line = [
                (column, *_format_cell(column, cell))
                for column, cell in zip(self.columns, row, strict=True)
            ]
            if line and line[0][0].align == "left" and not self.repeats:
                name = line[0][1]
                line[0] = (line[0][0], "" if name == above else name, line[0][2])
                above = name
            lines.append(line)
        return lines

    @staticmethod
    def values(row: Sequence[Value | Cell]) -> list[Value]:
        """Return the values of a row."""
        return [cell.value if isinstance(cell, Cell) else cell for cell in row]

    def rename(self, words: Mapping[str, str]) -> "Table":
        """Return the table with words replaced in its headings, texts and notes."""

        def renamed(value: Any) -> Any:
            """Return a text with the words replaced; other values as they are."""
            if isinstance(value, Cell):
                return replace(value, value=renamed(value.value))
            for word, other in words.items() if isinstance(value, str) else ():
                value = value.replace(word, other)
            return value

        return replace(
            self,
            columns=[replace(each, title=renamed(each.title)) for each in self.columns],
            rows=[[renamed(each) for each in row] for row in self.rows],
            notes=[renamed(each) for each in self.notes],
        )

    def select(self, keep: Sequence[Column]) -> "Table":
        """Return the table with some of its columns alone."""
        chosen = [index for index, column in enumerate(self.columns) if column in keep]
        rows, footer = (
            [[row[k] for k in chosen] for row in part] for part in (self.rows, self.footer)
        )
        return Table([self.columns[k] for k in chosen], rows, self.caption, self.notes, footer)

    def without_constant(self) -> "Table":
        """Return the table without a first column that holds one name alone, where it has several
        rows."""
        names = {str(row[0]) for row in self.rows}
        return self.select(self.columns[1:]) if len(names) == 1 < len(self.rows) else self

    def without_details(self) -> "Table":
        """Return the table without the columns that are details."""
        return self.select([column for column in self.columns if not column.detail])

    def without_empty(self) -> "Table":
        """Return the table without columns that hold nothing."""
        rows = list(map(self.values, self.rows))
        return self.select(
            [c for k, c in enumerate(self.columns) if any(row[k] not in (None, "") for row in rows)]
        )


def relabel(shown: Table, labels: Mapping[str, str]) -> Table:
    """Return a table with the operator's labels for the names of captures."""
    rows = [
        [use_labels(cell, labels) if isinstance(cell, str) else cell for cell in row]
        for row in shown.rows
    ]
    return replace(shown, rows=rows, notes=[use_labels(note, labels) for note in shown.notes])


def use_labels(sentence: str, labels: Mapping[str, str]) -> str:
    """Replace the captures' names in a sentence by the operator's labels."""
    names = [re.escape(name) for name, label in labels.items() if label != name]
    return (
        re.sub(rf"(?<![\w.-])({'|'.join(names)})(?![\w-])", lambda m: labels[m[1]], sentence)
        if names
        else sentence
    )


def _make_column(title: str) -> Column:
    return Column(title, digits=2 if "ratio" in title else 1 if title.endswith("%") else 3)


def _format_cell(column: Column, cell: Value | Cell) -> tuple[str, Mark]:
    """Return text and mark of a cell; what is unknown is muted."""
    value, mark = (cell.value, cell.mark) if isinstance(cell, Cell) else (cell, "")
    text = column.format(value)
    return text, "muted" if text == UNKNOWN else mark  # type: ignore[return-value]


def better_worse(error: float | None, rival: float | None) -> Mark:
    """Return the mark "better" or "worse" of an error against a rival's, by magnitude; none where
    they are equal."""
    if error is None or rival is None or not (math.isfinite(error) and math.isfinite(rival)):
        return ""
    error, rival = abs(error), abs(rival)
    if abs(error - rival) <= EQUAL * max(error, rival):
        return ""
    return "better" if error < rival else "worse"


def compare_errors(error: float | None, rival: float | None) -> Cell:
    """Return the cell that compares an error with a rival's, such as ``2.60 × better``,
    coloured."""
    if not (error and rival and math.isfinite(error) and math.isfinite(rival)):
        return Cell(None)
    error, rival, mark = abs(error), abs(rival), better_worse(error, rival)
    return Cell(f"{max(rival / error, error / rival):.2f} × {mark}" if mark else "equal", mark)


def compare_with_first(errors: Mapping[str, float | None], model: str) -> Cell:
    """Return the cell that compares a model's error with that of the first one; empty for the
    first."""
    first = next(iter(errors), model)
    return Cell("") if model == first else compare_errors(errors.get(model), errors[first])


def format_signed(value: float, unit: str = "", digits: int = 0) -> str:
    """Return a difference with its sign and unit."""
    return f"{value:+.{digits}f} {unit}".strip().replace("-", "−")


def format_scale(factor: float) -> str:
    """Return by how much a correction of scale lengthens, such as ``+300 ppm``."""
    return format_signed(1e6 * (factor - 1), "ppm")


def format_count(count: int, noun: str) -> str:
    """Format a count and its noun, in the plural unless the count is 1."""
    return f"{count} {noun}{'' if count == 1 else 's'}"


def format_counts(purposes: Iterable[str]) -> str:
    """Format how many captures there are of each purpose: "8 poses, 3 scans, 1 plane"; planes and
    spheres only where there are any."""
    n = {"pose": 0, "scan": 0, **Counter(purposes)}
    return ", ".join(format_count(count, purpose) for purpose, count in n.items())


def render_text(table: Table) -> str:
    """Return a table for the terminal: names to the left, figures to the right, and its notes
    below.

    Titles stand above their columns one word a line, so that wide tables stay narrow.
    """
    words = [column.heading.split() for column in table.columns]
    height = max(map(len, words), default=0)
    head = list(zip(*([""] * (height - len(each)) + each for each in words), strict=True))
    body, footer = (
        [[text for _, text, _ in line] for line in table.format(rows)]
        for rows in (table.rows, table.footer)
    )
    widths = [max(map(len, cells)) for cells in zip(*head, *body, *footer, strict=True)]

    def align(line: Sequence[str]) -> str:
        """Return the cells of a line side by side."""
        cells = [
            text.ljust(width) if column.align == "left" else text.rjust(width)
            for text, width, column in zip(line, widths, table.columns, strict=True)
        ]
        return "  ".join(cells).rstrip()

    rule = "-" * (sum(widths) + 2 * max(0, len(widths) - 1))
    below = [rule, *map(align, footer)] if footer else []
    return "\n".join([*map(align, head), rule, *map(align, body), *below, *table.notes])
