"""How a request is granted or refused: at once, without raising, and in words."""

from collections.abc import Callable
from functools import wraps
from typing import Any, Concatenate, ParamSpec, TypeVar

from slviewer.wizard.engine import Engine


class RequestHandler:
    """Whoever takes requests for an engine."""

    _engine: Engine


P = ParamSpec("P")
Self = TypeVar("Self", bound=RequestHandler)
Request = Callable[Concatenate[Any, P], bool]


def request(doing: str) -> Callable[[Callable[Concatenate[Self, P], None]], Request[P]]:
    """Turns what a request raises into a notice, and tells everybody that something changed."""

    def decorate(function: Callable[Concatenate[Self, P], None]) -> Request[P]:
        @wraps(function)
        def ask(self: Self, /, *args: P.args, **kwargs: P.kwargs) -> bool:
            try:
                function(self, *args, **kwargs)
            except Exception as error:
                self._engine.notices.fail(doing, error)
                return False
            finally:
                self._engine.publisher.changed(session=True)
            return True

        return ask

    return decorate
