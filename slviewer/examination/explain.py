"""Search for the hypothesis that explains the images of a capture best."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, product
from typing import NamedTuple

import numpy as np

from slviewer.examination import limits
from slviewer.examination.evaluate import Evaluator, Hypothesis, MisfitChange, described
from slviewer.examination.findings import contradict
from slviewer.examination.hypotheses import (
    exchange,
    lag_from,
    list_descriptions,
    list_lags,
    list_motions,
    list_neighbours,
    list_orders,
    recover_orders,
)
from slviewer.examination.match import Match
from slviewer.examination.motion import has_trend
from slviewer.examination.sample import Sample
from slviewer.fringe.layout import axis_layout
from slviewer.fringe.phase_shifting import fit_ripples, phase_shift
from slviewer.fringe.sequence import Axis, Indices, PatternSequence
from slviewer.records.verdict import Cause

Explanation = tuple[Hypothesis, ...]
"""One hypothesis, or one for each axis."""


def explain(evaluator: Evaluator, base: Hypothesis, has_motion: bool = False) -> Explanation:
    """Return what explains the images better than the description ``base``; empty where nothing
    does, and where the description explains them well, without motion of the scene, which phases of
    another offset imitate."""
    found: Explanation = ()
    if has_motion or _is_doubtful(evaluator, base):
        found = _search(evaluator, base)
        # three steps of which two are alike fit a changed description as well
        if found and (found[0].axis or found[0].cause == "step-order"):
            copies = _list_copies(evaluator, base.sequence)
            if 0 < len(copies) <= limits.MOST_SINGLE:
                copied = dict(copies)
                images = [None if i in copied else i for i in base.images]
                others = replace(base, images=tuple(images), cost=0.0)
                explained = _rate(evaluator, base, found)
                if _rate(evaluator, base, (others,)).comparison.left < explained.most_left:
                    return tuple(_repeat(base.sequence, *pair) for pair in copies)
    repeated = _explain_repetition(evaluator, base, found)
    return repeated or found or tuple(_explain_single_images(evaluator, base))


def _explain_repetition(evaluator: Evaluator, base: Hypothesis, found: Explanation) -> Explanation:
    """Return that an image repeats the one before, and those behind it are late or not; empty where
    there is none, or what was ``found`` is about that image, or explains more."""
    k = _find_repetition(evaluator, base)
    if k is None or any(k in each.frames for each in found):
        return ()
    without = tuple(None if i == k else i for i in base.images)
    others, late = replace(base, images=without), lag_from(base.sequence, k)
    left, left_late = (evaluator.compare(base, each).left for each in (others, late))
    if found and _rate(evaluator, base, found).comparison.left < min(left, left_late):
        return ()
    is_late = len(late.changed) > 1 and left_late < left
    return (late if is_late else _repeat(base.sequence, k, k - 1),)


def _find_repetition(evaluator: Evaluator, base: Hypothesis) -> int | None:
    """Return the first frame whose image is equal to the one before in every pixel, where their
    patterns differ; None where there is none: noise makes two images of anything unlike."""
    repeated = list[int]()
    for axis, sample, m in evaluator.matched(base):
        levels, places = sample.levels[:, 1], {image: i for i, image in enumerate(m.images)}
        pairs = [k for k in places if k - 1 in places and np.array_equal(levels[k], levels[k - 1])]
        if not pairs:
            continue
        low, high = np.quantile(m.coordinate, [0.05, 0.95])
        seen = np.linspace(low, high, len(m.coordinate))  # the match takes up what fine bits show
        shown = evaluator.atoms(base, axis).at(seen)[m.places]
        repeated += [
            k for k in pairs if np.abs(shown[places[k]] - shown[places[k - 1]]).mean() > limits.FLAT
        ]
    return min(repeated, default=None)


def is_late(evaluator: Evaluator, base: Hypothesis) -> bool:
    """Return whether the small sample shows that all frames are late, or early: the description
    explains their light then as little as their order."""
    lags = _rank(evaluator, base, list_lags(base.sequence))
    return _choose_explaining(evaluator, base, lags) is not None


def list_unresolved(evaluator: Evaluator, base: Hypothesis) -> list[int]:
    """Return the frames of the finest Gray bits whose stripes the camera does not resolve."""
    sequence, out = base.sequence, list[int]()
    for axis, sample, m in evaluator.explained(base):
        bits, inverse = sequence.bits("gray", axis), sequence.bits("inverse", axis)
        patterns = evaluator.atoms(base, axis).at(m.coordinate)[m.places]
        seen = (sample.levels[m.images, 1] - m.background) / m.contrast.clip(1e-3)
        pairs = [*zip(bits, inverse, strict=True)] if inverse else [(i,) for i in bits]
        for pair in reversed(pairs):
            places = [m.images.index(i) for i in pair]
            own = patterns[places] - patterns[places].mean(axis=1, keepdims=True)
            squares = np.maximum(np.einsum("kp,kp->k", own, own), 1e-6)
            contrasts = np.einsum("kp,kp->k", own, seen[places].clip(-1, 2)) / squares
            # blur leaves grey, and no image of even light or darkness
            uneven = np.abs(seen[places].mean(axis=1) - 0.5) > limits.FLAT
            is_seen = (np.abs(contrasts) > limits.UNRESOLVED).any() or uneven.any()
            if is_seen and not _is_too_fine(sequence, axis, pair[0], sample, m):
                break
            out += pair
    return out


def _is_unpredictable(evaluator: Evaluator, hypothesis: Hypothesis, k: int) -> bool:
    """Return whether frame k, which the hypothesis leaves out, is the finest bit of an axis without
    phase steps, in cells of hardly two pixels: what they show of it no other image tells."""
    sequence, frame = hypothesis.sequence, hypothesis.sequence.frames[k]
    axis = frame.axis
    if (
        axis is None
        or sequence.periods_px(axis)
        or frame.bit + 1 < len(sequence.find("gray", axis))
    ):
        return False
    sample, m = evaluator.sample.by_axis.get(axis), evaluator.match(hypothesis, axis)
    if sample is None or m is None:
        return False
    px = float(np.median(np.abs(m.rise))) / sample.reach_px
    return sequence.gray_cell(axis) < limits.NARROW * px


def _is_too_fine(sequence: PatternSequence, axis: Axis, k: int, sample: Sample, m: Match) -> bool:
    """Return whether the stripes of frame k, a bit of the axis, are narrower than most pixels that
    the match explains: what these show of them follows from no coordinate."""
    finer = len(sequence.find("gray", axis)) - 1 - sequence.frames[k].bit
    width = (2 - sequence.binary) * sequence.gray_cell(axis) * 2**finer
    return width < float(np.median(np.abs(m.rise))) / sample.reach_px


def _is_doubtful(evaluator: Evaluator, base: Hypothesis) -> bool:
    """Return whether the description leaves more than noise, in all images or in one, or gives
    coordinates beyond the projector, or that fall from neighbour to neighbour where they rise over
    the image: aliases, which fit as well where the patterns have few levels; or phases of several
    periods that contradict each other."""
    coordinates = evaluator.coordinates(base)
    if coordinates.beyond or coordinates.folded:
        return True
    for _, agreement, grown in measure_levels(evaluator, base):
        if agreement < limits.AGREEING or grown > limits.GROWN:
            return True
    residuals = evaluator.residuals(base)
    for axis in evaluator.sample.by_axis:
        m = evaluator.match(base, axis)
        if m is None or m.misfit.mean() > limits.SMALL_LOSS:
            return True
        groups = evaluator.atoms(base, axis).groups[m.places]
        for group in {*groups.tolist()}:
            own = residuals[np.array(m.images)[groups == group]]
            if own.max() > limits.STANDS_OUT * np.median(own) + limits.STANDS_OUT_LEAST:
                return True
    return has_trend(evaluator, base)  # it leaves little that the coordinates do not take up


def measure_levels(evaluator: Evaluator, base: Hypothesis) -> Iterator[tuple[Axis, float, float]]:
    """Yield, of each axis of several periods and no bits, how well the coordinates by a longer
    period, or a beat, agree with those by the next shorter one beside what gamma does: mean cosine
    of their distance in the shorter period, the least of all; and the largest distance over the
    view, in that period, to which it grows from the projector's first column, 0 where it does not
    grow.

    Another offset or period leaves little of the images in few steps, and may put whole periods
    off.
    """
    sequence = base.sequence
    for axis, sample, m in evaluator.coarse.matched(base):
        periods = sequence.periods_px(axis)
        if sequence.find("gray", axis) or len(periods) < 2 or contradict(sequence, axis):
            continue
        layout, levels = axis_layout(sequence, axis), sample.levels[:, 1]
        _, turns = fit_ripples(
            layout,
            [
                phase_shift(levels, shift.indices, layout.sign, layout.offset_rad)[0]
                for shift in layout.shifts
            ],
            None,
        )
        low, high = np.quantile(m.coordinate, [0.05, 0.95])
        slopes = [np.polyfit(m.coordinate, each - np.rint(each), 1)[0] for each in turns]
        grown = [
            abs(slope) * high for slope in slopes if abs(slope) * (high - low) > limits.GROWING
        ]
        agreement = min(float(np.cos(2 * np.pi * each).mean()) for each in turns)
        yield axis, agreement, max(grown, default=0.0)


def _search(evaluator: Evaluator, base: Hypothesis) -> Explanation:
    """Choose the best of all hypotheses."""
    unresolved = {*list_unresolved(evaluator, base)}
    gained = _turned(evaluator, (base,))
    rated = [
        r
        for r in sorted(_rate_all(evaluator, base), key=lambda r: -r.net)
        if _is_possible(evaluator, r, gained)
        and (r.hypotheses[0].axis or not unresolved.issuperset(r.hypotheses[0].changed))
    ]
    if not rated:
        return ()
    for each in _list_likely(evaluator, rated, gained):
        is_single = each.hypotheses[0].excluded is not None
        if not is_single and _is_explained(evaluator, base, each, gained):
            return _explain_by_one(evaluator, rated, each) or _locate(evaluator, rated, each)
    return () if rated[0].hypotheses[0].excluded is None else _choose_strange(evaluator, rated)


def _is_possible(evaluator: Evaluator, rated: "_Rated", gained: float) -> bool:
    """Return whether an explanation is significant, and is not contradicted: what is wrong misleads
    everywhere, edges of surfaces and beats are misread in lines. ``gained``: cost of the
    description's directions."""
    first, change = rated.hypotheses[0], rated.comparison
    is_wide = change.share > limits.MAJORITY and change.breadth > limits.LEAST_SHARE
    if first.excluded is not None and not is_wide:
        return False
    if first.axis and change.share <= limits.LEAST_SHARE:
        return False
    if first.is_of_files and rated.turned > gained:
        return False
    is_significant = change.sigmas > _least_sigmas(rated, gained)
    is_repeating = _repetition(evaluator, first) < limits.REPEATED
    return is_significant and rated.net + gained > 0 and is_repeating


