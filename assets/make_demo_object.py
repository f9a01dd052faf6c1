"""Make the demo object: an ammonite in a slab of rock, a mesh without symmetry for scans to be
aligned on.

    python assets/make_demo_object.py

writes ``assets/objects/ammonite.ply``: binary PLY, mm, watertight, its front towards -z (towards
the camera, when its frame is turned like the camera's), the origin near its middle. The front is a
relief over the plane, free of undercuts; its sides and back are closed.
"""

from pathlib import Path

import numpy as np

from slviewer.session.ply import write_ply

RINGS = 142  # triangles of half a millimetre on the front
SIDE_RINGS = 6
HALF_WIDTH_MM = 70.0
GROWTH = np.log(2.15) / (2 * np.pi)  # the spiral's radius grows 2.15-fold in a turn
# tube radius as a share of the spiral's: neighbouring whorls just touch
TUBE = (2.15 - 1) / (2.15 + 1)


def disc(rings: int) -> tuple[np.ndarray, np.ndarray]:
    """A triangulated unit disc: points (n, 2), ring k has 6 k of them; triangles (m, 3),
    anticlockwise."""
    points, triangles, start = [np.zeros((1, 2))], [], [0, 1]
    for k in range(1, rings + 1):
        angle = 2 * np.pi * np.arange(6 * k) / (6 * k)
        points.append(k / rings * np.stack([np.cos(angle), np.sin(angle)], 1))
        start.append(start[-1] + 6 * k)
        inner, outer = max(6 * (k - 1), 1), 6 * k
        for side in range(6):
            for i in range(k):
                a, b = start[k] + (side * k + i) % outer, start[k] + (side * k + i + 1) % outer
                c = start[k - 1] + (side * (k - 1) + i) % inner
                triangles.append((a, b, c))
                if i < k - 1:
                    triangles.append((c, b, start[k - 1] + (side * (k - 1) + i + 1) % inner))
    return np.concatenate(points), np.array(triangles)


def outline(angle: np.ndarray) -> np.ndarray:
    """The slab's half width in mm by direction: a worn, lopsided stone."""
    waves = (
        0.06 * np.cos(2 * angle - 0.5)
        + 0.045 * np.cos(3 * angle + 1.1)
        + 0.02 * np.cos(5 * angle + 2.3)
    )
    return HALF_WIDTH_MM * (
        0.95 + waves + 0.008 * np.cos(11 * angle) + 0.006 * np.cos(17 * angle + 0.8)
    )


def dome(x: np.ndarray, y: np.ndarray, rim: np.ndarray) -> np.ndarray:
    """Height of the smooth rock in mm; `rim` runs from 0 in the middle to 1 at the outline."""
    return 17 * np.sqrt(np.clip(1 - rim**5, 0, 1)) + 0.035 * x - 0.05 * y


