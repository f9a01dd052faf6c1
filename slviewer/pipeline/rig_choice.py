"""Rigs: from what the operator chose to devices, choices by name, recorded captures as a rig, and
what there is to choose from.

A choice is a plain mapping, as the session keeps it: ``{"driver": "simulated", "scale": 0.5,
"seed": 0}`` for a rig that one driver makes, or ``{"name": "bench", "camera": {"driver": …},
"projector": {"driver": …}}``; all other keys but `COMMON_KEYS` go to the driver.

Choices with a name are TOML files, shipped in ``assets/rigs`` or the operator's own in the session.
A file holds what `set_up` takes, and `what`, a sentence about it. The content of a file is checked
before a device is touched, so that a mistyped option is named and not ignored.
"""

import inspect
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import cycle
from math import isfinite
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np

from slviewer.devices.browser import PAGE_ROLES, PageChannels, PageRole
from slviewer.devices.drivers import DRIVER_PLUGINS, Driver, available, driver, drivers
from slviewer.devices.protocols import Rig, Turntable
from slviewer.devices.replay import Recording, recording_rig
from slviewer.devices.simulated import simulated_rig
from slviewer.devices.simulated_dlpc350 import simulated_lightcrafter_rig
from slviewer.devices.world import SimulatedWorld, Thing
from slviewer.errors import InputError, SlviewerError
from slviewer.fringe.sequence import PatternSequence
from slviewer.pipeline.import_captures import check_imported_capture, find_captures
from slviewer.pipeline.operation import ignore_warnings
from slviewer.session.capture import Capture
from slviewer.session.importers.imported import ImportableRecording
from slviewer.session.layout import is_session
from slviewer.session.reading import expand_user, read_toml
from slviewer.session.store import Session
from slviewer.session.toml import to_toml
from slviewer.simulation.assets import asset
from slviewer.simulation.rig import letter
from slviewer.target.board import Board

Choice = Mapping[str, Any]
Recorded = Capture | ImportableRecording
COMMON_KEYS = ("name", "settle_ms", "focal_px", "exposure_ms", "gain", "turntable")
"""Keys that a choice may hold for any rig: its name, the delay of its light, the nominal focal
length of its lens in camera px, what its camera is set to by default, and its turntable."""
RigLike = Mapping[str, Any] | Path | str
"""A choice of devices, a TOML file that holds one, or the name of a preset."""
FOLDER = "rigs"
_PARTS = ("camera", "second", "projector")
"""Devices of a choice; the second camera may be missing."""
_LARGEST = {"settle_ms": 60_000, "focal_px": 1e6, "exposure_ms": 600_000, "gain": 1e6}


class Reel:
    """A rig that replays recorded captures; it has only the `sequence` of the current one until it
    is wound on."""

    def __init__(self, recorded: Sequence[Recorded]) -> None:
        """Play these captures in order."""
        self.names = [each.name for each in recorded]
        self._following = cycle(recorded)
        self._recording = Recording(*_read_shot(next(self._following)))
        self.rig: Rig = recording_rig(self._recording)

    @property
    def sequence(self) -> PatternSequence:
        """The patterns of the capture that is played."""
        return self._recording.played[1]

    @property
    def has_dark(self) -> bool:
        """Whether that capture holds a dark frame."""
        return any(frame.kind == "black" for frame in self.sequence.frames)

    def advance(self) -> None:
        """Play the next capture; the first after the last. Raises InputError where it is not of the
        same rig."""
        if len(self.names) > 1:
            self._recording.play(*_read_shot(next(self._following)))


def _read_shot(recorded: Recorded) -> tuple[np.ndarray, PatternSequence]:
    """Read the frames (n, h, w) and the sequence of a recorded capture."""
    if isinstance(recorded, Capture):
        return recorded.frames, recorded.sequence
    imported = check_imported_capture(recorded.read(), ignore_warnings)
    return imported.frames, imported.sequence


