"""Light that surfaces throw on themselves: form factors of known shapes, linearity, and what it
does to decoding."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from slviewer.fringe.decode import decode
from slviewer.fringe.presets import micro, p18
from slviewer.fringe.sequence import one_axis
from slviewer.simulation.boards import Pose
from slviewer.simulation.concave import Indirect, bowl, groove, wax
from slviewer.simulation.plans import rotation
from slviewer.simulation.renderer import Renderer
from slviewer.simulation.rig import letter

pytestmark = pytest.mark.computes

RIG = letter(0.3)
POSE = Pose(rotation(np.radians([0, 15, 0])), np.array([0, 0, 640.0]))


@cache
def coordinate_errors(sequence_of, angle_deg=90.0, bounces=2):
    """Return errors (n,) px and predicted sigmas (n,) px of the valid pixels of a groove."""
    renderer = Renderer(RIG, groove(POSE, angle_deg, indirect=Indirect(bounces)))
    sequence = one_axis(sequence_of(RIG.projector.size), "x")
    phase, truth = (
        decode(sequence, renderer.capture(sequence, 1), "x", mask_indirect=False),
        renderer.truth(),
    )
    valid = phase.mask & truth.mask
    assert valid.sum() > 0.9 * truth.mask.sum()
    return (phase.coordinate - truth.projector[..., 0])[valid], phase.sigma_px[valid]


@pytest.mark.slow
def test_a_wall_of_a_groove_receives_what_the_formula_of_two_strips_says():
    """In the middle of a long wall: (1 + (cos a - s) / sqrt(1 + s^2 - 2 s cos a)) / 2 at s widths
    from the fold."""
    short = groove(Pose(np.eye(3), np.array([0, 0, 640.0])), 70)
    scene = replace(short, vertices=short.vertices * [1, 10, 1])
    middle = np.flatnonzero(np.abs(scene.vertices[:, 1]) < 1e-6)
    factors = scene._form_factors[middle].sum(axis=1)
    x, _, z = scene.vertices[middle].T
    s, c = np.hypot(x, z) / 60, np.cos(np.radians(70))
    # Seen from the point, the direction of the other wall's far edge.
    expected = (1 + (c - s) / np.sqrt(1 + s**2 - 2 * s * c)) / 2
    away = s > 0.05
    assert away.sum() > 20
    assert factors[away] == pytest.approx(expected[away], abs=0.01)


@pytest.mark.slow
def test_every_point_of_a_sphere_receives_the_same_light_from_each_part_of_it():
    scene = bowl(Pose(np.eye(3), np.array([0, 0, 640.0])), 60, 60)
    total = scene._form_factors.sum(axis=1)  # the cap's area over the sphere's: (1 - cos 60) / 2
    inner = np.hypot(*scene.vertices[:, :2].T) < 40
    assert total[inner] == pytest.approx(0.25, abs=0.015)


@pytest.mark.slow
def test_indirect_light_adds_up_and_needs_bounces():
    once, twice = (groove(POSE, indirect=Indirect(n)).light_matrix(RIG, "x") for n in (1, 2))
    assert np.all(once >= 0) and 1.02 < twice.sum() / once.sum() < 1.5
    assert not groove(POSE, indirect=Indirect(0)).light_matrix(RIG, "x").any()
    glossy = groove(POSE, indirect=Indirect(1, gloss=0.5)).light_matrix(RIG, "x")
    assert 0.5 < glossy.sum() / once.sum() < 2 and abs(glossy - once).max() > 0.2 * once.max()


@pytest.mark.slow
def test_scattered_light_keeps_its_amount_away_from_the_border():
    scene = wax(POSE)
    inner = np.abs(scene.vertices[:, :2]).max(axis=1) < 25
    assert scene._scattering.sum(axis=1)[inner] == pytest.approx(1.0, abs=0.1)


@pytest.mark.slow
def test_fine_stripes_average_in_the_light_of_other_surfaces():
    matrix = groove(POSE).light_matrix(RIG, "x")
    columns = np.arange(matrix.shape[1])
    depth = {}
    for period in (12.0, 400.0):
        wave = matrix @ np.exp(2j * np.pi * columns / period)
        depth[period] = np.median(np.abs(wave) / np.maximum(matrix.sum(axis=1), 1e-9))
    assert depth[12.0] < 0.1 and depth[400.0] > 0.4


@pytest.mark.slow
def test_micro_phase_shifting_measures_a_groove_that_misleads_gray_code():
    misled, _ = coordinate_errors(p18)
    fine, sigma = coordinate_errors(micro)
    assert 0.5 < np.sqrt(np.mean(misled**2)) < 3
    assert 0.04 < np.sqrt(np.mean(fine**2)) < np.sqrt(np.mean(misled**2)) / 5
    assert np.mean(np.abs(fine) > 5 * sigma) < 0.03


@pytest.mark.slow
def test_without_bounces_both_measure_to_the_noise():
    for sequence_of in (p18, micro):
        errors, sigma = coordinate_errors(sequence_of, bounces=0)
        assert 0.9 < np.sqrt(np.mean((errors / sigma) ** 2)) < 2
        assert np.abs(errors).max() < 1
