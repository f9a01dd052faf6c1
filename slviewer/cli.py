"""The command line: every command is a function of ``slviewer.pipeline``, ``preflight`` or
``validation``.

Results go to standard output, progress and warnings to standard error. Exit status: 0 done, 1
failed, 2 usage, 3 calibration rejected, 130 cancelled. Nothing heavy is imported before a command
needs it.
"""

import os
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import MISSING, fields
from functools import partial
from pathlib import Path
from typing import Any

import tyro

# Several threads multiply small matrices; OpenBLAS would wake threads of its own for each, which
# then wait for work.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before NumPy is imported

from slviewer import __version__, terminal
from slviewer.commands.calibration import CALIBRATED, run_calibrate
from slviewer.commands.command import JSON, read_command, show_result, union
from slviewer.commands.devices import CHECKED, PAGES, run_capture, run_preflight, run_turn
from slviewer.commands.imports import make_import_command
from slviewer.commands.meshing import MESHING, run_meshing
from slviewer.commands.wizard import wizard
from slviewer.errors import Cancelled, SlviewerError


def _describe_simulation(names: list[str], session: Path, **_: Any) -> str:
    """Describe how many captures were simulated, and the next command."""
    from slviewer.pipeline.simulate import TARGET

    return (
        f"{len(names)} captures simulated into {session}; next: slviewer calibrate {session}"
        f" --target {TARGET}"
    )


def _describe_dataset(fetched: Path, **_: Any) -> str:
    """Describe where a data set is."""
    return f"images in {fetched}"


CONFIG = (
    tyro.conf.OmitArgPrefixes,
    tyro.conf.OmitSubcommandPrefixes,
    tyro.conf.FlagCreatePairsOff,
    tyro.conf.PositionalMetavarFromFieldName,
)
DESCRIPTION = (
    "Structured-light 3D scanning: calibrate a camera and a projector, prove it, scan, merge."
)


class Commands(Mapping[str, Callable[..., Any]]):
    """Commands by name, each made when it is first used: that reads the source of its function.

    Operations that other code has registered are commands too.
    """

    def __init__(self, make: Mapping[str, Callable[[], Callable[..., Any]]]) -> None:
        self._make = make

    def __getitem__(self, name: str) -> Callable[..., Any]:
        return self._make[name]() if name in self._make else _make_operation_command(name)

    def __iter__(self) -> Iterator[str]:
        return iter(self._make)

    def __len__(self) -> int:
        return len(self._make)


def _make_operation_command(name: str) -> Callable[..., Any]:
    """Return the command of an operation that is registered in this process; its settings without
    defaults are positional. Raises KeyError where there is none."""
    registry = sys.modules.get("slviewer.pipeline.operation")
    operation = getattr(registry, "OPERATIONS", {})[name]
    required = [each.name for each in fields(operation.settings) if each.default is MISSING]
    source = f"{operation.function.__module__}:{operation.function.__name__}"
    return read_command(source, "session", *required, options=JSON)


def _define_command(
    source: str, *positional: str, **options: Any
) -> Callable[[], Callable[..., Any]]:
    """Return a function that reads a command from its source, see `read_command`."""
    return partial(read_command, source, *positional, **options)


