"""Rigs from the terminal: the pages of a browser's devices are served while a rig needs them."""

import math
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from slviewer import terminal
from slviewer.commands.command import (
    Arguments,
    Function,
    call,
    show_result,
    take_options,
    write_json,
)
from slviewer.errors import DeviceError, InputError, UsageError

if TYPE_CHECKING:
    from slviewer.devices.browser import PageChannels, PageRole
    from slviewer.pipeline.rig_choice import SetUp
    from slviewer.server.secure import Serving

PAGE_PATIENCE_S = 600.0
"""How long somebody may take to walk to the projector and open its page."""


@dataclass(frozen=True)
class PageOptions:
    """How the pages of a rig's devices are served.

    Args:
        port: Port of the pages, where projector or camera is one; 0 takes any free one.
        host: Address to serve the pages at: 0.0.0.0 for other computers and phones.
        tls: Encrypt the pages, as the browser of another device demands for its camera.
        wait_s: How long to wait until each page is opened and ready, in s.
    """

    port: int = 8080
    host: str = "127.0.0.1"
    tls: bool = False
    wait_s: float = PAGE_PATIENCE_S


@dataclass(frozen=True)
class CheckedOptions:
    """What `preflight` checks.

    Args:
        rig: A TOML file that describes the rig, or the name of one that `slviewer devices` lists.
        capture: Session folder and name of a recorded capture, to check its frames instead of a
            rig.
    """

    rig: str | None = None
    capture: tuple[Path, str] | None = None


def run_capture(capture: Function, arguments: Arguments) -> None:
    """Capture, and print what the capture holds."""
    from slviewer.pipeline.inspect import summarise_capture

    with _serve_pages(arguments) as set_up:
        saved = call(capture, set_up=set_up, say=terminal.print_result, **arguments)
    terminal.print_result(summarise_capture(saved))


def run_turn(turn: Function, arguments: Arguments) -> None:
    """Scan all round, and show what was made."""
    with _serve_pages(arguments) as set_up:
        show_result(turn, {**arguments, "set_up": set_up})


def run_preflight(check_rig: Function, arguments: Arguments) -> None:
    """Check a rig, or a recorded capture where --capture names one, and raise an error where
    something is bad."""
    from slviewer.preflight.check_rig import check_recorded_rig

    checked_options, json_file = take_options(arguments, CheckedOptions), arguments.pop("json")
    rig, recorded = checked_options.rig, checked_options.capture
    if (rig is None) == (recorded is None):
        raise UsageError(
            "give --rig to check a rig, or --capture SESSION NAME to check the frames of a capture"
        )
    if recorded is not None:
        checked = call(check_recorded_rig, session=recorded[0], capture=recorded[1])
    else:
        with _serve_pages(arguments) as set_up:
            checked = call(check_rig, rig=rig, set_up=set_up, **arguments)
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
def _serve_pages(arguments: Arguments) -> Iterator["SetUp"]:
    """Take the `PageOptions` out of the arguments; yield the function that sets up rigs, which
    serves the pages that a rig needs until the block ends."""
    from slviewer.devices.browser import PageChannels
    from slviewer.pipeline.rig_choice import Board, Choice, RigSetup, list_needed_pages, set_up
    from slviewer.server.secure import Serving

    options = take_options(arguments, PageOptions)
    serving = Serving(options.host, options.port, tls=options.tls)
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
            pages = _connect_pages(serving, needed, ended, options.wait_s)
            return set_up(choice, board, pages=pages)

        yield make


def _connect_pages(
    serving: "Serving", needed: tuple["PageRole", ...], ended: ExitStack, wait_s: float
) -> "PageChannels":
    """Serve the pages and return the channels to them, once those needed are ready. Raises
    DeviceError on timeout."""
    from slviewer.devices.browser import PageChannels
    from slviewer.server.device_pages import serve_device_pages
    from slviewer.server.secure import serve

    pages, server = PageChannels(), serve(serving)
    ended.callback(server.stop)
    serve_device_pages(server, pages)
    if server.certificate is not None and server.certificate.self_made:
        terminal.print_message(
            f"Fingerprint of the pages' certificate (SHA-256): {server.certificate.fingerprint}"
        )
    openings: dict[PageRole, str] = {
        "projector": f"Open this on the projector's screen, full screen: {server.link('project')}",
        "camera": f"Open this on the phone or laptop that is the camera: {server.link('camera')}",
    }
    for role, opening in openings.items():
        if role in needed:
            terminal.print_message(opening)
    reported = dict.fromkeys(needed, "")
    for _ in range(math.ceil(wait_s)):
        states = {role: getattr(pages, role).page_state() for role in needed}
        waiting = [role for role in needed if states[role].state != "ready"]
        if not waiting:
            return pages
        for role, state in states.items():
            if state.words != reported[role]:
                reported[role] = state.words
                terminal.print_message(f"{role} page: {state.words}")
        getattr(pages, waiting[0]).wait_ready(1.0)
    reasons = "; ".join(f"the {role} page: {states[role].words}" for role in waiting)
    raise DeviceError(f"not ready within {wait_s:g} s: {reasons}")
