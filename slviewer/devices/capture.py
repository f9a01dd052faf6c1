"""One capture: every frame of a pattern sequence shown and grabbed, in one exposure or in several."""

import contextlib
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from slviewer.devices.protocols import CameraSettings, ColourCamera, Rig
from slviewer.errors import DeviceError, InputError
from slviewer.fringe.sequence import PatternSequence

MOST_EXPOSURES = 8
"""More would take longer than anything stands still for."""


def capture(
    rig: Rig,
    sequence: PatternSequence,
    out: np.ndarray | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> np.ndarray:
    """The frames (n, h, w) of `sequence` as the open rig's camera sees them, in `out` if it is given.

    `progress(done, n)` is called before the first frame and after each, and may raise (Cancelled) to stop. Raises
    DeviceError, with the frame at which it happened; whatever is raised, `out` then holds no capture and the rig can be
    used again once its device answers. The projector is left showing the last frame.
    """
    rig.projector.load(sequence)
    out = _allocate(rig, len(sequence.frames), out)
    _shoot(rig, len(sequence.frames), out, progress)
    return out


def _allocate(rig: Rig, n: int, out: np.ndarray | None) -> np.ndarray:
    """`out`, if `n` frames of the rig's camera fit it, or a new array for them. Raises InputError."""
    width, height = rig.camera.size
    if out is None:
        return np.empty((n, height, width), rig.camera.dtype)
    if out.shape != (n, height, width) or out.dtype != rig.camera.dtype:
        raise InputError(
            f"the {n} frames of {rig.camera.name} need {(n, height, width)} {rig.camera.dtype}, "
            f"got {out.shape} {out.dtype}: make the array by the camera's size"
        )
    return out


def _shoot(rig: Rig, n: int, out: np.ndarray, progress: Callable[[int, int], None] | None) -> None:
    """Show and grab the `n` frames that are loaded."""
    if progress is not None:
        progress(0, n)
    for k in range(n):
        try:
            rig.projector.show(k)
            settle(rig)
            rig.camera.grab(out[k])
            if k == n - 1:
                rig.projector.show(k)  # one that changed during this exposure says so only when it is asked again
        except DeviceError as error:
            raise DeviceError(f"the capture ended at frame {k + 1} of {n}, nothing is kept of it: {error}") from error
        if progress is not None:
            progress(k + 1, n)


@dataclass(frozen=True, eq=False)
class CapturedFrames:
    """What `take` brings home: frames (n, h, w), or (k n, h, w) of k `exposures_ms`, the whole sequence in one after
    the other; what else the camera was set to; and a colour texture (h, w, 3), None of a camera that sees none.
    """

    frames: np.ndarray
    settings: CameraSettings
    exposures_ms: tuple[float, ...] = ()
    texture: np.ndarray | None = None


def take(
    rig: Rig,
    sequence: PatternSequence,
    exposures_ms: Sequence[float] = (),
    out: np.ndarray | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> CapturedFrames:
    """Capture `sequence`, in each of two or more `exposures_ms` if they are given, and the colours after it.

    `out` is (k n, h, w) where it is given, and `progress(done, k n)` as in `capture`. The camera's settings are as
    before when this returns or raises. Raises InputError for exposures that are none, DeviceError for a camera that
    cannot be set to them, and whatever `capture` raises.
    """
    if not exposures_ms:
        frames = capture(rig, sequence, out, progress)
        return CapturedFrames(frames, rig.camera.settings(), (), _colours(rig))
    wanted = check_exposures(exposures_ms)
    n = len(sequence.frames)
    out = _allocate(rig, n * len(wanted), out)
    rig.projector.load(sequence)  # once: a projector that is lost between two exposures must not be taken for the same
    before, taken = rig.camera.settings(), []
    try:
        for e, exposure in enumerate(wanted):
            taken.append(_exposed(rig, exposure))
            if e and taken[e] <= taken[e - 1]:
                raise DeviceError(
                    f"{rig.camera.name} took {taken[e]:g} ms when it was asked for {exposure:g} ms: "
                    "choose exposures that it can tell apart, or a single one"
                )
            _shoot(rig, n, out[e * n : (e + 1) * n], _counting(progress, e * n, len(out)))
    finally:
        with contextlib.suppress(DeviceError):  # one that is lost tells so itself
            rig.camera.apply(before)
    return CapturedFrames(out, rig.camera.settings(), tuple(taken), _colours(rig))


def check_exposures(exposures_ms: Sequence[float]) -> list[float]:
    """Two or more exposures in ms, the shortest first. Raises InputError where they are not."""
    wanted = sorted(CameraSettings(exposure).exposure_ms or 0.0 for exposure in exposures_ms)
    if len(set(wanted)) < max(2, len(exposures_ms)) or len(wanted) > MOST_EXPOSURES:
        raise InputError(
            f"exposures of {', '.join(f'{e:g}' for e in exposures_ms)} ms: give 2 to {MOST_EXPOSURES}, each once"
        )
    return wanted


def _colours(rig: Rig) -> np.ndarray | None:
    """The colour texture; None also where it fails: the frames are whole, and a lost device tells so itself."""
    with contextlib.suppress(DeviceError):
        return colour_texture(rig)
    return None


def _exposed(rig: Rig, exposure_ms: float) -> float:
    """Set an exposure; what the camera took."""
    taken = rig.camera.apply(CameraSettings(exposure_ms)).exposure_ms
    if taken is None:
        raise DeviceError(f"{rig.camera.name} does not say which exposure it took: capture in a single one")
    return taken


def _counting(
    progress: Callable[[int, int], None] | None, before: int, frames: int
) -> Callable[[int, int], None] | None:
    """The progress of one exposure's frames among all."""
    return None if progress is None else lambda done, _: progress(before + done, frames)


def colour_texture(rig: Rig) -> np.ndarray | None:
    """(h, w, 3) RGB of the scene under white light, where the camera of the open rig sees colour; else None."""
    if not isinstance(rig.camera, ColourCamera):
        return None
    rig.projector.show_level(255)
    settle(rig)
    return rig.camera.grab_colour()


def settle(rig: Rig) -> None:
    """Wait until what the projector says it shows has reached the scene."""
    if rig.settle_ms > 0:
        time.sleep(rig.settle_ms / 1000)
