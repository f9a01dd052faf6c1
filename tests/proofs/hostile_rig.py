"""What real rigs do to a capture: faults, each at three severities, put where physics puts them.

A fault may change the rig, the scene, the light before the sensor, the sensor's signal, or the
frames as they are recorded: `hostile_light` renders the light, and `expose_frames` makes frames of
it.
"""

import tomllib
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal, TypeVar, get_args

import numpy as np

from slviewer.fringe.patterns import profile
from slviewer.fringe.sequence import PatternSequence
from slviewer.geometry.jit import run_rows
from slviewer.simulation.assets import asset
from slviewer.simulation.film import NORMAL_QUANTILES, digitise
from slviewer.simulation.renderer import Renderer
from slviewer.simulation.rig import SimulatedRig
from slviewer.simulation.scenes import Scene
from tests.proofs import hostile_frames as frame_faults
from tests.proofs import hostile_scenes as scene_faults
from tests.proofs.hostile_frames import Frames, Shot
from tests.proofs.hostile_scenes import CleanScene, MirrorTable, Pattern

T = TypeVar("T")
Severity = Literal["mild", "medium", "severe"]
SEVERITIES: tuple[Severity, ...] = get_args(Severity)
Direction = Literal["scan", "calibration"]
"""Where the fault strikes: scans measured with a sound calibration, or the target poses of the
calibration."""

ALL = 1000
"""More poses than any session has."""
_OPTICAL = {"rig", "scene", "moving", "pattern"}
_STAGES = _OPTICAL | {"light", "signal", "frames"}
_SUBLEVELS = 256  # a 16-bit signal holds so many steps a grey level


@dataclass(frozen=True, eq=False)
class Fault:
    """One fault: what each severity is in ``words``, and the ``causes`` of which one must be named
    where it does harm.

    Each of the functions in ``stages`` takes and gives one stage of a capture, at
    ``levels[severity]``. ``rig(rig, level, number)`` and ``scene(scene, level, number)`` of the
    capture of this number; ``moving([scene], level)``: the scene in each of so many equal parts of
    the capture; ``pattern(pattern, level)``: what the projector makes of one; ``light(light, level,
    shot)`` and ``signal(levels, level, shot)``: float32 grey levels (n, h, w), above dark and with
    dark; ``frames(frames, level, shot)``: uint8 (n, h, w), as they are recorded.

    ``must_measure``: at mild severity the program has to reach the floor. ``struck``: how many of
    the target poses it strikes, at each severity. ``directions``: where it can strike.
    """

    words: tuple[str, str, str]
    levels: tuple[float, float, float]
    causes: frozenset[str]
    stages: Mapping[str, Callable[..., Any]]
    must_measure: bool = False
    struck: tuple[int, int, int] = (ALL, ALL, ALL)
    directions: tuple[Direction, ...] = ("scan", "calibration")

    def apply(self, stage: str, value: T, severity: Severity, *context: object) -> T:
        """A stage of a capture with the fault; as it is where the fault is of other stages."""
        if stage in self.stages:
            level = self.levels[SEVERITIES.index(severity)]
            value = self.stages[stage](value, level, *context)
        return value

    @property
    def is_optical(self) -> bool:
        """Whether the fault changes the light, which has to be rendered again."""
        return not self.stages.keys().isdisjoint(_OPTICAL)


SOUND = Fault(("", "", ""), (0.0, 0.0, 0.0), frozenset(), {})
"""No fault."""


def render_light(
    rig: SimulatedRig,
    scene: Scene,
    sequence: PatternSequence,
    change: Callable[[Pattern], Pattern] = lambda p: p,
) -> tuple[Frames, Renderer]:
    """(n, h, w) float32: the light of every frame in grey levels above dark, before any noise; and
    its renderer."""
    renderer = Renderer(rig, scene)
    patterns = [change(profile(sequence, k)) for k in range(len(sequence.frames))]
    light = np.stack([renderer.light(pattern) for pattern in patterns])
    if isinstance(scene, MirrorTable):
        second, exposure = Renderer(scene.second_projector(rig), scene.scene), renderer.exposure
        mirrored = np.stack([second.light(pattern, exposure=exposure) for pattern in patterns])
        light += np.float32(scene.reflectivity) * mirrored
    return light, renderer


