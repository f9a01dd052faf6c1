"""The base of all records, and their kinds; their tables of figures with units, which the terminal,
pages, panels and CSV files draw; and dataclasses to and from plain values, the one codec for what
is written as JSON or TOML.

`to_plain(record)` is nested dicts, lists, tuples, numbers, strings and None, keyed by the names of
the fields; arrays become nested lists, paths strings. `from_plain(data, Kind)` is the inverse: it
checks every field's type, ignores keys that the dataclass does not have, gives absent fields their
defaults, and leaves checks of values to `__post_init__`::

    @dataclass(frozen=True, eq=False)
    class CutPlane:
        origin: NDArray[np.float64]
        up: NDArray[np.float64] | None = None

    data = to_plain(plane)              # {"origin": [0.0, 0.0, 580.0], "up": None}
    plane = from_plain(data, CutPlane)  # arrays of the annotated dtype, else InputError

Records nest: a field may be another dataclass, a tuple, a mapping or an optional of these. Name
fields after their keys on disk, and no method is needed. Where a published record holds computed
figures too, add them to the plain fields: `to_plain(self) | {"decision": self.decision}`.
`session.atomic.to_json` and the commands' `--json` take dataclasses as they are.
Properties are not written.
"""

import math
import os
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, ClassVar, Literal, TypeVar, get_args

import msgspec
import numpy as np

from slviewer.errors import InputError

T = TypeVar("T")


def to_plain(value: Any) -> Any:
    """Convert a dataclass, or values that contain some, to plain values for JSON. Raises TypeError
    where impossible."""
    return msgspec.to_builtins(value, enc_hook=plain_leaf)


def from_plain(data: Any, kind: type[T]) -> T:
    """Rebuild the value of type `kind` from the `data` of `to_plain`. Raises InputError that names
    the field."""
    try:
        return msgspec.convert(data, kind, dec_hook=_array)
    except msgspec.ValidationError as error:
        reason, _, place = str(error).replace("`", "").partition(" - at $")
        raise InputError(
            f"{reason[:1].lower()}{reason[1:]}", place=place.strip(".") or "its content"
        ) from error


def plain_leaf(value: Any) -> Any:
    """Convert a NumPy value, path or mapping one step towards plain values; the hook of every JSON
    writer."""
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    if isinstance(value, Mapping):
        return dict(value)
    raise TypeError(f"{type(value).__name__} has no plain form")


