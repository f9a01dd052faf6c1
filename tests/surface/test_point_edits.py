"""The region of interest, selections and edits, on scans whose points are known."""

import numpy as np
import pytest
from ball_scans import ball
from facts import raises

from slviewer.errors import InputError
from slviewer.surface.region_of_interest import RegionOfInterest, crop_mask
from slviewer.surface.selection import (
    Edit,
    EditHistory,
    ViewCamera,
    detect_support,
    make_edit,
    pack_mask,
    select_along_path,
    select_connected,
    select_in_outline,
    select_polygon,
    unpack_mask,
)

CAMERA = ViewCamera(np.zeros(3), np.eye(3), np.radians(40.0), 4 / 3)


def on_table(
    noise: float = 0.05, size: tuple[int, int] = (120, 90)
) -> tuple[np.ndarray, np.ndarray]:
    """Points (h, w, 3) mm of a block 20 mm high on a tilted table, with a floor 30 mm deeper; which
    are the block."""
    w, h = size
    v, u = np.mgrid[:h, :w].astype(float)
    rays = np.stack([(u - w / 2) / (2 * w), (v - h / 2) / (2 * w), np.ones_like(u)], axis=-1)
    normal = np.array([0.0, -0.6, -0.8])
    block = (np.abs(u - w / 2) < 15) & (np.abs(v - h / 2) < 12)
    floor = u < 12
    offsets = -320.0 + np.where(block, 20.0, 0.0) - np.where(floor, 30.0, 0.0)
    z = offsets / (rays @ normal) + noise * np.random.default_rng(3).normal(size=(h, w))
    points = (rays * z[..., None]).astype(np.float32)
    points[:3] = np.nan
    return points, block


def test_a_turned_box_holds_what_lies_between_its_sides() -> None:
    region = RegionOfInterest((10.0, -5.0, 400.0), (40.0, 20.0, 60.0), (0.0, 0.0, 30.0))
    T = region.T_camera_box
    local = np.random.default_rng(0).uniform(-1, 1, (2000, 3)) * 50
    inside = (np.abs(local) <= [20, 10, 30]).all(axis=1)
    assert np.array_equal(region.contains(local @ T[:3, :3].T + T[:3, 3]), inside)
    assert not region.contains(np.full((2, 3), np.nan)).any()
    lengths = np.linalg.norm(np.diff(region.edges(), axis=1)[:, 0], axis=1)
    assert np.allclose(np.sort(lengths), np.repeat([20, 40, 60], 4))
    again = RegionOfInterest.placed(T, region.size_mm)
    assert np.allclose(again.T_camera_box, T)
    assert np.allclose(again.rotation_deg, region.rotation_deg)


def test_a_region_around_points_holds_them_and_not_much_more() -> None:
    points = ball(300.0, 0.05, 1).points
    region = RegionOfInterest.around(points)
    share = region.contains(points).sum() / np.isfinite(points[..., 2]).sum()
    span = np.nanmax(points, axis=(0, 1)) - np.nanmin(points, axis=(0, 1))
    assert share == 1.0
    assert (np.array(region.size_mm) < 1.5 * span.max()).all()
    with pytest.raises(InputError):
        RegionOfInterest.around(np.full((4, 4, 3), np.nan))


def test_a_region_without_points_is_refused_with_numbers() -> None:
    points = ball(300.0, 0.05, 1).points
    with raises(
        InputError,
        "scan_1",
        f"{np.isfinite(points[..., 2]).sum()} points",
        "z",
        f"{np.nanmin(points[..., 2]):.0f}",
    ):
        crop_mask("scan_1", points, RegionOfInterest.between([-10, -10, 900], [10, 10, 950]))
    for wrong in ((0.0, 1.0, 1.0), (np.nan, 1.0, 1.0), (-1.0, 1.0, 1.0), (1e9, 1.0, 1.0)):
        with pytest.raises(InputError):
            RegionOfInterest((0.0, 0.0, 0.0), wrong)


def test_an_outline_selects_what_any_view_shows_inside() -> None:
    points, _ = on_table()
    at = CAMERA.project(points.astype(float))
    outline = np.array([[0.3, 0.3], [0.7, 0.3], [0.5, 0.8]])
    chosen = select_in_outline(points, CAMERA, outline)
    a, b, c = outline

    def side(p: np.ndarray, q: np.ndarray) -> np.ndarray:
        return (q[0] - p[0]) * (at[..., 1] - p[1]) - (q[1] - p[1]) * (at[..., 0] - p[0])

    truth = (side(a, b) > 0) & (side(b, c) > 0) & (side(c, a) > 0)
    assert truth.sum() > 500
    assert (chosen != truth).sum() < 0.01 * truth.sum()
    behind = ViewCamera(np.array([0.0, 0.0, 2000.0]), np.eye(3), 0.7, 1.0)
    assert not select_in_outline(points, behind, outline).any()
    # from the side, the same pixels are named
    turned = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
    side_view = ViewCamera(np.array([-600.0, 0.0, 400.0]), turned, 0.9, 1.5)
    whole = select_in_outline(points, side_view, [(0, 0), (1, 0), (1, 1), (0, 1)])
    assert whole.sum() > 0.9 * np.isfinite(points[..., 2]).sum()
    with pytest.raises(InputError):
        select_in_outline(points, CAMERA, outline[:2])


