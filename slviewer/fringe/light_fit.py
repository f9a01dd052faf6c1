"""Fit of the gains and offsets of a capture's frames to a sample of its pixels.

Per pixel, the phase-shifted frames have one background in common and one phasor for each period;
Gray, white and black frames show one of two levels, dark or bright; and the background is between
these at one share for the whole image. The residual after these unknowns are eliminated depends on
the light of the frames alone, and is solved for it by Gauss-Newton steps (variable projection),
with priors where the frames do not determine it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from itertools import compress
from typing import Literal

import numpy as np
from scipy.linalg import block_diag

from slviewer.fringe.cosines import (
    ONE_SIDED,
    cosine_columns,
    fit_common_harmonics,
    fit_cosine,
    measure_concentration,
)
from slviewer.fringe.light_sample import LightSample
from slviewer.fringe.sequence import Indices

Term = Literal["gain", "wave", "uniform", "albedo"]

PRIOR: dict[Term, float] = {"gain": 0.3, "wave": 0.1, "uniform": 0.3, "albedo": 0.3}
"""Standard deviation of each parameter: of a gain's logarithm, of the amplitude of its wave along
the rows, and of the room's light as a share of the mean grey level."""
WIDTH: dict[Term, int] = {"gain": 1, "wave": 2, "uniform": 1, "albedo": 3}
"""Values of each term per frame."""
SHARE_PRIOR = 0.5, 0.2
"""Position of the mean of the fringes between dark and bright, and its uncertainty: 0.3 to 0.65 for
usual gammas."""
GROUP_PRIOR = 0.003
"""By how much all coded frames together may differ from all phase-shifted ones, relative: that
difference can hardly be determined from the share above, and decoding does not need to separate
them."""
LINK_ERROR = 0.02
"""Share of the contrast by which blur shifts a pixel's background between dark and bright."""
COMMON = 1e4
"""Precision, relative to the priors', with which the mean over all frames is constrained: it is the
scene's own."""
HARMONIC_PRIOR = 0.1
HARMONIC_STEPS = 4
"""Largest number n of steps for which the fringe's harmonic n is significant in the background."""

MIN_ENTRIES = 0.03
"""Share of the sampled pixels that must be inside a coded frame's bright stripes."""
MAX_STEPS = 6
CONVERGED = 5e-4
OUTLIER = 4.0
"""A pixel whose residual is larger than the median pixel's by this factor in square loses
weight."""
CACHED_LIGHTS = 4
"""Lights of a sample whose residuals are cached."""

_Projected = tuple[
    np.ndarray, np.ndarray, np.ndarray, list[np.ndarray], list[tuple[slice, np.ndarray]]
]


@dataclass(frozen=True, eq=False)
class Light:
    """Factor and offset of the light in each of n frames.

    ``gain`` (n,); ``wave`` (n, 2): relative cosine and sine of ``cycles`` per image height along
    the rows; ``uniform`` (n,) grey levels; ``albedo`` (n, 3) times the scene's albedo (in grey
    levels): constant, along columns, along rows (both -0.5 ... 0.5). The room light, `uniform` and
    `albedo`, changes before the frames ``changes`` only: if it varied freely, a part in step with
    the fringes could not be separated from them.
    """

    gain: np.ndarray
    wave: np.ndarray
    cycles: float
    uniform: np.ndarray
    albedo: np.ndarray
    changes: Indices = ()

    @classmethod
    def constant(cls, count: int) -> "Light":
        """Return equal light for ``count`` frames."""
        return cls(np.ones(count), np.zeros((count, 2)), 0.0, np.zeros(count), np.zeros((count, 3)))

    @property
    def key(self) -> tuple[bytes | float | Indices, ...]:
        """Key of the values that equalized frames depend on, the same for equal lights."""
        return (
            *(part.tobytes() for part in (self.gain, self.wave, self.uniform, self.albedo)),
            self.cycles if self.wave.any() else 0.0,
            self.changes if self.uniform.any() or self.albedo.any() else (),
        )

    def values(self, term: Term, frames: Sequence[int]) -> np.ndarray:
        """Return the values (u, k) of a term in some frames, of the gain its logarithm."""
        values = getattr(self, term)[frames].reshape(len(frames), -1)
        return np.asarray(np.log(values) if term == "gain" else values)


