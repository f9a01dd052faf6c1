"""Images taken one after the other under light that does not change: what varies in them is the light, or moves."""

from dataclasses import dataclass

import numpy as np

from slviewer.preflight.rig_under_test import RigUnderTest

_WHITE, _DARK = 24, 12


@dataclass(frozen=True, eq=False)
class Burst:
    """``white`` (n, h, w) and ``dark``; ``white_s`` and ``dark_s`` (n,): when each was begun."""

    white: np.ndarray
    dark: np.ndarray
    white_s: np.ndarray
    dark_s: np.ndarray


def take(bench: RigUnderTest) -> Burst:
    """Images in white light, then in the dark."""
    white_s, white = _images(bench, 255, _WHITE)
    dark_s, dark = _images(bench, None, _DARK)
    return Burst(white, dark, white_s, dark_s)


def _images(bench: RigUnderTest, grey: int | None, count: int) -> tuple[np.ndarray, np.ndarray]:
    bench.show(grey, "steadiness of the light")
    bench.wait()
    begun, images = zip(*(bench.timed() for _ in range(count)), strict=True)
    return np.array(begun), np.stack(images)
