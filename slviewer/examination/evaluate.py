"""Evaluation of hypotheses about a capture on its sample."""

from collections.abc import Collection, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from functools import cache, cached_property

import numpy as np
from threadpoolctl import ThreadpoolController

from slviewer.errors import InputError
from slviewer.examination import limits
from slviewer.examination.atoms import Atoms, tabulate_atoms
from slviewer.examination.match import Match, match, match_alone
from slviewer.examination.sample import CaptureSample, Sample
from slviewer.fringe.layout import axis_layout
from slviewer.fringe.levels import longest_range, unambiguous_px
from slviewer.fringe.sequence import Axis, PatternSequence
from slviewer.records.verdict import Cause

Images = tuple[int | None, ...]
"""Image that shows each frame of a sequence, None for a missing one."""


@dataclass(frozen=True)
class Hypothesis:
    """What the images of a capture show: image ``images[i]`` shows frame i of ``sequence``.

    ``cause``: the fault that it stands for, None for the capture as described; ``frames``: those
    that it names; ``axis``: that it concerns, None for all; ``value``: of the description, where it
    changes one; ``cost``: misfit that simpler hypotheses are allowed before this one is chosen.
    ``motion_px``: displacement of the pattern in each frame along ``axis``; empty for none.
    """

    cause: Cause | None
    sequence: PatternSequence
    images: Images
    frames: tuple[int, ...] = ()
    axis: Axis | None = None
    value: float | None = None
    cost: float = 0.0
    motion_px: tuple[float, ...] = ()

    def motion_along(self, axis: Axis) -> tuple[float, ...]:
        """Return ``motion_px`` along an axis; empty for none."""
        return self.motion_px if self.axis == axis else ()

    @property
    def changed(self) -> list[int]:
        """Pattern frames that are seen in another image than their own, or in none."""
        kinds = self.sequence.frames
        return [i for i, j in enumerate(self.images) if j != i and kinds[i].kind != "texture"]

    @property
    def is_of_files(self) -> bool:
        """Whether it is an order that the names of files made, of no certain frames."""
        return self.cause == "frame-order" and not self.frames

    @property
    def is_late(self) -> bool:
        """Whether all images are late, or early."""
        return self.cause == "frame-lag" and not self.frames

    @property
    def is_late_from_one(self) -> bool:
        """Whether the images are late from one on, which repeats the one before."""
        return self.cause == "frame-lag" and bool(self.frames)

    @property
    def loses_images(self) -> bool:
        """Whether no image shows one of the pattern frames."""
        return any(self.images[i] is None for i in self.changed)

    @property
    def excluded(self) -> int | None:
        """The one frame that no image shows, if all others are in place; else None."""
        changed = self.changed
        return changed[0] if len(changed) == 1 and self.images[changed[0]] is None else None


@cache
def _find_blas() -> ThreadpoolController:
    """Return what limits NumPy's threads; it reads the list of the loaded libraries, 3 ms."""
    return ThreadpoolController()


def use_one_thread() -> AbstractContextManager[object]:
    """Return the context of work on a sample, whose products are too small for more threads."""
    return _find_blas().limit(limits=1, user_api="blas")


def described(sequence: PatternSequence) -> Hypothesis:
    """Return the hypothesis that all images show what the description says."""
    return Hypothesis(None, sequence, tuple(range(len(sequence.frames))))


