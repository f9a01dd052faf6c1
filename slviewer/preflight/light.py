"""Light that is not the projector's, and light that does not stand still."""

import numpy as np

from slviewer.pipeline.check_results import Check
from slviewer.preflight.burst import Burst
from slviewer.preflight.rig_under_test import RigUnderTest

_BRIGHT, _TOO_BRIGHT = 0.35, 0.8  # room over projector
_STEP = 0.02  # of the projector's light
_UNSTEADY, _FLICKERS = 0.006, 0.02  # rms, as a share of the projector's light
_EXPLAINS = 0.6  # of the variance, by one mains frequency and not by the other
_DRIFTS = 0.8


def ambient(bench: RigUnderTest, last_dark: np.ndarray) -> Check:
    """Light in the dark frames, and whether it was the same at the end."""
    where = bench.illuminated
    room = float(np.median(bench.dark[where])) / max(bench.contrast, 1e-6)
    step = float(np.median((last_dark - bench.dark)[where])) / max(bench.contrast, 1e-6)
    figures = {"room_over_projector": round(room, 3), "change_over_projector": round(step, 4)}
    if abs(step) > max(_STEP, 3 * bench.unsteady):
        more = "brighter" if step > 0 else "darker"
        return Check(
            "ambient",
            "warning",
            f"The room became {more} by {100 * abs(step):.0f} % of the projector's light while this was checked.",
            "Keep lamps, doors and daylight as they are while capturing.",
            figures,
        )
    if room > _BRIGHT:
        return Check(
            "ambient",
            "bad" if room > _TOO_BRIGHT else "warning",
            f"The room is {100 * room:.0f} % as bright as the projector's light.",
            "Darken the room, or move closer so that the projector is brighter.",
            figures,
        )
    return Check("ambient", "good", f"The room adds {100 * room:.0f} % to the projector's light.", "", figures)


def flicker(bench: RigUnderTest, burst: Burst) -> Check:
    """Brightness of whole images from one to the next, beyond what noise makes of it."""
    where, span = bench.usable(), max(bench.contrast, 1e-6)
    if not where.any():
        return Check("flicker", "unknown", "Flicker cannot be measured: all that is illuminated is saturated.", "", {})
    white, dark = (
        np.array([float(i[where].mean(dtype=float)) for i in images]) for images in (burst.white, burst.dark)
    )
    noise = bench.noise / np.sqrt(np.count_nonzero(where)) / span
    (white_rest, drift), (dark_rest, _) = (
        _detrended(v / span, t) for v, t in ((white, burst.white_s), (dark, burst.dark_s))
    )
    swing = float(np.sqrt(max(0.0, float(np.var(white_rest)) - noise**2)))
    room = float(np.sqrt(max(0.0, float(np.var(dark_rest)) - noise**2)))
    present = bench.rig.camera.settings().exposure_ms
    hertz = _mains(white_rest, burst.white_s)
    figures = {
        "rms_in_white": round(swing, 5),
        "rms_in_dark": round(room, 5),
        "drift": round(drift, 5),
        "mains_hz": hertz,
        "exposure_ms": present,
        "exposures_ms": _multiples(present, hertz),
    }
    worst = max(swing, room)
    if worst <= _UNSTEADY:
        if abs(drift) > 2 * _UNSTEADY:
            said = f"The light drifts by {100 * abs(drift):.1f} % within a second."
            return Check("flicker", "warning", said, "Let the projector's lamp warm up for some minutes.", figures)
        return Check("flicker", "good", f"The light is steady to {100 * worst:.2f} %.", "", figures)
    source = "room's" if room > 0.5 * swing else "projector's"
    named = {100: " (100 Hz)", 120: " (120 Hz)", None: ""}[hertz]
    return Check(
        "flicker",
        "bad" if worst > _FLICKERS else "warning",
        f"The {source} light flickers by {100 * worst:.1f} % from image to image{named}.",
        _remedy(present, hertz) + ("" if source == "projector's" else ", or switch the room's lamps off") + ".",
        figures,
    )


def _remedy(present: float | None, hertz: int | None) -> str:
    choices = _multiples(present, hertz)
    listed = " or ".join(f"{value:g} ms (a multiple of 1/{name} s)" for name, value in choices.items())
    return f"Set the exposure to {listed}, and less gain or aperture if that is too bright"


def _multiples(present: float | None, hertz: int | None) -> dict[str, float]:
    """By frequency in Hz, the multiple of its period in ms that is nearest to the present exposure."""
    return {
        str(name): round(max(1, round((present or 0.0) * name / 1000)) * 1000 / name, 2)
        for name in (100, 120)
        if hertz in (None, name)
    }


def _detrended(values: np.ndarray, seconds: np.ndarray) -> tuple[np.ndarray, float]:
    """The values less a straight line, if that is what they mostly follow, and its rise per second."""
    line = np.polyfit(seconds - seconds[0], values, 1)
    rest = values - np.polyval(line, seconds - seconds[0])
    if np.var(rest) < (1 - _DRIFTS) * np.var(values):
        return rest, float(line[0])
    return values - values.mean(), 0.0


def _mains(values: np.ndarray, seconds: np.ndarray) -> int | None:
    """100 or 120, where one of these frequencies explains the values and the other does not; else None."""
    explained = {}
    for hertz in (100, 120):
        angle = 2 * np.pi * hertz * (seconds - seconds[0])
        design = np.stack([np.cos(angle), np.sin(angle), np.ones_like(angle)], axis=1)
        rest = values - design @ np.linalg.lstsq(design, values, rcond=None)[0]
        explained[hertz] = 1 - float(np.var(rest)) / max(float(np.var(values)), 1e-15)
    best, other = sorted(explained, key=lambda h: -explained[h])
    return best if explained[best] > _EXPLAINS and explained[other] < explained[best] - 0.3 else None
