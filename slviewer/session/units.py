"""Units of length in which files state coordinates, and origins that large coordinates get."""

import re
from typing import Literal

import numpy as np

from slviewer.errors import InputError
from slviewer.geometry.vectors import box_middle, diagonal
from slviewer.session.columns import find_columns
from slviewer.session.ply import FAR_MM, PLACE

Units = Literal["mm", "cm", "m", "inch"]
MM: dict[Units, float] = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "inch": 25.4}
_SPELLINGS = {
    "mm": "mm|millimet(?:er|re)s?",
    "cm": "cm|centimet(?:er|re)s?",
    "m": "m|met(?:er|re)s?",
    "inch": "in|inch|inches",
    "um": "um|\u00b5m|micromet(?:er|re)s?|microns?",
    "km": "km|kilomet(?:er|re)s?",
    "feet": "ft|foot|feet|(?:us )?survey f(?:oo|ee)t",
}
_UNIT = f"({'|'.join(_SPELLINGS.values())})(?![a-z0-9])"
_STATED = re.compile(
    r"\bunits?\b(?:[^a-z0-9\u00b5]|of length|of coordinates|are\b|is\b|in\b|1\b|1\.0\b)*"
    + _UNIT
    + r"|\b(?:coordinates|lengths|distances|points|vertices|xyz)\b(?: are| is| given)? in "
    + _UNIT
)
_COMMENT = re.compile(r"(#|//|%|comment|obj_info)")
IN_NAME = re.compile(r"(?i)(?<=[xyz])\s*[\[(/_ ]\s*" + _UNIT + r"[\])]?$")
"""A unit behind the name of a column, such as X [mm], y_m or z/inch."""
_SEPARATORS = re.compile(r"[,;\t]|\s+(?![\[(])")
_HEAD = 8192


def read_units(name: str, data: bytes, given: Units | None, notes: list[str]) -> Units | None:
    """Return the units of a file's numbers: those ``given``, else those that its comments or its
    columns' names state, noted unless mm; None without any. Raises InputError where it states
    several, or one that is not read."""
    head = data[:_HEAD].partition(b"end_header")[0]
    if name.lower().endswith(".stl"):
        head = b"# " + b" ".join(data[:80].split())
    stated = dict.fromkeys(_list_units(head.decode("utf-8-sig", "replace").lower()))
    if given or not stated:
        if stated and given not in stated:
            notes.append(f"it states {', '.join(stated)}, and was read in {given}, as given")
        return given
    (unit, *others) = stated
    read = next((each for each in MM if each == unit), None)
    if others or read is None:
        raise InputError(
            f"{name} states its lengths in {' and '.join(stated)}",
            f"{', '.join(MM)} are read: scale it, or give the unit of its numbers as --unit",
        )
    if read != "mm":
        notes.append(f"its numbers are {read}, as it states")
    return read


def _list_units(head: str) -> list[str]:
    """Return the names of all units in the small letters of a file's head: in comments, behind the
    names x y z of columns, and in the line below these."""
    lines, found = [line.strip(' "') for line in re.split(r"[\r\n]+", head)], list[str]()
    for i, line in enumerate(lines):
        if _COMMENT.match(line):
            found += [word for words in _STATED.findall(line) for word in words if word]
        columns = [each.strip(' "#/') for each in _SEPARATORS.split(line)]
        names = [IN_NAME.sub("", each) for each in columns]
        if (places := find_columns(names).get(PLACE)) is not None:
            below = [
                each.strip(' "[]()') for each in _SEPARATORS.split("".join(lines[i + 1 : i + 2]))
            ]
            below += [""] * len(columns)
            for k in places:
                match = IN_NAME.search(columns[k])
                found += [match[1]] if match else re.findall(f"^{_UNIT}$", below[k])
    spelt = {re.compile(words): unit for unit, words in _SPELLINGS.items()}
    return [unit for word in found for words, unit in spelt.items() if words.fullmatch(word)]


def find_origin(points: np.ndarray) -> tuple[float, float, float] | None:
    """Return an origin in whole metres, in mm, for points (n, 3) mm that float32 would round; None
    for points that are near, or as large as they are far."""
    reach, middle = np.abs(points).max(), box_middle(points)
    if reach < max(FAR_MM, 2 * diagonal(points)):
        return None
    x, y, z = (float(each) for each in np.round(middle, -3))
    return x, y, z
