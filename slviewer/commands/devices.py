"""Rigs from the terminal: the projector page is served while a rig needs it."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from slviewer import terminal
from slviewer.commands.command import JSON, Option, call, show_result, write_json
from slviewer.errors import DeviceError, InputError, UsageError

if TYPE_CHECKING:
    from slviewer.devices.channel import Channel
    from slviewer.pipeline.rig_choice import SetUp

PAGE_PATIENCE_S = 600.0
"""How long somebody may take to walk to the projector and open its page."""
PORT = Option("port", int, 8080, "Port of the projector page, where the rig's projector is one; 0 takes any free one.")
CHECKED = (
    Option(
        "rig", str | None, None, "A TOML file that describes the rig, or the name of one that `slviewer devices` lists."
    ),
    Option(
        "capture",
        tuple[Path, str] | None,
        None,
        "Session folder and name of a recorded capture, to check its frames instead of a rig.",
    ),
    PORT,
    JSON,
)
"""What `preflight` takes beside the parameters of `check_rig`."""


def run_capture(capture: Callable[..., Any], arguments: dict[str, Any]) -> None:
    """Capture, and print what the capture holds."""
    from slviewer.pipeline.inspect import summarise_capture

    with _serve_projector_page(arguments.pop("port")) as set_up:
        saved = call(capture, set_up=set_up, say=terminal.print_result, **arguments)
    terminal.print_result(summarise_capture(saved))


def run_turn(turn: Callable[..., Any], arguments: dict[str, Any]) -> None:
    """Scan all round, and show what was made."""
    with _serve_projector_page(arguments.pop("port")) as set_up:
        show_result(turn, {**arguments, "set_up": set_up})


def run_preflight(check_rig: Callable[..., Any], arguments: dict[str, Any]) -> None:
    """Check a rig, or a recorded capture where --capture names one, and raise an error where something is bad."""
    from slviewer.preflight.check_rig import check_capture

    recorded, port, json_file = (arguments.pop(name) for name in ("capture", "port", "json"))
    if (arguments["rig"] is None) == (recorded is None):
        raise UsageError("give --rig to check a rig, or --capture SESSION NAME to check the frames of a capture")
    if recorded is not None:
        checked = call(check_capture, session=recorded[0], capture=recorded[1])
    else:
        with _serve_projector_page(port) as set_up:
            checked = call(check_rig, set_up=set_up, **arguments)
    write_json(json_file, checked.to_dict())
    terminal.print_result(checked.text())
    if checked.verdict == "bad":
        if recorded is not None:
            raise InputError("the capture is not fit to measure with: correct what is marked bad, then capture again")
        raise DeviceError("the rig is not fit to capture with: correct what is marked bad, then check it again")


@contextmanager
def _serve_projector_page(port: int) -> Iterator["SetUp"]:
    """Yield the function that sets up rigs, which serves the projector page where needed until the block ends."""
    from slviewer.devices.channel import Channel
    from slviewer.pipeline.rig_choice import Board, Choice, RigSetup, needs_page, set_up

    with ExitStack() as ended:

        def make(choice: Choice, board: Board | None) -> RigSetup:
            """Set up a rig, with a channel to the projector page where it needs one."""
            if not needs_page(choice):
                return set_up(choice, board)
            # with an assumed size and without a page, so that what is impossible is refused before somebody walks there
            projector = {"size": [912, 1140], **choice["projector"]}
            set_up({**choice, "projector": projector}, board, channel=Channel())
            return set_up(choice, board, channel=_connect_page(port, ended))

        yield make


def _connect_page(port: int, ended: ExitStack) -> "Channel":
    """Serve the projector page and return the channel to it, once it is ready. Raises DeviceError on timeout."""
    from slviewer.devices.channel import Channel
    from slviewer.server.projector_page import serve_projector
    from slviewer.server.secure import Serving, serve

    channel, server = Channel(), serve(Serving(port=port), label="slviewer")
    ended.callback(server.stop)
    serve_projector(server, channel)
    terminal.print_message(f"Open this on the projector's screen, full screen: {server.link('project')}")
    reported = ""
    for _ in range(int(PAGE_PATIENCE_S)):
        standing = channel.wait_ready(1.0)
        if standing.state == "ready":
            return channel
        if standing.words != reported:
            terminal.print_message(f"projector page: {(reported := standing.words)}")
    raise DeviceError(f"the projector page was not ready within {PAGE_PATIENCE_S:g} s: {channel.page_state().words}")
