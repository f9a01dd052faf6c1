"""Grids of circles in rendered images: where their centres are, how they are numbered, and what is
refused."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from facts import raises
from rendered_board import View
from variants import crossed, often

from slviewer.errors import DetectionError, InputError
from slviewer.target.board import Board
from slviewer.target.detect import board_mask, detect
from slviewer.target.planar import x_direction

pytestmark = pytest.mark.computes

BOARD = Board.parse("circles:9x7:20")
SMALL = View(size=(400, 300), supersample=4)


def discs(board: Board, view: View) -> np.ndarray:
    """(n, 2) px: centroids of the circles' images, which perspective moves away from the images of
    their centres."""
    radius = view.diameter * board.pitch_mm / 2 * (2**0.5 if board.kind == "acircles" else 1)
    r = radius * np.sqrt((np.arange(16) + 0.5) / 16)
    a = np.arange(32) / 32 * 2 * np.pi
    disc = np.stack([np.outer(r, np.cos(a)).ravel(), np.outer(r, np.sin(a)).ravel()], axis=1)
    H = view.homography(board)
    points = board.points[:, None, :2] + disc
    seen = view.project(board, points.reshape(-1, 2)).reshape(points.shape)
    area = (points @ H[2, :2] + H[2, 2]) ** -3  # px² per mm²
    return (seen * area[..., None]).sum(1) / area.sum(1)[:, None]


def rms(difference: np.ndarray) -> float:
    return float(np.sqrt((difference**2).sum(1).mean()))


@pytest.mark.parametrize("tilt", [*often(0, 20), 35])
def test_centroids_are_exact_to_a_hundredth_of_a_pixel_under_uneven_light(tilt: float) -> None:
    view = View(size=(480, 360), tilt=tilt, axis=70, shade=4)
    found = detect(BOARD, view.render(BOARD)).pixels
    assert rms(found - discs(BOARD, view)) < 0.008
    assert np.abs((found - discs(BOARD, view)).mean(0)).max() < 0.003
    off = rms(found - view.truth(BOARD))  # perspective alone, which calibration corrects
    assert off < 0.01 if tilt == 0 else 0.03 < off < 0.1


@pytest.mark.parametrize(
    ("notation", "view", "limit"),
    [
        ("circles:9x7:20", replace(SMALL, noise=3, shade=3, tilt=20), 0.04),
        ("circles:9x7:20", replace(SMALL, inverted=True, shade=3, noise=1, tilt=25), 0.04),
        # distortion moves centroids as well
        (
            "circles:9x7:20",
            replace(SMALL, k1=0.4, tilt=20),
            0.15,
        ),
        ("acircles:4x11:20", replace(SMALL, tilt=25, shade=3, noise=1), 0.03),
        *often(
            ("circles:9x7:20", replace(SMALL, blur=2.5, tilt=20), 0.03),
            ("circles:9x7:20", replace(SMALL, tilt=45, axis=40, shade=2), 0.03),
            ("circles:9x7:20", replace(SMALL, shade=10), 0.03),
            ("circles:9x7:20", replace(SMALL, fill=0.3, noise=1), 0.06),
            ("circles:9x7:20", replace(SMALL, diameter=0.75, tilt=15), 0.02),
            ("circles:9x7:20", replace(SMALL, diameter=0.25, tilt=15), 0.02),
            ("circles:3x3:20", replace(SMALL, diameter=0.7, tilt=15, fill=0.6), 0.02),
            ("circles:21x16:9", replace(SMALL, fill=0.85, tilt=15), 0.03),
            ("acircles:7x6:20", replace(SMALL, tilt=40, axis=20, shade=3, noise=1), 0.03),
        ),
    ],
)
def test_found_whatever_the_view(notation: str, view: View, limit: float) -> None:
    board = Board.parse(notation)
    detection = detect(board, view.render(board))
    np.testing.assert_array_equal(detection.ids, np.arange(len(board.points)))
    expected = discs(board, view)
    assert 1e-5 < rms(detection.pixels - expected) < limit


@pytest.mark.parametrize(
    ("notation", "view", "radius"),
    [
        ("circles:9x7:20", replace(SMALL, tilt=30, shade=3), 5.0),
        ("circles:9x7:20", replace(SMALL, tilt=30, inverted=True, diameter=0.7), 7.0),
        ("acircles:4x11:20", replace(SMALL, tilt=30, diameter=0.5), 5.0 * 2**0.5),
    ],
)
def test_the_circles_radius_is_measured(notation: str, view: View, radius: float) -> None:
    board = Board.parse(notation)
    assert detect(board, view.render(board)).radius_mm == pytest.approx(radius, rel=0.03)


def test_other_image_types_give_the_same() -> None:
    image = replace(SMALL, tilt=20).render(BOARD)
    pixels = detect(BOARD, image).pixels
    np.testing.assert_allclose(
        detect(BOARD, image.astype(np.uint16) * 16).pixels, pixels, atol=1e-3
    )
    np.testing.assert_allclose(
        detect(BOARD, np.repeat(image[..., None], 3, axis=2)).pixels, pixels, atol=1e-3
    )
    np.testing.assert_allclose(detect(BOARD, image // 5).pixels, pixels, atol=0.05)


@pytest.mark.parametrize(
    "image", [np.zeros((300, 400)), np.zeros((300, 400, 4), np.uint8), np.zeros((4, 4), np.uint8)]
)
def test_what_is_no_image_is_refused(image: np.ndarray) -> None:
    with raises(InputError, "uint8", "uint16"):
        detect(BOARD, image)


@pytest.mark.parametrize(
    ("notation", "roll"),
    crossed(["circles:9x7:20", "acircles:5x8:20", "circles:6x6:20"], [180, 100, 50, 0, 250, 330]),
)
def test_a_symmetric_board_starts_where_the_rule_says(notation: str, roll: float) -> None:
    board, view = Board.parse(notation), replace(SMALL, roll=roll, tilt=20, fill=0.65)
    pixels = detect(board, view.render(board)).pixels
    preferred = (1, 0) if notation == "circles:6x6:20" else (2, 1)
    direction = x_direction(board.points, pixels)
    assert direction @ preferred > 0
    if notation == "circles:6x6:20":
        assert direction[0] > np.cos(np.deg2rad(50))
    y = pixels[board.columns] - pixels[0]
    assert direction[0] * y[1] - direction[1] * y[0] > 0, "x turns clockwise into y"
    apart = np.linalg.norm(pixels[:, None] - view.truth(board)[None], axis=2)
    assert sorted(apart.argmin(1)) == list(range(len(pixels))) and apart.min(1).max() < 0.5


@pytest.mark.parametrize(
    ("notation", "roll"),
    crossed(
        ["circles:9x7:20", "acircles:5x8:20", "circles:6x6:20", "acircles:4x9:20"],
        [180, 70, 250, 130, 0, 330],
    ),
)
def test_a_marked_board_starts_at_its_mark(notation: str, roll: float) -> None:
    board, view = (
        Board.parse(notation),
        replace(SMALL, roll=roll, tilt=20, fill=0.6, shade=2, noise=1, marked=True),
    )
    detection = detect(board, view.render(board))
    assert detection.marked
    assert rms(detection.pixels - view.truth(board)) < 0.15
    plain = detect(board, replace(view, marked=False).render(board))
    assert not plain.marked
    apart = np.linalg.norm(detection.pixels[:, None] - plain.pixels[None], axis=2).min(1)
    assert np.sqrt((apart**2).mean()) < 0.02, "the dot does not pull its neighbour"


@pytest.mark.parametrize(
    "view",
    [
        replace(SMALL, inverted=True, roll=180, fill=0.6, noise=2),
        replace(SMALL, roll=180, tilt=45, axis=40, shade=6, fill=0.6),
        *often(
            replace(SMALL, blur=2.0, roll=180, fill=0.6),
            replace(SMALL, roll=170, fill=0.35, noise=1),
            replace(SMALL, roll=190, k1=0.4, tilt=20, fill=0.8),
            replace(SMALL, roll=180, diameter=0.3, noise=3, fill=0.6),
            replace(SMALL, roll=180, diameter=0.7, noise=3, fill=0.6),
        ),
    ],
)
def test_the_mark_is_seen_whatever_the_view(view: View) -> None:
    detection = detect(BOARD, replace(view, marked=True).render(BOARD))
    assert detection.marked and rms(detection.pixels - view.truth(BOARD)) < 0.5
    assert not detect(BOARD, view.render(BOARD)).marked


def test_dirt_like_a_mark_at_both_ends_tells_nothing() -> None:
    view = replace(SMALL, marked=True, fill=0.6)
    image = view.render(BOARD)
    both = np.minimum(image, np.rot90(image, 2))
    detection = detect(BOARD, both)
    assert not detection.marked
    assert rms(detection.pixels - view.truth(BOARD)) < 0.1


@pytest.mark.parametrize("roll", [145, 180, *often(0, 90, 270)])
def test_an_odd_asymmetric_board_is_numbered_by_its_own_pattern(roll: float) -> None:
    board, view = Board.parse("acircles:4x9:20"), replace(SMALL, roll=roll, tilt=20, fill=0.65)
    assert rms(detect(board, view.render(board)).pixels - view.truth(board)) < 0.15


@pytest.mark.parametrize(
    ("notation", "hide"),
    [
        ("circles:9x7:20", (-30, -30, 190, 10)),  # the first row
        ("acircles:4x11:20", (-30, -30, 190, 10)),
        # the last column, beside an even background, which looks like bars
        ("circles:9x7:20", (150, -30, 190, 190)),
        *often(("circles:9x7:20", (-30, -30, 10, 190)), ("acircles:4x11:20", (-30, -30, 190, 30))),
    ],
)
def test_hidden_circles_are_counted_not_guessed(
    notation: str, hide: tuple[float, float, float, float]
) -> None:
    board = Board.parse(notation)
    x, y = board.points[:, :2].T
    left = np.count_nonzero(~((x > hide[0]) & (y > hide[1]) & (x < hide[2]) & (y < hide[3])))
    with raises(DetectionError, f"{left} of {len(x)}"):
        detect(board, replace(SMALL, hide=hide, tilt=10, fill=0.6).render(board))


@pytest.mark.parametrize("notation", ["circles:9x7:20", "acircles:4x11:20"])
def test_partly_covered_circles_are_refused(notation: str) -> None:
    board = Board.parse(notation)
    with raises(DetectionError, f"of {len(board.points)}"):
        detect(board, replace(SMALL, hide=(-30, -30, 190, -1.5), tilt=10).render(board))


def test_a_stain_on_one_circle_is_refused() -> None:
    view = replace(SMALL, tilt=20)
    image = view.render(BOARD)
    u, v = np.round(view.truth(BOARD)[30]).astype(int).tolist()
    cv2.circle(image, (u + 9, v), 3, 40, -1, cv2.LINE_AA)
    with raises(DetectionError, "1 of 63"):
        detect(BOARD, image)


@pytest.mark.parametrize(
    ("shift", "seen"), [((130, 0), 42), ((-130, 0), 42), *often(((0, 100), 45), ((0, -100), 45))]
)
def test_what_is_in_view_of_a_board_is_numbered_by_its_borders(
    shift: tuple[int, int], seen: int
) -> None:
    view = replace(SMALL, fill=0.6, shift=shift)
    detection = detect(BOARD, view.render(BOARD))
    assert len(detection.ids) == seen
    assert rms(detection.pixels - view.truth(BOARD)[detection.ids]) < 0.1


def test_a_mark_numbers_what_no_border_does() -> None:
    board = Board.parse("circles:14x9:15")
    view = replace(SMALL, fill=1.2, shift=(90, 60))
    image = view.render(board)
    with raises(DetectionError, "of 126", "border"):
        detect(board, image)
    view = replace(view, marked=True)
    detection = detect(board, view.render(board))
    assert detection.marked and 60 < len(detection.ids) < 126
    assert rms(detection.pixels - view.truth(board)[detection.ids]) < 0.1


@pytest.mark.parametrize("shift", [(90, 60), *often(((-90, 60),), ((90, -60),), ((-90, -60),))])
def test_every_place_of_a_board_that_an_image_allows_is_listed(shift: tuple[int, int]) -> None:
    view = replace(SMALL, fill=0.8, shift=shift)
    image = view.render(BOARD)
    with raises(DetectionError, "border", "mark"):
        detect(BOARD, image)
    seen = detect(BOARD, image, several=True)
    truth = view.truth(BOARD)
    off = [rms(seen.pixels - truth[ids]) for ids in (seen.ids, *seen.others)]
    assert min(off) < 0.1 and len(off) == 4 and 20 < len(seen.ids) < 63
    own = board_mask(
        BOARD, replace(seen, ids=[seen.ids, *seen.others][np.argmin(off)], others=()), image.shape
    )
    sure = board_mask(BOARD, seen, image.shape)
    assert not (sure & ~own).any() and 0.5 * own.sum() < sure.sum() < own.sum()


def test_a_board_of_which_nothing_tells_what_is_in_view_is_refused() -> None:
    with raises(DetectionError, "of 63", "left and the right"):
        detect(BOARD, replace(SMALL, fill=1.3).render(BOARD))


@pytest.mark.parametrize("cut", [0.5, 0.7, *often(0.55, 0.6, 0.8, 0.9)])
def test_no_cut_view_is_numbered_wrongly(cut: float) -> None:
    rng = np.random.default_rng(int(100 * cut))
    refused = 0
    for notation in ("circles:9x7:20", "circles:14x9:15", "acircles:4x9:20"):
        board = Board.parse(notation)
        roll, tilt = rng.uniform(-40, 40), rng.uniform(0, 35)
        view = replace(SMALL, roll=roll, tilt=tilt, marked=True, fill=0.8)
        image, truth = view.render(board), view.truth(board)
        low, high = truth.min(0), truth.max(0)
        for sides in ((0,), (1,), (2,), (3,), (0, 2), (1, 3)):
            window = np.array([0, 0, *image.shape[::-1]])
            for side in sides:
                k = side // 2
                reach = cut * (high[k] - low[k])
                window[k + 2 * (side % 2)] = low[k] + reach if side % 2 else high[k] - reach
            u0, v0, u1, v1 = window
            try:
                seen = detect(board, image[v0:v1, u0:u1])
            except DetectionError:
                refused += 1
                continue
            off = [
                rms(seen.pixels + np.array([u0, v0]) - way[seen.ids])
                for way in (truth, truth[::-1])[: 1 if seen.marked else 2]
            ]
            assert min(off) < 0.15
    assert refused < 14


@pytest.mark.parametrize("wrong", ["circles:8x7:20", *often("circles:9x6:20", "circles:7x7:20")])
def test_a_larger_grid_than_stated_is_refused(wrong: str) -> None:
    with raises(DetectionError, "63 circles", "columns"):
        detect(Board.parse(wrong), replace(SMALL, tilt=15).render(BOARD))


def test_a_smaller_grid_than_stated_is_refused() -> None:
    # unless what it lacks may be beyond the image's border
    with raises(DetectionError, "63 of 70"):
        detect(Board.parse("circles:10x7:20"), replace(SMALL, tilt=15, fill=0.6).render(BOARD))


def test_a_transposed_notation_is_the_same_board_turned() -> None:
    image = replace(SMALL, tilt=15).render(BOARD)
    turned = detect(Board.parse("circles:7x9:20"), image).pixels.reshape(9, 7, 2)
    np.testing.assert_allclose(
        np.rot90(detect(BOARD, image).pixels.reshape(7, 9, 2)), turned, atol=1e-6
    )


def test_squares_are_not_taken_for_circles() -> None:
    chessboard = Board.parse("chessboard:9x7:20")
    with raises(DetectionError, "squares"):
        detect(
            Board.parse("acircles:5x8:20"), replace(SMALL, blur=0.5, fill=0.5).render(chessboard)
        )


def test_overexposure_is_named() -> None:
    image = replace(SMALL, paper=3000).render(BOARD)
    with raises(DetectionError, "exposure", f"{np.mean(image[::4, ::4] == 255):.0%}", "saturated"):
        detect(BOARD, image)


def test_an_empty_image_is_refused() -> None:
    for level in (0, 128):
        with raises(DetectionError, "circles", 63):
            detect(BOARD, np.full((300, 400), level, np.uint8))


def test_noise_is_refused() -> None:
    with raises(DetectionError, "circles", 63):
        detect(BOARD, np.random.default_rng(0).integers(0, 255, (300, 400), np.uint8))


def test_board_mask_covers_half_a_pitch_beyond_the_circles() -> None:
    view = replace(SMALL, tilt=30, axis=20)
    mask = board_mask(BOARD, detect(BOARD, view.render(BOARD)), (300, 400))
    expected = np.zeros((300, 400), np.uint8)
    cv2.fillConvexPoly(
        expected, np.int32(np.round(view.project(BOARD, BOARD.outline()) * 16)), 1, shift=4
    )
    assert mask.shape == (300, 400) and mask.dtype == bool
    assert np.count_nonzero(mask != expected.astype(bool)) < 0.002 * np.count_nonzero(mask)