def test_a_brush_selects_what_lies_within_its_radius() -> None:
    points, _ = on_table()
    view = ViewCamera(CAMERA.position, CAMERA.R_scene_view, CAMERA.fov_rad, 1.6)
    at = view.project(points.astype(float)) * [1.6, 1.0]
    path = np.array([[0.4, 0.3], [0.6, 0.7]])
    chosen = select_along_path(points, view, path, 0.1)
    start, end = path * [1.6, 1.0]
    share = np.clip((at - start) @ (end - start) / ((end - start) @ (end - start)), 0, 1)
    truth = np.linalg.norm(at - start - share[..., None] * (end - start), axis=-1) < 0.1
    assert truth.sum() > 500
    assert (chosen != truth).sum() < 0.01 * truth.sum()
    dot = select_along_path(points, view, path[:1], 0.1)
    near = np.linalg.norm(at - start, axis=-1) < 0.1
    assert near.sum() > 100 and (dot != near).sum() < 0.02 * near.sum()
    with pytest.raises(InputError):
        select_along_path(points, view, path[:0], 0.1)


def test_the_connected_part_ends_at_jumps() -> None:
    points, block = on_table(0.0)
    part = select_connected(points, (60, 45))
    truth = block & np.isfinite(points[..., 2])
    assert truth[45, 60]
    assert np.array_equal(part, truth)
    with raises(InputError, "(5, 1)"):
        select_connected(points, (5, 1))
    without = np.ones(block.shape, bool)
    without[:, 60] = False
    halves = select_connected(points, (58, 45), without)
    assert 0.3 * truth.sum() < halves.sum() < 0.7 * truth.sum()


def test_the_support_and_what_is_below_it_are_selected() -> None:
    points, block = on_table()
    plane = detect_support(points, 0.05)
    assert np.degrees(np.arccos(np.dot(plane.normal, [0.0, -0.6, -0.8]))) < 0.1
    assert abs(plane.offset_mm + 320.0) < 0.05
    below = plane.select_below(points)
    assert not (below & block).any()
    measured = np.isfinite(points[..., 2])
    assert (below & measured).sum() > 0.995 * (measured & ~block).sum()
    with raises(InputError, "plane", "3600 points"):
        scattered = np.random.default_rng(0).uniform(100, 200, (60, 60, 3)).astype(np.float32)
        detect_support(scattered, 0.01)


def test_edits_are_undone_and_redone_without_limit() -> None:
    points, block = on_table()
    history = EditHistory()
    masks = [
        select_polygon(block.shape, np.array([[k, 10], [k + 1, 10], [k + 1, 60], [k, 60]]))
        for k in range(60)
    ]
    for mask in masks:
        history = history.add(make_edit(points, mask, "rectangle"))
    removed = np.isfinite(points[..., 2]) & ~history.keep_mask(points)
    assert np.array_equal(removed, np.logical_or.reduce(masks) & np.isfinite(points[..., 2]))
    back = history.undo(60)
    assert np.array_equal(back.keep_mask(points), np.isfinite(points[..., 2]))
    assert np.array_equal(back.redo(60).keep_mask(points), history.keep_mask(points))
    assert not back.redo(3).add(history.edits[0]).undone
    for wrong in (back.undo, lambda: history.redo(), lambda: history.undo(61)):
        with pytest.raises(InputError):
            wrong()


def test_edits_survive_another_calibration() -> None:
    """The same pixels go, and what lies below the same plane, when the points move a little."""
    points, block = on_table()
    plane = detect_support(points, 0.05)
    history = EditHistory().add(make_edit(points, plane.select_below(points), "support", plane))
    history = history.add(
        make_edit(
            points, select_connected(np.where(block[..., None], points, np.nan), (50, 40)), "part"
        )
    )
    assert not history.keep_mask(points).any()
    other = points * np.float32(1.0003)
    other[:3] = points[5]
    assert not history.undo().keep_mask(other)[3:][~block[3:]].any()
    assert not history.keep_mask(other)[block].any()


def test_what_cannot_be_an_edit_is_refused() -> None:
    points, block = on_table()
    with raises(InputError, "selected"):
        make_edit(points, np.zeros_like(block), "rectangle")
    with pytest.raises(InputError):
        Edit("both", 1)
    with raises(InputError, "'box'", "120x90", "120x40"):
        EditHistory().add(make_edit(points, block, "box")).keep_mask(points[:40])


def test_masks_are_packed_without_loss_and_bounded_when_read() -> None:
    _, block = on_table()
    packed = pack_mask(block)
    assert packed.size < block.size / 50
    assert np.array_equal(unpack_mask(packed, (120, 90)), block)
    for wrong, size in (
        (packed[:-6], (120, 90)),
        (packed, (121, 91)),
        (packed, (64, 64)),
        (packed, (0, 5)),
    ):
        with pytest.raises(InputError):
            unpack_mask(wrong, size)
