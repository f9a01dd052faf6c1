"""Light of each frame of a capture: estimated from the frames themselves, and equalized.

Frame i shows ``g_i(v) S_i(p) + o_i(p)``: S_i is what the scene shows of its pattern; the gain g_i
varies with automatic exposure and unsteady lamps, under a rolling shutter also along the image rows
v; o_i is the room light in excess of that of the other frames, uniform or in proportion to the
scene's albedo. Of several models the simplest one that explains the frames is selected; see
`light_fit`.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from slviewer.fringe.kernels_light import equalize
from slviewer.fringe.layout import check_stack, white_level
from slviewer.fringe.light_fit import (
    SHARE_PRIOR,
    Fit,
    Light,
    LightModel,
    Remainder,
    Term,
    equalize_sample,
    fit_light,
    light_model,
)
from slviewer.fringe.light_sample import (
    MIN_PIXELS,
    LightSample,
    estimate_albedo,
    list_shifts,
    sample_light,
)
from slviewer.fringe.sequence import Indices, PatternSequence

LEAST_GAIN = 0.005
"""rms variation of the gains below which they are not corrected: a camera's response and blur
simulate at most this."""
LEAST_OF_THREE = 0.02
"""The same of three steps, whose gains are known only as far as the scene's texture is independent
of the fringes."""
LEAST_CODED_GAIN = 0.045
"""The same of a frame without phase shift: between blurred stripes the light of neighbours adds to
it."""
LEAST_WAVE, LEAST_ROOM = 0.01, 0.03
"""rms of a wave along the rows, and change of the room's light over the mean grey level, that are
corrected."""
NOISE_PART = 0.25
"""A variation below this part of the noise of a grey level is not corrected either: it adds 3 % to
the noise."""
BETTER = 1.03
"""Factor by which a wave along the rows or room light must reduce the mean squared residual to be
accepted."""
AS_GOOD = 1.02
"""Models within this factor of the best explain the frames as well: the first, simplest, is
selected."""
LEFT, LEFT_CONTRAST = 4.0, 0.02
"""Light explains the frames if the mean squared residual is below ``LEFT`` times the squared
roughness, plus the square of ``LEFT_CONTRAST`` times the contrast, for the effect of blur and the
camera's response."""
EXPLAINED = 0.6
"""For Gray code alone, light explains the frames if the residual is below this share of that of
equal light: blur, scattered light and compression add to it. Light explains up to a third of sound
frames, and of misplaced ones."""
LEFT_OF_ROOM = 1.5
"""``LEFT`` for gains and room light together: they have enough values to fit a misplaced frame as
well."""
ONE_FRAME = 6.0
"""Largest residual of a frame relative to the median frame: frames that show another's pattern have
more."""
LEFT_OF_FRAME = 0.3
"""For Gray code alone, a larger residual is accepted below this share of the frame's residual in
equal light."""
CLEARLY_BETTER = 1.5
"""Both factors for Gray code alone whose residual exceeds noise: some percent of it are blur and
scattered light that a wave along the rows, or room light, happens to fit."""
MIN_FRAMES = 3
"""Frames that must be known on either side of a change of the room's light: one or two may just be
of other gain."""
CYCLES = np.arange(0.5, 8.25, 0.25)
"""Waves along the image's height that are tried."""
FINE = 0.05
"""Share of pixels inside stripes below which a coded frame has fine stripes throughout."""
FEW_STEPS = 4
"""Largest number of steps between which a change of room light is not corrected reliably: with four
steps on a textured board, light of a quarter of the mean caused an error of 1.4 px when modelled as
uniform."""
REFUTED, REFUTED_LEAST = 1.5, 0.004
"""Factor, and share of the brightness, by which a correction may worsen the equality of means."""
CONFIRMED, CONFIRMED_LEAST = 0.4, 0.01
"""Factor by which a correction improves it that is accepted although blur or the projector's
response leave residuals; and variation that is not a matter of too few fringes in view."""
MEAN_ROWS, MEAN_COLUMNS = 16, 4
"""Every so many rows and columns are averaged: enough for a thousandth."""
FARTHEST = 0.7
"""Logarithm of a gain beyond which a frame shows something else."""
CLIPPED = 65535.0
"""The grey level of equalized frames where the camera clipped."""

