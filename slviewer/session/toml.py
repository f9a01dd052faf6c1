"""Plain values as TOML text, which `tomllib` reads back the same."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from slviewer.errors import InputError
from slviewer.fringe.sequence import PatternSequence


def to_toml(table: Mapping[str, Any]) -> str:
    """Return the TOML text of a table, inner tables as sections. None is omitted.

    Raises InputError for values that TOML does not hold.
    """
    lines = table_lines(
        {key: value for key, value in table.items() if not isinstance(value, Mapping)}
    )
    for key, inner in table.items():
        if isinstance(inner, Mapping):
            lines += ["", f"[{_format_key(key)}]", *table_lines(inner)]
    return "\n".join(lines).lstrip("\n") + "\n"


def describe_sequence(sequence: PatternSequence, files: list[str]) -> str:
    """The `frames` TOML of a sequence whose images have these names, in order."""
    described = sequence.to_dict()
    frames = described.pop("frame")
    lines = table_lines(described)
    for file, frame in zip(files, frames, strict=True):
        lines += ["", "[[frame]]", *table_lines({"file": file, **frame})]
    return "\n".join(lines) + "\n"


def table_lines(table: Mapping[str, Any]) -> list[str]:
    """Return the line ``key = value`` of each entry that is not None."""
    return [
        f"{_format_key(key)} = {format_value(value)}"
        for key, value in table.items()
        if value is not None
    ]


def format_value(value: Any) -> str:
    """Format a value in TOML's notation; mappings as inline tables."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, int | float):
        return repr(value)
    if isinstance(value, str | Path):
        return json.dumps(str(value), ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, list | tuple):
        return f"[{', '.join(format_value(each) for each in value)}]"
    if isinstance(value, Mapping):
        return f"{{{', '.join(table_lines(value))}}}"
    raise InputError(
        f"{value!r} cannot stand in a TOML file",
        "use text, numbers, true or false, or lists of them",
    )


def _format_key(key: Any) -> str:
    """Return a key in TOML's notation, quoted where it needs to be."""
    text = str(key)
    return (
        text
        if text and all(c.isascii() and (c.isalnum() or c in "-_") for c in text)
        else format_value(text)
    )