def _list_likely(
    evaluator: Evaluator, rated: Sequence["_Rated"], gained: float
) -> Sequence["_Rated"]:
    """Return the best explanation, then those that account for all images about as well: one that
    leaves none out is preferred, and comes first where it leaves as little, as a lost image of few
    steps fits what begins elsewhere; before it, images that are late from one on that is the same
    as the one before. ``gained``: cost of the description's directions."""
    first, *others = rated
    most_left, k = first.most_left, first.hypotheses[0].excluded
    if k is not None:  # all images are compared, that one too
        left, _ = _read_left_out(evaluator, first.hypotheses[0], k)
        most_left = min(most_left, float(left.mean()) + limits.LEFT_LEAST)
    rivals = [
        r
        for r in others
        if r.net + gained > limits.RIVAL * (first.net + gained)
        and r.comparison.left < most_left
        and not r.hypotheses[0].loses_images
    ]
    best = first.hypotheses[0]
    is_seen = best.is_late_from_one  # as an image that repeats another
    least = 0.0 if is_seen or not best.loses_images else first.comparison.left + limits.LEFT_ALIKE
    whole = [r for r in rivals if r.comparison.left < least and not r.hypotheses[0].is_of_files]
    alike = first.comparison.left + limits.LEFT_ALIKE
    if best.is_of_files:  # cameras are late more often than names are out of order
        whole = [r for r in others if r.hypotheses[0].is_late and r.comparison.left < alike]
    same = [
        r for r in rated if r.comparison.left < alike and _is_repeated(evaluator, r.hypotheses[0])
    ]
    return *same, *whole, first, *rivals


