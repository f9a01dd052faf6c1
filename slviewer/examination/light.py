"""Light of each frame of a capture, estimated from its sample, or found to be equal.

Per pixel, the patterns at its projector coordinate explain its levels but for background, contrast
and a displacement; what these three cannot take up is solved for the light of the frames by
Gauss-Newton steps (variable projection; Golub and Pereyra, Inverse Problems 19, 2003). Of several
models the simplest that explains pixels which it was not fitted to about as well as the best is
selected, and nothing is corrected that the frames' means, or the match of the patterns, refute.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from slviewer.examination import limits
from slviewer.examination.evaluate import Evaluator, Hypothesis, described, use_one_thread
from slviewer.examination.explain import is_late
from slviewer.examination.frame_means import (
    evaluate_waves,
    measure_drift,
    measure_unequal_means,
    shows_wave,
)
from slviewer.examination.sample import CaptureSample, Sample, sample_capture
from slviewer.fringe.frame_light import FrameLight, Term, estimate_albedo, list_shifts
from slviewer.fringe.image_area import ImageArea
from slviewer.fringe.layout import check_stack
from slviewer.fringe.sequence import Axis, PatternSequence
from slviewer.geometry.vectors import rms

MODELS: tuple[tuple[Term, ...], ...] = (
    ("room",), ("gain",), ("wave",), ("gain", "wave"), ("gain", "room")
)  # fmt: skip
VALUES: dict[Term, tuple[str, ...]] = {
    "gain": ("gain",), "wave": ("cosine", "sine"),
    "room": ("uniform", "albedo", "rows", "columns"),
}  # fmt: skip
"""Unknowns of each term: one a frame; of room light one for all frames
from its change on."""
PRIORS = {
    "gain": 0.3, "cosine": 0.1, "sine": 0.1, "uniform": 30.0, "albedo": 1.0, "rows": 1.0,
    "columns": 1.0, "level": 0.3,
}  # fmt: skip
"""Standard deviation of each value: relative, in grey levels, and of the albedo."""
CYCLES = np.arange(0.5, 8.25, 0.05)
"""Waves along the image's height that are tried."""
AROUND = np.linspace(-1, 1, 7)
"""Offsets from a pixel, over the distance of its neighbours: a stripe that ends between them is
changed by blur."""


@dataclass(frozen=True, eq=False)
class Look:
    """One look at the frames ``stack`` (n, h, w) of a capture: the evaluator of the sample that was
    taken of them, and the light of each frame. Decoding and examination share it."""

    stack: np.ndarray
    evaluator: Evaluator
    light: FrameLight

    @cached_property
    def area(self) -> ImageArea:
        """The part of the image that light changes between the frames."""
        return ImageArea.of_frames(self.stack)


def look_at(sequence: PatternSequence, stack: np.ndarray) -> Look:
    """Look at the frames (n, h, w) uint8 or uint16 of a capture.

    Frames whose light cannot be judged have gain 1. Raises InputError when the frames are not those
    of the sequence.
    """
    check_stack(sequence, stack)
    if not sequence.axes:
        nothing = Evaluator(CaptureSample({}, 0.0, 0.0, 0.0, 0.0, 0.0))
        return Look(stack, nothing, FrameLight.constant(len(stack)))
    with use_one_thread():
        evaluator = Evaluator(sample_capture(sequence, stack))
        return Look(stack, evaluator, estimate_light(evaluator, described(sequence), stack))


def estimate_frame_light(sequence: PatternSequence, stack: np.ndarray) -> FrameLight:
    """Estimate the light of the frames of a capture, from all of them together, as `look_at`
    does."""
    return look_at(sequence, stack).light


