"""Bringing in what other tools made."""

from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from tyro.conf import Positional

from slviewer import terminal
from slviewer.commands.parsing import Axis, Role, deferred, ui, union
from slviewer.errors import InputError, UsageError

Channel = Literal["red", "green", "blue", "luma", "max"]
Codec = Literal["2x3", "nstep", "3", "4", "gray"]


@dataclass(frozen=True)
class _Common:
    """What the import of every layout takes."""

    role: Role = "calibration"
    """calibration for target poses, scan for anything else."""
    prefix: str | None = None
    """Put before each capture's name: planes gives planes_pose_03."""
    channel: Channel | None = None
    """Of colour images; green where nothing states it."""
    force: bool = False
    """Replace captures of the same name (the old ones go to the session's trash)."""
    strict: bool = False
    """Import nothing where one capture cannot be used, instead of skipping it with a warning."""


_COMMON = _Common()


@deferred
def _import_auto(
    source: Positional[Path], session: Positional[Path], projector: str | None = None, common: _Common = _COMMON
) -> None:
    """Import folders whose layout is told by their file names, or by a TOML that lies in the folder.

    Args:
        source: One capture folder, or a folder of them.
        session: Session folder; made if it does not exist.
        projector: Width x height of the projector, px; by default the layout's, or what the session knows.
        common: What every layout takes.
    """
    _import(source, session, "detect", common, projector=projector)


@deferred
def _import_p18(
    source: Positional[Path], session: Positional[Path], projector: str = "912x1140", common: _Common = _COMMON
) -> None:
    """Import folders of the p18 layout: pose_XX/{V,H}/P18_FNN.PNG, 18 phase steps and 7 Gray bits an axis.

    Args:
        source: One pose folder, or a folder of them.
        session: Session folder; made if it does not exist.
        projector: Width x height of the projector, px.
        common: What every layout takes.
    """
    _import(source, session, "p18", common, projector=projector)


@deferred
def _import_procam_calibration(
    source: Positional[Path], session: Positional[Path], projector: str = "1024x768", common: _Common = _COMMON
) -> None:
    """Import folders of the procam-calibration layout: capture_N/graycode_NN.*, Gray code with inverses, white, black.

    Args:
        source: One capture folder, or a folder of them.
        session: Session folder; made if it does not exist.
        projector: Width x height of the projector, px.
        common: What every layout takes.
    """
    _import(source, session, "procam-calibration", common, projector=projector)


@deferred
def _import_opencv_graycode(
    source: Positional[Path],
    session: Positional[Path],
    projector: str | None = None,
    files: str | None = None,
    common: _Common = _COMMON,
) -> None:
    """Import the images of OpenCV's structured_light GrayCodePattern: columns, then rows, each bit with its inverse.

    Args:
        source: One capture folder, or a folder of them; images are taken in natural order of their names.
        session: Session folder; made if it does not exist.
        projector: Width x height of the projector, px; by default what the session knows.
        files: Pattern of the names to take, such as "pattern_cam1_*"; * and ? are wildcards.
        common: What every layout takes.
    """
    _import(source, session, "opencv-graycode", common, projector=projector, files=files)


@deferred
def _import_sltk(
    source: Positional[Path], session: Positional[Path], projector: str | None = None, common: _Common = _COMMON
) -> None:
    """Import folders of the sltk layout: TIME_[AA-BB-CC_NN]_img.jpg, Gray code with inverses.

    Args:
        source: One capture folder, or a folder of them.
        session: Session folder; made if it does not exist.
        projector: Width x height of the projector, px; by default what the session knows.
        common: What every layout takes.
    """
    _import(source, session, "sltk", common, projector=projector)


@deferred
def _import_slstudio(
    source: Positional[Path],
    session: Positional[Path],
    projector: str | None = None,
    codec: Codec | None = None,
    axis: Axis = "x",
    common: _Common = _COMMON,
) -> None:
    """Import the frames that SLStudio writes: frameSeq_NN.bmp.

    Args:
        source: One capture folder, or a folder of them.
        session: Session folder; made if it does not exist.
        projector: Width x height of the projector, px (with the diamond pattern twice its columns); by default what
            the session knows.
        codec: What was shown; needed where the number of frames does not tell it.
        axis: Of a codec along a single axis.
        common: What every layout takes.
    """
    _import(source, session, "slstudio", common, projector=projector, codec=codec, axis=axis)


