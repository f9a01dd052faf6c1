"""Scanning an object all round: capture at each angle of a turntable, then merge and mesh.

Each capture is saved, with its angle, before the table turns on; whatever ends a turn, the scans
before it stay, and the missing steps can be captured later.
"""

from collections.abc import Callable, Sequence
from dataclasses import KW_ONLY, dataclass, replace
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any

from slviewer.devices.capture import capture_with_texture
from slviewer.devices.protocols import Rig, Turntable
from slviewer.errors import Cancelled, InputError, SlviewerError, UsageError
from slviewer.fringe.sequence import one_axis
from slviewer.pipeline.capture import (
    RigSettings,
    check_space,
    depth_axis,
    save_frames,
    set_camera,
    set_up_rig,
    warn_of_captured,
)
from slviewer.pipeline.merge import MergeSettings, merge
from slviewer.pipeline.mesh import MeshResult, mesh
from slviewer.pipeline.models import ModelName, check_accepted, load_model, load_stereo_if_complete
from slviewer.pipeline.operation import (
    Findings,
    Progress,
    Warn,
    ignore_progress,
    ignore_warnings,
    opened_or_made,
    part,
    takes_settings,
)
from slviewer.pipeline.rig_choice import RigLike, RigSetup, load_rig
from slviewer.records.merge import Merge
from slviewer.registration.multiway import MOST_SCANS
from slviewer.registration.refusal import Refused
from slviewer.session.capture import Capture, TurnStep
from slviewer.session.names import safe_name
from slviewer.session.store import Session
from slviewer.surface.meshing import MeshingPlan

STEPS = 12
"""Of a full turn: neighbours then overlap by far more than registering needs."""
FULL_TURN_DEG = 360.0
WATERTIGHT = MeshingPlan(watertight=True)
"""What stood on a table has a foot that no scan shows; it is closed flat."""
_COUNT_LOST_DEG = 0.5


@dataclass(frozen=True, eq=False)
class Turn:
    """The captures of a turn, in the order of their angles, and what was made of them, None where
    nothing was."""

    captures: tuple[Capture, ...]
    merged: Findings[Merge] | None = None
    meshed: MeshResult | None = None

    def to_json(self) -> dict[str, Any]:
        """The contract of ``turn --json``."""
        steps = {capture.name: capture.turn_step for capture in self.captures}
        return {
            "captures": {name: step.deg for name, step in steps.items() if step is not None},
            "merge": None if self.merged is None else self.merged.to_json(),
            "mesh": None if self.meshed is None else self.meshed.to_json(),
        }

    def text(self) -> str:
        """Return the result as a report for the terminal."""
        names = [capture.name for capture in self.captures]
        lines = [f"{len(names)} scans all round: {names[0]} to {names[-1]}"]
        return "\n".join(
            lines + [made.text() for made in (self.merged, self.meshed) if made is not None]
        )


@dataclass(frozen=True)
class TurnSettings(RigSettings):
    """What is scanned all round, and what is made of the scans.

    Args:
        session: Session folder.
        rig: A TOML file that describes the rig with its turntable, or the name of one that
            `slviewer devices` lists.
        steps: How many scans.
        range_deg: Degrees from the first scan to the last; 360 is a full turn, whose last scan is
            one step before it. Negative to turn the other way.
        name: Name of the turn; its captures are NAME_01, NAME_02 and so on. By default turn1, turn2
            ...
        resume: Capture what is missing of the turn of that name, by default of the last one.
        merge: Whether to merge the scans and mesh the merge; --no-merge captures only.
        mesh: File of the mesh, .ply, .stl, .obj or .glb; by default a .ply in the session's
            exports.
        model: Which calibration to use; by default the best one available.
        accept_rejected: Use the calibration although its verdict rejects it.

    Raises InputError, DeviceError, SessionError, and whatever `progress` raises; what was captured
    stays.
    """

    session: Path | str
    rig: RigLike
    _: KW_ONLY
    steps: int = STEPS
    range_deg: float = FULL_TURN_DEG
    name: str | None = None
    resume: bool = False
    merge: bool = True
    mesh: Path | str | None = None
    model: ModelName | None = None
    accept_rejected: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.mesh is not None and not self.merge:
            raise UsageError(
                "a mesh is made of the merged scans: give --mesh or --no-merge, not both"
            )