MODELS: tuple[tuple[Term, ...], ...] = (
    ("gain",),
    ("uniform", "albedo"),
    ("gain", "wave"),
    ("gain", "uniform", "albedo"),
)


@dataclass(frozen=True, eq=False)
class FrameLight:
    """Light of each of n frames, relative to their mean.

    ``terms``: terms of the light that are to be corrected, empty where no correction is necessary
    or possible; ``unexplained``: terms by which the frames differ, although these explain too
    little to be corrected. ``drift``: rms of the gains' logarithm; ``wave``: rms amplitude of the
    wave along the rows, relative; ``room`` (n,): room light of each frame as a share of the mean
    grey level, from 0 on.
    """

    light: Light
    terms: tuple[Term, ...]
    drift: float = 0.0
    wave: float = 0.0
    room: np.ndarray | None = None
    unexplained: tuple[Term, ...] = ()

    @property
    def is_significant(self) -> bool:
        """Whether the light differs between the frames by more than can be neglected."""
        return bool(self.terms)

    def count_open_steps(self, sequence: PatternSequence, k: int) -> int:
        """Return the number of phase steps of the period during which the room's light changes
        before frame ``k``; 0 where there are none, or enough to tell uniform light from light in
        proportion to the albedo."""
        for steps in list_shifts(sequence):
            if len(steps) <= FEW_STEPS and min(steps) < k <= max(steps):
                return len(steps)
        return 0


def estimate_frame_light(sequence: PatternSequence, stack: np.ndarray) -> FrameLight:
    """Estimate the light of the frames (n, h, w) uint8 or uint16 of a capture, from all of them
    together.

    A small sample decides first whether there is anything to estimate. Frames that cannot be judged
    have gain 1. Raises InputError when the frames are not those of the sequence.
    """
    check_stack(sequence, stack)
    steady = FrameLight(Light.constant(len(stack)), ())
    coarse = sample_light(sequence, stack, coarse=True)
    if coarse is None or not _is_light_varying(coarse):
        return steady
    sample = sample_light(sequence, stack)
    if sample is None:
        return steady
    fit = fit_light(sample, ("gain",), Light.constant(len(stack)))
    # bits and inverses are now separated better
    if np.ptp(np.log(fit.light.gain)) > 0.2 and sample.coded:
        sample = sample_light(sequence, stack, fit.light.gain) or sample
        coarse = sample_light(sequence, stack, fit.light.gain, coarse=True) or coarse
        fit = fit_light(sample, ("gain",), fit.light)
    gains = fit
    fit = _choose_model(coarse, sample, gains)
    if fit is not gains and not _needs_correction(sample, fit):
        fit = gains
    light = _estimate_fine_stripes(sample, _fill_unknown_frames(sample, fit))
    used = list(fit.informed)
    room_light = _compute_room_light(sample, light, used)
    room_light = room_light - room_light[used].min()
    before, after, claimed = _measure_unequal_means(sequence, stack, fit.light.gain, room_light)
    is_confirmed = before > CONFIRMED_LEAST and after < CONFIRMED * before
    if not (_explains_frames(sample, fit) or is_confirmed):
        return replace(steady, unexplained=fit.terms if _explains_most(sample, fit) else ())
    if after > REFUTED * before + REFUTED_LEAST or claimed > 3 * before + CONFIRMED_LEAST:
        return steady
    drift = float(np.std(np.log(fit.light.gain[used])))
    wave = float(np.sqrt(np.mean(light.wave[used] ** 2)))
    return FrameLight(light, fit.terms, drift, wave, room_light)


