"""Captures as the wizard takes them: what is projected, under which name it is saved, and what follows."""

from collections.abc import Callable
from dataclasses import replace
from typing import Literal

import numpy as np

from slviewer.devices.capture import Taken
from slviewer.errors import DeviceError, InputError, SessionError
from slviewer.fringe.sequence import Axis, PatternSequence, one_axis
from slviewer.pipeline.capture import keep, sequence_for
from slviewer.session.atomic import megabytes
from slviewer.wizard.acquisition import CaptureRequest
from slviewer.wizard.engine import Engine
from slviewer.wizard.snapshot import CalibrationView

Purpose = Literal["scan", "plane", "sphere"]


def sequence_for_poses(engine: Engine) -> PatternSequence:
    """Both axes of the session's pattern sequence, for the projector of the rig, or what a recording answers to."""
    if engine.bench is None:
        raise DeviceError("no rig is chosen: choose one in the step Rig")
    sequence = sequence_for(engine.bench, engine.reader.patterns())
    levels = engine.reader.levels()
    return sequence if levels is None else replace(sequence, levels=levels)


def take_pose(engine: Engine, name: str | None = None) -> None:
    """Capture the target; `name`: in place of this pose, which goes to the trash once the new one is saved."""
    store = engine.store
    target = engine.reader.target()
    if not target:
        raise InputError("choose the target first: a pose is judged by it")
    retake = name is not None
    if name is not None and store.load_capture(name).role != "calibration":
        raise InputError(f"{name} is no target pose: capture another scan instead")
    sequence, name = sequence_for_poses(engine), name or next_name(engine, "pose")
    source = engine.acquisition.view().name

    def save(taken: Taken) -> None:
        keep(store, name, "calibration", sequence, taken, source=source, purpose="pose", board=target, force=retake)
        if retake and name in store.excluded():
            store.include(name)

    _take(engine, name, sequence, save, lambda: None)


def take_scan(engine: Engine, purpose: Purpose, label: str, follow: Callable[[str], object]) -> None:
    """Capture anything but the target, and `follow(name)` once it is saved."""
    store = engine.store
    view = engine.publisher.now().session
    if view is None or view.calibration is None:
        raise InputError("calibrate first: without a calibration a capture cannot be measured")
    sequence = sequence_for_poses(engine)
    if engine.bench is not None and engine.bench.reel is None:
        sequence = one_axis(sequence, depth_axis(view.calibration))  # half of the frames
    name = next_name(engine, purpose)
    source = engine.acquisition.view().name

    def save(taken: Taken) -> None:
        keep(store, name, "scan", sequence, taken, source=source, purpose=purpose)
        if label.strip():
            store.decide("names", {**(store.decision("names") or {}), name: label.strip()})

    _take(engine, name, sequence, save, lambda: follow(name))


def _take(
    engine: Engine,
    name: str,
    sequence: PatternSequence,
    save: Callable[[Taken], None],
    follow: Callable[[], object],
) -> None:
    exposures = engine.reader.exposures_ms()
    check_space(engine, name, len(sequence.frames) * max(1, len(exposures)))
    bench = engine.bench

    def saved() -> None:
        engine.queue_unfinished()
        follow()
        engine.publisher.changed(session=True)
        if bench is not None and bench.reel is not None:
            if engine.acquisition.view().light in ("dark", "pattern"):  # which the next one may not hold
                engine.acquisition.shine("white")
            bench.reel.wind_on()

    engine.acquisition.capture(CaptureRequest(name, sequence, save, saved, exposures))


def depth_axis(calibration: CalibrationView) -> Axis:
    """The axis along which the projector's picture moves more with depth."""
    shift = np.abs(np.diag(calibration.K_projector)[:2] * calibration.t[:2])
    return "x" if shift[0] >= shift[1] else "y"


def check_space(engine: Engine, name: str, frames: int) -> None:
    """Raise SessionError where so many frames would fill the disk."""
    space = engine.space(frames)
    if space is not None and not space.enough:
        raise SessionError(
            f"{name} needs {megabytes(space.capture_bytes or 0)} and {megabytes(space.free_bytes)} are free on "
            f"{engine.store.folder}: free some space first"
        )


def next_name(engine: Engine, kind: str) -> str:
    """A name that no capture has, nor one that is still on its way."""
    taken = [*engine.store.capture_names(), *engine.acquisition.names()]
    numbers = [name.removeprefix(f"{kind}_") for name in taken if name.startswith(f"{kind}_")]
    number = max((int(number) for number in numbers if number.isdecimal()), default=0) + 1
    return f"{kind}_{number:02d}"
