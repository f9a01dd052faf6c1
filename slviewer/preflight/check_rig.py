"""The preflight without a browser: is a rig fit to capture with, and is a capture fit to measure with?"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from slviewer.pipeline.capture import set_camera
from slviewer.pipeline.check_results import Preflight
from slviewer.pipeline.feedback import Progress, Warn, unheard, unwarned
from slviewer.pipeline.open_session import SessionLike, opened
from slviewer.pipeline.rig_choice import SetUp, set_up
from slviewer.pipeline.rig_presets import load_rig
from slviewer.preflight.recorded_capture import preflight_capture
from slviewer.preflight.run import preflight
from slviewer.session.store import Session


def check_rig(
    rig: Mapping[str, Any] | Path | str,
    *,
    session: Path | str | None = None,
    exposure_ms: float | None = None,
    gain: float | None = None,
    set_up: SetUp = set_up,
    progress: Progress = unheard,
    warn: Warn = unwarned,
) -> Preflight:
    """What the preflight says of a rig: a choice, a TOML file that holds one, or the name of a preset, `session`'s own
    too. Its camera is set as for a capture. Raises InputError, DeviceError, and whatever `progress` raises.
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


def check_capture(session: SessionLike, capture: str, *, progress: Progress = unheard) -> Preflight:
    """What the frames of a recorded capture say about the rig that took them: order, light, exposure, response, noise,
    description, decoded share. Raises SessionError for a capture that cannot be read, and whatever `progress` raises.
    """
    with opened(session) as store:
        return preflight_capture(store.load_capture(capture), progress)


def in_words(found: Preflight) -> str:
    """A preflight for the terminal: each check with its remedy, then what to set."""
    lines = []
    for check in found.checks:
        lines.append(f"{check.verdict:<8} {check.name}: {check.sentence}")
        if check.remedy:
            lines.append(f"         -> {check.remedy}")
    if found.settle_ms is not None:
        lines.append(f"settle_ms = {found.settle_ms:g} is what the rig's file should say")
    if found.exposure_ms is not None:
        lines.append(f"exposure_ms = {found.exposure_ms:g} would be better")
    lines.append(f"{found.verdict} after {found.seconds:.1f} s")
    return "\n".join(lines)