@takes_settings(TurnSettings)
def turn(settings: TurnSettings) -> Turn:
    """Scan an object all round on the rig's turntable, merge the scans, and close them to a
    watertight mesh.

    Each scan is saved before the table turns on; a turn that was cancelled or failed can be
    resumed.
    """
    progress, warn, exposures = settings.progress, settings.warn, settings.exposures
    model, accepts = settings.model, settings.accept_rejected
    with opened_or_made(settings.session) as store:
        if settings.merge:  # refused before anything turns
            check_accepted(store, accepts)
            load_model(store, model)
        todo = _list_steps(store, settings)
        turn_name = todo[0].turn
        choice = load_rig(settings.rig, store)
        if choice.get("driver") == "replay":
            raise InputError("a recording cannot be turned: choose a rig with a turntable")
        bench, sequence = set_up_rig(store, choice, None, settings)
        require_turntable(bench.rig)
        place_object(bench)
        if (stereo := load_stereo_if_complete(store)) is not None:
            sequence = one_axis(sequence, depth_axis(stereo.rig))  # half of the frames
        frames = len(sequence.frames) * max(1, len(exposures)) * len(todo)
        check_space(store, bench.rig.cameras, frames, "the turn")
        with bench.rig.opened() as devices:
            set_camera(devices, choice, settings)

            def capture_step(step: TurnStep, progress: Progress) -> None:
                """Capture and save one step."""

                def report(done: int, n: int) -> None:
                    """Report the frames that are captured."""
                    progress(done / n, f"frame {done} of {n}")

                captured = capture_with_texture(devices, sequence, exposures, progress=report)
                save_frames(store, step.name, "scan", captured, turn_step=step)
                warn_of_captured(step.name, captured, warn)

            before, turning = recorded_steps(store, turn_name), part(progress, 0, 0.5)
            capture_turn(devices, todo, capture_step, before, turning, warn)
        names = [step.name for step in recorded_steps(store, turn_name)]
        captures = tuple(map(store.load_capture, names))
        if not settings.merge:
            progress(1.0, "captured")
            return Turn(captures)
        merging = MergeSettings(names, names[0], model=model, accept_rejected=accepts)
        merged = merge_turn(store, merging, part(progress, 0.5, 0.8), warn)
        out = settings.mesh or store.exports / f"{turn_name}_mesh.ply"
        meshed = mesh(
            store, [f"merge/{next(iter(merged))}"], out, plan=WATERTIGHT, model=model,
            accept_rejected=accepts, progress=part(progress, 0.8, 1.0), warn=warn,
        )  # fmt: skip
    return Turn(captures, merged, meshed)


def _list_steps(store: Session, settings: TurnSettings) -> list[TurnStep]:
    """Return the steps to capture. Raises InputError where a capture has the name of one."""
    if settings.resume:
        steps = missing_steps(store, settings.name)
    else:
        steps = plan_turn(settings.name or next_turn(store), settings.steps, settings.range_deg)
    if taken := set(store.taken_names()).intersection(step.name for step in steps):
        raise InputError(
            f"there is a capture {min(taken)!r} already: choose another name, or resume the turn"
        )
    return steps


def plan_turn(name: str, steps: int = STEPS, range_deg: float = FULL_TURN_DEG) -> list[TurnStep]:
    """Return the steps of a turn: of a full one (360 degrees either way) equal ones, else from end
    to end of the range.

    Raises InputError for a number of steps or a range that cannot be scanned and merged.
    """
    if not 2 <= steps <= MOST_SCANS:
        raise InputError(f"{steps} steps make no turn: choose 2 to {MOST_SCANS}")
    if not 0 < abs(range_deg) <= FULL_TURN_DEG:
        raise InputError(
            f"a turn of {range_deg:g} degrees is impossible: choose up to 360, negative the"
            " other way"
        )
    safe_name(f"{name}_{steps:02d}")
    step_deg = range_deg / (steps if abs(range_deg) == FULL_TURN_DEG else steps - 1)
    return [TurnStep(name, k, steps, step_deg) for k in range(1, steps + 1)]


def next_turn(store: Session) -> str:
    """Return the next unused name of a turn: turn1, turn2 and so on."""
    taken = {name.rpartition("_")[0] for name in store.taken_names()}
    return next(name for number in count(1) if (name := f"turn{number}") not in taken)


