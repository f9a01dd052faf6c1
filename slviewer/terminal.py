"""Progress and messages of a command, on standard error."""

import io
import sys

from slviewer.printable import escape_controls


def accept_all_characters() -> None:
    """Let the standard streams replace what their encoding lacks, such as an arrow in Windows' code
    pages."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace" if stream is sys.stderr else "replace")


def progress(done: float, doing: str) -> None:
    """Print the share `done`, 0 ... 1, as one line that is redrawn in place; silent unless on a
    terminal."""
    if sys.stderr.isatty():
        print(
            f"\r\033[K{100 * done:3.0f} % {escape_controls(doing)}",
            end="\n" if done >= 1 else "",
            file=sys.stderr,
            flush=True,
        )


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