@dataclass(frozen=True, eq=False)
class Fit:
    """Fitted light of the frames of a sample.

    ``variance``: mean squared residual; ``share``: position of the fringes' mean between dark (0)
    and bright (1); ``weight`` (p,): weight of each sampled pixel; ``informed``: the frames whose
    light the sample determines.
    """

    light: Light
    terms: tuple[Term, ...]
    variance: float
    share: float
    weight: np.ndarray
    informed: Indices


def fit_light(
    sample: LightSample,
    terms: Sequence[Term],
    start: Light,
    weight: np.ndarray | None = None,
    most_steps: int = MAX_STEPS,
) -> Fit:
    """Fit the light of the given terms to a sample by Gauss-Newton steps.

    ``start``: initial light, which also defines the wave's cycles; ``weight`` (p,): fixed weight of
    each pixel, robust weights if None; ``most_steps``: number of steps at most.
    """
    light, share, is_fixed = start, SHARE_PRIOR[0], weight is not None
    weight = np.ones(sample.frames.shape[1], np.float32) if weight is None else weight
    variance = max(sample.roughness**2, 1 / 12)
    model = light_model(sample)
    for _ in range(most_steps):
        remainder = model.eliminate(light, share, weight)
        variance = max(remainder.variance, 1e-3)
        change, share_change = remainder.solve(light, terms, variance, share)
        light, share = (
            _update_light(light, change, model),
            float(np.clip(share + share_change, 0.05, 0.95)),
        )
        if not is_fixed:
            weight = remainder.robust_weight()
        if all(
            np.abs(values).max() < CONVERGED * remainder.scale(term)
            for term, values in change.items()
        ):
            break
    remainder = model.eliminate(light, share, weight)
    return Fit(light, tuple(terms), remainder.variance, share, weight, model.informed)


