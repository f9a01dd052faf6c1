"""One capture: every frame of a pattern sequence shown and grabbed, in one exposure or in
several."""

import contextlib
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from slviewer.devices.protocols import (
    BurstProjector,
    Camera,
    CameraSettings,
    ColourCamera,
    PatternBurst,
    Rig,
    TriggeredCamera,
    read_lens,
    report_driver_faults,
)
from slviewer.errors import DeviceError, InputError
from slviewer.fringe.sequence import PatternSequence

MAX_EXPOSURES = 8
"""With more, the scene would have to be still for too long."""


def capture_frames(
    rig: Rig,
    sequence: PatternSequence,
    out: np.ndarray | None = None,
    progress: Callable[[int, int], None] | None = None,
    sleep: Callable[[float], None] = time.sleep,
    second: np.ndarray | None = None,
) -> np.ndarray:
    """Capture the frames (n, h, w) of `sequence` with the open rig, into `out` if it is given, and
    those of its second camera into `second`; as a burst where its camera is triggered by its
    projector.

    `progress(done, n)` is called before the first frame and after each, and may raise (Cancelled)
    to stop. `sleep(seconds)` waits for the light to settle. Raises DeviceError, with the frame at
    which it happened; whatever is raised, `out` then holds no capture and the rig can be used again
    once its device answers. The projector is left showing the last frame, or dark after a burst.
    """
    with report_driver_faults(rig.projector):
        rig.projector.load(sequence)
    out = _allocate(rig.camera, len(sequence.frames), out)
    _capture_loaded(rig, (out, second), range(len(out)), progress, sleep)
    return out


def _allocate(camera: Camera, n: int, out: np.ndarray | None = None) -> np.ndarray:
    """Return `out` if `n` frames of a camera fit it, or a new array (n, h, w). Raises
    InputError."""
    width, height = camera.size
    if out is None:
        return np.empty((n, height, width), camera.dtype)
    if out.shape != (n, height, width) or out.dtype != camera.dtype:
        raise InputError(
            f"the {n} frames of {camera.name} need {(n, height, width)} {camera.dtype}, got"
            f" {out.shape} {out.dtype}",
            "make the array by the camera's size",
        )
    return out


def _capture_loaded(
    rig: Rig,
    stacks: tuple[np.ndarray, np.ndarray | None],
    places: range,
    progress: Callable[[int, int], None] | None,
    sleep: Callable[[float], None] = time.sleep,
) -> None:
    """Show and grab the loaded frames into their `places` in the stacks (k, h, w) of both
    cameras."""
    report = progress or (lambda done, n: None)
    report(places.start, len(stacks[0]))
    if can_burst(rig):
        _capture_burst(rig, stacks[0][places.start : places.stop])
        report(places.stop, len(stacks[0]))
        return
    for k, place in enumerate(places):
        try:
            with report_driver_faults(rig.projector):
                rig.projector.show(k)
            settle(rig, sleep)
            for camera, out in zip(rig.cameras, stacks, strict=False):
                if out is not None:
                    with report_driver_faults(camera):
                        camera.grab(out[place])
            if k == len(places) - 1:
                with report_driver_faults(rig.projector):
                    # a change during this exposure is reported by the next request only
                    rig.projector.show(k)
        except DeviceError as error:
            raise DeviceError(
                f"the capture ended at frame {k + 1} of {len(places)}, and its frames were"
                f" discarded: {error.observation}",
                error.remedy,
            ) from error
        report(place + 1, len(stacks[0]))


_SAMPLED_STEP = 8
"""Every how many rows and columns the light of a frame is taken from."""


def can_burst(rig: Rig) -> bool:
    """Whether the projector of a rig shows a sequence by itself and triggers the rig's camera."""
    able = isinstance(rig.projector, BurstProjector) and isinstance(rig.camera, TriggeredCamera)
    return rig.bursts and able and rig.second is None