def reel(
    source: Path | str,
    capture: str | None = None,
    layout: str | None = None,
    sequence: Path | str | None = None,
    projector: str | None = None,
) -> Reel:
    """Read the captures in `source`, or the one of that name, for a replayed rig.

    `layout` is session or one of `layouts.layouts()`, by default what `source` looks like;
    `sequence` is the TOML of the layout frames, `projector` its size, such as "912x1140", where it
    is not the layout's own. Raises InputError, SessionError.
    """
    folder, recorded = expand_user(source), list[Recorded]()
    if layout == "session" or (layout is None and is_session(folder)):
        with Session.open(folder) as store:
            recorded += store.captures(with_frames=True)
    else:
        layout = layout or "detect"
        recorded += find_captures(folder, layout, sequence, projector=projector).recordings
    names = [each.name for each in recorded]
    if capture is not None and capture not in names:
        raise InputError(
            f"there is no capture {capture!r} in {folder}: the captures are"
            f" {', '.join(names) or 'none'}"
        )
    if not recorded:
        raise InputError(f"{folder} holds no capture to play back", "name a folder that does")
    return Reel([each for each in recorded if capture in (None, each.name)])


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
    try:
        if "driver" in choice:
            made = _make_device("rig", _options_of_rig(choice), board=board)
        else:
            devices = {
                part: _make_device(part, choice[part], page=pages and getattr(pages, part))
                for part in ("camera", "projector")
            }
            if "second" in choice:
                devices["second"] = _make_device("camera", choice["second"])
            made = Rig(str(choice.get("name", "rig")), **devices)
        if isinstance(made, Reel):
            made = RigSetup(made.rig, reel=made)
        bench = made if isinstance(made, RigSetup) else RigSetup(made)
        table: Turntable | None = bench.rig.turntable
        if (turning := choice.get("turntable")) is not None:
            if dict(turning)["driver"] == "simulated" and bench.world is None:
                raise InputError(
                    "a simulated turntable turns only what is before the simulated rig",
                    "choose another",
                )
            table = _make_device("turntable", turning, world=bench.world)
        settle_ms = float(choice.get("settle_ms", 0.0)) or bench.rig.settle_ms
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"the rig {dict(choice)} cannot be set up ({error})", "choose it again"
        ) from error
    return replace(
        bench,
        rig=replace(bench.rig, settle_ms=settle_ms, turntable=table),
        focal_px=bench.focal_px or choice.get("focal_px"),
    )


def place_object(bench: RigSetup) -> None:
    """Let the stone stand on the turntable before a simulated rig, where a board, plate or ball
    shows nothing."""
    if bench.world is not None and bench.world.standing in ("board", "plane", "sphere"):
        bench.world.place("stone")


def require_turntable(rig: Rig) -> Turntable:
    """Return the rig's turntable. Raises InputError where it has none."""
    if rig.turntable is None:
        raise InputError(f"the rig {rig.name} has no turntable", "add [turntable] to its file")
    return rig.turntable


def _make_device(part: str, chosen: Choice, **provided: Any) -> Any:
    """Return a device (camera, projector, turntable, or a whole rig) of a driver and its options,
    with those of the ``provided`` arguments that the driver takes from the program."""
    options = dict(chosen)
    named = driver(str(options.pop("driver")))
    make = driver_factory(named, part)
    if make is None:
        raise InputError(f"the driver {named.name} offers no {part}", "choose another")
    taken = _list_provided(named) & inspect.signature(make).parameters.keys() & provided.keys()
    return make(**options, **{name: provided[name] for name in taken})


def _list_provided(named: Driver) -> set[str]:
    """Return the names of a driver's arguments that the program supplies; they are not entries of a
    file."""
    return {"board", "world", "timing"} | ({"page"} if named.page else set())


def _options_of_rig(choice: Choice) -> Choice:
    """Return the driver and its options of a choice without the keys that all rigs may have."""
    return {key: value for key, value in choice.items() if key not in COMMON_KEYS}


def list_needed_pages(choice: Choice) -> tuple[PageRole, ...]:
    """Return which of a choice's devices are pages in a browser."""
    return tuple(
        role
        for role in PAGE_ROLES
        if isinstance(part := choice.get(role), Mapping)
        and (named := drivers().get(str(part.get("driver"))))
        and named.page
    )


def driver_factory(driver: Driver, part: str) -> Callable[..., Any] | None:
    """Return the driver's function that makes the part (camera, projector, turntable or rig) from
    its options; None where it has none."""
    own = {"simulated": _simulated_setup, "replay": reel} if part == "rig" else {}
    return own.get(driver.name, getattr(driver, part))


