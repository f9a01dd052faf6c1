"""Boards of circles among clutter: detected in place and in order, or refused for the right
reason."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from facts import raises
from hostile_board import Disc, Scene, blobs_around, lattice_around
from rendered_board import View
from variants import often

from slviewer.errors import DetectionError
from slviewer.target.board import Board
from slviewer.target.detect import detect

pytestmark = pytest.mark.computes

SYMMETRIC, ASYMMETRIC = Board.parse("circles:9x7:20"), Board.parse("acircles:4x11:20")
SIZE = (400, 300)
SCENE = Scene(size=SIZE, supersample=3, fill=0.6, sheet=0.6)


def hostile_scenes(board: Board, seed: int) -> Iterator[tuple[str, Scene]]:
    """Scenes by what is hostile in them, each view tilted and turned at random."""
    rng = np.random.default_rng(seed)
    shift = rng.uniform(-15, 15, 2)
    base = replace(
        SCENE,
        tilt=float(rng.uniform(0, 35)),
        axis=float(rng.uniform(0, 180)),
        roll=float(rng.uniform(-25, 25)),
        shift=(float(shift[0]), float(shift[1])),
    )
    blobs = blobs_around(board, seed, 40)
    warm = tuple((x, y, radius, 0.9) for x, y, radius, _ in blobs)
    between = [
        (x + 0.5, y + 0.5, 0.08, 0.1)
        for x in range(board.columns - 1)
        for y in range(board.rows - 1)
    ]
    glare = tuple(
        (float(rng.uniform(0, 400)), float(rng.uniform(0, 300)), 35.0, 90.0) for _ in range(3)
    )
    yield "many blobs", replace(base, discs=blobs_around(board, seed, 120))
    yield "blobs in a row", replace(base, discs=lattice_around(board, seed, 1.0, 0.25))
    yield "thermal", replace(base, inverted=True, blur=1.6, noise=4, contrast=0.4, discs=warm)
    yield "texture", replace(base, texture=35.0, noise=2)
    yield "low contrast", replace(base, contrast=0.12, noise=1.0, discs=blobs)
    yield "glare", replace(base, glare=glare, discs=blobs)
    yield "steep", replace(base, tilt=58.0, fill=0.7, discs=blobs)
    yield "small", replace(base, fill=0.35, discs=blobs)
    yield "uneven light", replace(base, shade=8, discs=blobs)
    if board.kind == "circles":
        yield "dots between", replace(base, discs=(*blobs, *between))


def distance(pixels: np.ndarray, truth: np.ndarray, half_turn: bool) -> np.ndarray:
    """(n,) px from the truth, of whose numbering a half turn may be the one that was taken."""
    straight = np.linalg.norm(pixels - truth, axis=1)
    turned = np.linalg.norm(pixels - truth[::-1], axis=1)
    return turned if half_turn and turned.max() < straight.max() else straight


@pytest.mark.slow
@pytest.mark.parametrize("board", [SYMMETRIC, *often(ASYMMETRIC)], ids=str)
def test_a_board_among_clutter_is_detected_in_order(board: Board) -> None:
    detected, errors = 0, []
    scenes = [scene for scene in hostile_scenes(board, 1)]
    for k, (name, scene) in enumerate(scenes):
        try:
            detection = detect(board, scene.render(board, k))
        except DetectionError:
            continue
        detected += 1
        off = distance(detection.pixels, scene.truth(board), board is SYMMETRIC)
        # centroids are not images of centres: a tenth of a pixel under a steep slant
        assert off.max() < 0.6, name
        assert not detection.marked, name
        errors.append(float(np.sqrt((off**2).mean())))
    assert detected >= len(scenes) - 1
    assert 0.005 < np.median(errors) < 0.1


def corners_of(board: Board, away: float, radius: float) -> tuple[Disc, ...]:
    """Discs on the diagonals of the grid's four corners, as screws and holes of boards are."""
    high = board.points[:, :2].max(0) / board.pitch_mm
    return tuple(
        (x, y, radius, 0.08) for x in (-away, high[0] + away) for y in (-away, high[1] + away)
    )


