"""Text, mm: x y z of a point a line, and its red green blue; no other line, which most readers
would not bear. Read with headers, separators and normals too."""

import codecs
import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from slviewer.errors import InputError
from slviewer.geometry.vectors import finite_rows, lengths
from slviewer.session.atomic import arriving_file
from slviewer.session.columns import Columns, find_columns, note_unused
from slviewer.session.ply import COLOURS, NORMAL, PLACE
from slviewer.session.shape_format import DECIMALS, Shape, ShapeFormat, Sizes, split_shape
from slviewer.session.units import IN_NAME

_SIZES = Sizes(0, 33, 12)
_UTF16 = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?|[-+]?(?i:nan|inf)")
_COMMA = re.compile(r"[-+]?\d+,\d+([eE][-+]?\d+)?")
_QUOTED = re.compile(r'"([^"\n]*)"')
_GROUPED = r"([-+]?\d{1,3})((?:,\d{3})+(?=\.)|(?:\.\d{3})+(?=,))([.,]\d+)"
_THOUSANDS = re.compile(rf'(?:^|(?<=[ \t;"])){_GROUPED}(?=[ \t;"])|(?<=[ \t;"]){_GROUPED}$', re.M)
"""Numbers with marks between thousands, 1,234.5 or 1.234,5, beside others: a line alone may be
x,y,z."""
_NO_NUMBER = re.compile(r"[-+]?(?:1\.#[A-Z]+|(?i:nan)\(\w+\))")
"""How programs on Windows write NaN and infinity."""
_UNIT = re.compile(r"[\[(][^\])]+[\])]")
_PTS = {4: ("intensity",), 6: COLOURS, 7: ("intensity", *COLOURS)}
"""Names of the columns behind x y z in a PTS, by the number of all."""


def _write(path: Path, shape: Shape, scalars: Columns, notes: Sequence[str]) -> None:
    points, _ = split_shape(shape)
    columns = np.round(points.astype(np.float64), DECIMALS) + 0.0  # no "-0.000000"
    formats = [f"%.{DECIMALS}f"] * 3
    has_colours = shape.colours is not None
    if shape.colours is not None:
        columns, formats = np.hstack([columns, shape.colours]), [*formats, "%d", "%d", "%d"]
    with arriving_file(path, _SIZES.estimate(len(points), 0, has_colours, 0)) as file:
        np.savetxt(file, columns, formats)


@dataclass(frozen=True)
class _Lines:
    """The ``titles`` of a text, its ``rows`` of numbers with decimal points, their ``separator``
    (None: spaces), and whether they had counts of points before them."""

    titles: list[str]
    rows: list[str]
    separator: str | None
    has_counts: bool


def read_table(path: Path, data: bytes, notes: list[str]) -> list[Columns]:
    """Return the columns of a text by the names in its header; without one x y z come first, then
    normals and colours where the numbers are such."""
    lines = _read_lines(path.name, data, notes)
    places, header = _number_places(lines.rows[0]), _read_header(lines, notes)
    names = header or [f"column {i + 1}" for i in range(len(_split_line(lines.rows[0])[1]))]
    kinds = find_columns(names).values()
    needed = sorted(i for named in kinds for i in named) or places
    numbers, places = _parse_rows(path.name, lines, places, needed, header)
    unused = [name for i, name in enumerate(names) if name and i not in places]
    note_unused(unused, notes)
    titles = [names[i] for i in places] if header else _name_columns(path, numbers, lines)
    return [dict(zip(titles, numbers.T, strict=True))]


