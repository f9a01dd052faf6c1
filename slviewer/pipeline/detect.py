"""Detecting a board in photographs: where its features are, or why it cannot be measured."""

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import cv2
import numpy as np
from scipy.spatial import cKDTree

from slviewer.errors import InputError, SlviewerError, UsageError
from slviewer.fringe.layout import to_eight_bits
from slviewer.geometry.vectors import rms_length
from slviewer.pipeline.capture_phases import capture_texture
from slviewer.printable import format_csv
from slviewer.records.record import to_plain
from slviewer.session.atomic import replace_file
from slviewer.session.importers.images import read_image
from slviewer.session.store import Session
from slviewer.target.board import Board, Detection
from slviewer.target.detect import RecognisedBoard, detect, recognise_board
from slviewer.target.planar import GridMap, fit_grid_map

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm", ".webp")
COLUMNS = ("image", "index", "x_mm", "y_mm", "u_px", "v_px")
_BLUE, _RED, _GREEN, _BLACK = (255, 120, 0), (40, 40, 255), (40, 200, 40), (0, 0, 0)  # BGR
T = TypeVar("T")
MOST_EXAMINED = 5
"""Pictures, about, in which a board is recognised: each takes a second or so."""
_LARGEST_OVERLAY_PX = 1600


@dataclass(frozen=True)
class BoardImageResult:
    """A photograph, and the board in it: the features ``index`` (n) at the ``pixels`` (n, 2), from
    the board's mark on where that was seen (``marked``), or why it was not detected (``refusal``).

    ``rms_px`` (None without the board): how far the features lie from the smooth map of a flat grid
    behind a lens. ``note``: what else is in view and not used.
    """

    image: Path
    detected: bool = False
    refusal: str = ""
    marked: bool = False
    rms_px: float | None = None
    index: Sequence[int] = ()
    pixels: Sequence[Sequence[float]] = ()
    note: str = ""


