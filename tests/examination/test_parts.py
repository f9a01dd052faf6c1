"""Parts of the examination: patterns as functions of the coordinate, the match of a sample with
them, comparisons of hypotheses, and what single faults leave."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest
from fringe_scene import capture, slope

from slviewer.examination import limits
from slviewer.examination.atoms import evaluate_frame, tabulate_atoms
from slviewer.examination.evaluate import Evaluator, Hypothesis, described
from slviewer.examination.explain import explain, list_unresolved
from slviewer.examination.frame_means import measure_drift
from slviewer.examination.ghost import has_ghost, measure_ghost
from slviewer.examination.hypotheses import exchange, list_descriptions, list_orders
from slviewer.examination.motion import measure_motion
from slviewer.examination.sample import sample_capture
from slviewer.fringe.patterns import profile
from slviewer.fringe.presets import complementary, gray, micro, multifrequency, p18
from slviewer.fringe.sequence import Axis, PatternSequence, PerAxis
from slviewer.records.verdict import MOST_WARNINGS, Examination, Finding

pytestmark = pytest.mark.computes

PROJECTOR = (256, 160)
COORDINATE = slope(80, 200, start=20.0)
SEQUENCES = {
    "p18": p18(PROJECTOR),
    "gray": gray(PROJECTOR),
    "complementary": complementary(PROJECTOR, 4, 16.0),
    "multifrequency": multifrequency(PROJECTOR, 6),
    "micro": micro(PROJECTOR),
}
CONVENTIONS = {
    "plain": {},
    "sign and offset": {"phase_sign": PerAxis(-1, 1), "phase_offset_rad": PerAxis(0.7, -2.0)},
    "origin": {"gray_origin_px": PerAxis(-8.5, -4.5)},
}


def one_axis(name: str) -> PatternSequence:
    """The frames of x, and those without an axis."""
    sequence = SEQUENCES[name]
    return replace(sequence, frames=tuple(f for f in sequence.frames if f.axis != "y"))


def prepare(name: str, stack: np.ndarray) -> tuple[Evaluator, Hypothesis]:
    sequence = one_axis(name)
    return Evaluator(sample_capture(sequence, stack)), described(sequence)


@pytest.mark.parametrize("axis", ["x", "y"])
@pytest.mark.parametrize("name", SEQUENCES)
@pytest.mark.parametrize("convention", CONVENTIONS)
def test_atoms_are_what_the_projector_shows(name: str, axis: Axis, convention: str) -> None:
    sequence = SEQUENCES[name]
    if convention == "origin" and name != "p18":
        return
    sequence = replace(sequence, **CONVENTIONS[convention])
    atoms = tabulate_atoms(sequence, axis)
    u = np.arange(sequence.extent(axis), dtype=float)
    tabulated = atoms.at(u)
    for k, i in enumerate(atoms.frames):
        own, levels = profile(sequence, i)
        shown = levels[: len(u)] / 255 if own is None else levels / 255
        exact = evaluate_frame(sequence, axis, sequence.frames[i], u)
        np.testing.assert_allclose(exact, shown, atol=1.01 / 255)
        if sequence.frames[i].kind == "phase":
            assert 0 < np.abs(tabulated[k] - shown).max() < 0.02
        else:  # but within a step of the table from an edge
            assert np.mean(np.abs(tabulated[k] - shown) > 0.02) < 0.15
    steps = [i for i, group in zip(atoms.frames, atoms.groups, strict=True) if group >= 0]
    assert steps == sequence.find("phase", axis)


@pytest.mark.parametrize("name", SEQUENCES)
def test_match_recovers_known_coordinates(name: str) -> None:
    stack = capture(one_axis(name), COORDINATE)
    evaluator, base = prepare(name, stack)
    sample, m = evaluator.sample.by_axis["x"], evaluator.match(base, "x")
    assert m is not None
    row, column = ((sample.place + 0.5) * COORDINATE.shape).T
    truth = COORDINATE[np.rint(row).astype(int), np.rint(column).astype(int)]
    good = m.good(sample)
    error = np.abs(m.coordinate - truth)[good]
    assert good.mean() > 0.7 and 0.001 < np.median(error) < 1.2
    assert np.quantile(error, 0.95) < 3
    assert 0.8 * 180 < np.median(m.contrast[good]) < 1.2 * 180
    assert 0 < np.median(m.misfit) < 0.06  # of stripes most, on whose edges pixels are half bright
    # the neighbours lie to the left and the right
    assert sample.direction == 1 and (m.rise[good] > 0).mean() > 0.95


@pytest.mark.parametrize("name", ["complementary", "multifrequency"])
def test_compare_prefers_the_truth(name: str) -> None:
    sequence = one_axis(name)
    stack = capture(sequence, COORDINATE)
    evaluator, base = prepare(name, stack)
    assert evaluator.compare(base, base).gain == 0
    others = [*list_orders(sequence), *list_descriptions(sequence, "x")]
    gains = [evaluator.compare(base, other).gain for other in others]
    assert len(gains) > 30 and max(gains) < 0.003 and min(gains) < -0.2
    swapped = exchange(sequence, 1, 2)
    of_swapped, _ = prepare(name, stack[[0, 2, 1, *range(3, len(stack))]])
    comparison = of_swapped.compare(base, swapped)
    assert comparison.gain > 0.5 * comparison.loss and comparison.sigmas > limits.SIGMAS
    assert 0 < comparison.left < 0.03
    assert explain(of_swapped, base) and not explain(evaluator, base)


def move(sequence: PatternSequence, px: float) -> np.ndarray:
    """Frames of a scene whose pattern moves steadily by ``px`` over the phase steps of x, or over
    the bits."""
    steps = sequence.find("phase", "x") or sequence.select("x")
    stack = capture(sequence, COORDINATE)
    for place, i in enumerate(steps):
        shift = px * (place / (len(steps) - 1) - 0.5)
        stack[i] = capture(sequence, COORDINATE + shift)[i]
    return stack


@pytest.mark.parametrize("px", [-1.5, 1.0])
def test_motion_is_measured(px: float) -> None:
    evaluator, base = prepare("p18", move(one_axis("p18"), px))
    (measured,) = measure_motion(evaluator, base).values()
    # where coordinates rise the pattern moves back; each pixel's own light takes a part of it
    assert 0.45 < -measured / px < 1.0


def test_motion_of_stripes_is_measured_between_bits_and_inverses() -> None:
    evaluator, base = prepare("gray", move(one_axis("gray"), 2.0))
    (measured,) = measure_motion(evaluator, base).values()
    assert 0.45 < -measured / 2.0 < 1.3


@pytest.mark.parametrize("defocus", [0.8, 2.5])
def test_blur_of_stripes_and_gamma_leave_little(defocus: float) -> None:
    stack = capture(one_axis("p18"), COORDINATE, defocus=defocus, gamma=1.6)
    evaluator, base = prepare("p18", stack)
    m = evaluator.match(base, "x")
    assert m is not None and 0 < np.median(m.misfit) < 0.003
    assert 0.98 * 180 < np.median(m.contrast) < 1.02 * 180  # that of wide stripes


@pytest.mark.parametrize("share", [-0.3, 0.06])
def test_a_drift_is_measured_in_sums_that_are_equal(share: float) -> None:
    sequence = SEQUENCES["complementary"]
    stack = capture(sequence, COORDINATE).astype(float)
    own = sequence.select("y")
    stack[own] = capture(sequence, COORDINATE, axis="y")[own]
    assert measure_drift(sequence, stack) == 0
    gains = np.exp(np.linspace(0, share, len(stack)))
    rate = measure_drift(sequence, stack * gains[:, None, None])
    assert rate == pytest.approx(share / (len(stack) - 1), rel=0.05)


@pytest.mark.parametrize("gamma", [1.0, 1.6])
@pytest.mark.parametrize("name", ["p18", "gray", "complementary", "multifrequency"])
def test_a_sound_capture_neither_moves_nor_has_a_ghost(name: str, gamma: float) -> None:
    stack = capture(one_axis(name), COORDINATE, gamma=gamma, shot=0.02)
    evaluator, base = prepare(name, stack)
    assert measure_motion(evaluator, base) == {} and has_ghost(evaluator, base) == 0


@pytest.mark.parametrize("name", ["p18", "gray", "complementary"])
def test_a_ghost_is_measured(name: str) -> None:
    stack = capture(one_axis(name), COORDINATE).astype(float)
    stack[1:] = 0.88 * stack[1:] + 0.12 * stack[:-1]
    evaluator, base = prepare(name, np.rint(stack).astype(np.uint8))
    share, error = measure_ghost(evaluator, base)
    # of the contrast that is left
    assert share == pytest.approx(0.12, rel=0.25) and 1e-5 < error < 0.01
    assert has_ghost(evaluator, base) == share


@pytest.mark.parametrize(("defocus", "bits"), [(0.4, 0), (3.0, 2)])
def test_stripes_that_blur_has_closed_are_listed(defocus: float, bits: int) -> None:
    sequence = one_axis("gray")
    evaluator, base = prepare("gray", capture(sequence, COORDINATE, defocus=defocus))
    finest = [sequence.bits(kind, "x")[::-1][:bits] for kind in ("gray", "inverse")]
    assert {*list_unresolved(evaluator, base)} == {i for each in finest for i in each}


def test_an_examination_returns_from_plain_values() -> None:
    findings = (
        Finding("frame-order", "rejected", "a", "b", frames=(3, 4)),
        Finding("gamma", "doubtful", "c", "d", axis="x", value=0.5),
    )
    examination = Examination(findings, 0.02)
    plain = msgspec.to_builtins(examination)
    assert msgspec.convert(msgspec.json.decode(msgspec.json.encode(plain)), Examination) == (
        examination
    )
    assert examination.rejected == findings[:1] and len(examination.warnings()) == 2


def test_warnings_about_one_capture_are_few() -> None:
    findings = tuple(
        Finding("duplicate-frame", "rejected", str(k), "look", frames=(k,)) for k in range(9)
    )
    texts = Examination(findings * 2).warnings()
    assert len(texts) == MOST_WARNINGS and str(9 - MOST_WARNINGS + 1) in texts[-1]
