"""What OpenCV's ways to a webcam call its exposure, gain, focus and white balance, and in which
units.

A camera may refuse a value, round it or ignore it: what counts is the value that it reports
afterwards.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import cv2

UNKNOWN = -1.0
"""What OpenCV says for a control that it does not know (`getProperty` of every backend)."""


@dataclass(frozen=True)
class Dialect:
    """The control conventions of one backend. `automatics`: each automatic control, and the value
    that switches it off; empty where a value that is set switches its own automatic off.
    """

    to_ms: Callable[[float], float]
    from_ms: Callable[[float], float]
    white_balance: int
    automatics: tuple[tuple[str, int, float], ...] = ()


# V4L2_CID_EXPOSURE_ABSOLUTE counts in 100 us; V4L2_EXPOSURE_MANUAL is 1 (docs.kernel.org, "Camera
# Control Reference"). OpenCV 4 and later hands both on as they are
# (modules/videoio/src/cap_v4l.cpp; the 0.25 and 0.75 of older advice are those of its normalised
# ranges, which `CAP_PROP_MODE` 0 switches off).
_V4L2 = Dialect(
    to_ms=lambda value: value / 10,
    from_ms=lambda ms: max(1.0, round(ms * 10)),
    white_balance=cv2.CAP_PROP_WB_TEMPERATURE,
    automatics=(
        ("exposure", cv2.CAP_PROP_AUTO_EXPOSURE, 1.0),
        ("white balance", cv2.CAP_PROP_AUTO_WB, 0.0),
        ("focus", cv2.CAP_PROP_AUTOFOCUS, 0.0),
    ),
)


# Windows counts in powers of two of a second (learn.microsoft.com, "ICameraControl::put_Exposure");
# OpenCV cuts the fraction off, and sets each value with the flag that says "manual" (cap_dshow.cpp,
# cap_msmf.cpp: setProperty).
def _make_windows_dialect(white_balance: int) -> Dialect:
    """Return the conventions of Windows' backends: exposures are powers of two in s, set by their
    exponent."""
    return Dialect(
        lambda value: 1000 * 2.0**value,
        lambda ms: float(round(math.log2(ms / 1000))),
        white_balance,
    )


_DIALECTS = {
    "V4L2": _V4L2,
    "DSHOW": _make_windows_dialect(cv2.CAP_PROP_WHITE_BALANCE_BLUE_U),
    "MSMF": _make_windows_dialect(cv2.CAP_PROP_TEMPERATURE),
}


def dialect_of(capture: cv2.VideoCapture) -> Dialect | None:
    """Return the control conventions of the open `capture`'s backend; None where controls are not
    accessible: those of a stream, and on macOS those of any camera (cap_avfoundation_mac.mm sets a
    size and a frame rate only).
    """
    dialect = _DIALECTS.get(capture.getBackendName())
    if dialect is _V4L2:
        capture.set(cv2.CAP_PROP_MODE, 0)
    return dialect


def disable_automatics(capture: cv2.VideoCapture, words: Dialect) -> dict[str, str]:
    """Fix exposure, white balance and focus at their current values; returns {control: warning} for
    those that stay automatic.

    A pattern sequence means nothing when its frames are exposed differently.
    """
    if words.automatics:
        remedy = "look for a switch at the camera itself"
        automatic = [
            what
            for what, control, off in words.automatics
            if capture.get(control) != UNKNOWN
            and not (capture.set(control, off) and capture.get(control) == off)
        ]
    else:
        remedy = "do it in the system's camera settings"
        controls = {
            "exposure": cv2.CAP_PROP_EXPOSURE,
            "white balance": words.white_balance,
            "focus": cv2.CAP_PROP_FOCUS,
        }
        current = {what: capture.get(control) for what, control in controls.items()}
        automatic = [
            what
            for what, now in current.items()
            if now != UNKNOWN and not capture.set(controls[what], now)
        ]
    return {
        f"automatic {what}": f"its automatic {what} cannot be switched off: {remedy}"
        for what in automatic
    }


def exposure_ms(capture: cv2.VideoCapture, words: Dialect) -> float | None:
    """Read the current exposure, ms; None where the camera does not report it."""
    value = capture.get(cv2.CAP_PROP_EXPOSURE)
    ms = 0.0 if value == UNKNOWN else words.to_ms(value)
    return ms if 0 < ms < 1e5 else None


def set_exposure(capture: cv2.VideoCapture, words: Dialect, ms: float) -> str:
    """Set the exposure to the nearest supported value; returns a warning if that differs or failed,
    else ""."""
    value = words.from_ms(ms)
    capture.set(cv2.CAP_PROP_EXPOSURE, value)
    applied = exposure_ms(capture, words)
    if applied is None:
        return "its exposure cannot be set: set it at the camera itself"
    if abs(applied - ms) > 0.01 * ms:
        return f"its exposure is {applied:g} ms, {ms:g} ms were requested"
    return ""


def set_value(capture: cv2.VideoCapture, control: int, value: float, what: str) -> str:
    """Set a control, in the camera's units; returns a warning if the value differs or was not set,
    else ""."""
    capture.set(control, value)
    applied = capture.get(control)
    if applied == UNKNOWN != value:
        return f"its {what} cannot be set: set it at the camera itself"
    return (
        "" if abs(applied - value) < 0.5 else f"its {what} is {applied:g}, {value:g} was requested"
    )
