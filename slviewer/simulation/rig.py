"""A camera and a projector that exist in numbers only, and the preset like the Letter's rig."""

import dataclasses
import tomllib
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from slviewer.errors import InputError
from slviewer.simulation.assets import asset
from slviewer.simulation.lens import SimulatedLens
from slviewer.simulation.waves import random_waves


@dataclass(frozen=True)
class Sensor:
    """How light becomes grey levels; the fields are explained in ``assets/simulation/letter.toml``.

    Noise of one pixel of one frame: variance = read_variance + shot_variance (level - dark_level),
    in grey levels squared, then rounding to 8 bits adds 1/12. It is the same at every scale, so
    that figures can be compared.
    """

    psf_px: float
    dark_level: float
    read_variance: float
    shot_variance: float
    peak_level: float


@dataclass(frozen=True)
class Illumination:
    """The projector's light and the room's, relative to full white on a board that faces the
    projector at its focus."""

    ambient: float
    black: float
    gamma: float
    flicker: float
    blur_px: float
    focus_mm: float
    defocus_px_mm: float


@dataclass(frozen=True, eq=False)
class SimulatedRig:
    """Both lenses, their arrangement X_p = R X_c + t (mm), the sensor and the light; `seed` also
    keys the noise."""

    camera: SimulatedLens
    projector: SimulatedLens
    R: np.ndarray
    t: np.ndarray
    sensor: Sensor
    light: Illumination
    seed: int = 0

    @property
    def rows_per_column(self) -> float:
        """Ratio of the projector's focal lengths in px, vertical over horizontal."""
        return self.projector.focal_px[1] / self.projector.focal_px[0]

    @property
    def projector_centre(self) -> np.ndarray:
        """(3,) mm, in the camera frame."""
        return -self.R.T @ self.t

    def project(self, points: np.ndarray) -> np.ndarray:
        """Projector pixels (..., 2) of camera-frame `points` (..., 3) mm; NaN behind the
        projector."""
        return self.projector.project(np.asarray(points, float) @ self.R.T + self.t)


def check_scale(scale: float) -> None:
    """Raise InputError for a resolution that `letter` does not simulate."""
    if not 0.05 <= scale <= 4:
        raise InputError(
            f"the scale {scale:g} is not between 0.05 and 4", "1 is the full 1600x1200"
        )


def read_preset() -> dict[str, Any]:
    """Return what is known of the Letter's rig."""
    return tomllib.loads(asset("simulation/letter.toml").read_text(encoding="utf-8"))


def letter(
    scale: float = 1.0,
    seed: int = 0,
    *,
    local_distortion_px: float | None = None,
    texture: Literal["coarse", "fine"] = "coarse",
    gamma: float | None = None,
    flicker: float | None = None,
) -> SimulatedRig:
    """A rig like the Letter's: camera 1600x1200 times `scale`, projector 912x1140, baseline 180 mm.

    `seed` draws principal points, focal lengths, distortions, the local distortion's waves and the
    noise. `local_distortion_px` is the rms of each coordinate's displacement in px of each device
    at full resolution (None: the preset's 0.15; 0 switches it off exactly); `texture` its
    wavelengths: 0.3 ... 0.8 of the width, or 0.15 ... 0.4. `gamma` and `flicker` replace the
    preset's (1: a linearised projector; 0: a steady lamp).
    """
    check_scale(scale)
    if local_distortion_px is not None and not 0 <= local_distortion_px <= 5:
        raise InputError(
            f"a local distortion of {local_distortion_px:g} px is not between 0 and 5 px"
        )
    if texture not in ("coarse", "fine"):
        raise InputError(f"the local distortion's texture is coarse or fine, not {texture!r}")
    preset = read_preset()
    streams = np.random.SeedSequence([seed, 0x51]).spawn(3)
    camera, projector = (
        sample_device(stream, preset, name, texture, local_distortion_px)
        for name, stream in zip(("camera", "projector"), streams[:2], strict=True)
    )
    R, t = sample_arrangement(streams[2], preset, "arrangement")
    given = {
        name: value for name, value in (("gamma", gamma), ("flicker", flicker)) if value is not None
    }
    light = Illumination(**preset["light"] | given)
    camera = dataclasses.replace(camera, scale=scale)
    return SimulatedRig(camera, projector, R, t, Sensor(**preset["sensor"]), light, seed)


def sample_device(
    stream: np.random.SeedSequence,
    preset: dict[str, Any],
    name: str,
    texture: str = "coarse",
    rms: float | None = None,
) -> SimulatedLens:
    """Sample a random lens of a preset's device: with Brown distortion and local waves of ``rms``
    px, by default the preset's."""
    rng, device, local = np.random.default_rng(stream), preset[name], preset["local_distortion"]
    rms = local["rms_px"] if rms is None else rms
    width, height = device["size"]
    focal = np.array(device["focal_px"]) * (1 + device["focal_spread"] * rng.uniform(-1, 1))
    middle = np.array([(width - 1) / 2, (height - 1) / 2]) + device["centre_offset_px"]
    centre = middle + device["centre_spread_px"] * rng.uniform(-1, 1, 2)
    spread = np.array(device["distortion_spread"]) * rng.uniform(-1, 1, 5)
    k1, k2, p1, p2, k3 = (np.array(device["distortion"]) + spread).tolist()
    (fx, fy), (cx, cy), size = focal.tolist(), centre.tolist(), (width, height)
    waves = random_waves(rng, size, fy / fx, local["waves"], tuple(local[texture]), rms)
    return SimulatedLens(size, (fx, fy), (cx, cy), (k1, k2, p1, p2, k3), waves)


def sample_arrangement(
    stream: np.random.SeedSequence, preset: dict[str, Any], name: str
) -> tuple[np.ndarray, np.ndarray]:
    """R and t of a preset's arrangement: the device at the baseline's length, its axis through the
    camera's axis at the crossing depth."""
    rng, arrangement = np.random.default_rng(stream), preset[name]
    direction = np.array(arrangement["direction"])
    centre = arrangement["baseline_mm"] * direction / np.linalg.norm(direction)
    roll, pan, nod = np.radians(arrangement["spread_deg"]) * rng.uniform(-1, 1, 3)
    axis = np.array([0, 0, arrangement["crossing_mm"]]) - centre
    axis += np.linalg.norm(axis) * np.array([pan, nod, 0])
    R = look_along(axis, roll + np.radians(arrangement["roll_deg"]))
    return R, -R @ centre


def look_along(axis: np.ndarray, roll: float) -> np.ndarray:
    """(3, 3): R_device_camera of a device that looks along ``axis`` (3,), rolled by rad about
    it."""
    z = axis / np.linalg.norm(axis)
    x = np.cross([-np.sin(roll), np.cos(roll), 0], z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z])
