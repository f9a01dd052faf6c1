"""What is taken for the board: clear of its edges, and in its plane."""

import cv2
import numpy as np
import pytest

from slviewer.calibration.observe import BoardPlane, bright_pixels
from slviewer.fringe.phase import PhaseMap

SIZE = (400, 300)
CAMERA = np.array([[400.0, 0, 199.5], [0, 400, 149.5], [0, 0, 1]])
BENT = np.array([-0.2, 0.05, 0, 0, 0])
PROJECTOR = np.array([[1200.0, 0, 640], [0, 1200, 400], [0, 0, 1]])
TURN = cv2.Rodrigues(np.radians([0.0, -14.0, 0.0]))[0]


def board(tilt: float, nearer_mm: float = 0.0, margin: float = 0.0) -> np.ndarray:
    """(n, 3) mm: 11 x 8 features of 25 mm pitch, or as many points that reach ``margin`` pitches
    beyond them."""
    x, y = np.meshgrid(
        np.linspace(-5 - margin, 5 + margin, 11), np.linspace(-3.5 - margin, 3.5 + margin, 8)
    )
    R = cv2.Rodrigues(np.radians([tilt, -0.6 * tilt, 0.0]))[0]
    return np.stack([x, y, 0 * x], 2).reshape(-1, 3) * 25 @ R.T + [0, 0, 340 - nearer_mm]


def in_camera(points: np.ndarray) -> np.ndarray:
    return cv2.projectPoints(points, np.zeros(3), np.zeros(3), CAMERA, BENT)[0].reshape(-1, 2)


def in_projector(points: np.ndarray) -> np.ndarray:
    bent = np.array([-0.06, 0.02, 0, 0, 0])
    return cv2.projectPoints(
        (points - [100, 0, 0]) @ TURN.T, np.zeros(3), np.zeros(3), PROJECTOR, bent
    )[0].reshape(-1, 2)


@pytest.mark.parametrize("tilt", [0.0, 20.0])
def test_a_wide_lens_keeps_the_board_and_loses_the_hand(tilt: float) -> None:
    features, outline, hand = board(tilt), board(tilt, margin=0.5), board(tilt, nearer_mm=40.0)
    plane = BoardPlane.fit(in_camera(features), in_projector(features), SIZE)
    assert plane is not None
    for points, near in ((features, 1.0), (outline, 1.0), (hand, 0.0)):
        off = np.abs(plane.predict(*in_camera(points).T) - in_projector(points))
        assert (off < plane.reach).all(1).mean() == near
    assert (plane.reach > 1.0).all() and plane.bend < -0.02


def test_features_misread_do_not_count() -> None:
    camera, projector = in_camera(board(10.0)), in_projector(board(10.0))
    clean = BoardPlane.fit(camera, projector, SIZE)
    projector[5] += 30.0
    projector[40] = np.nan
    spoiled = BoardPlane.fit(camera, projector, SIZE)
    assert clean is not None and spoiled is not None
    assert np.abs(spoiled.predict(200.0, 150.0) - clean.predict(200.0, 150.0)).max() < 0.5
    assert (spoiled.reach < 2 * clean.reach).all()
    assert BoardPlane.fit(camera[:9], projector[:9], SIZE) is None


def test_a_map_is_judged_pixel_by_pixel() -> None:
    plane = BoardPlane.fit(in_camera(board(0.0)), in_projector(board(0.0)), SIZE)
    assert plane is not None
    u, v = np.meshgrid(np.arange(150, 190), np.arange(100, 120))
    rows = plane.predict(u, v)[..., 1]
    rows[3, 4], rows[5, 6] = rows[3, 4] + plane.reach[1] + 0.1, np.nan
    holds = plane.contains(rows, 1, (150, 100))
    assert holds.sum() == holds.size - 2 and not holds[3, 4] and not holds[5, 6]


def modulated(modulation: np.ndarray) -> PhaseMap:
    flat = np.zeros(modulation.shape, np.float32)
    reason = flat.astype(np.uint8)
    return PhaseMap(
        "x", 18.0, flat, flat, modulation.astype(np.float32), flat + 100, reason, (1.0, 0.0), 18
    )


def test_strips_beside_markers_are_read_and_edges_of_plain_squares_stay_clear() -> None:
    v, u = np.mgrid[:216, :288]
    white = (u // 36 + v // 36) % 2 == 0
    marker = white & (np.abs(u % 36 - 17.5) < 13.5) & (np.abs(v % 36 - 17.5) < 13.5)
    inside = np.pad(np.ones((180, 252), bool), 18)
    plain = bright_pixels(
        modulated(cv2.GaussianBlur(np.where(white, 80.0, 8.0), (0, 0), 0.8)), inside, 36.0
    )
    assert not plain[~white].any()
    assert plain[36 * 2 + 3, 36 * 2 + 3] and not plain[36 * 2 + 1, 36 * 2 + 10]
    strips = bright_pixels(modulated(np.where(white & ~marker, 80.0, 8.0)), inside, 36.0)
    assert not strips[~white | marker].any()
    for y in range(36, 216, 36):
        for x in range(36, 288, 36):
            assert np.count_nonzero(strips[y - 28 : y + 28, x - 28 : x + 28]) > 100