def recorded_steps(store: Session, name: str) -> list[TurnStep]:
    """List the captured steps of a turn, in their order."""
    steps = (capture.turn_step for capture in store.captures("scan"))
    turned = (step for step in steps if step is not None and step.turn == name)
    return sorted(turned, key=lambda step: step.step)


def missing_steps(store: Session, name: str | None = None) -> list[TurnStep]:
    """Return the steps of a turn, by default of the last one, that are not captured. Raises
    InputError if none is."""
    if name is None:
        captures = sorted(store.captures("scan"), key=lambda each: str(each.meta.get("created")))
        turns = [step.turn for each in captures if (step := each.turn_step) is not None]
        name = turns[-1] if turns else ""
    recorded = recorded_steps(store, name)
    if not recorded:
        raise InputError(f"there is no turn {name or 'yet'} to resume: begin a new one")
    first, taken = recorded[0], set(store.taken_names())
    steps = [replace(first, step=k) for k in range(1, first.steps + 1)]
    if missing := [step for step in steps if step.name not in taken]:
        return missing
    raise InputError(
        f"all {first.steps} steps of {name} are captured: delete a scan to capture it again"
    )


def place_object(bench: RigSetup) -> None:
    """Let the stone stand on the turntable before a simulated rig, where a board, plate or ball
    shows nothing."""
    if bench.world is not None and bench.world.standing in ("board", "plane", "sphere"):
        bench.world.place("stone")


def require_turntable(rig: Rig) -> Turntable:
    """Return the rig's turntable. Raises InputError where it has none."""
    if rig.turntable is None:
        raise InputError(f"the rig {rig.name} has no turntable: add [turntable] to its file")
    return rig.turntable


def capture_turn(
    rig: Rig,
    steps: Sequence[TurnStep],
    capture_step: Callable[[TurnStep, Progress], None],
    recorded: Sequence[TurnStep] = (),
    progress: Progress = ignore_progress,
    warn: Warn = ignore_warnings,
) -> None:
    """Turn to each step with the open rig, and capture there: `capture_step(step, progress)` saves
    what it captures.

    ``recorded``: the steps of the same turn that were captured before. The turntable is opened for
    the turn alone. `progress` may raise Cancelled at any time, which stops the table. Other errors
    name the step, and how to go on.
    """
    table = require_turntable(rig)
    table.open()
    try:
        origin_deg = _origin(table, recorded, warn)
        for k, step in enumerate(steps):
            label = f"step {step.step} of {step.steps}"
            report = part(progress, k / len(steps), (k + 1) / len(steps), label)
            check = partial(report, 0.0, f"turning to {step.deg:g} degrees")
            try:
                check()
                table.turn_to(origin_deg + step.deg, check)
                capture_step(replace(step, position_deg=table.position_deg()), report)
            except Cancelled:
                raise
            except SlviewerError as error:
                saved = len(recorded) + k
                raise type(error)(
                    f"{label}, at {step.deg:g} degrees: {error}. {saved}"
                    f" scan{'s are' if saved != 1 else ' is'} saved: correct the cause, then resume"
                    " the turn"
                ) from error
    finally:
        table.close()


def merge_turn(
    store: Session, settings: MergeSettings, progress: Progress, warn: Warn
) -> Findings[Merge]:
    """Merge the scans of a turn by the angles of its turntable; by features where the angles do not
    fit the scans.

    They do not where the motor lost steps, the object slipped, or the table was moved while it was
    switched off.
    """
    try:
        return merge.run(store, replace(settings, start="turntable"), progress, warn)
    except (Refused, InputError) as error:
        warn(
            "the angles of the turntable do not align the scans, they are aligned by features"
            f" instead: {error}"
        )
    return merge.run(store, replace(settings, start="features"), progress, warn)


def _origin(table: Turntable, recorded: Sequence[TurnStep], warn: Warn) -> float:
    """Return what the open table counts at the first step of a turn, deg, so that a resumed turn
    goes on with it."""
    now_deg = table.position_deg()
    if not recorded:
        return now_deg
    last = recorded[-1]
    lost = not table.is_absolute and abs(now_deg) < _COUNT_LOST_DEG < abs(last.position_deg)
    if lost:
        warn(
            f"{table.name} was switched off and counts from 0 again: it is taken to stand where"
            f" {last.name} was captured; merging checks this against the scans"
        )
    return (now_deg if lost else last.position_deg) - last.deg
