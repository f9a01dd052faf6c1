"""The command line: every command is a function of ``slviewer.pipeline``, ``preflight`` or ``validation``.

Results go to standard output, progress and warnings to standard error. Exit status: 0 done, 1 failed, 2 usage,
3 calibration rejected, 130 cancelled. Nothing heavy is imported before a command needs it.
"""

import sys
from collections.abc import Callable
from typing import Any

import tyro

from slviewer import __version__, terminal
from slviewer.commands.calibration import accept, calibrate, check, detect, validate
from slviewer.commands.devices import capture, devices, preflight
from slviewer.commands.documents import inspect, patterns, report, target
from slviewer.commands.exports import decode, export
from slviewer.commands.imports import import_command
from slviewer.commands.measurements import measure, measurements
from slviewer.commands.parsing import union
from slviewer.commands.scans import batch, compare, merge, mesh, reconstruct, verify
from slviewer.commands.validation import bench, prove, reproduce, simulate
from slviewer.commands.wizard import wizard
from slviewer.errors import Cancelled, SlviewerError

COMMANDS: dict[str, Callable[..., Any]] = {
    "wizard": wizard,
    "devices": devices,
    "preflight": preflight,
    "capture": capture,
    "import": import_command,
    "calibrate": calibrate,
    "validate": validate,
    "decode": decode,
    "reconstruct": reconstruct,
    "verify": verify,
    "merge": merge,
    "mesh": mesh,
    "compare": compare,
    "measure": measure,
    "measurements": measurements,
    "export": export,
    "batch": batch,
    "check": check,
    "accept": accept,
    "simulate": simulate,
    "reproduce": reproduce,
    "prove": prove,
    "patterns": patterns,
    "target": target,
    "detect": detect,
    "report": report,
    "inspect": inspect,
    "bench": bench,
}


def main(arguments: list[str] | None = None) -> int:
    """Run one command; returns the exit status."""
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
        terminal.say(f"slviewer: {error}")
        return error.exit_status
    except KeyboardInterrupt:
        terminal.say("slviewer: cancelled")
        return Cancelled.exit_status
    except BrokenPipeError:
        return 1
    except OSError as error:
        where = f" ({error.filename})" if error.filename else ""
        terminal.say(f"slviewer: {error.strerror or error}{where}")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
