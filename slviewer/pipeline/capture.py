"""Captures without a browser: show the patterns, capture the frames, save them, as the wizard
does."""

import shutil
from collections.abc import Callable, Sequence
from dataclasses import KW_ONLY, dataclass, replace
from pathlib import Path

import numpy as np

from slviewer.devices.capture import CapturedFrames, capture_with_texture, check_exposures
from slviewer.devices.protocols import (
    Camera,
    CameraSettings,
    Rig,
    list_changed_settings,
    list_notes,
    report_driver_faults,
    stated_full_scale,
)
from slviewer.errors import InputError, SessionError, SlviewerError
from slviewer.fringe.presets import PRESETS
from slviewer.fringe.sequence import Axis, PatternSequence
from slviewer.geometry.rig import StereoRig
from slviewer.pipeline.capture_phases import decode_frames
from slviewer.pipeline.examination import load_or_save_examination, warn_of_exposure
from slviewer.pipeline.operation import (
    Callbacks,
    Warn,
    ignore_warnings,
    opened_or_made,
    part,
    takes_settings,
)
from slviewer.pipeline.rig_choice import Choice, RigLike, RigSetup, SetUp, load_rig, set_up
from slviewer.pipeline.suggest_exposure import (
    BUDGET_S,
    MAX_SUGGESTED,
    apply_suggestion,
    suggest_exposure,
)
from slviewer.records.record import to_plain
from slviewer.session.atomic import format_bytes
from slviewer.session.capture import Capture, NewCapture, Purpose, Role, TurnStep
from slviewer.session.names import new_name
from slviewer.session.store import Session
from slviewer.target.board import Board

DEFAULT_PATTERNS = "complementary"
"""The sequence used by default: its codes forgive blurred edges, and it is shorter than the
Letter's."""


@dataclass(frozen=True, kw_only=True)
class RigSettings(Callbacks):
    """How a rig captures.

    Args:
        patterns: p18, complementary, gray, multifrequency or micro (for surfaces that light
            themselves); by default the session's, else complementary.
        exposure_ms: Exposure of the camera; by default the rig's, else what the camera is set to.
        exposures_ms: Two or more exposures for shiny and dark parts; each pixel is used from the
            longest that does not clip it.
        gain: Gain of the camera, as a factor; by default the rig's, else what the camera is set to.

    ``set_up`` makes the devices of a choice of rig.
    """

    patterns: str | None = None
    exposure_ms: float | None = None
    exposures_ms: Sequence[float] = ()
    gain: float | None = None
    set_up: SetUp = set_up

    def __post_init__(self) -> None:
        is_chosen = getattr(self, "auto_exposure", False)  # of a capture alone
        if (self.exposure_ms is not None) + bool(self.exposures_ms) + is_chosen > 1:
            raise InputError(
                "the exposure was given in several ways: give one, several, or let it be chosen"
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
        budget_s: With --auto-exposure: what the capture may last, s.
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
    budget_s: float = BUDGET_S
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
                f"there is a capture {name!r} already: choose another name, or replace it with"
                " --force"
            )
        choice = load_rig(settings.rig, store)
        notation = settings.board or store.decision("target")
        target = Board.parse(notation) if notation else None
        bench, sequence = set_up_rig(store, choice, target, settings)
        exposures = settings.exposures
        most = MAX_SUGGESTED if settings.auto_exposure else max(1, len(exposures))
        check_space(store, bench.rig.cameras, len(sequence.frames) * most, name)
        begin = 0.3 if settings.auto_exposure else 0.0
        with bench.rig.opened() as devices:
            set_camera(devices, choice, settings)
            if settings.auto_exposure:
                suggested = suggest_exposure(
                    devices,
                    sequence,
                    budget_s=settings.budget_s,
                    region=settings.region,
                    progress=part(progress, 0.0, begin),
                )
                settings.say(suggested.text())
                exposures = apply_suggestion(devices, suggested)
            captured = capture_with_texture(
                devices,
                sequence,
                exposures,
                progress=lambda done, n: progress(
                    begin + (0.95 - begin) * done / n, f"{name}: frame {done} of {n}"
                ),
            )
        for wanted_ms, applied_ms in zip(exposures, captured.exposures_ms, strict=True):
            for note in list_changed_settings(
                devices.camera, CameraSettings(wanted_ms), CameraSettings(applied_ms)
            ):
                warn(note)
        progress(0.95, "saving")
        is_pose = settings.role == "calibration"
        saved = save_frames(
            store,
            name,
            "pose" if is_pose else "scan",
            captured,
            board=target if is_pose else None,
            force=settings.force,
        )
        try:
            for message in load_or_save_examination(store, saved).warnings():
                warn(f"{name}: {message}")
        except SlviewerError as error:  # it is saved, and can be looked at later
            warn(f"{name} is saved, and its frames could not be checked: {error}")
        warn_of_captured(name, captured, warn)
    progress(1.0, "captured")
    return saved


def set_up_rig(
    store: Session, choice: Choice, target: Board | None, settings: RigSettings
) -> tuple[RigSetup, PatternSequence]:
    """Return the devices of a choice, not opened yet, and the sequence that they capture. What the
    settings or the choice state wrongly is refused before."""
    settings.camera_settings(choice)
    patterns = settings.patterns or str(store.decision("patterns") or DEFAULT_PATTERNS)
    if choice.get("driver") != "replay":
        _check_patterns(patterns)
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


def _check_patterns(patterns: str) -> None:
    """Raise InputError unless a pattern sequence has this name."""
    if patterns not in PRESETS:
        raise InputError(f"no pattern sequence is called {patterns!r}: use {', '.join(PRESETS)}")


def choose_sequence(bench: RigSetup, patterns: str) -> PatternSequence:
    """Return the sequence to capture: the one of that name for the rig's devices, or the rig's only
    one."""
    if bench.reel is not None:
        return bench.reel.sequence
    _check_patterns(patterns)
    shown = PRESETS[patterns](bench.rig.projector.size)
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
        name,
        "calibration" if purpose == "pose" else "scan",
        captured.sequence,
        captured.frames,
        source=captured.source,
        texture=captured.texture,
        settings={"purpose": purpose, **exposure, "gain": captured.settings.gain, **lens, **turned},
        board=board,
        exposures_ms=captured.exposures_ms,
        second=second,
        force=force,
    )


@dataclass(frozen=True)
class Space:
    """Free space on a session's disk, and what the frames to be captured need; None where that is
    unknown."""

    free_bytes: int
    capture_bytes: int | None

    @property
    def enough(self) -> bool:
        """Whether twice the frames fit: what is computed from a capture takes about as much
        again."""
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
            f" results, and {format_bytes(space.free_bytes)} are free on {store.folder}: free some"
            " space first"
        )
