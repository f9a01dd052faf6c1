"""Search for an order of the frames in which a capture fits its description.

Images may be late, missing, repeated or exchanged.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache

from slviewer.fringe.agreement_tests import (
    SURE,
    Answer,
    failed_tests,
    has_evidence,
    is_proven,
    sum_shares,
)
from slviewer.fringe.axis_agreement import measure_agreement, measure_code_agreement
from slviewer.fringe.axis_reader import AxisFrames, AxisReader, Images, described_frames
from slviewer.fringe.contradiction import Contradiction
from slviewer.fringe.frame_likeness import FrameLikeness
from slviewer.fringe.ghost import detect_ghosting
from slviewer.fringe.layout import Shift
from slviewer.fringe.line_sample import LineSample
from slviewer.fringe.residual_order import (
    detect_misordered_steps,
    detect_strange_frames,
    recover_step_order,
)
from slviewer.fringe.residual_sample import BESIDE, sample_fringe
from slviewer.fringe.sequence import Axis, Indices, PatternSequence
from slviewer.fringe.suspect import Suspect

NAMED_BY_STEPS = 0.5
"""Score added to a hypothesis that the phase steps alone suggest as well."""

COARSE_MARGIN = 0.15
"""Tolerance of the length of a mean unit vector between a sample and a small part of it."""


@dataclass(frozen=True)
class _StepFindings:
    """Findings about the order of the phase steps of one period.

    ``order``: step of each frame where these are permuted, else None; ``misplaced``: frames that
    show another step; ``strange``: frames that no step explains, judged only where none is
    misplaced.
    """

    order: list[int] | None
    misplaced: list[Suspect]
    strange: list[Suspect]


class StepReader:
    """Checks the phase steps of a sample against a fitted cosine, cached for each order of their
    images."""

    def __init__(self, sequence: PatternSequence, sample: LineSample) -> None:
        """Check the phase steps of ``sequence`` at the pixels of ``sample``."""
        self._sequence, self._sample = sequence, sample
        self._cached_findings = cache(self._judge_period)

    def detect_misplaced_steps(
        self, axis: Axis, images: Images | None = None
    ) -> list[Contradiction]:
        """Return the contradictions of phase steps that are out of order, from the residual of the
        fitted cosine.

        ``images``: image of each frame, None for a missing one; the described order if omitted.
        """
        out = []
        causes = {"late": "duplicate-frame", "dropped": "missing-frame", "lag": "frame-lag"}
        for findings in self._judge_axis(axis, images):
            if steps := findings.order:
                order = ", ".join(str(step) for step in steps)
                text = (
                    f"the {len(steps)} phase steps of axis {axis} come in the order {order}: number"
                    " the frames so in the description"
                )
                return [Contradiction("step-order", text, axis, None)]
            for suspect in findings.misplaced:
                cause = causes.get(suspect.fault, "frame-order")
                text = f"{suspect.sentence}: put the frames in order, or capture again"
                out.append(Contradiction(cause, text, axis, float(suspect.frame)))
        return out

    def detect_unexplained_steps(self, images: Images | None = None) -> set[int]:
        """Return the frames that no step of their period explains, with or without a share of the
        image before."""
        findings = (f for axis in self._sequence.axes for f in self._judge_axis(axis, images))
        return {suspect.frame for each in findings for suspect in each.strange}

    def _judge_axis(self, axis: Axis, images: Images | None) -> Iterator[_StepFindings]:
        """Yield the findings of each period whose steps are all present and whose fringes are in
        view."""
        count = len(self._sample.lines)
        images = images or tuple(range(count))
        for period, steps in self._sequence.phase_shifts(axis):
            if None in (images[i] for i in steps):
                continue
            first, last = max(min(steps) - BESIDE, 0), min(max(steps) + BESIDE + 1, count)
            seen = tuple(i if (image := images[i]) is None else image for i in range(first, last))
            findings = self._cached_findings(Shift(period, steps), first, seen)
            if findings is not None:
                yield findings

    def _judge_period(self, shift: Shift, first: int, seen: Indices) -> _StepFindings | None:
        """Return the findings of one period, image ``seen[i]`` shown as frame ``first + i``; None
        without fringes."""
        lines, white = self._sample.lines, self._sample.white
        images = [*range(first), *seen, *range(first + len(seen), len(lines))]
        sampled = sample_fringe(lines[images], shift, (0.0, 0.0), white)
        if sampled is None:
            return None
        if order := recover_step_order(sampled):
            return _StepFindings(order, [], [])
        misplaced = detect_misordered_steps(sampled)
        # With ghosting all steps hold a share of the image before.
        is_judged = not misplaced and sampled.steps > 3 and not detect_ghosting(sampled)
        return _StepFindings(None, misplaced, detect_strange_frames(sampled) if is_judged else [])


def detect_copies(
    sequence: PatternSequence, readers: dict[Axis, AxisReader], likeness: FrameLikeness
) -> tuple[Contradiction, ...]:
    """Return the contradictions of images that repeat another one; empty unless all tests pass
    without them."""
    pairs = likeness.repeated()
    if not pairs:
        return ()
    for which in (0, 1):  # the later image of each pair is the copy, or the earlier
        lost = {pair[which]: pair[1 - which] for pair in pairs}
        images = tuple(None if i in lost else i for i in range(len(sequence.frames)))
        if _score_order(sequence, readers, likeness, images) is not None:
            return tuple(_describe_duplicate(sequence, i, j) for i, j in lost.items())
    return ()


def _describe_duplicate(sequence: PatternSequence, i: int, j: int) -> Contradiction:
    """Return the contradiction of frame ``i`` that repeats the pattern of frame ``j``."""
    text = (
        f"frame {i + 1} shows the pattern of frame {j + 1}: it is late or repeated; capture again"
    )
    return Contradiction("duplicate-frame", text, sequence.frames[i].axis, float(i))


def search_order(
    sequence: PatternSequence,
    readers: dict[Axis, AxisReader],
    steps: StepReader,
    likeness: FrameLikeness,
    disordered: list[Contradiction],
) -> Answer | None:
    """Search the order of the frames that passes all tests best.

    Return its contradiction and score, None if none passes.

    ``disordered``: contradictions of the phase steps alone; an order that agrees with them is
    preferred.
    """
    named_by_steps = {(contradiction.cause, contradiction.value) for contradiction in disordered}
    passed: list[tuple[float, Images, Contradiction]] = []
    for images, contradiction, penalty in _list_orders(sequence):
        score = _score_order(sequence, readers, likeness, images)
        if score is not None:
            score += (
                NAMED_BY_STEPS * ((contradiction.cause, contradiction.value) in named_by_steps)
                - penalty
            )
            passed.append((score, images, contradiction))
    for score, images, contradiction in sorted(passed, key=lambda order: -round(order[0] / 0.02)):
        ordered = not any(steps.detect_misplaced_steps(axis, images) for axis in sequence.axes)
        if ordered and not steps.detect_unexplained_steps(images):
            k = int(contradiction.value or 0)
            if contradiction.cause == "duplicate-frame" and (j := likeness.copied(k)) is not None:
                contradiction = _describe_duplicate(sequence, k, j)
            return Answer((contradiction,), score)
    return None


def _score_order(
    sequence: PatternSequence,
    readers: dict[Axis, AxisReader],
    likeness: FrameLikeness,
    images: Images,
) -> float | None:
    """Return the sum of the agreement shares of all axes in this order of the images.

    None if a test fails, or if no axis gives positive evidence for the order.
    """
    if not all(map(likeness.is_even, range(len(images)), images)):
        return None
    described = {axis: described_frames(sequence, axis, images) for axis in sequence.axes}
    if any(
        _is_refuted(readers[axis], own) and readers[axis].is_in_view(own)
        for axis, own in described.items()
    ):
        return None
    score, is_any_supported = 0.0, False
    for axis, frames in described.items():
        a = measure_agreement(readers[axis], frames)
        is_supported = has_evidence(frames, a)
        if not failed_tests(frames, a) and (is_supported or _lacks_steps(frames)):
            is_any_supported |= is_supported
            score += sum_shares(a)
        elif readers[axis].is_in_view(frames):
            return None
    return score if is_any_supported else None


def _is_refuted(reader: AxisReader, frames: AxisFrames) -> bool:
    """Return whether the Gray code alone, or the levels of a small part of the sample, certainly
    fail a test.

    This takes a fraction of the time that all tests take, and excludes most orders.
    """
    if frames.bits:
        return not is_proven(frames, measure_code_agreement(reader, frames))
    return (
        min(measure_agreement(reader.coarse, frames).level_common, default=1.0)
        < SURE - COARSE_MARGIN
    )


def _list_orders(sequence: PatternSequence) -> Iterator[tuple[Images, Contradiction, float]]:
    """Yield hypotheses of the frame order, the simplest first: lag, exchange, repetition, or a
    missing frame.

    Each is (image of each frame, None for a missing one; the contradiction to report; a penalty).
    """
    n = len(sequence.frames)
    for lag in (1, 2, -1):
        images: Images = tuple(i + lag if 0 <= i + lag < n else None for i in range(n))
        count = "one image" if abs(lag) == 1 else f"{abs(lag)} images"
        way = (
            "late, so that each shows the pattern before its own: let the camera wait longer after"
            " each pattern, or switch its buffering off, where it hands out old images (the"
            " preflight shows which)"
            if lag > 0
            else (
                "early, so that each shows the pattern after its own, and the first is missing: let"
                " the camera begin with the first pattern"
            )
        )
        text = f"all frames are {count} {way}; capture again, or move the files by {count}"
        # Without its first bit an inverted code is a code as well: the fewer images are lost, the
        # better.
        yield images, Contradiction("frame-lag", text, None, float(lag)), 0.04 * (abs(lag) - 1)
    every = tuple(range(n))
    lagging = (
        "from frame {0} on the camera is one image behind the projector, and image {0} repeats the"
        " one before: capture again"
    )
    missing = (
        "frame {0} is missing, and those that follow come one place too early: add the image, or"
        " capture again"
    )
    foreign = (
        "frame {0} does not show the pattern described for it: look at this image, and capture"
        " again"
    )
    swapped = "frames {0} and {1} have changed places: exchange these two files, or capture again"

    def describe(cause: str, text: str, k: int) -> Contradiction:
        """Return the contradiction of a fault from frame ``k`` on."""
        return Contradiction(cause, text.format(k + 1, k + 2), sequence.frames[k].axis, float(k))

    for k in range(n - 1):
        yield (*every[:k], k + 1, k, *every[k + 2 :]), describe("frame-order", swapped, k), 0.0
    for k in range(1, n):
        yield (*every[:k], *every[k + 1 :], None), describe("frame-lag", lagging, k), 0.05
        yield (*every[:k], None, *every[k:-1]), describe("missing-frame", missing, k), 0.1
    for k in range(n):
        yield (*every[:k], None, *every[k + 1 :]), describe("duplicate-frame", foreign, k), 0.2


def _lacks_steps(frames: AxisFrames) -> bool:
    """Return whether so many steps are missing that the periods of an axis cannot be compared."""
    return not frames.bits and any(
        sum(image is not None for image in images) < 3 for _, images in frames.shifts
    )
