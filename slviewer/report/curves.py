"""The Letter's picture of one pixel: z over phase, x and y over z, and the residuals of the
fits."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from slviewer.errors import InputError
from slviewer.report.canvas import (
    FULL,
    HALF,
    INK,
    MODELS,
    SOFT,
    add_legend,
    finish_figure,
    new_figure,
    style_axes,
)
from slviewer.report.data import PixelCurve
from slviewer.report.page import Figure

DATA = "#c2502e"


@dataclass(frozen=True)
class _FittedCurve:
    """Values (n,) mm of a pixel over phases or depths (n,), and the function that was fitted to
    them."""

    title: str
    along: str
    name: str
    at: np.ndarray
    values: np.ndarray
    fitted: Callable[[np.ndarray], np.ndarray]

    def draw(self, upper: Any, lower: Any) -> None:
        """Draw the fit and the values into the upper axes, the residuals in um into the lower
        ones."""
        at = self.at
        margin = 0.06 * (np.ptp(at) or 1.0)
        line = np.linspace(at.min() - margin, at.max() + margin, 200)
        upper.plot(line, self.fitted(line), color=MODELS["pixelwise"], linewidth=1.5, label="fit")
        style: dict[str, Any] = {"color": DATA, "markeredgewidth": 0}
        upper.plot(at, self.values, "o", markersize=4.2, alpha=0.85, label="target poses", **style)
        residuals = 1e3 * (self.values - self.fitted(at))
        lower.vlines(at, 0, residuals, color=DATA, linewidth=0.9, alpha=0.6)
        lower.plot(at, residuals, "o", markersize=3.4, **style)
        reach = 1.25 * max(float(np.abs(residuals).max()), 1.0)
        lower.set_ylim(-reach, reach)


def pixel_curves(curve: PixelCurve, *, width: int = FULL) -> Figure:
    """The rational function and the two lines of one camera pixel with their data, residuals in um
    below.

    A narrow figure has one curve a row, its residuals beside it.
    """
    n = len(curve.phase)
    if any(np.shape(v) != (n,) for v in (curve.z, curve.x, curve.y)) or np.shape(
        curve.coefficients
    ) != (5,):
        raise InputError(
            f"pixel {curve.pixel} has {n} phases, and depths {np.shape(curve.z)}, x"
            f" {np.shape(curve.x)}, y {np.shape(curve.y)} with coefficients"
            f" {np.shape(curve.coefficients)}: (n,) each and (5,) are needed"
        )
    known = np.isfinite([curve.phase, curve.z, curve.x, curve.y]).all(axis=0)
    phase, z, x, y = (np.asarray(v, float)[known] for v in (curve.phase, curve.z, curve.x, curve.y))
    c0, c1, c2, c3, c4 = curve.coefficients

    def depth(at: np.ndarray) -> np.ndarray:
        """Depth z in mm by the rational function, at projector coordinates (n,)."""
        return (c0 + c1 * at) / (1 + c2 * at)

    curves = (
        _FittedCurve("z over phase (eq. 9)", "absolute phase, rad", "z", phase, z, depth),
        _FittedCurve("x over z (eq. 10)", "z, mm", "x", z, x, lambda at: c3 * at),
        _FittedCurve("y over z (eq. 11)", "z, mm", "y", z, y, lambda at: c4 * at),
    )
    narrow = width <= HALF
    drawing = new_figure(width, 540 if narrow else 400)
    if narrow:
        grid = drawing.add_gridspec(3, 2, width_ratios=(1.35, 1))
    else:
        grid = drawing.add_gridspec(2, 3, height_ratios=(3, 1.15))
    for i, (each, rms) in enumerate(zip(curves, curve.rms_mm, strict=True)):
        upper = drawing.add_subplot(grid[i, 0] if narrow else grid[0, i])
        lower = drawing.add_subplot(grid[i, 1] if narrow else grid[1, i], sharex=upper)
        stated = f"RMS {1e3 * rms:.0f} µm"
        if narrow:
            style_axes(upper, f"{each.title}: {stated}", each.along, f"{each.name}, mm")
        else:
            style_axes(upper, each.title, "", f"{each.name}, mm")
        style_axes(lower, "", each.along, f"{each.name} - fit, µm")
        upper.tick_params(labelbottom=narrow)
        if phase.size:
            each.draw(upper, lower)
            if not narrow:
                add_legend(upper, loc="best", title=stated, title_fontsize=8.6, alignment="left")
                upper.get_legend().get_title().set_color(INK)
            elif i == 0:
                add_legend(upper, loc="best")
        lower.axhline(0, color=SOFT, linewidth=0.8)
    u, v = curve.pixel
    listed = ", ".join(
        f"{name} {1e3 * rms:.0f} µm" for name, rms in zip("zxy", curve.rms_mm, strict=True)
    )
    return finish_figure(
        drawing,
        f"Fit of camera pixel ({u}, {v}) to {phase.size} target poses: z as a rational function of"
        f" the absolute phase of axis {curve.axis}, x and y as lines through the camera's centre."
        f" {'Beside' if narrow else 'Below'}: the residuals (RMS {listed}).",
        f"Curves of z over phase, x over z and y over z at camera pixel ({u}, {v}) with residuals;"
        f" RMS {listed}",
    )
