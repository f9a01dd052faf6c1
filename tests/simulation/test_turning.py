"""The stone on the turntable: closed, without symmetry, and seen from the rig in every step."""

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from slviewer.simulation.renderer import Renderer
from slviewer.simulation.rig import letter
from slviewer.simulation.turning import AXIS, AXIS_POINT, STEPS, stone, turning


@pytest.mark.slow
@pytest.mark.computes
def test_the_stone_is_closed_and_stands_on_a_flat_foot() -> None:
    vertices, triangles = stone()
    mesh = trimesh.Trimesh(vertices, triangles, process=False)
    assert mesh.is_watertight and mesh.volume > 3e5
    assert (mesh.extents > 75).all() and (mesh.extents < 135).all()
    foot = vertices[:, 2] < vertices[:, 2].min() + 1e-6
    assert np.ptp(vertices[foot, 0]) > 60 and vertices[:, 2].max() > 45


def test_the_table_turns_it_about_one_axis_before_the_rig() -> None:
    scenes = turning()
    assert list(scenes)[:2] == ["turn_01", "turn_02"] and len(scenes) == STEPS
    first, second, last = (scenes[name].pose for name in ("turn_01", "turn_02", "turn_12"))
    for before, after in ((first, second), (last, first)):
        R = after.R @ before.R.T
        np.testing.assert_allclose(
            np.degrees(Rotation.from_matrix(R).as_rotvec()), 30.0 * AXIS, atol=1e-9
        )
        np.testing.assert_allclose(R @ (before.t - AXIS_POINT) + AXIS_POINT, after.t, atol=1e-9)
    truth = Renderer(letter(0.08), scenes["turn_05"]).truth()
    seen = np.isfinite(truth.points[..., 2])
    assert truth.mask.sum() > 0.8 * seen.sum() > 800
    assert not (seen[0].any() or seen[-1].any() or seen[:, 0].any() or seen[:, -1].any())
    assert np.nanmin(truth.points[..., 2]) > 500 and np.nanmax(truth.points[..., 2]) < 700
