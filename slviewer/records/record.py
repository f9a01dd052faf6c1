"""The base of all records, their kinds, and figures by name."""

import re
from collections.abc import Mapping
from typing import Annotated, Any, ClassVar

import msgspec
import numpy as np

from slviewer.records.plain import from_plain, to_plain
from slviewer.records.table import Column, Row, Table

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
    {capture or result: its hash}; ``scales``: {model: correction of scale in the figures}. A
    subclass names its ``kind``, the folder of its results, and its ``title``; its docstring
    explains its figures in the report. What older versions stored is converted by `upgrade`.
    ``prefix``: what the names of numbered records begin with; ``labels``: the decision with the
    operator's own.
    """

    kind: ClassVar[str] = ""
    title: ClassVar[str] = ""
    is_history: ClassVar[bool] = False  # also records of before are of interest
    is_of_captures: ClassVar[bool] = True  # and not shown once these are deleted
    prefix: ClassVar[str] = ""
    labels: ClassVar[str] = "names"
    newest_first: ClassVar[bool] = False  # of the tables that each record has
    operation: str = ""
    settings: dict[str, Any] = {}
    inputs: dict[str, str] = {}
    scales: dict[str, float] = {}

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        RECORDS[cls.kind] = cls

    @classmethod
    def upgrade(cls, meta: Mapping[str, Any]) -> Mapping[str, Any]:
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
            if key not in Record.__struct_fields__
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
