"""The white balance of a colour camera, from the white of the board or a grey card."""

import cv2
import numpy as np

from slviewer.errors import InputError
from slviewer.fringe.layout import to_eight_bits
from slviewer.pipeline.poses import load_observations
from slviewer.session.capture import Capture
from slviewer.session.store import Session

BOARD = "board"
WHITE_SHARE = 0.25
"""Of a reference's pixels, the brightest: a board has dark marks too."""
SATURATED, DARKEST = 250, 10
"""Grey levels between which a reference tells its colour."""
MAX_GAIN = 8.0


def measure_white(store: Session, reference: str) -> np.ndarray:
    """Return the gains (3,) of red, green and blue, at most 1, that make a reference neutral.

    ``reference``: a capture of a grey card or white sheet that fills most of the view, a target
    pose, or ``board``: all target poses. Raises InputError for pictures without colours, and for
    white that is overexposed or too dark.
    """
    if reference != BOARD:
        return _measure_gains(store, store.load_capture(reference))
    captures = [capture for capture in store.captures("calibration") if capture.texture is not None]
    if not captures:
        raise InputError(
            "the target poses have no colours, so that the board's white is unknown: capture them"
            " with a colour camera and a white image, or name a capture of a grey card"
        )
    gains, refusals = list[np.ndarray](), list[str]()
    for capture in captures:
        try:
            gains.append(_measure_gains(store, capture))
        except InputError as error:
            refusals.append(str(error))
    if not gains:
        raise InputError(refusals[0])
    middle = np.median(gains, axis=0)
    return np.asarray(middle / middle.max())


def balance(texture: np.ndarray, gains: np.ndarray) -> np.ndarray:
    """Return a texture (h, w, 3) uint8 with the gains (3,) applied; overexposed pixels become
    neutral."""
    return np.rint(np.minimum(texture * gains, 255 * gains.min())).astype(np.uint8)


def _measure_gains(store: Session, capture: Capture) -> np.ndarray:
    """Return the gains of one reference."""
    texture = capture.texture
    if texture is None:
        raise InputError(
            f"{capture.name} has no colours: name a capture of a colour camera with a white image"
        )
    texture = to_eight_bits(texture, capture.sequence.full_scale)
    if observed := load_observations(store, [capture.name]):  # a target pose: its board
        hull = cv2.convexHull(np.rint(observed[0].camera).astype(np.int32))
        mask = cv2.fillConvexPoly(np.zeros(texture.shape[:2], np.uint8), hull, 1) == 1
    else:  # what is lit
        levels = texture.max(axis=2)
        mask = levels >= 0.5 * np.quantile(levels, 0.99)
    pixels = texture[mask].astype(np.float64)
    brightness = pixels.max(axis=1)
    white = pixels[brightness >= np.quantile(brightness, 1 - WHITE_SHARE)]
    usable = white[white.max(axis=1) < SATURATED]
    if len(usable) < len(white) / 2:
        share = 100 * (1 - len(usable) / len(white))
        raise InputError(
            f"{share:.0f} % of the white in {capture.name} is overexposed: lower the exposure"
        )
    colour = np.median(usable, axis=0)
    if colour.min() < DARKEST or colour.max() > MAX_GAIN * colour.min():
        levels = ", ".join(f"{level:.0f}" for level in colour)
        raise InputError(
            f"the white in {capture.name} has {levels} grey levels of red, green and blue: expose"
            f" it so that each has {DARKEST} or more, none {MAX_GAIN:g} times another"
        )
    return np.asarray(colour.min() / colour)
