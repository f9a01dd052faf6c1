"""Bringing in what other tools made."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from tyro.conf import Positional

from slviewer import workflow
from slviewer.commands.parsing import Role, deferred, ui, union


@deferred
def _import_p18(
    source: Positional[Path],
    session: Positional[Path],
    role: Role = "calibration",
    prefix: str | None = None,
    projector: str = "912x1140",
    force: bool = False,
    strict: bool = False,
) -> None:
    """Import folders of the p18 layout: pose_XX/{V,H}/P18_FNN.PNG, 18 phase steps and 7 Gray bits an axis.

    Args:
        source: One pose folder, or a folder of them.
        session: Session folder; made if it does not exist.
        role: calibration for target poses, scan for anything else.
        prefix: Put before each capture's name: planes gives planes_pose_03.
        projector: Width x height of the projector, px.
        force: Replace captures of the same name (the old ones go to the session's trash).
        strict: Import nothing where one capture cannot be used, instead of skipping it with a warning.
    """
    _say_imported(
        workflow.import_p18(
            source, session, role=role, prefix=prefix, projector=projector, force=force, strict=strict, **ui()
        )
    )


@deferred
def _import_procam_calibration(
    source: Positional[Path],
    session: Positional[Path],
    role: Role = "calibration",
    prefix: str | None = None,
    projector: str = "1024x768",
    force: bool = False,
    strict: bool = False,
) -> None:
    """Import folders of the procam-calibration layout: capture_N/graycode_NN.*, Gray code with inverses, white, black.

    Args:
        source: One capture folder, or a folder of them.
        session: Session folder; made if it does not exist.
        role: calibration for target poses, scan for anything else.
        prefix: Put before each capture's name.
        projector: Width x height of the projector, px.
        force: Replace captures of the same name (the old ones go to the session's trash).
        strict: Import nothing where one capture cannot be used, instead of skipping it with a warning.
    """
    _say_imported(
        workflow.import_procam_calibration(
            source, session, role=role, prefix=prefix, projector=projector, force=force, strict=strict, **ui()
        )
    )


@deferred
def _import_frames(
    source: Positional[Path],
    session: Positional[Path],
    sequence: Path,
    role: Role = "calibration",
    prefix: str | None = None,
    projector: str | None = None,
    force: bool = False,
    strict: bool = False,
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
        strict: Import nothing where one capture cannot be used, instead of skipping it with a warning.
    """
    _say_imported(
        workflow.import_frames(
            source, session, sequence, role=role, prefix=prefix, projector=projector, force=force, strict=strict, **ui()
        )
    )


@deferred
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
    model = workflow.import_opencv_calibration(file, session, keys, projector=projector, camera=camera, force=force)
    baseline = f": baseline {model.baseline_mm:.1f} mm" if model else "; import the scans that it belongs to"
    print(f"stereo calibration imported{baseline}")


def bring_in(command: Any) -> Callable[[], None]:
    """Import captures or calibrations that other tools made."""
    run: Callable[[], None] = command
    return run


bring_in.__annotations__["command"] = union(
    {
        "p18": _import_p18,
        "procam-calibration": _import_procam_calibration,
        "frames": _import_frames,
        "opencv-calibration": _import_opencv_calibration,
    }
)


def _say_imported(names: list[str]) -> None:
    print(f"{len(names)} capture{'s' * (len(names) != 1)} imported: {', '.join(names)}")
