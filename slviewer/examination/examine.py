"""Examination of a capture: what its frames contradict, by the best explanation of all of them."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from slviewer.errors import InputError
from slviewer.examination import limits
from slviewer.examination.evaluate import Evaluator, Hypothesis, described, use_one_thread
from slviewer.examination.explain import Explanation, explain, list_unresolved, measure_levels
from slviewer.examination.findings import (
    LINES,
    REMEDIES,
    contradict,
    describe_apart_periods,
    describe_gamma,
    describe_ghost,
    describe_hypothesis,
    describe_light,
    describe_mirroring,
    describe_missing_pattern,
    describe_motion,
    describe_reach,
    describe_unreadable,
    describe_unresolved,
    wrap,
)
from slviewer.examination.ghost import has_ghost
from slviewer.examination.hypotheses import list_descriptions
from slviewer.examination.light import Look, equalize_samples, look_at
from slviewer.examination.motion import is_displaced, measure_motion
from slviewer.examination.sample import CaptureSample
from slviewer.fringe.aliased_harmonics import MOST_STEPS, estimate_aliased_harmonics
from slviewer.fringe.decoding_task import prepare_decoding
from slviewer.fringe.frame_light import FrameLight
from slviewer.fringe.sequence import Axis, PatternSequence
from slviewer.records.verdict import Examination, Finding


def examine(sequence: PatternSequence, stack: np.ndarray, look: Look | None = None) -> Examination:
    """Examine the frames (n, h, w) uint8 or uint16 of a capture.

    Every hypothesis (an order of the images, another convention of the description) predicts the
    grey levels of sampled pixels from their neighbours; the one that explains all frames best is
    named, and nothing where the description explains them as well. ``look`` at them: taken if None.
    Raises InputError for a stack that does not match the sequence.
    """
    look = look or look_at(sequence, stack)
    if not sequence.axes:
        return Examination()
    base, light = described(sequence), look.light
    with use_one_thread():
        findings = _judge(stack, _correct(look.evaluator, base, light), base, light)
    return Examination(tuple(findings), light.drift)


def _judge(
    stack: np.ndarray, evaluator: Evaluator, base: Hypothesis, light: FrameLight
) -> Sequence[Finding]:
    """Return the findings of a capture whose light has been estimated."""
    sequence, sample = base.sequence, evaluator.sample
    if too_little := [*_judge_pattern(sequence, sample)]:
        return too_little
    ghost, motion = has_ghost(evaluator, base), measure_motion(evaluator, base)
    found = explain(evaluator, base, bool(motion))
    coordinates = [*_judge_coordinates(evaluator, base)]
    if found and not _is_imitated(found, evaluator, bool(ghost), bool(motion)):
        named = _describe_explanation(found, evaluator, base)
        # codes that cannot be are displaced as well, and fit others with fewer images as little
        has_moved = any(each.cause == "moved" for each in named)
        if not (coordinates and (has_moved or _explains_little(evaluator, base, found[0]))):
            return named
    if motion and not ghost and not coordinates:
        return [describe_motion(sequence, axis, px) for axis, px in motion.items()]
    judged = [*_judge_readability(evaluator, base), *coordinates]
    if ghost:  # it imitates other light
        return [*judged, describe_ghost(ghost)]
    if not coordinates:
        judged += [*_judge_periods(evaluator, base), *_judge_light(sequence, stack, light)]
    return judged


def _judge_periods(evaluator: Evaluator, base: Hypothesis) -> Iterator[Finding]:
    """Yield the finding of an axis of which one of several periods is another."""
    for axis, _, grown in measure_levels(evaluator, base):
        if grown > limits.GROWN:
            yield describe_apart_periods(base.sequence, axis, grown)


def _explains_little(evaluator: Evaluator, base: Hypothesis, found: Hypothesis) -> bool:
    """Return whether an order that loses an image leaves most of the misfit."""
    if not found.loses_images:
        return False
    change = evaluator.compare(base, found)
    return change.left > limits.HALF_LEFT * change.loss


def _judge_pattern(sequence: PatternSequence, sample: CaptureSample) -> Iterator[Finding]:
    """Yield the finding of images without pattern, else of an axis whose one fringe period does not
    number the projector: what fits its images best is not known then."""
    if not sample.is_usable and (sample.by_axis or sample.lit < limits.LEAST_LIT):
        yield describe_missing_pattern(sample)
        return
    for axis in sequence.axes if sequence.projector_size else ():
        is_single = len(sequence.periods_px(axis)) == 1 and not sequence.find("gray", axis)
        error = contradict(sequence, axis) if is_single else None
        if error is not None:
            period, extent = sequence.period_px(axis), sequence.extent(axis)
            text = (
                f"{extent / period:.3g} fringes of {period:.4g} px do not number the projector's"
                f" {extent} {LINES[axis]}"
            )
            yield Finding("projector-size", "rejected", text, error.remedy, axis=axis)


def _is_imitated(found: Explanation, evaluator: Evaluator, ghost: bool, motion: bool) -> bool:
    """Return whether motion, or a ghost, that was measured imitates an explanation; a ghost does
    motion, beside which it is measured, and one strange frame, as the first image, which has none
    before it, stands out."""
    is_like_ghost = [each.cause for each in found] in (["moved"], ["duplicate-frame"])
    return (motion and _are_displaced(evaluator, found)) or (ghost and is_like_ghost)


def _correct(evaluator: Evaluator, base: Hypothesis, light: FrameLight) -> Evaluator:
    """Return the evaluator of the same pixels under equal light, without those that only the light
    of the room made vary, if that leaves nothing to explain, and less than other explanations."""
    if not light.is_significant:
        return evaluator
    equal = equalize_samples(evaluator, base.sequence, light)
    by_axis = {
        axis: sample.part(np.ptp(sample.levels[:, 1], axis=0) > limits.STEEP * sample.swing)
        for axis, sample in equal.sample.by_axis.items()
    }
    equal = Evaluator(replace(equal.sample, by_axis=by_axis))
    if not equal.sample.is_usable or explain(equal, base) or measure_motion(equal, base):
        return evaluator
    if has_ghost(equal, base):
        return evaluator
    # light accounts for the image, too, that a rival without order leaves out
    rivals = [
        evaluator.compare(base, _fill_in(h)).left * (1 if h.images else limits.AS_LITTLE)
        for h in explain(evaluator, base)
    ]
    return evaluator if rivals and max(rivals) < equal.compare(base, base).loss else equal


def _are_displaced(evaluator: Evaluator, found: Explanation) -> bool:
    """Return whether frames that show no other pattern, or a later one, show their own one
    displaced."""
    return any(
        len(hypothesis.frames) == 1
        and not hypothesis.images
        and (hypothesis.value is None or hypothesis.value > hypothesis.frames[0])
        and is_displaced(evaluator, described(hypothesis.sequence), *hypothesis.frames)
        for hypothesis in found
    )


def _describe_explanation(
    found: Explanation, evaluator: Evaluator, base: Hypothesis
) -> list[Finding]:
    """Return the findings of an explanation.

    An offset of the phase that is no convention, on one axis of several periods captured one after
    the other, is motion between them.
    """
    sequence, first, axis = base.sequence, found[0], found[0].axis
    if first.cause == "moved" and axis is not None and first.value is not None:
        return [describe_motion(sequence, axis, first.value)]
    is_offset = len(found) == 1 and first.cause == "phase-offset" and len(sequence.axes) == 2
    if axis is not None and is_offset and not sequence.find("gray", axis):
        *_, (period, steps) = sequence.phase_shifts(axis)
        turns = wrap((first.sequence.offset_rad(axis) - sequence.offset_rad(axis)) / (2 * np.pi))
        if all(abs(wrap(turns * n)) > limits.USUAL_OFFSET * n for n in (4, len(steps))):
            return [describe_motion(sequence, axis, turns * period)]
    return [describe_hypothesis(hypothesis, evaluator, base) for hypothesis in found]


def _fill_in(hypothesis: Hypothesis) -> Hypothesis:
    """Return a hypothesis with the images of all frames but those that it names, if it has none."""
    every = range(len(hypothesis.sequence.frames))
    without = tuple(None if i in hypothesis.frames else i for i in every)
    return replace(hypothesis, images=hypothesis.images or without)


def _judge_readability(evaluator: Evaluator, base: Hypothesis) -> Iterator[Finding]:
    """Yield the findings of an axis that no hypothesis makes readable, and of stripes that the
    camera does not resolve."""
    for axis, sample, m in evaluator.matched(base):
        if m.misfit.mean() > limits.UNREADABLE:
            is_weak = np.median(sample.swing) < limits.WEAK * evaluator.sample.noise
            yield describe_unreadable(axis, is_weak)
    if unresolved := list_unresolved(evaluator, base):
        yield describe_unresolved(base.sequence, unresolved)


def _judge_coordinates(evaluator: Evaluator, base: Hypothesis) -> Iterator[Finding]:
    """Yield the finding of mirrored coordinates, else of codes that the description cannot hold, or
    that lie beyond the projector."""
    sequence = base.sequence
    coordinates = evaluator.coordinates(base)
    jacobian, beyond = coordinates.jacobian, coordinates.beyond
    mirrored = [] if jacobian is None else [*describe_mirroring(sequence, jacobian)]
    yield from mirrored
    for axis in sequence.axes if sequence.projector_size and not mirrored else ():
        if error := contradict(sequence, axis):
            remedy = error.remedy or REMEDIES["projector-size"]
            yield Finding("projector-size", "rejected", error.observation, remedy, axis=axis)
        elif axis in beyond:
            others = _list_inside(evaluator, base, axis)
            yield describe_reach(axis, sequence.extent(axis), *beyond[axis], others)


def _list_inside(evaluator: Evaluator, base: Hypothesis, axis: Axis) -> Iterator[str]:
    """Yield the remedies of other bits that explain an axis as well, with codes inside the
    projector: inverted, plain numbers count backwards."""
    own = evaluator.match(base, axis)
    for hypothesis in list_descriptions(base.sequence, axis):
        other = evaluator.match(hypothesis, axis) if hypothesis.cause == "bit-order" else None
        if own is None or other is None or axis in evaluator.coordinates(hypothesis).beyond:
            continue
        if other.misfit.mean() < own.misfit.mean() + limits.LEFT_ALIKE:
            yield describe_hypothesis(hypothesis, evaluator, base).remedy


def _judge_light(
    sequence: PatternSequence, stack: np.ndarray, light: FrameLight
) -> Iterator[Finding]:
    """Yield the findings of light that varies, and of a projector response that is not linear."""
    yield from describe_light(sequence, light)
    for axis in sequence.axes:
        if not any(len(steps) <= MOST_STEPS for _, steps in sequence.phase_shifts(axis)):
            continue
        try:
            task = prepare_decoding(sequence, stack, axis, light)
        except InputError:  # decoding reports it, with the remedy
            continue
        few = [shift for shift in task.layout.shifts if len(shift.indices) <= MOST_STEPS]
        layout = replace(task.layout, shifts=(few[-1],))
        harmonics = estimate_aliased_harmonics(layout, task.stack, task.white, task.noise)
        yield from describe_gamma(harmonics, layout, task.layout.period_px)