def estimate_light(evaluator: Evaluator, base: Hypothesis, stack: np.ndarray) -> FrameLight:
    """Estimate the light of the frames (n, h, w) of a capture, described by ``base``, whose sample
    an evaluator holds. One step of each term decides first whether there is any to estimate; of
    frames that are all late there is none."""
    constant = FrameLight.constant(len(stack))
    fitted = evaluator.part(np.s_[::2])
    varying, rate = _list_varying(fitted, base), measure_drift(base.sequence, stack)
    if (not varying and not rate) or is_late(evaluator, base):
        return constant
    judged = evaluator.part(np.s_[1::2])
    first = _measure_losses(judged, judged, base, constant)
    drift, score = _judge_drift(judged, base, rate, first)
    best, gains = drift, constant
    for terms in MODELS:
        if len(terms) > 1 and score < limits.EXPLAINED_WELL:
            break
        if not varying.issuperset(terms):
            continue
        light = _fit(fitted, base, terms, gains if "gain" in terms else constant)
        if terms == ("gain",):
            gains = light = _choose_gains(
                light, *_fit_from_means(fitted, base), judged, base, first
            )
        if len(terms) > 1 and not _is_large(base.sequence, stack, light, "gain"):
            light = replace(light, gain=constant.gain, terms=light.terms[1:])
        own = _score(judged, base, light, first)
        is_large = _is_large(base.sequence, stack, light, terms[-1], own)
        if is_large and own < score * limits.BETTER_LIGHT[len(terms) - 1]:
            best, score = light, own
    light = _accept(evaluator, base, stack, best, score)
    return drift if drift.terms and not light.terms else light


def _judge_drift(
    evaluator: Evaluator, base: Hypothesis, rate: float, first: np.ndarray
) -> tuple[FrameLight, float]:
    """Return a light that grows by a rate from frame to frame, and its score; equal light where it
    does not explain the pixels, whose losses under equal light are ``first`` (p,)."""
    count = len(base.images)
    constant = FrameLight.constant(count)
    gain = np.exp(rate * (np.arange(count) - count / 2))
    drift = replace(constant, gain=gain, terms=("gain",))
    score = _score(evaluator, base, drift, first, limits.SIGMAS_CONFIRMED) if rate else np.inf
    return (drift, score) if np.isfinite(score) else (constant, 1.0)


def _choose_gains(
    of_equal: FrameLight,
    of_means: FrameLight,
    centred: FrameLight,
    evaluator: Evaluator,
    base: Hypothesis,
    first: np.ndarray,
) -> FrameLight:
    """Return the best of gains that were fitted from equal light, where misread bits lead astray,
    and from means, where few fringes do; between kinds of frames they differ only where that
    explains more."""
    own, other, least = (_score(evaluator, base, x, first) for x in (of_equal, of_means, centred))
    if other < limits.BETTER_LIGHT[1] * min(own, least):
        return of_means
    return centred if least < own else of_equal


def _fit_from_means(evaluator: Evaluator, base: Hypothesis) -> tuple[FrameLight, FrameLight]:
    """Fit gains, beginning with the frames' mean levels over those of their axis; second relative
    to the mean of the frames of a kind, as the fit changes only these."""
    constant = FrameLight.constant(len(base.images))
    gain = np.ones(len(base.images))
    every = [evaluator.atoms(base, axis) for axis in evaluator.sample.by_axis]
    for atoms, sample in zip(every, evaluator.sample.by_axis.values(), strict=True):
        means = sample.levels[atoms.frames, 1].mean(axis=1) + 1
        gain[atoms.frames] = means / np.exp(np.log(means).mean())
    light = _fit(evaluator, base, ("gain",), replace(constant, gain=gain))
    logs = np.log(light.gain)
    for atoms in every:
        same = (atoms.groups[:, None] == atoms.groups).astype(float)
        logs[atoms.frames] -= same @ logs[atoms.frames] / same.sum(axis=1)
    return light, replace(light, gain=np.exp(logs))


def _is_agreed(evaluator: Evaluator, base: Hypothesis, light: FrameLight) -> bool:
    """Return whether parts of the image, each asked alone, agree on the gains of a light: light is
    the same for all, and what a tone curve, blur and the scene imitate is not."""
    if "gain" not in light.terms:
        return True
    parts = list[np.ndarray]()
    for rows, columns in np.ndindex(2, 2):
        by_axis = {}
        for axis, sample in evaluator.sample.by_axis.items():
            row, column = (sample.place > np.median(sample.place, axis=0)).T
            by_axis[axis] = sample.part((row == rows) & (column == columns))
        own = evaluator.of_samples(by_axis)
        if residuals := [*_project(own, equalize_samples(own, base.sequence, light), base, light)]:
            parts.append(_accumulate(residuals, light, ("gain",)).solve(("gain",))[0]["gain"])
    known = np.count_nonzero(np.reshape(parts, (-1, len(light.gain))), axis=0) > 1
    if not known.any():
        return False
    shifts, logs = list_shifts(base.sequence), np.log(light.gain)
    coded = {*range(len(logs))}.difference(*shifts)
    for kind in (*shifts, coded):
        if alike := [k for k in kind if known[k]]:
            logs[alike] -= logs[alike].mean()
    squares = np.var([part[known] for part in parts], axis=0) / (len(parts) - 1)
    # four values hardly tell a frame's own error
    errors = np.sqrt((squares + squares.mean()) / 2 + limits.CONVERGED**2)
    return bool(rms(logs[known] / errors) > limits.AGREED)


