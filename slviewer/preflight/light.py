"""Projector light and ambient light: exposure, response to grey levels, ambient light, flicker."""

from dataclasses import dataclass

import numpy as np

from slviewer.fringe.response import (
    fit_gamma,
    linearise_levels,
    measure_nonlinearity,
    predict_phase_error,
)
from slviewer.pipeline.examination import CLIPPED, MUCH_CLIPPED, TOO_WEAK, WEAK, Check, CheckVerdict
from slviewer.preflight.rig_under_test import RigUnderTest

_BURST = 24
"""Images in white light, and in the dark."""


@dataclass(frozen=True, eq=False)
class Burst:
    """Images ``white`` (n, h, w) and ``dark`` (m, h, w); ``white_s`` (n,), ``dark_s`` (m,): when
    each began, s."""

    white: np.ndarray
    dark: np.ndarray
    white_s: np.ndarray
    dark_s: np.ndarray


def capture_burst(bench: RigUnderTest) -> Burst:
    """Capture several images in white light, then several in the dark, with the time at which each
    began.

    The bench's ``unsteady`` rises to what they show: it was measured from fewer images.
    """
    white_s, white = _grab_images(bench, 255)
    dark_s, dark = _grab_images(bench, None)
    bench.unsteady = max(
        bench.unsteady, bench.measure_unsteadiness(white), bench.measure_unsteadiness(dark)
    )
    return Burst(white, dark, white_s, dark_s)


def _grab_images(bench: RigUnderTest, grey: int | None) -> tuple[np.ndarray, np.ndarray]:
    """Start times (n,) s and images (n, h, w) under even light."""
    bench.show(grey, "steadiness of the light")
    bench.wait()
    return bench.grab_spread(_BURST)


_TARGET_LEVEL = 0.85  # of full scale, for the 99.5th percentile of what is illuminated
_SATURATED_FACTOR = 0.5  # of the exposure: by how much it is too long is unknown, so measure again


def check_exposure(bench: RigUnderTest) -> tuple[Check, float | None]:
    """Check how bright white light is in what the projector illuminates.

    Returns the check, and the exposure in ms to set, None where it is right or unknown.
    """
    level = bench.white[bench.illuminated]
    black = float(np.median(bench.dark[bench.illuminated]))
    bright, clipped = float(np.quantile(level, 0.995)), float(np.mean(level >= bench.clip))
    factor, share = _SATURATED_FACTOR, bright / bench.full
    if bright < bench.clip:
        factor = (_TARGET_LEVEL * bench.full - black) / max(bright - black, 1.0)
    present, wanted = bench.read_exposure_ms(), None
    change = f"Multiply the exposure by {factor:.2g}"
    if present is not None:
        wanted = float(f"{present * factor:.3g}")
        change = f"Change the exposure from {present:g} ms to {wanted:g} ms"
    figures = {
        "bright_share_of_full_scale": round(share, 3),
        "clipped_share": round(clipped, 4),
        "median_contrast_levels": round(bench.contrast, 1),
        "exposure_ms": present,
        "suggested_exposure_ms": wanted,
        "suggested_factor": round(factor, 2),
    }
    if clipped > CLIPPED:
        verdict: CheckVerdict = "bad" if clipped > MUCH_CLIPPED else "warning"
        text = f"{100 * clipped:.1f} % of what the projector lights is saturated in white light."
        return Check("exposure", verdict, text, f"{change}, then check again.", figures), wanted
    if share < WEAK:
        verdict = "bad" if share < TOO_WEAK else "warning"
        text = f"White light reaches only {100 * share:.0f} % of the camera's range."
        return Check("exposure", verdict, text, f"{change}, or open the aperture.", figures), wanted
    text = (
        f"White light reaches {100 * share:.0f} % of the camera's range; {100 * clipped:.1f} % is"
        " saturated."
    )
    return Check("exposure", "good", text, "", figures), None


