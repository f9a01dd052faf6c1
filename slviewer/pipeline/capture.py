"""Captures without a browser: show the patterns, capture the frames, save them, as the wizard does;
and an object scanned all round: captured at each angle of a turntable, then merged and meshed.

Each step of a turn is saved, with its angle, before the table turns on; whatever ends a turn, the
scans before it stay, and the missing steps can be captured later."""

import shutil
from collections.abc import Callable, Sequence
from dataclasses import KW_ONLY, dataclass, replace
from functools import partial
from itertools import count
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from slviewer.devices.capture import CapturedFrames, capture_with_texture, check_exposures
from slviewer.devices.protocols import (
    Camera,
    CameraSettings,
    Rig,
    Turntable,
    list_changed_settings,
    list_notes,
    report_driver_faults,
    stated_full_scale,
)
from slviewer.errors import Cancelled, InputError, SessionError, SlviewerError, UsageError
from slviewer.fringe.presets import PresetName, find_preset
from slviewer.fringe.sequence import Axis, PatternSequence, one_axis
from slviewer.geometry.rig import StereoRig
from slviewer.inputs import EXPOSURE, GAIN, Input
from slviewer.pipeline.capture_phases import decode_frames
from slviewer.pipeline.examination import load_or_save_examination, warn_of_exposure
from slviewer.pipeline.merge import MergeSettings, merge
from slviewer.pipeline.mesh import MeshResult, mesh
from slviewer.pipeline.models import ModelName, check_accepted, load_model, load_stereo_if_complete
from slviewer.pipeline.operation import (
    Callbacks,
    Findings,
    Progress,
    Warn,
    ignore_progress,
    ignore_warnings,
    opened_or_made,
    part,
    takes_settings,
)
from slviewer.pipeline.rig_choice import (
    Choice,
    RigLike,
    RigSetup,
    SetUp,
    load_rig,
    place_object,
    require_turntable,
    set_up,
)
from slviewer.pipeline.suggest_exposure import (
    BUDGET_S,
    MAX_SUGGESTED,
    suggest_exposure,
)
from slviewer.records.merge import Merge
from slviewer.records.record import to_plain
from slviewer.registration.multiway import MOST_SCANS
from slviewer.registration.refusal import Refused
from slviewer.session.atomic import format_bytes
from slviewer.session.capture import Capture, NewCapture, Purpose, Role, TurnStep
from slviewer.session.names import new_name, safe_name
from slviewer.session.store import Session
from slviewer.surface.meshing import MeshingPlan
from slviewer.target.board import Board

DEFAULT_PATTERNS = "complementary"
"""The sequence used by default: its codes forgive blurred edges, and it is shorter than the
Letter's."""


@dataclass(frozen=True, kw_only=True)
class RigSettings(Callbacks):
    """How a rig captures.

    Args:
        patterns: Sequence to project, micro for surfaces that light themselves; by default the
            session's, else complementary.
        exposure_ms: Exposure of the camera; by default the rig's, else what the camera is set to.
        exposures_ms: Two or more exposures for shiny and dark parts; each pixel is used from the
            longest that does not clip it.
        gain: Gain of the camera, as a factor; by default the rig's, else what the camera is set to.

    ``set_up`` makes the devices of a choice of rig.
    """

    patterns: PresetName | None = None
    exposure_ms: Annotated[float | None, EXPOSURE] = None
    exposures_ms: Annotated[Sequence[float], EXPOSURE] = ()
    gain: Annotated[float | None, GAIN] = None
    set_up: SetUp = set_up

    def __post_init__(self) -> None:
        is_chosen = getattr(self, "auto_exposure", False)  # of a capture alone
        if (self.exposure_ms is not None) + bool(self.exposures_ms) + is_chosen > 1:
            raise InputError(
                "the exposure was given in several ways", "give one, several, or let it be chosen"
            )
        _ = self.exposures

    @property
    def exposures(self) -> list[float]:
        """The exposures of each frame, ms, ascending; empty for the one that the camera is set
        to."""
        return check_exposures(self.exposures_ms) if self.exposures_ms else []

    def camera_settings(self, choice: Choice) -> CameraSettings:
        """Return the requested settings, else those of the choice. Raises InputError for impossible
        ones."""
        given = {"exposure_ms": self.exposure_ms, "gain": self.gain}
        chosen = {n: choice.get(n) if value is None else value for n, value in given.items()}
        return CameraSettings(**chosen)


