"""Choosing the exposures of a capture: from a quick bracket, the few that measure as much of the
scene as possible."""

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from slviewer.devices.capture import settle
from slviewer.devices.protocols import CameraSettings, Rig, find_full_scale, report_driver_faults
from slviewer.errors import DeviceError, InputError
from slviewer.fringe.layout import Layout, axis_layout
from slviewer.fringe.limits import DARK_LEVELS
from slviewer.fringe.phase_shifting import dark_sigmas, phase_shift
from slviewer.fringe.plateau import find_plateau
from slviewer.fringe.sequence import PatternSequence
from slviewer.geometry.rigid import Floats, Floats32, Mask
from slviewer.pipeline.operation import Progress, ignore_progress

MAX_SUGGESTED = 4
BUDGET_S = 20.0
"""What a capture may last by default."""
Region = tuple[int, int, int, int]
Exposures = tuple[float, ...]
Image = NDArray[np.uint8]
STATES = ("unlit", "measured", "saturated", "dark")
"""States of a pixel, by their numbers in `ExposureSuggestion.state`."""
_UNLIT, _MEASURED, _SATURATED, _DARK = range(len(STATES))

_PIXELS = 150_000
_STOP = 4.0  # between exposures of the bracket
_MAX_LOOKS = 6  # on either side of the present exposure
_LONGEST_LOOK_MS = 1000.0
_FEW = 0.002  # of the pixels: a further exposure that concerns fewer is not tried
# of full scale, that the brightest grey level of a pixel may reach: the light varies a little
_HEADROOM = 0.97
_WEAK_COST = 0.3
"""By how much less a pixel counts that is barely modulated: its depth is noisier."""
_WORTH = 0.02
"""Share of the illuminated pixels that one exposure more must add."""
_CANDIDATES = 32
_APART = 1.9  # ratio of neighbouring exposures
_CORRECTIONS = 3
_MAX_DOUBLINGS = 3
_BEYOND = 1.33
"""By how much longer than the longest that was tried an exposure may have to be for a pixel to
count as illuminated; noise alone has the modulation that asks for 1.33 times in one pixel of
10,000."""
_LATE = 0.05
"""Share of the illuminated pixels that time is too short for, from which the gain is raised."""
_ALL = 0.98
_FACTOR = 0.8  # of exposures that turn out to saturate


@dataclass(frozen=True, eq=False)
class ExposureSuggestion:
    """Exposures that were chosen and tried, and what they measure.

    ``exposures_ms`` ascending, and the camera's ``gain``, None where it is unknown. ``share`` of
    the illuminated pixels that are measured with them, and ``share_before`` with the exposures
    before. ``capture_s`` that a capture then lasts. ``state`` and ``state_before`` (h, w) uint8,
    indices of `STATES`, of every ``stride``-th row and column; ``image`` (h, w) uint8 is the scene
    there.
    """

    exposures_ms: Exposures
    gain: float | None
    share: float
    share_before: float
    capture_s: float
    state: Image
    state_before: Image
    image: Image
    stride: int

    def text(self) -> str:
        """The suggestion in one sentence."""
        listed = " and ".join(f"{exposure:g}" for exposure in self.exposures_ms)
        gain = "" if self.gain is None else f" at gain {self.gain:g}"
        return (
            f"{len(self.exposures_ms)} exposure{'s' * (len(self.exposures_ms) > 1)} of {listed}"
            f" ms{gain} measure {100 * self.share:.1f} % of what the projector lights"
            f" ({100 * self.share_before:.1f} % before), in {self.capture_s:.1f} s a capture"
        )


@dataclass(frozen=True, eq=False)
class _Look:
    """Fringes in one exposure, (h, w) float32 grey levels each: modulation, background, and the
    brightest sample; ``repeat`` (2, h, w): the same frame twice."""

    exposure_ms: float
    modulation: Floats32
    background: Floats32
    peak: Floats32
    repeat: Floats32


def suggest_exposure(
    rig: Rig,
    sequence: PatternSequence,
    *,
    current_ms: Sequence[float] = (),
    budget_s: float = BUDGET_S,
    region: Region | None = None,
    progress: Progress = ignore_progress,
) -> ExposureSuggestion:
    """Choose one to four exposures with which an open rig measures as many pixels as possible.

    Takes the finest fringes of ``sequence`` in a bracket of exposures, chooses, and tries what was
    chosen. The lowest gain is used that lets the exposures fit. Settings are as before when this
    returns or raises.

    Args:
        current_ms: The exposures in use, to compare with; by default the camera's.
        budget_s: What a capture may last.
        region: x, y, width and height, px, of the part of the image that matters; by default all.

    Raises DeviceError where the camera does not report its exposure, or nothing sees the patterns;
    InputError for a region or time that is impossible; and whatever `progress` raises.
    """
    if not budget_s > 0:
        raise InputError(f"a capture of {budget_s:g} s is impossible", "give a time above 0")
    before = rig.camera.settings()
    bracket = _Bracket(rig, sequence, region, budget_s, progress)
    try:
        return bracket.choose(current_ms or (before.exposure_ms,), before.gain)
    finally:
        rig.camera.apply(before)