def _rate_all(evaluator: Evaluator, base: Hypothesis) -> list["_Rated"]:
    """Compare all hypotheses on the small sample, and return the best of them, compared on all
    pixels."""
    kept, explaining = _rank_orders(evaluator, base)
    rated = [_rate(evaluator, base, (h,)) for _, h in kept[: limits.KEPT]]
    by_axis, moved = list[Sequence[_Ranked]](), list[Sequence[_Ranked]]()
    for axis, sample in evaluator.sample.by_axis.items():
        own, known = evaluator.of_samples({axis: sample}), explaining
        for list_all, ranked in ((list_descriptions, by_axis), (list_motions, moved)):
            every, known = _rank_likely(own, base, [*list_all(base.sequence, axis)], known)
            ranked.append(every[: limits.KEPT // 2])
    rated += [_rate(evaluator, base, (h,)) for ranked in by_axis + moved for _, h in ranked]
    if len(by_axis) == 2:
        joint = [_rate(evaluator, base, (a, b)) for (_, a), (_, b) in product(*by_axis)]
        rated += [r for r in joint if r.comparison.sigmas > limits.SIGMAS]
    best = max(rated, key=lambda r: r.net).hypotheses[0]
    return rated + [_rate(evaluator, base, (h,)) for h in list_neighbours(best)]


def _rank_orders(
    evaluator: Evaluator, base: Hypothesis
) -> tuple[Sequence["_Ranked"], Hypothesis | None]:
    """Return the orders of the images and the exchanges of distant ones by what they gain on the
    small sample, and the one that explains it; see `_rank_likely`."""
    sequence = base.sequence
    every = [*list_orders(sequence), *recover_orders(evaluator, sequence)]
    first, others = _split_likely(evaluator, every)
    orders = _rank(evaluator, base, first)
    pairs = _rank(evaluator, base, _list_pairs(evaluator, base, orders))
    explaining = _choose_explaining(evaluator, base, [*orders, *pairs])
    orders += _rank(evaluator, base, _select_likely(evaluator, base, others, explaining))
    if explaining is None:
        orders.sort(key=lambda ranked: -ranked.net)
        pairs = _rank(evaluator, base, _list_pairs(evaluator, base, orders))
    return sorted([*orders, *pairs], key=lambda ranked: -ranked.net), explaining


def _rank_likely(
    evaluator: Evaluator,
    base: Hypothesis,
    hypotheses: Sequence[Hypothesis],
    explaining: Hypothesis | None,
) -> tuple[Sequence["_Ranked"], Hypothesis | None]:
    """Return hypotheses by what they gain on the small sample, without those that are clearly less
    likely than one that is known to explain it, if one is; and the one that explains it."""
    ranked = list[_Ranked]()
    if explaining is None:
        first, hypotheses = _split_likely(evaluator, hypotheses)
        ranked = _rank(evaluator, base, first)
        explaining = _choose_explaining(evaluator, base, ranked)
    ranked += _rank(evaluator, base, _select_likely(evaluator, base, hypotheses, explaining))
    return sorted(ranked, key=lambda ranked: -ranked.net), explaining


def _choose_explaining(
    evaluator: Evaluator, base: Hypothesis, ranked: Sequence["_Ranked"]
) -> Hypothesis | None:
    """Return the best hypothesis if it explains the small sample as the description does that of a
    sound capture; else None."""
    if not ranked:
        return None
    best = max(ranked, key=lambda ranked: ranked.net).hypothesis
    comparison = evaluator.coarse.compare(base, best)
    most = min(limits.SMALL_LOSS, limits.LEFT_BY_EXPLAINING * comparison.loss)
    return best if comparison.left < most else None


def _split_likely(
    evaluator: Evaluator, hypotheses: Sequence[Hypothesis]
) -> tuple[Sequence[Hypothesis], Sequence[Hypothesis]]:
    """Return the hypotheses that about fit best where each pixel is matched alone, and the
    others."""
    if not hypotheses:
        return (), ()
    alone = evaluator.part(slice(limits.ALONE))
    left = np.array([alone.leave_alone(h, h.images) for h in hypotheses])
    is_likely = ~_is_clearly_more(left - left[left.mean(axis=1).argmin()], limits.LEFT_LEAST)
    chosen = [h for h, own in zip(hypotheses, is_likely, strict=True) if own]
    return chosen, [h for h, own in zip(hypotheses, is_likely, strict=True) if not own]


def _select_likely(
    evaluator: Evaluator,
    base: Hypothesis,
    hypotheses: Sequence[Hypothesis],
    explaining: Hypothesis | None,
) -> Sequence[Hypothesis]:
    """Return the hypotheses that may explain the images about as well as the one that does, all
    without one: matched alone, pixels leave as little of the images that this one uses."""
    if explaining is None or not hypotheses:
        return hypotheses
    alone, used = evaluator.part(slice(limits.ALONE)), explaining.images
    left = np.array([alone.leave_alone(h, used) for h in hypotheses])
    rated = _rate(evaluator.coarse, base, (explaining,))
    most = rated.most_left - rated.comparison.left + rated.turned
    is_likely = ~_is_clearly_more(left - alone.leave_alone(explaining, used), most)
    return [h for h, own in zip(hypotheses, is_likely, strict=True) if own]


def _is_clearly_more(values: np.ndarray, most: float) -> np.ndarray:
    """Return whether the means of values (n, p) exceed a number by more than chance makes them."""
    errors = limits.SIGMAS_OF_RIVAL * values.std(axis=1) / np.sqrt(values.shape[1])
    return np.asarray(values.mean(axis=1) - errors > most)


def _locate(evaluator: Evaluator, rated: Sequence["_Rated"], found: "_Rated") -> Explanation:
    """Return an explanation; of lags that begin at about equally likely frames, the one whose image
    repeats the one before it most closely."""
    first = found.hypotheses[0]
    if not first.is_late_from_one:
        return found.hypotheses
    rivals = [
        h
        for each in rated
        if each.comparison.left < found.most_left
        for h in each.hypotheses[:1]
        if h.is_late_from_one
    ]
    return (min(rivals, key=lambda h: _repetition(evaluator, h)),)


def _repetition(evaluator: Evaluator, hypothesis: Hypothesis) -> float:
    """Return the mean squared difference, in squares of the pixels' ranges, of the image from which
    on all are late and the one before, which it repeats; 0 for another hypothesis."""
    if not hypothesis.is_late_from_one:
        return 0.0
    sample, (k,) = next(iter(evaluator.sample.by_axis.values())), hypothesis.frames
    squares = (sample.levels[k, 1] - sample.levels[k - 1, 1]) ** 2
    return float(squares.mean() / np.mean(sample.swing**2))


def _is_repeated(evaluator: Evaluator, hypothesis: Hypothesis) -> bool:
    """Return whether images are late from one on that is the same as the one before."""
    return hypothesis.is_late_from_one and _repetition(evaluator, hypothesis) < limits.SAME


def _explain_by_one(
    evaluator: Evaluator, rated: Sequence["_Rated"], found: "_Rated"
) -> Explanation:
    """Return what explains all images better than the explanation that was found: that a single one
    shows something else; empty where none does. What was rated leaves that image out."""
    first = found.hypotheses[0]
    if _is_repeated(evaluator, first):
        return ()
    few = first.changed if len(first.changed) <= limits.MOST_SINGLE else []
    every, base = range(len(first.images)), described(first.sequence)
    least, best = found.comparison.left - limits.LEFT_LEAST, None
    excluded = (r.hypotheses[0].excluded for r in rated)
    for k in {*few, *(i for i in excluded if i is not None)}:
        others = replace(base, images=tuple(None if i == k else i for i in every))
        left, shown = _read_left_out(evaluator, others, k)
        if left.mean() < least:
            least, best = float(left.mean()), shown
    return () if best is None else (best,)


@dataclass(frozen=True)
class _Rated:
    """Some hypotheses, compared with the description; ``net``: their gain less their cost, of which
    ``turned`` is that of the coordinates' directions."""

    hypotheses: Explanation
    comparison: MisfitChange
    net: float
    turned: float

    @property
    def most_left(self) -> float:
        """Misfit up to which another explanation is about as likely."""
        return limits.LEFT_OF_RIVAL * self.comparison.left + limits.LEFT_LEAST


def _least_sigmas(rated: _Rated, gained: float) -> float:
    """Return the significance that an explanation needs: less where nearly all pixels agree, and
    where it gives coordinates that rise in a possible direction, and the description, whose
    directions cost ``gained``, does not."""
    is_impossible = gained >= min(limits.MIRRORED_COST, limits.FOLDED_COST)
    is_possible = rated.turned < gained
    is_shared = rated.comparison.share > limits.NEARLY_ALL
    is_confirmed = is_shared or (is_impossible and is_possible)
    return limits.SIGMAS_CONFIRMED if is_confirmed else limits.SIGMAS


def _rate(evaluator: Evaluator, base: Hypothesis, hypotheses: Explanation) -> _Rated:
    """Compare hypotheses of different axes with the description, on all pixels."""
    each = [evaluator.compare(base, h) for h in hypotheses]
    gain = sum(c.gain for c in each)
    sigmas, share = min(c.sigmas for c in each), min(c.share for c in each)
    breadth = min(c.breadth for c in each)
    comparison = MisfitChange(each[0].loss, gain, sigmas, share, breadth)
    turned = _turned(evaluator, hypotheses)
    net = gain - sum(h.cost for h in hypotheses) - turned
    return _Rated(hypotheses, comparison, net, turned)


def _turned(evaluator: Evaluator, hypotheses: Explanation) -> float:
    """Return the cost of coordinates beyond the projector, and of the directions in which they
    rise: the same from neighbour to neighbour and over the image; camera and projector both see the
    scene from the front, and mostly stand upright."""
    coordinates = evaluator.coordinates(*hypotheses)
    J = coordinates.jacobian
    cost = limits.FOLDED_COST * (len(coordinates.beyond) + len(coordinates.folded))
    if J is None:
        return cost
    if np.linalg.det(J) < 0:
        return cost + limits.MIRRORED_COST
    return cost + (limits.TURNED_COST if J[0, 0] < 0 and J[1, 1] < 0 else 0.0)


def _is_explained(evaluator: Evaluator, base: Hypothesis, rated: _Rated, gained: float) -> bool:
    """Return whether hypotheses leave much less of all images, or of those that they move.

    ``gained``: cost of the description's directions.
    """
    first = rated.hypotheses[0]
    images = [image for i in first.changed if (image := first.images[i]) is not None]
    before, after = (evaluator.residuals(h)[images] for h in (base, first))
    if (
        first.cause == "frame-order"
        and first.frames
        and (after > limits.LEFT_OF_EACH * before).any()
    ):
        return False  # of two frames that have changed places, none shows what is described
    if first.is_of_files:
        return rated.comparison.left < limits.EXPLAINED * rated.comparison.loss
    if first.cause == "axes-swapped":
        # half of the frames of an axis fit by themselves, whatever the others show
        for axis in evaluator.sample.by_axis:
            a, b = evaluator.match(base, axis), evaluator.match(first, axis)
            if a is None or b is None or b.misfit.mean() > limits.EXPLAINED * a.misfit.mean():
                return False
        return True
    if first.cause == "moved":
        return rated.net > limits.EXPLAINED_BY_MOTION * rated.comparison.loss
    if rated.net + gained > limits.EXPLAINED * rated.comparison.loss:
        return True
    if len(rated.hypotheses) > 1 or rated.comparison.left > limits.LEFT_BESIDE:
        return False  # what hardly improves all images cannot be what is wrong with them
    return bool(np.nansum(after) < limits.LEFT_OF_FRAMES * np.nansum(before))


class _Ranked(NamedTuple):
    """A hypothesis, and what it gains less its cost."""

    net: float
    hypothesis: Hypothesis


class _Rival(NamedTuple):
    """A frame that shows something else: ``is_late`` where that is an earlier pattern; its squared
    ``residual``, and what the ``hypothesis`` leaves at each pixel, ``left`` (p,)."""

    is_late: bool
    residual: float
    left: np.ndarray
    hypothesis: Hypothesis


def _choose_strange(evaluator: Evaluator, rated: Sequence[_Rated]) -> Explanation:
    """Return, of frames that show something else, the one that explains all images best, and of
    about equally likely ones one that repeats an earlier frame, else the one that fits least
    itself; empty where blur or the projector's response explains why it does not fit."""
    rivals, best = list[_Rival](), rated[0]
    for each in rated:
        first = each.hypotheses[0]
        k = first.excluded
        is_rival = each.net > limits.RIVAL * best.net or each.comparison.left < best.comparison.left
        if k is not None and is_rival and not _is_unpredictable(evaluator, first, k):
            residual = _measure_strangeness(evaluator, first, k)
            share = each.net / each.comparison.loss
            if residual > (0 if share > limits.STRANGE_SHARE else limits.VERY_STRANGE):
                left, shown = _read_left_out(evaluator, first, k)
                is_late = shown.value is not None and shown.value < k
                rivals.append(_Rival(is_late, residual, left, shown))
    if not rivals:
        return ()
    least = min((rival.left for rival in rivals), key=np.mean)
    likely = []
    for rival in rivals:
        more = rival.left - least  # no more than chance makes it
        if more.mean() <= limits.SIGMAS_OF_RIVAL * more.std() / np.sqrt(len(more)):
            likely.append(rival)
    return (max(likely, key=lambda rival: (rival.is_late, rival.residual)).hypothesis,)


def _read_left_out(
    evaluator: Evaluator, hypothesis: Hypothesis, k: int
) -> tuple[np.ndarray, Hypothesis]:
    """Return what is left of all images, as `_measure_left` does, where image k, which the
    hypothesis leaves out, shows what it is most like, and the hypothesis that it shows that."""
    j = _identify_pattern(evaluator, hypothesis, k)
    return _measure_left(evaluator, hypothesis, k, j), _repeat(hypothesis.sequence, k, j)


def _measure_left(
    evaluator: Evaluator, hypothesis: Hypothesis, k: int, j: int | None
) -> np.ndarray:
    """Return the share (p,) of the variance of all images that is left at each pixel if image k,
    which the hypothesis leaves out, shows the pattern of frame j of its axis; None: even light."""
    losses = list[np.ndarray]()
    for axis, sample, m in evaluator.matched(hypothesis):
        atoms, residuals = evaluator.atoms(hypothesis, axis), [*m.residual(sample)]
        if k in atoms.frames:
            seen = sample.levels[k, 1] - m.background
            pattern = seen @ m.contrast / max(float(m.contrast @ m.contrast), 1e-6)
            if j is not None:
                pattern = atoms.at(m.coordinate)[atoms.frames.index(j)]
            residuals.append(seen - m.contrast * pattern)
        total = sample.levels[atoms.frames, 1].var(axis=0) * len(atoms.frames)
        left = np.sum(np.square(residuals), axis=0) / np.maximum(total, 1e-6)
        losses.append(np.minimum(left, 1))
    return np.concatenate(losses)


class _ReadImage(NamedTuple):
    """What an image shows at p pixels: ``shown`` (p,), relative to their dark and bright levels.

    ``patterns`` (k, p): of the k ``frames`` of its axis there. ``rise``, ``own_rise`` (p,): change
    of the image and of its own pattern from neighbour to neighbour, which is known even where two
    places fit.
    """

    frames: Indices
    shown: np.ndarray
    patterns: np.ndarray
    rise: np.ndarray
    own_rise: np.ndarray


def _read_image(evaluator: Evaluator, hypothesis: Hypothesis, k: int) -> _ReadImage | None:
    """Read image k, which the hypothesis leaves out, at the pixels that the others explain; None
    for too few of them."""
    for axis, sample, m in evaluator.explained(hypothesis):
        atoms = evaluator.atoms(hypothesis, axis)
        if k in atoms.frames:
            before, own, behind = sample.levels[k]
            ends = np.stack([m.coordinate - m.rise / 2, m.coordinate + m.rise / 2])
            first, second = atoms.at(ends.ravel())[atoms.frames.index(k)].reshape(2, -1)
            return _ReadImage(
                tuple(atoms.frames),
                (own - m.background) / m.contrast,
                atoms.at(m.coordinate),
                (behind - before) / m.contrast,
                second - first,
            )
    return None


def _correlate(seen: np.ndarray, own: np.ndarray) -> float:
    """Return the correlation of two series (p,), 0 where the first does not vary, or the second
    hardly."""
    varies = own.std() > 0.05 and seen.std() > 0
    return float(np.corrcoef(seen, own)[0, 1]) if varies else 0.0


def _identify_pattern(evaluator: Evaluator, hypothesis: Hypothesis, k: int) -> int | None:
    """Return the other frame of its axis whose pattern image k shows, which the hypothesis leaves
    out; None where it shows none."""
    if (read := _read_image(evaluator, hypothesis, k)) is None:
        return None
    residual = np.minimum((read.shown - read.patterns) ** 2, 1).mean(axis=1)
    j = int(residual.argmin())
    is_like = residual[j] < limits.UNLIKE_ANY_LEAST and read.patterns[j].std() > limits.FLAT / 2
    return read.frames[j] if is_like and read.frames[j] != k else None


def _measure_strangeness(evaluator: Evaluator, hypothesis: Hypothesis, k: int) -> float:
    """Return the mean squared residual of image k, which the hypothesis leaves out, in squares of
    the contrast; 0 where it shows its pattern, or what blur leaves of stripes, and no other one."""
    if (read := _read_image(evaluator, hypothesis, k)) is None:
        return 0.0
    shown, own = read.shown, read.patterns[read.frames.index(k)]
    alike = max(_correlate(shown, own), _correlate(read.rise, read.own_rise))
    kind = hypothesis.sequence.frames[k].kind
    # white may be exposed otherwise
    level = max(0.5, float(np.median(shown))) if kind in ("white", "texture") else 0.5
    is_flat = np.mean(np.minimum((shown - level) ** 2, 1)) < limits.FLAT**2
    is_excused = kind != "phase" and (is_flat or alike > limits.ALIKE)
    if is_excused and _identify_pattern(evaluator, hypothesis, k) is None:
        return 0.0
    residual = float(np.minimum((shown - own) ** 2, 1).mean())
    usual = limits.STRANGE * np.nanmedian(evaluator.residuals(hypothesis))
    return residual if residual > usual + limits.STRANGE_LEAST else 0.0


def _explain_single_images(evaluator: Evaluator, base: Hypothesis) -> Iterator[Hypothesis]:
    """Yield what single images show instead of their own step or bit; the others decode in spite of
    them, so that a search by the others does not find them."""
    shows, strange = _read_steps(evaluator, base)
    sequence = base.sequence
    if not shows and not strange:
        shows = dict(_list_copies(evaluator, sequence)[: limits.MOST_SINGLE])
    if len(strange) == 2 and not shows:
        swapped = exchange(sequence, *strange)
        before, after = (evaluator.residuals(h)[strange] for h in (base, swapped))
        if np.nansum(after) < limits.LEFT_OF_FRAMES * np.nansum(before):
            yield swapped
            return
    if len(shows) + len(strange) > limits.MOST_SINGLE:
        return
    for i, j in shows.items():
        if shows.get(j) != i:
            yield _repeat(sequence, i, j)
        elif i < j:
            yield exchange(sequence, i, j)
    if not shows and len(strange) < limits.MOST_SINGLE:
        yield from (Hypothesis("duplicate-frame", sequence, (), (i,)) for i in strange)


def _repeat(sequence: PatternSequence, i: int, j: int | None) -> Hypothesis:
    """Return the hypothesis that image i shows the pattern of frame j, or none of its axis."""
    cause: Cause = "frame-order" if j is not None and j > i else "duplicate-frame"
    return Hypothesis(cause, sequence, (), (i,), value=j)


def _list_copies(evaluator: Evaluator, sequence: PatternSequence) -> list[tuple[int, int]]:
    """Return the phase steps whose image repeats that of the step before, each with that step.

    Three steps fit any three images, but not as two that are alike and a third that is not. Where
    the scene covers a small part of a period, steps are alike in sound captures.
    """
    out = []
    base = described(sequence)
    for axis, sample in evaluator.sample.by_axis.items():
        m = evaluator.match(base, axis)
        for period, steps in sequence.phase_shifts(axis):
            if m is not None:
                turns = m.coordinate[m.good(sample)] / period
                if abs(np.exp(2j * np.pi * turns).sum()) > limits.CONCENTRATED * len(turns):
                    continue
            levels = sample.levels[list(steps), 1]
            squares = np.mean(np.diff(levels, axis=0) ** 2, axis=1)
            usual = float(squares.max() if len(steps) == 3 else np.median(squares))
            most = limits.COPY * usual + limits.COPY_NOISE * 2 * evaluator.sample.noise**2
            if most < usual / 4:
                alike = np.flatnonzero(squares < most)
                out += [(steps[k + 1], steps[k]) for k in alike]
    return out


def _read_steps(evaluator: Evaluator, base: Hypothesis) -> tuple[dict[int, int], list[int]]:
    """Return the frame that each phase step or bit shows which does not show its own, and the steps
    that show none of their axis: blur makes bits unlike any."""
    shows, strange = dict[int, int](), list[int]()
    for axis, sample, m in evaluator.explained(base):
        groups, own = evaluator.atoms(base, axis).groups[m.places], m.predicted
        shown = np.clip((sample.levels[m.images, 1] - m.background) / m.contrast, -1, 2)
        squares = [np.einsum("kp,kp->k", a, a) for a in (shown, own)]
        residual = (squares[0][:, None] - 2 * shown @ own.T + squares[1]) / own.shape[1]
        for group in {*groups.tolist()}:
            steps, is_code = np.flatnonzero(groups == group), group < 0
            usual = float(np.median(residual[steps, steps])) if len(steps) > 3 else np.inf
            for k in steps:
                j, left = int(residual[k].argmin()), float(residual[k, k])
                if left < limits.MISPLACED * usual + limits.MISPLACED_LEAST:
                    continue
                is_sure = not is_code or residual[k, j] < limits.UNLIKE_ANY_LEAST
                if is_sure and residual[k, j] < limits.LEFT_OF_FRAMES * left:
                    shows[m.images[k]] = m.images[j]
                elif not is_code and left > limits.UNLIKE_ANY * usual + limits.UNLIKE_ANY_LEAST:
                    strange.append(m.images[k])
    return shows, strange


def _list_pairs(
    evaluator: Evaluator, base: Hypothesis, orders: Sequence["_Ranked"]
) -> Iterator[Hypothesis]:
    """Yield exchanges of distant frames, of those without which the others fit best, or that fit
    least themselves."""
    alone = [h.frames[0] for _, h in orders if h.cause == "duplicate-frame"][: limits.KEPT]
    worst = np.argsort(-np.nan_to_num(evaluator.residuals(base)))[: limits.KEPT]
    kinds = base.sequence.frames
    chosen = sorted(i for i in {*alone, *worst.tolist()} if kinds[i].kind != "texture")
    for a, b in combinations(chosen, 2):
        if b > a + 1:  # less likely than another convention
            yield replace(exchange(base.sequence, a, b), cost=1.5 * limits.CHANGE_COST)


def _rank(
    evaluator: Evaluator, base: Hypothesis, hypotheses: Iterable[Hypothesis]
) -> list["_Ranked"]:
    """Return the hypotheses by what they gain on the small sample less their cost, best first."""
    coarse = evaluator.coarse
    gains = [_Ranked(coarse.compare(base, h).gain - h.cost, h) for h in hypotheses]
    return sorted(gains, key=lambda ranked: -ranked.net)