def _measure_unequal_means(
    sequence: PatternSequence, stack: np.ndarray, gain: np.ndarray, room: np.ndarray
) -> tuple[float, float, float]:
    """Measure the relative standard deviation of means of frames that are equal under equal light:
    as captured, and without these gains (n,) and room light (n,), a share of the mean; and that of
    the gains, which room light would have to balance where the means do not vary.

    Equal are the steps of the finest period of an axis, and the sums of a bit and its inverse. A
    surface that moves, and blur, imitate varying light, but not in these means.
    """
    means = stack[:, ::MEAN_ROWS, ::MEAN_COLUMNS].mean(axis=(1, 2))
    groups: list[list[tuple[int, ...]]] = []
    for axis in sequence.axes:
        groups += [[(i,) for i in steps] for _, steps in sequence.phase_shifts(axis)[-1:]]
        bits, inverse = sequence.bits("gray", axis), sequence.bits("inverse", axis)
        groups.append([*zip(bits, inverse, strict=False)])

    def spread(values: np.ndarray, whole: np.ndarray) -> float:
        """Return the largest deviation inside a group, as a share of its mean in ``whole``."""
        sums = [
            np.array([[v[[*pair]].sum() for pair in group] for v in (values, whole)])
            for group in groups
            if group
        ]
        return max((float(s[0].std() / max(s[1].mean(), 1e-6)) for s in sums), default=0.0)

    # without the light of the room the mean is smaller, and the differences are the same
    equalized = (means - room * means.mean()) / gain
    return spread(means, means), spread(equalized, means), spread(gain, gain)


def equalize_frames(
    sequence: PatternSequence,
    stack: np.ndarray,
    light: FrameLight,
    frames: Sequence[int] | None = None,
) -> tuple[PatternSequence, np.ndarray, float]:
    """Scale frames to equal light: their sequence, (k, h, w) uint16, and the factor that multiplied
    the grey levels.

    ``frames``: indices of the frames to scale, all if None. Phase-shifted frames are 65535
    throughout at pixels that the camera clipped in one of the frames of their period, and nowhere
    else. Room light is added to the frames that lack it rather than subtracted, so that nothing
    becomes negative.
    """
    chosen = list(range(len(stack)) if frames is None else frames)
    height, values = stack.shape[1], light.light
    angle = 2 * np.pi * values.cycles * np.arange(height) / (height - 1)
    waves = np.stack([np.cos(angle), np.sin(angle)])
    gain = values.gain[:, None] * (1 + values.wave @ waves)
    along_rows = values.albedo[:, :1] + values.albedo[:, 2:] * (
        np.arange(height) / (height - 1) - 0.5
    )
    offset, along_columns = (
        values.uniform - values.uniform.max(),
        values.albedo[:, 1] - values.albedo[:, 1].max(),
    )
    along_rows = along_rows - along_rows.max(axis=0)
    white = white_level(sequence, stack, chosen)
    albedo = np.zeros((0, 0), np.float32)
    highest = white - offset.min()
    if values.albedo.any():
        albedo = estimate_albedo(sequence, stack, values.changes)
        # A column's part reaches from -0.5 to 0.5 of its slope.
        highest -= float(albedo.max()) * (along_rows.min() - 0.5 * np.abs(along_columns).max())
        along_rows = along_rows - 0.5 * np.abs(along_columns).max()
    scale = float(min(256.0, 65000.0 / (highest / gain.min())))
    out = np.empty((len(chosen), *stack.shape[1:]), np.uint16)
    equalize(
        stack, np.array(chosen), gain[chosen].astype(np.float32), offset[chosen].astype(np.float32),
        along_rows[chosen].astype(np.float32), along_columns[chosen].astype(np.float32), albedo,
        scale, out,
    )  # fmt: skip
    for steps in list_shifts(sequence):
        if places := [k for k, i in enumerate(chosen) if i in steps]:
            clipped = np.maximum.reduce([stack[chosen[k]] for k in places]) >= white
            for k in places:
                out[k][clipped] = CLIPPED
    full_scale = None if sequence.full_scale is None else int(CLIPPED)
    return (
        replace(sequence, frames=tuple(sequence.frames[i] for i in chosen), full_scale=full_scale),
        out,
        scale,
    )