@dataclass(eq=False)
class _Bracket:
    """Looks at the fringes of a scene in several exposures, and the choice among them."""

    rig: Rig
    sequence: PatternSequence
    region: Region | None
    budget_s: float
    progress: Progress

    def __post_init__(self) -> None:
        rig, sequence = self.rig, self.sequence
        self._grabs = 0
        self._frames = len(sequence.frames)
        layout = axis_layout(sequence, sequence.axes[0])
        self._indices, self._is_fringe = _select_steps(layout)
        self._sigmas = dark_sigmas(layout)
        width, height = rig.camera.size
        self._frame = np.empty((height, width), rig.camera.dtype)
        self._largest, self._plateau = 0, math.inf
        self._stride = max(1, math.ceil(math.sqrt(width * height / _PIXELS)))
        x, y, across, down = self.region or (0, 0, width, height)
        if not (0 <= x < width and 0 <= y < height and across > 0 and down > 0):
            raise InputError(
                f"the region {x} {y} {across} {down} is outside of the image of {width}x{height}"
                " px",
                "give x, y, width and height in px",
            )
        inside = np.zeros((height, width), bool)
        inside[y : y + down, x : x + across] = True
        self._inside = inside[:: self._stride, :: self._stride]
        self._overhead_ms = math.inf
        self._looks: dict[float, _Look] = {}
        rig.projector.load(sequence)

    def choose(self, current_ms: Sequence[float | None], gain: float | None) -> ExposureSuggestion:
        """Look, choose, try, and correct what saturates after all."""
        if gain is not None and gain > 1:
            gain = self.rig.camera.apply(CameraSettings(gain=1.0)).gain
        low, high, lit = self._examine(current_ms)
        # of the gain, where time does not allow for the exposures that are needed
        for _ in range(_MAX_DOUBLINGS):
            late = np.count_nonzero(low[lit] > self._longest_ms())
            if gain is None or late <= _LATE * np.count_nonzero(lit):
                break
            brighter = self.rig.camera.apply(CameraSettings(gain=2 * gain)).gain
            if brighter is None or brighter <= gain:
                break
            gain, self._looks = brighter, {}
            low, high, lit = self._examine(current_ms)
        if np.count_nonzero(lit) < max(50, _FEW * np.count_nonzero(self._inside)):
            raise DeviceError(
                "no pixel sees the patterns in any exposure",
                "check that the projector lights what the camera sees",
            )
        chosen = self._choose(low[lit], high[lit])
        if not chosen:
            raise DeviceError(
                f"no capture of {self._frames} frames fits into {self.budget_s:g} s",
                "allow more time, or choose patterns with fewer frames",
            )
        for _ in range(_CORRECTIONS):
            chosen = self._applied(chosen)
            clipped = self._looks[chosen[0]].peak >= self._clip
            expected = high < chosen[0]
            if np.count_nonzero(clipped & ~expected & lit) <= _FEW * np.count_nonzero(lit):
                break
            chosen = tuple(_round(_FACTOR * exposure) for exposure in chosen)
        chosen = self._applied(chosen)
        state, state_before = (
            self._classify(each, lit) for each in (chosen, self._applied(current_ms))
        )
        share, share_before = (
            float(np.mean(each[lit] == _MEASURED)) for each in (state, state_before)
        )
        return ExposureSuggestion(
            chosen,
            gain,
            share,
            share_before,
            float(self._duration_ms(np.array(chosen))) / 1e3,
            state,
            state_before,
            self._draw_scene(chosen, lit),
            self._stride,
        )

    def _draw_scene(self, exposures_ms: Exposures, lit: Mask) -> Image:
        """The scene (h, w) as an image, each pixel from the longest of these exposures that does
        not saturate it."""
        best = self._looks[exposures_ms[0]].background
        for exposure in exposures_ms[1:]:
            look = self._looks[exposure]
            scaled = look.background * (exposures_ms[0] / exposure)
            best = np.where(look.peak < self._clip, scaled, best)
        tone = np.sqrt(np.clip(best / max(float(np.quantile(best[lit], 0.99)), 1e-6), 0, 1))
        return (255 * tone).astype(np.uint8)

    @property
    def _full(self) -> float:
        """Grey level at which the camera clips."""
        return min(self._plateau, find_full_scale(self.rig.camera, self._largest))

    @property
    def _clip(self) -> float:
        """Grey level from which a pixel counts as saturated."""
        return 0.99 * self._full

    def _applied(self, exposures: Sequence[float | None]) -> Exposures:
        """The exposures that the camera set when these were requested, ascending."""
        return tuple(sorted(self._look(exposure).exposure_ms for exposure in exposures))

    def _look(self, exposure_ms: float | None) -> _Look:
        """Capture the fringes in the exposure that the camera has nearest to this one, unless that
        was done."""
        with report_driver_faults(self.rig.camera):
            set_ms = self.rig.camera.apply(CameraSettings(exposure_ms)).exposure_ms
        if set_ms is None:
            raise DeviceError(
                f"{self.rig.camera.name} does not report its exposure",
                "set it by hand, at the camera",
            )
        if set_ms in self._looks:
            return self._looks[set_ms]
        self._grabs += 1
        self.progress(min(0.95, self._grabs / (2 * _MAX_LOOKS)), f"fringes at {set_ms:g} ms")
        begun, images = time.monotonic(), []
        for index in (*self._indices, self._indices[-1]):
            with report_driver_faults(self.rig.projector):
                self.rig.projector.show(index)
            settle(self.rig)
            with report_driver_faults(self.rig.camera):
                self.rig.camera.grab(self._frame)
            image = self._frame[:: self._stride, :: self._stride]
            self._largest = max(self._largest, int(image.max()))
            images.append(image.astype(np.float32))
        lasted_ms = 1e3 * (time.monotonic() - begun) / len(images)
        self._overhead_ms = max(0.0, min(self._overhead_ms, lasted_ms - set_ms))
        stack = np.stack(images)
        n = len(self._indices)
        if self._is_fringe:
            _, modulation, background, peak = phase_shift(stack, tuple(range(n)), 1)
            steps = stack[:n].reshape(n, -1).astype(self._frame.dtype)
            self._plateau = find_plateau(steps, self._full) or self._plateau
        else:
            modulation, background = abs(stack[0] - stack[1]) / 2, stack[:2].mean(0)
            peak = stack[:2].max(0)
        self._looks[set_ms] = look = _Look(set_ms, modulation, background, peak, stack[n - 1 :])
        return look

    def _longest_ms(self) -> float:
        """The longest exposure that a capture has time for."""
        return 1e3 * self.budget_s / self._frames - self._overhead_ms

    def _examine(self, current_ms: Sequence[float | None]) -> tuple[Floats, Floats, Mask]:
        """Look at the present exposures, at shorter ones until nothing is saturated, and at longer
        ones until all is or time allows for no more.

        Returns (h, w) each, in ms: the shortest exposure at which a pixel is modulated enough,
        infinite where it sees no patterns, and the longest at which it is not saturated, from the
        longest exposure that did not saturate it; and the pixels of the region that see the
        patterns.
        """
        for exposure in current_ms:
            self._look(exposure)
        for start, factor in ((min, 1 / _STOP), (max, _STOP)):
            look = self._look(start(self._looks))
            for _ in range(_MAX_LOOKS):
                saturated = float(np.mean(look.peak[self._inside] >= self._clip))
                next_ms = factor * look.exposure_ms
                enough = saturated <= _FEW / 2
                if start is max:  # one more than time allows for, to see what is missed
                    longest_ms = min(_STOP * self._longest_ms(), _LONGEST_LOOK_MS)
                    enough = saturated > _ALL or next_ms > longest_ms
                if enough:
                    break
                following = self._look(next_ms)
                if (following.exposure_ms - look.exposure_ms) * (factor - 1) <= 0:
                    break
                look = following
        variance = self._noise()
        low, high = np.full(self._inside.shape, np.inf), np.zeros(self._inside.shape)
        for exposure, look in sorted(self._looks.items()):
            clipped = look.peak >= self._clip
            free = ~clipped | (exposure == min(self._looks))
            longest = exposure * _HEADROOM * self._full / np.maximum(look.peak, 1)
            longest[clipped] = 0.5 * exposure  # how far beyond is not known
            shortest = exposure * self._required_factor(look, variance)
            shortest[clipped] = exposure  # of what is saturated in all, to be counted
            low[free] = np.where(shortest > _BEYOND * exposure, np.inf, shortest)[free]
            high[free] = longest[free]
        return low, high, np.isfinite(low) & self._inside

    def _noise(self) -> tuple[float, float]:
        """Variance of a grey level: at none, and its increase with each."""
        means, squares = [], []
        for look in self._looks.values():
            free = (look.repeat.max(0) < self._clip) & self._inside
            means.append(look.repeat.mean(0)[free])
            squares.append(np.square(look.repeat[1] - look.repeat[0])[free] / 2)
        mean, square = np.concatenate(means), np.concatenate(squares)
        if mean.size < 100:
            return 1.0, 0.0
        groups = np.array_split(np.argsort(mean), 12)
        level = np.array([mean[group].mean() for group in groups])
        spread = np.array(
            [np.mean(np.sort(square[group])[: max(1, int(0.99 * group.size))]) for group in groups]
        )
        slope, offset = 0.0, float(spread.mean())
        if np.ptp(level) > 1:
            slope, offset = np.polyfit(level, spread, 1)
        return max(float(offset), 1 / 12), max(float(slope), 0.0)

    def _duration_ms(self, exposures_ms: Floats) -> Floats:
        """How long captures in these exposures (..., n) last."""
        return self._frames * np.sum(exposures_ms + self._overhead_ms, axis=-1)

    def _choose(self, low: Floats, high: Floats) -> Exposures:
        """The exposures for pixels with limits (n,) ms; none where the time does not even allow for
        one."""
        first, most = max(min(self._looks), float(np.quantile(high, 0.001))), self._longest_ms()
        most = min(max(self._looks) * 2, most)
        if most <= first:
            return ()
        grid = np.unique([_round(each) for each in np.geomspace(first, most, _CANDIDATES)])
        values = _tabulate_values(grid, low, high)
        best: list[tuple[float, Exposures]] = []
        for count in range(1, MAX_SUGGESTED + 1):
            sets = np.array(list(combinations(range(len(grid)), count))).reshape(-1, count)
            times = grid[sets]
            fits = self._duration_ms(times) <= 1e3 * self.budget_s
            sets = sets[fits & (times[:, 1:] >= _APART * times[:, :-1]).all(1)]
            if not len(sets):
                break
            following = np.concatenate([sets[:, 1:], np.full((len(sets), 1), len(grid))], axis=1)
            chosen = grid[sets[values[sets, following].sum(1).argmax()]]
            used = np.searchsorted(chosen, high, side="right") - 1  # the longest of each pixel
            measured = float(np.count_nonzero((used >= 0) & (low <= chosen[used])))
            best.append((measured, tuple(chosen.tolist())))
        largest = max((measured for measured, _ in best), default=0.0)
        good = (each for measured, each in best if measured >= largest - _WORTH * low.size)
        return next(good, ())

    def _classify(self, exposures_ms: Sequence[float], lit: Mask) -> Image:
        """State (h, w) of each pixel if it is used from the longest of these exposures that does
        not saturate it."""
        variance = self._noise()
        state = np.full(lit.shape, _SATURATED, np.uint8)
        for look in (self._looks[exposure] for exposure in exposures_ms):
            is_measured = self._required_factor(look, variance) <= 1
            reached = np.where(is_measured, _MEASURED, _DARK)
            state = np.where(look.peak < self._clip, reached, state).astype(np.uint8)
        state[~lit] = _UNLIT
        return state

    def _required_factor(self, look: _Look, variance: tuple[float, float]) -> Floats:
        """Factor (h, w) of the exposure at which a pixel's modulation exceeds the dark limit, in
        grey levels and in standard deviations of a grey level, whose ``variance`` is an offset and
        a slope."""
        offset, slope = variance
        least, factor = DARK_LEVELS * self._full / 255, self._sigmas**2
        modulation = np.maximum(look.modulation.astype(np.float64), 1e-3)
        square, linear = modulation**2, factor * slope * np.maximum(look.background, 0)
        by_noise = (linear + np.sqrt(linear**2 + 4 * square * factor * offset)) / (2 * square)
        return np.maximum(by_noise, least / modulation)


