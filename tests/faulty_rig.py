"""Devices that fail on purpose, to prove that a fault ends one capture and harms nothing else.

`breakable(rig)` wraps any rig; `Faults.plan` says what goes wrong at which frame of the next
capture.
"""

from collections.abc import Callable
from typing import Literal, get_args

import numpy as np

from slviewer.devices.protocols import Camera, CameraSettings, Projector, Rig, Turntable
from slviewer.errors import DeviceError, InputError, TurntableError
from slviewer.fringe.sequence import PatternSequence
from slviewer.pipeline.rig_choice import Choice, RigSetup, set_up
from slviewer.target.board import Board

Fault = Literal["timeout", "unplugged", "projector", "turntable"]
"""The camera gives no frame once; the camera is gone until it is closed and opened; the same for
the projector; the turntable raises an alarm once."""


class Faults:
    """What is planned, and what is broken now."""

    def __init__(self) -> None:
        self._planned: tuple[Fault, int] | None = None
        self._gone: set[str] = set()
        self.shown: int | None = None

    def plan(self, fault: Fault, frame: int) -> None:
        """Let `fault` happen once, when frame `frame` of a sequence is shown; previews do not set
        it off. That of the turntable happens when it is to turn to `frame` degrees.
        """
        if fault not in get_args(Fault):
            raise InputError(
                f"no fault is called {fault!r}: use one of {', '.join(get_args(Fault))}"
            )
        self._planned = (fault, frame)

    def strike(self, device: str) -> None:
        """Raise DeviceError if `device`, "camera" or "projector", is broken or breaks now."""
        if self._planned is not None and self.shown == self._planned[1]:
            fault = self._planned[0]
            if (fault == "projector") == (device == "projector"):
                self._planned = None
                if fault == "timeout":
                    raise DeviceError(
                        "the camera gave no frame within 2 s: check its cable and its trigger"
                    )
                self._gone.add(device)
        if device in self._gone:
            raise DeviceError(f"the {device} does not answer: plug it in again and reconnect")

    def strike_turntable(self, deg: float) -> None:
        """Raise TurntableError if the turntable breaks at this angle."""
        if (
            self._planned is not None
            and self._planned[0] == "turntable"
            and deg >= self._planned[1]
        ):
            self._planned = None
            raise TurntableError("the turntable raised alarm 1: see that the table turns freely")

    def restore(self, device: str) -> None:
        """What opening a device again does."""
        self._gone.discard(device)


class FaultyCamera:
    """A camera that works until its faults say otherwise."""

    def __init__(self, camera: Camera, faults: Faults) -> None:
        self._camera, self._faults = camera, faults
        self.name, self.size, self.dtype = camera.name, camera.size, camera.dtype

    def open(self) -> None:
        """Open the wrapped camera, working again."""
        self._camera.open()
        self._faults.restore("camera")

    def close(self) -> None:
        """Close the wrapped camera."""
        self._camera.close()

    def grab(self, out: np.ndarray) -> None:
        """The wrapped camera's frame, or the fault."""
        self._faults.strike("camera")
        self._camera.grab(out)

    def settings(self) -> CameraSettings:
        """The wrapped camera's."""
        self._faults.strike("camera")
        return self._camera.settings()

    def apply(self, settings: CameraSettings) -> CameraSettings:
        """The wrapped camera's."""
        self._faults.strike("camera")
        return self._camera.apply(settings)


class FaultyProjector:
    """A projector that works until its faults say otherwise."""

    def __init__(self, projector: Projector, faults: Faults) -> None:
        self._projector, self._faults = projector, faults
        self.name, self.size = projector.name, projector.size

    def open(self) -> None:
        """Open the wrapped projector, working again."""
        self._projector.open()
        self._faults.restore("projector")

    def close(self) -> None:
        """Close the wrapped projector."""
        self._projector.close()

    def load(self, sequence: PatternSequence) -> None:
        """Load the wrapped projector."""
        self._faults.shown = None
        self._faults.strike("projector")
        self._projector.load(sequence)

    def show(self, index: int) -> None:
        """Show it, or the fault."""
        self._faults.shown = index
        self._faults.strike("projector")
        self._projector.show(index)

    def show_level(self, grey: int | None) -> None:
        """Even light, or the fault."""
        self._faults.shown = None
        self._faults.strike("projector")
        self._projector.show_level(grey)


class FaultyTurntable:
    """A turntable that works until its faults say otherwise."""

    def __init__(self, table: Turntable, faults: Faults) -> None:
        self._table, self._faults = table, faults
        self.name, self.limits_deg, self.is_absolute = (
            table.name,
            table.limits_deg,
            table.is_absolute,
        )

    def open(self) -> None:
        """Open the wrapped turntable."""
        self._table.open()

    def close(self) -> None:
        """Close the wrapped turntable."""
        self._table.close()

    def position_deg(self) -> float:
        """The wrapped turntable's."""
        return self._table.position_deg()

    def turn_to(self, deg: float, check: Callable[[], None] = lambda: None) -> None:
        """Turn it, or the fault."""
        self._faults.strike_turntable(deg)
        self._table.turn_to(deg, check)


def breakable(rig: Rig) -> tuple[Rig, Faults]:
    """`rig` with devices that can be broken, and the faults that break them."""
    faults = Faults()
    table = None if rig.turntable is None else FaultyTurntable(rig.turntable, faults)
    camera, projector = FaultyCamera(rig.camera, faults), FaultyProjector(rig.projector, faults)
    return Rig(rig.name, camera, projector, turntable=table), faults


class FaultyRigs:
    """Sets rigs up as usual, with faults that can be planned."""

    faults: Faults

    def __call__(self, choice: Choice, board: Board | None) -> RigSetup:
        bench = set_up(choice, board)
        rig, self.faults = breakable(bench.rig)
        return RigSetup(rig, bench.world, bench.focal_px)