def _capture_burst(rig: Rig, out: np.ndarray) -> None:
    """Capture the loaded frames into `out` (n, h, w) at the pace of the projector.

    Raises DeviceError unless as many frames came as there were triggers.
    """
    camera, projector = rig.camera, rig.projector
    assert isinstance(camera, TriggeredCamera) and isinstance(projector, BurstProjector)
    with report_driver_faults(projector):
        burst = projector.prepare()
    with report_driver_faults(camera):
        exposure_ms = camera.settings().exposure_ms
    if exposure_ms and exposure_ms > burst.period_ms:
        raise DeviceError(
            f"an exposure of {exposure_ms:.4g} ms does not fit a burst with {burst.period_ms:.4g}"
            " ms a pattern",
            "set a shorter one, or fewer patterns a picture",
        )
    frames = np.empty((burst.most, *out.shape[1:]), out.dtype)
    try:
        with report_driver_faults(camera):
            camera.arm(burst.most)
        with report_driver_faults(projector):
            projector.run()
        with report_driver_faults(camera):
            came = 0
            while came < burst.most and camera.fetch(frames[came]):
                came += 1
    finally:
        # a lost device raises its own error
        with contextlib.suppress(DeviceError), report_driver_faults(camera):
            camera.disarm()
    first = _find_first_pattern(frames[:came], burst)
    for frame, place in zip(out, burst.places, strict=True):
        frame[:] = frames[first + place]


def _find_first_pattern(frames: np.ndarray, burst: PatternBurst) -> int:
    """Return the index of a burst's first pattern among its frames (n, h, w), the one after the
    white marker. Raises DeviceError where the markers are not as far apart as they were shown."""
    light = frames[:, ::_SAMPLED_STEP, ::_SAMPLED_STEP].mean(axis=(1, 2))
    bright = np.flatnonzero(light > (light.min(initial=np.inf) + light.max(initial=0)) / 2)
    wanted = burst.length + 2 * burst.marker
    came = int(bright[-1] - bright[0]) + 1 if len(bright) else 0
    if came > wanted:
        raise DeviceError(
            f"{came} frames came of a burst of {wanted}, a picture stood for two refreshes, and its"
            " frames were discarded",
            "end what loads this computer's graphics, then capture again",
        )
    if came < wanted:
        raise DeviceError(
            f"the trigger was lost, {came} of {wanted} frames came of a burst with"
            f" {burst.period_ms:.3g} ms a pattern, and its frames were discarded",
            "set an exposure that leaves the camera time to be ready again, check the trigger's"
            " cable, or set fewer patterns a picture",
        )
    return int(bright[0]) + burst.marker


@dataclass(frozen=True, eq=False)
class CapturedFrames:
    """Result of `capture_with_texture`: frames (n, h, w), or (k n, h, w) of k `exposures_ms`, the
    whole sequence in one after the other; the camera's settings; the sequence and the name of the
    rig; a colour texture (h, w, 3), None with a monochrome camera; and what the camera reports of
    its ``lens``, as `read_lens`. ``second``: the frames of a second camera, in the same order.
    """

    frames: np.ndarray
    settings: CameraSettings
    sequence: PatternSequence
    source: str
    exposures_ms: tuple[float, ...] = ()
    texture: np.ndarray | None = None
    lens: Mapping[str, float] = field(default_factory=dict)
    second: np.ndarray | None = None