def _select_steps(layout: Layout) -> tuple[tuple[int, ...], bool]:
    """Frames by which fringes are examined: three or four equal steps of the finest period, all
    where no such share of them exists, and True; of Gray code alone the finest bit, or white, and
    what is complementary to it, and False.
    """
    if layout.shifts:
        indices = layout.shifts[-1].indices
        count = next((count for count in (4, 3) if len(indices) % count == 0), len(indices))
        return indices[:: len(indices) // count], True
    if layout.inverse:
        return (layout.gray[-1], layout.inverse[-1]), False
    # or its layout would have been refused
    assert layout.white is not None and layout.black is not None
    return (layout.white, layout.black), False


def _tabulate_values(grid: Floats, low: Floats, high: Floats) -> Floats:
    """Value (n, n + 1) of the pixels that exposure i of the grid measures where exposure j, the
    next one, saturates them; j = n: none follows. A pixel's value is 1, less where it is weakly
    modulated."""
    n = len(grid)
    saturated_by = np.searchsorted(grid, high, side="right")
    values = np.zeros((n, n + 1))
    for i, exposure in enumerate(grid):
        measured = (low <= exposure) & (high >= exposure)
        value = 1 - _WEAK_COST * np.square(low[measured] / exposure)
        values[i] = np.cumsum(np.bincount(saturated_by[measured], value, n + 1))
    return values


def _round(exposure_ms: float) -> float:
    """Milliseconds rounded to three significant digits."""
    return float(f"{exposure_ms:.3g}")
