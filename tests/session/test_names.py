"""The order in which names of files count."""

import random

import pytest

from slviewer.session.names import natural_order


@pytest.mark.parametrize(
    "names",
    [
        [f"pose_{i}.png" for i in range(3, 14)],
        [f"f{i:x}.bmp" for i in range(40)],
        [f"0x{i:04X}_raw.png" for i in range(500, 540)],
        [*"abcdefghijklmnopqrstuvwxyz", "aa", "ab", "ac"],
        [f"DSC{9995 + i:04d}.JPG" for i in range(5)] + [f"DSC{i:04d}.JPG" for i in range(1, 20)],
        [f"{9995 + i:04d}.JPG" for i in range(5)] + [f"{i:04d}.JPG" for i in range(20)],
        ["a.png", "aa.png"],
        ["only.png"],
        [],
    ],
    ids=lambda names: names[0] if names else "none",
)
def test_names_are_in_the_order_in_which_they_count(names):
    mixed = names.copy()
    random.Random(4).shuffle(mixed)
    assert natural_order(mixed) == names


@pytest.mark.parametrize(
    "names",
    [
        ["0001.png", "0002.png", "9998.png"],
        ["1.png", "2.png", "10.png", "a.png"],
        ["b.png", "ba.png", "c.png"],
        ["f1.png", "f9.png", "f10.png"],
    ],
    ids=lambda names: names[-1],
)
def test_a_count_with_gaps_is_in_natural_order(names):
    assert natural_order(names[::-1]) == names
