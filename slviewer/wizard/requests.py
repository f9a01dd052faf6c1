"""How requests are granted or refused: at once, without raising."""

from collections.abc import Callable
from dataclasses import replace
from functools import wraps
from typing import Any, Concatenate, ParamSpec, TypeVar

from slviewer.pipeline.models import accepts_rejected
from slviewer.pipeline.operation import Findings, Operation
from slviewer.wizard.engine import Engine
from slviewer.wizard.jobs import Reporter

T = TypeVar("T")


class RequestHandler:
    """Base of all groups of requests to an engine."""

    _engine: Engine

    def _warner(self, section: str) -> Callable[[str], None]:
        """Return a function that adds a warning to the notices, with its section of the help."""
        return lambda text: self._engine.notices.add("warning", text, section)

    def _submit(
        self,
        name: str,
        work: Callable[[Reporter], T],
        describe: Callable[[T], str],
        failed: Callable[[BaseException], None] | None = None,
    ) -> None:
        """Queue a job; `describe(result)` becomes a notice, and `failed(error)` replaces the notice
        of a failure."""

        def done(result: T) -> None:
            """Add the description of the result to the notices, and mark the session as changed."""
            is_good = not isinstance(result, Findings) or all(
                each.is_good for each in result.values()
            )
            if text := describe(result):
                self._engine.notices.add("good" if is_good else "warning", text)
            self._engine.publisher.mark_changed(session=True)

        self._engine.jobs.submit(name, work, done, failed=failed)

    def _run(
        self,
        title: str,
        operation: Operation[..., Any, Any],
        settings: Any,
        section: str = "",
        failed: Callable[[BaseException], None] | None = None,
    ) -> None:
        """Queue an operation on the session; the summary of what it found becomes a notice.

        A calibration that the operator uses although it was rejected is used. ``section``: of the
        help, of warnings.
        """
        store, warn = self._engine.store, self._warner(section)

        def work(report: Reporter) -> Findings[Any]:
            """Run the operation, which no longer saves once the job was cancelled."""
            used = settings
            if accepts_rejected(store) and hasattr(settings, "accept_rejected"):
                used = replace(settings, accept_rejected=True)
            return operation.run(store.guarded(report.saving), used, report, warn)

        self._submit(title, work, Findings.summary, failed)


P = ParamSpec("P")
Handler = TypeVar("Handler", bound=RequestHandler)
Request = Callable[Concatenate[Any, P], bool]


def request(action: str) -> Callable[[Callable[Concatenate[Handler, P], None]], Request[P]]:
    """Return a decorator: the method then returns whether its request was granted, and an error
    becomes a notice."""

    def decorate(function: Callable[Concatenate[Handler, P], None]) -> Request[P]:
        """Wrap a method as a request."""

        @wraps(function)
        def handle(self: Handler, /, *args: P.args, **kwargs: P.kwargs) -> bool:
            """Call the method; return True, or False with a notice where it raised an error."""
            try:
                function(self, *args, **kwargs)
            except Exception as error:
                self._engine.notices.add_failure(action, error)
                return False
            finally:
                self._engine.publisher.mark_changed(session=True)
            return True

        return handle

    return decorate