def _is_light_varying(sample: LightSample) -> bool:
    """Return whether one step of any model, on a small sample, promises a significant
    correction."""
    model, count = light_model(sample), len(sample.frames)
    if not model.informed:
        return False
    weight = np.ones(sample.frames.shape[1], np.float32)
    gains = fit_light(sample, ("gain",), Light.constant(count), weight, most_steps=1)
    if _has_large_gains(sample, gains):
        return True
    return any(
        fit_light(sample, terms, start, weight, most_steps=1).variance * BETTER < gains.variance
        for terms, start in _list_candidate_models(sample, gains)
    )


def _list_candidate_models(
    sample: LightSample, gains: Fit
) -> Iterator[tuple[tuple[Term, ...], Light]]:
    """Yield the models besides gains alone, each with the light to start from."""
    constant = Light.constant(len(sample.frames))
    remainder = light_model(sample).eliminate(gains.light, gains.share, gains.weight)
    changes_alone, changes_with_gain = _locate_room_changes(sample, constant, gains.weight)
    for terms in MODELS[1:]:
        start = replace(constant, gain=gains.light.gain) if "gain" in terms else constant
        if "wave" in terms:
            yield terms, replace(start, cycles=_estimate_strongest_wave(remainder))
        elif changes := changes_with_gain if "gain" in terms else changes_alone:
            yield terms, replace(start, gain=constant.gain, changes=changes)


def _locate_room_changes(
    sample: LightSample, light: Light, weight: np.ndarray
) -> tuple[Indices, Indices]:
    """Return the frame before which a change of the room light explains most of the residual; empty
    if there is none.

    First of a change of room light alone, then together with gains. ``weight`` (p,) of the pixels.
    """
    model = light_model(sample)
    # three steps: nothing but the Gray code contradicts a change
    if model.phased and not model.phase_freedom:
        return (), ()
    remainder = model.eliminate(light, SHARE_PRIOR[0], weight)
    normal, moment = remainder.normal_equations(
        light, ("gain", "uniform", "albedo"), max(remainder.variance, 1e-3), SHARE_PRIOR[0]
    )
    u = len(model.used)
    beside = range(5 * u, len(normal))
    return (
        _select_room_change(model, normal, moment, [*beside]),
        _select_room_change(model, normal, moment, [*range(u), *beside]),
    )


def _select_room_change(
    model: LightModel, normal: np.ndarray, moment: np.ndarray, free_columns: list[int]
) -> Indices:
    """Return the frame before which a change of the room light explains most of the residual; empty
    if there is none.

    ``normal`` and ``moment`` of gains, uniform light and albedo. The unknowns ``free_columns``,
    which every change has beside it, are eliminated first.
    """
    used, u = np.array(model.used), len(model.used)
    inverse = np.linalg.inv(normal[np.ix_(free_columns, free_columns)])
    cross = normal[u : 3 * u, free_columns] @ inverse
    own = normal[u : 3 * u, u : 3 * u] - cross @ normal[free_columns, u : 3 * u]
    target = moment[u : 3 * u] - cross @ moment[free_columns]
    phased, coded = set(model.phased), set(model.sample.coded)
    informed = np.array(model.informed)
    before = np.searchsorted(np.sort(informed), used)
    usable = [
        int(k)
        for k, count in sorted(zip(used, before, strict=True))[1:]
        if min(count, len(informed) - count) >= MIN_FRAMES
        # indistinguishable from where the fringes' mean lies
        and {i for i in used if i >= k} not in (phased, coded)
    ]
    if not usable:
        return ()
    step = (used >= np.array(usable)[:, None]).astype(float)
    part = step @ target.reshape(2, u).T
    precision = np.stack(
        [
            ((step @ block) * step).sum(axis=1)
            for block in own.reshape(2, u, 2, u).swapaxes(1, 2).reshape(4, u, u)
        ]
    )
    gain = np.einsum(
        "ki,ki->k", part, np.linalg.solve(precision.T.reshape(-1, 2, 2), part[:, :, None])[:, :, 0]
    )
    best = int(np.argmax(gain))
    return (usable[best],) if gain[best] > 0 else ()