def capture_with_texture(
    rig: Rig,
    sequence: PatternSequence,
    exposures_ms: Sequence[float] = (),
    out: np.ndarray | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> CapturedFrames:
    """Capture `sequence`, in each of two or more `exposures_ms` if they are given, and then a
    colour texture.

    `out` is (k n, h, w) where it is given, and `progress(done, k n)` as in `capture_frames`. The
    camera's settings are as before when this returns or raises. Raises InputError for invalid
    exposures, DeviceError for a camera that cannot be set to them, and whatever `capture_frames`
    raises.
    """
    wanted, n = check_exposures(exposures_ms) if exposures_ms else [], len(sequence.frames)
    count = n * max(1, len(wanted))
    second = None if rig.second is None else _allocate(rig.second, count)
    if not wanted:
        out = capture_frames(rig, sequence, out, progress, second=second)
        return replace(_complete(rig, sequence, out), second=second)
    out = _allocate(rig.camera, count, out)
    with report_driver_faults(rig.projector):
        # once: a projector reconnected between two exposures must not go unnoticed
        rig.projector.load(sequence)
    applied_ms = list[float]()
    before = [read_settings(camera) for camera in rig.cameras]
    try:
        for e, exposure in enumerate(wanted):
            applied_ms.append(_set_exposure(rig, exposure))
            if e and applied_ms[e] <= applied_ms[e - 1]:
                raise DeviceError(
                    f"{rig.camera.name} set {applied_ms[e]:g} ms instead of the requested"
                    f" {exposure:g} ms",
                    "choose exposures that it can tell apart, or a single one",
                )
            _capture_loaded(rig, (out, second), range(e * n, (e + 1) * n), progress)
    finally:
        # a lost device raises its own error
        for camera, settings in zip(rig.cameras, before, strict=True):
            with contextlib.suppress(DeviceError), report_driver_faults(camera):
                camera.apply(settings)
    return replace(_complete(rig, sequence, out, tuple(applied_ms)), second=second)


def _complete(
    rig: Rig, sequence: PatternSequence, frames: np.ndarray, applied_ms: tuple[float, ...] = ()
) -> CapturedFrames:
    """Return captured frames with the camera's settings, its colour texture (h, w, 3) and its lens,
    as far as its driver gives them: the frames are complete, and kept, without.

    ``applied_ms``: the exposures that were set, none for a single one.
    """
    settings, texture, lens = CameraSettings(), None, dict[str, float]()
    with contextlib.suppress(DeviceError):
        settings = read_settings(rig.camera)
    with contextlib.suppress(DeviceError), report_driver_faults(rig.camera):
        texture = capture_colour(rig)
    with contextlib.suppress(DeviceError), report_driver_faults(rig.camera):
        lens = read_lens(rig.camera)
    return CapturedFrames(frames, settings, sequence, rig.name, applied_ms, texture, lens)


def check_exposures(exposures_ms: Sequence[float]) -> list[float]:
    """Return two or more exposures, ms, ascending. Raises InputError for too few, too many or
    repeated ones."""
    wanted = sorted(CameraSettings(exposure).exposure_ms or 0.0 for exposure in exposures_ms)
    if len(set(wanted)) < max(2, len(exposures_ms)) or len(wanted) > MAX_EXPOSURES:
        raise InputError(
            f"exposures of {', '.join(f'{e:g}' for e in exposures_ms)} ms",
            f"give 2 to {MAX_EXPOSURES}, each once",
        )
    return wanted


def _set_exposure(rig: Rig, exposure_ms: float) -> float:
    """Set the exposure of each camera; returns the value, ms, that the first one applied. Raises
    DeviceError where it is unknown."""
    for camera in reversed(rig.cameras):
        with report_driver_faults(camera):
            applied_ms = camera.apply(CameraSettings(exposure_ms)).exposure_ms
    if applied_ms is None:
        raise DeviceError(
            f"{rig.camera.name} does not report its exposure", "capture in a single one"
        )
    return applied_ms


def read_settings(camera: Camera) -> CameraSettings:
    """Return a camera's settings. Raises DeviceError."""
    with report_driver_faults(camera):
        return camera.settings()


def capture_colour(rig: Rig) -> np.ndarray | None:
    """Capture (h, w, 3) RGB of the scene under white light; None where the rig's camera sees no
    colour."""
    if not isinstance(rig.camera, ColourCamera):
        return None
    rig.projector.show_level(255)
    settle(rig)
    return rig.camera.grab_colour()


def settle(rig: Rig, sleep: Callable[[float], None] = time.sleep) -> None:
    """Wait for the delay between the projector's report and the light on the scene
    (`settle_ms`)."""
    if rig.settle_ms > 0:
        sleep(rig.settle_ms / 1000)