@dataclass(frozen=True)
class CaptureSettings(RigSettings):
    """What is captured, and how.

    Args:
        session: Session folder; made if it does not exist.
        name: Name of the capture.
        rig: A TOML file that describes the rig, or the name of one that `slviewer devices` lists.
        role: calibration for a target pose, scan for anything else.
        board: What the target is, circles:21x16:9 and the like; by default as the session knows it.
        auto_exposure: Choose one to four exposures, and the gain, that measure as much of the scene
            as possible.
        region: With --auto-exposure: x, y, width and height, px, of the part of the image that
            matters; by default all.
        budget_s: What a capture may last, s, whose exposure is chosen for it.
        force: Replace a capture of that name (the old one goes to the session's trash).

    ``warn`` is called with what the camera could not be set to, and with frames that contradict the
    others; `say` with the exposures that were chosen. Raises InputError, DeviceError, SessionError,
    and whatever `progress` raises before the capture is saved; nothing is saved then.
    """

    session: Path | str
    name: str
    rig: RigLike
    _: KW_ONLY
    role: Role = "calibration"
    board: str | None = None
    auto_exposure: bool = False
    region: tuple[int, int, int, int] | None = None
    budget_s: Annotated[float, Input(0, 3600, "s", "Time limit", 0.5)] = BUDGET_S
    force: bool = False
    say: Callable[[str], None] = ignore_warnings


@takes_settings(CaptureSettings)
def capture(settings: CaptureSettings) -> Capture:
    """Capture with a rig, without the wizard."""
    name, progress, warn = settings.name, settings.progress, settings.warn
    new_name(name)
    with opened_or_made(settings.session) as store:
        if name in store.taken_names() and not settings.force:
            raise InputError(
                f"there is a capture {name!r} already",
                "choose another name, or replace it with --force",
            )
        choice = load_rig(settings.rig, store)
        notation = settings.board or store.decision("target")
        target = Board.parse(notation) if notation else None
        bench, sequence = set_up_rig(store, choice, target, settings)
        exposures = settings.exposures
        most = sequence.count_images(range(MAX_SUGGESTED) if settings.auto_exposure else exposures)
        check_space(store, bench.rig.cameras, most, name)
        begin = 0.3 if settings.auto_exposure else 0.0
        with bench.rig.opened() as devices:
            set_camera(devices, choice, settings)
            if settings.auto_exposure:
                suggested = suggest_exposure(
                    devices, sequence, budget_s=settings.budget_s, region=settings.region,
                    progress=part(progress, 0.0, begin),
                )  # fmt: skip
                settings.say(suggested.text())
                exposures = list(suggested.exposures_ms)
                devices.camera.apply(CameraSettings(exposures[0], suggested.gain))
                exposures = exposures if len(exposures) > 1 else []
            capturing = part(progress, begin, 0.95, name)
            captured = capture_sequence(devices, sequence, exposures, capturing)
        progress(0.95, "saving")
        is_pose = settings.role == "calibration"
        purpose: Purpose = "pose" if is_pose else "scan"
        board = target if is_pose else None
        saved = save_frames(store, name, purpose, captured, board=board, force=settings.force)
        for wanted_ms, applied_ms in zip(exposures, captured.exposures_ms, strict=True):
            for note in list_changed_settings(
                devices.camera, CameraSettings(wanted_ms), CameraSettings(applied_ms)
            ):
                warn(note)
        try:
            for message in load_or_save_examination(store, saved).warnings():
                warn(f"{name}: {message}")
        except SlviewerError as error:  # it is saved, and can be looked at later
            warn(f"{name} is saved, and its frames could not be checked: {error}")
        warn_of_captured(name, captured, warn)
    progress(1.0, "captured")
    return saved


