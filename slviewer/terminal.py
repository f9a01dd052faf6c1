"""Progress and messages of a command, on standard error."""

import re
import sys
import unicodedata

_UNUSUAL = re.compile(r"[^\n\t -~]")
_UNPRINTABLE = {"Cc", "Cf", "Cs", "Co", "Cn", "Zl", "Zp"}


def progress(done: float, doing: str) -> None:
    """Print the share `done`, 0 ... 1, as one line that is redrawn in place; silent unless on a terminal."""
    if sys.stderr.isatty():
        end = "\n" if done >= 1 else ""
        print(f"\r\033[K{100 * done:3.0f} % {escape_controls(doing)}", end=end, file=sys.stderr, flush=True)


def escape_controls(text: str) -> str:
    """Return text with the control and direction characters in it (but line breaks and tabs) as escapes: `\\x1b`.

    Names and files from outside may hold some, which would drive the terminal.
    """

    def escape(match: re.Match[str]) -> str:
        """Return one character, or its escape where it is not printable."""
        character = match[0]
        if unicodedata.category(character) not in _UNPRINTABLE:
            return character
        return character.encode("unicode_escape").decode("ascii")

    return _UNUSUAL.sub(escape, text)


def print_message(message: str) -> None:
    """Print a message, in place of an unfinished progress line."""
    if sys.stderr.isatty():
        print("\r\033[K", end="", file=sys.stderr)
    print(escape_controls(message), file=sys.stderr)


def print_result(text: str) -> None:
    """Print what a command returns on standard output."""
    print(escape_controls(text))


def warn(message: str) -> None:
    """Print a warning."""
    print_message(f"warning: {message}")
