"""The command line: every command is a function of ``slviewer.pipeline``, ``preflight`` or ``validation``.

Results go to standard output, progress and warnings to standard error. Exit status: 0 done, 1 failed, 2 usage,
3 calibration rejected, 130 cancelled. Nothing heavy is imported before a command needs it.
"""

import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import tyro

from slviewer import __version__, terminal
from slviewer.commands.calibration import CALIBRATED, run_calibrate
from slviewer.commands.command import JSON, read_command, show_result, union
from slviewer.commands.devices import CHECKED, PORT, run_capture, run_preflight
from slviewer.commands.imports import import_command
from slviewer.commands.meshing import MESHING, run_meshing
from slviewer.commands.wizard import wizard
from slviewer.errors import Cancelled, SlviewerError


def describe_measurement(made: Any, **_: Any) -> str:
    """Describe a measurement in one line."""
    from slviewer.pipeline import measurements

    return measurements.describe_measurement(made)


def describe_simulation(names: list[str], session: Path, **_: Any) -> str:
    """Describe how many captures were simulated, and the next command."""
    from slviewer.pipeline.simulate import TARGET

    return f"{len(names)} captures simulated into {session}; next: slviewer calibrate {session} --target {TARGET}"


COMMANDS: dict[str, Callable[..., Any]] = {
    "wizard": wizard,
    "devices": read_command("pipeline.devices:devices"),
    "preflight": read_command("preflight.check_rig:check_rig", options=CHECKED, run=run_preflight),
    "capture": read_command("pipeline.capture:capture", "session", "name", options=[PORT], run=run_capture),
    "import": import_command,
    "calibrate": read_command("pipeline.calibrate:calibrate", "session", options=CALIBRATED, run=run_calibrate),
    "validate": read_command("pipeline.validate:validate", "session", options=[JSON]),
    "decode": read_command("pipeline.decode:decode", "session", "capture", names={"file_format": "format"}),
    "reconstruct": read_command("pipeline.reconstruct:reconstruct", "session", "capture"),
    "verify": read_command(
        "pipeline.verify:verify",
        "session",
        "captures",
        options=[JSON],
        names={"models": "model", "depth_range": "range"},
    ),
    "merge": read_command("pipeline.merge:merge", "session", "captures", options=[JSON]),
    "mesh": read_command("pipeline.mesh:mesh", "session", "names", options=[*MESHING, JSON], run=run_meshing),
    "compare": read_command("pipeline.compare:compare", "session", "scan", "nominal", options=[JSON]),
    "measure": read_command(
        "pipeline.measure:measure",
        "session",
        "scan",
        "what",
        run=partial(show_result, describe=describe_measurement),
    ),
    "measurements": read_command("pipeline.measure:edit_measurements", "session"),
    "export": read_command(
        "pipeline.export:export",
        "session",
        "what",
        "name",
        options=MESHING,
        names={"file_format": "format"},
        run=run_meshing,
    ),
    "batch": read_command("pipeline.batch:batch", "sessions", options=[JSON]),
    "check": read_command("pipeline.check:check", "session", "capture", options=[JSON]),
    "accept": read_command("pipeline.accept:accept", "session", options=[JSON]),
    "simulate": read_command(
        "pipeline.simulate:simulate", "session", run=partial(show_result, describe=describe_simulation)
    ),
    "reproduce": read_command("validation.reproduce:reproduce", options=[JSON]),
    "prove": read_command("validation.prove:prove", options=[JSON], names={"cases": "case"}),
    "patterns": read_command("pipeline.printouts:patterns"),
    "target": read_command("pipeline.printouts:target", "board"),
    "detect": read_command("pipeline.detect:detect_board", "images", options=[JSON], names={"csv_out": "csv"}),
    "report": read_command("pipeline.report:report", "session"),
    "inspect": read_command("pipeline.inspect:inspect", "session"),
    "bench": read_command("validation.bench:bench", options=[JSON]),
}


def main(arguments: list[str] | None = None) -> int:
    """Run one command; returns its exit status."""
    arguments = sys.argv[1:] if arguments is None else arguments
    if not arguments:
        arguments = ["wizard"]
    if arguments == ["--version"]:
        print(f"slviewer {__version__}")
        return 0
    try:
        run = tyro.cli(
            union(COMMANDS),
            prog="slviewer",
            description="Structured-light 3D scanning: calibrate a camera and a projector, prove it, scan, merge.",
            args=arguments,
            config=(
                tyro.conf.OmitArgPrefixes,
                tyro.conf.OmitSubcommandPrefixes,
                tyro.conf.FlagCreatePairsOff,
                tyro.conf.PositionalMetavarFromFieldName,
            ),
        )
    except SystemExit as stop:
        return int(stop.code or 0)
    try:
        run()
    except SlviewerError as error:
        terminal.print_message(f"slviewer: {error}")
        return error.exit_status
    except KeyboardInterrupt:
        terminal.print_message("slviewer: cancelled")
        return Cancelled.exit_status
    except BrokenPipeError:
        return 1
    except OSError as error:
        where = f" ({error.filename})" if error.filename else ""
        terminal.print_message(f"slviewer: {error.strerror or error}{where}")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
