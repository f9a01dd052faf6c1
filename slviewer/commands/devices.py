"""Real and simulated devices from the terminal: what is there, a check of the rig, captures without a browser."""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from tyro.conf import Positional

from slviewer import terminal
from slviewer.commands.parsing import Role, deferred, ui, write_json
from slviewer.errors import DeviceError, InputError, UsageError

if TYPE_CHECKING:
    from slviewer.devices.channel import Channel
    from slviewer.pipeline.rig_choice import SetUp

PAGE_PATIENCE_S = 600.0
"""How long somebody may take to walk to the projector and open its page."""


@deferred
def devices() -> None:
    """List the drivers: which can be used here, what is connected, what each needs, and the rigs to choose from."""
    from slviewer.pipeline import devices, rig_presets

    print(devices.devices())
    print(rig_presets.rigs())


@deferred
def capture(
    session: Positional[Path],
    name: Positional[str],
    rig: str,
    role: Role = "calibration",
    board: str | None = None,
    patterns: str | None = None,
    exposure_ms: float | None = None,
    exposures_ms: tuple[float, ...] = (),
    gain: float | None = None,
    force: bool = False,
    port: int = 8080,
) -> None:
    """Capture with a rig, without the wizard.

    Args:
        session: Session folder; made if it does not exist.
        name: Name of the capture.
        rig: A TOML file that describes the rig, or the name of one that `slviewer devices` lists.
        role: calibration for a target pose, scan for anything else.
        board: What the target is, circles:21x16:9 and the like; by default as the session knows it.
        patterns: p18, complementary, gray or multifrequency; by default the session's, else complementary.
        exposure_ms: Exposure of the camera; by default the rig's, else what the camera is set to.
        exposures_ms: Two or more exposures for shiny and dark parts; each pixel is taken from the longest that does not
            clip it.
        gain: Gain of the camera, as a factor; by default the rig's, else what the camera is set to.
        force: Replace a capture of that name (the old one goes to the session's trash).
        port: Port of the projector page, where the rig's projector is one; 0 takes any free one.
    """
    from slviewer.pipeline import capture, inspect

    with _set_up(port) as set_up:
        saved = capture.capture(
            session,
            name,
            rig,
            role=role,
            board=board,
            patterns=patterns,
            exposure_ms=exposure_ms,
            exposures_ms=exposures_ms,
            gain=gain,
            force=force,
            set_up=set_up,
            **ui(),
        )
    print(inspect.summary(saved))


@deferred
def preflight(
    rig: str | None = None,
    capture: tuple[Path, str] | None = None,
    session: Path | None = None,
    exposure_ms: float | None = None,
    gain: float | None = None,
    port: int = 8080,
    json: Path | None = None,
) -> None:
    """Check a rig in about 10 s: right screen, delay, order of frames, light, stillness; or the frames of a capture.

    Says of each what is wrong, and what to do. Ends with status 1 where something is bad.

    Args:
        rig: A TOML file that describes the rig, or the name of one that `slviewer devices` lists.
        capture: Session folder and name of a recorded capture, to check its frames instead of a rig.
        session: A session, whose own rigs are known by name too.
        exposure_ms: Exposure of the camera; by default the rig's, else what the camera is set to.
        gain: Gain of the camera, as a factor; by default the rig's, else what the camera is set to.
        port: Port of the projector page, where the rig's projector is one; 0 takes any free one.
        json: Write the result to this file too.
    """
    from slviewer.preflight import check_rig

    if capture is not None and rig is None:
        recorded = check_rig.check_capture(*capture, progress=terminal.progress)
        write_json(json, recorded.to_dict())
        print(check_rig.in_words(recorded))
        if recorded.verdict == "bad":
            raise InputError("the capture is not fit to measure with: correct what is marked bad, then capture again")
        return
    if rig is None or capture is not None:
        raise UsageError("give --rig to check a rig, or --capture SESSION NAME to check the frames of a capture")
    with _set_up(port) as set_up:
        found = check_rig.check_rig(rig, session=session, exposure_ms=exposure_ms, gain=gain, set_up=set_up, **ui())
    write_json(json, found.to_dict())
    print(check_rig.in_words(found))
    if found.verdict == "bad":
        raise DeviceError("the rig is not fit to capture with: mend what is marked bad, then check it again")


@contextmanager
def _set_up(port: int) -> Iterator["SetUp"]:
    """How rigs are set up; the projector page is served for one that needs it, until the block ends."""
    from slviewer.pipeline.rig_choice import Board, Choice, RigSetup, needs_page, set_up

    with ExitStack() as ended:

        def make(choice: Choice, board: Board | None) -> RigSetup:
            return set_up(choice, board, channel=_page(port, ended) if needs_page(choice) else None)

        yield make


def _page(port: int, ended: ExitStack) -> "Channel":
    """The wire to the projector page, once it is open and ready. Raises DeviceError where nobody opens it."""
    from slviewer.devices.channel import Channel
    from slviewer.server.projector_page import PATH, serve_projector
    from slviewer.server.secure import serve

    channel, server = Channel(), serve("127.0.0.1", port, label="slviewer")
    ended.callback(server.stop)
    serve_projector(server, channel)
    terminal.say(f"Open this on the projector's screen, full screen: {server.link(PATH)}")
    told = ""
    for _ in range(int(PAGE_PATIENCE_S)):
        standing = channel.wait_ready(1.0)
        if standing.state == "ready":
            return channel
        if standing.words != told:
            terminal.say(f"projector page: {(told := standing.words)}")
    raise DeviceError(f"the projector page was not ready within {PAGE_PATIENCE_S:g} s: {channel.standing().words}")
