"""How long work reports progress and warnings to its caller."""

from collections.abc import Callable

Progress = Callable[[float, str], None]
"""Called with the share done (0 to 1) and what is being done; it may raise Cancelled to stop the work."""

Warn = Callable[[str], None]
"""Called with one sentence that the operator should know of."""


def ignore_progress(done: float, doing: str) -> None:
    """Ignore the progress."""


def ignore_warnings(message: str) -> None:
    """Ignore the warning."""


def part(progress: Progress, begin: float, end: float, label: str = "") -> Progress:
    """The progress of one stage, as a share of the whole; ``label`` stands before what is being done."""

    def report(done: float, doing: str) -> None:
        progress(begin + (end - begin) * done, f"{label}: {doing}" if label else doing)

    return report


def stage(progress: Progress, begin: float, end: float, doing: str) -> Callable[[float], None]:
    """Report that a stage begins; returns what reports the share of it that is done."""
    progress(begin, doing)
    return lambda done: progress(begin + (end - begin) * done, doing)
