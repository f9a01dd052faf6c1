"""Text from outside, made harmless."""

import csv
import io

import pytest

from slviewer.printable import escape_controls, format_csv


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("plain ± 0.1 µm\n\ttab", "plain ± 0.1 µm\n\ttab"),
        ("a\x1b[2Jb", "a\\x1b[2Jb"),
        ("gpj\u202egnp.exe", "gpj\\u202egnp.exe"),
        ("a\x00\x7f\u2028", "a\\x00\\x7f\\u2028"),
        ("Zürich 東京", "Zürich 東京"),
    ],
)
def test_what_would_drive_a_terminal_is_escaped(text: str, shown: str) -> None:
    assert escape_controls(text) == shown


def test_a_table_is_read_back_and_runs_nothing() -> None:
    rows = [
        ["name", "value"],
        ["=1+1", -1.5],
        ["@sum", "-2.5"],
        ['a,"b"', "1e-3"],
        ["x\x1b[2J", "nan"],
        ["-a", None],
    ]
    read = list(csv.reader(io.StringIO(format_csv(rows))))
    assert read == [
        ["name", "value"], ["'=1+1", "-1.5"], ["'@sum", "-2.5"], ['a,"b"', "1e-3"],
        ["x\\x1b[2J", "nan"], ["'-a", ""],
    ]  # fmt: skip
