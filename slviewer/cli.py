"""The command line: every command is the public function of the same name in ``slviewer.workflow``, and its words.

Results go to standard output, progress and warnings to standard error. Exit status: 0 done, 1 failed, 2 usage,
3 calibration rejected, 130 cancelled. Nothing heavy is imported before a command needs it.
"""

import functools
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal, Union

import tyro
from tyro.conf import Positional

from slviewer import __version__, terminal
from slviewer.errors import Cancelled, SlviewerError

Axis = Literal["x", "y"]
ModelName = Literal["stereo", "pixelwise"]
Role = Literal["calibration", "scan"]


def _deferred(command: Callable[..., None]) -> Callable[..., Callable[[], None]]:
    """Parsing ends before the command runs, so that no error of the command is taken for one of its arguments."""

    @functools.wraps(command)
    def parse(*args: Any, **kwargs: Any) -> Callable[[], None]:
        return functools.partial(command, *args, **kwargs)

    return parse


@_deferred
def _import_p18(
    source: Positional[Path],
    session: Positional[Path],
    role: Role = "calibration",
    prefix: str | None = None,
    projector: str = "912x1140",
    force: bool = False,
) -> None:
    """Import folders of the p18 layout: pose_XX/{V,H}/P18_FNN.PNG, 18 phase steps and 7 Gray bits an axis.

    Args:
        source: One pose folder, or a folder of them.
        session: Session folder; made if it does not exist.
        role: calibration for target poses, scan for anything else.
        prefix: Put before each capture's name: planes gives planes_pose_03.
        projector: Width x height of the projector, px.
        force: Replace captures of the same name (the old ones go to the session's trash).
    """
    from slviewer.workflow import import_p18

    _say_imported(import_p18(source, session, role=role, prefix=prefix, projector=projector, force=force, **_ui()))


@_deferred
def _import_procam_calibration(
    source: Positional[Path],
    session: Positional[Path],
    role: Role = "calibration",
    prefix: str | None = None,
    projector: str = "1024x768",
    force: bool = False,
) -> None:
    """Import folders of the procam-calibration layout: capture_N/graycode_NN.*, Gray code with inverses, white, black.

    Args:
        source: One capture folder, or a folder of them.
        session: Session folder; made if it does not exist.
        role: calibration for target poses, scan for anything else.
        prefix: Put before each capture's name.
        projector: Width x height of the projector, px.
        force: Replace captures of the same name (the old ones go to the session's trash).
    """
    from slviewer.workflow import import_procam_calibration

    _say_imported(
        import_procam_calibration(source, session, role=role, prefix=prefix, projector=projector, force=force, **_ui())
    )


@_deferred
def _import_frames(
    source: Positional[Path],
    session: Positional[Path],
    sequence: Path,
    role: Role = "calibration",
    prefix: str | None = None,
    projector: str | None = None,
    force: bool = False,
) -> None:
    """Import any folder of images with a TOML that names each frame.

    Args:
        source: One folder of images, or a folder of such folders.
        session: Session folder; made if it does not exist.
        sequence: The TOML that says what each file shows; the README describes it, and `slviewer patterns` writes one.
        role: calibration for target poses, scan for anything else.
        prefix: Put before each capture's name.
        projector: Width x height of the projector, px, where the TOML does not say it.
        force: Replace captures of the same name (the old ones go to the session's trash).
    """
    from slviewer.workflow import import_frames

    _say_imported(
        import_frames(source, session, sequence, role=role, prefix=prefix, projector=projector, force=force, **_ui())
    )


@_deferred
def _import_opencv_calibration(
    file: Positional[Path],
    session: Positional[Path],
    keys: tuple[str, str, str, str, str, str],
    projector: str | None = None,
    camera: str | None = None,
    force: bool = False,
) -> None:
    """Import a stereo calibration made elsewhere, from an OpenCV FileStorage file.

    Args:
        file: The .yml, .xml or .json file.
        session: Session folder; made if it does not exist.
        keys: The file's names for the matrices K_camera D_camera K_projector D_projector R T; R and T (mm) map camera
            to projector.
        projector: Width x height of the projector, px; by default the one of the session's captures.
        camera: Width x height of the camera, px; by default the one of the session's captures.
        force: Replace the session's stereo calibration (the old one goes to the session's trash).
    """
    from slviewer.workflow import import_opencv_calibration

    model = import_opencv_calibration(file, session, keys, projector=projector, camera=camera, force=force)
    baseline = f": baseline {model.baseline_mm:.1f} mm" if model else "; import the scans that it belongs to"
    print(f"stereo calibration imported{baseline}")


