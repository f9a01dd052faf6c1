"""Drawn parts with faults: their truth, and that no verdict contradicts it."""

import numpy as np
import pytest

from tests.proofs.faulty_parts import Patch, fit_true
from tests.proofs.plan_faults import prove_plan_faults


@pytest.mark.parametrize("kind", ["plane", "cylinder", "sphere"])
def test_true_shape_is_that_of_its_points(kind: str) -> None:
    rng = np.random.default_rng(1)
    patch = Patch(kind, kind, np.array([3.0, -2.0, 5.0]), (6.0, 4.0))  # type: ignore[arg-type]
    points, normals = patch.points(patch.draw(500, rng))
    found = fit_true(patch, points + 0.1 * normals, patch.axes[2])
    assert np.abs(found.off).max() < 1e-6
    if kind != "plane":
        assert found.radius == pytest.approx(6.1, abs=1e-6)


@pytest.mark.slow
@pytest.mark.computes
@pytest.mark.parametrize("seed", [3, 4])
def test_no_wrong_part_passes(seed: int) -> None:
    proof = prove_plan_faults(0.05, seed, lambda share, message: None)
    assert proof.holds, proof.text()
