"""The command line: every command is a function of ``slviewer.pipeline``, ``preflight`` or
``validation``.

Results go to standard output, progress and warnings to standard error. Exit status: 0 done, 1
failed, 2 usage, 3 calibration rejected, 130 cancelled. Nothing heavy is imported before a command
needs it.
"""

import os
import sys
from collections.abc import Callable
from difflib import get_close_matches
from functools import partial
from textwrap import fill
from typing import Any

# Several threads multiply small matrices; OpenBLAS would wake threads of its own for each, which
# then wait for work.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before NumPy is imported

from slviewer import __version__, terminal
from slviewer.commands.command import (
    JSON,
    Arguments,
    Function,
    call,
    parse_command,
    read_command,
    read_description,
    read_operation,
    show_result,
    take_options,
)
from slviewer.commands.runs import (
    make_import_command,
    run_calibrate,
    run_capture,
    run_preflight,
    run_reproduce,
    run_turn,
    run_wizard,
)
from slviewer.entry_points import OPERATIONS, find_sources
from slviewer.errors import Cancelled, SlviewerError, UsageError


def _run_simulate(simulate: Function, arguments: Arguments) -> None:
    """Print how many captures were simulated, and the next command."""
    from slviewer.pipeline.simulate import TARGET

    count, session = len(call(simulate, **arguments)), arguments["session"]
    terminal.print_result(
        f"{count} captures simulated into {session}; next: slviewer calibrate {session}"
        f" --target {TARGET}"
    )


def _run_fetch(fetch: Function, arguments: Arguments) -> None:
    """Print where a data set is."""
    terminal.print_result(f"images in {call(fetch, **arguments)}")


def _run_meshing(function: Function, arguments: Arguments) -> None:
    """Call a function that takes a `MeshingPlan`, and show what it returns."""
    from slviewer.surface.meshing import MeshingPlan

    arguments["plan"] = take_options(arguments, MeshingPlan)
    show_result(function, arguments)


DESCRIPTION = """usage: slviewer COMMAND ...

Structured-light 3D scanning: calibrate a camera and a projector, prove it, scan, merge.
`slviewer COMMAND --help` explains a command; without one the wizard starts in the browser.
"""
WIDTH, INDENT = 88, 18
"""Columns of the list of commands, and those of their names."""
PAGES = ("commands.runs:PageOptions",)
MESHING = ("surface.meshing:MeshingPlan",)
MESHING_NAMES = {"fill_holes_mm": "fill_holes"}


def _define_command(source: str, *positional: str, **options: Any) -> Callable[[], Function]:
    """Return a function that reads a command from its source, see `read_command`."""
    return partial(read_command, source, *positional, **options)


COMMANDS: dict[str, Callable[[], Function]] = {
    "wizard": _define_command(
        "commands.runs:wizard", "session", options=("commands.runs:Address",), run=run_wizard
    ),
    "devices": _define_command("pipeline.rig_choice:devices"),
    "plugins": _define_command("plugins:plugins"),
    "preflight": _define_command(
        "preflight.check_rig:check_rig",
        options=("commands.runs:CheckedOptions", *PAGES, *JSON),
        run=run_preflight,
    ),
    "capture": _define_command("pipeline.capture:capture", "name", options=PAGES, run=run_capture),
    "turn": _define_command("pipeline.capture:turn", options=(*PAGES, *JSON), run=run_turn),
    "import": make_import_command,
    "calibrate": _define_command(
        "pipeline.calibrate:calibrate",
        options=("commands.runs:CalibrateOptions", *JSON),
        run=run_calibrate,
    ),
    "validate": _define_command("pipeline.accept:validate", options=JSON),
    "decode": _define_command(
        "pipeline.capture_phases:write_decoded", "capture", names={"file_format": "format"}
    ),
    "reconstruct": _define_command("pipeline.reconstruct:reconstruct", "capture"),
    "region": _define_command("pipeline.edit:set_region"),
    "edit": _define_command("pipeline.edit:edit_scan", "scan", options=JSON),
    "verify": _define_command(
        "pipeline.reconstruct:verify",
        "captures",
        options=JSON,
        names={"models": "model", "depth_range": "range"},
    ),
    "align": _define_command("pipeline.merge:align", "captures", options=JSON),
    "merge": _define_command("pipeline.merge:merge", "captures", options=JSON),
    "mesh": _define_command(
        "pipeline.mesh:mesh",
        "names",
        options=(*MESHING, *JSON),
        names=MESHING_NAMES,
        run=_run_meshing,
    ),
    "compare": _define_command("pipeline.compare:compare", "scan", "nominal", options=JSON),
    "measure": _define_command("pipeline.measure:measure", "scan", "what", options=JSON),
    "measurements": _define_command("pipeline.measure:edit_measurements"),
    "plan": _define_command("pipeline.inspect_parts:plan"),
    "inspect-parts": _define_command(
        "pipeline.inspect_parts:inspect_parts",
        "plan",
        "sessions",
        options=JSON,
        names={"scans": "scan"},
    ),
    "run-plan": _define_command(
        "pipeline.inspect_parts:run_plan", "plan", options=JSON, names={"scans": "scan"}
    ),
    "export": _define_command(
        "pipeline.export:export",
        "what",
        "name",
        options=MESHING,
        names={"file_format": "format", **MESHING_NAMES},
        run=_run_meshing,
    ),
    "check": _define_command("pipeline.accept:check", "capture", options=JSON),
    "accept": _define_command("pipeline.accept:accept", options=JSON),
    "fetch": _define_command("pipeline.datasets:fetch", "name", "folder", run=_run_fetch),
    "simulate": _define_command("pipeline.simulate:simulate", run=_run_simulate),
    "reproduce": _define_command(
        "validation.reproduce:reproduce",
        options=("commands.runs:ReproduceOptions", *JSON),
        run=run_reproduce,
    ),
    "patterns": _define_command("pipeline.printouts:patterns"),
    "target": _define_command("pipeline.printouts:target", "board"),
    "detect": _define_command(
        "pipeline.detect:detect_board", "images", options=JSON, names={"csv_out": "csv"}
    ),
    "report": _define_command("pipeline.report:report"),
    "verify-report": _define_command("pipeline.certificate:verify_report", "report", options=JSON),
    "inspect": _define_command("pipeline.report:inspect"),
    "restore": _define_command("pipeline.report:restore", "names"),
    "bench": _define_command("validation.bench:bench", options=JSON),
}
"""The commands by name, each made when it is used: that reads the source of its function."""


