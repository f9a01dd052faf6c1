"""What tests of the wizard share: a timing that spares the machine, and waits for events instead of
times."""

from collections.abc import Callable

import clocks
from clocks import HANG_S

from slviewer.wizard.operator import Operator
from slviewer.wizard.service import Timing
from slviewer.wizard.snapshot import Level, Snapshot

SPARING = Timing(retry_s=0.1, previews_per_s=1.0, trials=20)
"""Nobody looks at the previews, and the best of fewer poses does."""


def until(condition: Callable[[], bool]) -> None:
    """Wait until a condition holds that other threads fulfil."""
    assert clocks.until(condition), "it never happened"


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
