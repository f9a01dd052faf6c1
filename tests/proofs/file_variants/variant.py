"""A file of random form, with what must be read from it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np


@dataclass(frozen=True, eq=False)
class Points:
    """``points`` (n, 3) mm, finite; ``colours`` (n, 3) uint8 and ``normals`` (n, 3) of unit length,
    None where the file has none; ``scalars`` (n,): all other numbers by name."""

    points: np.ndarray
    colours: np.ndarray | None = None
    normals: np.ndarray | None = None
    scalars: Mapping[str, np.ndarray] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Variant:
    """A file ``name`` of a ``format``, drawn as ``form`` says.

    ``truth``: what must be read, None for a damaged file. ``extras``: sets of spellings, of each of
    which one must occur in a note, since nothing in the program holds these values. ``reasons``:
    words of which a refusal states one; a refusal without any of them is a wrong reason.
    """

    format: str
    form: str
    name: str
    content: bytes
    truth: Any = None
    extras: Sequence[Sequence[str]] = ()
    reasons: Sequence[str] = ()


@dataclass
class Form:
    """Draws of the form of one file, with the words that describe them."""

    rng: np.random.Generator
    words: list[str] = field(default_factory=list)

    def draw(self, what: str, *options: Any) -> Any:
        """Return one of the options, and note it."""
        chosen = options[int(self.rng.integers(len(options)))]
        self.words.append(f"{what} {chosen!r}")
        return chosen

    def text(self) -> str:
        """All draws in words."""
        return ", ".join(self.words)


def draw_surface(rng: np.random.Generator, size: int = 40) -> Points:
    """Draw a curved patch of size x size points in rows, some 60 mm large, with colours and
    normals, whose coordinates have five decimals."""
    u, v = np.meshgrid(*(np.linspace(-1, 1, size),) * 2)
    a, b = rng.uniform(0.2, 0.6, 2)
    points = np.stack([22 * u, 20 * v, 9 * np.sin(2 * a * u) + 8 * b * v**2], axis=-1)
    points = np.round(points.reshape(-1, 3) + rng.uniform(-60, 60, 3), 5)
    slope_x = 9 * 2 * a * np.cos(2 * a * u) / 22
    slope_y = 16 * b * v / 20
    normals = np.stack([-slope_x, -slope_y, np.ones_like(u)], axis=-1).reshape(-1, 3)
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    low = int(rng.choice([0, 40]))  # a bright part has no level of 0 or 1
    colours = rng.integers(low, 256, (len(points), 3)).astype(np.uint8)
    return Points(points, colours, normals)


UNITS = {
    "mm": 1.0, "millimeters": 1.0, "cm": 10.0, "m": 1000.0, "metres": 1000.0, "in": 25.4,
    "inches": 25.4,
}  # fmt: skip


def draw_unit(form: Form, *short: str) -> tuple[str, float]:
    """Draw a unit that a file states, among the ``short`` ones if any, "" for none, and its mm."""
    unit = form.draw("unit", "", "", *(short or UNITS))
    return unit, UNITS.get(unit, 1.0)


def draw_comment(form: Form, unit: str) -> str:
    """Draw a sentence that states a unit; one of something else where there is none."""
    if not unit:
        return form.draw("comment", "made elsewhere", "taken from 2 m in 1 s", "v 1.0")
    words = ("units: {}", "unit {}", "File units = {}", "all coordinates are in {}", "UNITS={}")
    return form.draw("comment", *words).format(unit)


def draw_shift(form: Form) -> np.ndarray:
    """Draw where the points are (3,) mm: mostly near the origin, at times far in a survey."""
    far = [np.zeros(3)] * 3 + [np.array([85e3, -2e3, 0]), np.array([694123e3, 5155987e3, 85e3])]
    return far[int(form.draw("place", *range(len(far))))]


def list_faces(size: int, corners: int) -> list[list[int]]:
    """Return faces of 3 or 4 corners over rows of size x size points."""
    quads = [
        [i, i + 1, i + size + 1, i + size]
        for row in range(size - 1)
        for i in range(row * size, row * size + size - 1)
    ]
    if corners == 4:
        return quads
    return [face for a, b, c, d in quads for face in ([a, b, c], [a, c, d])]


def end_lines(text: str, end: str) -> bytes:
    """Return a text with lines that end so."""
    return text.replace("\n", end).encode("utf-8")