def _has_large_gains(sample: LightSample, fit: Fit) -> bool:
    """Return whether the gains vary significantly among the steps of a period, or among the other
    frames.

    Only the former shift the phase. The latter appear to vary by some percent where stripes are
    blurred, and thresholds tolerate more.
    """
    used = list(fit.informed)
    level = float(np.mean(sample.frames[used]))
    gain = np.log(fit.light.gain)
    spread = {
        shift: float(np.std(gain[list(shift)]))
        for shift in sample.shifts
        if set(shift) <= set(used)
    }
    within = max(
        (s for shift, s in spread.items() if len(shift) > 3 or s > LEAST_OF_THREE), default=0.0
    )
    coded = [i for i in used if i in sample.coded]
    between = float(np.abs(gain[coded] - np.median(gain[coded])).max()) if coded else 0.0
    least = max(LEAST_GAIN, NOISE_PART * np.sqrt(fit.variance) / level)
    return within > least or between > max(LEAST_CODED_GAIN, least)


def _needs_correction(sample: LightSample, fit: Fit) -> bool:
    """Return whether a wave along the rows, or a change of the room light, is large enough to be
    corrected."""
    light, used = fit.light, list(fit.informed)
    if "wave" in fit.terms and np.sqrt(np.mean(light.wave[used] ** 2)) > LEAST_WAVE:
        return True
    room_light = _compute_room_light(sample, light, used)
    return any(abs(float(room_light[k] - room_light[k - 1])) > LEAST_ROOM for k in light.changes)


def _compute_room_light(sample: LightSample, light: Light, used: Sequence[int]) -> np.ndarray:
    """Return the room light (n,) of each frame as a share of the mean grey level."""
    albedo = float(np.mean(sample.albedo(light.changes)))
    return (light.uniform + light.albedo[:, 0] * albedo) / float(np.mean(sample.frames[list(used)]))


def _choose_model(coarse: LightSample, sample: LightSample, first: Fit) -> Fit:
    """Select the simplest model that explains the frames about as well as the best, on a coarse
    sample, and fit it."""
    weight = np.ones(coarse.frames.shape[1], np.float32)
    own = fit_light(coarse, ("gain",), first.light, weight, 2)
    fits = [
        own,
        *(
            fit_light(coarse, terms, start, weight, 3)
            for terms, start in _list_candidate_models(coarse, own)
        ),
    ]
    best = min(fit.variance for fit in fits)
    is_noise = bool(coarse.shifts) or own.variance < LEFT * coarse.roughness**2
    if own.variance < (BETTER if is_noise else CLEARLY_BETTER) * best:
        return first
    chosen = next(
        fit for fit in fits if fit.variance <= (AS_GOOD if is_noise else CLEARLY_BETTER) * best
    )
    if any("wave" in term for term in chosen.terms):
        chosen = _refine_wave(coarse, chosen)
    return fit_light(sample, chosen.terms, chosen.light, most_steps=3)


def _refine_wave(sample: LightSample, fit: Fit) -> Fit:
    """Refine the number of cycles of the wave by a parabola through the residuals of three fits."""
    tried = [fit]
    for step in (-0.12, 0.12):
        tried.append(
            fit_light(
                sample, fit.terms, replace(fit.light, cycles=fit.light.cycles + step), fit.weight, 2
            )
        )
    middle, below, above = (f.variance for f in tried)
    curvature = below + above - 2 * middle
    if curvature <= 0:
        return min(tried, key=lambda f: f.variance)
    cycles = fit.light.cycles + 0.12 * float(np.clip(0.5 * (below - above) / curvature, -1.5, 1.5))
    tried.append(fit_light(sample, fit.terms, replace(fit.light, cycles=cycles), fit.weight, 3))
    return min(tried, key=lambda f: f.variance)


def _estimate_strongest_wave(remainder: Remainder) -> float:
    """Return the cycles per image height of the strongest wave that the residual light has along
    the rows."""
    excess, rows = remainder.row_excess()
    excess = excess - excess.mean(axis=1, keepdims=True)
    power = (np.abs(excess @ np.exp(-2j * np.pi * rows[:, None] * CYCLES)) ** 2).sum(axis=0)
    return float(CYCLES[int(np.argmax(power))])