def _simulated_setup(
    board: Board | None,
    preset: str = "letter",
    scale: float = 1.0,
    seed: int = 0,
    thing: Thing = "board",
    cameras: Literal[1, 2] = 1,
    dlpc350: bool = False,
) -> RigSetup:
    """Return the simulated rig of a preset, with a thing of `devices.world`, such as the board, in
    view, and one camera or two; ``dlpc350``: its projector is a LightCrafter 4500 that triggers the
    camera, if that is one."""
    if preset != "letter":
        raise InputError(f"no rig preset is called {preset!r}", "use letter")
    rig = letter(scale, seed)
    world = SimulatedWorld(rig, board)
    if thing != "board":
        world.place(thing)
    made = simulated_rig(world, cameras)
    if dlpc350:
        made = replace(simulated_lightcrafter_rig(world), second=made.second)
    return RigSetup(made, world, rig.camera.focal_px[0] * scale)


@dataclass(frozen=True)
class Preset:
    """A rig with a name: `what` it is in a sentence, the `choice` it stands for, its file, and
    `problem`, why it cannot be used here and how to correct that, empty if it can.
    """

    name: str
    what: str
    choice: Mapping[str, Any]
    source: Path
    problem: str = ""


def presets(session: Session | None = None) -> list[Preset]:
    """List the session's own rigs, then those that are shipped; a session's hides a shipped one of
    the same name."""
    own = {} if session is None else session.rigs()
    shipped = {
        path.stem: path for path in sorted(asset(FOLDER).glob("*.toml")) if path.stem not in own
    }
    listed = []
    for name, path in {**own, **shipped}.items():
        try:
            preset = _read_preset(name, path)
            missing = [drivers()[each].missing for each in _driver_names(preset.choice)]
            listed.append(replace(preset, problem="; ".join(filter(None, dict.fromkeys(missing)))))
        except InputError as error:
            listed.append(Preset(name, "", {}, path, str(error)))
    return listed


def rigs() -> str:
    """List the rigs that can be chosen by name, as text."""
    lines = ["rigs:"]
    for preset in presets():
        problem = f" (not here: {preset.problem})" if preset.problem else ""
        lines.append(f"  {preset.name}: {preset.what}{problem}")
    return "\n".join(lines)


def load_rig(rig: RigLike, session: Session | None = None) -> dict[str, Any]:
    """Load the checked choice in a TOML file, or of the preset of that name; a mapping is returned
    as it is.

    Raises InputError for a file or a name that does not exist, an unknown key or driver,
    DeviceError where a package is missing.
    """
    if isinstance(rig, Mapping):
        return dict(rig)
    name, path = str(rig), expand_user(rig)
    if not path.is_file():
        named = {preset.name: preset.source for preset in presets(session)}
        if path.suffix.lower() == ".toml":
            raise InputError(
                f"there is no file {path}",
                f"name a TOML file that describes a rig, or one of {', '.join(named)}",
            )
        if name not in named:
            raise InputError(
                f"no rig is called {name!r}", f"use {', '.join(named)}, or name a TOML file"
            )
        path = named[name]
    choice = _read_preset(name, path).choice
    for each in _driver_names(choice):
        driver(each)  # raises where it cannot be used
    return dict(choice)


def save_rig(session: Session, name: str, choice: Choice, what: str = "") -> Preset:
    """Save a choice in the session under a name, in place of an older one. Raises InputError for an
    invalid one."""
    check_choice(choice, f"the rig {name}")
    content = {"what": what, **choice} if what else choice
    return _read_preset(name, session.save_rig(name, to_toml(content)))


def check_choice(choice: Choice, where: str) -> None:
    """Raise InputError, which names the place `where`, unless `choice` names devices and only
    options they know."""
    for key, largest in _LARGEST.items():
        value = choice.get(key, 1)
        if (
            type(value) not in (int, float)
            or not 0 <= value <= largest
            or (not value and key != "settle_ms")
        ):
            raise InputError(
                f"{where}: {key} = {value!r} is not a number above 0, up to {largest:g}",
                "correct it",
            )
    name = choice.get("name", "")
    if not isinstance(name, str) or not name.isprintable():
        raise InputError(f"{where}: name = {name!r} is not text that can be printed", "correct it")
    if "turntable" in choice:
        _check_device(choice, "turntable", where)
    if "driver" in choice:
        given = _options_of_rig(choice)
        if set(_PARTS) & set(given):
            raise InputError(
                f"{where} names a driver of a whole rig and a camera or a projector",
                "remove one of both",
            )
        _check_options(given, "rig", where)
        return
    unknown = sorted(set(choice) - {*COMMON_KEYS, *_PARTS})
    if unknown:
        raise InputError(
            f"{where} has the unknown key {unknown[0]!r}",
            f"use {', '.join(_PARTS)}, {', '.join(COMMON_KEYS)}",
        )
    for part in ("camera", "projector"):
        _check_device(choice, part, where)
    if "second" in choice:
        _check_device(choice, "second", where)


