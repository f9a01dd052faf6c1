"""Printed boards of other makers and sizes."""

import re
from functools import partial

import cv2
import numpy as np

from slviewer.calibration.camera import calibrate_camera
from slviewer.pipeline.calibrate import calibrate
from slviewer.pipeline.measure import measure
from slviewer.pipeline.simulate import TARGET
from slviewer.session.capture import NewCapture
from slviewer.session.store import Session
from slviewer.simulation.plans import target_poses
from slviewer.simulation.rig import letter
from slviewer.target.board import Board, Detection
from slviewer.target.charuco import opencv_board
from slviewer.target.detect import detect
from tests.proofs.report_cases.case import Case, Outcome, Workplace, read_refusal

_PIXELS_PER_SQUARE = 100
CENTRE, DIAMETER_MM = np.array([14.0, 6.0, 640.0]), 196.0
"""Of the plan's third sphere."""


def _judge_stretch(_: Workplace, x: float, y: float) -> Outcome:
    """Calibrate a camera from a board whose print is longer by the shares ``x`` and ``y``, and
    again as the finding says."""
    rig, board = letter(0.5, 0), Board.parse("circles:21x16:9")
    printed = board.points * [1 + x, 1 + y, 1]
    rng = np.random.default_rng(0)
    seen = {
        str(i): Detection(
            rig.camera.project(pose.to_camera(printed)) + rng.normal(0, 0.02, (len(printed), 2)),
            np.arange(len(printed)),
        )
        for i, pose in enumerate(target_poses(rig, board, 8))
    }
    first = calibrate_camera(board, seen, rig.camera.size)
    findings = [f for f in first.verdict.findings if f.cause == "board-size"]
    truth = f"9 x 9 mm stretched by {100 * x:g} and {100 * y:g} %"
    if not findings:
        return Outcome("no finding", truth, x == y)
    for notation in re.findall(r"circles:\S+?(?=[,;])", findings[0].remedy):
        named = Board.parse(notation)
        if np.allclose(named.pitches, [9 * (1 + x), 9 * (1 + y)], rtol=1e-3):
            again = calibrate_camera(named, seen, rig.camera.size)
            error = float(
                np.abs(
                    np.diag(again.lens.K)[:2] / (np.array(rig.camera.focal_px) * rig.camera.scale)
                    - 1
                ).max()
            )
            is_right = error < 2e-3 and not again.verdict.findings
            return Outcome(f"{named}, focal length {100 * error:.2f} % off", truth, is_right)
    return Outcome(findings[0].remedy, truth, False)


def _judge_picture(
    _: Workplace, printed: str, given: str, right: str, mirrored: bool = False
) -> Outcome:
    """Detect the board ``printed`` in an oblique picture, given as another notation; the error
    names ``right``, which is detected with its own numbers."""
    board = Board.parse(printed)
    width, height = (_PIXELS_PER_SQUARE * n for n in (board.columns, board.rows))
    sheet = opencv_board(board).generateImage((width, height))
    corners = np.array([[0, 0], [width, 0], [width, height], [0, height]], np.float32)
    places = np.array([[160, 90], [1060, 130], [1010, 760], [210, 810]], np.float32)
    H = cv2.getPerspectiveTransform(corners, places)
    image = cv2.GaussianBlur(
        cv2.warpPerspective(sheet, H, (1280, 960), borderValue=235), (0, 0), 0.9
    )
    shown = np.ascontiguousarray(image[:, ::-1]) if mirrored else image
    message = read_refusal(lambda: detect(Board.parse(given), shown), "detected")
    found = detect(board, image)
    points = board.points[found.ids][:, :2] / board.pitches + 1
    true = cv2.perspectiveTransform(points[None] * _PIXELS_PER_SQUARE - 0.5, H.astype(float))[0]
    off = float(np.abs(found.pixels - true).max())
    is_named = right in message and off < 0.3
    return Outcome(f"{message}; then {off:.2f} px off", right, is_named)


def _judge_mirrored(
    workplace: Workplace, flip: tuple[slice, ...], is_mirror: bool = True
) -> Outcome:
    """Calibrate from camera images that are flipped, which is refused by naming both devices; then,
    as the remedy says, without the flip, and measure a sphere."""
    base, folder = workplace.base(), workplace.folder / "flipped"
    with Session.open(base) as old, Session.create(folder) as new:
        for role in ("calibration", "scan"):
            captures = [
                old.load_capture(n) for n in old.capture_names(role) if n[:4] in ("pose", "sphe")
            ]
            flipped = [
                NewCapture(c.name, c.sequence, np.ascontiguousarray(c.frames[:, *flip]), None, "")
                for c in captures
            ]
            new.save_captures(flipped, role, board=TARGET if role == "calibration" else None)
    said = read_refusal(lambda: calibrate(folder, target=TARGET), "calibrated")
    x, y, z = CENTRE if is_mirror else -CENTRE
    ball, session = (x, y, abs(z), DIAMETER_MM / 2 + 3), base if is_mirror else folder
    diameter = measure(session, "sphere_3", "sphere", ball=ball).only["diameter"]
    return Outcome(
        f"{said}; then {diameter.value:.3f} mm, U {diameter.U:.3f} mm",
        f"{'mirrored; ' if is_mirror else ''}{DIAMETER_MM:g} mm",
        all((word in said) == is_mirror for word in ("text", "camera's mirror", "projector's"))
        and 0 < abs(diameter.value - DIAMETER_MM) < (diameter.U or 0.0) < 0.05,
    )


CASES: dict[str, Case] = {
    "camera image mirrored left to right": partial(_judge_mirrored, flip=np.s_[:, ::-1]),
    "camera image mirrored top to bottom": partial(_judge_mirrored, flip=np.s_[::-1, :]),
    "camera turned by 180 degrees": partial(
        _judge_mirrored, flip=np.s_[::-1, ::-1], is_mirror=False
    ),
    "print longer in x by 1 %": partial(_judge_stretch, x=0.01, y=0.0),
    "print longer in y by 0.3 %": partial(_judge_stretch, x=0.0, y=0.003),
    "print shorter in x by 3 %": partial(_judge_stretch, x=-0.03, y=0.0),
    "print longer in both by 1 %": partial(_judge_stretch, x=0.01, y=0.01),
    "ChArUco board before OpenCV 4.6": partial(
        _judge_picture,
        printed="charuco-legacy:8x6:30",
        given="charuco:8x6:30",
        right="charuco-legacy:8x6:30",
    ),
    "ChArUco board given as older": partial(
        _judge_picture,
        printed="charuco:8x6:30",
        given="charuco-legacy:8x6:30",
        right="give the board as charuco:8x6:30",
    ),
    "older ChArUco board of odd columns": partial(
        _judge_picture,
        printed="charuco-legacy:5x4:30",
        given="charuco:5x4:30",
        right="charuco-legacy:5x4:30",
    ),
    "ChArUco board mirrored": partial(
        _judge_picture,
        printed="charuco:8x6:30",
        given="charuco:8x6:30",
        right="mirror",
        mirrored=True,
    ),
}
"""Camera calibrations and pictures of stretched, older and mirrored boards."""
