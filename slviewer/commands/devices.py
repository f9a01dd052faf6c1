"""Rigs from the terminal: the pages of a browser's devices are served while a rig needs them."""

import math
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from slviewer import terminal
from slviewer.commands.command import JSON, Option, call, show_result, write_json
from slviewer.errors import DeviceError, InputError, UsageError

if TYPE_CHECKING:
    from slviewer.devices.browser import PageChannels, PageRole
    from slviewer.pipeline.rig_choice import SetUp
    from slviewer.server.secure import Serving

PAGE_PATIENCE_S = 600.0
"""How long somebody may take to walk to the projector and open its page."""
PAGES = (
    Option(
        "port",
        int,
        8080,
        "Port of the pages, where projector or camera is one; 0 takes any free one.",
    ),
    Option(
        "host",
        str,
        "127.0.0.1",
        "Address to serve the pages at: 0.0.0.0 for other computers and phones.",
    ),
    Option(
        "tls",
        bool,
        False,
        "Encrypt the pages, as the browser of another device demands for its camera.",
    ),
    Option(
        "wait_s",
        float,
        PAGE_PATIENCE_S,
        "How long to wait until each page is opened and ready, in s.",
    ),
)
"""How the pages of a rig's devices are served."""
CHECKED = (
    Option(
        "rig",
        str | None,
        None,
        "A TOML file that describes the rig, or the name of one that `slviewer devices` lists.",
    ),
    Option(
        "capture",
        tuple[Path, str] | None,
        None,
        "Session folder and name of a recorded capture, to check its frames instead of a rig.",
    ),
    *PAGES,
    *JSON,
)
"""What `preflight` takes beside the parameters of `check_rig`."""


def run_capture(capture: Callable[..., Any], arguments: dict[str, Any]) -> None:
    """Capture, and print what the capture holds."""
    from slviewer.pipeline.inspect import summarise_capture

    with _serve_pages(arguments) as set_up:
        saved = call(capture, set_up=set_up, say=terminal.print_result, **arguments)
    terminal.print_result(summarise_capture(saved))


def run_turn(turn: Callable[..., Any], arguments: dict[str, Any]) -> None:
    """Scan all round, and show what was made."""
    with _serve_pages(arguments) as set_up:
        show_result(turn, {**arguments, "set_up": set_up})


def run_preflight(check_rig: Callable[..., Any], arguments: dict[str, Any]) -> None:
    """Check a rig, or a recorded capture where --capture names one, and raise an error where
    something is bad."""
    from slviewer.preflight.check_rig import check_recorded_rig

    recorded, json_file = arguments.pop("capture"), arguments.pop("json")
    if (arguments["rig"] is None) == (recorded is None):
        raise UsageError(
            "give --rig to check a rig, or --capture SESSION NAME to check the frames of a capture"
        )
    if recorded is not None:
        checked = call(check_recorded_rig, session=recorded[0], capture=recorded[1])
    else:
        with _serve_pages(arguments) as set_up:
            checked = call(check_rig, set_up=set_up, **arguments)
    write_json(json_file, checked.to_dict())
    terminal.print_result(checked.text())
    if checked.verdict == "bad":
        if recorded is not None:
            raise InputError(
                "the capture is not fit to measure with: correct what is marked bad, then capture"
                " again"
            )
        raise DeviceError(
            "the rig is not fit to capture with: correct what is marked bad, then check it again"
        )


@contextmanager
def _serve_pages(arguments: dict[str, Any]) -> Iterator["SetUp"]:
    """Take `PAGES` out of the arguments; yield the function that sets up rigs, which serves the
    pages that a rig needs until the block ends."""
    from slviewer.devices.browser import PageChannels
    from slviewer.pipeline.rig_choice import Board, Choice, RigSetup, list_needed_pages, set_up
    from slviewer.server.secure import Serving

    wait_s = arguments.pop("wait_s")
    serving = Serving(
        **{option.name: arguments.pop(option.name) for option in PAGES if option.name in arguments}
    )
    with ExitStack() as ended:

        def make(choice: Choice, board: Board | None) -> RigSetup:
            """Set up a rig, with channels to the pages that it needs."""
            needed = list_needed_pages(choice)
            if not needed:
                return set_up(choice, board)
            # with assumed sizes and without pages, so that what is impossible is refused before
            # somebody walks there
            devices: dict[str, Any] = {
                role: {"size": [912, 1140], **choice[role]} for role in needed
            }
            set_up({**choice, **devices}, board, pages=PageChannels())
            return set_up(choice, board, pages=_connect_pages(serving, needed, ended, wait_s))

        yield make


def _connect_pages(
    serving: "Serving", needed: tuple["PageRole", ...], ended: ExitStack, wait_s: float
) -> "PageChannels":
    """Serve the pages and return the channels to them, once those needed are ready. Raises
    DeviceError on timeout."""
    from slviewer.devices.browser import PageChannels
    from slviewer.server.device_pages import serve_device_pages
    from slviewer.server.secure import serve

    pages, server = PageChannels(), serve(serving, label="slviewer")
    ended.callback(server.stop)
    serve_device_pages(server, pages)
    if server.certificate is not None and server.certificate.self_made:
        terminal.print_message(
            f"Fingerprint of the pages' certificate (SHA-256): {server.certificate.fingerprint}"
        )
    if "projector" in needed:
        terminal.print_message(
            f"Open this on the projector's screen, full screen: {server.link('project')}"
        )
    if "camera" in needed:
        terminal.print_message(
            f"Open this on the phone or laptop that is the camera: {server.link('camera')}"
        )
    reported = dict.fromkeys(needed, "")
    for _ in range(math.ceil(wait_s)):
        states = {role: getattr(pages, role).page_state() for role in needed}
        if all(state.state == "ready" for state in states.values()):
            return pages
        for role, state in states.items():
            if state.words != reported[role]:
                reported[role] = state.words
                terminal.print_message(f"{role} page: {state.words}")
        getattr(pages, next(role for role in needed if states[role].state != "ready")).wait_ready(
            1.0
        )
    reasons = "; ".join(
        f"the {role} page: {state.words}"
        for role, state in states.items()
        if state.state != "ready"
    )
    raise DeviceError(f"not ready within {wait_s:g} s: {reasons}")