def _check_device(choice: Choice, part: str, where: str) -> None:
    """Raise InputError unless a choice names a driver of the part (camera, projector or turntable)
    and its options."""
    device = choice.get(part)
    if not isinstance(device, Mapping) or "driver" not in device:
        rather = "" if part == "turntable" else ", or a driver of a rig"
        raise InputError(f"{where} names no {part}", f'add [{part}] with driver = "…"{rather}')
    _check_options(device, "camera" if part == "second" else part, f"{where}, {part}")


def _read_preset(name: str, path: Path) -> Preset:
    """Read and check a preset's TOML; InputError where it is invalid."""
    choice = read_toml(path)
    what = choice.pop("what", "")
    if not isinstance(what, str):
        raise InputError(f"{path}: what = {what!r} is not text", "correct it")
    check_choice(choice, str(path))
    return Preset(name, what, choice, path)


def _check_options(chosen: Choice, part: str, where: str) -> None:
    """Raise InputError unless the driver of a choice exists, offers the part, and accepts the
    options."""
    options = dict(chosen)
    name = str(options.pop("driver"))
    if name not in drivers():
        offering = sorted(d.name for d in drivers().values() if driver_factory(d, part))
        why = DRIVER_PLUGINS.explain_missing(name)
        raise InputError(
            f"{where}: no driver is called {name!r}", f"use one of {', '.join(offering)}{why}"
        )
    make = driver_factory(drivers()[name], part)
    if make is None:
        raise InputError(f"{where}: the driver {name} offers no {part}", "choose another")
    parameters = inspect.signature(make, eval_str=True).parameters
    if any(each.kind is each.VAR_KEYWORD for each in parameters.values()):
        return
    provided = _list_provided(drivers()[name])
    known = {key: each for key, each in parameters.items() if key not in provided}
    if unknown := sorted(options.keys() - known.keys()):
        use = f"use {', '.join(known)}" if known else "it takes none"
        raise InputError(f"{where}: the driver {name} has no option {unknown[0]!r}", use)
    for key, each in known.items():
        if key not in options and each.default is each.empty:
            raise InputError(f"{where}: the driver {name} needs {key}", "add it")
    for key, value in options.items():
        _check_type(f"{where}: {key} = {value!r}", value, known[key].annotation)


def _check_type(stated: str, value: Any, kind: Any) -> None:
    """Raise InputError where an option is not of the type of the driver's parameter, or no number
    that is finite."""
    if isinstance(value, float) and not isfinite(value):
        raise InputError(f"{stated} is not a number", "correct it")
    try:
        with suppress(TypeError):  # a path, which the driver checks itself
            msgspec.convert(value, Any if kind is inspect.Parameter.empty else kind)
    except msgspec.ValidationError as error:
        raise InputError(f"{stated} is of the wrong type ({error})", "correct it") from error


def _driver_names(choice: Choice) -> list[str]:
    """Return the drivers of a choice: that of the whole rig, or those of camera and projector, and
    of a turntable."""
    parts = [choice, *(choice.get(part, {}) for part in (*_PARTS, "turntable"))]
    return [str(part["driver"]) for part in parts if "driver" in part]


def devices() -> str:
    """List the drivers: which can be used here, what is connected, what each needs, and the rigs to
    choose from."""
    blocks = []
    for each in available():  # those that can be used here first
        parts = ("camera", "projector", "turntable", "rig")
        offers = ", ".join(part for part in parts if getattr(each, part) is not None)
        lines = [
            f"{each.name} ({offers}): {each.what}",
            f"  cannot be used here, {each.missing}" if each.missing else "  can be used",
        ]
        if each.needs:
            lines.append(f"  needs {each.needs}")
        if each.list_connected is not None and not each.missing:
            try:
                connected = each.list_connected() or ["no device"]
                lines += [f"  connected: {line}" for line in connected]
            except Exception as error:  # a broken library of a maker must not hide other devices
                kind = "" if isinstance(error, SlviewerError) else f" ({type(error).__name__})"
                lines.append(f"  could not look for what is connected: {error}{kind}")
        blocks.append("\n".join(lines))
    return "\n".join([*blocks, rigs()])
