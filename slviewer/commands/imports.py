"""`slviewer import`: one command a layout, and the calibrations that other tools made."""

from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

from slviewer import terminal
from slviewer.commands.command import (
    Arguments,
    Command,
    Function,
    Run,
    Work,
    call,
    read_command,
    take_options,
    union,
)
from slviewer.entry_points import IMPORTERS, list_names
from slviewer.errors import InputError, UsageError


@dataclass(frozen=True)
class SLStudioOptions:
    """What was shown.

    Args:
        codec: What was shown; needed where the number of frames does not determine it.
        axis: Of a codec along a single axis.
    """

    codec: Literal["2x3", "nstep", "3", "4", "gray"] | None = None
    axis: Literal["x", "y"] = "x"


@dataclass(frozen=True)
class FileOptions:
    """Which files are images of the sequence.

    Args:
        files: Pattern of the names to use, such as "pattern_cam1_*"; * and ? are wildcards.
    """

    files: str | None = None


@dataclass(frozen=True)
class SequenceOptions:
    """What describes the images.

    Args:
        sequence: The TOML that says what each file shows, by default the one in the source; the
            reference describes it, and `slviewer patterns` writes one.
    """

    sequence: Path | None = None


@dataclass(frozen=True)
class GuessOptions:
    """How that description is proposed.

    Args:
        guess: A capture folder, whose TOML is proposed from its images; nothing is imported. Exit
            status 1 where a part of it is unsure.
        out: File for the proposed TOML, by default standard output.
    """

    guess: Path | None = None
    out: Path | None = None


def run_import(layout: str, import_captures: Function, arguments: Arguments) -> None:
    """Import folders of a layout, and print the captures' role and names."""
    from slviewer.pipeline.import_captures import describe_import, detect_layout

    if layout == "detect":
        with suppress(InputError):  # the session may describe the files
            layout = detect_layout(arguments["source"])
            terminal.print_result(f"layout {layout}")
    names = call(import_captures, layout=layout, **arguments)
    terminal.print_result(describe_import(names, arguments["role"]))


def run_frames(import_captures: Function, arguments: Arguments) -> None:
    """Import folders that a TOML describes, or propose that TOML."""
    options = take_options(arguments, GuessOptions)
    source, session, sequence = (arguments[name] for name in ("source", "session", "sequence"))
    if options.guess is not None:
        if source is not None or sequence is not None:
            raise UsageError(
                "--guess proposes a TOML and imports nothing: give it without SOURCE, SESSION,"
                " --sequence"
            )
        _propose_description(options, arguments["projector"], arguments["channel"])
    elif source is None or session is None:
        raise UsageError("SOURCE or SESSION is missing: give both, or --guess FOLDER for a TOML")
    elif options.out is not None:
        raise UsageError(
            "--out is the file for the TOML of --guess: give --guess FOLDER, or omit --out"
        )
    else:
        run_import("frames", import_captures, arguments)


def run_import_calibration(import_calibration: Function, arguments: Arguments) -> None:
    """Import a calibration, and print what was read from its file."""
    from slviewer.pipeline.import_captures import identify_calibration_keys

    if arguments["keys"] is None:
        identified = identify_calibration_keys(arguments["file"])
        terminal.print_result(
            "read from the file: "
            + ", ".join(f"{entry} = {key}" for entry, key in identified.items())
        )
    model = call(import_calibration, **arguments)
    if model is None:
        terminal.print_result("stereo calibration imported; import the scans that it belongs to")
        return
    (cw, ch), (pw, ph) = model.rig.camera.size, model.rig.projector.size
    terminal.print_result(
        f"stereo calibration imported: camera {cw}x{ch}, projector {pw}x{ph}, baseline"
        f" {model.baseline_mm:.1f} mm"
    )


def _propose_description(options: GuessOptions, projector: str | None, channel: Any) -> None:
    """Write the proposed TOML of a capture folder to ``out`` or standard output. Raises InputError
    for doubts."""
    from slviewer.session.importers.frames import guess_description

    assert options.guess is not None
    guessed = guess_description(options.guess, projector, channel)
    if (out := options.out) is None:
        print(guessed.toml, end="")
    else:
        out.parent.mkdir(parents=True, exist_ok=True)
        out.write_text(guessed.toml, encoding="utf-8")
        terminal.print_result(f"written to {out}")
    if guessed.doubts:
        raise InputError(
            f"unsure: {'; '.join(guessed.doubts)}. Correct the entries marked UNSURE in the TOML"
        )


def _make_captures_command(
    layout: str,
    description: str,
    *options: str,
    run: Run | None = None,
    optional: tuple[str, ...] = (),
) -> Command:
    """Return the import command of a layout."""
    return read_command(
        "pipeline.import_captures:import_captures",
        "source",
        description=description,
        options=options,
        optional=optional,
        run=run or partial(run_import, layout),
    )


def make_import_command() -> Command:
    """Return the command with one subcommand a layout."""
    layouts = {
        "auto": _make_captures_command(
            "detect",
            "Import folders whose layout is known by their file names, or by a TOML that lies in"
            " the folder.",
        ),
        "p18": _make_captures_command(
            "p18",
            "Import folders of the p18 layout: pose_XX/{V,H}/P18_FNN.PNG, 18 phase steps and 7 Gray"
            " bits an axis.\n\nA projector of 912x1140 pixels is assumed in a new session.",
        ),
        "procam-calibration": _make_captures_command(
            "procam-calibration",
            "Import folders of the procam-calibration layout: capture_N/graycode_NN.*, Gray code"
            " with inverses, white, black.\n\nA projector of 1024x768 pixels is assumed in a new"
            " session.",
        ),
        "opencv-graycode": _make_captures_command(
            "opencv-graycode",
            "Import the images of OpenCV's structured_light GrayCodePattern: columns, then rows,"
            " each bit with its inverse.\n\nImages are read in natural order of their names.",
            "commands.imports:FileOptions",
        ),
        "sltk": _make_captures_command(
            "sltk",
            "Import folders of the sltk layout: TIME_[AA-BB-CC_NN]_img.jpg, Gray code with"
            " inverses.",
        ),
        "slstudio": _make_captures_command(
            "slstudio",
            "Import the frames that SLStudio writes: frameSeq_NN.bmp.\n\nWith the diamond pattern,"
            " the projector's size has twice its columns.",
            "commands.imports:SLStudioOptions",
        ),
        "frames": _make_captures_command(
            "frames",
            "Import any folder of images with a TOML that describes them, or propose that TOML with"
            " --guess FOLDER.",
            "commands.imports:SequenceOptions",
            "commands.imports:GuessOptions",
            run=run_frames,
            optional=("source", "session"),
        ),
        "opencv-calibration": read_command(
            "pipeline.import_captures:import_opencv_calibration",
            "file",
            run=run_import_calibration,
        ),
    }

    def import_command(command: Any) -> Work:
        """Import captures or calibrations that other tools made."""
        return command  # type: ignore[no-any-return]

    for name in sorted(set(list_names(IMPORTERS)) - layouts.keys()):
        layouts[name] = _make_captures_command(
            name, f"Import folders of the layout {name}, which a plugin reads."
        )
    import_command.__annotations__["command"] = union(layouts)
    return import_command
