"""Regions of a surface, and surfaces cut by planes."""

import json

import numpy as np
import pytest
from facts import raises
from scipy.spatial.transform import Rotation

from slviewer.errors import InputError
from slviewer.inspection.regions import Region
from slviewer.inspection.section import (
    CutPlane,
    measure_cursors,
    nearest_on_section,
    radius_through,
    section,
)
from slviewer.records.record import from_plain, to_plain


def test_regions_hold_the_points_they_were_made_of() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(-5, 5, (30, 41, 3))
    points[3] = np.nan
    finite = np.isfinite(points[..., 0])
    ball, box = Region.ball([0, 0, 0], 3.0), Region.box([1, 1, 1], [-2, -2, -2])
    assert np.array_equal(
        ball.within(points), finite & (np.linalg.norm(np.nan_to_num(points), axis=-1) <= 3)
    )
    assert np.array_equal(
        box.within(points), finite & ((points >= -2) & (points <= 1)).all(axis=-1)
    )
    plain = {"kind": "ball", "centre": [1.0, 2.0, 3.0], "size": [4.0], "axes": None}
    assert to_plain(Region.ball([1, 2, 3], 4.0)) == plain


def test_regions_that_cannot_be_are_refused() -> None:
    with raises(InputError, "0 mm"):
        Region.ball([0, 0, 0], 0.0)
    with pytest.raises(InputError):
        Region.ball([0, np.nan, 0], 1.0)


def ball(radius: float) -> tuple[np.ndarray, np.ndarray]:
    import trimesh

    mesh = trimesh.creation.icosphere(4, radius)
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)


def test_a_ball_is_cut_in_a_circle_that_its_cursors_read() -> None:
    vertices, faces = ball(40.0)
    plane = CutPlane.through([-1, 0, 24], [1, 0, 24], [0, 1, 0])
    (line,) = section(vertices, faces, plane)
    assert np.array_equal(line[0], line[-1])  # closed
    radii = np.linalg.norm(line - [1, 0], axis=1)  # the first point is the drawing's origin
    assert np.allclose(radii, 32.0, atol=0.15)
    turns = np.diff(np.unwrap(np.arctan2(line[:, 1], line[:, 0] - 1)))
    assert (turns > 0).all() or (turns < 0).all()  # one point after the other
    a, b, c = line[[0, 40, 90]]
    assert radius_through(a, b, c).value == pytest.approx(32.0, abs=0.3)
    top = nearest_on_section([line], 1.0)
    assert top[1] == pytest.approx(32.0, abs=0.2)
    read = {q.name: q.value for q in measure_cursors(np.array([0.0, 1.0]), np.array([3.0, 5.0]))}
    assert read == {"distance": 5.0, "along": 3.0, "height difference": 4.0}


def test_an_open_surface_is_cut_in_lines_from_left_to_right_the_longest_first() -> None:
    u, v = np.meshgrid(np.arange(40.0), np.arange(30.0))
    points = np.stack([u, v, 500 - 2 * np.sin(u / 5)], -1)
    from slviewer.reconstruction.reconstruct import triangulate_grid

    points[:, 25] = np.nan  # a gap
    faces, vertices = triangulate_grid(points, 50.0), points[np.isfinite(points[..., 0])]
    plane = CutPlane.through([0, 12.5, 500], [10, 12.5, 500], [0, 0, -1])
    lines = section(vertices, faces, plane)
    assert [len(line) > 5 for line in lines] == [True, True] and np.ptp(
        lines[0][:, 0]
    ) == 24 > np.ptp(lines[1][:, 0])
    for line in lines:
        assert (np.diff(line[:, 0]) > 0).all() and np.allclose(
            line[:, 1], 2 * np.sin(line[:, 0] / 5), atol=0.03
        )
    assert from_plain(json.loads(json.dumps(to_plain(plane))), CutPlane).normal == pytest.approx(
        plane.normal
    )


def test_sections_that_cannot_be_are_refused() -> None:
    vertices, faces = ball(10.0)
    with pytest.raises(InputError):
        section(vertices, faces, CutPlane.through([0, 0, 11], [1, 0, 11], [0, 1, 0]))
    with pytest.raises(InputError):
        CutPlane.through([0, 0, 0], [0, 0, 0], [0, 1, 0])
    with pytest.raises(InputError):
        CutPlane.through([0, 0, 0], [0, 5, 0], [0, 1, 0])
    with raises(InputError, "line"):
        radius_through(np.zeros(2), np.ones(2), 3 * np.ones(2))


def test_a_box_along_a_view_holds_its_points_and_keeps_its_axes() -> None:
    axes = Rotation.from_rotvec([0.3, -0.5, 0.8]).as_matrix()
    rng = np.random.default_rng(1)
    inside = rng.uniform(-1, 1, (500, 3)) * [10, 5, 2] @ axes + [4, 5, 600]
    region = Region.around(inside, axes)
    assert region.within(inside).all()
    assert np.sort(region.size) == pytest.approx([2, 5, 10], rel=0.02)
    beyond = np.array([[11.0, 0, 0], [0, 6, 0], [0, 0, 3]]) @ axes + [4, 5, 600]
    assert not region.within(beyond).any()
    stored = from_plain({k: v for k, v in to_plain(region).items()}, Region)
    assert np.allclose(stored.axes, axes) and stored.within(inside).all()
    assert np.linalg.norm(
        region.edges()[:, 0] - region.edges()[:, 1], axis=1
    ).max() == pytest.approx(20, rel=0.02)