@deferred
def _import_frames(
    source: Positional[Path | None] = None,
    session: Positional[Path | None] = None,
    sequence: Path | None = None,
    projector: str | None = None,
    guess: Path | None = None,
    out: Path | None = None,
    common: _Common = _COMMON,
) -> None:
    """Import any folder of images with a TOML that describes them, or propose that TOML with --guess FOLDER.

    Args:
        source: One folder of images, or a folder of such folders.
        session: Session folder; made if it does not exist.
        sequence: The TOML that says what each file shows, by default the one in the source; the README describes it,
            and `slviewer patterns` writes one.
        projector: Width x height of the projector, px, where the TOML does not say it.
        guess: A capture folder, whose TOML is proposed from its images; nothing is imported. Exit status 1 where a part
            of it is unsure.
        out: File for the proposed TOML, by default standard output.
        common: What every layout takes.
    """
    if guess is not None:
        if source is not None or sequence is not None:
            raise UsageError("--guess proposes a TOML and imports nothing: give it without SOURCE, SESSION, --sequence")
        _propose(guess, out, projector, common.channel)
        return
    if source is None or session is None:
        raise UsageError("SOURCE or SESSION is missing: give both, or --guess FOLDER for a TOML")
    if out is not None:
        raise UsageError("--out is the file for the TOML of --guess: give --guess FOLDER, or leave --out away")
    _import(source, session, "frames", common, sequence=sequence, projector=projector)


@deferred
def _import_opencv_calibration(
    file: Positional[Path],
    session: Positional[Path],
    keys: tuple[str, str, str, str, str, str] | None = None,
    projector: str | None = None,
    camera: str | None = None,
    force: bool = False,
) -> None:
    """Import a stereo calibration made elsewhere, from an OpenCV FileStorage file.

    Args:
        file: The .yml, .xml or .json file.
        session: Session folder; made if it does not exist.
        keys: The file's names for the matrices K_camera D_camera K_projector D_projector R T; R and T (mm) map camera
            to projector. By default the common names are recognised, and what was taken is printed.
        projector: Width x height of the projector, px; by default what the file states, else the session's captures.
        camera: Width x height of the camera, px; by default what the file states, else the session's captures.
        force: Replace the session's stereo calibration (the old one goes to the session's trash).
    """
    from slviewer.pipeline import import_calibration

    if keys is None:
        identified = import_calibration.identify_calibration_keys(file)
        print("taken from the file: " + ", ".join(f"{entry} = {key}" for entry, key in identified.items()))
    model = import_calibration.import_opencv_calibration(
        file, session, keys, projector=projector, camera=camera, force=force, warn=terminal.warn
    )
    if model is None:
        print("stereo calibration imported; import the scans that it belongs to")
        return
    sizes = (
        f"{name} {w}x{h}"
        for name, (w, h) in (("camera", model.rig.camera.size), ("projector", model.rig.projector.size))
    )
    print(f"stereo calibration imported: {', '.join(sizes)}, baseline {model.baseline_mm:.1f} mm")


def import_command(command: Any) -> Callable[[], None]:
    """Import captures or calibrations that other tools made."""
    run: Callable[[], None] = command
    return run


import_command.__annotations__["command"] = union(
    {
        "auto": _import_auto,
        "p18": _import_p18,
        "procam-calibration": _import_procam_calibration,
        "opencv-graycode": _import_opencv_graycode,
        "sltk": _import_sltk,
        "slstudio": _import_slstudio,
        "frames": _import_frames,
        "opencv-calibration": _import_opencv_calibration,
    }
)


def _propose(folder: Path, out: Path | None, projector: str | None, channel: Channel | None) -> None:
    from slviewer.pipeline import import_captures

    guessed = import_captures.guess_description(folder, projector=projector, channel=channel)
    if out is None:
        print(guessed.toml, end="")
    else:
        out.parent.mkdir(parents=True, exist_ok=True)
        out.write_text(guessed.toml, encoding="utf-8")
        print(f"written to {out}")
    if guessed.doubts:
        raise InputError(f"unsure: {'; '.join(guessed.doubts)}. Correct the entries marked UNSURE in the TOML")


def _import(source: Path, session: Path, layout: str, common: _Common, **options: Any) -> None:
    from slviewer.pipeline import import_captures

    if layout == "detect":
        layout = import_captures.detect_layout(source)
        print(f"layout {layout}")
    names = import_captures.import_captures(source, session, layout, **asdict(common), **options, **ui())
    print(f"{len(names)} capture{'s' * (len(names) != 1)} imported: {', '.join(names)}")
