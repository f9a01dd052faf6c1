"""What a nominal model's file says of itself, looked at before it is loaded: files come from anywhere."""

import mmap
import os
import re
from pathlib import Path
from typing import Literal

from slviewer.errors import SessionError

Format = Literal["stl", "ply", "obj"]
FORMATS: tuple[Format, ...] = ("stl", "ply", "obj")
MOST_BYTES = 1 << 29
MOST_TRIANGLES = 5_000_000
MOST_HEADER = 1 << 16
STL_HEADER, STL_TRIANGLE = 84, 50
_SIZES = {
    "char": 1, "int8": 1, "uchar": 1, "uint8": 1, "short": 2, "int16": 2, "ushort": 2, "uint16": 2, "int": 4,
    "int32": 4, "uint": 4, "uint32": 4, "float": 4, "float32": 4, "double": 8, "float64": 8,
}  # fmt: skip


def check_nominal_file(path: Path) -> Format:
    """The file's format, if it may be loaded.

    Raises SessionError for a file that is absent, too large, truncated, of another format, or without triangles.
    """
    suffix = path.suffix.lower().removeprefix(".")
    if suffix not in FORMATS:
        raise SessionError(f"{path.name} is no nominal model that can be read: give an STL, PLY or OBJ file")
    try:
        size = os.stat(path).st_size
        if not path.is_file():
            raise SessionError(f"{path} is no file: give an STL, PLY or OBJ file")
        if size > MOST_BYTES:
            raise SessionError(
                f"{path.name} has {size / 1e6:.0f} MB, and up to {MOST_BYTES / 1e6:.0f} MB are read: decimate it first"
            )
        if size == 0:
            raise SessionError(f"{path.name} is empty: export the model again")
        with open(path, "rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
            triangles = {"stl": _stl, "ply": _ply, "obj": _obj}[suffix](path.name, data)
    except OSError as error:
        raise SessionError(f"{path} cannot be read ({error.strerror}): check its name") from error
    if triangles == 0:
        raise SessionError(f"{path.name} holds no triangles: export the model as a mesh")
    if triangles > MOST_TRIANGLES:
        raise SessionError(
            f"{path.name} has {triangles:,} triangles, and at most {MOST_TRIANGLES:,} are read: decimate it first"
        )
    return suffix  # type: ignore[return-value]


def _stl(name: str, data: mmap.mmap) -> int:
    if len(data) >= STL_HEADER:
        told = int.from_bytes(data[80:84], "little")
        if len(data) == STL_HEADER + STL_TRIANGLE * told:
            return told
    if data[:6].lstrip().lower().startswith(b"solid") and _contains(data, b"facet"):
        if not _contains(data[-200:], b"endsolid"):
            raise SessionError(f"{name} breaks off before its end: export the model again")
        return _count(data, rb"\bendfacet\b")
    if len(data) < STL_HEADER:
        raise SessionError(f"{name} is no STL file: it has {len(data)} bytes; export the model again")
    raise SessionError(
        f"{name} is damaged: it tells of {told:,} triangles, and has room for "
        f"{(len(data) - STL_HEADER) // STL_TRIANGLE:,}; export the model again"
    )


def _ply(name: str, data: mmap.mmap) -> int:
    end = data.find(b"end_header", 0, MOST_HEADER)
    damaged = SessionError(f"{name} has no PLY header that can be read: export the model again")
    lines = [line.split() for line in data[: max(end, 0)].decode("ascii", "replace").splitlines()]
    if end < 0 or lines[0] != ["ply"]:
        raise damaged
    counts: dict[str, int] = {}
    least: dict[str, int] = {}  # bytes that one of an element takes at least, in a binary file
    binary = True
    element = ""
    for words in lines[1:]:
        if words[:1] == ["format"]:
            binary = words[1:2] != ["ascii"]
        elif words[:1] == ["element"] and len(words) == 3 and re.fullmatch(r"\d{1,12}", words[2]):
            element = words[1]
            counts[element], least[element] = int(words[2]), 0
        elif words[:1] == ["property"] and element and len(words) == 3 and words[1] in _SIZES:
            least[element] += _SIZES[words[1]]
        elif words[:2] == ["property", "list"] and element and len(words) == 5 and {*words[2:4]} <= set(_SIZES):
            least[element] += _SIZES[words[2]] + (3 * _SIZES[words[3]] if element == "face" else 0)
        elif words and words[0] not in ("comment", "obj_info"):
            raise damaged
    if not counts.get("vertex"):
        raise SessionError(f"{name} holds no points: export the model again")
    if not counts.get("face"):
        raise SessionError(
            f"{name} is a cloud of {counts['vertex']:,} points without triangles: export the model as a mesh"
        )
    room = len(data) - end
    # a line of text takes two bytes at least; anything may hold nothing
    needed = sum(count * (max(least[each], 1) if binary else 2) for each, count in counts.items())
    if needed > room:
        raise SessionError(
            f"{name} breaks off: its header tells of {counts['vertex']:,} points and {counts['face']:,} triangles, and "
            f"only {room:,} bytes follow; export the model again"
        )
    if counts["vertex"] > 3 * MOST_TRIANGLES:
        raise SessionError(
            f"{name} has {counts['vertex']:,} points, and at most {3 * MOST_TRIANGLES:,} are read: decimate it first"
        )
    return counts["face"]


def _obj(name: str, data: mmap.mmap) -> int:
    # a face of many corners becomes many triangles: two fewer than it has corners
    corners = sum(len(line.split()) - 3 for line in _lines(data, rb"(?m)^[ \t]*f[ \t][^\r\n]*"))
    return max(corners, 0)


def _lines(data: mmap.mmap, pattern: bytes) -> list[bytes]:
    return [match.group() for match in re.finditer(pattern, data)]


def _count(data: mmap.mmap, pattern: bytes) -> int:
    return sum(1 for _ in re.finditer(pattern, data))


def _contains(data: mmap.mmap | bytes, word: bytes) -> bool:
    return re.search(rb"(?i)\b" + word + rb"\b", data) is not None
