"""A projector whose light is not proportional to its grey levels, and the table that mends it."""

import json
from dataclasses import replace

import numpy as np
import pytest
from facts import raises
from fringe_scene import variants

from slviewer.errors import InputError
from slviewer.fringe import phase_shifting
from slviewer.fringe.aliased_harmonics import AliasedHarmonics
from slviewer.fringe.decode import decode
from slviewer.fringe.patterns import profile, render_pattern
from slviewer.fringe.presets import complementary, gray
from slviewer.fringe.response import (
    fit_gamma,
    linearise_levels,
    measure_nonlinearity,
    predict_phase_error,
)
from slviewer.fringe.sequence import PatternSequence
from slviewer.session.exporters import write_pattern_folder
from slviewer.session.importers.frames import read_description
from slviewer.simulation.boards import Pose, blank_board
from slviewer.simulation.renderer import Renderer
from slviewer.simulation.rig import letter

SHOWN = np.arange(18) * 15.0
SEEN = (SHOWN / 255) ** 2.2
PROJECTOR = (256, 128)


def noisy(seed=0, sigma=0.002):
    return SEEN + np.random.default_rng(seed).normal(0, sigma, len(SEEN)) * np.minimum(
        SHOWN, 255 - SHOWN
    ).clip(0, 1)


def test_a_response_says_its_gamma_and_what_it_costs():
    assert fit_gamma(SHOWN, noisy()) == pytest.approx(2.2, abs=0.03)
    assert 0.28 < measure_nonlinearity(SHOWN, SEEN) < 0.31
    assert measure_nonlinearity(SHOWN, SHOWN / 255) < 1e-9
    three, four, nine = (predict_phase_error(SHOWN, SEEN, n) for n in (3, 4, 9))
    assert 0.15 < three < 0.25 and 0.0 < nine < four < three / 5
    assert predict_phase_error(SHOWN, SHOWN / 255, 3) < 1e-6


def test_the_table_straightens_the_response():
    levels = np.array(linearise_levels(SHOWN, noisy()))
    assert levels[0] == 0 and levels[-1] == 255 and (np.diff(levels) >= 0).all()
    light = (levels / 255) ** 2.2
    assert 0.0005 < np.abs(light - np.arange(256) / 255).max() < 0.015
    assert linearise_levels(SHOWN, SHOWN / 255) == tuple(range(256))


def ripple_rad(phase, coordinate):
    """The phase error as a function of the phase itself: what is left of it when noise has averaged
    out."""
    inside = phase.mask & np.isfinite(coordinate)
    inside[:3] = inside[-3:] = inside[:, :3] = inside[:, -3:] = False
    assert inside.mean() > 0.3
    turns = 2 * np.pi / phase.period_px
    error, place = (
        (phase.coordinate - coordinate)[inside] * turns,
        np.mod(coordinate[inside] * turns, 2 * np.pi),
    )
    bins = (place * (48 / (2 * np.pi))).astype(int)
    mean = np.bincount(bins, error, 48) / np.bincount(bins, minlength=48)
    return float((mean - mean.mean()).std())


@pytest.mark.computes
# noise leaves 1.3 mrad
@pytest.mark.parametrize(
    ("steps", "before_rad", "times"), variants([(3, 0.15, 20), (4, 0.005, 3)], (3, 0.15, 20))
)
def test_phase_errors_of_gamma_shrink_with_the_table_on_a_plane(
    monkeypatch, steps, before_rad, times
):
    monkeypatch.setattr(phase_shifting, "estimate_aliased_harmonics", lambda *_: AliasedHarmonics())
    rig = letter(0.25, local_distortion_px=0, gamma=2.2)
    renderer = Renderer(rig, blank_board(Pose(np.eye(3), np.array([0.0, 0.0, 600.0]))))
    plain = complementary(rig.projector.size, steps, 36.0)
    truth = renderer.truth().projector[..., 0]
    mended = replace(plain, levels=linearise_levels(SHOWN, noisy()))
    with_gamma, without = (
        ripple_rad(decode(s, renderer.capture(s), "x"), truth) for s in (plain, mended)
    )
    assert with_gamma > before_rad
    assert with_gamma > times * without > 0.001


def test_the_table_concerns_cosines_alone():
    levels = linearise_levels(SHOWN, SEEN)
    for plain in (complementary(PROJECTOR, 4, 16.0), gray(PROJECTOR)):
        sequence = replace(plain, levels=levels)
        for k, frame in enumerate(sequence.frames):
            row, before = profile(sequence, k)[1], profile(plain, k)[1]
            assert np.array_equal(row, np.array(levels)[before])
            if frame.kind != "phase":
                assert np.array_equal(render_pattern(sequence, k), render_pattern(plain, k))


def test_the_table_is_kept_with_the_sequence(tmp_path):
    sequence = replace(complementary((64, 48), 4, 16.0), levels=linearise_levels(SHOWN, SEEN))
    assert PatternSequence.from_dict(json.loads(json.dumps(sequence.to_dict()))) == sequence
    assert "levels" not in complementary((64, 48)).to_dict()
    write_pattern_folder(tmp_path / "patterns", sequence)
    toml = next((tmp_path / "patterns").glob("*.toml"))
    assert read_description(toml).sequence == sequence


@pytest.mark.parametrize(
    "levels",
    [
        tuple(range(255)),
        (*range(255), 254),
        (1, *range(1, 256)),
        (0, 5, 4, *range(3, 256)),
        tuple(float(i) for i in range(256)),
        tuple("0" * 256),
    ],
)
def test_a_table_that_cannot_be_is_refused(levels):
    with raises(InputError, 256):
        replace(gray((64, 48)), levels=levels)


def test_a_response_that_was_not_measured_is_refused():
    for shown, seen in [
        (SHOWN[1:], SEEN[1:]),
        (SHOWN, SEEN * np.nan),
        (SHOWN[::-1], SEEN),
        (SHOWN[:2], SEEN[:2]),
    ]:
        with raises(InputError, "response"):
            linearise_levels(shown, seen)
