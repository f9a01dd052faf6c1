"""Several models on one capture: the same pixels, each its own fit; histograms and tables."""

import json

import numpy as np
import pytest
from facts import missing_facts, raises
from planted import board_before_a_wall, cloud, plane_depth, rectangle, sphere_depth

from slviewer.errors import InputError
from slviewer.evaluation import letter
from slviewer.evaluation.fit import Comparison, fit_clouds, incidence
from slviewer.reconstruction.cloud import Cloud
from slviewer.records.record import render_text, to_plain
from slviewer.records.verification import Verification, average


def seen(points: np.ndarray, model: str, sigma: float = 0.05) -> Cloud:
    return Cloud(points, "x", model, np.full(points.shape[:2], sigma, np.float32))


@pytest.fixture(scope="module")
def two() -> tuple[dict[str, Cloud], np.ndarray, Comparison]:
    first, board = board_before_a_wall(0.10, 1)
    second, _ = board_before_a_wall(0.05, 2)
    second[..., 2] += 1.0  # a plane of its own, which its own fit forgives
    second[:, :150] = np.nan
    illuminated = board.copy()
    illuminated[:, 300:] = False
    clouds = {"stereo": seen(first, "stereo", 0.10), "pixelwise": seen(second, "pixelwise")}
    return clouds, board, fit_clouds("plane", clouds, illuminated, depth_range=(590.0, 610.0))


def test_every_model_is_measured_over_the_common_pixels(
    two: tuple[dict[str, Cloud], np.ndarray, Comparison],
) -> None:
    result = two[2]
    stereo, pixelwise = result.results["stereo"], result.results["pixelwise"]
    assert stereo.points == pixelwise.points == result.common.sum()
    assert not result.common[:, :150].any()
    assert 0.09 < stereo.rms_mm < 0.105
    assert 0.045 < pixelwise.rms_mm < 0.052
    assert stereo.noise_floor_mm == pytest.approx(stereo.rms_mm, rel=0.02)
    assert pixelwise.noise_floor_mm == pytest.approx(pixelwise.rms_mm, rel=0.02)
    assert result.coverage["stereo"] == 1.0
    lit_columns = 300 - 52
    assert result.coverage["pixelwise"] == pytest.approx(150 / lit_columns, abs=0.02)
    assert result.warnings == []


def test_a_larger_wall_that_one_model_alone_measures_is_not_the_shape() -> None:
    board = rectangle((130, 280), (80, 230))
    everywhere = cloud(np.where(board, plane_depth(), plane_depth(900.0, (0.0, 0.1))), 0.05)
    near = everywhere.copy()
    near[~rectangle((140, 270), (90, 220))] = np.nan
    for order in (1, -1):
        clouds = dict(
            list(
                {"stereo": seen(everywhere, "stereo"), "pixelwise": seen(near, "pixelwise")}.items()
            )[::order]
        )
        result = fit_clouds("plane", clouds, board)
        assert not result.region[~board].any()
        assert result.region.sum() > 0.9 * board.sum()
        assert result.results["stereo"].points == result.results["pixelwise"].points == 130 * 130
        assert 0.04 < result.results["stereo"].rms_mm < 0.055


def test_a_given_region_is_taken_as_it_is() -> None:
    points, board = board_before_a_wall()
    points[40:60, 60:90] = np.nan
    result = fit_clouds("plane", {"stereo": seen(points, "stereo")}, board, region=board)
    assert result.results["stereo"].points == board.sum() - 600
    assert result.coverage["stereo"] == pytest.approx(1 - 600 / board.sum())


def test_what_is_not_known_is_none_in_json() -> None:
    points, _ = board_before_a_wall()
    record = fit_clouds("plane", {"stereo": seen(points, "stereo")}).record()
    figures = json.loads(json.dumps(to_plain(record)))
    assert figures["incidence"] is None
    assert figures["models"]["stereo"]["coverage"] is None
    assert figures["models"]["stereo"]["radius_mm"] is None
    assert 0.04 < figures["models"]["stereo"]["rms_mm"] < 0.06


def test_models_without_common_pixels_are_refused() -> None:
    left, board = board_before_a_wall()
    right = left.copy()
    left[:, 180:] = np.nan
    right[:, :180] = np.nan
    with raises(InputError, "left"):
        fit_clouds(
            "plane", {"left": seen(left, "left"), "right": seen(right, "right")}, region=board
        )
    with raises(InputError, "left", "right", 0):
        fit_clouds("plane", {"left": seen(left, "left"), "right": seen(right, "right")})
    with pytest.raises(InputError):
        fit_clouds("plane", {"left": seen(left, "left"), "right": seen(right[:100], "right")})
    with pytest.raises(InputError):
        fit_clouds("plane", {})