def roughness(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Height in mm of what the weather left on the rock."""
    rng = np.random.default_rng(11)
    rough = np.zeros_like(x)
    for length, height in ((41, 1.6), (23, 0.9), (13, 0.5), (7.5, 0.26), (4.3, 0.13)):
        for _ in range(11):
            a, phase, wavelength = (
                rng.uniform(0, 2 * np.pi),
                rng.uniform(0, 2 * np.pi),
                length * rng.uniform(0.75, 1.3),
            )
            rough += (
                height
                / 3.3
                * np.sin(2 * np.pi / wavelength * (x * np.cos(a) + y * np.sin(a)) + phase)
            )
    return rough


def ammonite(
    x: np.ndarray, y: np.ndarray, size: float, turns: float, turn: float, ribs: int
) -> tuple[np.ndarray, np.ndarray]:
    """A coiled, ribbed shell about the origin: its height in mm, -inf beside it, and (bool) the
    ground that it covers.

    `size`: greatest radius in mm; `turn`: direction of the mouth; `ribs`: their number in a turn.
    """
    radius, angle = np.hypot(x, y), np.arctan2(y, x) - turn
    outer = size / (1 + TUBE)  # the spiral's radius at the mouth
    height, covered = np.full_like(x, -np.inf), np.zeros(x.shape, bool)
    for whorl in range(int(turns) + 1):
        # 0 at the mouth, negative inwards
        along = np.mod(angle, 2 * np.pi) - 2 * np.pi * (whorl + 1)
        centre = outer * np.exp(GROWTH * along)
        tube = 1.05 * TUBE * centre
        across = (radius - centre) / tube
        covered |= across < 0.8  # short of the edge, where rock and shell meet in a fillet
        inside = (np.abs(across) < 1) & (along > -2 * np.pi * turns)
        phase = ribs * along + 1.1 * (across + 0.4) ** 2  # ribs sweep forward on the outer flank
        share = np.clip((across + 0.1) / 0.6, 0, 1)  # and split in two towards the keel
        ornament = (1 - share) * (0.5 + 0.5 * np.cos(phase)) ** 1.3 + share * (
            0.5 + 0.5 * np.cos(2 * phase + 0.4)
        )
        profile = np.sqrt(np.clip(1 - across**2, 0, 1))
        keel = 0.10 * np.exp(-(((across - 0.62) / 0.09) ** 2))
        mouth = np.sqrt(np.clip(-along / 0.12, 0, 1))  # the last chamber is broken off
        body = tube * profile * (1.0 + 0.15 * ornament * profile + keel) * (0.2 + 0.8 * mouth)
        height = np.where(inside, np.maximum(height, body + 0.10 * (size - radius)), height)
    core = outer * np.exp(-GROWTH * 2 * np.pi * turns) * (1 + TUBE)
    button = np.sqrt(np.clip(1 - (radius / core) ** 2, 0, 1))
    return np.where(button > 0, np.maximum(height, core * button + 0.10 * size), height), covered


def scallop(x: np.ndarray, y: np.ndarray, size: float) -> np.ndarray:
    """Height in mm of a small fan-shaped shell with its hinge at the origin, opening towards +y;
    -inf beside it."""
    radius, angle = np.hypot(x, y), np.arctan2(x, y)
    reach = size * (0.80 + 0.2 * np.cos(1.5 * angle)) * (1 + 0.02 * np.cos(22 * angle))
    s = radius / reach
    inside = (s < 1) & (np.abs(angle) < 1.15)
    vault = np.sqrt(np.clip(1 - s**2, 0, 1)) * np.sqrt(
        np.clip(np.sin(np.pi * np.clip(s * 0.8 + 0.2, 0, 1)), 0, 1)
    )
    edge = np.sqrt(np.clip(1 - (angle / 1.15) ** 2, 0, 1))
    ribs = 1 + 0.10 * np.cos(22 * angle) * s
    growth = 1 + 0.03 * np.cos(2 * np.pi * s * 6)
    return np.where(inside, 0.34 * size * vault * edge * ribs * growth, -np.inf)


def soft_max(a: np.ndarray, b: np.ndarray, width: float) -> np.ndarray:
    """The greater of both, with a fillet of `width` mm where they meet."""
    b = np.where(np.isfinite(b), b, a - 10 * width)
    blend = np.clip(0.5 + (b - a) / (2 * width), 0, 1)
    return a + (b - a) * blend + width * blend * (1 - blend)


def relief(x: np.ndarray, y: np.ndarray, rim: np.ndarray) -> np.ndarray:
    """Height of the front in mm."""
    rock = dome(x, y, rim)
    height = rock + roughness(x, y) * (1 - rim**4)
    large, covered = ammonite(x + 5, y - 4, 52, 3.6, 0.9, 34)
    height = np.where(covered, rock - 6, height)
    height = soft_max(height, rock - 3 + large, 0.6)
    small, covered = ammonite(-(x - 44), y + 27, 15, 2.6, 2.6, 22)  # coils the other way
    height = np.where(covered, rock - 3, height)
    height = soft_max(height, rock - 0.5 + small, 0.4)
    c, s = np.cos(0.95), np.sin(0.95)
    fan = scallop(c * (x + 27) + s * (y + 46), -s * (x + 27) + c * (y + 46), 26)
    height = soft_max(height, rock - 0.5 + fan, 0.4)
    along, across = x * 0.8 + y * 0.6 - 8, -x * 0.6 + y * 0.8 - 49  # a crack in the rock
    across = across - 1.5 * np.sin(along / 6) - 0.6 * np.sin(along / 2.3)
    crack = 2.2 * np.exp(-((across / 1.1) ** 2)) * np.clip(1 - (np.abs(along) / 30) ** 2, 0, 1)
    return height - crack


def build() -> tuple[np.ndarray, np.ndarray]:
    """Vertices (n, 3) mm and triangles (m, 3) of the closed object."""
    flat, front = disc(RINGS)
    rim = np.hypot(*flat.T)
    angle = np.arctan2(flat[:, 1], flat[:, 0])
    # Rings crowd towards the outline, where the stone falls off steeply.
    spread = np.sin(rim * np.pi / 2 * 0.85) / np.sin(np.pi / 2 * 0.85)
    x, y = spread * outline(angle) * np.cos(angle), spread * outline(angle) * np.sin(angle)
    height = relief(x, y, spread)
    vertices = [np.stack([x, y, height], 1)]
    boundary = np.flatnonzero(rim > 1 - 1e-9)
    bottom = -9.0
    for k in range(1, SIDE_RINGS + 1):  # sides curve inwards to a flat back
        t = k / SIDE_RINGS * np.pi / 2
        shrink = 1 - 0.10 * (1 - np.cos(t))
        level = height[boundary] + (bottom - height[boundary]) * np.sin(t)
        vertices.append(np.stack([x[boundary] * shrink, y[boundary] * shrink, level], 1))
    vertices.append(np.array([[0.0, 0.0, bottom]]))
    triangles, inner = [front], boundary
    n, start = len(boundary), len(flat)
    following = np.roll(np.arange(n), -1)
    for k in range(SIDE_RINGS):
        outer = start + k * n + np.arange(n)
        triangles += [
            np.stack([inner, outer, inner[following]], 1),
            np.stack([inner[following], outer, outer[following]], 1)
        ]  # fmt: skip
        inner = outer
    last = np.full(n, start + SIDE_RINGS * n)
    triangles.append(np.stack([inner, last, inner[following]], 1))
    points = np.concatenate(vertices)
    points[:, 2] -= 14  # the middle of the relief
    points *= [1, -1, -1]  # half a turn about x: the front looks towards -z
    return points, np.concatenate(triangles)


if __name__ == "__main__":
    corners, faces = build()
    write_ply(Path(__file__).parent / "objects" / "ammonite.ply", corners, faces=faces)