def _read_lines(name: str, data: bytes, notes: list[str]) -> _Lines:
    """Return the lines of a text that are not empty. Raises InputError without any of three
    numbers, and for blocks of other numbers of points than announced."""
    text = data.decode("utf-16" if data[:2] in _UTF16 else "utf-8-sig", "replace")
    text = "\n".join(filter(None, map(str.strip, text.splitlines())))
    if (
        "#" in text or "(" in text
    ):  # a search through all of a large text takes longer than the rest
        text = _NO_NUMBER.sub("nan", text)
    lines = _settle_marks(text, notes).split("\n")
    first = next((i for i, line in enumerate(lines) if len(_number_places(line)) >= 3), None)
    if first is None:
        raise InputError(
            f"{name} has no line of three numbers",
            "write x y z of a point a line, with decimal points",
        )
    titles, rows = lines[:first], lines[first:]
    separator, words = _split_line(rows[0])
    has_counts = bool(titles) and titles[-1].isdigit()
    if has_counts:
        rows = _drop_counts(name, [titles.pop(), *rows])
    if separator != "," and any("," in words[i] for i in _number_places(rows[0])):
        notes.append("the commas in its numbers were read as decimal points")
        rows = [row.replace(",", ".") for row in rows]
    return _Lines(titles, rows, separator, has_counts)


def _settle_marks(text: str, notes: list[str]) -> str:
    """Return a text without marks between thousands and without quotes, in which no separator
    lies."""

    def join(match: re.Match[str]) -> str:
        """Return a number without marks between thousands."""
        whole, marked, decimals = filter(None, match.groups())
        return whole + re.sub("[.,]", "", marked) + decimals

    if all(mark in text for mark in ",.") and any(each in text for each in ' \t;"'):
        text, grouped = _THOUSANDS.subn(join, text)
        if grouped:
            notes.append("the marks between thousands in its numbers were skipped")
    if '"' not in text:
        return text
    cells = [cell for cell in _QUOTED.findall(text) if _COMMA.fullmatch(cell)]
    if cells:
        notes.append(f"the commas in its quoted numbers were read as decimal points: {cells[0]}")

    def unquote(match: re.Match[str]) -> str:
        """Return a quoted cell with a decimal point, or spaces in place of separators."""
        return re.sub("[,;\t]", "." if _COMMA.fullmatch(match[1]) else " ", match[1])

    return _QUOTED.sub(unquote, text).replace('"', "")


def _split_line(line: str) -> tuple[str | None, list[str]]:
    """Return the separator of a line, None for spaces, and its words."""
    separator = next((each for each in ";\t" if each in line), None)
    if separator is None and "," in line and not all(map(_COMMA.fullmatch, line.split())):
        separator = ","
    return separator, [word.strip() for word in line.split(separator)]


def _number_places(line: str) -> list[int]:
    """Return the places of the words of a line that are numbers."""
    separator, words = _split_line(line)
    if separator != ",":
        words = [word.replace(",", ".") for word in words]
    return [i for i, word in enumerate(words) if _NUMBER.fullmatch(word)]


def _drop_counts(name: str, lines: list[str]) -> list[str]:
    """Return the lines of blocks without the numbers of points before each. Raises InputError for
    blocks of other numbers."""
    starts = [i for i, line in enumerate(lines) if line.isdigit()]
    for start, end in zip(starts, [*starts[1:], len(lines)], strict=True):
        if end - start - 1 != int(lines[start]):
            raise InputError(
                f"{name} announces {int(lines[start]):,} points and {end - start - 1:,} follow",
                "it is truncated or damaged; export the cloud again",
            )
    return [line for line in lines if not line.isdigit()]


def _read_header(lines: _Lines, notes: list[str]) -> list[str]:
    """Return the names of all columns, or more; empty where no header names any."""
    count, unknown, is_comment = len(_split_line(lines.rows[0])[1]), list[str](), True
    for title in reversed(lines.titles):
        is_comment = title.startswith(("#", "//"))
        for separator in (lines.separator, ",", ";", None):
            names = _UNIT.sub("", title.lstrip("#/ ")).split(separator)
            names = [IN_NAME.sub("", name.strip(" ,")) for name in names]
            names = [name or f"column {i}" for i, name in enumerate(names, 1)]
            if PLACE in find_columns(names):
                return [*names, *(f"column {i}" for i in range(len(names) + 1, count + 1))]
            if len(names) == count and not is_comment:
                unknown = names
    if not unknown and not is_comment:
        notes.append(f"not used: its first line, '{lines.titles[0][:60]}'")
    return unknown