def test_a_sphere_reports_its_radius() -> None:
    points = cloud(sphere_depth((0.0, 0.0, 650.0), 98.0), 0.04)
    result = fit_clouds("sphere", {"stereo": seen(points, "stereo", 0.04)}, radius=98.0)
    assert result.record().models["stereo"].radius_mm == pytest.approx(98.0, abs=0.01)
    (table,) = Verification.tables({"ball": result.record()})
    assert "98.0" in render_text(table)


def test_incidence_counts_points_by_depth() -> None:
    z = np.repeat(np.arange(400.0, 800.0)[None], 300, axis=0)  # columns at 400 ... 799 mm
    points = cloud(z)
    everywhere = np.ones(z.shape, bool)
    assert incidence(points, everywhere, (500.0, 700.0)) == {"R1": 25.0, "R2": 50.25, "R3": 24.75}
    points[:, :100] = np.nan
    assert incidence(points, everywhere, (500.0, 700.0))["R1"] == 0.0
    assert incidence(points, z < 600, (500.0, 700.0)) == {"R1": 0.0, "R2": 100.0, "R3": 0.0}
    with raises(InputError, 700, 500):
        incidence(points, everywhere, (700.0, 500.0))
    with pytest.raises(InputError):
        incidence(points, z < 450, (500.0, 700.0))


def test_the_letters_tables_have_its_means() -> None:
    planes, spheres = average("plane", letter.TABLE_1), average("sphere", letter.TABLE_2)
    stereo, pixelwise = planes.rms_mm.values()
    assert [stereo, pixelwise] == pytest.approx([0.184, 0.087], abs=6e-4)
    assert stereo / pixelwise == pytest.approx(2.13, abs=0.005)
    ratios = [row.rms_mm["stereo"] / row.rms_mm["pixelwise"] for row in letter.TABLE_1]
    assert max(ratios) == pytest.approx(3.59, abs=0.005)
    shares = [row.incidence or {} for row in letter.TABLE_1]
    assert all(sum(each.values()) == pytest.approx(100.0, abs=0.11) for each in shares)
    assert [i for i, each in enumerate(shares, 1) if each["R2"] >= 87.0] == [3, 4, 9, 10]
    assert [*spheres.rms_mm.values()] == pytest.approx([0.091, 0.072], abs=6e-4)
    assert [*spheres.radii_mm.values()] == pytest.approx([98.256, 98.060], abs=1e-3)


def test_the_letters_pose_has_the_number_of_the_capture() -> None:
    assert letter.find_pose("plane_03", "plane").rms_mm["stereo"] == 0.144
    assert letter.find_pose("sphere_2", "sphere").radii_mm["pixelwise"] == 98.0
    for name in ("sphere_7", "sphere_0", "ball"):
        assert letter.find_pose(name, "sphere").models == {}


def test_a_plane_far_off_the_depths_is_all_in_one_range() -> None:
    points = cloud(plane_depth(440.0), 0.02)
    result = fit_clouds(
        "plane", {"stereo": seen(points, "stereo")}, depth_range=letter.DEPTH_RANGE_MM
    )
    assert result.incidence == {"R1": 100.0, "R2": 0.0, "R3": 0.0}


def test_a_plane_that_is_a_minor_part_of_the_scene_is_told_with_its_place() -> None:
    board = rectangle((60, 140), (50, 110))
    u = np.arange(board.shape[1])[None, :]
    rough = plane_depth(900.0) + 40.0 * np.sin(u / 6.0)
    points = cloud(np.where(board, plane_depth(), rough), 0.05)
    result = fit_clouds("plane", {"stereo": seen(points, "stereo")}, np.ones(board.shape, bool))
    assert 0.0 < result.share < 0.5 and result.record().share == result.share
    place = f"{100 * result.share:.0f} %", result.region_text()
    assert [missing_facts(warning, *place) for warning in result.warnings].count([]) == 1
    rows, columns = (np.flatnonzero(result.region.any(axis=axis)) for axis in (1, 0))
    assert missing_facts(result.region_text(), columns[0], columns[-1], rows[0], rows[-1]) == []
    given = fit_clouds("plane", {"stereo": seen(points, "stereo")}, region=board)
    # it was not searched for
    assert all(missing_facts(warning, given.region_text()) for warning in given.warnings)


def test_an_rms_far_above_the_floor_by_every_model_is_told() -> None:
    v = np.arange(plane_depth().shape[0])[:, None]
    bent = cloud(plane_depth() + 0.6 * np.sin(v / 10.0), 0.05)
    result = fit_clouds("plane", {"stereo": seen(bent, "stereo"), "splined": seen(bent, "splined")})
    ratios = {name: each.rms_mm / each.noise_floor_mm for name, each in result.results.items()}
    best = min(ratios, key=lambda name: ratios[name])
    facts = "noise floor", "plane", f"{ratios[best]:.1f}", best
    assert [missing_facts(warning, *facts) for warning in result.warnings].count([]) == 1
