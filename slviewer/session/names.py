"""Names of captures and results: safe as folder names on every system, sorted as a person
counts."""

import re
from collections.abc import Iterable, Iterator, Sequence
from pathlib import PurePath

from slviewer.errors import InputError

_SAFE = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,127}")
_LONGEST = 200
"""Bytes of a folder's name: file systems take 255, and a temporary one beside it needs some."""
_DEVICE = re.compile(r"(?i:con|prn|aux|nul|com\d|lpt\d)(\..*)?")
"""Names that Windows keeps for devices, with any suffix."""


def safe_name(name: str) -> str:
    """Return `name` itself if it is valid as a folder name: letters, digits, `_`, `-`, `.`, no dot
    or dash first.

    Raises InputError otherwise.
    """
    if not is_safe_name(name):
        raise InputError(
            f"{name!r} cannot be a name",
            "use letters, digits, '_', '-' and '.', with no path in it",
        )
    return name


def is_safe_name(name: str) -> bool:
    """Whether `safe_name` accepts the name."""
    return isinstance(name, str) and _SAFE.fullmatch(name) is not None and not name.endswith(".")


def new_name(name: str, others: Iterable[str] = ()) -> str:
    """Return a `safe_name` for something new: none that Windows keeps for a device, and none that
    differs from one of ``others`` in its case alone, so that sessions can be copied there. Raises
    InputError otherwise. What has such a name already can be read."""
    if _DEVICE.fullmatch(safe_name(name)):
        raise InputError(
            f"{name!r} cannot be a name: Windows keeps it for a device", "choose another one"
        )
    for other in others:
        if other != name and other.lower() == name.lower():
            raise InputError(
                f"{name!r} cannot be a name beside {other!r}: Windows and macOS do not tell them"
                " apart",
                "choose another",
            )
    return name


def safe_path(name: str) -> str:
    """Return `name` if every part between its slashes is a safe name, as in `calibration/stereo`;
    else InputError."""
    if not isinstance(name, str) or not name:
        raise InputError(
            f"{name!r} cannot be a name",
            "use letters, digits, '_', '-' and '.', parts joined by '/'",
        )
    for part in name.split("/"):
        safe_name(part)
    return name


def plain_name(text: str, otherwise: str) -> str:
    """Return a valid name made from one of elsewhere: ASCII letters, digits, '_', '-' and '.', the
    last 100 characters; ``otherwise`` where nothing remains."""
    plain = re.sub(r"[^A-Za-z0-9_.-]+", "_", text).lstrip(".-")
    return safe_name(plain[-100:].lstrip(".-") or otherwise)


def clean_label(text: str) -> str:
    """Return an operator's name for something, without surplus space. Raises InputError for
    characters that are not printable: controls, and marks that change the direction of writing."""
    label = " ".join(text.split())
    if not label.isprintable():
        raise InputError(
            f"{label!r} holds characters that cannot be printed", "type the name again"
        )
    return label


def folder_name(text: str) -> str:
    """Return an operator's name for a session as that of its folder, on every system: printable
    characters, without space at its ends. Raises InputError for what would be a path or has another
    meaning."""
    name = clean_label(text)
    if found := sorted({*name} & {*r'/\:*?"<>|'}):
        raise InputError(f"{name!r} cannot be a name with {' '.join(found)} in it", "use - or _")
    if _DEVICE.fullmatch(name) or name.startswith(".") or name.endswith("."):
        raise InputError(
            f"{name!r} cannot be a name: it begins or ends with a dot, or Windows keeps it for a"
            " device",
            "choose another one",
        )
    if len(name.encode()) > _LONGEST:
        raise InputError(f"{name[:20]!r} ... is too long a name", f"use {_LONGEST // 2} letters")
    return name


def join_names(names: Sequence[str], most: int = 6) -> str:
    """Format names for a sentence, the first few of many."""
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


def natural_key(name: str) -> list[tuple[int, int, str]]:
    """Sort key that puts `pose_2` before `pose_10`."""
    parts = re.split(r"(\d+)", name.lower())
    return [(0, int(part), part) if part.isdecimal() else (1, 0, part) for part in parts]


def natural_order(files: Sequence[str]) -> list[str]:
    """Names of files in natural order: 2 before 10.

    Where they count without a gap in hexadecimal digits (f, 10), in letters (z, aa), or in a
    camera's four digits that begin again (9999, 0001), in the order of that count.
    """
    found = sorted(files, key=natural_key)
    if len(found) < 2:
        return found
    stems = [PurePath(name).stem.lower() for name in found]
    ends = [stem[_count_shared(stems) :] for stem in stems]
    shared = _count_shared([end[::-1] for end in ends])
    for values in _read_counts([end[: len(end) - shared] for end in ends]):
        if sorted(values) == [*range(min(values), min(values) + len(values))]:
            return [name for _, name in sorted(zip(values, found, strict=True))]
    return found


def _count_shared(texts: Sequence[str]) -> int:
    """Count the characters with which all texts begin."""
    return next(
        (i for i, each in enumerate(zip(*texts, strict=False)) if len({*each}) > 1),
        min(map(len, texts)),
    )


def _read_counts(counts: Sequence[str]) -> Iterator[list[int]]:
    """Yield the numbers that the differing parts of names are, as each kind of count reads them."""
    if all(re.fullmatch("[0-9a-f]+", count) for count in counts):
        yield [int(count, 16) for count in counts]
    if all(re.fullmatch("[a-z]{1,2}", count) for count in counts):
        yield [26 * (len(count) > 1) * (ord(count[0]) - 96) + ord(count[-1]) for count in counts]
    if all(re.fullmatch("[0-9]{4}", count) for count in counts):
        numbers = [int(count) for count in counts]
        again = 10_000 - (0 not in numbers)
        yield [number + again * (number < 5_000) for number in numbers]
