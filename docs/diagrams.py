"""Draw the diagrams of the pages: geometry, phase, and noise over distance and angle.

`python docs/figures.py --pictures` runs this; the figures of noise are those of `slviewer
plan-rig`.
"""

import os
import sys
from pathlib import Path

import cv2
import matplotlib.pyplot as plt
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from slviewer.calibration.stereo import StereoModel
from slviewer.fringe.decode import decode
from slviewer.fringe.patterns import render_pattern
from slviewer.fringe.presets import p18
from slviewer.geometry.lens import Lens
from slviewer.geometry.rig import StereoRig
from slviewer.inspection.deviation import deviation_colours
from slviewer.operations.plan_rig import plan_rig
from slviewer.operations.show_on_part import projection_image, write_text
from slviewer.reconstruction.reconstruct import triangulate_grid
from slviewer.simulation.plans import objects
from slviewer.simulation.renderer import Renderer
from slviewer.simulation.rig import letter
from slviewer.simulation.truth import rig_record

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


def draw_mountings(path: Path) -> None:
    """Draw what a hand-eye calibration measures and solves, for both mountings."""
    figure, axes = plt.subplots(1, 2, figsize=(8.4, 3.2), layout="constrained")
    parts = {
        "eye in hand": ("camera", "board", (2.0, 1.0)),
        "eye to hand": ("board", "camera", (2.0, 1.0)),
    }
    for axis, (title, (on_flange, fixed, flange)) in zip(axes, parts.items(), strict=True):
        places = {"base": (0.0, 0.0), "flange": flange, on_flange: (3.4, 1.0), fixed: (3.4, -0.4)}
        arms = [(0, 0), (0.3, 1.4), (1.4, 1.7), flange]
        axis.plot(*np.transpose(arms), "o-", lw=6, ms=11, color="#c3c7cc", zorder=0)
        in_hand = on_flange == "camera"
        arrows = (
            ("base", "flange", "robot", "#1f9673"),
            ("camera", "board", "measured", "#1f9673"),
            ("flange" if in_hand else "base", "camera", "X, solved", "#d9692b"),
            ("base" if in_hand else "flange", "board", "Z, solved", "#d9692b"),
        )
        for start, end, label, colour in arrows:
            (x0, y0), (x1, y1) = places[start], places[end]
            style = {"arrowstyle": "->", "color": colour, "lw": 1.8}
            axis.annotate("", (x1, y1), (x0, y0), arrowprops=style)
            middle = (x0 + x1) / 2, (y0 + y1) / 2
            box = {"facecolor": "white", "edgecolor": "none", "pad": 1.5}
            axis.text(*middle, label, color=colour, fontsize=9, ha="center", va="center", bbox=box)
        for name, (x, y) in places.items():
            axis.plot(x, y, "s" if name in ("camera", "board") else "o", ms=9, color="#333333")
            axis.text(x + 0.06, y + 0.18, name, fontsize=10, weight="bold")
        axis.set(title=title, xlim=(-0.4, 4.3), ylim=(-0.8, 2.1), aspect="equal")
        axis.axis("off")
    figure.savefig(path, dpi=100)


def draw_rigs(path: Path) -> None:
    """Draw two rigs round one sphere from above: what each sees, and what relates them."""
    figure, axis = plt.subplots(figsize=(6.4, 3.0), layout="constrained")
    angles = np.radians(np.linspace(-78, 78, 60))
    axis.add_patch(plt.Circle((0, 0), 1, color="#e6e8ea"))
    for name, turn_deg, colour in (
        ("reference", 180.0, "#2270b8"),
        ("other rig", -20.0, "#d9692b"),
    ):
        turn = np.radians(turn_deg)
        axis.plot(np.cos(turn + angles), np.sin(turn + angles), lw=4, color=colour, alpha=0.7)
        x, y = 3.2 * np.cos(turn), 3.2 * np.sin(turn)
        axis.plot(x, y, "s", ms=13, color=colour)
        axis.text(x, y - 0.55, name, ha="center", color=colour, fontsize=10, weight="bold")
        for edge in (-72, 72):
            rim = np.radians(edge) + turn
            axis.plot([x, np.cos(rim)], [y, np.sin(rim)], ":", lw=1, color=colour)
    arrow = {"arrowstyle": "->", "color": "#333333", "lw": 1.6,
             "connectionstyle": "arc3,rad=-0.55"}  # fmt: skip
    end = 3.2 * np.cos(np.radians(20)), -3.2 * np.sin(np.radians(20)) + 0.2
    axis.annotate("", end, (-3.2, 0.25), arrowprops=arrow)
    axis.text(0, 1.85, "T_reference_rig, with U", ha="center", fontsize=10)
    axis.text(0, 0, "board, spheres\nor part", ha="center", va="center", fontsize=9)
    axis.set(xlim=(-4.2, 4.2), ylim=(-1.9, 2.2), aspect="equal")
    axis.axis("off")
    figure.savefig(path, dpi=100)


def draw_on_part(path: Path) -> None:
    """Draw what the simulated camera sees of a relief on which its projector shows deviations that
    are made up: a bump and a dent."""
    rig = letter(0.5, 3, local_distortion_px=0)
    renderer = Renderer(rig, objects()["object_r2"])
    truth = renderer.truth()
    points = np.where(truth.mask[..., None], truth.points, np.nan)
    vertices = points[np.isfinite(points).all(axis=2)]
    x, y, _ = (vertices - np.median(vertices, axis=0)).T
    deviations = 0.4 * np.exp(-((x - 25) ** 2 + (y + 15) ** 2) / 300)
    deviations -= 0.5 * np.exp(-((x + 25) ** 2 + (y - 20) ** 2) / 400)
    record = rig_record(rig)
    lenses = [
        Lens(np.array(record[device]["K"]), np.array(record[device]["D"]), each.size)
        for device, each in (("camera", rig.camera), ("projector", rig.projector))
    ]
    model = StereoModel.from_rig(StereoRig(*lenses, rig.R, rig.t))
    image = projection_image(
        model,
        vertices,
        triangulate_grid(points),
        deviations[:, None],
        lambda values: deviation_colours(values[:, 0], 0.4),
        gamma=rig.light.gamma,
    )
    for at in (deviations.argmax(), deviations.argmin()):
        write_text(image, model.pinholes, vertices[at], f"{deviations[at]:+.2f}")
    light = ((image / 255) ** rig.light.gamma).astype(np.float32)
    u, v = (truth.projector[..., k].astype(np.float32) for k in (0, 1))
    white = renderer.light((None, np.full(rig.projector.size[0], 255)))[..., None]
    seen = (0.12 + cv2.remap(light, u, v, cv2.INTER_LINEAR)) * white / 255
    seen = np.where(truth.mask[..., None], seen, 0.0)[80:500, 180:660]
    plt.imsave(path, np.clip(seen, 0, 1) ** (1 / 2.2))


def draw_diagrams(folder: Path) -> None:
    """Draw all diagrams as PNG files."""
    os.environ.setdefault("MPLBACKEND", "agg")
    folder.mkdir(parents=True, exist_ok=True)
    draw_geometry(folder / "geometry.png")
    draw_phase(folder / "phase.png")
    draw_noise(folder / "noise.png")
    draw_mountings(folder / "mountings.png")
    draw_rigs(folder / "rigs.png")
    draw_on_part(folder / "on_part.png")


if __name__ == "__main__":
    draw_diagrams(Path(__file__).parent / "images" / "diagrams")
