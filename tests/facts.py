"""Errors matched by their type and by the facts in their message, not by its wording."""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TypeVar

import pytest

E = TypeVar("E", bound=Exception)


def missing_facts(text: str, *facts: object) -> list[str]:
    """Return the facts (numbers, names, options, terms of the field) that a text lacks, in any
    order and any case.

    A fact stands in the text by itself: 12 is not in "120" nor in "0.12", and "line" not in
    "outline".
    """
    return [str(fact) for fact in facts if not re.search(_pattern(str(fact)), text, re.IGNORECASE)]


def _pattern(fact: str) -> str:
    """Return the regular expression of a fact that is no part of a longer word or number."""
    before = r"(?<!\w)(?<!\d\.)" if fact[0].isalnum() else ""
    after = r"(?!\w)(?!\.\d)" if fact[-1].isalnum() else ""
    return before + re.escape(fact) + after


@contextmanager
def raises(
    error: type[E] | tuple[type[E], ...], *facts: object
) -> Iterator[pytest.ExceptionInfo[E]]:
    """Expect an error of a type whose message states all facts, see `missing_facts`."""
    with pytest.raises(error) as caught:
        yield caught
    missing = missing_facts(str(caught.value), *facts)
    assert not missing, f"{missing} not in: {caught.value}"
