"""`slviewer calibrate`: the rig, the camera alone, and the comparison of models that may follow."""

from dataclasses import dataclass
from pathlib import Path

from slviewer import terminal
from slviewer.commands.command import Arguments, Function, call, take_options, write_json
from slviewer.errors import UsageError


@dataclass(frozen=True)
class CalibrateOptions:
    """What `calibrate` takes beside the settings of the pipeline's `calibrate`.

    Args:
        validate: Also compare the models on poses that they were not made from, as `slviewer
            validate` does.
        camera_only: Calibrate the camera's lens alone, from pictures of the board in the session,
            or in a folder in its place; the session stays as it is.
        out: With --camera-only: write the lens to this .yml, .xml or .json, for OpenCV.
    """

    validate: bool = False
    camera_only: bool = False
    out: Path | None = None


def run_calibrate(calibrate: Function, arguments: Arguments) -> None:
    """Calibrate the rig, or the camera alone with --camera-only; compare the models with
    --validate."""
    options, json_file = take_options(arguments, CalibrateOptions), arguments.pop("json")
    if options.camera_only:
        from slviewer.pipeline.calibrate_camera import calibrate_camera_alone

        chosen = {name: arguments[name] for name in ("target", "poses", "exclude")}
        source, out = arguments["session"], options.out
        result = call(calibrate_camera_alone, source=source, out=out, **chosen)
    elif options.out is not None:
        raise UsageError(
            "--out belongs to --camera-only: `slviewer export calibration` writes the rig's"
            " calibration"
        )
    else:
        result = call(calibrate, **arguments)
    data = result.to_json()
    terminal.print_result(result.text())
    if options.validate and not options.camera_only:
        from slviewer.pipeline.validate import validate

        compared = call(validate, session=arguments["session"], models=arguments["models"])
        data |= compared.to_json()
        terminal.print_result(compared.text())
    if not options.camera_only:
        from slviewer.pipeline.models import describe_default_model

        terminal.print_result(describe_default_model(arguments["session"]))
    write_json(json_file, data)