@_deferred
def _calibrate(
    session: Positional[Path],
    target: str,
    models: tuple[ModelName, ...] = ("stereo", "pixelwise"),
    smoothing: Literal["spline", "polynomial"] = "spline",
    degree: int = 5,
    json: Path | None = None,
) -> None:
    """Calibrate from the session's target poses.

    Args:
        session: Session folder.
        target: circles:21x16:9 (columns x rows : pitch mm), acircles:…, chessboard:9x7:75 (inner corners : square mm),
            charuco:….
        models: Which models to fit.
        smoothing: How the Letter's step 2 smooths a board's phase; the spline keeps the local distortion.
        degree: Degree of the polynomial, with --smoothing polynomial.
        json: Write the result to this file too.
    """
    from slviewer.workflow import calibrate

    result = calibrate(session, target, models=models, smoothing=smoothing, degree=degree, **_ui())
    _write_json(json, result.to_json())
    print(result.text())


@_deferred
def _reconstruct(
    session: Positional[Path],
    capture: Positional[str],
    model: ModelName | None = None,
    axis: Axis | None = None,
    out: Path | None = None,
    grid: Path | None = None,
) -> None:
    """Reconstruct a capture as a cloud; a board pose also says how flat each model measures the board.

    Args:
        session: Session folder.
        capture: Name of the capture.
        model: Which calibration to use; by default the best one available.
        axis: Which pattern axis gives the depth; by default the one with the smaller predicted noise.
        out: PLY file; by default in the session's exports. That of a board pose holds the points inside the board's
            outline.
        grid: Also write the whole organised cloud, (h, w, 3) float32 mm, NaN where invalid, as .npy.
    """
    from slviewer.workflow import reconstruct

    print(reconstruct(session, capture, model=model, axis=axis, out=out, grid=grid, **_ui()).text())


@_deferred
def _verify(
    session: Positional[Path],
    captures: Positional[tuple[str, ...]],
    shape: Literal["plane", "sphere"],
    model: tuple[ModelName, ...] = (),
    range: tuple[float, float] | None = None,
    radius: float | None = None,
    axis: Axis | None = None,
    json: Path | None = None,
) -> None:
    """Measure captures of a plane or a sphere with each model, and compare.

    Args:
        session: Session folder.
        captures: Names of the captures.
        shape: What the captures show.
        model: Which calibrations to compare; by default all there are.
        range: Near and far end of the calibrated depths R2, mm; by default those of the board poses.
        radius: Nominal radius of the sphere, mm: helps to find it; the fitted radius stays free.
        axis: Which pattern axis gives the depth; by default the one with the smaller predicted noise.
        json: Write the result to this file too.
    """
    from slviewer.workflow import verify

    result = verify(session, captures, shape, models=model, depth_range=range, radius=radius, axis=axis, **_ui())
    _write_json(json, result.to_json())
    print(result.text())


@_deferred
def _merge(
    session: Positional[Path],
    captures: Positional[tuple[str, ...]],
    reference: str,
    out: Path,
    model: ModelName | None = None,
    json: Path | None = None,
) -> None:
    """Register scans to a reference scan by ICP, and merge them into one cloud.

    Args:
        session: Session folder.
        captures: Names of the captures.
        reference: The capture whose frame the merged cloud takes.
        out: PLY file.
        model: Which calibration to use; by default the best one available.
        json: Write the registrations to this file too.
    """
    from slviewer.workflow import merge

    result = merge(session, captures, reference, out, model=model, **_ui())
    _write_json(json, result.to_json())
    print(result.text())


@_deferred
def _simulate(
    session: Positional[Path],
    preset: Literal["letter"] = "letter",
    scale: float = 1.0,
    poses: int = 25,
    seed: int = 0,
) -> None:
    """Fill a new session with captures of a simulated rig: target poses, planes, spheres, an object at three depths.

    Args:
        session: Session folder to make.
        preset: Which rig.
        scale: Resolution of the camera, as a share of the preset's.
        poses: How many target poses.
        seed: Another seed is another rig of the same kind.
    """
    from slviewer.workflow import simulate

    names = simulate(session, preset=preset, scale=scale, poses=poses, seed=seed, **_ui())
    print(f"{len(names)} captures simulated into {session}")


