"""What tests of the wizard share: a timing that spares the machine, and waits for events instead of times."""

import time
from collections.abc import Callable

from slviewer.wizard.operator import Operator
from slviewer.wizard.snapshot import Level, Snapshot
from slviewer.wizard.timing import Timing

HANG_S = 900.0
"""Ends a test that hangs; nothing that works takes as long on the slowest machine."""
SPARING = Timing(retry_s=0.1, previews_per_s=1.0, trials=20)
"""Nobody looks at the previews, and the best of fewer poses does."""


def until(condition: Callable[[], bool]) -> None:
    """Wait until a condition holds that other threads fulfil."""
    end = time.monotonic() + HANG_S
    while not condition():
        assert time.monotonic() < end, "it never happened"
        time.sleep(0.005)


def wait_until_open(operator: Operator) -> None:
    """Wait until the rig is open."""
    assert operator.wait_for(lambda s: s.rig.state == "open", HANG_S)


def last_notice(snapshot: Snapshot) -> str:
    """Return the text of the latest notice; empty where there is none."""
    return snapshot.notices[-1].text if snapshot.notices else ""


def list_texts(source: Operator | Snapshot, level: Level) -> list[str]:
    """List the notices of one level, oldest first."""
    notices = source.notices if isinstance(source, Snapshot) else source.notices()
    return [notice.text for notice in notices if notice.level == level]
