"""Making a calibration from elsewhere the session's own, once it agrees with itself and with the
session's captures."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from slviewer.calibration.stereo import StereoModel
from slviewer.errors import InputError
from slviewer.fringe.sequence import parse_size
from slviewer.geometry.lens import Lens
from slviewer.geometry.rig import StereoRig
from slviewer.pipeline.capture_phases import decode_capture
from slviewer.pipeline.feedback import Warn, ignore_warnings
from slviewer.pipeline.models import available_models, save_imported_stereo, trash_models
from slviewer.pipeline.open_session import opened_or_made
from slviewer.reconstruction.axis_agreement import check_phases
from slviewer.session.capture import Capture
from slviewer.session.importers import opencv_calibration
from slviewer.session.importers.filestorage import read_storage

Size = str | tuple[int, int]
Keys = tuple[str, str, str, str, str, str]


def import_opencv_calibration(
    file: Path | str,
    session: Path | str,
    keys: Keys | None = None,
    *,
    projector: Size | None = None,
    camera: Size | None = None,
    force: bool = False,
    warn: Warn = ignore_warnings,
) -> StereoModel | None:
    """Import a stereo calibration made elsewhere, from an OpenCV FileStorage file.

    Args:
        file: The .yml, .xml or .json file.
        session: Session folder; made if it does not exist.
        keys: The file's names for the matrices K_camera D_camera K_projector D_projector R T; R and
            T (mm) map camera to projector. By default the common names are recognised, and those
            used are printed.
        projector: Width x height of the projector, px; by default what the file states, else the
            session's captures.
        camera: Width x height of the camera, px; by default what the file states, else the
            session's captures.
        force: Replace the session's stereo calibration (the old one goes to the session's trash).

    Returns the model, or None while nothing states a size. The session's other calibrations go to
    the trash with the stereo one that they were made from.

    Raises InputError, and replaces nothing, where sizes contradict each other, and where the
    patterns of a capture in the session contradict the calibration: R and T inverted, matrices
    exchanged or at another pixel scale, another rig.
    """
    path = Path(file)
    storage = read_storage(path)
    matrices = opencv_calibration.read_matrices(storage, keys)
    stated = opencv_calibration.read_sizes(storage)
    with opened_or_made(session) as store:
        there = available_models(store)
        if there and not force:
            raise InputError(
                f"{store.folder} holds a {' and a '.join(there)} calibration already: "
                "replace it with --force (it goes to the session's trash)"
            )
        captures = store.captures()
        projectors = {capture.sequence.projector_size for capture in captures} - {None}
        sizes = {
            device: _resolve_size(path, device, given, stated, captured)
            for device, given, captured in (
                ("camera", camera, {capture.size for capture in captures}),
                ("projector", projector, projectors),
            )
        }
        camera_lens, projector_lens = (  # raises what a lens cannot have
            Lens(matrices[f"K_{device}"], matrices[f"D_{device}"], size or (1, 1))
            for device, size in sizes.items()
        )
        rig = StereoRig(camera_lens, projector_lens, matrices["R"], matrices["T"])
        model = None if None in sizes.values() else StereoModel.from_rig(rig)
        if model is None or not _is_confirmed(model, captures, warn):
            for device, size in sizes.items():
                if size is not None:
                    _check_principal_point(device, matrices[f"K_{device}"], size, warn)
        with store.together():
            trash_models(store, there)
            save_imported_stereo(store, matrices, source=str(file), **sizes)
        return model


def identify_calibration_keys(file: Path | str) -> dict[str, str]:
    """{entry: the file's name for it}, as ``import_opencv_calibration`` takes them by default.
    Raises InputError."""
    keys = opencv_calibration.identify_keys(read_storage(Path(file)))
    return dict(zip(opencv_calibration.ENTRIES, keys, strict=True))


def _resolve_size(
    path: Path,
    device: str,
    given: Size | None,
    stated: dict[str, tuple[tuple[int, int], str]],
    captured: set[Any],
) -> tuple[int, int] | None:
    """The size that is given, else stated in the file, else the captures'; InputError where these
    differ."""
    sources = {f"--{device}": parse_size(given)} if given is not None else {}
    if device in stated:
        sources[f"{path.name}: {stated[device][1]}"] = stated[device][0]
    if len(captured) == 1:
        sources["the session's captures"] = next(iter(captured))
    if len(set(sources.values())) > 1:
        conflict = ", ".join(
            f"{width}x{height} px by {source}" for source, (width, height) in sources.items()
        )
        raise InputError(
            f"the {device} has {conflict}: the calibration does not belong to these captures, or"
            " one size is wrong"
        )
    size = next(iter(sources.values()), None)
    if len(captured) > 1 and size not in captured:
        raise InputError(
            f"the session's captures have several {device} sizes: give the calibrated one with"
            f" --{device}"
        )
    return size


def _is_confirmed(model: StereoModel, captures: Iterable[Capture], warn: Warn) -> bool:
    """Whether a capture with both axes confirms the calibration; False without such a capture.
    Raises InputError where one contradicts it."""
    rig = model.rig
    for capture in captures:
        sequence = capture.sequence
        is_same = (capture.size, sequence.projector_size) == (rig.camera.size, rig.projector.size)
        if is_same and len(sequence.axes) > 1:
            check = check_phases(capture.name, decode_capture(capture), model)
            for message in check.warnings:
                warn(message)
            if check.agreement is not None:
                return True
    return False


def _check_principal_point(device: str, K: np.ndarray, size: tuple[int, int], warn: Warn) -> None:
    """Warn where the optical axis is outside of the image: a shifted lens, or another pixel
    scale."""
    (width, height), (cx, cy) = size, K[:2, 2]
    if not (-0.5 <= cx <= width - 0.5 and -0.5 <= cy <= height - 0.5):
        warn(
            f"the {device}'s principal point ({cx:.0f}, {cy:.0f}) lies outside of its"
            f" {width}x{height} px: the lens is shifted, or the calibration was made at another"
            " pixel scale; import a capture with patterns along both axes, and the calibration"
            " after it: the patterns then tell"
        )
