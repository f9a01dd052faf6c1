"""Faults of light, signal and frame order, as pure functions of a capture's (n, h, w) arrays."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import get_args

import cv2
import numpy as np

from slviewer.fringe.sequence import Kind, PatternSequence

Frames = np.ndarray
"""(n, h, w): light or a signal, float32 grey levels, or recorded images, uint8."""


@dataclass(frozen=True, eq=False)
class Shot:
    """The capture that a fault acts on: its sequence, and a generator of its own. ``room_light``:
    (h, w) float32, even light as strong as the projector's white, in grey levels.
    """

    sequence: PatternSequence
    rng: np.random.Generator
    room_light: np.ndarray

    def indices(self, kind: str, axis: str) -> list[int]:
        """Indices of the sequence's frames of a kind and an axis."""
        return [i for i, f in enumerate(self.sequence.frames) if (f.kind, f.axis) == (kind, axis)]


# Light before the sensor


def scale_frames(light: Frames, gains: np.ndarray) -> Frames:
    """Each of the frames (n, h, w) times its gain (n,)."""
    return light * np.asarray(gains, np.float32)[:, None, None]


def vary_exposure(light: Frames, rms: float, shot: Shot) -> Frames:
    """Automatic exposure: each frame has a gain of its own, of exactly this relative rms."""
    gains = shot.rng.standard_normal(len(light))
    clipped = np.clip((gains - gains.mean()) / gains.std(), -2.5, 2.5)
    return scale_frames(light, 1 + rms * clipped / clipped.std())


def follow_exposure(light: Frames, off: float, shot: Shot) -> Frames:
    """Simulate an exposure control that starts too bright by ``off`` and follows the mean level of
    the last frame.

    Its target is the mean level of all frames; each frame it takes 15 % of the way that is left.
    """
    means = light.mean((1, 2))
    target, gain = float(means.mean()), 1 + off
    gains = []
    for mean in means:
        gains.append(gain)
        gain *= (target / (gain * max(float(mean), 1e-3))) ** 0.15
    return scale_frames(light, np.array(gains))


def add_flicker(light: Frames, depth: float, shot: Shot) -> Frames:
    """Add mains flicker under a rolling shutter: bands 1 + depth sin, at another phase in each
    frame."""
    n = len(light)
    begin = 0.37 * np.arange(n)[:, None] + shot.rng.uniform(0, 1, (n, 1)) * 0.1
    return light * (1 + depth * np.sin(row_phase(light, 1.6, begin))).astype(np.float32)


def add_room_flicker(light: Frames, depth: float, shot: Shot) -> Frames:
    """Add ambient light, a fifth as strong as the projector's, that flickers by ``depth`` of its
    light."""
    phase = row_phase(light, 1.6, 0.29 * np.arange(len(light))[:, None])
    bands = 0.2 * (1 + depth * np.sin(phase))
    return 0.8 * light + bands.astype(np.float32) * shot.room_light


