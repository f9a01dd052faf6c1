"""Printed edges, measured with and without the correction of blur."""

from dataclasses import replace

import pytest

from slviewer.simulation.rig import letter
from tests.proofs.surfaces import measure_object_edges, measure_ridges

pytestmark = [pytest.mark.computes, pytest.mark.slow]


@pytest.mark.parametrize(
    ("scale", "blur_px"), [(0.25, 0.6), pytest.param(0.5, 1.2, marks=pytest.mark.slow)]
)
def test_the_ridges_of_a_print_are_lower_by_a_factor_of_three(scale: float, blur_px: float) -> None:
    rig = letter(scale, 3)
    rig = replace(rig, sensor=replace(rig.sensor, psf_px=blur_px / scale))
    before, after = measure_ridges(rig)
    assert 1.0 < before < 10.0, "mm, beside a print of 1:9 contrast"
    assert 3 < before / after < 50


def test_the_edges_of_an_object_stay_as_they_are() -> None:
    before, after = measure_object_edges(letter(0.25, 3))
    assert 0.05 < after <= 1.01 * before < 0.5