def capture_sequence(
    rig: Rig, sequence: PatternSequence, exposures_ms: Sequence[float], progress: Progress
) -> CapturedFrames:
    """Capture as `capture_with_texture`, and report each frame."""
    return capture_with_texture(
        rig, sequence, exposures_ms,
        progress=lambda done, n: progress(done / n, f"frame {done} of {n}"),
    )  # fmt: skip


def set_up_rig(
    store: Session, choice: Choice, target: Board | None, settings: RigSettings
) -> tuple[RigSetup, PatternSequence]:
    """Return the devices of a choice, not opened yet, and the sequence that they capture. What the
    settings or the choice state wrongly is refused before."""
    settings.camera_settings(choice)
    patterns = settings.patterns or str(store.decision("patterns") or DEFAULT_PATTERNS)
    if choice.get("driver") != "replay":
        find_preset(patterns)
    settings.progress(0.0, "opening the devices")
    bench = settings.set_up(choice, target)
    return bench, choose_sequence(bench, patterns)


def warn_of_captured(name: str, captured: CapturedFrames | Capture, warn: Warn) -> None:
    """Warn where captured frames are too bright or too dark; of several exposures each is meant to
    be so somewhere."""
    if captured.exposures_ms:
        return
    frames = captured.frames
    try:
        phases = decode_frames(name, captured.sequence, frames)
    except SlviewerError as error:
        warn(f"{name} is saved, and its exposure could not be checked: {error}")
    else:
        warn_of_exposure(name, captured.sequence, frames, phases, warn)


def set_camera(rig: Rig, choice: Choice, settings: RigSettings) -> None:
    """Set the open rig's cameras to the requested values, else to those of its choice; warns of
    those refused or changed."""
    wanted = applied = settings.camera_settings(choice)
    for camera in rig.cameras:
        with report_driver_faults(camera):
            if wanted != CameraSettings():
                applied = camera.apply(wanted)
            notes = (*list_notes(camera), *list_changed_settings(camera, wanted, applied))
        for note in notes:
            settings.warn(note)


def choose_sequence(bench: RigSetup, patterns: str) -> PatternSequence:
    """Return the sequence to capture: the one of that name for the rig's devices, or the rig's only
    one."""
    if bench.reel is not None:
        return bench.reel.sequence
    shown = find_preset(patterns)(bench.rig.projector.size)
    return replace(shown, full_scale=stated_full_scale(bench.rig.camera))


def depth_axis(rig: StereoRig) -> Axis:
    """Return the axis along which the projector's coordinate changes more with depth."""
    shift = np.abs(np.diag(rig.projector.K)[:2] * rig.t[:2])
    return "x" if shift[0] >= shift[1] else "y"


def save_frames(
    store: Session,
    name: str,
    purpose: Purpose,
    captured: CapturedFrames,
    *,
    board: object | None = None,
    turn_step: TurnStep | None = None,
    force: bool = False,
) -> Capture:
    """Save captured frames with their sequence, settings and texture; returns the stored
    capture."""
    turned = {} if turn_step is None else {"turntable": to_plain(turn_step)}
    lens = {"lens": captured.lens} if captured.lens else {}
    second = None
    if captured.second is not None:
        second = NewCapture(
            name, captured.sequence, captured.second, source=captured.source,
            exposures_ms=captured.exposures_ms,
        )  # fmt: skip
    exposure = {} if captured.exposures_ms else {"exposure_ms": captured.settings.exposure_ms}
    return store.save_capture(
        name, "calibration" if purpose == "pose" else "scan", captured.sequence, captured.frames,
        source=captured.source, texture=captured.texture,
        settings={"purpose": purpose, **exposure, "gain": captured.settings.gain, **lens, **turned},
        board=board, exposures_ms=captured.exposures_ms, second=second, force=force,
    )  # fmt: skip