def make_command(name: str) -> Function:
    """Return the command of that name, also of another package's operation. Raises UsageError where
    there is none."""
    commands = find_commands()
    if name not in commands:
        near = "".join(f" (did you mean {each}?)" for each in get_close_matches(name, commands, 1))
        raise UsageError(f"unknown command {name}{near}", "`slviewer --help` lists all commands")
    return commands[name]()


def find_commands() -> dict[str, Callable[[], Function]]:
    """Return all commands by name, and those of operations that are found by entry points."""
    sources = find_sources(OPERATIONS).items()
    found = {name: partial(_make_operation, name, source) for name, source in sources}
    return COMMANDS | {name: make for name, make in found.items() if name not in COMMANDS}


def _make_operation(name: str, source: str) -> Function:
    """Return the command of an operation. Raises UsageError where its source cannot be read."""
    try:
        return read_operation(source)
    except Exception as error:  # whatever is wrong with a package
        raise UsageError(
            f"{name}, of another package, cannot be used ({type(error).__name__}: {error})",
            "`slviewer plugins` shows why",
        ) from error


def list_commands() -> str:
    """Return all commands, each with the first paragraph of its description."""
    lines = [DESCRIPTION]
    for name, make in find_commands().items():
        try:
            text = " ".join(_describe(make).split("\n\n")[0].split())
        except UsageError as error:
            text = str(error)
        lines.append(fill(f"  {name:{INDENT - 2}}{text}", WIDTH, subsequent_indent=" " * INDENT))
    return "\n".join(lines)


def _describe(make: Callable[[], Function]) -> str:
    """Return the description of a command; that of a function of slviewer needs no arguments."""
    if isinstance(make, partial) and make.func is read_command:
        return read_description(make.args[0])
    return make().__doc__ or ""


def _split_merge(name: str, arguments: list[str]) -> list[str]:
    """Return the arguments with `export SESSION merge/1` as `export SESSION merge 1`."""
    match name, arguments:
        case "export", [session, merge, *others] if merge.startswith("merge/"):
            return [session, *merge.split("/"), *others]
    return arguments


def main(arguments: list[str] | None = None) -> int:
    """Run one command; returns its exit status."""
    terminal.accept_all_characters()
    arguments = sys.argv[1:] if arguments is None else arguments
    if not arguments:
        arguments = ["wizard"]
    name, *rest = arguments
    try:
        if name in ("--version", "-h", "--help"):
            print(f"slviewer {__version__}" if name == "--version" else list_commands())
            return 0
        parse_command(make_command(name), name, _split_merge(name, rest))()
    except SystemExit as stop:
        return int(stop.code or 0)
    except SlviewerError as error:
        terminal.print_message(f"slviewer: {error}")
        return error.exit_status
    except KeyboardInterrupt:
        terminal.print_message("slviewer: cancelled")
        return Cancelled.exit_status
    except BrokenPipeError:  # the help, or a result, is piped into `head`
        return 1
    except (MemoryError, RecursionError) as error:
        reason = (
            "needs more memory than there is"
            if isinstance(error, MemoryError)
            else "nests values too deep"
        )
        terminal.print_message(
            f"slviewer: an unexpected end: what was read {reason}: give a smaller or an undamaged"
            " file"
        )
        return 1
    except OSError as error:
        where = f" ({error.filename})" if error.filename else ""
        terminal.print_message(f"slviewer: {error.strerror or error}{where}")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