def _accept(
    evaluator: Evaluator, base: Hypothesis, stack: np.ndarray, light: FrameLight, score: float
) -> FrameLight:
    """Return the light of best ``score`` if it is to be corrected; else equal light, with the terms
    of one that is neither refuted nor explains enough."""
    sequence, samples = base.sequence, evaluator.sample.by_axis.values()
    depth = np.mean([np.mean(each.swing / 2) / each.levels.mean() for each in samples])
    constant = FrameLight.constant(len(stack))
    if not light.terms or not _is_agreed(evaluator, base, light):
        return constant
    before, after, claimed = measure_unequal_means(sequence, stack, light)
    is_refuted = after > limits.REFUTED * before + limits.REFUTED_LEAST
    is_refuted |= claimed > 3 * before + limits.CONFIRMED_LEAST
    # means that differ anyway, of few fringes in view, refute nothing that explains much
    if score <= limits.EXPLAINED_CLEARLY:
        is_refuted &= (before < limits.CONFIRMED_LEAST) | (after > limits.DEEPEST * depth)
    is_strange = np.abs(np.log(light.gain)).max() > limits.FARTHEST_GAIN
    if is_strange or is_refuted.any():
        return constant
    is_confirmed = (before > limits.CONFIRMED_LEAST) & (after < limits.CONFIRMED * before)
    if is_confirmed.any() or score < limits.EXPLAINED_BY_LIGHT:
        return light
    return replace(constant, unexplained=light.terms)


def _score(
    evaluator: Evaluator,
    base: Hypothesis,
    light: FrameLight,
    first: np.ndarray,
    sigmas: float = limits.SIGMAS,
) -> float:
    """Return the share of the residual, times that of the misfit, which a light leaves; infinite
    where pixels are few or match their neighbours less, or the improvement is not significant.

    ``first`` (p,): losses under equal light. ``sigmas``: standard errors of the improvement.
    """
    equal = equalize_samples(evaluator, base.sequence, light)
    losses = _measure_losses(evaluator, equal, base, light)
    gain = (first - losses)[both := np.isfinite(first - losses)]
    if len(gain) < limits.FEWEST_PIXELS / 2:
        return np.inf
    before, after = (
        np.concatenate([m.misfit for *_, m in each.matched(base)]) for each in (evaluator, equal)
    )
    misfit = after.mean() / before.mean()
    # a few pixels may be read otherwise by chance
    is_worse = misfit > limits.AS_WELL and _is_above_chance(after - before, limits.SIGMAS_CONFIRMED)
    if is_worse or not _is_above_chance(gain, sigmas):
        return np.inf
    return float(losses[both].mean() / first[both].mean() * misfit)


def _is_above_chance(values: np.ndarray, sigmas: float) -> bool:
    """Return whether the mean of values (p,) is positive by so many standard errors."""
    return bool(values.mean() > sigmas * values.std() / np.sqrt(len(values)))


def equalize_samples(
    evaluator: Evaluator, sequence: PatternSequence, light: FrameLight
) -> Evaluator:
    """Return an evaluator of the same pixels under equal light."""
    if not light.terms:
        return evaluator
    by_axis = {
        axis: replace(sample, levels=_equalize(sample, sequence, light))
        for axis, sample in evaluator.sample.by_axis.items()
    }
    return evaluator.of_samples(by_axis)


def _equalize(sample: Sample, sequence: PatternSequence, light: FrameLight) -> np.ndarray:
    """Return the levels (n, 3, p) of a sample under equal light."""
    row, column = sample.place.T
    wave = light.wave @ np.stack(evaluate_waves(row, light))
    gain = light.gain[:, None] * (1 + wave)
    room = light.uniform[:, None, None]
    if light.albedo.any():
        lamp = light.albedo @ np.stack([np.ones_like(row), row, column])
        seen = sample.levels.swapaxes(0, 1)
        albedo = np.stack([estimate_albedo(sequence, each, light.changes) for each in seen])
        room = room + lamp[:, None] * albedo
    return ((sample.levels - room) / gain[:, None]).astype(np.float32)