_LEVELS = np.arange(18) * 15
MAX_NONLINEARITY = 0.03
"""Deviation from a straight line, as a share of white, from which the response is named."""
_MIN_PIXELS = 500  # pixels
_MAX_FLICKER = 0.02


def check_gamma(bench: RigUnderTest) -> tuple[Check, tuple[int, ...] | None, float]:
    """Measure gamma: the check, a table for `PatternSequence.levels`, and the light of level 127.5
    over white."""
    where = bench.usable()
    if where.sum() < _MIN_PIXELS:
        return _fail_gamma("too few pixels are illuminated and not saturated", "the exposure")
    if bench.unsteady > _MAX_FLICKER:
        return _fail_gamma(f"the light flickers by {100 * bench.unsteady:.0f} %", "the flicker")
    images = [bench.grab_mean(int(level), "response to grey levels") for level in _LEVELS]
    light = np.array([image[where].sum(dtype=float) for image in images])
    if light[-1] <= light[0]:
        return _fail_gamma("white is no brighter than black", "what the other checks name")
    response = (light - light[0]) / (light[-1] - light[0])
    exponent, curved = fit_gamma(_LEVELS, response), measure_nonlinearity(_LEVELS, response)
    errors = {n: predict_phase_error(_LEVELS, response, n) for n in (3, 4, 6, 8)}
    figures = {
        "gamma": round(exponent, 3),
        "nonlinearity_percent": round(100 * curved, 2),
        "phase_error_rad": {str(n): round(error, 5) for n, error in errors.items()},
        "shown": _LEVELS.tolist(),
        "seen": [round(float(s), 5) for s in response],
    }
    levels = linearise_levels(_LEVELS, response)
    middle = float(np.interp(127.5, _LEVELS, response))
    if curved <= MAX_NONLINEARITY:
        text = f"Light is proportional to grey levels within {100 * curved:.1f} %."
        return Check("gamma", "good", text, "", figures), levels, middle
    text = (
        f"Light follows grey levels with a gamma of {exponent:.2f}, {100 * curved:.0f} % off a"
        f" straight line: an error of {errors[3]:.3f} rad with 3 steps and {errors[4]:.3f} rad with"
        " 4, before blur smooths it."
    )
    remedy = "Use the table that straightens it (measured just now), or 8 steps and more."
    return Check("gamma", "warning", text, remedy, figures), levels, middle


def _fail_gamma(why: str, fault: str) -> tuple[Check, None, float]:
    """The result of `check_gamma` where nothing can be measured, and the ``fault`` to correct
    before."""
    text = f"The response cannot be measured: {why}."
    return Check("gamma", "unknown", text, f"Correct {fault} first."), None, 0.5


_BRIGHT, _TOO_BRIGHT = 0.35, 0.8  # room over projector
_STEP = 0.02  # of the projector's light
_UNSTEADY, _FLICKERS = 0.006, 0.02  # rms, as a share of the projector's light
_EXPLAINS = 0.6  # of the variance, by one mains frequency and not by the other
_DRIFTS = 0.8


def check_ambient(bench: RigUnderTest, last_dark: np.ndarray) -> Check:
    """Check ambient light: its level in the dark frames, and whether it changed until the end."""
    where = bench.illuminated
    ambient = float(np.median(bench.dark[where])) / max(bench.contrast, 1e-6)
    step = float(np.median((last_dark - bench.dark)[where])) / max(bench.contrast, 1e-6)
    figures = {"room_over_projector": round(ambient, 3), "change_over_projector": round(step, 4)}
    if abs(step) > max(_STEP, 3 * bench.unsteady):
        more = "brighter" if step > 0 else "darker"
        return Check(
            "ambient",
            "warning",
            f"The room became {more} by {100 * abs(step):.0f} % of the projector's light while this"
            " was checked.",
            "Keep lamps, doors and daylight as they are while capturing.",
            figures,
        )
    if ambient > _BRIGHT:
        return Check(
            "ambient",
            "bad" if ambient > _TOO_BRIGHT else "warning",
            f"The room is {100 * ambient:.0f} % as bright as the projector's light.",
            "Darken the room, or move closer so that the projector is brighter.",
            figures,
        )
    return Check(
        "ambient",
        "good",
        f"The room adds {100 * ambient:.0f} % to the projector's light.",
        "",
        figures,
    )