@_deferred
def _reproduce(
    quick: bool = False,
    out: Path | None = None,
    json: Path | None = None,
    seed: int = 0,
) -> None:
    """Repeat the Letter's experiments on the simulated rig, and put its figures beside ours.

    Args:
        quick: Half resolution; its figures are its own.
        out: Folder for the session and the report; by default reproduction, or reproduction-quick.
        json: Write the figures to this file too.
        seed: Another seed is another rig of the same kind.
    """
    from slviewer.workflow import reproduce

    folder = out or Path("reproduction-quick" if quick else "reproduction")
    result = reproduce(folder, quick=quick, seed=seed, **_ui())
    _write_json(json, result.to_json())
    print(result.text())


@_deferred
def _patterns(preset: str, projector: str, out: Path) -> None:
    """Write the images of a pattern sequence, and the TOML that `import frames` reads.

    Args:
        preset: p18, complementary, gray or multifrequency.
        projector: Width x height of the projector, px.
        out: Folder to make.
    """
    from slviewer.workflow import patterns

    print(f"{patterns(preset, projector, out)} patterns written to {out}")


@_deferred
def _target(board: Positional[str], out: Path) -> None:
    """Draw a printable target to exact scale.

    Args:
        board: circles:21x16:9, acircles:…, chessboard:9x7:75 or charuco:….
        out: A .pdf or .svg file.
    """
    from slviewer.workflow import target

    target(board, out)
    print(f"{board} drawn to {out}: print at 100 %, and measure it")


@_deferred
def _report(session: Positional[Path], out: Path) -> None:
    """Write one self-contained HTML report of a session.

    Args:
        session: Session folder.
        out: The .html file.
    """
    from slviewer.workflow import report

    report(session, out, **_ui())
    print(f"report written to {out}")


@_deferred
def _inspect(session: Positional[Path]) -> None:
    """Say what a session holds, and what is stale.

    Args:
        session: Session folder.
    """
    from slviewer.workflow import inspect

    print(inspect(session))


@_deferred
def _bench(calibration: bool = False, scale: float = 1.0, json: Path | None = None) -> None:
    """Time the main stages on this machine, beside what they cannot beat.

    Args:
        calibration: Also simulate and calibrate 25 poses (minutes, and 3.5 GB of disk at full size).
        scale: Resolution of the camera, as a share of 1600x1200.
        json: Write the figures to this file too.
    """
    from slviewer.workflow import bench

    result = bench(calibration=calibration, scale=scale, progress=terminal.progress)
    _write_json(json, result.to_json())
    print(result.text())


@_deferred
def _wizard(
    session: Positional[Path | None] = None,
    rig: str = "",
    host: str = "127.0.0.1",
    port: int = 8080,
    no_browser: bool = False,
) -> None:
    """Start the wizard in the browser: from an unknown rig to a merged mesh. Plain `slviewer` does the same.

    Args:
        session: Session folder, made if it does not exist; by default slviewer-session, here.
        rig: simulated (half resolution), simulated:0.25 and the like, or a driver's name; by default the one that the
            session remembers, else the simulated one.
        host: Address to serve at; any other than the default lets others on the network try.
        port: Port to serve at; 0 takes any free one.
        no_browser: Print the address, and open no browser.
    """
    from slviewer.gui.app import run

    run(session, rig, host, port, open_browser=not no_browser)


def _union(commands: dict[str, Callable[..., Any]]) -> Any:
    choices = [Annotated[Any, tyro.conf.subcommand(name=name, constructor=f)] for name, f in commands.items()]
    return Union[tuple(choices)]  # noqa: UP007 (built at run time)


def _import(command: Any) -> Callable[[], None]:
    """Import captures or calibrations that other tools made."""
    run: Callable[[], None] = command
    return run


_import.__annotations__["command"] = _union(
    {
        "p18": _import_p18,
        "procam-calibration": _import_procam_calibration,
        "frames": _import_frames,
        "opencv-calibration": _import_opencv_calibration,
    }
)

COMMANDS: dict[str, Callable[..., Any]] = {
    "wizard": _wizard,
    "import": _import,
    "calibrate": _calibrate,
    "reconstruct": _reconstruct,
    "verify": _verify,
    "merge": _merge,
    "simulate": _simulate,
    "reproduce": _reproduce,
    "patterns": _patterns,
    "target": _target,
    "report": _report,
    "inspect": _inspect,
    "bench": _bench,
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
            _union(COMMANDS),
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


def _say_imported(names: list[str]) -> None:
    print(f"{len(names)} capture{'s' * (len(names) != 1)} imported: {', '.join(names)}")


def _write_json(path: Path | None, data: dict[str, Any]) -> None:
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(data, indent=2) + "\n")


def _ui() -> dict[str, Any]:
    """Callbacks for progress and warnings on standard error."""
    return {"progress": terminal.progress, "warn": terminal.warn}


if __name__ == "__main__":
    sys.exit(main())
