"""Match of sampled pixels with the patterns of a hypothesis, by zero-mean normalised correlation.

A pixel sees A + B d(u) of the pattern values d at its projector coordinate u. The coordinate of
largest correlation is the most likely one for equal noise in all frames (Mirdehghan et al.,
"Optimal structured light a la carte", CVPR 2018). A pixel is predicted from the coordinates of its
two neighbours: that counts wrong patterns, and patterns that do not join, alike.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from slviewer.examination import limits
from slviewer.examination.atoms import Atoms
from slviewer.examination.sample import Sample
from slviewer.geometry.jit import kernel

_OF_PIXELS = ("coordinate", "rise", "background", "contrast", "misfit")


@dataclass(frozen=True, eq=False)
class Match:
    """Prediction of the p pixels of a sample.

    ``images`` (k,): of the sample, described by the ``atoms``, with blurred stripes, at ``places``
    (k,); ``coordinate`` (p,) px: the mean of the two neighbours'; ``rise`` (p,) px: from the first
    to the second one; ``predicted`` (k, p): pattern values; ``background``, ``contrast`` (p,): A
    and B; ``misfit`` (p,): 1 - correlation^2.
    """

    images: list[int]
    places: list[int]
    atoms: Atoms
    coordinate: np.ndarray
    rise: np.ndarray
    predicted: np.ndarray
    background: np.ndarray
    contrast: np.ndarray
    misfit: np.ndarray

    @property
    def jump(self) -> np.ndarray:
        """(p,) px between the neighbours' coordinates."""
        return np.abs(self.rise)

    def part(self, pixels: np.ndarray) -> "Match":
        """Return the match of some of the pixels."""
        return replace(
            self,
            predicted=self.predicted[:, pixels],
            **{name: getattr(self, name)[pixels] for name in _OF_PIXELS},
        )

    def residual(self, sample: Sample) -> np.ndarray:
        """(k, p) grey levels that the prediction does not explain."""
        seen = sample.levels[self.images, 1]
        return np.asarray(seen - self.background - self.contrast * self.predicted)

    def good(self, sample: Sample) -> np.ndarray:
        """(p,) bool: pixels that are explained, and lie on one surface with their neighbours."""
        return (
            (self.misfit < limits.GOOD)
            & (self.jump < 4 * np.median(self.jump) + 2)
            & (self.contrast > limits.LEAST_CONTRAST * sample.swing)
        )


def match(sample: Sample, atoms: Atoms, images: list[int | None]) -> Match:
    """Match a sample with atoms, whose frames are seen in ``images``; None where one is missing."""
    places = [place for place, image in enumerate(images) if image is not None]
    there = [image for image in images if image is not None]
    levels, values = sample.levels[there], atoms.values[places]
    centred = values - values.mean(axis=0)
    length = np.sqrt(np.einsum("ku,ku->u", centred, centred))
    beside = levels[:, [0, 2]]
    beside = beside - beside.mean(axis=0)
    scores = beside.reshape(len(there), -1).T @ (centred / np.maximum(length, 1e-3))
    # a bit on an edge, half bright, decides nothing
    undecided = limits.UNDECIDED * 0.25 / float(np.mean(length**2))
    best = _join(
        scores.reshape(2, levels.shape[2], -1),
        np.sqrt(np.einsum("kip,kip->ip", beside, beside)),
        undecided,
    )
    coordinate = _refine(scores, best.ravel()) * atoms.step_px + atoms.start_px
    first, second = coordinate.reshape(2, -1)
    middle, rise = (first + second) / 2, second - first
    seen, groups = levels[:, 1], atoms.groups[places]
    atoms = _blur_stripes(seen, atoms, middle, places)
    pattern = atoms.at(middle)[places]
    predicted = pattern
    misfit, background, contrast = _fit_levels(seen, predicted)
    for _ in range(limits.FITS_OF_GROUPS):
        predicted = _fit_groups(seen, pattern, background, contrast, misfit, groups)
        misfit, background, contrast = _fit_levels(seen, predicted)
    return Match(there, places, atoms, middle, rise, predicted, background, contrast, misfit)