@dataclass(frozen=True, eq=False)
class _Residual:
    """What the patterns of one axis leave of k frames at p pixels, relative to each pixel's
    contrast.

    ``frames``, ``groups`` (k,): as of `Atoms`; ``level``, ``fuzzy`` (k,): rms of the levels, and
    share of the pixels beside an edge; ``pixels``: bool, of those of the sample; ``shapes``: (k, p)
    change of the levels with each value of the light but its wave's, by name; ``left`` (k, p): the
    residual without the part that background, contrast and displacement of a pixel take up, which
    ``basis`` (3, k, p) spans; ``weight`` and ``row`` (p,); ``entries``: independent residuals.
    """

    axis: Axis
    frames: np.ndarray
    groups: np.ndarray
    level: np.ndarray
    fuzzy: np.ndarray
    pixels: np.ndarray
    shapes: dict[str, np.ndarray]
    left: np.ndarray
    basis: np.ndarray
    weight: np.ndarray
    row: np.ndarray
    entries: int


def _project(
    evaluator: Evaluator, equal: Evaluator, base: Hypothesis, light: FrameLight
) -> Iterator[_Residual]:
    """Yield the residual of each axis under a light; ``equal``: the same pixels under equal
    light."""
    sequence, white = base.sequence, evaluator.sample.white
    for axis, sample, m in equal.matched(base):
        good = m.misfit <= max(limits.GOOD, float(np.median(m.misfit)))
        good &= m.contrast > limits.LEAST_CONTRAST * sample.swing
        if np.count_nonzero(good) < limits.FEWEST_PIXELS / 2:
            continue
        sample, m = sample.part(good), m.part(good)
        atoms, frames, contrast = equal.atoms(base, axis), np.array(m.images), m.contrast
        seen = evaluator.sample.by_axis[axis].levels[:, 1, good]
        level = m.background / contrast + m.predicted
        # between stripes blur changes the levels, at the same phase of the fringes everywhere
        beside = [atoms.at(m.coordinate + d * m.rise)[m.places] for d in AROUND]
        is_edge, groups = np.ptp(beside, axis=0) > 0.5, atoms.groups[m.places]
        fuzzy = is_edge.mean(axis=1)
        used = 1 - (is_edge & (groups < 0)[:, None]).astype(np.float32)
        used[(groups < 0) & (fuzzy >= limits.FUZZY)] = limits.FUZZY_WEIGHT
        used[seen[frames] >= white] = 0
        row, column = sample.place.T
        over = np.ones_like(level) / light.gain[frames, None]
        albedo = over * estimate_albedo(sequence, seen, light.changes) / contrast
        shapes = {
            "gain": level, "uniform": over / contrast, "albedo": albedo, "rows": albedo * row,
            "columns": albedo * column, "level": np.ones_like(level),
            "contrast": m.predicted - m.predicted.mean(axis=1, keepdims=True),
            "curve": m.predicted**2 * (groups >= 0)[:, None],
        }  # fmt: skip
        slope = atoms.slope_at(m.coordinate)[m.places] + 1e-6
        spans = np.stack([np.ones_like(level), m.predicted, slope]) * used
        basis = np.linalg.qr(spans.transpose(2, 1, 0))[0].transpose(2, 1, 0)
        left = _take_out(basis, (sample.levels[frames, 1] / contrast - level) * used)
        loss = np.einsum("kp,kp->p", left, left)
        weight = np.minimum(1, limits.OUTLIER * np.median(loss) / np.maximum(loss, 1e-12))
        yield _Residual(
            axis, frames, groups, np.sqrt(np.mean(level**2, axis=1)), fuzzy, good,
            {name: shape * used for name, shape in shapes.items()}, left, basis, weight, row,
            np.count_nonzero(used) - 3 * used.shape[1],
        )  # fmt: skip


def _take_out(basis: np.ndarray, levels: np.ndarray) -> np.ndarray:
    """Return levels (k, p) without the part that a basis (3, k, p) spans at each pixel."""
    taken = np.einsum("jkp,kp->jp", basis, levels)
    return np.asarray(levels - np.einsum("jkp,jp->kp", basis, taken))


