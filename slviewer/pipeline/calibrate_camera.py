"""The camera alone, from the pictures of a board that a folder or a session holds."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from slviewer import __version__
from slviewer.calibration.camera import CameraCalibration, calibrate_camera
from slviewer.errors import DetectionError, InputError
from slviewer.pipeline.capture_phases import capture_texture
from slviewer.pipeline.feedback import Progress, Warn, ignore_progress, ignore_warnings
from slviewer.pipeline.open_session import match_names
from slviewer.session.exporters import write_calibration
from slviewer.session.importers.images import read_image
from slviewer.session.importers.imported import images_by_name
from slviewer.session.layout import is_session
from slviewer.session.store import Session
from slviewer.target.board import Board
from slviewer.target.detect import Detection, detect


def calibrate_camera_alone(
    source: Path | str,
    target: str,
    *,
    poses: Sequence[str] = (),
    exclude: Sequence[str] = (),
    out: Path | str | None = None,
    progress: Progress = ignore_progress,
    warn: Warn = ignore_warnings,
) -> CameraCalibration:
    """Calibrate the camera from a folder of pictures, or from the target poses of a session; a
    session stays as it is.

    ``poses``, ``exclude``: names or patterns of pictures. ``out``: .yml, .xml or .json for OpenCV.
    Pictures in which the board is not detected are excluded with the reason. Raises
    CalibrationRejected for fewer than three.
    """
    board, source = Board.parse(target), Path(source)
    if is_session(source):
        with Session.open(source) as store:
            names = store.capture_names("calibration")
    elif source.is_dir():
        names = [path.name for path in images_by_name(source)]
    else:
        raise InputError(
            f"{source} is not a folder: give a folder of pictures of the board, or a session"
        )
    without = match_names(names, exclude, "picture")
    chosen = match_names(names, poses, "picture") if poses else names
    chosen = [name for name in chosen if name not in without]
    detections, excluded = dict[str, Detection](), dict[str, str]()
    size: tuple[int, int] | None = None
    for i, name in enumerate(chosen):
        progress(i / len(chosen), f"detecting the board in {name}")
        image = _read_picture(source, name)
        height, width = image.shape[:2]
        if size is not None and size != (width, height):
            raise InputError(
                f"{name} is {width}x{height} px, others are {size[0]}x{size[1]}: use pictures of"
                " one size"
            )
        size = width, height
        try:
            detections[name] = detect(board, image)
        except DetectionError as error:
            excluded[name] = str(error)
            warn(f"{name} is excluded: {error}")
    if size is None:
        raise InputError(f"{source} holds no picture to calibrate from: name some")
    calibration = calibrate_camera(board, detections, size, excluded)
    if out is not None:
        entries = {
            "program": f"slviewer {__version__}",
            "target": calibration.board,
            "camera_size": np.array(calibration.lens.size),
            "K_camera": calibration.lens.K,
            "D_camera": calibration.lens.D,
            "focal_sigma_px": np.array(calibration.focal_sigma_px),
            "reprojection_rms_px_camera": calibration.rms_px,
            "verdict": calibration.verdict.level,
        }
        write_calibration(Path(out), entries, _MEANINGS)
    progress(1.0, "calibrated")
    return calibration


def _read_picture(source: Path, name: str) -> np.ndarray:
    """Return a picture (h, w) or (h, w, 3) RGB by its name in the folder or session."""
    if is_session(source):
        with Session.open(source) as store:
            capture = store.load_capture(name)
            return capture_texture(capture, capture.stack())
    image = read_image(source / name)
    return np.ascontiguousarray(image[..., ::-1]) if image.ndim == 3 else image


_MEANINGS = {
    "camera_size": (
        "width and height of the image, px; pixel (0, 0) is the centre of the top left one"
    ),
    "K_camera": "intrinsics: fx 0 cx, 0 fy cy, 0 0 1, px",
    "D_camera": "distortion: k1 k2 p1 p2 k3, as OpenCV orders them",
    "focal_sigma_px": "standard deviations of fx and fy, px",
}
