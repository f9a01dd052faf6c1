"""Settings of functions: frozen dataclasses whose fields are the keywords of a function, described
once."""

import inspect
from collections.abc import Callable
from dataclasses import dataclass
from functools import wraps
from typing import Any, ParamSpec, TypeVar

from slviewer.pipeline.feedback import Progress, Warn, ignore_progress, ignore_warnings

P = ParamSpec("P")
R = TypeVar("R")
S = TypeVar("S")


@dataclass(frozen=True, kw_only=True)
class Callbacks:
    """What takes the progress and the warnings of work; the base of settings."""

    progress: Progress = ignore_progress
    warn: Warn = ignore_warnings


def takes_settings(settings: Callable[P, S]) -> Callable[[Callable[[S], R]], Callable[P, R]]:
    """Return a decorator of a function of such settings: it is called with their fields.

    The function's docstring describes it, and those of the settings and their bases the fields.
    """

    def decorate(function: Callable[[S], R]) -> Callable[P, R]:
        """Return the function that takes the fields."""

        @wraps(function)
        def call(*args: P.args, **kwargs: P.kwargs) -> R:
            return function(settings(*args, **kwargs))

        call.__doc__ = describe(function, settings)
        signature = inspect.signature(settings)
        returned = inspect.signature(function).return_annotation
        call.__signature__ = signature.replace(return_annotation=returned)  # type: ignore[attr-defined]
        return call

    return decorate


def describe(function: Callable[..., Any], settings: Callable[..., Any]) -> str:
    """Return the docstring of a function, with the fields that its settings and their bases
    describe."""
    assert inspect.isclass(settings)
    docs = [
        inspect.cleandoc(each.__doc__ or "").partition("Args:\n")[2] for each in settings.__mro__
    ]
    own, *inherited = docs
    described, _, rest = own.partition("\n\n")
    fields = "\n".join([described, *(doc.partition("\n\n")[0] for doc in inherited if doc)])
    return "\n\n".join(
        filter(None, (inspect.getdoc(function), fields and f"Args:\n{fields}", rest))
    )
