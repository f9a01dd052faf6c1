"""Variants of a test, of which the slow tier runs those that say little new."""

from collections.abc import Sequence
from typing import Any

import pytest


def often(*variants: Any) -> list[Any]:
    """Return parameters of variants, tuples of values or single ones, that only the slow tier
    runs."""
    return [
        pytest.param(*(v if type(v) is tuple else (v,)), marks=pytest.mark.slow) for v in variants
    ]


def crossed(first: Sequence[Any], second: Sequence[Any]) -> list[Any]:
    """Return parameters of all pairs; by default each of the first runs with one of the second, in
    turn."""
    return [
        pytest.param(a, b, marks=[] if k == i % len(second) else pytest.mark.slow)
        for i, a in enumerate(first)
        for k, b in enumerate(second)
    ]