@pytest.mark.parametrize(
    "clutter",
    [
        corners_of(SYMMETRIC, 0.8, 0.2)[:1],  # a screw
        ((-0.8, -0.5, 0.13, 0.08),),  # a dot of the mark's size beside its place
        *often(
            (corners_of(SYMMETRIC, 0.6, 0.25)[3:],),
            (corners_of(SYMMETRIC, 0.62, 0.04)[:1],),  # a speck of dirt
            (((9.0, 6.9, 0.5, 0.08),),),
            (tuple((x, -0.65, 0.12, 0.08) for x in np.linspace(-0.9, 3.0, 14)),),  # a line of print
        ),
    ],
)
def test_what_lies_beside_a_board_is_no_mark(clutter: tuple[Disc, ...]) -> None:
    view = replace(SCENE, sheet=1.3, roll=170, fill=0.55)
    plain = detect(SYMMETRIC, view.render(SYMMETRIC))
    cluttered = detect(SYMMETRIC, replace(view, discs=clutter).render(SYMMETRIC))
    assert not plain.marked and not cluttered.marked
    np.testing.assert_allclose(cluttered.pixels, plain.pixels, atol=0.2)


@pytest.mark.slow
def test_warm_spots_beyond_the_edge_of_a_thermal_board_are_no_mark() -> None:
    rng, detected = np.random.default_rng(4), 0
    for k in range(12):
        spots = tuple(
            (-0.625 + a, -0.625 + b, float(rng.uniform(0.1, 0.3)), 1.0)
            for a, b in rng.uniform(-0.3, 0.3, (3, 2))
        )
        view = replace(SCENE, inverted=True, blur=1.5, noise=3, roll=180, sheet=0.4, discs=spots)
        try:
            detection = detect(SYMMETRIC, view.render(SYMMETRIC, k))
        except DetectionError:  # a spot touches the first circle
            continue
        detected += 1
        assert not detection.marked
        assert distance(detection.pixels, view.truth(SYMMETRIC)[::-1], False).max() < 1.0, (
            "numbered by the rule"
        )
    assert detected >= 4


@pytest.mark.parametrize("roll", [*often(0.0), 180.0])
def test_a_marked_board_among_clutter_starts_at_its_mark(roll: float) -> None:
    for seed in range(2):
        around = blobs_around(SYMMETRIC, seed, 60, sheet=1.2)
        scene = replace(
            SCENE, sheet=1.3, roll=roll, tilt=20, fill=0.55, marked=True, discs=around, noise=2
        )
        detection = detect(SYMMETRIC, scene.render(SYMMETRIC, seed))
        assert detection.marked
        assert np.linalg.norm(detection.pixels - scene.truth(SYMMETRIC), axis=1).max() < 0.3


def test_one_more_row_that_belongs_to_the_grid_is_refused() -> None:
    for share in (0.5, 1.0):
        scene = replace(SCENE, sheet=1.3, tilt=15, discs=lattice_around(SYMMETRIC, 0, share))
        with raises(DetectionError, "circles:9x7:20", 63):
            detect(SYMMETRIC, scene.render(SYMMETRIC))


def test_of_two_boards_the_much_larger_is_taken_and_of_two_alike_none() -> None:
    small = View(size=SIZE, supersample=3, fill=0.24, shift=(140.0, 60.0), sheet=0.6)
    scene = replace(SCENE, fill=0.5, shift=(-60.0, 0.0), second=small, roll=5)
    detection = detect(SYMMETRIC, scene.render(SYMMETRIC))
    assert np.linalg.norm(detection.pixels - scene.truth(SYMMETRIC), axis=1).max() < 0.2
    mirrored = replace(
        scene, fill=0.4, shift=(-100.0, 0.0), second=replace(small, fill=0.38, shift=(90.0, 0.0))
    )
    with raises(DetectionError, "2 boards", "circles:9x7:20"):
        detect(SYMMETRIC, mirrored.render(SYMMETRIC))


def test_a_covered_circle_among_clutter_is_left_out_not_replaced() -> None:
    blobs = blobs_around(SYMMETRIC, 3, 40)
    for hidden in (0, 31):
        x, y = SYMMETRIC.points[hidden, :2]
        scene = replace(SCENE, tilt=15, discs=blobs, hide=(x - 8, y - 8, x + 8, y + 8))
        detection = detect(SYMMETRIC, scene.render(SYMMETRIC))
        assert set(range(63)) - set(detection.ids.tolist()) == {hidden}
        assert distance(detection.pixels, scene.truth(SYMMETRIC)[detection.ids], False).max() < 0.5


@pytest.mark.parametrize("shift", [110, *often(80, 140)])
def test_a_board_that_reaches_beyond_the_image_says_at_which_side(shift: int) -> None:
    with raises(DetectionError, "of 63", "right"):
        detect(SYMMETRIC, replace(SCENE, shift=(shift, 0)).render(SYMMETRIC))
