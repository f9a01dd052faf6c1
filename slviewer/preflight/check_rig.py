"""The preflight without a browser: is a rig fit to capture with, and is a capture fit to measure
with?"""

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Annotated

from slviewer.devices.capture import can_burst
from slviewer.devices.protocols import CameraSettings, Rig, report_driver_faults
from slviewer.errors import DeviceError
from slviewer.inputs import EXPOSURE, GAIN
from slviewer.pipeline.capture import RigSettings, set_camera
from slviewer.pipeline.examination import Check, CheckName, Preflight
from slviewer.pipeline.operation import (
    Progress,
    SessionLike,
    Warn,
    ignore_progress,
    ignore_warnings,
    opened,
    part,
)
from slviewer.pipeline.rig_choice import RigLike, SetUp, load_rig, set_up
from slviewer.preflight.latency import measure_latency
from slviewer.preflight.light import (
    capture_burst,
    check_ambient,
    check_exposure,
    check_flicker,
    check_gamma,
)
from slviewer.preflight.order import check_burst, check_order
from slviewer.preflight.recorded_capture import preflight_capture
from slviewer.preflight.rig_under_test import SYSTEM_CLOCK, Clock, RigUnderTest
from slviewer.preflight.screen import check_pixels, check_screen
from slviewer.preflight.stillness import check_motion
from slviewer.preflight.turntable import check_turning
from slviewer.session.store import Session


def check_rig(
    rig: RigLike,
    *,
    session: Path | str | None = None,
    exposure_ms: Annotated[float | None, EXPOSURE] = None,
    gain: Annotated[float | None, GAIN] = None,
    set_up: SetUp = set_up,
    progress: Progress = ignore_progress,
    warn: Warn = ignore_warnings,
) -> Preflight:
    """Check a rig in about 10 s: screen, delay, order of frames, light, stillness, turntable; or a
    capture's frames.

    Reports of each what is wrong, and what to do. Ends with status 1 where something is bad.

    Args:
        session: A session, whose own rigs are known by name too.
        exposure_ms: Exposure of the camera; by default the rig's, else what the camera is set to.
        gain: Gain of the camera, as a factor; by default the rig's, else what the camera is set to.

    Raises InputError, DeviceError, and whatever `progress` raises.
    """
    if isinstance(rig, Mapping):
        choice = dict(rig)
    elif session is None:
        choice = load_rig(rig)
    else:
        with Session.open(session) as store:
            choice = load_rig(rig, store)
    progress(0.0, "opening the devices")
    with set_up(choice, None).rig.opened() as devices:
        before = list[CameraSettings]()
        for camera in devices.cameras:
            with report_driver_faults(camera):
                before.append(camera.settings())
        set_camera(devices, choice, RigSettings(exposure_ms=exposure_ms, gain=gain, warn=warn))
        try:
            return preflight(devices, progress=progress)
        finally:  # a camera may keep what it was checked with
            for camera, settings in zip(devices.cameras, before, strict=True):
                with suppress(DeviceError), report_driver_faults(camera):
                    camera.apply(settings)


def check_recorded_rig(
    session: SessionLike, capture: str, *, progress: Progress = ignore_progress
) -> Preflight:
    """Check the rig of a recorded capture from its frames: order, light, exposure, response, noise,
    description, decoded share. Raises SessionError for a capture that cannot be read, and whatever
    `progress` raises.
    """
    with opened(session) as store:
        return preflight_capture(store.load_capture(capture), progress)


_EXPECTED_IMAGES = 52
"""How often about the bench shows something: what progress is measured by."""
_AVERAGED_IMAGES = 8  # images
_LONG_MS = 300.0  # of patience where the delay is unknown
_CHECK_ORDER: tuple[CheckName, ...] = (
    "latency",
    "exposure",
    "flicker",
    "gamma",
    "pixels",
    "order",
    "repeats",
    "ambient",
    "motion",
)


def preflight(
    rig: Rig,
    *,
    say: Warn = ignore_warnings,
    progress: Progress = ignore_progress,
    clock: Clock = SYSTEM_CLOCK,
) -> Preflight:
    """Check an open rig, on the thread that owns its devices; about 10 s for each of its cameras,
    whose checks are joined as `Preflight.join` does.

    `say` receives one sentence for each check. `progress` may raise Cancelled. Raises DeviceError
    where a device does not answer. Patterns are loaded and light is shown; what was loaded and
    shown before is for the caller to restore.
    """
    if rig.second is None:
        return _check_camera(rig, say, progress, clock)
    alone = replace(rig, second=None, bursts=False)
    first = _check_camera(alone, say, part(progress, 0.0, 0.5), clock)
    other = replace(alone, camera=rig.second, turntable=None)

    return first.join(
        _check_camera(
            other, lambda text: say(f"Second camera: {text}"), part(progress, 0.5, 1.0), clock
        )
    )


def _check_camera(rig: Rig, say: Warn, report: Progress, clock: Clock) -> Preflight:
    """Check an open rig with one camera, as `preflight`."""
    began, shown = clock.now(), 0
    checks: list[Check] = []

    def tick(doing: str) -> None:
        """Report progress by one more image."""
        nonlocal shown
        report(min(0.99, shown / _EXPECTED_IMAGES), doing)
        shown += 1

    def add(*results: Check) -> None:
        """Store the checks, and report each with its remedy."""
        for check in results:
            checks.append(check)
            say(check.message)

    bench = RigUnderTest(replace(rig, bursts=False), tick, clock)
    bench.measure_references()
    delay, settle_ms = measure_latency(bench)
    if settle_ms is None:
        bench.settle_ms = _LONG_MS
    screen = check_screen(bench)
    if screen.verdict == "bad" or settle_ms is None:
        # What else was measured would be another screen's.
        add(screen)
        if screen.verdict != "bad":
            add(delay)
        unseen = (
            "It was not looked at, because the camera does not see what the projector is given to"
            " show."
        )
        rest = [name for name in _CHECK_ORDER if name not in {check.name for check in checks}]
        checks += [Check(name, "unknown", unseen) for name in rest]
        return Preflight(tuple(checks), seconds=clock.now() - began)
    add(screen, delay)
    right, exposure_ms = check_exposure(bench)
    add(right)
    images = capture_burst(bench)
    add(check_flicker(bench, images))
    response, levels, middle = check_gamma(bench)
    add(response, check_pixels(bench, middle), *check_order(bench))
    last_dark, last_white = (
        bench.grab_mean(grey, "what changed meanwhile", _AVERAGED_IMAGES) for grey in (None, 255)
    )
    add(check_ambient(bench, last_dark), check_motion(bench, images, last_white))
    if can_burst(rig):
        tick("a burst")
        add(check_burst(bench))
    if rig.turntable is not None:
        tick("turning the turntable")
        add(check_turning(rig.turntable))
    report(1.0, "checked")
    return Preflight(tuple(checks), settle_ms, levels, exposure_ms, clock.now() - began)
