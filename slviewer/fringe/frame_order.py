"""An order of the frames in which a capture fits its description: late, missing, repeated and exchanged images."""

from collections.abc import Iterator
from dataclasses import replace

from slviewer.fringe.agreement_tests import Answer, failed_tests, is_supported, sum_shares
from slviewer.fringe.axis_agreement import AxisFrames, AxisReader, described_frames, measure_agreement
from slviewer.fringe.contradiction import Contradiction
from slviewer.fringe.frame_likeness import FrameLikeness
from slviewer.fringe.ghost import detect_ghosting
from slviewer.fringe.layout import Shift
from slviewer.fringe.line_sample import LineSample
from slviewer.fringe.residual_order import detect_foreign_frames, detect_misordered_steps, recover_step_order
from slviewer.fringe.residual_sample import Fringe, sample_fringe
from slviewer.fringe.sequence import Axis, PatternSequence

NAMED_BY_STEPS = 0.5
"""What a hypothesis gains that the phase steps name by themselves."""

Images = tuple[int | None, ...]


def detect_misplaced_steps(
    sequence: PatternSequence, axis: Axis, sample: LineSample, images: Images | None = None
) -> list[Contradiction]:
    """Phase steps out of order, by what a cosine through all of them leaves."""
    out = []
    causes = {"late": "duplicate-frame", "dropped": "missing-frame", "lag": "frame-lag"}
    for sampled in _sampled_steps(sequence, axis, sample, images):
        if steps := recover_step_order(sampled):
            order = ", ".join(str(step) for step in steps)
            text = (
                f"the {len(steps)} phase steps of axis {axis} come in the order {order}: number the frames so in the "
                "description"
            )
            return [Contradiction("step-order", text, axis, None)]
        for suspect in detect_misordered_steps(sampled):
            cause = causes.get(suspect.fault, "frame-order")
            text = f"{suspect.sentence}: put the frames in order, or capture again"
            out.append(Contradiction(cause, text, axis, float(suspect.frame)))
    return out


def detect_unexplained_steps(sequence: PatternSequence, sample: LineSample, images: Images | None = None) -> set[int]:
    """Frames that neither a step of their period explains, nor one with a share of the image before it."""
    unexplained: set[int] = set()
    for axis in sequence.axes:
        for sampled in _sampled_steps(sequence, axis, sample, images):
            if sampled.steps > 3 and not detect_ghosting(sampled):  # else all steps hold a share of the image before
                unexplained |= {suspect.frame for suspect in detect_foreign_frames(sampled)}
    return unexplained


def detect_copies(
    sequence: PatternSequence, readers: dict[Axis, AxisReader], likeness: FrameLikeness
) -> tuple[Contradiction, ...]:  # fmt: skip
    """Images that are another once more, if all tests are passed without them."""
    pairs = likeness.repeated()
    if not pairs:
        return ()
    for which in (0, 1):  # the later image of each pair is the copy, or the earlier
        lost = {pair[which]: pair[1 - which] for pair in pairs}
        images = tuple(None if i in lost else i for i in range(len(sequence.frames)))
        if _score(sequence, readers, likeness, images) is not None:
            return tuple(_describe_duplicate(sequence, i, j) for i, j in lost.items())
    return ()


def _describe_duplicate(sequence: PatternSequence, i: int, j: int) -> Contradiction:
    """The contradiction of frame i that repeats the pattern of frame j."""
    text = f"frame {i + 1} shows the pattern of frame {j + 1}: it is late or repeated; capture again"
    return Contradiction("duplicate-frame", text, sequence.frames[i].axis, float(i))


def search_order(
    sequence: PatternSequence,
    sample: LineSample,
    readers: dict[Axis, AxisReader],
    likeness: FrameLikeness,
    disordered: list[Contradiction],
    strange: set[int],
) -> Answer | None:
    """The order of the frames in which all tests are passed best; None if there is none. ``disordered``: what the phase
    steps alone say; ``strange``: those that no step explains.
    """
    named_by_steps = {(contradiction.cause, contradiction.value) for contradiction in disordered}
    passed: list[Answer] = []
    orders: list[Images] = []
    for images, contradiction, penalty in _orders(sequence):
        score = _score(sequence, readers, likeness, images)
        if score is not None:
            score += NAMED_BY_STEPS * ((contradiction.cause, contradiction.value) in named_by_steps) - penalty
            orders.append(images)
            passed.append(Answer((contradiction,), score))
    for i in sorted(range(len(passed)), key=lambda i: -round(passed[i].score / 0.02)):
        images = orders[i]
        ordered = not any(detect_misplaced_steps(sequence, axis, sample, images) for axis in sequence.axes)
        if ordered and not detect_unexplained_steps(sequence, sample, images):
            (contradiction_found,) = passed[i].contradictions
            k = int(contradiction_found.value or 0)
            if contradiction_found.cause == "duplicate-frame" and (j := likeness.copied(k)) is not None:
                return replace(passed[i], contradictions=(_describe_duplicate(sequence, k, j),))
            return passed[i]
    return None