def hostile_light(
    fault: Fault,
    severity: Severity,
    rig: SimulatedRig,
    scene: CleanScene,
    sequence: PatternSequence,
    number: int,
) -> tuple[Frames, Renderer]:
    """Render the light as ``render_light``, with the fault's effects on rig, scene and patterns.

    Where the scene moves, the renderer is that of the middle of the phase steps of x, which depth
    comes from.
    """
    rig = fault.apply("rig", rig, severity, number)
    places = fault.apply("moving", [fault.apply("scene", scene, severity, number)], severity)
    parts = np.array_split(np.arange(len(sequence.frames)), len(places))
    rendered = [
        render_light(
            rig, place, sequence, lambda pattern: fault.apply("pattern", pattern, severity)
        )
        for place in places
    ]
    light = [light[part] for (light, _), part in zip(rendered, parts, strict=True)]
    steps = [
        i for i, frame in enumerate(sequence.frames) if (frame.kind, frame.axis) == ("phase", "x")
    ]
    middle = next(k for k, part in enumerate(parts) if steps[len(steps) // 2] in part)
    return np.concatenate(light), rendered[middle][1]


def expose_frames(
    renderer: Renderer,
    light: Frames,
    sequence: PatternSequence,
    number: int = 0,
    fault: Fault = SOUND,
    severity: Severity = "mild",
    seed: int = 0,
) -> Frames:
    """(n, h, w) uint8: frames that the renderer's camera records of the ``light`` (n, h, w), with
    the fault applied.

    The same ``number`` and ``seed`` give the same noise, fault or not.
    """
    name = 0 if fault is SOUND else zlib.crc32(repr(fault.words).encode())
    sensor, noise_seed = renderer.rig.sensor, [renderer.rig.seed, seed, number]
    rng = np.random.default_rng([*noise_seed, name])
    shot = Shot(sequence, rng, renderer.room_light())
    light = fault.apply("light", light, severity, shot)
    noise = (
        np.array([sensor.dark_level, sensor.read_variance * _SUBLEVELS, sensor.shot_variance])
        * _SUBLEVELS
    )
    keys = np.random.default_rng([*noise_seed, 0xF0]).integers(
        0, 2**32, (len(light), 2), dtype=np.uint32
    )
    signal = np.empty(light.shape, np.uint16)
    for k, frame in enumerate(light):
        frame = frame * np.float32(_SUBLEVELS)
        run_rows(
            digitise,
            len(frame),
            frame,
            noise,
            255.0 * _SUBLEVELS,
            NORMAL_QUANTILES,
            keys[k],
            signal[k],
        )
    levels = signal.astype(np.float32) / np.float32(_SUBLEVELS)
    levels = fault.apply("signal", levels, severity, shot)
    frames = np.rint(np.clip(levels, 0, 255)).astype(np.uint8)
    return fault.apply("frames", frames, severity, shot)


def _load_fault(row: dict[str, Any]) -> Fault:
    """The fault of a table of ``faults.toml``, in which a stage is the name of a function of this
    package."""
    names = {stage: row.pop(stage) for stage in _STAGES & row.keys()}
    stages = {
        stage: getattr(scene_faults, name, None) or getattr(frame_faults, name)
        for stage, name in names.items()
    }
    values = {"words": tuple(row["words"]), "causes": frozenset(row["causes"]), "stages": stages}
    return Fault(**row | values)


_TABLE = tomllib.loads(asset("simulation/faults.toml").read_text(encoding="utf-8"))
FAULTS: Mapping[str, Fault] = {name: _load_fault(row) for name, row in _TABLE.items()}
"""Every fault by name; what its severities are stands in ``assets/simulation/faults.toml``."""