def _array(kind: Any, value: Any) -> Any:
    """Convert to an array of the dtype that a field is annotated with, of the values' own where it
    names none."""
    if kind is not np.ndarray and getattr(kind, "__origin__", None) is not np.ndarray:
        raise NotImplementedError(f"{kind} is not a type of records")
    dtype = next(iter(get_args(get_args(kind)[1])), None) if get_args(kind) else None
    array = np.asarray(value, None if dtype is Any else dtype)
    if array.dtype.kind not in "biuf":
        raise ValueError("Expected numbers")
    return array


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
    right. ``detail``: omitted where a table is narrow."""

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
                    f" {len(self.columns)} columns",
                    "give one cell a column",
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


RECORDS: dict[str, type["Record"]] = {}
"""The kinds of records by the folder of their results."""
UNITS = {
    "mm": ("mm", 3), "mm2": ("mm²", 3), "mm3": ("mm³", 3), "um": ("µm", 1), "px": ("px", 3),
    "deg": ("°", 4),
    "rad": ("rad", 4), "percent": ("%", 1), "ppm": ("ppm", 1), "s": ("s", 1), "ms": ("ms", 1),
}  # fmt: skip
"""{last word of a figure's name: (unit, decimals)}."""
DEPTHS = ("R1", "R2", "R3")
"""In front of, inside and behind the calibrated depths."""
Meta = Mapping[str, Any]
"""The entries of a stored record."""
Count = Annotated[int, msgspec.Meta(ge=0)]
Share = Annotated[float, msgspec.Meta(ge=0, le=1)]
Vector = tuple[float, float, float]
Row4 = tuple[float, float, float, float]
Matrix4 = tuple[Row4, Row4, Row4, Row4]


def to_vector(values: np.ndarray) -> Vector:
    """Return an array (3,) as plain numbers."""
    x, y, z = map(float, values)
    return x, y, z


def to_matrix(T: np.ndarray) -> Matrix4:
    """Return a transform (4, 4) as plain numbers."""
    return from_plain(np.asarray(T, np.float64).tolist(), Matrix4)  # type: ignore[arg-type]


class Record(msgspec.Struct, frozen=True, kw_only=True):
    """What an operation found: figures with their units in the names, and what they were made from.

    ``operation`` and ``settings``, those that are not the default, made it from ``inputs``:
    {capture or result: its hash}; ``scales``: {model: correction of scale in the figures};
    ``calibration_warning``: why the calibration was doubtful or not checked, if it was. A
    subclass names its ``kind``, the folder of its results, and its ``title``; its docstring
    explains its figures in the report. What older versions stored is converted by `upgrade`.
    ``prefix``: what the names of numbered records begin with; ``labels``: the decision with the
    operator's own.
    """

    kind: ClassVar[str] = ""
    title: ClassVar[str] = ""
    is_history: ClassVar[bool] = False  # also records of before are of interest
    has_figures: ClassVar[bool] = True  # that a repetition finds again
    is_of_captures: ClassVar[bool] = True  # and not shown once these are deleted
    prefix: ClassVar[str] = ""
    labels: ClassVar[str] = "names"
    newest_first: ClassVar[bool] = False  # of the tables that each record has
    operation: str = ""
    settings: dict[str, Any] = {}
    inputs: dict[str, str] = {}
    scales: dict[str, float] = {}
    calibration_warning: str = ""

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        if cls.kind in RECORDS:
            raise ValueError(f"a kind of records is called {cls.kind} already")
        RECORDS[cls.kind] = cls

    @classmethod
    def upgrade(cls, meta: Meta) -> Meta:
        """Return the entries of a stored record with today's names."""
        return meta

    @classmethod
    def is_number(cls, name: str) -> bool:
        """Whether a record of this name is numbered, and not named after a capture."""
        return name.removeprefix(cls.prefix).isdecimal()

    def label(self, name: str) -> str:
        """Return what the record of this name is called unless the operator calls it otherwise."""
        return name

    @classmethod
    def tables(cls, found: Mapping[str, "Record"]) -> list[Table]:
        """Return the tables of some records of this kind, by the name of each: by default those of
        each, or a line each, and a column for every figure."""
        listed = list(found.items())[:: -1 if cls.newest_first else 1]
        if own := [table for name, record in listed for table in record.list_tables(name)]:
            return own
        rows = [
            {"name": name, **{figure_column(f): value for f, value in record.figures().items()}}
            for name, record in found.items()
        ]
        return [Table.of(rows, cls.title)]

    def list_tables(self, name: str) -> list[Table]:
        """Return the record's own tables; none where records of its kind share them."""
        return []

    @property
    def is_good(self) -> bool:
        """Whether what was found needs no attention."""
        return True

    @property
    def failure(self) -> str:
        """Why a command that found this ends with status 1; empty where it ends with 0."""
        return ""

    def summary(self) -> str:
        """Return the figures in one sentence."""
        columns = [(figure_column(name), value) for name, value in self.figures().items()]
        return ", ".join(
            f"{column.title} {column.format(value)} {column.unit}".strip()
            for column, value in columns
        )

    def figures(self) -> dict[str, float]:
        """Return the numbers of the record by name; of those inside others ``name of the outer, of
        the inner``."""
        plain = {
            key: value
            for key, value in to_plain(self).items()
            if self.has_figures and key not in Record.__struct_fields__
        }
        return list_numbers(plain)


def figure_column(name: str) -> Column:
    """Return the column of a figure, with the unit that its name ends in."""
    words = re.split(r"[ _]", name)
    unit, digits = UNITS.get(words[-1], ("", 3))
    return Column(" ".join(words[:-1] if unit else words), unit, digits=digits)


def list_shares(incidence: Mapping[str, float] | None) -> Row:
    """Return the percent in front of, inside and behind the calibrated depths by column."""
    return {
        Column(where, "%", "of the calibrated depths", digits=1, detail=True): (
            (incidence or {}).get(depths)
        )
        for depths, where in zip(DEPTHS, ("in front", "inside", "behind"), strict=True)
    }


def list_numbers(values: Mapping[str, Any], outer: str = "") -> dict[str, float]:
    """Return the numbers in plain values by name; of those inside others ``name of the outer, of
    the inner``. Texts, lists and truth values are none."""
    numbers: dict[str, float] = {}
    for key, value in values.items():
        name = f"{outer} {key}".strip()
        if isinstance(value, Mapping):
            numbers |= list_numbers(value, name)
        elif isinstance(value, int | float) and not isinstance(value, bool):
            numbers[name] = value
    return numbers