COMMANDS = Commands(
    {
        "wizard": lambda: wizard,
        "devices": _define_command("pipeline.devices:devices"),
        "plugins": _define_command("pipeline.plugins:plugins"),
        "preflight": _define_command(
            "preflight.check_rig:check_rig", options=CHECKED, run=run_preflight
        ),
        "capture": _define_command(
            "pipeline.capture:capture", "session", "name", options=PAGES, run=run_capture
        ),
        "turn": _define_command(
            "pipeline.turn:turn", "session", options=[*PAGES, *JSON], run=run_turn
        ),
        "plan-rig": _define_command(
            "pipeline.plan_rig:plan_rig", "camera", "projector", "distance", options=JSON
        ),
        "import": make_import_command,
        "calibrate": _define_command(
            "pipeline.calibrate:calibrate", "session", options=CALIBRATED, run=run_calibrate
        ),
        "validate": _define_command("pipeline.validate:validate", "session", options=JSON),
        "decode": _define_command(
            "pipeline.decode:write_decoded", "session", "capture", names={"file_format": "format"}
        ),
        "reconstruct": _define_command("pipeline.reconstruct:reconstruct", "session", "capture"),
        "region": _define_command("pipeline.edit:set_region", "session"),
        "edit": _define_command("pipeline.edit:edit_scan", "session", "scan", options=JSON),
        "verify": _define_command(
            "pipeline.verify:verify",
            "session",
            "captures",
            options=JSON,
            names={"models": "model", "depth_range": "range"},
        ),
        "align": _define_command("pipeline.align:align", "session", "captures", options=JSON),
        "merge": _define_command("pipeline.merge:merge", "session", "captures", options=JSON),
        "mesh": _define_command(
            "pipeline.mesh:mesh", "session", "names", options=[*MESHING, *JSON], run=run_meshing
        ),
        "compare": _define_command(
            "pipeline.compare:compare", "session", "scan", "nominal", options=JSON
        ),
        "measure": _define_command(
            "pipeline.measure:measure", "session", "scan", "what", options=JSON
        ),
        "measurements": _define_command("pipeline.measurements:edit_measurements", "session"),
        "plan": _define_command("pipeline.plan:plan", "session"),
        "inspect-parts": _define_command(
            "pipeline.inspect_parts:inspect_parts",
            "plan",
            "sessions",
            options=JSON,
            names={"scans": "scan"},
        ),
        "run-plan": _define_command(
            "pipeline.run_plan:run_plan", "session", "plan", options=JSON, names={"scans": "scan"}
        ),
        "export": _define_command(
            "pipeline.export:export",
            "session",
            "what",
            "name",
            options=MESHING,
            names={"file_format": "format"},
            run=run_meshing,
        ),
        "batch": _define_command("pipeline.batch:batch", "sessions", options=JSON),
        "check": _define_command("pipeline.check:check", "session", "capture", options=JSON),
        "accept": _define_command("pipeline.accept:accept", "session", options=JSON),
        "fetch": _define_command(
            "pipeline.datasets:fetch",
            "name",
            "folder",
            run=partial(show_result, describe=_describe_dataset),
        ),
        "simulate": _define_command(
            "pipeline.simulate:simulate",
            "session",
            run=partial(show_result, describe=_describe_simulation),
        ),
        "reproduce": _define_command("validation.reproduce:reproduce", options=JSON),
        "prove": _define_command("validation.prove:prove", options=JSON, names={"cases": "case"}),
        "patterns": _define_command("pipeline.printouts:patterns"),
        "target": _define_command("pipeline.printouts:target", "board"),
        "detect": _define_command(
            "pipeline.detect:detect_board", "images", options=JSON, names={"csv_out": "csv"}
        ),
        "report": _define_command("pipeline.report:report", "session"),
        "verify-report": _define_command(
            "pipeline.certificate:verify_report", "session", "report", options=JSON
        ),
        "inspect": _define_command("pipeline.inspect:inspect", "session"),
        "restore": _define_command("pipeline.restore:restore", "session", "names"),
        "bench": _define_command("validation.bench:bench", options=JSON),
    }
)


def main(arguments: list[str] | None = None) -> int:
    """Run one command; returns its exit status."""
    terminal.accept_all_characters()
    arguments = sys.argv[1:] if arguments is None else arguments
    if not arguments:
        arguments = ["wizard"]
    if arguments == ["--version"]:
        print(f"slviewer {__version__}")
        return 0
    name, *rest = arguments
    try:
        if name in COMMANDS:
            run = tyro.cli(COMMANDS[name], prog=f"slviewer {name}", args=rest, config=CONFIG)
        else:
            run = tyro.cli(
                union(COMMANDS),
                prog="slviewer",
                description=DESCRIPTION,
                args=arguments,
                config=CONFIG,
            )
        run()
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
