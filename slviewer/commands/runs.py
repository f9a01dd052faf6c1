"""The commands that do more than call their function and show its result: those that serve pages of
devices, imports, the calibration with what may follow it, and the wizard."""

import math
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import arg

from slviewer import terminal
from slviewer.commands.command import (
    JSON,
    Arguments,
    Command,
    Function,
    Run,
    Work,
    call,
    read_command,
    show_result,
    take_options,
    union,
    write_json,
)
from slviewer.entry_points import IMPORTERS, list_names
from slviewer.errors import DeviceError, InputError, UsageError
from slviewer.inputs import Input

if TYPE_CHECKING:
    from slviewer.devices.browser import PageChannels, PageRole
    from slviewer.pipeline.rig_choice import SetUp
    from slviewer.records.calibration import ModelCalibration
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

    port: Annotated[int, Input(0, 65535)] = 8080
    host: str = "127.0.0.1"
    tls: bool = False
    wait_s: Annotated[float, Input(1)] = PAGE_PATIENCE_S


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
    from slviewer.pipeline.report import summarise_capture

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

    checked = take_options(arguments, CheckedOptions)
    if (checked.rig is None) == (checked.capture is None):
        raise UsageError(
            "give --rig to check a rig, or --capture SESSION NAME to check the frames of a capture"
        )
    if checked.capture is not None:
        session, capture = checked.capture
        recorded = {"session": session, "capture": capture, "json": arguments["json"]}
        show_result(check_recorded_rig, recorded)
        return
    with _serve_pages(arguments) as set_up:
        show_result(check_rig, {**arguments, "rig": checked.rig, "set_up": set_up})


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
    for role in needed:
        terminal.print_message(openings[role])
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


@dataclass(frozen=True)
class CalibrateOptions:
    """What `calibrate` takes beside the settings of the pipeline's `calibrate`.

    Args:
        validate: Also compare the models on poses that they were not made from, as `slviewer
            validate` does.
        camera_only: Calibrate the camera's lens alone, from pictures of the board in the session,
            or in a folder in its place; the session stays as it is.
        out: With --camera-only: write the lens to this .yml, .xml or .json, for --camera and for
            OpenCV.
        verbose: Print the figures of each model too.
    """

    validate: bool = False
    camera_only: bool = False
    out: Path | None = None
    verbose: Annotated[bool, arg(aliases=["-v"])] = False


def run_calibrate(calibrate: Function, arguments: Arguments) -> None:
    """Calibrate the rig, or the camera alone with --camera-only, and print the verdict first;
    compare the models with --validate."""
    options, json_file = take_options(arguments, CalibrateOptions), arguments.pop("json")
    if options.camera_only:
        _calibrate_camera(arguments, options.out, json_file)
        return
    if options.out is not None:
        raise UsageError(
            "--out belongs to --camera-only",
            "`slviewer export calibration` writes the rig's calibration",
        )
    from slviewer.geometry.jit_prepare import Preparation
    from slviewer.pipeline.accept import validate
    from slviewer.pipeline.models import describe_default_model

    with Preparation():
        result = call(calibrate, **arguments)
    data = result.to_json()
    terminal.print_result(_summarise_calibration(result))
    if options.verbose:
        terminal.print_result(result.text())
    if options.validate:
        compared = call(validate, session=arguments["session"], models=arguments["models"])
        data |= compared.to_json()
        terminal.print_result(compared.text())
    terminal.print_result(describe_default_model(arguments["session"]))
    write_json(json_file, data)


def _calibrate_camera(arguments: Arguments, out: Path | None, json_file: Path | None) -> None:
    """Calibrate the camera alone, and print its figures, and where its file is."""
    from slviewer.pipeline.calibrate import calibrate_camera_alone

    if arguments["camera"] is not None:
        raise UsageError(
            "--camera is where the calibration of a rig starts, and --camera-only makes such a"
            " file",
            "omit one of them",
        )
    source, target = arguments["session"], arguments["target"]
    chosen = {name: arguments[name] for name in ("poses", "exclude")}
    result = call(calibrate_camera_alone, source=source, target=target, out=out, **chosen)
    terminal.print_result(result.text())
    if out is not None:
        terminal.print_result(
            f"written to {out}; next: slviewer calibrate SESSION --target {target} --camera {out}"
            " [--fix-camera]"
        )
    write_json(json_file, result.to_json())


def _summarise_calibration(found: Mapping[str, "ModelCalibration"]) -> str:
    """Return the verdict, a line for each model, and the excluded poses with their reasons."""
    stereo = found["stereo"]
    lines = [] if stereo.verdict is None else [stereo.verdict.text()]
    lines += [f"{name}: {each.fit.summary()}" for name, each in found.items() if each.fit]
    excluded = getattr(stereo.fit, "excluded", {})
    lines += [f"excluded: {name}: {why}" for name, why in excluded.items()]
    return "\n".join([*lines, "figures of each model: -v"])


@dataclass(frozen=True)
class ReproduceOptions:
    """What `reproduce` takes beside the parameters of its function.

    Args:
        clean: Compute nothing, and remove the session and the merged cloud of an earlier run from
            the folder; its report stays.
    """

    clean: bool = False


