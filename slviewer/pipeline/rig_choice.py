"""From what the operator chose to devices: a choice is a plain mapping, as the session keeps it.

``{"driver": "simulated", "scale": 0.5, "seed": 0}`` for a rig that one driver makes, or ``{"name":
"bench", "camera": {"driver": …}, "projector": {"driver": …}}``; all other keys but `ABOUT` go to
the driver.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

from slviewer.devices.browser import PAGE_ROLES, PageChannels, PageRole
from slviewer.devices.drivers import Driver, driver, drivers
from slviewer.devices.protocols import Rig, Turntable
from slviewer.devices.simulated import simulated_rig
from slviewer.devices.world import SimulatedWorld, Thing
from slviewer.errors import InputError
from slviewer.pipeline.replay import Reel, reel
from slviewer.simulation.rig import letter
from slviewer.target.board import Board

Choice = Mapping[str, Any]

COMMON_KEYS = ("name", "settle_ms", "focal_px", "exposure_ms", "gain", "turntable")
"""Keys that a choice may hold for any rig: its name, the delay of its light, the nominal focal
length of its lens in camera px, what its camera is set to by default, and its turntable."""


@dataclass(frozen=True)
class RigSetup:
    """A rig that can be opened; `world` is the scene of a simulated one, `focal_px` the lens's
    nominal focal length in camera px, where it is known, `reel` what is played back.
    """

    rig: Rig
    world: SimulatedWorld | None = None
    focal_px: float | None = None
    reel: Reel | None = None


SetUp = Callable[[Choice, Board | None], RigSetup]


def set_up(choice: Choice, board: Board | None, *, pages: PageChannels | None = None) -> RigSetup:
    """The devices of a choice, not opened yet; `board` is in front of a simulated rig, `pages`
    leads to the pages of the browser's devices where they are served.

    Raises InputError for an invalid choice, DeviceError for a driver that cannot be used here.
    """
    bench = _set_up_devices(choice, board, pages)
    if "turntable" in choice:
        table = _set_up_turntable(choice["turntable"], bench.world)
        bench = replace(bench, rig=replace(bench.rig, turntable=table))
    return bench


def _set_up_turntable(choice: Choice, world: SimulatedWorld | None) -> Turntable:
    """The turntable of a choice, not opened yet; a simulated one turns the thing in `world`."""
    options = dict(choice)
    try:
        chosen = driver(str(options.pop("driver")))
        if chosen.turntable is None:
            raise InputError(f"the driver {chosen.name} offers no turntable: choose another")
        if chosen.name != "simulated":
            return chosen.turntable(**options)
        if world is None:
            raise InputError(
                "a simulated turntable turns only what is before the simulated rig: choose another"
            )
        return chosen.turntable(world, **options)
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"the turntable {dict(choice)} cannot be set up ({error}): choose it again"
        ) from error


def _set_up_devices(choice: Choice, board: Board | None, pages: PageChannels | None) -> RigSetup:
    """Camera and projector of a choice, as `set_up` returns them."""
    options = {key: value for key, value in choice.items() if key not in (*COMMON_KEYS, "driver")}
    focal, settle_ms = choice.get("focal_px"), float(choice.get("settle_ms", 0.0))
    try:
        if choice.get("driver") == "simulated":
            bench = _simulated_setup(board, **options)
            return replace(bench, rig=replace(bench.rig, settle_ms=settle_ms))
        if choice.get("driver") == "replay":
            played = reel(**options)
            return RigSetup(played.rig, focal_px=focal, reel=played)
        if "driver" in choice:
            chosen = driver(str(choice["driver"]))
            if chosen.rig is None:
                raise InputError(
                    f"the driver {choice['driver']} offers no whole rig: choose a camera and a"
                    " projector"
                )
            rig = chosen.rig(**options)
            rig = replace(rig, settle_ms=settle_ms or rig.settle_ms)
        else:
            devices: list[Any] = []
            for part in ("camera", "projector"):
                given = dict(options.pop(part))
                chosen = driver(given.pop("driver"))
                make = getattr(chosen, part)
                if make is None:
                    raise InputError("one of the drivers offers no such device: choose others")
                if chosen.page:
                    given["page"] = pages and getattr(pages, part)
                devices.append(make(**given))
            rig = Rig(str(choice.get("name", "rig")), devices[0], devices[1], settle_ms)
        return RigSetup(rig, focal_px=focal)
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"the rig {dict(choice)} cannot be set up ({error}): choose it again"
        ) from error


def list_needed_pages(choice: Choice) -> tuple[PageRole, ...]:
    """Return which of a choice's devices are pages in a browser."""
    parts = {role: part for role in PAGE_ROLES if isinstance(part := choice.get(role), Mapping)}
    named = {role: drivers().get(str(part.get("driver"))) for role, part in parts.items()}
    return tuple(role for role, named_driver in named.items() if named_driver and named_driver.page)


def rig_factory(driver: Driver) -> Callable[..., Any] | None:
    """Return the function that builds the whole rig of a driver from its options; None if it drives
    no whole rig."""
    own: dict[str, Callable[..., Any]] = {"simulated": _simulated_setup, "replay": reel}
    return own.get(driver.name, driver.rig)


def _simulated_setup(
    board: Board | None,
    preset: str = "letter",
    scale: float = 1.0,
    seed: int = 0,
    thing: Thing = "board",
) -> RigSetup:
    """Return the simulated rig of a preset, with a thing of `devices.world`, such as the board, in
    view."""
    if preset != "letter":
        raise InputError(f"no rig preset is called {preset!r}: use letter")
    rig = letter(scale, seed)
    world = SimulatedWorld(rig, board)
    if thing != "board":
        world.place(thing)
    return RigSetup(simulated_rig(world), world, rig.camera.focal_px[0] * scale)
