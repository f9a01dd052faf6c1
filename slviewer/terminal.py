"""What a command says on standard error while it works."""

import sys


def progress(done: float, doing: str) -> None:
    """One line, redrawn in place on a terminal; silent elsewhere."""
    if sys.stderr.isatty():
        end = "\n" if done >= 1 else ""
        print(f"\r\033[K{100 * done:3.0f} % {doing}", end=end, file=sys.stderr, flush=True)


def say(message: str) -> None:
    """One sentence, in the place of an unfinished progress line."""
    if sys.stderr.isatty():
        print("\r\033[K", end="", file=sys.stderr)
    print(message, file=sys.stderr)


def warn(message: str) -> None:
    """One sentence that the operator should know of."""
    say(f"warning: {message}")
