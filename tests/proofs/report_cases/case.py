"""What a rebuilt report is given, and what it answers."""

import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from slviewer.errors import SlviewerError
from slviewer.fringe.presets import p18
from slviewer.fringe.sequence import one_axis
from slviewer.pipeline.calibrate import calibrate
from slviewer.pipeline.simulate import TARGET, simulate
from slviewer.session.capture import NewCapture, Role
from slviewer.session.store import Session
from slviewer.simulation.renderer import Renderer
from slviewer.simulation.rig import SimulatedRig
from slviewer.simulation.scenes import Scene

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

    def capture(
        self,
        rig: SimulatedRig,
        scenes: Mapping[str, Scene],
        first: int = 0,
        axes: str = "x",
        role: Role = "scan",
    ) -> Path:
        """A calibrated session with captures of scenes by a rig, whose noise is numbered from
        ``first`` on."""
        session, sequence = self.base(), p18(rig.projector.size)
        if axes == "x":
            sequence = one_axis(sequence, "x")
        captures = (
            NewCapture(name, sequence, Renderer(rig, scene).capture(sequence, k))
            for k, (name, scene) in enumerate(scenes.items(), first)
        )
        with Session.open(session, write=True) as store:
            store.save_captures(captures, role, board=TARGET if role == "calibration" else None)
        return session


def read_refusal(work: Callable[[], object], otherwise: str) -> str:
    """Return the program's own error that ends some work, else what is given for none."""
    try:
        work()
    except SlviewerError as error:
        return str(error)
    return otherwise


Case = Callable[[Workplace], Outcome]
