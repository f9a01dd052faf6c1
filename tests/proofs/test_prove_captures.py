"""Simulated captures with faults: what the simulation states is true, and outcomes are counted
rightly; a share of what `prove_captures` runs."""

import json
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from facts import missing_facts

from slviewer.fringe.sequence import PatternSequence
from slviewer.pipeline.operation import ignore_progress
from tests.proofs import captures
from tests.proofs.capture_faults import CAPTURE_FAULTS, FaultyCapture, draw_faulty
from tests.proofs.captures import (
    NO_FAULT,
    CaptureCase,
    Named,
    decode_coordinates,
    examine_case,
    judge_coordinates,
    judge_findings,
    plan_cases,
    prove_captures,
    summarize_cases,
)
from tests.proofs.pipelines import PIPELINES
from tests.proofs.simulated_capture import (
    KINDS,
    CaptureKind,
    draw_setup,
    render_capture,
)

CELLS = [(fault, kind) for fault, own in CAPTURE_FAULTS.items() for kind in own.kinds]


@pytest.mark.computes
@pytest.mark.parametrize("kind", KINDS)
def test_the_true_coordinates_are_those_of_the_images(kind: CaptureKind) -> None:
    setup = replace(draw_setup(kind, 5), noise=0.5, blur_px=0.5, jpeg=0, gamma=1.0)
    capture = render_capture(setup)
    decoded = decode_coordinates(setup.described, capture.stack)
    for axis in setup.shown.axes:
        difference = (decoded[axis] - capture.truth[axis])[np.isfinite(capture.truth[axis])]
        assert np.isfinite(difference).mean() > 0.9
        # Gray code alone gives the cell
        unit = setup.shown.gray_cell(axis) if kind == "gray" else 0.1
        assert 0 < np.nanmedian(np.abs(difference)) < 0.3 * unit
        assert abs(np.nanmedian(difference)) < 0.05 * unit


@pytest.mark.computes
def test_a_capture_is_the_same_for_the_same_seed() -> None:
    one, same, other = (render_capture(draw_setup("micro", seed)) for seed in (3, 3, 4))
    assert np.array_equal(one.stack, same.stack)
    assert one.stack.shape != other.stack.shape or not np.array_equal(one.stack, other.stack)


@pytest.mark.parametrize(("fault", "kind"), CELLS)
def test_every_fault_changes_what_is_shown_or_described(fault: str, kind: CaptureKind) -> None:
    faulty = draw_faulty(fault, kind, 2)
    assert faulty == draw_faulty(fault, kind, 2)
    assert faulty.setup != faulty.sound and faulty.causes
    assert len(faulty.setup.order) in (0, len(faulty.setup.shown.frames))
    assert all(0 <= frame < len(faulty.setup.shown.frames) for frame in faulty.frames)


def fault(causes: Sequence[str] = (), frames: Sequence[int] = ()) -> FaultyCapture:
    """A capture of which the causes and frames are what matters."""
    setup = replace(draw_setup("p18", 0), gamma=1.0)
    return FaultyCapture(setup, setup, frozenset(causes), tuple(frames))


@pytest.mark.parametrize(
    ("named", "causes", "frames", "outcome"),
    [
        ([Named("frame-lag", (), "bad")], ["frame-lag"], [], "right"),
        ([Named("frame-lag", (4,), "bad")], ["frame-lag", "duplicate-frame"], [4, 5], "right"),
        ([Named("frame-lag", (3,), "bad")], ["frame-lag"], [4], "wrong"),
        ([Named("frame-lag", (), "bad")], ["frame-lag"], [4], "wrong"),
        (
            [Named("dark", (), "warning"), Named("frame-lag", (), "bad")],
            ["frame-lag"],
            [],
            "wrong",
        ),
        (
            [Named("exposure-drift", (2,), "note"), Named("dark", (), "warning")],
            ["dark"],
            [],
            "right",
        ),
        ([Named("exposure-drift", (2,), "note")], ["exposure-drift"], [], "right"),
        ([Named("exposure-drift", (2,), "note")], ["flicker"], [], None),
        ([], ["flicker"], [], None),
        ([], [], [], "sound"),
        ([Named("exposure-drift", (2,), "note")], [], [], "sound"),
        ([Named("exposure-drift", (2,), "warning")], [], [], "FALSE ALARM"),
    ],
)
def test_findings_are_judged_by_the_first_of_weight(
    named: list[Named], causes: list[str], frames: list[int], outcome: str | None
) -> None:
    assert judge_findings(named, fault(causes, frames)) == outcome