def _parse_rows(
    name: str, lines: _Lines, places: list[int], needed: list[int], header: Sequence[str]
) -> tuple[np.ndarray, list[int]]:
    """Return the numbers (n, k) in the columns ``places`` of each line, and these places; where
    others than the ``needed`` ones have gaps, of the needed ones. Lines may differ in length behind
    these only below a header."""
    stripped = (row.partition("#")[0].partition("//")[0].strip() for row in lines.rows)
    rows = [row for row in stripped if row]
    *widths, last = (len(row.split(lines.separator)) for row in rows)
    least, is_even = min(widths, default=last), {*widths} <= {last}
    if is_even or (header and last >= least):
        shared = [i for i in places if i < least]
        for columns in (shared, needed):
            with suppress(ValueError):
                numbers = np.loadtxt(
                    rows, delimiter=lines.separator, usecols=columns, ndmin=2, comments=None
                )
                return numbers, columns
    bad = next((row for row in rows if not {*needed} <= {*_number_places(row)}), None)
    bad = bad or max(rows, key=lambda row: len(row.split(lines.separator)))
    raise InputError(
        f"{name} has a line without the numbers of the others, '{bad[:60]}'",
        "it is truncated or damaged there; export the cloud again",
    )


def _name_columns(path: Path, rows: np.ndarray, lines: _Lines) -> list[str]:
    """Return the names of columns (n, k) that no header names."""
    _check_columns(path.name, rows, lines)
    is_level = [_are_levels(column) for column in rows.T]
    is_pts = lines.has_counts or path.suffix.lower() == ".pts"
    count = rows.shape[1]
    if is_pts and count in _PTS and (count == 4 or all(is_level[-3:])):
        return [*PLACE, *_PTS[count]]
    names, k = [*PLACE, *(f"column {i + 1}" for i in _number_places(lines.rows[0])[3:])], 3
    while k < count:
        run = [*is_level[k:], False].index(False)
        if NORMAL[0] not in names and _are_normals(rows[:, k : k + 3]):
            names[k : k + 3], run = NORMAL, 3
        elif run == 3:
            names[k : k + 3] = COLOURS
        k += max(run, 1)
    return names


def _check_columns(name: str, rows: np.ndarray, lines: _Lines) -> None:
    """Raise InputError where decimal commas may have parted the numbers (n, k), or the first of
    them may be an index."""
    words = _split_line(lines.rows[0])[1]
    first, *others = ("." in words[i] for i in _number_places(lines.rows[0])[:4])
    if not first and any(others) and rows.shape[1] > 3:
        raise InputError(
            f"{name} has whole numbers before others, as indices are: {' '.join(words)[:60]}",
            "name the columns in a first line, as index x y z",
        )
    count, is_whole = rows.shape[1], (rows == np.rint(rows)).all()
    if lines.separator == "," and is_whole and count >= 6 and not count % 2:
        raise InputError(
            f"{name} holds {count} whole numbers a line: its commas may be decimal ones",
            "write decimal points, or name the columns in a first line",
        )


def _are_levels(values: np.ndarray) -> bool:
    """Whether numbers (n,) are levels of 8 bits."""
    some = values[np.isfinite(values)]
    return bool(
        len(some) and (some == np.rint(some)).all() and some.min() >= 0 and some.max() < 256
    )


def _are_normals(values: np.ndarray) -> bool:
    """Whether numbers (n, k) are unit vectors, but for a few."""
    some = values[finite_rows(values)]
    is_triple = values.shape[1] == 3 and len(some)
    return bool(is_triple and np.percentile(np.abs(lengths(some) - 1), 99) < 0.01)


FORMAT = ShapeFormat(
    "xyz",
    "mm; text, x y z of a point a line, and its colour",
    _SIZES,
    _write,
    takes_points=True,
    read=read_table,
    others=("txt", "asc", "pts"),
)
