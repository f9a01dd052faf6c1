"""Text and tables with content from outside, made harmless for terminals, pages and
spreadsheets."""

import csv
import io
import re
import unicodedata
from collections.abc import Iterable

_UNUSUAL = re.compile(r"[^\n\t -~]")
_UNPRINTABLE = {"Cc", "Cf", "Cs", "Co", "Cn", "Zl", "Zp"}
_FORMULA = ("=", "+", "-", "@", "\t")
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?|[+-]?(inf|nan)")


def escape_controls(text: str) -> str:
    """Return text with the control and direction characters in it (but line breaks and tabs) as
    escapes: `\\x1b`.

    Names and files from outside may hold some, which would drive a terminal or hide what a page
    shows.
    """

    def escape(match: re.Match[str]) -> str:
        """Return one character, or its escape where it is not printable."""
        character = match[0]
        if unicodedata.category(character) not in _UNPRINTABLE:
            return character
        return character.encode("unicode_escape").decode("ascii")

    return _UNUSUAL.sub(escape, text)


def capitalize(text: str) -> str:
    """Return text with a capital first letter, and all others as they are."""
    return text[:1].upper() + text[1:]


def format_csv(rows: Iterable[Iterable[object]]) -> str:
    """Return rows as comma-separated values; text in them holds no control characters and no
    formula."""
    text = io.StringIO(newline="")
    csv.writer(text, lineterminator="\n").writerows(
        [_make_cell(value) for value in row] for row in rows
    )
    return text.getvalue()


def _make_cell(value: object) -> object:
    """Return a value that a spreadsheet shows as it is: numbers unchanged, also those that were
    formatted."""
    if not isinstance(value, str):
        return value
    text = escape_controls(value)
    if text.startswith(_FORMULA) and not _NUMBER.fullmatch(text):
        return f"'{text}"
    return text
