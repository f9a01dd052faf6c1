"""`slviewer calibrate`: the rig, the camera alone, and the comparison of models that may follow."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from slviewer import terminal
from slviewer.commands.command import JSON, Option, call, write_json
from slviewer.errors import UsageError

CALIBRATED = (
    Option(
        "validate",
        bool,
        False,
        "Also compare the models on poses that they were not made from, as `slviewer validate`"
        " does.",
    ),
    Option(
        "camera_only",
        bool,
        False,
        "Calibrate the camera's lens alone, from pictures of the board in the session, or in a"
        " folder in its place; the session stays as it is.",
    ),
    Option(
        "out",
        Path | None,
        None,
        "With --camera-only: write the lens to this .yml, .xml or .json, for OpenCV.",
    ),
    *JSON,
)
"""What `calibrate` takes beside the parameters of the pipeline's `calibrate`."""


def run_calibrate(calibrate: Callable[..., Any], arguments: dict[str, Any]) -> None:
    """Calibrate the rig, or the camera alone with --camera-only; compare the models with
    --validate."""
    validated, camera_only, out, json_file = (arguments.pop(option.name) for option in CALIBRATED)
    if camera_only:
        from slviewer.pipeline.calibrate_camera import calibrate_camera_alone

        chosen = {name: arguments[name] for name in ("target", "poses", "exclude")}
        result = call(calibrate_camera_alone, source=arguments["session"], out=out, **chosen)
    elif out is not None:
        raise UsageError(
            "--out belongs to --camera-only: `slviewer export calibration` writes the rig's"
            " calibration"
        )
    else:
        result = call(calibrate, **arguments)
    data = result.to_json()
    terminal.print_result(result.text())
    if validated and not camera_only:
        from slviewer.pipeline.validate import validate

        compared = call(validate, session=arguments["session"], models=arguments["models"])
        data |= compared.to_json()
        terminal.print_result(compared.text())
    if not camera_only:
        from slviewer.pipeline.models import describe_default_model

        terminal.print_result(describe_default_model(arguments["session"]))
    write_json(json_file, data)
