"""Detecting a board in photographs: where its features are, or why it cannot be measured."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from slviewer.errors import DetectionError, InputError
from slviewer.fringe.layout import to_eight_bits
from slviewer.printable import format_csv
from slviewer.session.importers.images import read_image
from slviewer.target.board import Board
from slviewer.target.detect import Detection, detect
from slviewer.target.planar import fit_grid_map

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm", ".webp")
COLUMNS = ("image", "index", "x_mm", "y_mm", "u_px", "v_px")
_BLUE, _RED, _GREEN, _BLACK = (255, 120, 0), (40, 40, 255), (40, 200, 40), (0, 0, 0)  # BGR
_LARGEST_OVERLAY_PX = 1600


@dataclass(frozen=True, eq=False)
class BoardImageResult:
    """A photograph, and the board in it: ``detection``, or None and the reason (``refusal``).

    ``rms_px`` (NaN without a detection): how far the features lie from the smooth map of a flat
    grid behind a lens.
    """

    path: Path
    detection: Detection | None
    refusal: str = ""
    rms_px: float = float("nan")


@dataclass(frozen=True, eq=False)
class BoardsDetected:
    """What ``detect_board`` returns: ``board`` and one result for each photograph, in the order of
    ``images``."""

    board: Board
    images: tuple[BoardImageResult, ...]

    @property
    def detected(self) -> int:
        """Number of photographs in which the board was detected."""
        return sum(image.detection is not None for image in self.images)

    @property
    def failure(self) -> str:
        """In how many photographs the board was not detected; empty where it was in all."""
        missing = len(self.images) - self.detected
        return (
            f"{self.board} not detected in {missing} of {len(self.images)} images"
            if missing
            else ""
        )

    def rows(self) -> list[tuple[str, int, float, float, float, float]]:
        """The table: image, index of the feature, its place on the board in mm, and in the image in
        px."""
        return [
            (image.path.name, int(index), x, y, u, v)
            for image in self.images
            if image.detection is not None
            for index, (x, y), (u, v) in zip(
                image.detection.ids,
                self.board.points[image.detection.ids][:, :2].tolist(),
                image.detection.pixels.tolist(),
                strict=True,
            )
        ]

    def text(self) -> str:
        """One line for each photograph; for a single one also the table."""
        lines = [_describe_result(self.board, image) for image in self.images]
        if len(self.images) == 1 and self.detected:
            lines.append(f"{'index':>5} {'x mm':>9} {'y mm':>9} {'u px':>10} {'v px':>10}")
            lines += [
                f"{index:5d} {x:9.2f} {y:9.2f} {u:10.3f} {v:10.3f}"
                for _, index, x, y, u, v in self.rows()
            ]
        elif len(self.images) > 1:
            lines.append(f"{self.board} detected in {self.detected} of {len(self.images)} images")
        return "\n".join(lines)

    def to_json(self) -> dict[str, Any]:
        """Return the result as plain values."""
        return {
            "target": str(self.board),
            "images": [
                {
                    "image": str(image.path),
                    "detected": image.detection is not None,
                    "refusal": image.refusal,
                    "marked": bool(image.detection and image.detection.marked),
                    "rms_px": image.rms_px if image.detection is not None else None,
                    "index": image.detection.ids.tolist() if image.detection else [],
                    "pixels": image.detection.pixels.tolist() if image.detection else [],
                }
                for image in self.images
            ],
        }


def detect_board(
    images: Sequence[Path | str],
    target: str,
    *,
    out: Path | str | None = None,
    csv_out: Path | str | None = None,
) -> BoardsDetected:
    """Detect a calibration board in photographs: where its circles or corners are, or why it cannot
    be measured.

    Ends with status 1 where the board is not detected in every image.

    Args:
        images: Image files, or folders of them.
        target: circles:21x16:9 (columns x rows : pitch mm), acircles:..., chessboard:9x7:75 (inner
            corners : square mm), charuco:....
        out: The picture with numbered features and the board's axes; a folder where there are
            several images.
        csv_out: Table of all features: image, index, place on the board in mm, place in the image
            in px.

    A photograph that cannot be read, or in which the board is not detected, is a result with its
    reason. Raises InputError where there is no photograph at all.
    """
    board = Board.parse(target)
    paths = _list_photographs([Path(image) for image in images])
    results = []
    for path in paths:
        try:
            picture = read_image(path)
            result = _detect_board_in(board, path, picture)
        except InputError as error:
            results.append(BoardImageResult(path, None, str(error)))
            continue
        results.append(result)
        if out is not None:
            _write_picture(
                _overlay_path(Path(out), path, len(paths)),
                draw_detection(board, picture, result.detection),
            )
    detected = BoardsDetected(board, tuple(results))
    if csv_out is not None:
        _write_csv(Path(csv_out), detected)
    return detected


def draw_detection(board: Board, image: np.ndarray, detection: Detection | None) -> np.ndarray:
    """(h, w, 3) uint8 BGR: the photograph with each feature marked and numbered, and the board's
    axes (x red, y green); enlarged or reduced to a width at which the numbers can be read."""
    image = to_eight_bits(image)
    picture = np.ascontiguousarray(
        image if image.ndim == 3 else cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
    )
    scale = _LARGEST_OVERLAY_PX / max(picture.shape[:2])
    picture = cv2.resize(
        picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA if scale < 1 else 1
    )
    if detection is None:
        return picture
    pixels = (detection.pixels + 0.5) * scale - 0.5
    places = [(round(float(u)), round(float(v))) for u, v in pixels]
    apart = np.linalg.norm(pixels[:, None] - pixels[None], axis=2)
    np.fill_diagonal(apart, np.inf)
    size = float(np.clip(np.median(apart.min(1)) / 90, 0.3, 0.8))
    for index, place in zip(detection.ids.tolist(), places, strict=True):
        cv2.drawMarker(picture, place, _BLUE, cv2.MARKER_CROSS, 9, 1, cv2.LINE_AA)
        for colour, width in ((_BLACK, 3), (_BLUE, 1)):
            cv2.putText(
                picture,
                str(index),
                (place[0] + 4, place[1] - 4),
                0,
                size,
                colour,
                width,
                cv2.LINE_AA,
            )
    to_px = fit_grid_map(board.points[detection.ids][:, :2] / board.pitch_mm, pixels)
    axes = to_px.to_image(
        np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]) * (2 if board.kind == "acircles" else 1)
    )
    origin, *tips = [(round(float(u)), round(float(v))) for u, v in axes]
    for tip, colour, name in zip(tips, (_RED, _GREEN), "xy", strict=True):
        cv2.arrowedLine(picture, origin, tip, colour, 3, cv2.LINE_AA, tipLength=0.25)
        cv2.putText(picture, name, (tip[0] + 6, tip[1] + 14), 0, 0.8, colour, 2, cv2.LINE_AA)
    return picture


def _list_photographs(given: list[Path]) -> list[Path]:
    """Return the given image files and the images in given folders; InputError for a missing
    path."""
    paths: list[Path] = []
    for path in given:
        if path.is_dir():
            inside = sorted(
                each for each in path.iterdir() if each.suffix.lower() in IMAGE_SUFFIXES
            )
            if not inside:
                raise InputError(
                    f"{path} holds no images: name a folder with {', '.join(IMAGE_SUFFIXES)} files"
                )
            paths += inside
        elif path.exists():
            paths.append(path)
        else:
            raise InputError(f"{path} does not exist: name image files, or a folder of them")
    if not paths:
        raise InputError("no image was named: name image files, or a folder of them")
    return paths


def _detect_board_in(board: Board, path: Path, picture: np.ndarray) -> BoardImageResult:
    """Detect the board in a BGR or grey picture; the result holds the reason where that fails."""
    try:
        detection = detect(board, picture[..., ::-1] if picture.ndim == 3 else picture)
    except DetectionError as error:
        return BoardImageResult(path, None, str(error))
    residuals = fit_grid_map(
        board.points[detection.ids][:, :2] / board.pitch_mm, detection.pixels
    ).residuals
    return BoardImageResult(path, detection, rms_px=float(np.sqrt((residuals**2).sum(1).mean())))


def _describe_result(board: Board, image: BoardImageResult) -> str:
    """Describe the detection in one photograph as a line of text."""
    if image.detection is None:
        return f"{image.path.name}: not detected: {image.refusal}"
    features = "circles" if board.kind in ("circles", "acircles") else "corners"
    mark = ", numbered from the board's mark" if image.detection.marked else ""
    return (
        f"{image.path.name}: {len(image.detection.ids)} of {len(board.points)} {features} detected,"
        f" {image.rms_px:.3f} px RMS from a flat grid{mark}"
    )


def _overlay_path(out: Path, photograph: Path, count: int) -> Path:
    """Return the file for a photograph's overlay: ``out`` itself for a single image, else a PNG in
    that folder."""
    return (
        out
        if count == 1 and out.suffix.lower() in IMAGE_SUFFIXES
        else out / f"{photograph.stem}_board.png"
    )


def _write_picture(path: Path, picture: np.ndarray) -> None:
    """Write an image in the format of the suffix; InputError where that is not an image format."""
    path.parent.mkdir(parents=True, exist_ok=True)
    done, data = cv2.imencode(path.suffix, picture)
    if not done:
        raise InputError(
            f"{path.name} cannot be written as an image: give a name that ends in .png"
        )
    path.write_bytes(data.tobytes())


def _write_csv(path: Path, detected: BoardsDetected) -> None:
    """Write the detected features of all photographs as CSV, one row each."""
    path.parent.mkdir(parents=True, exist_ok=True)
    rows = (
        (name, index, x, y, f"{u:.4f}", f"{v:.4f}") for name, index, x, y, u, v in detected.rows()
    )
    path.write_text(format_csv([COLUMNS, *rows]), encoding="utf-8", newline="")
