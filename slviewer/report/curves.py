"""The Letter's picture of one pixel: z over phase, x and y over z, and the residuals of the fits."""

import numpy as np

from slviewer.errors import InputError
from slviewer.report.canvas import FULL, HALF, INK, MODELS, SOFT, add_legend, finish_figure, new_figure, style_axes
from slviewer.report.data import PixelCurve
from slviewer.report.page import Figure

DATA = "#c2502e"


def pixel_curves(curve: PixelCurve, *, width: int = FULL) -> Figure:
    """The rational function and the two lines of one camera pixel with their data, residuals in um below.

    A narrow figure has one curve a row, its residuals beside it.
    """
    n = len(curve.phase)
    if any(np.shape(v) != (n,) for v in (curve.z, curve.x, curve.y)) or np.shape(curve.coefficients) != (5,):
        raise InputError(
            f"pixel {curve.pixel} has {n} phases, and depths {np.shape(curve.z)}, x {np.shape(curve.x)}, "
            f"y {np.shape(curve.y)} with coefficients {np.shape(curve.coefficients)}: (n,) each and (5,) are needed"
        )
    known = np.isfinite([curve.phase, curve.z, curve.x, curve.y]).all(axis=0)
    phase, z, x, y = (np.asarray(v, float)[known] for v in (curve.phase, curve.z, curve.x, curve.y))
    c0, c1, c2, c3, c4 = curve.coefficients

    def depth(at: np.ndarray) -> np.ndarray:
        """Depth z in mm by the rational function, at projector coordinates (n,)."""
        return (c0 + c1 * at) / (1 + c2 * at)

    panels = (
        ("z over phase (eq. 9)", "absolute phase, rad", "z", phase, z, depth),
        ("x over z (eq. 10)", "z, mm", "x", z, x, lambda at: c3 * at),
        ("y over z (eq. 11)", "z, mm", "y", z, y, lambda at: c4 * at),
    )
    narrow = width <= HALF
    drawing = new_figure(width, 540 if narrow else 400)
    if narrow:
        grid = drawing.add_gridspec(3, 2, width_ratios=(1.35, 1))
    else:
        grid = drawing.add_gridspec(2, 3, height_ratios=(3, 1.15))
    for i, ((title, along, name, at, value, fitted), rms) in enumerate(zip(panels, curve.rms_mm, strict=True)):
        upper = drawing.add_subplot(grid[i, 0] if narrow else grid[0, i])
        lower = drawing.add_subplot(grid[i, 1] if narrow else grid[1, i], sharex=upper)
        style_axes(
            upper, f"{title}: RMS {1e3 * rms:.0f} µm" if narrow else title, along if narrow else "", f"{name}, mm"
        )
        style_axes(lower, "", along, f"{name} - fit, µm")
        upper.tick_params(labelbottom=narrow)
        if at.size:
            margin = 0.06 * (np.ptp(at) or 1.0)
            line = np.linspace(at.min() - margin, at.max() + margin, 200)
            upper.plot(line, fitted(line), color=MODELS["pixelwise"], linewidth=1.5, label="fit")
            upper.plot(at, value, "o", color=DATA, markersize=4.2, markeredgewidth=0, alpha=0.85, label="target poses")
            residuals = 1e3 * (value - fitted(at))
            lower.vlines(at, 0, residuals, color=DATA, linewidth=0.9, alpha=0.6)
            lower.plot(at, residuals, "o", color=DATA, markersize=3.4, markeredgewidth=0)
            reach = 1.25 * max(float(np.abs(residuals).max()), 1.0)
            lower.set_ylim(-reach, reach)
            if not narrow:
                add_legend(upper, loc="best", title=f"RMS {1e3 * rms:.0f} µm", title_fontsize=8.6, alignment="left")
                upper.get_legend().get_title().set_color(INK)
            elif i == 0:
                add_legend(upper, loc="best")
        lower.axhline(0, color=SOFT, linewidth=0.8)
    u, v = curve.pixel
    listed = ", ".join(f"{name} {1e3 * rms:.0f} µm" for name, rms in zip("zxy", curve.rms_mm, strict=True))
    return finish_figure(
        drawing,
        f"Fit of camera pixel ({u}, {v}) to {at.size} target poses: z as a rational function of the absolute "
        f"phase of axis {curve.axis}, x and y as lines through the camera's centre. "
        f"{'Beside' if narrow else 'Below'}: the residuals "
        f"(RMS {listed}).",
        f"Curves of z over phase, x over z and y over z at camera pixel ({u}, {v}) with residuals; RMS {listed}",
    )
