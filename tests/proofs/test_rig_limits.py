"""Rigs at their limits: where their projectors are, and that planes are at the noise floor."""

from pathlib import Path

import numpy as np
import pytest

from tests.proofs.limits import MOST_FLOORS, RIGS, measure_limit


@pytest.mark.parametrize("name", RIGS)
def test_a_projector_is_where_it_is_said_to_be_and_aims_at_the_middle(name: str) -> None:
    limit = RIGS[name]
    rig, poses = limit.build(0.25, 1)
    middle = np.array([0.0, 0.0, limit.camera_mm * limit.scale])
    off = np.abs(rig.project(middle) - np.array(rig.projector.size) / 2)
    # but for its distortion, and what keystone moves
    assert off.max() < (0.15 if limit.keystone else 0.1) * max(rig.projector.size)
    away = rig.projector_centre - middle
    assert np.arccos(-away[2] / np.linalg.norm(away)) == pytest.approx(np.radians(limit.angle))
    assert np.arctan2(away[1], away[0]) % (2 * np.pi) == pytest.approx(
        np.radians(limit.around) % (2 * np.pi)
    )
    depths = np.array([pose.t[2] for pose in poses]) / limit.scale - limit.back_mm
    assert 400 < depths.min() < depths.max() < 800


@pytest.mark.parametrize("name", ["fisheye of 120 degrees", "pixels twice as high"])
def test_a_lens_at_its_limit_undoes_its_own_projection(name: str) -> None:
    camera = RIGS[name].build(0.25, 1)[0].camera
    rays = camera.rays()
    known = np.isfinite(rays).all(axis=-1)
    assert known.mean() > 0.95
    points = np.concatenate([rays, np.ones_like(rays[..., :1])], axis=-1)
    rows, columns = np.nonzero(known)
    off = camera.project(points[known]) - np.column_stack([columns, rows])
    assert np.abs(off).max() < 1e-6


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name, limit in RIGS.items() if limit.limited_by])
def test_what_limits_a_rig_is_named(name: str, tmp_path: Path) -> None:
    figures = measure_limit(RIGS[name], 0.25, 5, tmp_path / "session")
    assert RIGS[name].limited_by in f"{figures.get('refused')} {figures.get('findings')}"


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["projector above", "field of 8 mm, out of focus", "pixels twice as high"]
)
def test_a_rig_at_its_limit_measures_planes_at_the_floor(name: str, tmp_path: Path) -> None:
    figures = measure_limit(RIGS[name], 0.25, 5, tmp_path / "session")
    ratio = figures["ratio"]
    assert isinstance(ratio, float) and 0.8 < ratio < MOST_FLOORS, figures
