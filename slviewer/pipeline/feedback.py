"""How long work reports progress and warnings to its caller."""

from collections.abc import Callable

Progress = Callable[[float, str], None]
"""Called with the share done (0 to 1) and what is being done; it may raise Cancelled to stop the
work."""

Warn = Callable[[str], None]
"""Called with one sentence that the operator should know of."""


def ignore_progress(done: float, doing: str) -> None:
    """Ignore the progress."""


def ignore_warnings(message: str) -> None:
    """Ignore the warning."""


def part(progress: Progress, start: float, end: float, label: str = "") -> Progress:
    """Map the progress 0 to 1 of a stage to ``start`` to ``end`` of the whole; ``label``: a
    prefix."""

    def report(done: float, doing: str) -> None:
        """Report the share ``done`` (0 to 1) of the stage as a share of the whole."""
        progress(start + (end - start) * done, f"{label}: {doing}" if label else doing)

    return report


def stage(progress: Progress, start: float, end: float, doing: str) -> Callable[[float], None]:
    """Report the start of a stage; returns a callback for the share of it, 0 to 1, that is done."""
    progress(start, doing)
    return lambda done: progress(start + (end - start) * done, doing)
