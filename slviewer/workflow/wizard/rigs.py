"""From what the operator chose to devices: a choice is a plain mapping, as the session keeps it.

``{"driver": "simulated", "scale": 0.5, "seed": 0}`` for a rig that one driver makes, or
``{"name": "bench", "camera": {"driver": …}, "projector": {"driver": …}}``; all other keys go to the driver.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from slviewer.devices.drivers import driver
from slviewer.devices.protocols import Rig
from slviewer.devices.simulated import simulated_rig
from slviewer.devices.world import SimulatedWorld
from slviewer.errors import InputError
from slviewer.simulation.rig import letter
from slviewer.target.board import Board

Choice = Mapping[str, Any]


@dataclass(frozen=True)
class Bench:
    """A rig that can be opened; `world` is what stands before a simulated one, `focal_px` the lens's nominal focal
    length in camera px, where it is known.
    """

    rig: Rig
    world: SimulatedWorld | None = None
    focal_px: float | None = None


SetUp = Callable[[Choice, Board | None], Bench]


def set_up(choice: Choice, board: Board | None) -> Bench:
    """The devices of a choice, not opened yet; `board` is what stands before a simulated rig.

    Raises InputError for a choice that is none, DeviceError for a driver that cannot be used here.
    """
    options = {key: value for key, value in choice.items() if key not in ("driver", "name", "focal_px")}
    focal = choice.get("focal_px")
    try:
        if choice.get("driver") == "simulated":
            return _simulated(board, **options)
        if "driver" in choice:
            make = driver(str(choice["driver"])).rig
            if make is None:
                raise InputError(f"the driver {choice['driver']} offers no whole rig: choose a camera and a projector")
            return Bench(make(**options), focal_px=focal)
        camera, projector = (dict(options.pop(which)) for which in ("camera", "projector"))
        make_camera, make_projector = driver(camera.pop("driver")).camera, driver(projector.pop("driver")).projector
        if make_camera is None or make_projector is None:
            raise InputError("one of the drivers offers no such device: choose others")
        rig = Rig(str(choice.get("name", "rig")), make_camera(**camera), make_projector(**projector))
        return Bench(rig, focal_px=focal)
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"the rig {dict(choice)} cannot be set up ({error}): choose it again") from error


def _simulated(board: Board | None, preset: str = "letter", scale: float = 1.0, seed: int = 0) -> Bench:
    if preset != "letter":
        raise InputError(f"no rig preset is called {preset!r}: use letter")
    rig = letter(scale, seed)
    return Bench(simulated_rig(world := SimulatedWorld(rig, board)), world, rig.camera.focal_px[0] * scale)