def match_alone(sample: Sample, atoms: Atoms, images: Sequence[int | None]) -> np.ndarray:
    """Return the share (p,) of the variance that is left of pixels each of which is matched alone,
    wherever its neighbours are: less than `match` leaves, and known much sooner."""
    places = [place for place, image in enumerate(images) if image is not None]
    there = [image for image in images if image is not None]
    values, seen = atoms.values[places], sample.levels[there, 1]
    for each in (values, seen):  # copies
        each -= each.mean(axis=0)
        each /= np.maximum(np.sqrt(np.einsum("kp,kp->p", each, each)), 1e-3)
    return np.asarray(1 - np.maximum((seen.T @ values).max(axis=1), 0) ** 2)


def _blur_stripes(
    seen: np.ndarray, atoms: Atoms, coordinate: np.ndarray, places: list[int]
) -> Atoms:
    """Return the patterns with stripes as blurred as in levels (k, p) at coordinates (p,) px."""
    groups = atoms.groups[places]
    # of Gray code alone the table is as coarse as the cells, between which it is interpolated
    stripes = np.flatnonzero(groups < 0) if groups.max() >= 0 else np.empty(0, int)
    best, least = atoms, np.inf
    for blur in limits.BLURS if stripes.size else ():
        blurred = atoms.blurred(blur * atoms.step_px)
        patterns = blurred.at(coordinate)[np.array(places)[stripes]]
        misfit = float(_fit_levels(seen[stripes], patterns)[0].mean())
        if misfit > least:
            break
        best, least = blurred, misfit
    return best