def equalize_sample(
    sample: LightSample, light: Light, used: Sequence[int]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the samples (u, p) of the frames ``used`` under equal light, and the gains (u, p) that
    divided them."""
    frames = sample.frames[used]
    gain = np.broadcast_to(light.gain[used, None].astype(np.float32), frames.shape)
    wave = light.wave[used].astype(np.float32)
    if wave.any():
        cosine, sine = _compute_row_wave(sample, light.cycles)
        gain = gain * (1 + wave[:, :1] * cosine + wave[:, 1:] * sine)
    if light.uniform.any() or light.albedo.any():
        shapes = np.stack([np.ones_like(sample.column), sample.column - 0.5, sample.row - 0.5])
        added = light.uniform[used, None] + (
            light.albedo[used] @ (shapes * sample.albedo(light.changes))
        )
        frames = frames - added.astype(np.float32)
    return frames / gain, gain


def _compute_row_wave(sample: LightSample, cycles: float) -> tuple[np.ndarray, np.ndarray]:
    """Return cosine and sine (p,) of a wave along the image rows at the sampled pixels; ``cycles``
    per image height."""
    angle = np.float32(2 * np.pi * cycles) * sample.row
    return np.cos(angle), np.sin(angle)


def _update_light(light: Light, change: dict[Term, np.ndarray], model: "LightModel") -> Light:
    """Return the light after a step; frames that the sample does not determine change like the mean
    of the others."""
    used, known = model.used, np.isin(model.used, model.informed)
    values: dict[str, np.ndarray] = {}
    for term, step in change.items():
        if term in ("gain", "wave"):
            change[term] = step = np.where(known[:, None], step - step[known].mean(axis=0), 0)
        values[term] = getattr(light, term).copy()
        step = step.reshape(values[term][used].shape)
        if term == "gain":
            values[term][used] *= np.exp(np.clip(step, -0.5, 0.5))
        else:
            values[term][used] += step
    return replace(light, **values)  # type: ignore[arg-type]


@lru_cache(maxsize=2)
def light_model(sample: LightSample) -> "LightModel":
    """Return the model of a sample, cached for the last two samples: the coarse and the full one of
    a capture."""
    return LightModel(sample)


class LightModel:
    """Structure of the fit: which frames share a background, a phasor, or a level of dark and
    bright.

    ``phased``, ``used``: indices of the phase-shifted frames, and of all frames in the fit;
    ``keep``: matrix that projects phase steps onto their residual; ``phase_freedom``: its degrees
    of freedom; ``classes``, ``counts``: masks of the dark and of the bright stripes (c, p) and
    their frames per pixel (p,); ``informed``: frames whose light can be determined.
    """

    def __init__(self, sample: LightSample) -> None:
        """Build the model of a sample."""
        self.sample = sample
        self._projected: dict[object, _Projected] = {}
        self.phased = [i for shift in sample.shifts for i in shift]
        self.used = [*self.phased, *sample.coded]
        n = len(self.phased)
        parts, first = [], 0
        self.places, self.turning, self.determined = list[slice](), list[bool](), list[int]()
        for shift in sample.shifts:
            steps = len(shift)
            place = slice(first, first + steps)
            turning = measure_concentration(fit_cosine(sample.frames[list(shift)])[1]) < ONE_SIDED
            # If only part of the phases is in view, harmonics cannot be separated from light: its
            # frames are free.
            parts.append(
                cosine_columns(np.arange(steps), steps, 1)[:, 1:] if turning else np.eye(steps)
            )
            self.places.append(place)
            self.turning.append(turning)
            self.determined += range(n)[place] if turning else []
            first += steps
        design = np.hstack([np.ones((n, 1)), block_diag(*parts) if n else np.zeros((0, 0))])
        basis, sizes, _ = (
            np.linalg.svd(design, full_matrices=False) if n else (design, np.zeros(0), None)
        )
        basis = basis[:, sizes > 1e-9]
        self.keep = np.eye(n) - basis @ basis.T
        self.phase_freedom = n - basis.shape[1]
        self.classes = [sample.interior & ~sample.bright, sample.interior & sample.bright]
        self.counts = [members.sum(axis=0).astype(np.float32) for members in self.classes]
        # Dark stripes alone hardly depend on the gain.
        is_informed = self.classes[1].sum(axis=1) >= MIN_ENTRIES * sample.frames.shape[1]
        self.informed = (
            *(self.phased[k] for k in self.determined),
            *compress(sample.coded, is_informed),
        )

    def eliminate(self, light: Light, share: float, weight: np.ndarray) -> "Remainder":
        """Eliminate pattern and surface from the frames under a light; the residual contains only
        light and noise.

        ``share``: see `Fit`; ``weight`` (p,) of the pixels. Several models start from the same
        light, or one from another's result: the last lights' residuals are cached.
        """
        key = light.key
        projected = self._projected.pop(key, None) or self._project(light)
        self._projected[key] = projected  # the latest is last
        if len(self._projected) > CACHED_LIGHTS:
            del self._projected[next(iter(self._projected))]
        return Remainder(self, *projected, self.counts, share, weight)

    def _project(self, light: Light) -> _Projected:
        """Return gain, shown, left, levels and harmonics of a `Remainder`, all that depends on the
        light alone."""
        sample, n = self.sample, len(self.phased)
        frames, gain = equalize_sample(sample, light, self.used)
        shown, left = np.zeros_like(frames), np.zeros_like(frames)
        harmonics: list[tuple[slice, np.ndarray]] = []
        phases = frames[:n].copy()
        for place, shift, turning in zip(self.places, sample.shifts, self.turning, strict=True):
            phasor = fit_cosine(phases[place])[1]
            strength = np.abs(phasor)
            unit = phasor / np.maximum(strength, 1e-6)
            steps = len(shift)
            if steps > 3 and turning:
                phases[place] -= fit_common_harmonics(phases[place], phasor, 1)
            if steps <= HARMONIC_STEPS and turning:  # it looks like a change of the background
                wave = (strength * unit**steps).astype(np.complex64)
                harmonics += [(place, np.tile(part, (steps, 1))) for part in (wave.real, wave.imag)]
        left[:n] = self.keep.astype(np.float32) @ phases
        shown[:n] = phases - left[:n]
        levels = []
        for members, count in zip(self.classes, self.counts, strict=True):
            level = (frames[n:] * members).sum(axis=0) / np.maximum(count, 1)
            shown[n:] += level * members
            levels.append(level)
        left[n:] = (frames[n:] - shown[n:]) * sample.interior
        return gain, shown, left, levels, harmonics


@dataclass(eq=False)
class Remainder:
    """Residual of the frames under a light after each pixel's own unknowns are eliminated.

    ``gain``, ``shown``, ``left`` (u, p): gains, fitted levels and residuals; ``levels``,
    ``counts``: level and number of the dark and of the bright frames of each pixel (p,);
    ``harmonics``: frames of a shift and its aliased harmonic in them.
    """

    model: LightModel
    gain: np.ndarray
    shown: np.ndarray
    left: np.ndarray
    levels: list[np.ndarray]
    harmonics: list[tuple[slice, np.ndarray]]
    counts: list[np.ndarray]
    share: float
    weight: np.ndarray

    def __post_init__(self) -> None:
        """Compute contrast and link: the background's deviation from its share between dark and
        bright."""
        dark, bright = self.levels
        self.contrast = bright - dark
        linked = (self.counts[0] > 0) & (self.counts[1] > 0) & bool(self.model.determined)
        self.linked = linked
        background = (
            self.shown[self.model.determined].mean(axis=0)
            if self.model.determined
            else np.zeros_like(dark)
        )
        self.link = np.where(
            linked, background - (1 - self.share) * dark - self.share * bright, 0
        ).astype(np.float32)

    def scale(self, term: Term) -> float:
        """Return the unit of a term: 1, or what converts ``uniform`` or ``albedo`` to the mean grey
        level."""
        if term == "uniform":
            return self._mean_level
        albedo = max(float(np.mean(self.model.sample.amplitudes[-1])), 1e-3)
        return self._mean_level / albedo if term == "albedo" else 1.0

    @cached_property
    def _mean_level(self) -> float:
        """Mean grey level of the entries that show light."""
        bright = self.shown > 0
        return float(np.mean(self.shown[bright])) if bright.any() else 1.0

    @property
    def freedom(self) -> float:
        """Weighted degrees of freedom of the residual."""
        return float(np.sum(self.weight * self._pixel_freedom))

    @cached_property
    def _pixel_freedom(self) -> np.ndarray:
        """Degrees of freedom (p,) of each pixel's residual."""
        return np.asarray(
            self.model.phase_freedom + sum(np.maximum(count - 1, 0) for count in self.counts)
        )

    @property
    def variance(self) -> float:
        """Weighted mean squared residual of the sample, including that of the link."""
        own, freedom = float(np.sum(self.weight * (self.left**2).sum(axis=0))), self.freedom
        variance = max(own / max(freedom, 1.0), 1 / 12)
        weight = self._compute_link_weight(variance, self.share)
        return (own + float(np.sum(weight * self.link**2))) / max(
            freedom + float(np.sum(self.weight * self.linked)), 1.0
        )

    def row_excess(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the relative residual light (u, rows) of each image row in each frame, and the
        rows' positions.

        Positions are 0 at the top of the image and 1 at the bottom.
        """
        rows, place = np.unique(self.model.sample.row, return_inverse=True)
        inside = np.ones_like(self.shown)
        inside[len(self.model.phased) :] = self.model.sample.interior
        both, square = self.weight * self.shown * self.left, self.weight * inside * self.shown**2
        sums = [
            np.stack([np.bincount(place, line, len(rows)) for line in lines])
            for lines in (both, square)
        ]
        return sums[0] / np.maximum(sums[1], 1e-6), rows

    def robust_weight(self) -> np.ndarray:
        """Return the weight (p,) float32 of each pixel, small for outliers."""
        freedom = self._pixel_freedom
        ratio = (self.left**2).sum(axis=0) / np.maximum(freedom, 1)
        usual = float(np.median(ratio[freedom > 0])) if (freedom > 0).any() else 0.0
        return (1 / (1 + (ratio / max(OUTLIER * usual, 1e-6)) ** 2)).astype(np.float32)

    def solve(
        self, light: Light, terms: Sequence[Term], variance: float, share: float
    ) -> tuple[dict[Term, np.ndarray], float]:
        """Solve the linearised fit: the change (u, k) of each term of the light, and the change of
        the share."""
        normal, moment = self.normal_equations(light, terms, variance, share)
        into = self._build_change_matrix(terms, light.changes, len(normal))
        solution = into @ np.linalg.solve(into.T @ normal @ into, into.T @ moment)
        change: dict[Term, np.ndarray] = {}
        at, u = 0, len(self.model.used)
        for term in terms:
            count = WIDTH[term]
            change[term] = solution[at : at + count * u].reshape(count, u).T
            at += count * u
        return change, float(solution[-1])

    def normal_equations(
        self, light: Light, terms: Sequence[Term], variance: float, share: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return normal matrix and moment of the fit, with priors.

        The unknowns are the values (u,) of each shape of each term, then the harmonics, and the
        share. ``variance``: of the residual, which the equations are divided by.
        """
        model, sample = self.model, self.model.sample
        n, u = len(model.phased), len(model.used)
        cosine, sine = _compute_row_wave(sample, light.cycles)
        albedo = sample.albedo(light.changes)
        one = np.ones_like(cosine)
        shapes: dict[Term, list[np.ndarray]] = {
            "gain": [one],
            "wave": [cosine, sine],
            "uniform": [one],
            "albedo": [albedo, albedo * (sample.column - 0.5), albedo * (sample.row - 0.5)],
        }
        R = np.stack(
            [
                (self.shown if term in ("gain", "wave") else 1 / self.gain) * shape
                for term in terms
                for shape in shapes[term]
            ]
        )
        k, c, p = len(R), u - n, len(self.weight)
        total, at_harmonics = k * u, slice(k * u, k * u + len(self.harmonics))
        # How a frame's change moves the link: through the background, and through the levels of
        # dark and bright.
        reach = np.zeros_like(self.shown)
        reach[model.determined] = 1 / max(len(model.determined), 1)
        for members, part, count in zip(
            model.classes, (1 - share, share), self.counts, strict=True
        ):
            reach[n:] -= part * members / np.maximum(count, 1)
        waves = [wave.sum(axis=0) / len(model.determined) for _, wave in self.harmonics]
        moved = np.concatenate(
            [(R * reach).reshape(total, p), np.array(waves).reshape(-1, p), self.contrast[None]]
        )
        link_weight = self._compute_link_weight(variance, share)
        normal = ((moved * link_weight) @ moved.T).astype(float)
        moment = (moved @ (link_weight * self.link)).astype(float)
        # What remains of the frames themselves: phase steps project by ``keep``, coded frames lose
        # their class' mean.
        weighted = R * self.weight
        blocks = np.zeros((k, u, k, u))
        phased = weighted[:, :n].reshape(k * n, p) @ R[:, :n].reshape(k * n, p).T
        blocks[:, :n, :, :n] = model.keep[:, None] * phased.reshape(k, n, k, n)
        for members, count in zip(model.classes, self.counts, strict=True):
            own = (R[:, n:] * members).reshape(k * c, p)
            blocks[:, n:, :, n:] -= (own * (self.weight / np.maximum(count, 1)) @ own.T).reshape(
                k, c, k, c
            )
        for i in range(c):
            blocks[:, n + i, :, n + i] += (weighted[:, n + i] * sample.interior[i]) @ R[:, n + i].T
        normal[:total, :total] += blocks.reshape(total, total)
        moment[:total] += (weighted * self.left).sum(axis=2).ravel()
        # Harmonic n of the fringe in the background of a shift of n steps is an unknown beside the
        # light.
        for row, (place, wave) in enumerate(self.harmonics, start=total):
            own = (model.keep[:, place].astype(np.float32) @ wave) * self.weight
            moment[row] += np.sum(own * self.left[:n])
            cross = np.zeros((k, u))
            cross[:, :n] = (own * R[:, :n]).sum(axis=2)
            normal[row, :total] += cross.ravel()
            normal[:total, row] += cross.ravel()
            normal[row, at_harmonics] += [
                np.sum(own[other] * shown) for other, shown in self.harmonics
            ]
        normal /= variance
        moment /= variance
        self._add_priors(normal, moment, light, terms, share, total)
        return normal, moment

    def _build_change_matrix(
        self, terms: Sequence[Term], changes: Indices, total: int
    ) -> np.ndarray:
        """Return the matrix (total, unknowns) that expands the steps of the room light to the
        values of each frame.

        Gains and waves have one unknown per frame.
        """
        used = np.array(self.model.used)
        after = (
            np.stack([used >= k for k in changes], axis=1).astype(float)
            if changes
            else np.zeros((len(used), 0))
        )
        blocks = []
        for term in terms:
            blocks += [np.eye(len(used)) if term in ("gain", "wave") else after] * WIDTH[term]
        return np.asarray(block_diag(*blocks, np.eye(total - len(blocks) * len(used))))

    def _compute_link_weight(self, variance: float, share: float) -> np.ndarray:
        """Return the weight (p,) float32 of the equations that relate coded frames to phase
        steps."""
        dark, bright = (np.maximum(count, 1) for count in self.counts)
        parts = 1 / max(len(self.model.determined), 1) + (1 - share) ** 2 / dark + share**2 / bright
        error = (LINK_ERROR * self.contrast) ** 2
        return np.where(self.linked, self.weight * variance / (variance * parts + error), 0).astype(
            np.float32
        )

    def _add_priors(
        self,
        normal: np.ndarray,
        moment: np.ndarray,
        light: Light,
        terms: Sequence[Term],
        share: float,
        total: int,
    ) -> None:
        """Add the priors of the light to the normal equations, in place."""
        model = self.model
        n, u = len(model.phased), len(model.used)
        known = np.isin(model.used, model.informed)
        # the frames' mean is the scene's own
        relative = np.eye(u) + COMMON * np.outer(known, known)
        columns = [(term, column) for term in terms for column in light.values(term, model.used).T]
        for a, (term, column) in enumerate(columns):
            here = slice(a * u, (a + 1) * u)
            precision = (PRIOR[term] * self.scale(term)) ** -2
            normal[here, here] += precision * (relative if term in ("gain", "wave") else np.eye(u))
            moment[here] -= precision * column
        phased, coded = known & (np.arange(u) < n), known & (np.arange(u) >= n)
        if terms[0] == "gain" and self.linked.any() and coded.any():
            apart = phased / max(int(np.count_nonzero(phased)), 1) - coded / int(
                np.count_nonzero(coded)
            )
            stiff = GROUP_PRIOR**-2
            normal[:u, :u] += stiff * np.outer(apart, apart)
            moment[:u] -= stiff * apart * (apart @ columns[0][1])
        extra = np.arange(total, len(normal) - 1)
        normal[extra, extra] += HARMONIC_PRIOR**-2
        normal[-1, -1] += SHARE_PRIOR[1] ** -2
        moment[-1] += SHARE_PRIOR[1] ** -2 * (SHARE_PRIOR[0] - share)
