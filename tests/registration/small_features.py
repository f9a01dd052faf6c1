"""Scans of round, flat and prismatic parts that one small feature holds, with their true pose."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from slviewer.geometry.rigid import motion_jacobian, move_points
from slviewer.registration.pairwise import Registration, register_prepared
from slviewer.registration.scan import prepare_scan
from slviewer.registration.start import Candidate

PARTS = ("lidded", "tube", "cone", "sphere", "plate", "profile")
FEATURES = ("dent", "bump", "key", "corner")


@dataclass(frozen=True)
class Part:
    """A part of 50 mm times ``scale`` with features along its normal.

    ``feature``: dent and bump are Gaussians, key a groove with steep ends, corner an L, whose turn
    is unique. ``depth``: in units of the ``noise``, mm; ``width``: of a Gaussian, mm. ``copies``:
    the feature repeats so many times about the axis, or along the part. ``is_estimated``: normals
    are estimated, instead of those of the part without its feature.
    """

    kind: str = "lidded"
    feature: str = "dent"
    depth: float = 50.0
    width: float = 2.0
    noise: float = 0.03
    scale: float = 1.0
    copies: int = 1
    points: int = 12_000
    place: float = 30.0
    is_estimated: bool = False

    def sample(self, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Points and normals (n, 3) of a scan in the part's frame, mm, and the relief (n,)."""
        rng = np.random.default_rng(seed)
        u, v = rng.uniform(0, 1, (2, self.points))
        relief = np.zeros(self.points)
        if self.kind in ("lidded", "tube", "cone"):
            angle, z = 2 * np.pi * u - np.pi, 50.0 * v
            taper = 0.15 if self.kind == "cone" else 0.0
            radius = 20.0 - taper * z
            out = np.stack([np.cos(angle), np.sin(angle), np.full_like(z, taper)], 1)
            points = np.stack([radius * np.cos(angle), radius * np.sin(angle), z], 1)
            for k in range(self.copies):
                turned = np.angle(np.exp(1j * (angle - 2 * np.pi * k / self.copies)))
                relief += self.relief(turned * radius, z - self.place)
        elif self.kind == "sphere":
            out = rng.normal(size=(self.points, 3))
            out /= np.linalg.norm(out, axis=1, keepdims=True)
            points = 25.0 * out
            for k in range(self.copies):
                side = out * (1 - 2 * k)
                front = side[:, 0] > 0
                relief += np.where(front, self.relief(25 * side[:, 1], 25 * side[:, 2]), 0.0)
        else:
            x, y = 50.0 * u - 25.0, 50.0 * v - 25.0
            tilt = np.zeros_like(x)
            height = np.zeros_like(x)
            if self.kind == "profile":
                height, tilt = 4.0 * np.sin(x / 6.0), 4.0 / 6.0 * np.cos(x / 6.0)
            out = np.stack([-tilt, 0 * x, np.ones_like(x)], 1)
            points = np.stack([x, y, height], 1)
            for k in range(self.copies):
                relief += self.relief(x - 5.0, y - 0.3 * self.place + 20 * k)
        out /= np.linalg.norm(out, axis=1, keepdims=True)
        if self.kind == "lidded":
            count = self.points // 5
            r, angle = 20.0 * np.sqrt(rng.uniform(0, 1, count)), rng.uniform(-np.pi, np.pi, count)
            lid = np.stack([r * np.cos(angle), r * np.sin(angle), np.full(count, 50.0)], 1)
            points, out = (
                np.vstack([points, lid]),
                np.vstack([out, np.tile([0, 0, 1.0], (count, 1))]),
            )
            relief = np.append(relief, np.zeros(count))
        points = points + (relief + rng.normal(0, self.noise, len(points)))[:, None] * out
        return points * self.scale, out, relief * self.scale

    def relief(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Height (n,) mm of the feature, at coordinates (n,) mm about its centre."""
        depth, w = self.depth * self.noise, self.width
        if self.feature in ("dent", "bump"):
            height = np.exp(-(a**2 + b**2) / (2 * w**2))
        else:
            height = ((np.abs(a) < w) & (np.abs(b) < 2.5 * w)).astype(float)
        if self.feature == "corner":
            height += (np.abs(a - 2.5 * w) < 1.5 * w) & (np.abs(b + 1.75 * w) < 0.75 * w)
        return depth * height * (1.0 if self.feature == "bump" else -1.0)


def random_motion(seed: int, size: float) -> np.ndarray:
    """A rotation and shift of any amount, (4, 4)."""
    rng = np.random.default_rng(seed)
    T = np.eye(4)
    T[:3, :3] = Rotation.random(random_state=rng).as_matrix()
    T[:3, 3] = size * rng.normal(size=3)
    return T


@dataclass(frozen=True)
class Outcome:
    """A registration's errors: mm at the feature, over 1 sigma there, and mm at most over the
    part."""

    at_feature_mm: float
    in_sigmas: float
    largest_mm: float


def register_part(
    part: Part, seed: int, T: np.ndarray, start: Candidate | None = None
) -> tuple[Registration, Outcome]:
    """Register a scan, moved by the inverse of ``T`` (4, 4), onto another; the outcome with it."""
    points, normals, relief = part.sample(2 * seed + 1)
    onto, onto_normals, _ = part.sample(2 * seed)
    moved, turned = (points - T[:3, 3]) @ T[:3, :3], normals @ T[:3, :3]
    estimated = part.is_estimated
    scan = prepare_scan("scan", moved, None if estimated else turned, None, has_camera=False)
    reference = prepare_scan(
        "reference", onto, None if estimated else onto_normals, None, has_camera=False
    )
    result = register_prepared(scan, reference, min(scan.size, reference.size), start)
    D = result.T_reference_scan @ np.linalg.inv(T)
    height = np.abs(relief)
    centre = points[height > 0.5 * height.max()].mean(axis=0) if height.any() else points[0]
    shift = float(np.linalg.norm(move_points(D, centre[None]) - centre))
    J = motion_jacobian((centre - result.uncertainty.centre)[None])[0]
    sigma = float(np.sqrt(np.trace(J @ result.uncertainty.covariance @ J.T)))
    largest = float(np.linalg.norm(move_points(D, points) - points, axis=1).max())
    return result, Outcome(shift, shift / sigma, largest)
