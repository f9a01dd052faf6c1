"""A few of the deaths and write faults that `python -m tests.faults` tries in great number."""

import pytest
from faults import COMMANDS, run

pytestmark = pytest.mark.slow


def test_a_command_that_dies_or_is_refused_leaves_a_session_that_goes_on() -> None:
    quick = tuple(command for command in COMMANDS if command.split()[0] in ("import", "restore", "align"))
    outcomes = run(8, 4, seed=1, commands=quick)
    assert outcomes["wrong"] == 0 and outcomes["died"] >= 6 and sum(outcomes.values()) == 12
