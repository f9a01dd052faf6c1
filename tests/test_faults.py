"""A few of the deaths and write faults that `python -m tests.faults` tries in great number."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = [pytest.mark.slow, pytest.mark.process]

ROOT = Path(__file__).parents[1]


def test_a_command_that_dies_or_is_refused_leaves_a_session_that_goes_on() -> None:
    some = [
        "--kills",
        "8",
        "--faults",
        "4",
        "--seed",
        "1",
        "--commands",
        "import",
        "restore",
        "align",
    ]
    # in a process of its own: compiled code that ran in parallel must not be forked
    ran = subprocess.run(
        [sys.executable, "-m", "tests.faults", *some], cwd=ROOT, capture_output=True, text=True
    )
    assert ran.returncode == 0, ran.stdout + ran.stderr
    counted = re.search(r"^12 cases: (.*)$", ran.stdout, re.MULTILINE)
    assert counted is not None and int(re.search(r"(\d+) died", counted[1])[1]) >= 6  # type: ignore[index]