@dataclass(eq=False)
class Evaluator:
    """Matches of a sample under hypotheses; those that several share are computed once."""

    sample: CaptureSample
    _atoms: dict[object, Atoms] = field(default_factory=dict)
    _matches: dict[object, Match] = field(default_factory=dict)

    @cached_property
    def coarse(self) -> "Evaluator":
        """The same on a small part of the sample."""
        return self.part()

    def part(self, pixels: slice | None = None) -> "Evaluator":
        """Return the same on some of the pixels; None: on the small sample of each axis."""
        by_axis = {
            axis: sample.part(pixels or slice(sample.few))
            for axis, sample in self.sample.by_axis.items()
        }
        return self.of_samples(by_axis)

    def of_samples(self, by_axis: dict[Axis, Sample]) -> "Evaluator":
        """Return the evaluator of other samples of the capture, with the same atoms."""
        return Evaluator(replace(self.sample, by_axis=by_axis), self._atoms)

    def atoms(self, hypothesis: Hypothesis, axis: Axis) -> Atoms:
        """Return the patterns of an axis."""
        key = _list_conventions(hypothesis, axis)
        if key not in self._atoms:
            if motion := hypothesis.motion_along(axis):
                still = self.atoms(replace(hypothesis, motion_px=()), axis)
                self._atoms[key] = still.displaced([motion[i] for i in still.frames])
            else:
                self._atoms[key] = tabulate_atoms(hypothesis.sequence, axis)
        return self._atoms[key]

    def match(self, hypothesis: Hypothesis, axis: Axis) -> Match | None:
        """Return the match of one axis; None where it has fewer than four images, or no pixels."""
        atoms, sample = self.atoms(hypothesis, axis), self.sample.by_axis.get(axis)
        images = tuple(hypothesis.images[i] for i in atoms.frames)
        if sample is None or not sample.swing.size or not _is_matchable(images):
            return None
        key = _list_conventions(hypothesis, axis), images
        if key not in self._matches:
            self._matches[key] = match(sample, atoms, list(images))
        return self._matches[key]

    def leave_alone(self, hypothesis: Hypothesis, known: Collection[int | None]) -> np.ndarray:
        """Return what a hypothesis leaves (p,) of the ``known`` images at pixels that are matched
        alone; all of an axis of which it uses fewer than four of them."""
        left = []
        for axis, sample in self.sample.by_axis.items():
            atoms = self.atoms(hypothesis, axis)
            shown = (hypothesis.images[i] for i in atoms.frames)
            images = [i if i in known else None for i in shown]
            every = np.ones(len(sample.swing))
            left.append(match_alone(sample, atoms, images) if _is_matchable(images) else every)
        return np.concatenate(left)

    def matched(self, *hypotheses: Hypothesis) -> Iterator[tuple[Axis, Sample, Match]]:
        """Yield each axis that is matched, its sample, and its match under the one of the
        hypotheses that is about it, else under the first."""
        for axis, sample in self.sample.by_axis.items():
            own = next((h for h in hypotheses if h.axis == axis), hypotheses[0])
            if (m := self.match(own, axis)) is not None:
                yield axis, sample, m

    def explained(self, hypothesis: Hypothesis) -> Iterator[tuple[Axis, Sample, Match]]:
        """Yield each axis of which enough pixels are explained, with the sample and the match of
        these."""
        for axis, sample, m in self.matched(hypothesis):
            good = m.good(sample)
            if np.count_nonzero(good) >= limits.FEWEST_PIXELS:
                yield axis, sample.part(good), m.part(good)

    def compare(self, base: Hypothesis, other: Hypothesis) -> "MisfitChange":
        """Compare a hypothesis with the ``base``, on the images that both use."""
        gains, losses = [], []
        for axis, sample in self.sample.by_axis.items():
            a, b = self.match(base, axis), self.match(other, axis)
            if a is None or b is None:
                gains.append(np.zeros(len(sample.swing)))
                losses.append(np.zeros(0) if a is None else a.misfit)
            elif len(a.images) == len(b.images):
                gains.append(a.misfit - b.misfit)
                losses.append(a.misfit)
            else:
                common = [i for i in a.images if i in b.images]
                total = np.maximum(sample.levels[common, 1].var(axis=0) * len(common), 1e-6)
                loss = []
                for m in (a, b):
                    residual = m.residual(sample)[[m.images.index(i) for i in common]]
                    loss.append(np.minimum(np.einsum("kp,kp->p", residual, residual) / total, 1))
                gains.append(loss[0] - loss[1])
                losses.append(loss[0])
        gain = np.concatenate(gains)
        mean = float(gain.mean())
        # chance loses as often as it gains, so that a few large gains are not significant
        chance = np.sqrt(2 * np.mean(np.minimum(gain, 0) ** 2))
        error = max(float(chance), float(gain.std()) / limits.MOST_SKEWED) / np.sqrt(len(gain))
        every = np.concatenate(losses)
        sigmas, changed = mean / (error + 1e-9), max(float(np.mean(gain != 0)), 1e-9)
        share, breadth = (float(np.mean(gain > least)) / changed for least in (0.0, 0.1 * mean))
        lost = float(every.mean()) if every.size else 1.0
        return MisfitChange(lost, mean, float(sigmas), share, breadth)

    def residuals(self, hypothesis: Hypothesis) -> np.ndarray:
        """Return the mean squared residual (n,) of each image in squares of the pattern's contrast,
        NaN where it is not matched."""
        out = np.full(len(hypothesis.images), np.nan)
        for _, sample, m in self.matched(hypothesis):
            least = 1e-3 + limits.LEAST_CONTRAST / 3 * sample.swing
            relative = m.residual(sample) / np.maximum(m.contrast, least)
            out[m.images] = np.fmax(out[m.images], np.minimum(relative**2, 1).mean(axis=1))
        return out

    def coordinates(self, *hypotheses: Hypothesis) -> "Coordinates":
        """Return how the projector's coordinates run over the image, each axis under the one of the
        hypotheses that is about it, else under the first."""
        sequence = hypotheses[0].sequence
        slopes, folded = list[np.ndarray](), list[Axis]()
        beyond: dict[Axis, tuple[np.ndarray, float]] = {}
        for axis, sample, m in self.matched(*hypotheses):
            if _is_ambiguous(sequence, axis):
                continue
            coordinate = _move_inside(sequence, axis, m.coordinate)
            u = coordinate[m.misfit < limits.GOOD]
            if sequence.projector_size and u.size:
                share = float(np.mean(u > sequence.extent(axis) + 0.5))
                if share > limits.OUTSIDE[bool(sequence.find("gray", axis))]:
                    beyond[axis] = u, share
            if np.count_nonzero(sure := m.good(sample)) < limits.FEWEST_PIXELS / 2:
                continue
            design, good = np.c_[np.ones(len(sure)), sample.place], sure
            for _ in range(4):  # without the surfaces before or behind most
                fit, *_ = np.linalg.lstsq(design[good], coordinate[good], rcond=None)
                off = np.abs(design @ fit - coordinate)
                good = sure & (off < 3 * np.median(off[good]) + 1)
            slopes.append(fit[:0:-1])
            if float(np.median(m.rise[sure])) * slopes[-1][1 - sample.direction] < 0:
                folded.append(axis)
        return Coordinates(np.array(slopes) if len(slopes) == 2 else None, beyond, folded)


