"""How long work speaks to whoever asked for it."""

from collections.abc import Callable

Progress = Callable[[float, str], None]
"""Called with the share done (0 to 1) and what is being done; it may raise Cancelled to stop the work."""

Warn = Callable[[str], None]
"""Called with one sentence that the operator should know of."""


def unheard(done: float, doing: str) -> None:
    """A Progress that nobody listens to."""


def unwarned(message: str) -> None:
    """A Warn that nobody listens to."""


def part(progress: Progress, begin: float, end: float) -> Progress:
    """The progress of one stage, as a share of the whole."""

    def report(done: float, doing: str) -> None:
        progress(begin + (end - begin) * done, doing)

    return report
