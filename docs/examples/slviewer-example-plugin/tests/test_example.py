"""Each plugin is tested as slviewer uses it, by the checks of `slviewer.plugins`."""

import shlex
import socket
import sys
import threading
from pathlib import Path

import cv2
import numpy as np
import pytest
from slviewer_example.aprilgrid import SPACING
from slviewer_example.axisfolders import LAYOUT
from slviewer_example.hotfolder import HotfolderCamera, HotfolderProjector
from slviewer_example.pts import EXPORTER
from slviewer_example.turntable import TcpTurntable

from slviewer.plugins import (
    Board,
    CameraSettings,
    DeviceError,
    PatternSequence,
    TurntableError,
    check_board,
    check_camera,
    check_exporter,
    check_importer,
    check_projector,
    check_turntable,
    phase_steps,
    render,
)
from slviewer.target.detect import detect


@pytest.fixture
def camera(tmp_path: Path) -> HotfolderCamera:
    """A camera whose trigger copies a picture into the folder under a new name."""
    picture, folder = tmp_path / "picture.png", tmp_path / "pictures"
    folder.mkdir()
    rng = np.random.default_rng(0)
    cv2.imwrite(str(picture), rng.integers(0, 255, (48, 64)).astype(np.uint8))
    take = tmp_path / "take.py"
    take.write_text(
        f"import pathlib, shutil, time\nshutil.copy({str(picture)!r}, pathlib.Path({str(folder)!r})"
        " / f'{time.time_ns()}.png')\n"
    )
    return HotfolderCamera(
        str(folder), (64, 48), shlex.join([sys.executable, str(take)]), timeout_s=30.0
    )


def test_the_camera_keeps_the_protocol(camera: HotfolderCamera) -> None:
    assert check_camera(camera) == []


def test_a_camera_without_pictures_says_so(tmp_path: Path) -> None:
    camera = HotfolderCamera(str(tmp_path), (64, 48), timeout_s=0.1)
    camera.open()
    assert camera.apply(CameraSettings(exposure_ms=5)) == CameraSettings()
    with pytest.raises(DeviceError, match="no picture"):
        camera.grab(np.empty((48, 64), np.uint8))


def test_the_projector_keeps_the_protocol(tmp_path: Path) -> None:
    projector = HotfolderProjector(str(tmp_path / "shown.png"), (128, 80), settle_s=0.0)
    assert check_projector(projector) == []
    projector.open()
    projector.show_level(77)
    assert np.unique(cv2.imread(str(tmp_path / "shown.png"), cv2.IMREAD_GRAYSCALE)) == [77]


class Controller(threading.Thread):
    """A turntable's controller on loopback, which needs three questions for each turn."""

    def __init__(self) -> None:
        super().__init__(daemon=True)
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = self._listener.getsockname()[1]
        self.start()

    def run(self) -> None:
        angle, target, left = 0.0, 0.0, 0
        while True:
            connection, _ = self._listener.accept()
            for line in connection.makefile("r"):
                word, *rest = line.split()
                if word == "TURN":
                    target, left = float(rest[0]), 3
                elif word == "STOP":
                    target, left = angle, 0
                left = max(0, left - 1)
                angle = angle if left else target
                connection.sendall(f"{'MOVING' if left else 'OK'} {angle:.3f}\n".encode())


def test_the_turntable_keeps_the_protocol() -> None:
    assert check_turntable(TcpTurntable("127.0.0.1", Controller().port)) == []


def test_a_turntable_that_is_not_there_says_so() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    with pytest.raises(TurntableError, match="does not answer"):
        TcpTurntable("127.0.0.1", port).open()


def draw_aprilgrid(columns: int, rows: int, side_px: int) -> np.ndarray:
    """An AprilGrid seen straight on, `side_px` a tag, with a border of one tag."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    step = round(side_px * (1 + SPACING))
    image = np.full(((rows + 1) * step + side_px, (columns + 1) * step + side_px), 255, np.uint8)
    for tag in range(columns * rows):
        row, column = divmod(tag, columns)
        top, left = side_px + row * step, side_px + column * step
        image[top : top + side_px, left : left + side_px] = cv2.aruco.generateImageMarker(
            dictionary, tag, side_px
        )
    return image


def test_the_board_is_detected_where_it_is() -> None:
    assert check_board("aprilgrid:6x6:88") == []
    board = Board.parse("aprilgrid:5x4:10")
    straight = draw_aprilgrid(5, 4, 100)
    height, width = straight.shape
    corners = np.float32([[0, 0], [width, 0], [width, height], [0, height]])
    seen = np.float32([[40, 30], [width - 60, 80], [width - 20, height - 40], [90, height - 70]])
    H = cv2.getPerspectiveTransform(corners, seen)
    image = cv2.GaussianBlur(
        cv2.warpPerspective(straight, H, (width, height), borderValue=255), (0, 0), 1.0
    )
    found = detect(board, image)
    assert len(found.ids) == 4 * 20
    # a tag of 10 mm is 100 px, and its edge is between pixels
    points = board.points[found.ids][:, :2] * 10 + 100 - 0.5
    true = cv2.perspectiveTransform(points[None], H)[0]
    error = np.sqrt(np.mean((found.pixels - true) ** 2))
    assert 0.001 < error < 0.3


def test_the_importer_reads_whole_captures_alone(tmp_path: Path) -> None:
    size = (144, 108)
    frames = [
        frame
        for axis, extent in zip("xy", size, strict=True)
        for n in (1, 6, 36)
        for frame in phase_steps(axis, 4, extent / n)
    ]
    shown = PatternSequence(size, tuple(frames))
    for k in range(len(frames)):  # what a camera with the projector's own pixels records
        file = tmp_path / "part" / "xy"[k // 12] / f"{k % 12}.png"
        file.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(file), cv2.convertScaleAbs(render(shown, k), alpha=0.7, beta=20))
    assert check_importer(LAYOUT, tmp_path / "part", projector=size) == []
    x = tmp_path / "part" / "x"  # frames out of order are named
    for old, new in (("4", "other"), ("5", "4"), ("other", "5")):
        (x / f"{old}.png").rename(x / f"{new}.png")
    (fault,) = check_importer(LAYOUT, tmp_path / "part", projector=size)
    assert "x/4.png" in fault and "x/5.png" in fault


def test_the_exporter_writes_its_format() -> None:
    assert check_exporter(EXPORTER) == []