def _move_inside(sequence: PatternSequence, axis: Axis, coordinate: np.ndarray) -> np.ndarray:
    """Return coordinates (p,) px of fringes with those before or behind the projector moved by the
    range after which the fringes repeat, where that moves them into it."""
    if sequence.projector_size is None or sequence.find("gray", axis):
        return coordinate
    extent, reach = sequence.extent(axis), longest_range(sequence.periods_px(axis))
    sign = np.where(coordinate < -0.5, 1, np.where(coordinate > extent - 0.5, -1, 0))
    moved = coordinate + sign * reach
    return np.where((moved >= -0.5) & (moved <= extent - 0.5), moved, coordinate)


def _is_matchable(images: Sequence[int | None]) -> bool:
    """Return whether the images that are not missing suffice for a match."""
    return len(images) - images.count(None) >= limits.FEWEST_IMAGES


def _is_ambiguous(sequence: PatternSequence, axis: Axis) -> bool:
    """Return whether the phase steps of an axis fit several places of the projector, so that they
    state no coordinate of it; with unknown size, whether they have one period."""
    try:
        layout = axis_layout(sequence, axis)
        if sequence.projector_size is None:
            return len(layout.shifts) == 1 and not layout.gray
        return unambiguous_px(layout) < layout.extent
    except InputError:
        return False


@dataclass(frozen=True, eq=False)
class Coordinates:
    """How the projector's coordinates run over the image.

    ``jacobian`` (2, 2): change of projector column and row with the camera's, None where one of
    them is not known; ``beyond``: the coordinates (p,) px of each axis of which too large a share
    lies beyond the projector, and that share; ``folded``: axes whose coordinates fall from
    neighbour to neighbour where they rise over the image, or the other way round.
    """

    jacobian: np.ndarray | None
    beyond: dict[Axis, tuple[np.ndarray, float]]
    folded: list[Axis]


@dataclass(frozen=True)
class MisfitChange:
    """By how much a hypothesis explains the images better than another.

    ``loss``: mean share of the images' variance that the other leaves; ``gain``: by how much less
    the first leaves; ``sigmas``: the gain in standard errors; ``share``: of the pixels that it
    changes, those that it explains better, and ``breadth`` by a tenth of the mean gain.
    """

    loss: float
    gain: float
    sigmas: float
    share: float
    breadth: float

    @property
    def left(self) -> float:
        """Mean share of the variance that the first leaves."""
        return self.loss - self.gain


def _list_conventions(hypothesis: Hypothesis, axis: Axis) -> tuple[object, ...]:
    """Return all of a hypothesis that the patterns of an axis depend on."""
    sequence = hypothesis.sequence
    return (
        axis, hypothesis.motion_along(axis),
        tuple(sequence.frames[i] for i in sequence.select(axis)), sequence.projector_size,
        sequence.sign(axis), sequence.offset_rad(axis), sequence.origin_px(axis),
        sequence.gray_cell(axis), sequence.binary,
    )  # fmt: skip