def test_what_is_true_without_the_fault_is_no_false_alarm() -> None:
    setup = replace(draw_setup("multifrequency", 0), gamma=1.6)
    faulty = FaultyCapture(setup, setup, frozenset())
    gamma, drift = Named("gamma", (0,), "warning"), Named("exposure-drift", (0,), "warning")
    assert judge_findings([gamma], faulty) == "sound"
    assert judge_findings([gamma, drift], faulty) == "FALSE ALARM"


@pytest.mark.parametrize(
    ("scale", "share", "outcome"),
    [
        (1.0, 1.0, "harmless"),
        (1.4, 0.95, "harmless"),
        (1.6, 1.0, "HARMFUL"),
        (1.0, 0.8, "LOST"),
        (9.0, 0.8, "HARMFUL"),
        (1.0, 0.0, "LOST"),
    ],
)
def test_errors_are_compared_with_those_without_the_fault(
    scale: float, share: float, outcome: str
) -> None:
    least = np.linspace(0, 0.1, 1001)
    errors = scale * least[: round(share * len(least))] / max(share, 0.1)
    assert judge_coordinates({"x": least, "y": errors}, {"x": least, "y": least}) == outcome


def test_few_wrong_pixels_are_harmful() -> None:
    least = np.linspace(0, 0.1, 1001)
    errors = np.where(np.arange(1001) > 940, 30.0, least)
    assert judge_coordinates({"x": errors}, {"x": least}) == "HARMFUL"
    assert judge_coordinates({}, {"x": least}) == "LOST"


@pytest.mark.computes
def test_each_case_is_examined_and_judged(monkeypatch: pytest.MonkeyPatch) -> None:
    def find(*found: Named) -> CaptureCase:
        monkeypatch.setattr(captures, "examine_capture", lambda *_: list(found))
        return examine_case("late from the start", "multifrequency", 0)

    assert find(Named("frame-lag", (), "bad")).outcome == "right"
    assert find(Named("gamma-ray", (), "bad")).outcome == "wrong"
    assert find().outcome in ("HARMFUL", "LOST")

    def crash(sequence: PatternSequence, stack: np.ndarray) -> list[Named]:
        raise ZeroDivisionError("a fault of the program")

    monkeypatch.setattr(captures, "examine_capture", crash)
    case = examine_case(NO_FAULT, "gray", 0)
    assert case.outcome == "CRASH" and missing_facts(case.text(), "ZeroDivisionError") == []


