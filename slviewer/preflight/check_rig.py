"""The preflight without a browser: is a rig fit to capture with, and is a capture fit to measure with?"""

from collections.abc import Mapping
from pathlib import Path

from slviewer.pipeline.capture import set_camera
from slviewer.pipeline.check_results import Preflight
from slviewer.pipeline.feedback import Progress, Warn, ignore_progress, ignore_warnings
from slviewer.pipeline.open_session import SessionLike, opened
from slviewer.pipeline.rig_choice import SetUp, set_up
from slviewer.pipeline.rig_presets import RigLike, load_rig
from slviewer.preflight.recorded_capture import preflight_capture
from slviewer.preflight.run import preflight
from slviewer.session.store import Session


def check_rig(
    rig: RigLike,
    *,
    session: Path | str | None = None,
    exposure_ms: float | None = None,
    gain: float | None = None,
    set_up: SetUp = set_up,
    progress: Progress = ignore_progress,
    warn: Warn = ignore_warnings,
) -> Preflight:
    """Check a rig in about 10 s: right screen, delay, order of frames, light, stillness; or the frames of a capture.

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
        set_camera(devices, choice, exposure_ms, gain, warn)
        return preflight(devices, progress=progress)


def check_capture(session: SessionLike, capture: str, *, progress: Progress = ignore_progress) -> Preflight:
    """What the frames of a recorded capture say about the rig that took them: order, light, exposure, response, noise,
    description, decoded share. Raises SessionError for a capture that cannot be read, and whatever `progress` raises.
    """
    with opened(session) as store:
        return preflight_capture(store.load_capture(capture), progress)