def check_flicker(bench: RigUnderTest, burst: Burst) -> Check:
    """Check brightness changes from image to image beyond the noise."""
    where, span = bench.usable(), max(bench.contrast, 1e-6)
    if not where.any():
        text = "Flicker cannot be measured: all that is illuminated is saturated."
        return Check("flicker", "unknown", text)
    noise = bench.noise / np.sqrt(where.sum()) / span
    (white_rest, drift), (dark_rest, _) = (
        _remove_drift(images[:, where].mean(axis=1, dtype=float) / span, seconds)
        for images, seconds in ((burst.white, burst.white_s), (burst.dark, burst.dark_s))
    )
    swing, ambient = (
        float(np.sqrt(max(0.0, np.var(rest) - noise**2))) for rest in (white_rest, dark_rest)
    )
    present = bench.read_exposure_ms()
    hertz = _identify_mains(white_rest, burst.white_s)
    # the multiples of the mains period that are nearest to the present exposure, ms
    exposures_ms = {
        str(name): round(max(1, round((present or 0.0) * name / 1000)) * 1000 / name, 2)
        for name in (100, 120)
        if hertz in (None, name)
    }
    figures = {
        "rms_in_white": round(swing, 5),
        "rms_in_dark": round(ambient, 5),
        "drift": round(drift, 5),
        "mains_hz": hertz,
        "exposure_ms": present,
        "exposures_ms": exposures_ms,
    }
    worst = max(swing, ambient)
    if worst <= _UNSTEADY:
        if abs(drift) > 2 * _UNSTEADY:
            text = f"The light drifts by {100 * abs(drift):.1f} % within a second."
            return Check(
                "flicker",
                "warning",
                text,
                "Let the projector's lamp warm up for some minutes.",
                figures,
            )
        return Check("flicker", "good", f"The light is steady to {100 * worst:.2f} %.", "", figures)
    source = "room's" if ambient > 0.5 * swing else "projector's"
    named = f" ({hertz} Hz)" if hertz else ""
    lamps = ", or switch the room's lamps off" if source == "room's" else ""
    listed = " or ".join(
        f"{value:g} ms (a multiple of 1/{name} s)" for name, value in exposures_ms.items()
    )
    return Check(
        "flicker",
        "bad" if worst > _FLICKERS else "warning",
        f"The {source} light flickers by {100 * worst:.1f} % from image to image{named}.",
        f"Set the exposure to {listed}, and less gain or aperture if that is too bright{lamps}.",
        figures,
    )


def _remove_drift(values: np.ndarray, seconds: np.ndarray) -> tuple[np.ndarray, float]:
    """The values without their linear trend, if it dominates, and the slope per second."""
    line = np.polyfit(seconds - seconds[0], values, 1)
    rest = values - np.polyval(line, seconds - seconds[0])
    if np.var(rest) < (1 - _DRIFTS) * np.var(values):
        return rest, float(line[0])
    return values - values.mean(), 0.0


def _identify_mains(values: np.ndarray, seconds: np.ndarray) -> int | None:
    """100 or 120, where only one of these frequencies, Hz, explains the values; else None."""
    explained = {}
    for hertz in (100, 120):
        angle = 2 * np.pi * hertz * (seconds - seconds[0])
        design = np.stack([np.cos(angle), np.sin(angle), np.ones_like(angle)], axis=1)
        rest = values - design @ np.linalg.lstsq(design, values, rcond=None)[0]
        explained[hertz] = 1 - np.var(rest) / max(np.var(values), 1e-15)
    best, other = sorted(explained, key=lambda h: -explained[h])
    return (
        best if explained[best] > _EXPLAINS and explained[other] < explained[best] - 0.3 else None
    )
