"""Sizes as people write them: 912x1140."""

import re

from slviewer.errors import InputError


def parse_size(size: str | tuple[int, int], whose: str) -> tuple[int, int]:
    """(width, height) px from ``WIDTHxHEIGHT``; InputError says what is wrong."""
    if isinstance(size, tuple):
        return size
    match = re.fullmatch(r"\s*(\d+)\s*[x×]\s*(\d+)\s*", size)
    if not match or not all(8 <= int(n) <= 32768 for n in match.groups()):
        raise InputError(f"the {whose}'s size {size!r} is not understood: write width x height in px, like 912x1140")
    return int(match[1]), int(match[2])