@dataclass(frozen=True)
class Space:
    """Free space on a session's disk, and what the frames to be captured need, where known."""

    free_bytes: int
    capture_bytes: int | None

    @property
    def enough(self) -> bool:
        """Whether twice the frames fit: what is computed takes about as much again."""
        return self.capture_bytes is None or self.free_bytes > 2 * self.capture_bytes


def measure_space(store: Session, cameras: Sequence[Camera], frames: int | None) -> Space:
    """Return the free space on the session's disk, and what so many frames of each camera need."""
    needed = None
    if cameras and frames is not None:
        needed = sum(frames * c.size[0] * c.size[1] * c.dtype.itemsize for c in cameras)
    return Space(shutil.disk_usage(store.folder).free, needed)


def check_space(store: Session, cameras: Sequence[Camera], frames: int, name: str) -> None:
    """Raise SessionError before anything is captured for which the disk has no room."""
    space = measure_space(store, cameras, frames)
    if not space.enough:
        raise SessionError(
            f"{name} needs {format_bytes(space.capture_bytes or 0)}, and as much again for its"
            f" results, and {format_bytes(space.free_bytes)} are free on {store.folder}",
            "free some space first",
        )


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
        made = [each.text() for each in (self.merged, self.meshed) if each is not None]
        return "\n".join([f"{len(names)} scans all round: {names[0]} to {names[-1]}", *made])


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
    steps: Annotated[int, Input(2, MOST_SCANS)] = STEPS
    range_deg: Annotated[float, Input(-360, 360, "°", "Range", 5.0)] = FULL_TURN_DEG
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
                "a mesh is made of the merged scans", "give --mesh or --no-merge, not both"
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
            raise InputError("a recording cannot be turned", "choose a rig with a turntable")
        bench, sequence = set_up_rig(store, choice, None, settings)
        require_turntable(bench.rig)
        place_object(bench)
        if (stereo := load_stereo_if_complete(store)) is not None:
            sequence = one_axis(sequence, depth_axis(stereo.rig))  # half of the frames
        frames = sequence.count_images(exposures) * len(todo)
        check_space(store, bench.rig.cameras, frames, "the turn")
        with bench.rig.opened() as devices:
            set_camera(devices, choice, settings)

            def capture_step(step: TurnStep, progress: Progress) -> None:
                """Capture and save one step."""
                captured = capture_sequence(devices, sequence, exposures, progress)
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
            f"there is a capture {min(taken)!r} already", "choose another name, or resume the turn"
        )
    return steps


def plan_turn(name: str, steps: int = STEPS, range_deg: float = FULL_TURN_DEG) -> list[TurnStep]:
    """Return the steps of a turn: of a full one (360 degrees either way) equal ones, else from end
    to end of the range.

    Raises InputError for a number of steps or a range that cannot be scanned and merged.
    """
    if not 2 <= steps <= MOST_SCANS:
        raise InputError(f"{steps} steps make no turn", f"choose 2 to {MOST_SCANS}")
    if not 0 < abs(range_deg) <= FULL_TURN_DEG:
        raise InputError(
            f"a turn of {range_deg:g} degrees is impossible",
            "choose up to 360, negative the other way",
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
        raise InputError(f"there is no turn {name or 'yet'} to resume", "begin a new one")
    first, taken = recorded[0], set(store.taken_names())
    steps = [replace(first, step=k) for k in range(1, first.steps + 1)]
    if missing := [step for step in steps if step.name not in taken]:
        return missing
    raise InputError(
        f"all {first.steps} steps of {name} are captured", "delete a scan to capture it again"
    )


def capture_turn(
    rig: Rig,
    steps: Sequence[TurnStep],
    capture_step: Callable[[TurnStep, Progress], None],
    recorded: Sequence[TurnStep],
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
