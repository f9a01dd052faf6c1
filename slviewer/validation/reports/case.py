"""What a rebuilt report is given, and what it answers."""

import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from slviewer.pipeline.calibrate import calibrate
from slviewer.pipeline.simulate import TARGET, simulate

BASE_POSES, BASE_SCALE = 8, 0.25


@dataclass(frozen=True)
class Outcome:
    """What was ``measured`` or said, beside the ``truth``; ``holds``: the value is right, or a
    refusal names a remedy that leads to the right value."""

    measured: str
    truth: str
    holds: bool


@dataclass(frozen=True)
class Workplace:
    """An empty ``folder`` for one case; ``shared`` holds what cases share."""

    folder: Path
    shared: Path

    def base(self) -> Path:
        """A copy of its own of the simulated session, calibrated from `BASE_POSES` poses."""
        made = self.shared / "base"
        if not made.exists():
            simulate(made, poses=BASE_POSES, scale=BASE_SCALE)
            calibrate(made, target=TARGET)
        return Path(shutil.copytree(made, self.folder / "base"))


Case = Callable[[Workplace], Outcome]
