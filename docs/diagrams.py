"""Draw the diagrams of the pages: geometry, phase, and noise over distance and angle.

`python docs/figures.py --pictures` runs this; the figures of noise are those of `slviewer
plan-rig`.
"""

import os
import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from slviewer.fringe.decode import decode
from slviewer.fringe.patterns import render_pattern
from slviewer.fringe.presets import p18
from slviewer.operations.plan_rig import plan_rig

RIGS = {
    "webcam, pocket projector": ("webcam-1080p", "pocket-720p"),
    "global shutter, 1080p projector": ("global-shutter-2mp", "projector-1080p"),
    "machine vision, LightCrafter": ("machine-vision-5mp", "lightcrafter4500"),
}
DISTANCES_MM = np.array([300, 400, 500, 600, 800, 1000])
ANGLES_DEG = np.array([6, 10, 15, 22, 30, 40])


def draw_geometry(path: Path) -> None:
    """Draw a camera and a projector that see one point, from above."""
    figure, axis = plt.subplots(figsize=(7.2, 3.6), layout="constrained")
    camera, projector, point = np.array([0.0, 0.0]), np.array([2.4, 0.0]), np.array([0.9, 3.6])
    surface_x = np.linspace(-0.9, 2.9, 100)
    surface = 3.75 - 0.12 * (surface_x - 0.1) ** 2 + 0.1 * np.sin(3 * surface_x)
    point[1] = np.interp(point[0], surface_x, surface)
    for device, colour, name in (
        (camera, "#2270b8", "camera"),
        (projector, "#d9692b", "projector"),
    ):
        side = np.array([0.16, -0.3])
        axis.fill(
            *np.array([device, device + side, device + side * [-1, 1]]).T, color=colour, alpha=0.9
        )
        axis.text(device[0], device[1] - 0.62, name, ha="center", color=colour)
        axis.plot(*np.array([device, point]).T, color=colour, lw=1.6)
    axis.plot(
        *np.array([projector, projector + 1.12 * (point - projector)]).T,
        color="#d9692b",
        lw=1,
        ls=":",
    )
    axis.plot(surface_x, surface, color="#5a6877", lw=2)
    axis.plot(*point, "o", color="#1b2733")
    axis.annotate(
        "",
        (camera[0], -0.15),
        (projector[0], -0.15),
        arrowprops={"arrowstyle": "<->", "color": "#5a6877"},
    )
    axis.text(1.2, -0.12, "baseline", ha="center", va="bottom", color="#5a6877")
    axis.annotate(
        "", (-1.45, 0), (-1.45, point[1]), arrowprops={"arrowstyle": "<->", "color": "#5a6877"}
    )
    axis.text(-1.5, 1.8, "z", ha="right", color="#5a6877")
    axis.text(0.25, 2.1, "ray of the pixel\n$(u_c, v_c)$", color="#2270b8", ha="right")
    axis.text(
        1.95, 1.6, "plane of the column $u_p$,\nwhich the phase $\\phi$ names", color="#d9692b"
    )
    axis.text(point[0] + 0.12, point[1] + 0.08, "point (x, y, z)", color="#1b2733", va="bottom")
    turned = np.radians([np.degrees(np.arctan2(*(d - point)[::-1])) for d in (camera, projector)])
    arc = np.linspace(*turned, 30)
    axis.plot(point[0] + 0.8 * np.cos(arc), point[1] + 0.8 * np.sin(arc), color="#1b2733", lw=1)
    axis.text(
        *(point + 1.05 * np.array([np.cos(arc[15]), np.sin(arc[15])])),
        "angle",
        ha="center",
        va="top",
    )
    axis.set(aspect="equal", xlim=(-1.9, 4.6), ylim=(-0.75, 4.1))
    axis.axis("off")
    figure.savefig(path, dpi=100)


def draw_phase(path: Path) -> None:
    """Draw fringes, Gray code, wrapped and absolute phase along the first columns of the preset
    p18."""
    columns = 90
    sequence = p18((912, 64))
    frames = np.stack(
        [render_pattern(sequence, k)[:, :columns] for k in range(len(sequence.frames))]
    )
    phase = decode(sequence, frames, "x").phase[32]
    u = np.arange(columns)
    kinds = [(frame.axis, frame.kind) for frame in sequence.frames]
    steps = [k for k, kind in enumerate(kinds) if kind == ("x", "phase")]
    bits = [k for k, kind in enumerate(kinds) if kind == ("x", "gray")]
    figure, axes = plt.subplots(4, 1, figsize=(7.2, 5.0), layout="constrained", sharex=True)
    for k, alpha in zip(steps[::6], (1.0, 0.6, 0.35), strict=True):
        axes[0].plot(u, frames[k][32], color="#2270b8", alpha=alpha)
    axes[0].set(ylabel="$I_k$", title="three of the phase steps, grey levels")
    axes[1].imshow(
        frames[bits[-4:], 32], cmap="gray", aspect="auto", extent=(-0.5, columns - 0.5, 4, 0)
    )
    axes[1].set(
        yticks=[], ylabel="bits", title="the last bits of the Gray code, which number the fringes"
    )
    axes[2].plot(u, np.mod(phase + np.pi, 2 * np.pi) - np.pi, ".", ms=3, color="#d9692b")
    axes[2].set(ylabel="rad", title="wrapped phase")
    axes[3].plot(u, phase, ".", ms=3, color="#1f9673")
    axes[3].set(ylabel="rad", xlabel="projector column, px", title="absolute phase")
    for axis in axes:
        axis.title.set_fontsize(9)
    figure.savefig(path, dpi=100)


def draw_noise(path: Path) -> None:
    """Draw the predicted noise of a point of three rigs over distance, and over the angle at one
    distance."""
    figure, (left, right) = plt.subplots(
        1, 2, figsize=(8.4, 3.4), layout="constrained", sharey=True
    )
    for name, devices in RIGS.items():
        far = [1000 * plan_rig(*devices, float(z)).plan.sigma_middle for z in DISTANCES_MM]
        wide = [
            1000
            * plan_rig(
                *devices, 600.0, baseline=600.0 * np.tan(np.radians(angle))
            ).plan.sigma_middle
            for angle in ANGLES_DEG
        ]
        left.plot(DISTANCES_MM, far, "o-", label=name)
        right.plot(ANGLES_DEG, wide, "o-", label=name)
    left.set(xlabel="distance, mm (angle 22 degrees)", ylabel="noise of a point, µm", yscale="log")
    right.set(xlabel="angle, degrees (distance 600 mm)")
    left.set_yticks([5, 10, 20, 50, 100, 200], labels=["5", "10", "20", "50", "100", "200"])
    left.minorticks_off()
    for axis in (left, right):
        axis.grid(alpha=0.4)
    right.legend(fontsize=8)
    figure.savefig(path, dpi=100)


def draw_diagrams(folder: Path) -> None:
    """Draw all diagrams as PNG files."""
    os.environ.setdefault("MPLBACKEND", "agg")
    folder.mkdir(parents=True, exist_ok=True)
    draw_geometry(folder / "geometry.png")
    draw_phase(folder / "phase.png")
    draw_noise(folder / "noise.png")


if __name__ == "__main__":
    draw_diagrams(Path(__file__).parent / "images" / "diagrams")
