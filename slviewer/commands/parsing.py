"""What commands have in common: how their arguments are read, and where their words go."""

import functools
import json
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal, Union

import tyro

from slviewer import terminal

Axis = Literal["x", "y"]
ModelName = Literal["stereo", "pixelwise", "splined"]
Role = Literal["calibration", "scan"]
Start = Literal["features", "turntable", "identity"]
Method = Literal["grid", "poisson", "volume"]


def deferred(command: Callable[..., None]) -> Callable[..., Callable[[], None]]:
    """Parsing ends before the command runs, so that no error of the command is taken for one of its arguments."""

    @functools.wraps(command)
    def parse(*args: Any, **kwargs: Any) -> Callable[[], None]:
        return functools.partial(command, *args, **kwargs)

    return parse


def union(commands: dict[str, Callable[..., Any]]) -> Any:
    """The type whose value is one of the commands, for tyro."""
    choices = [Annotated[Any, tyro.conf.subcommand(name=name, constructor=f)] for name, f in commands.items()]
    return Union[tuple(choices)]  # noqa: UP007 (built at run time)


def write_json(path: Path | None, result: object) -> None:
    """Write a result, plain values or dataclasses, to the file that ``--json`` names; nothing without one."""
    if path is not None:
        from slviewer.records import to_plain  # lazily: it brings NumPy

        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(result, indent=2, default=to_plain) + "\n")


def ui() -> dict[str, Any]:
    """Callbacks for progress and warnings on standard error."""
    return {"progress": terminal.progress, "warn": terminal.warn}