@dataclass(frozen=True, eq=False)
class BoardsDetected:
    """What ``detect_board`` returns: ``board`` and one result for each photograph, in the order of
    ``images``."""

    board: Board
    images: tuple[BoardImageResult, ...]

    @property
    def detected(self) -> int:
        """Number of photographs in which the board was detected."""
        return sum(image.detected for image in self.images)

    @property
    def failure(self) -> str:
        """In how many photographs the board was not detected; empty where it was in all."""
        count = len(self.images)
        missing = count - self.detected
        return f"{self.board} not detected in {missing} of {count} images" if missing else ""

    def rows(self) -> list[tuple[str, int, float, float, float, float]]:
        """The table: image, index of the feature, its place on the board in mm, and in the image in
        px."""
        places = self.board.points[:, :2].tolist()
        return [
            (image.image.name, index, *places[index], u, v)
            for image in self.images
            for index, (u, v) in zip(image.index, image.pixels, strict=True)
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
        return {"target": str(self.board), "images": to_plain(self.images)}


def detect_board(
    images: Sequence[Path | str],
    target: str = "",
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
            corners : square mm), charuco:.... Without it, the chessboard or grid of circles that
            the images show is named.
        out: The picture with numbered features and the board's axes; a folder where there are
            several images.
        csv_out: Table of all features: image, index, place on the board in mm, place in the image
            in px.

    A photograph that cannot be read, or in which the board is not detected, is a result with its
    reason. Raises InputError where there is no photograph at all.
    """
    paths = _list_photographs([Path(image) for image in images])
    if not target:
        raise _request_target(paths)
    board = Board.parse(target)
    results = []
    for path in paths:
        picture, detection = None, None
        try:
            picture = read_image(path)
            detection = detect(board, picture[..., ::-1] if picture.ndim == 3 else picture)
            ids, pixels = detection.ids.tolist(), detection.pixels.tolist()
            rms_px = rms_length(_fit_grid(board, detection, detection.pixels).residuals)
            marked, note = detection.marked, detection.note
            found = BoardImageResult(path, True, "", marked, rms_px, ids, pixels, note)
        except InputError as error:
            found = BoardImageResult(path, refusal=str(error))
        results.append(found)
        if out is None or picture is None:
            continue
        overlay = Path(out)
        if len(paths) > 1 or overlay.suffix.lower() not in IMAGE_SUFFIXES:
            overlay = overlay / f"{path.stem}_board.png"
        done, data = cv2.imencode(overlay.suffix, draw_detection(board, picture, detection))
        if not done:
            raise InputError(
                f"{overlay.name} cannot be written as an image", "give a name that ends in .png"
            )
        replace_file(overlay, data.tobytes())
    detected = BoardsDetected(board, tuple(results))
    if csv_out is not None:
        rows = [(*row, f"{u:.4f}", f"{v:.4f}") for *row, u, v in detected.rows()]
        replace_file(Path(csv_out), format_csv([COLUMNS, *rows]).encode())
    return detected


def _request_target(paths: Sequence[Path]) -> UsageError:
    """Return the error of a missing target, with the board that the photographs show."""

    def read() -> Iterator[np.ndarray]:
        """Yield those that can be read, in RGB."""
        for path in _select_some(paths):
            with suppress(InputError):
                picture = read_image(path)
                yield picture[..., ::-1] if picture.ndim == 3 else picture

    recognised = recognise_board(read())
    if recognised is None:
        return UsageError(
            "no target was given, and none was recognised",
            "give --target with kind, columns x rows : pitch in mm, such as circles:21x16:9",
        )
    notation = recognised.notation
    return UsageError(recognised.text(), f"give its pitch in mm: --target {notation}:PITCH")


def _select_some(items: Sequence[T]) -> Sequence[T]:
    """Return about `MOST_EXAMINED` of many items, evenly."""
    return items[:: max(1, len(items) // MOST_EXAMINED)]


def recognise_target(store: Session) -> RecognisedBoard | None:
    """Return the board that some of the session's target poses show; None where none is
    recognised."""
    captures = store.captures("calibration", with_frames=True)

    def read() -> Iterator[np.ndarray]:
        """Yield the pictures of those that can be read."""
        for each in _select_some(captures):
            with suppress(SlviewerError):
                yield capture_texture(each, each.frames)

    return recognise_board(read())


def _fit_grid(board: Board, detection: Detection, pixels: np.ndarray) -> GridMap:
    """Return the smooth map from the board, in pitches, to the ``pixels`` (n, 2) of what was
    detected."""
    return fit_grid_map(board.nodes[detection.ids], pixels)


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
    apart = cKDTree(pixels).query(pixels, k=2)[0][:, 1]
    size = float(np.clip(np.median(apart) / 90, 0.3, 0.8))
    for index, (u, v) in zip(detection.ids, np.rint(pixels).astype(int).tolist(), strict=True):
        cv2.drawMarker(picture, (u, v), _BLUE, cv2.MARKER_CROSS, 9, 1, cv2.LINE_AA)
        for colour, width in ((_BLACK, 3), (_BLUE, 1)):
            place = u + 4, v - 4
            cv2.putText(picture, str(index), place, 0, size, colour, width, cv2.LINE_AA)
    axes = np.eye(3)[:, 1:] * (2 if board.kind == "acircles" else 1)
    ends = _fit_grid(board, detection, pixels).to_image(axes)
    origin, *tips = np.rint(ends).astype(int).tolist()
    for (u, v), colour, name in zip(tips, (_RED, _GREEN), "xy", strict=True):
        cv2.arrowedLine(picture, origin, (u, v), colour, 3, cv2.LINE_AA, tipLength=0.25)
        cv2.putText(picture, name, (u + 6, v + 14), 0, 0.8, colour, 2, cv2.LINE_AA)
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
                    f"{path} holds no images",
                    f"name a folder with {', '.join(IMAGE_SUFFIXES)} files",
                )
            paths += inside
        elif path.exists():
            paths.append(path)
        else:
            raise InputError(f"{path} does not exist", "name image files, or a folder of them")
    if not paths:
        raise InputError("no image was named", "name image files, or a folder of them")
    return paths


def _describe_result(board: Board, found: BoardImageResult) -> str:
    """Describe the detection in one photograph as a line of text."""
    if not found.detected:
        return f"{found.image.name}: not detected: {found.refusal}"
    features = "circles" if board.kind in ("circles", "acircles") else "corners"
    mark = ", numbered from the board's mark" if found.marked else ""
    return (
        f"{found.image.name}: {len(found.index)} of {len(board.points)} {features} detected,"
        f" {found.rms_px:.3f} px RMS from a flat grid{mark}"
        + (f"; {found.note}" if found.note else "")
    )