def run_reproduce(reproduce: Function, arguments: Arguments) -> None:
    """Reproduce the Letter's experiments, saying first how much disk they take; or remove what an
    earlier run left."""
    if take_options(arguments, ReproduceOptions).clean:
        from slviewer.validation.reproduce import choose_folder, clean_reproduction

        folder = choose_folder(arguments["out"], arguments["quick"])
        terminal.print_result(clean_reproduction(folder))
    else:
        from slviewer.geometry.jit_prepare import Preparation

        with Preparation():
            show_result(reproduce, {**arguments, "say": terminal.print_message})


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
class CellOptions:
    """How the code numbers the projector.

    Args:
        cell: Width of the cells that the Gray code numbers, px of the projector.
    """

    cell: int = 1


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
            status 1 where an image is not identified.
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
    """Import folders that a TOML describes, or propose that TOML, to ``out`` or standard output.
    Raises InputError for doubts."""
    from slviewer.session.importers.guessed_frames import guess_description

    options = take_options(arguments, GuessOptions)
    guess, out = options.guess, options.out
    source, session, sequence = (arguments[name] for name in ("source", "session", "sequence"))
    if guess is None:
        if source is None or session is None:
            raise UsageError(
                "SOURCE or SESSION is missing", "give both, or --guess FOLDER for a TOML"
            )
        if out is not None:
            raise UsageError(
                "--out is the file for the TOML of --guess", "give --guess FOLDER, or omit --out"
            )
        run_import("frames", import_captures, arguments)
        return
    if source is not None or sequence is not None:
        raise UsageError(
            "--guess proposes a TOML and imports nothing",
            "give it without SOURCE, SESSION, --sequence",
        )
    guessed = guess_description(guess, arguments["projector"], arguments["channel"])
    if out is None:
        print(guessed.toml, end="")
    else:
        out.parent.mkdir(parents=True, exist_ok=True)
        out.write_text(guessed.toml, encoding="utf-8")
        terminal.print_result("\n  ".join([f"written to {out}:", *guessed.summary]))
    unsure = f"unsure: {'; '.join(guessed.doubts)}. Correct the entries marked UNSURE in the TOML"
    if not guessed.is_complete:
        raise InputError(unsure)
    if guessed.doubts:
        terminal.warn(unsure)


def run_import_calibration(import_calibration: Function, arguments: Arguments) -> None:
    """Import a calibration, and print what was read from its file."""
    from slviewer.pipeline.import_captures import identify_calibration_keys
    from slviewer.pipeline.imported_verdict import judge_imported
    from slviewer.pipeline.operation import opened

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
    with opened(arguments["session"]) as store:
        verdict = judge_imported(store)
        for finding in () if verdict is None or verdict.level != "good" else verdict.findings:
            terminal.print_result(finding.text())


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
            "commands.runs:CellOptions",
        ),
        "opencv-graycode": _make_captures_command(
            "opencv-graycode",
            "Import the images of OpenCV's structured_light GrayCodePattern: columns, then rows,"
            " each bit with its inverse.\n\nImages are read in natural order of their names.",
            "commands.runs:FileOptions",
            "commands.runs:CellOptions",
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
            "commands.runs:SLStudioOptions",
        ),
        "frames": _make_captures_command(
            "frames",
            "Import any folder of images with a TOML that describes them, or propose that TOML with"
            " --guess FOLDER.",
            "commands.runs:SequenceOptions",
            "commands.runs:GuessOptions",
            run=run_frames,
            optional=("source", "session"),
        ),
        "opencv-calibration": read_command(
            "pipeline.import_captures:import_opencv_calibration",
            "file",
            run=run_import_calibration,
        ),
        "cloud": read_command("pipeline.import_cloud:import_cloud", "files", options=JSON),
        "poses": read_command("pipeline.machine_poses:import_poses", "file", options=JSON),
    }

    def import_command(command: Any) -> Work:
        """Import captures, calibrations or clouds that other tools made."""
        return command  # type: ignore[no-any-return]

    for name in sorted(set(list_names(IMPORTERS)) - layouts.keys()):
        layouts[name] = _make_captures_command(
            name, f"Import folders of the layout {name}, which a plugin reads."
        )
    import_command.__annotations__["command"] = union(layouts)
    options = set().union(*(each.options for each in layouts.values()))  # type: ignore[attr-defined]
    import_command.options = options  # type: ignore[attr-defined]
    return import_command


@dataclass(frozen=True)
class Address:
    """Where and how to serve the page.

    Args:
        host: Address to serve at; any other than the default lets others on the network try.
        port: Port to serve at; 0 takes any free one.
        name: Further host names under which browsers reach this server, such as scanner.lab, behind
            a proxy.
        tls: Encrypt, with a certificate that slviewer makes; its fingerprint is printed.
        tls_files: Encrypt, with this certificate and this key (PEM files).
        token_file: TOML file with the tokens of the links, which so stay the same; made if it does
            not exist.
    """

    host: str = "127.0.0.1"
    port: int = 8080
    name: tuple[str, ...] = ()
    tls: bool = False
    tls_files: tuple[Path, Path] | None = None
    token_file: Path | None = None


def wizard(
    serving: "Serving",
    session: Path | None = None,
    rig: str = "",
    no_browser: bool = False,
    gpu: bool = False,
) -> None:
    """Start the wizard in the browser: from an unknown rig to a merged mesh. Plain `slviewer` does
    the same.

    Args:
        session: Session folder, made if it does not exist; by default the page begins with the
            recent sessions, and makes new ones in the folder slviewer of your documents.
        rig: simulated (half resolution), simulated:0.25 or a driver; by default that of the
            session, else simulated.
        no_browser: Print the address, and open no browser.
        gpu: Compute live scans on the CUDA device, once it has measured what the processor does.
    """
    from slviewer.geometry.cuda_device import use_device
    from slviewer.gui.app import run

    use_device(gpu)
    run(session, rig, serving, open_browser=not no_browser)


def run_wizard(wizard: Function, arguments: Arguments) -> None:
    """Start the wizard at the address that the options state."""
    from slviewer.server.secure import Serving

    address = take_options(arguments, Address)
    wizard(Serving(*vars(address).values()), **arguments)