def switch_lamp_on(light: Frames, share: float, shot: Shot) -> Frames:
    """Switch a lamp on half way through the phase steps of x: even light, ``share`` of the
    projector's."""
    steps = shot.indices("phase", "x")
    illuminated = light.copy()
    illuminated[steps[len(steps) // 2] :] += np.float32(share) * shot.room_light
    return illuminated


def add_colour_wheel(light: Frames, depth: float, shot: Shot) -> Frames:
    """Simulate a short exposure that sees part of the colour wheel's turn: fast bands of the
    projector's light."""
    dark = light.min(0, keepdims=True)
    phase = row_phase(light, 5.0, shot.rng.uniform(0, 1, (len(light), 1)))
    bands = 1 + depth * (np.sin(phase) + 0.5 * np.sin(2 * phase))
    return dark + (light - dark) * bands.astype(np.float32)


def row_phase(light: Frames, turns: float, begin: np.ndarray) -> np.ndarray:
    """Phase (n, h, 1), rad, of so many turns along the rows that begin at ``begin`` (n, 1)."""
    height = light.shape[1]
    return (2 * np.pi * (turns * np.arange(height) / height + begin))[..., None]


def add_crosstalk(light: Frames, share: float, shot: Shot | None = None) -> Frames:
    """Mix a share of the previous image into each, as a display with a slow response does."""
    before = np.concatenate([light[:1], light[:-1]])
    return np.float32(1 - share) * light + np.float32(share) * before


def add_vignetting(light: Frames, loss: float, shot: Shot) -> Frames:
    """Light that falls off to the image's corners by ``loss``."""
    y, x = (np.linspace(-1, 1, size) for size in light.shape[1:])
    return light * (1 - loss * (x[None] ** 2 + y[:, None] ** 2) / 2).astype(np.float32)


def add_lens_dust(light: Frames, loss: float, shot: Shot) -> Frames:
    """Blurred spots and scratches on the camera's lens, the same in every frame and every
    capture."""
    _, height, width = light.shape
    rng = np.random.default_rng(0xD7)
    spots = np.zeros((height, width), np.float32)
    for _ in range(25):
        centre = (int(rng.integers(width)), int(rng.integers(height)))
        cv2.circle(
            spots, centre, int(rng.integers(2, 9)) * width // 400, float(rng.uniform(0.3, 1)), -1
        )
    for _ in range(6):
        (a, b), (c, d) = rng.integers(0, [width, height], (2, 2)).tolist()
        cv2.line(spots, (a, b), (c, d), 0.6, max(1, width // 400))
    blurred = cv2.GaussianBlur(spots, (0, 0), 3.0 * width / 400)
    return np.asarray(light * (1 - np.float32(loss) * blurred), np.float32)


def add_defocus_gradient(light: Frames, sigma_px: float, shot: Shot) -> Frames:
    """Blur as a tilted lens does: sharp at the left edge, up to ``sigma_px`` (of 400 px of width)
    at the right."""
    width = light.shape[2]
    widest = sigma_px * width / 400
    steps = 5
    share = (steps - 1) * np.arange(width) / (width - 1)
    out = np.zeros_like(light)
    for k in range(steps):
        weight = np.clip(1 - np.abs(share - k), 0, 1).astype(np.float32)
        for i, frame in enumerate(light):
            out[i] += weight * (
                cv2.GaussianBlur(frame, (0, 0), widest * k / (steps - 1)) if k else frame
            )
    return out


# The sensor's signal, and what is recorded of it


def encode_srgb(signal: Frames, share: float, shot: Shot) -> Frames:
    """Encode grey levels by this ``share`` of the sRGB curve, 0 for linear light."""
    x = np.clip(signal / 255, 0, 1)
    curve = np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 1e-9) ** (1 / 2.4) - 0.055)
    return np.asarray(255 * ((1 - share) * x + share * curve), np.float32)


def shift_white_balance(signal: Frames, rms: float, shot: Shot) -> Frames:
    """Apply a digital gain that varies from frame to frame as a random walk of relative ``rms``."""
    walk = np.cumsum(shot.rng.standard_normal(len(signal)))
    walk -= walk.mean()
    return scale_frames(signal, 1 + rms * walk / walk.std())


def compress_jpeg(frames: Frames, quality: float, shot: Shot | None = None) -> Frames:
    """Compress each frame (n, h, w) uint8 as JPEG, and decode it."""
    out = np.empty_like(frames)
    for k, frame in enumerate(frames):
        data = cv2.imencode(".jpg", frame, [cv2.IMWRITE_JPEG_QUALITY, int(quality)])[1]
        out[k] = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE)
    return out


def add_hot_pixels(frames: Frames, share: float, shot: Shot) -> Frames:
    """Set this share of the pixels hot or dead, the same ones in every capture."""
    kind = np.random.default_rng(0x407).random(frames.shape[1:])
    return np.where(
        kind < share / 2, np.uint8(255), np.where(kind > 1 - share / 2, np.uint8(0), frames)
    )


# Frames in another order than described


def delay_frames(frames: Frames, by: float = 1, shot: Shot | None = None) -> Frames:
    """The frames (n, h, w) delayed: each shows the pattern projected ``by`` frames before."""
    return np.roll(frames, int(by), axis=0)


def drop_frame(frames: Frames, index: int) -> Frames:
    """The frames (n, h, w) with one dropped: later ones move forward by one, and the last is
    repeated."""
    return np.concatenate([np.delete(frames, index, axis=0), frames[-1:]])


def show_instead(frames: Frames, places: Sequence[int], sources: Sequence[int]) -> Frames:
    """The frames (n, h, w) with those at the indices ``places`` replaced by those at
    ``sources``."""
    out = frames.copy()
    out[list(places)] = frames[list(sources)]
    return out


def lose_frames(frames: Frames, level: float, shot: Shot) -> Frames:
    """Drop a Gray frame of y (level 0), a phase step of x (1), or both (2); later frames move
    forward."""
    if level != 0:
        frames = drop_frame(frames, shot.indices("phase", "x")[3])
    return frames if level == 1 else drop_frame(frames, shot.indices("gray", "y")[2])


def repeat_frames(frames: Frames, level: float, shot: Shot) -> Frames:
    """Repeat the previous frame in place of a Gray frame of x (level 0), a phase step (1), or three
    of them (2)."""
    phase, gray = shot.indices("phase", "x"), shot.indices("gray", "x")
    places = ([gray[-2]], [phase[2]], [phase[1], phase[-2], gray[-1]])[int(level)]
    return show_instead(frames, places, [place - 1 for place in places])


def swap_neighbours(frames: Frames, level: float, shot: Shot) -> Frames:
    """Two Gray frames of x swapped (level 0), two phase steps (1), the last phase step and the
    first Gray frame (2)."""
    phase, gray = shot.indices("phase", "x"), shot.indices("gray", "x")
    first = (gray[-2], phase[1], phase[-1])[int(level)]
    return show_instead(frames, [first, first + 1], [first + 1, first])


def exchange_axis_frames(frames: Frames, level: float, shot: Shot) -> Frames:
    """Exchange all frames of x and y (level 0), the phase steps alone (1), or the Gray frames alone
    (2)."""
    kinds = (get_args(Kind), ("phase",), ("gray", "complementary"))[int(level)]
    x, y = ([i for kind in kinds for i in shot.indices(kind, axis)] for axis in ("x", "y"))
    return show_instead(frames, x + y, y + x)


def reverse_bits(frames: Frames, level: float, shot: Shot) -> Frames:
    """Gray bits in reverse order: of x (level 0), of both axes (1), of both with the complementary
    one (2)."""
    for axis in ("x",) if level == 0 else ("x", "y"):
        places = shot.indices("gray", axis)
        if level == 2:
            places += shot.indices("complementary", axis)
        frames = show_instead(frames, places, places[::-1])
    return frames


def reorder_steps(frames: Frames, level: float, shot: Shot) -> Frames:
    """Reorder phase steps: begin a quarter period late (level 0), run backwards (1), or 0 2 4 ... 1
    3 5 (2)."""
    for axis in ("x", "y"):
        places = shot.indices("phase", axis)
        n = len(places)
        orders = (
            [(k + n // 4) % n for k in range(n)],
            [-k % n for k in range(n)],
            [*range(0, n, 2), *range(1, n, 2)],
        )
        frames = show_instead(frames, places, [places[k] for k in orders[int(level)]])
    return frames