@pytest.mark.computes
def test_a_fault_that_changes_nothing_is_harmless(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(captures, "examine_capture", lambda *_: [])
    case = examine_case("steps reversed", "p18", 0)
    assert case.outcome == "HARMFUL"
    case = examine_case("drift of 8 %", "gray", 0)
    assert case.outcome == "harmless", "the inverse of each bit follows it at once"


def test_the_plan_holds_every_fault_of_every_kind() -> None:
    cells = list(plan_cases(1.0, 0))
    assert len(cells) == len(set(cells))
    assert all(sum(c[:2] == cell for c in cells) == 3 for cell in CELLS)
    assert sum(c[0] == NO_FAULT for c in cells) >= 400
    part = list(plan_cases(0.1, 0))
    assert {c[0] for c in part} == {c[0] for c in cells} and len(part) < 0.12 * len(cells)


def test_outcomes_are_counted_by_fault_and_in_total() -> None:
    named = (Named("dark", (3,), "bad"),)
    cases = [
        CaptureCase(name, "p18", seed, outcome, "flicker", named, "", "a plane", 0.5)
        for name, seed, outcome in (
            ("flicker", 0, "right"),
            ("flicker", 1, "HARMFUL"),
            ("dark", 0, "wrong"),
            (NO_FAULT, 0, "sound"),
            (NO_FAULT, 1, "FALSE ALARM"),
        )
    ]
    proof = summarize_cases(cases, 1.0)
    assert not proof.holds
    row = next(row for row in proof.rows if row["fault"] == "flicker")
    assert (row["right %"], row["harmful"], row["s"]) == (50.0, 1, 0.5)
    text = proof.text()
    assert missing_facts(text, "3 faults", "2 sound", "1 HARMFUL", "1 dark", "seed 1") == []
    assert len(json.loads(json.dumps(proof.to_json()))["cases"]) == 5


@pytest.mark.slow
@pytest.mark.computes
def test_a_tenth_of_the_captures_is_judged_as_well_as_measured() -> None:
    proof = prove_captures(0.1, 0, ignore_progress)
    assert len(proof.rows) == 1 + len(CAPTURE_FAULTS)
    assert proof.holds, proof.text()
    assert not [case for case in proof.record["cases"] if case.outcome == "CRASH"]


@pytest.mark.computes
def test_beats_beyond_a_projector_that_is_stated_too_small_are_named() -> None:
    # aliases of the stated size, 168 px off, agree with the beats that it needs
    case = examine_case("projector too small", "micro", 1)
    assert case.outcome == "right"
    assert {named.cause for named in case.named} == {"projector-size"}


@pytest.mark.computes
def test_a_phase_that_begins_elsewhere_is_not_named_as_motion() -> None:
    # vignetting and a gamma hide most of it
    case = examine_case("offset of a quarter period", "multifrequency", 481109000, "vignette")
    assert case.outcome == "right", case.text()


@pytest.mark.computes
@pytest.mark.parametrize(
    ("fault", "kind", "seed", "cause"),
    [
        # a drift of 1 % among three steps, and one that noise hides in each frame
        ("drift of 8 %", "heterodyne", 0, "exposure-drift"),
        ("drift of 30 %", "micro", 1, "exposure-drift"),
        # aliases that run against the image, and fit as well
        ("offset of half a period", "multifrequency", 0, "phase-offset"),
    ],
)
def test_what_few_phase_steps_hide_is_named(
    fault: str, kind: CaptureKind, seed: int, cause: str
) -> None:
    case = examine_case(fault, kind, seed)
    assert case.outcome == "right", case.text()
    assert {named.cause for named in case.named} == {cause}


@pytest.mark.computes
@pytest.mark.parametrize(
    ("fault", "kind", "seed"),
    [
        ("lamp switched on", "micro", 71000),  # after the first image of an axis
        ("black frame", "p18", 9001),  # a Gray bit without inverse: two places fit
        ("drift of 8 %", "p18", 91000),  # two pixels are read otherwise by chance
        ("random exposure", "complementary", 92000),
        ("clipped cosine", "micro", 51000),  # the finest period has eight steps
        (NO_FAULT, "p18", 51004),  # edges are misread in lines
    ],
)
def test_what_another_cause_imitates_is_named(fault: str, kind: CaptureKind, seed: int) -> None:
    case = examine_case(fault, kind, seed)
    assert case.outcome == ("sound" if fault == NO_FAULT else "right"), case.text()


@pytest.mark.computes
@pytest.mark.parametrize(
    ("fault", "kind", "pipeline"),
    [
        # of few images that come one late, only one shows something else
        ("frame repeated", "gray", "sharpened"),
        ("black frame", "micro", "demosaiced"),
        # a tone curve makes a lamp change the gains too
        ("lamp switched on", "gray", "sRGB"),
        # and stripes that blur closes brighter; a line fits the means of two axes
        (NO_FAULT, "complementary", "vignette"),
        ("narrow stripes", "gray", "gamma 1.8"),
    ],
)
def test_what_an_ordinary_camera_imitates_is_named(
    fault: str, kind: CaptureKind, pipeline: str
) -> None:
    case = examine_case(fault, kind, 11000, pipeline)
    assert case.outcome == ("sound" if fault == NO_FAULT else "right"), case.text()


@pytest.mark.computes
@pytest.mark.parametrize("pipeline", PIPELINES)
def test_pipelines_make_images_of_the_same_places(pipeline: str) -> None:
    setup = replace(draw_setup("p18", 5, pipeline), noise=0.5, blur_px=0.5, gamma=1.0)
    capture = render_capture(setup)
    assert capture.stack.shape == render_capture(replace(setup, pipeline="")).stack.shape
    decoded = decode_coordinates(setup.described, capture.stack)
    for axis in setup.shown.axes:
        difference = decoded[axis] - capture.truth[axis]
        assert 0 < np.nanmedian(np.abs(difference)) < 0.2