def _fit_levels(
    seen: np.ndarray, predicted: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Fit levels (k, p) by the predicted patterns: 1 - correlation^2, background, contrast (p,)."""
    p0 = predicted - predicted.mean(axis=0)
    s0 = seen - seen.mean(axis=0)
    pp, ps, ss = (np.einsum("kp,kp->p", a, b) for a, b in ((p0, p0), (p0, s0), (s0, s0)))
    contrast = np.maximum(ps, 0) / np.maximum(pp, 1e-3)
    misfit = 1 - np.maximum(ps, 0) ** 2 / np.maximum(pp * ss, 1e-6)
    return misfit, seen.mean(axis=0) - contrast * predicted.mean(axis=0), contrast


def _fit_groups(
    seen: np.ndarray,
    predicted: np.ndarray,
    background: np.ndarray,
    contrast: np.ndarray,
    misfit: np.ndarray,
    groups: np.ndarray,
) -> np.ndarray:
    """Return the prediction with mean and contrast of the steps of each period fitted.

    Blur takes contrast from fine fringes that it leaves to wide stripes, and gamma lowers their
    mean.
    """
    good = misfit < np.quantile(misfit, 0.7)
    relative = (seen[:, good] - background[good]) / np.maximum(contrast[good], 1e-3)
    relative = np.clip(relative, -1, 2)
    out = predicted.copy()
    if not good.any():
        return out
    stripes = groups < 0
    x, y = predicted[stripes][:, good], relative[stripes]
    if x.size and x.var() > limits.VARIED_STRIPES:  # they are what fringes are compared with
        slope = np.mean((x - x.mean()) * (y - y.mean())) / x.var()
        slope = np.float32(np.clip(slope, 1 / limits.CONTRASTS[1], limits.CONTRASTS[1]))
        relative = (relative - y.mean()) / slope + x.mean()
    for group in range(groups.max() + 1):
        own = groups == group
        if np.count_nonzero(own) < 3:
            continue
        x, y = predicted[own][:, good].ravel(), relative[own].ravel()
        middle, spread = x.mean(), np.float32(max(float(x.var()), 1e-3))
        slope = np.mean((x - middle) * (y - y.mean())) / spread
        slope = np.float32(np.clip(slope, *limits.CONTRASTS))
        bent = (x - middle) ** 2 - spread
        curve = np.mean(bent * (y - slope * (x - middle))) / max(float(bent.var()), 1e-3)
        curve = np.float32(np.clip(curve, -slope / 2, slope / 2))
        z = predicted[own] - middle
        out[own] = y.mean() + slope * z + curve * (z**2 - spread)
    return out


def _join(scores: np.ndarray, length: np.ndarray, undecided: float) -> np.ndarray:
    """Return the place (2, p) of the best score of two neighbours; of places that are not at the
    usual distance, those at about that distance which fit both best, where the pixels decide too
    little against them.

    ``scores`` (2, p, u); ``length`` (2, p) of the pixels' centred levels. Where several places fit
    equally well several distances are frequent, and the usual one is that which fits best.
    """
    best = scores.argmax(axis=2)
    rise = best[1] - best[0]
    window = np.hanning(2 * limits.NEAR + 3)
    counts = np.convolve(np.bincount(rise - rise.min()), window)[limits.NEAR + 1 :]
    usual, most = list[int](), counts.max()
    while counts.max() > limits.FREQUENT * most:
        k = int(counts.argmax())
        counts[max(k - limits.NEAR, 0) : k + limits.NEAR + 1] = 0
        usual.append(k + int(rise.min()))
        if (np.abs(rise - usual[-1]) <= limits.NEAR).all():
            return best
    pairs, losses = _pair(scores, length, best, np.array(usual), undecided)
    return pairs[losses.sum(axis=1).argmin()]


@kernel()
def _pair(
    scores: np.ndarray, length: np.ndarray, best: np.ndarray, usual: np.ndarray, most: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return, for each of m ``usual`` distances, the places (m, 2, p) at about it that fit both
    neighbours best, and the loss (m, p) of their correlations against the ``best`` ones; those with
    their loss of ``most`` where it is not less, and without loss where these are at the distance;
    see `_join`."""
    count, size = scores.shape[1:]
    pairs, losses = np.empty((len(usual), *best.shape), best.dtype), np.empty((len(usual), count))
    first, loss = np.empty(size, best.dtype), np.empty(size)
    for p in range(count):
        a, b = 1 / max(length[0, p], 1e-6), 1 / max(length[1, p], 1e-6)
        high_a, high_b = scores[0, p, best[0, p]] * a, scores[1, p, best[1, p]] * b
        candidates = 0
        for place in range(size):
            if high_a - scores[0, p, place] * a < most:
                first[candidates], loss[candidates] = place, high_a - scores[0, p, place] * a
                candidates += 1
        for k in range(len(usual)):
            pairs[k, :, p] = best[:, p]
            is_near = abs(best[1, p] - best[0, p] - usual[k]) <= limits.NEAR
            losses[k, p] = 0.0 if is_near else most
            for c in range(candidates):
                if loss[c] >= losses[k, p]:
                    continue
                low, high = first[c] + usual[k] - limits.NEAR, first[c] + usual[k] + limits.NEAR
                for second in range(min(max(low, 0), size - 1), min(max(high, 0), size - 1) + 1):
                    both = loss[c] + high_b - scores[1, p, second] * b
                    if both < losses[k, p]:
                        losses[k, p], pairs[k, 0, p], pairs[k, 1, p] = both, first[c], second
    return pairs, losses


def _refine(scores: np.ndarray, best: np.ndarray) -> np.ndarray:
    """Return the place of the maximum between its neighbours, by a parabola."""
    inner = np.clip(best, 1, scores.shape[1] - 2)
    rows = np.arange(len(best))
    left, middle, right = (scores[rows, inner + d] for d in (-1, 0, 1))
    curve = 2 * middle - left - right
    shift = np.where(curve > 1e-9, (right - left) / np.maximum(2 * curve, 1e-9), 0.0)
    return np.asarray(np.where(best == inner, best + np.clip(shift, -0.5, 0.5), best))