@dataclass(frozen=True, eq=False)
class _Normal:
    """Normal equations of ``values`` of each of n frames: ``matrix`` (v n, v n) and ``moment``
    (v n,), in units of ``loss``, the mean square of ``entries`` independent residuals.

    ``level``, ``fuzzy`` (n,): see `_Residual`; the level of frames that the sample does not show is
    0. ``groups`` (n,): a number for the steps of each period, negative for the other frames of an
    axis.
    """

    values: tuple[str, ...]
    matrix: np.ndarray
    moment: np.ndarray
    loss: float
    entries: int
    groups: np.ndarray
    level: np.ndarray
    fuzzy: np.ndarray

    @property
    def known(self) -> np.ndarray:
        """Indices of the frames that the sample shows."""
        return np.flatnonzero(self.level)

    def solve(
        self, terms: Sequence[Term], change: int = 0, *, imitated: bool = False
    ) -> tuple[dict[str, np.ndarray], float]:
        """Return the change (n,) of each value, and the share of the residual that it removes.

        Beside the values of the terms, contrast and level of each period's steps, and the contrast
        of each other frame, are solved for. Gains are relative to the mean of their group, which
        contrast and level imitate, and 0 where the sample does not determine them. ``change``:
        frame before which the room's light changes. ``imitated``: beside a tone curve, and what it
        makes of blur, the level of other frames, which imitate gains.
        """
        t, normal, moment, _ = self._reduce(terms, (change,), imitated)
        x = np.linalg.solve(normal, moment)
        n = len(self.groups)
        step = (t @ x).reshape(len(self.values), n)
        if "gain" in terms:
            relative = t[:n] - t[self.known].mean(axis=0)
            variance = np.einsum("iq,qi->i", relative, np.linalg.solve(normal, relative.T))
            scattered = limits.SCATTERED / np.maximum(self.level, 1e-6)
            sure = variance + scattered**2 < limits.UNKNOWN_GAIN**2
            same = (self.groups[:, None] == self.groups) * sure
            same = same / np.maximum(same.sum(axis=1, keepdims=True), 1)
            step[0] = np.where(sure, step[0] - same @ step[0], 0)
        return dict(zip(self.values, step, strict=True)), float(x @ moment) / max(self.entries, 1)

    def rate_changes(self, terms: Sequence[Term]) -> dict[int, float]:
        """Return the share of the residual that a change of the room's light removes, by the frame
        before which it happens: a few from either end, and inside a group of frames; between groups
        level and contrast of the fringes imitate it."""
        few, known = limits.FEW_FRAMES_KNOWN, self.known
        groups = self.groups[known].tolist()
        inner = [
            int(known[i])
            for i in range(few, len(known) - few + 1)
            if not {*groups[:i]}.isdisjoint(groups[i:])
        ]
        _, normal, moment, changes = self._reduce(terms, inner)
        out = dict[int, float]()
        for k in inner:
            own = np.flatnonzero((changes == k) | (changes < 0))
            x = np.linalg.solve(normal[np.ix_(own, own)], moment[own])
            out[k] = float(x @ moment[own]) / max(self.entries, 1)
        return out

    def _reduce(
        self, terms: Sequence[Term], changes: Sequence[int], imitated: bool = False
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return what q unknowns do to the values (v n, q), their normal equations (q, q) and (q,)
        with what is known of them before, and the frame before which the room's light changes (q,),
        -1 of other unknowns."""
        n = len(self.groups)
        each, other = np.eye(n), self.groups < 0
        periods = [(self.groups == g).astype(float) for g in range(self.groups.max() + 1)]
        shared = np.stack([*periods, *each[other]], axis=1)
        blocks: dict[str, np.ndarray] = {
            "contrast": shared, "level": shared if imitated else shared[:, : len(periods)],
            **({"curve": np.ones((n, 1))} if imitated else {}),
            **{name: each for term in terms for name in VALUES[term]},
        }  # fmt: skip
        if "gain" in terms:
            same = (self.groups[:, None] == self.groups).astype(float)
            blocks["gain"] = each - same / same.sum(axis=1, keepdims=True)
        if "room" in terms:
            blocks |= dict.fromkeys(VALUES["room"], np.tri(n)[:, [*changes]])
        used = [(place, name) for place, name in enumerate(self.values) if name in blocks]
        count = sum(blocks[name].shape[1] for _, name in used)
        t, deviations = np.zeros((len(self.moment), count)), np.empty(count)
        of_room = list[int]()
        for place, name in used:
            own = np.s_[len(of_room) : len(of_room) + blocks[name].shape[1]]
            t[place * n : place * n + n, own] = blocks[name]
            deviations[own] = PRIORS.get(name, PRIORS["level"])
            if name == "contrast":
                blur = np.where(self.fuzzy[other] < limits.FUZZY, *limits.CONTRAST_PRIORS)
                deviations[own][len(periods) :] = blur
            if name == "level" and imitated:
                deviations[own][len(periods) :] = 1e-3 + limits.FUZZY_LEVEL * self.fuzzy[other]
            of_room += changes if name in VALUES["room"] else [-1] * blocks[name].shape[1]
        normal = t.T @ self.matrix @ t + np.diag(deviations**-2)
        return t, normal, t.T @ self.moment, np.array(of_room)


def _accumulate(
    parts: Sequence[_Residual], light: FrameLight, terms: Sequence[Term], more: Sequence[str] = ()
) -> _Normal:
    """Return the normal equations of the terms, of contrast and level, and of ``more`` values,
    about a light."""
    n = len(light.gain)
    values = (*(name for term in terms for name in VALUES[term]), "contrast", "level", *more)
    matrix, moment = np.zeros((len(values), n, len(values), n)), np.zeros((len(values), n))
    groups, (level, fuzzy) = np.full(n, -1), np.zeros((2, n))
    squares, entries = 1e-12, 0
    for part in parts:
        f, root = part.frames, np.sqrt(part.weight)
        waves = dict(zip(VALUES["wave"], evaluate_waves(part.row, light), strict=True))
        shapes = root * np.stack(
            [
                part.shapes["gain"] * waves[name] if name in waves else part.shapes[name]
                for name in values
            ]
        )
        taken = np.einsum("akp,jkp->akjp", shapes, part.basis).reshape(len(values) * len(f), -1)
        normal = -(taken @ taken.T).reshape(len(values), len(f), len(values), len(f))
        every = np.arange(len(f))
        normal[:, every, :, every] += np.einsum("akp,bkp->kab", shapes, shapes)
        matrix[:, f[:, None], :, f] += normal.transpose(1, 3, 0, 2)
        moment[:, f] += np.einsum("akp,kp->ak", shapes, root * part.left)
        squares += float(np.sum((root * part.left) ** 2))
        entries += part.entries
        coded = np.where(level[f] > 0, groups[f], groups.min() - 1)
        groups[f] = np.where(part.groups < 0, coded, part.groups + groups.max() + 1)
        level[f], fuzzy[f] = part.level, part.fuzzy
    loss, size = squares / max(entries, 1), len(values) * n
    matrix, moment = matrix.reshape(size, size) / loss, moment.ravel() / loss
    return _Normal(values, matrix, moment, loss, entries, groups, level, fuzzy)


def _list_varying(evaluator: Evaluator, base: Hypothesis) -> set[Term]:
    """Return the terms of which one step promises to explain more of the residual than as many
    values of noise do, beside contrast and level."""
    light = FrameLight.constant(len(base.sequence.frames))
    parts = [*_project(evaluator, evaluator, base, light)]
    if not parts:
        return set()
    light = replace(light, cycles=_find_wave(parts))
    normal = _accumulate(parts, light, ("gain", "wave", "room"), ("curve",))
    before, count = normal.solve(())[1], len(normal.known)
    imitated = normal.solve((), imitated=True)[1]
    shares: dict[Term, float] = {
        "gain": normal.solve(("gain",))[1] + before - imitated - count / normal.entries,
        "wave": normal.solve(("wave",))[1] - 2 * count / normal.entries,
        "room": max(normal.rate_changes(("room",)).values(), default=0.0) + before - imitated,
    }
    return {term for term, share in shares.items() if share > before + limits.LIGHT_SHARE}


def _find_wave(parts: Sequence[_Residual]) -> float:
    """Return the cycles per image height of the strongest wave that the residual has along the
    rows."""
    power = np.zeros(len(CYCLES))
    for part in parts:
        waves = np.exp(-2j * np.pi * (part.row[:, None] + 0.5) * CYCLES)
        excess = part.left * part.shapes["gain"] * part.weight
        excess = excess - excess.mean(axis=1, keepdims=True)
        power += (np.abs(excess @ waves) ** 2).sum(axis=0)
    return float(CYCLES[int(np.argmax(power))])


def _fit(
    evaluator: Evaluator, base: Hypothesis, terms: tuple[Term, ...], start: FrameLight
) -> FrameLight:
    """Fit the terms of a model by Gauss-Newton steps from a first light, and return the light of
    the last step that leaves about the least residual: of few fringes in view they may diverge."""
    light = best = replace(start, terms=terms)
    least = np.inf
    for step in range(limits.MOST_STEPS):
        equal = equalize_samples(evaluator, base.sequence, light)
        parts = [*_project(evaluator, equal, base, light)]
        if "wave" in terms and not step:  # of no amplitude yet
            light = replace(light, cycles=_find_wave(parts))
        if not parts:
            break
        normal = _accumulate(parts, light, terms)
        left = normal.loss * (1 - normal.solve(())[1])
        if left < limits.NO_WORSE * least:
            least, best = min(left, least), light
        if "room" in terms and not step:
            rated = normal.rate_changes(terms)
            if not rated:
                break
            light = replace(light, changes=(max(rated, key=rated.__getitem__),))
        change, _ = normal.solve(terms, *light.changes)
        light = _update(light, change, evaluator)
        steps = [np.abs(change[name]).max() for term in terms for name in VALUES[term]]
        if max(steps) < limits.CONVERGED:
            break
    return best


def _update(light: FrameLight, change: dict[str, np.ndarray], evaluator: Evaluator) -> FrameLight:
    """Return the light after a step."""
    if "gain" in light.terms:
        step = np.clip(change["gain"], -0.5, 0.5)
        light = replace(light, gain=light.gain * np.exp(step))
    if "wave" in light.terms:
        step = np.stack([change["cosine"], change["sine"]], axis=1)
        light = replace(light, wave=light.wave + step - step.mean(axis=0))
    if "room" in light.terms:
        samples = evaluator.sample.by_axis.values()
        mean = np.mean([s.levels[:, 1].mean() for s in samples])
        swing = np.mean([s.swing.mean() for s in samples])
        uniform = light.uniform + change["uniform"]
        albedo = light.albedo + np.stack([change[n] for n in VALUES["room"][1:]], axis=1)
        room = (uniform + albedo[:, 0] * swing / 2) / mean
        light = replace(light, uniform=uniform, albedo=albedo, room=room - room.min())
    return light


def _measure_losses(
    evaluator: Evaluator, equal: Evaluator, base: Hypothesis, light: FrameLight
) -> np.ndarray:
    """Return the weighted squared residual (p,) of the pixels of all axes under a light, beside
    contrasts and levels that fit them; NaN where it is not known. ``equal``: see `_project`."""
    parts = {part.axis: part for part in _project(evaluator, equal, base, light)}
    change = _accumulate([*parts.values()], light, ()).solve(())[0]
    losses = [np.zeros(0)]
    for axis, sample in evaluator.sample.by_axis.items():
        losses.append(np.full(len(sample.swing), np.nan))
        if part := parts.get(axis):
            own = sum(part.shapes[name] * change[name][part.frames, None] for name in change)
            left = part.left - _take_out(part.basis, own)
            losses[-1][part.pixels] = np.einsum("kp,kp->p", left, left) * part.weight
    return np.concatenate(losses)


def _is_large(
    sequence: PatternSequence,
    stack: np.ndarray,
    light: FrameLight,
    term: Term,
    left: float = 1.0,
) -> bool:
    """Return whether a term of the light, which leaves that share of the residual, is large enough
    to be corrected: a drift also makes the means of equal frames equal, and those of rows show a
    wave that leaves much; of few fringes in view they differ anyway."""
    if term == "wave":
        is_seen = left <= limits.EXPLAINED_WELL or shows_wave(sequence, stack, light)
        return is_seen and rms(light.wave) > limits.LEAST_WAVE
    if term == "room":
        return float(np.ptp(light.room)) > limits.LEAST_ROOM
    logs = np.log(light.gain)
    for steps in list_shifts(sequence):
        least = limits.LEAST_GAIN if len(steps) > 3 else limits.LEAST_GAIN_OF_THREE
        if logs[[*steps]].std() > least:
            return True
    coded = [i for i, f in enumerate(sequence.frames) if f.kind not in ("phase", "texture")]
    least_coded = limits.LEAST_CODED_GAIN[bool(list_shifts(sequence))]
    return bool(coded) and float(np.ptp(logs[coded])) / 2 > least_coded
