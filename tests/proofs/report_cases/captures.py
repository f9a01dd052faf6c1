"""Captures of other cameras and projectors."""

import re
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import cv2
import numpy as np

from slviewer.examination.examine import examine
from slviewer.fringe.decode import decode
from slviewer.fringe.patterns import profile
from slviewer.fringe.phase import PhaseMap
from slviewer.fringe.presets import complementary, gray_bits, phase_steps
from slviewer.fringe.sequence import Frame, PatternSequence
from slviewer.pipeline.capture_phases import loss_warnings
from tests.proofs.report_cases.case import Case, Outcome, Workplace

WIDTH, HEIGHT = 600, 80
NOISE = 1.0
"""Standard deviation of a grey level."""


def _photograph(
    levels: np.ndarray, brightness: float, black: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """Return the light (n, h, w) of patterns (n, extent), 0 to 255, on a board whose brightness
    varies, in grey levels, and the column (h, w) that each pixel sees."""
    extent = levels.shape[1]
    columns = np.linspace(5, extent - 6, WIDTH) + np.linspace(0, 3, HEIGHT)[:, None]
    fine = np.repeat(levels.astype(np.float32), 8, axis=1)
    blurred = cv2.GaussianBlur(fine, (0, 0), 5.0, sigmaY=1e-3, borderType=cv2.BORDER_REPLICATE)
    seen = blurred[:, ((columns + 0.5) * 8).astype(int)]
    albedo = brightness * (0.5 + 0.5 * np.linspace(0, 1, HEIGHT)[:, None])
    noise = np.random.default_rng(3).normal(0, NOISE, seen.shape)
    return black + albedo * seen + noise, columns


def _measure_errors(phase: PhaseMap, columns: np.ndarray) -> np.ndarray:
    """Return the errors px of the columns at the pixels that are not masked."""
    return np.abs(phase.coordinate - columns)[phase.mask]


def _judge_clipping(
    place: Workplace, *, brightness: float, clip: int, depth: int, share: float = 0.0
) -> Outcome:
    """Decode a board of which some columns are brighter by half, or all, by a camera that clips at
    a level of its own."""
    sequence = complementary((720, 720), steps=4)
    sequence = replace(sequence, frames=tuple(f for f in sequence.frames if f.axis == "x"))
    levels = np.stack([profile(sequence, k)[1] for k in range(len(sequence.frames))])
    light, columns = _photograph(levels, brightness, 10.0)
    if share:
        light[:, :, : int(share * WIDTH)] *= 2.0
    scale = ((1 << depth) - 1) / 255
    dtype = np.uint8 if depth == 8 else np.uint16
    images = np.clip(np.rint(light * scale), 0, clip).astype(dtype)
    phase = decode(sequence, images, "x")
    clipped = (light[:4] * scale > clip + 0.5 * scale).any(axis=0)
    crossed = float(np.mean(clipped))
    masked = float(np.mean(phase.reason == 2))
    error = float(np.quantile(_measure_errors(phase, columns), 0.99))
    warnings = loss_warnings(sequence, images, {"x": phase})
    warned = any(f"below grey level {clip}" in message for message in warnings)
    return Outcome(
        f"{100 * masked:.1f} % masked as saturated, 99 % of the errors below {error:.2f} px",
        f"{100 * crossed:.1f} % are clipped at {clip}; 0.30 px at most without them",
        abs(masked - crossed) < 0.02 and error < 0.3 and warned == (crossed > 0.05),
    )


def _judge_cells(
    place: Workplace,
    *,
    extent: int,
    period_px: float,
    edge: Callable[[np.ndarray], np.ndarray],
    offset_rad: float = 0.0,
) -> Outcome:
    """Examine fringes whose width is not whole in pixels, with a Gray code whose cells ``edge``
    numbers by column; follow the remedies, one after the other, and decode."""
    columns = np.arange(extent)
    order = edge(columns)
    bits = int(order.max()).bit_length()
    steps = phase_steps("x", 4, period_px)
    frames = (*steps, *gray_bits("x", bits), Frame("texture"))
    gray = order ^ (order >> 1)
    angle = 2 * np.pi * columns / period_px + offset_rad
    levels = [127.5 + 110 * np.cos(angle + np.pi / 2 * k) for k in range(4)]
    levels += [20.0 + 220 * ((gray >> (bits - 1 - b)) & 1) for b in range(bits)]
    light, seen = _photograph(np.stack([*levels, np.full(extent, 240.0)]), 0.9)
    images = np.clip(np.rint(light), 0, 255).astype(np.uint8)
    # where the code begins is convention: with column 0, whose edge is at -0.5
    sequence = PatternSequence((extent, extent), frames)
    followed = []
    for _ in range(3):
        rejected = examine(sequence, images).rejected
        if not rejected:
            break
        found = re.findall(r"(gray_cell_px|phase_offset) = ([-\d.]+)", rejected[0].remedy)
        if not found:
            return Outcome(rejected[0].text(), "a remedy that names a value", False)
        followed += [" = ".join(each) for each in found]
        values = {name: float(value) for name, value in found}
        sequence = PatternSequence.from_dict({**sequence.to_dict(), **values})
    phase = decode(sequence, images, "x")
    errors = _measure_errors(phase, seen)
    wrong, rms = float(np.mean(errors > 0.6)), float(np.sqrt(np.mean(errors**2)))
    return Outcome(
        f"{', '.join(followed) or 'as described'}: {100 * phase.mask.mean():.0f} % decoded, RMS"
        f" {rms:.3f} px, {100 * wrong:.2f} % wrong",
        "80 % or more decoded, RMS below 0.4 px, none wrong",
        bool(not rejected and phase.mask.mean() > 0.8 and wrong < 1e-3 and 0.01 < rms < 0.4),
    )


def _number_rounded(columns: np.ndarray, period_px: float) -> np.ndarray:
    """Return the cells whose edges are those of the periods, each rounded to a whole pixel."""
    edges = np.floor(np.arange(1, 100) * period_px + 0.5)
    return np.searchsorted(edges, columns, side="right")


def _cells(extent: int, period_px: float, cell_px: int, offset_rad: float = 0.0) -> Case:
    """Return the case of cells of a whole width."""
    return partial(
        _judge_cells,
        extent=extent,
        period_px=period_px,
        edge=lambda columns: columns // cell_px,
        offset_rad=offset_rad,
    )


CASES: dict[str, Case] = {
    "clipped at 235 of 255": partial(_judge_clipping, brightness=1.5, clip=235, depth=8),
    "clipped at 3839 of 4095": partial(_judge_clipping, brightness=1.5, clip=3839, depth=12),
    "clipped at 940 of 1023": partial(_judge_clipping, brightness=1.5, clip=940, depth=10),
    "clipped at 235 in 3 % of the pixels": partial(
        _judge_clipping, brightness=0.85, clip=235, depth=8, share=0.035
    ),
    "reaches 230 of 255 without clipping": partial(
        _judge_clipping, brightness=0.85, clip=255, depth=8
    ),
    "periods of 22.5 px, cells of 23": _cells(720, 22.5, 23),
    "periods of 35.56 px, cells of 36": _cells(1280, 1280 / 36, 36),
    "periods of 21.33 px, cells of 21": _cells(1024, 1024 / 48, 21),
    "periods of 22.5 px, edges rounded": partial(
        _judge_cells,
        extent=720,
        period_px=22.5,
        edge=partial(_number_rounded, period_px=22.5),
    ),
    "periods of 22.5 px, cells of 23, phase 1 rad later": _cells(720, 22.5, 23, 1.0),
    "periods of 22.5 px, cells of 23, phase a quarter later": _cells(720, 22.5, 23, np.pi / 2),
}