def _score(
    sequence: PatternSequence, readers: dict[Axis, AxisReader], likeness: FrameLikeness, images: Images
) -> float | None:  # fmt: skip
    """How well the images agree in this order; None where a test fails, or none has anything to show for itself."""
    if not all(map(likeness.is_even, range(len(images)), images)):
        return None
    score, sure = 0.0, False
    for axis in sequence.axes:
        frames = described_frames(sequence, axis, images)
        a = measure_agreement(readers[axis], frames)
        if failed_tests(frames, a) or not (is_supported(frames, a) or _lacks_steps(frames)):
            if readers[axis].is_in_view(frames):
                return None
            continue
        sure |= is_supported(frames, a)
        score += sum_shares(a)
    return score if sure else None


def _orders(sequence: PatternSequence) -> Iterator[tuple[Images, Contradiction, float]]:
    """Yield hypotheses of the frame order, the simplest first: lag, exchange, repetition, or a missing frame.

    Each is (image of each frame, None for a missing one; the contradiction to report; a penalty).
    """
    n = len(sequence.frames)
    for lag in (1, 2, -1):
        images = tuple(i + lag if 0 <= i + lag < n else None for i in range(n))
        count = "one image" if abs(lag) == 1 else f"{abs(lag)} images"
        way = (
            "late, so that each shows the pattern before its own: let the camera wait longer after each pattern"
            if lag > 0
            else "early, so that each shows the pattern after its own: the first frame is missing"
        )
        text = f"all frames are {count} {way}, and capture again, or move the files by {count}"
        # Without its first bit an inverted code is a code as well: the fewer images are lost, the better.
        yield images, Contradiction("frame-lag", text, None, float(lag)), 0.04 * (abs(lag) - 1)
    for k in range(n - 1):
        images = (*range(k), k + 1, k, *range(k + 2, n))
        text = f"frames {k + 1} and {k + 2} have changed places: exchange these two files, or capture again"
        yield images, Contradiction("frame-order", text, sequence.frames[k].axis, float(k)), 0.0
    for k in range(1, n):
        images = (*range(k), *(i + 1 if i + 1 < n else None for i in range(k, n)))
        text = (
            f"from frame {k + 1} on the camera is one image behind the projector, and image {k + 1} repeats the one "
            "before: capture again"
        )
        yield images, Contradiction("frame-lag", text, sequence.frames[k].axis, float(k)), 0.05
        images = (*range(k), None, *range(k, n - 1))
        text = (
            f"frame {k + 1} is missing, and those that follow come one place too early: add the image, or capture again"
        )
        yield images, Contradiction("missing-frame", text, sequence.frames[k].axis, float(k)), 0.1
    for k in range(n):
        images = (*range(k), None, *range(k + 1, n))
        text = f"frame {k + 1} does not show the pattern described for it: look at this image, and capture again"
        yield images, Contradiction("duplicate-frame", text, sequence.frames[k].axis, float(k)), 0.2


def _sampled_steps(
    sequence: PatternSequence, axis: Axis, sample: LineSample, images: Images | None
) -> Iterator[Fringe]:  # fmt: skip
    """The fringes of each period all of whose steps are there."""
    lines = sample.lines
    if images is not None:
        lines = lines[[i if image is None else image for i, image in enumerate(images)]]
    for period, steps in sequence.phase_shifts(axis):
        if images is not None and None in (images[i] for i in steps):
            continue
        sampled = sample_fringe(lines, Shift(period, steps), (0.0, 0.0), sample.white)
        if sampled is not None:
            yield sampled


def _lacks_steps(frames: AxisFrames) -> bool:
    """Whether too many steps are missing to compare its periods."""
    return not frames.bits and any(sum(image is not None for image in images) < 3 for _, images in frames.shifts)