def _explains_frames(sample: LightSample, fit: Fit) -> bool:
    """Return whether the residual of a fit is like noise: small, and similar in all frames."""
    if fit.terms == ("gain",) and not _has_large_gains(sample, fit):
        return False
    model = light_model(sample)
    remainder = model.eliminate(fit.light, fit.share, fit.weight)
    energy = (fit.weight * remainder.left**2).sum(axis=1)
    entries = np.full(len(energy), float(fit.weight.sum()))
    entries[len(model.phased) :] = (fit.weight * sample.interior).sum(axis=1)
    judged = np.isin(model.used, fit.informed)
    each = energy[judged] / np.maximum(entries[judged], 1)
    limit = ONE_FRAME * max(float(np.median(each)), sample.roughness**2 / 2)
    if sample.shifts:
        most = LEFT if len(fit.terms) < 3 else LEFT_OF_ROOM
        small = most * sample.roughness**2 + LEFT_CONTRAST**2 * float(
            np.mean(sample.amplitudes) ** 2
        )
        return fit.variance < small and bool(each.max() < limit)
    equal = model.eliminate(
        Light.constant(len(sample.frames)), SHARE_PRIOR[0], np.ones_like(fit.weight)
    )
    unequal = (fit.weight * equal.left**2).sum(axis=1)[judged] / np.maximum(entries[judged], 1)
    return _explains_most(sample, fit) and bool(
        (each < np.maximum(limit, LEFT_OF_FRAME * unequal)).all()
    )


def _explains_most(sample: LightSample, fit: Fit) -> bool:
    """Return whether the light removes a large part of the residual that equal light has."""
    model, one = light_model(sample), np.ones_like(fit.weight)
    equal = model.eliminate(Light.constant(len(sample.frames)), SHARE_PRIOR[0], one).variance
    return model.eliminate(fit.light, fit.share, one).variance < EXPLAINED * equal


def _fill_unknown_frames(sample: LightSample, fit: Fit) -> Fit:
    """Return the fit with values for the frames that do not determine their own light.

    Such a frame has the gain of the nearest frame, and the room light since its last change.
    """
    light, known, used = fit.light, np.array(fit.informed), light_model(sample).used
    frames = np.arange(len(light.gain))
    nearest = known[np.argmin(np.abs(frames[:, None] - known), axis=1)]
    since = np.searchsorted(light.changes, frames, side="right")
    alike = np.array([next((i for i in used if since[i] == s), used[0]) for s in since])
    own = replace(
        light,
        gain=light.gain[nearest],
        wave=light.wave[nearest],
        uniform=light.uniform[alike],
        albedo=light.albedo[alike],
    )
    return replace(fit, light=own)


def _estimate_fine_stripes(sample: LightSample, fit: Fit) -> Light:
    """Estimate the gains of coded frames whose stripes are too fine to have an interior, and return
    the light.

    Over many fine stripes the mean of each bit and of each inverse is the same share of white:
    about half, more or less by what the camera's response makes of blurred stripes, which all of
    them have in common.
    """
    model, light = light_model(sample), fit.light
    remainder = model.eliminate(light, fit.share, fit.weight)
    inside = sample.interior.mean(axis=1) if sample.coded else np.zeros(0)
    fine = [
        i
        for i, share in zip(sample.coded, inside, strict=True)
        if share < FINE and i not in fit.informed
    ]
    dark, bright = remainder.levels
    both = (remainder.counts[0] > 0) & (remainder.counts[1] > 0)
    if "gain" not in fit.terms or not fine or np.count_nonzero(both) < MIN_PIXELS:
        return light
    middle = float(np.mean(0.5 * (dark + bright)[both]))
    frames, _ = equalize_sample(sample, light, fine)
    gain, excess = light.gain.copy(), np.maximum(frames[:, both].mean(axis=1) / middle, 1e-3)
    shows_stripes = np.abs(np.log(excess)) < FARTHEST
    if shows_stripes.any():
        gain[fine] *= np.where(shows_stripes, excess / np.median(excess[shows_stripes]), 1)
    return replace(light, gain=gain)
