"""What real rigs do to a capture: faults, each at three severities, put where physics puts them.

A fault may change the rig, the scene, the light before the sensor, the sensor's signal, or the frames as they are
recorded: `hostile_light` renders the light, and `expose_frames` makes frames of it.
"""

import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from slviewer.fringe.patterns import profile
from slviewer.fringe.sequence import PatternSequence
from slviewer.simulation import hostile_frames as frame_faults
from slviewer.simulation import hostile_scenes as scene_faults
from slviewer.simulation.film import NORMAL_QUANTILES, digitise
from slviewer.simulation.hostile_frames import Shot
from slviewer.simulation.hostile_scenes import MirrorTable, Pattern
from slviewer.simulation.renderer import Renderer
from slviewer.simulation.rig import SimulatedRig
from slviewer.simulation.scenes import Scene

Severity = Literal["mild", "medium", "severe"]
SEVERITIES: tuple[Severity, ...] = get_args(Severity)
Direction = Literal["scan", "calibration"]
"""Where the fault strikes: scans measured with a sound calibration, or the target poses of the calibration."""

ALL = 1000
"""More poses than any session has."""
_SUBLEVELS = 256  # a 16-bit signal holds so many steps a grey level


@dataclass(frozen=True, eq=False)
class Fault:
    """One fault: what each severity is in ``words``, and the ``causes`` of which one must be named where it does harm.

    Each of the functions takes and gives one stage of a capture, at ``levels[severity]``. ``rig(rig, level, number)``
    and ``scene(scene, level, number)`` of the capture of this number; ``moving(scene, level)``: the scene in each of so
    many equal parts of the capture; ``pattern``: what the projector makes of one; ``light`` and ``signal``: float32
    grey levels (n, h, w), above dark and with dark; ``frames``: uint8 (n, h, w), as they are recorded.

    ``must_measure``: at mild severity the program has to reach the floor. ``struck``: how many of the target poses it
    strikes, at each severity. ``directions``: where it can strike.
    """

    words: tuple[str, str, str]
    levels: tuple[float, float, float]
    causes: frozenset[str]
    must_measure: bool = False
    struck: tuple[int, int, int] = (ALL, ALL, ALL)
    directions: tuple[Direction, ...] = ("scan", "calibration")
    rig: Callable[[SimulatedRig, float, int], SimulatedRig] | None = None
    scene: Callable[[Scene, float, int], Scene] | None = None
    moving: Callable[[Scene, float], Sequence[Scene]] | None = None
    pattern: Callable[[Pattern, float], Pattern] | None = None
    light: Callable[[np.ndarray, float, Shot], np.ndarray] | None = None
    signal: Callable[[np.ndarray, float, Shot], np.ndarray] | None = None
    frames: Callable[[np.ndarray, float, Shot], np.ndarray] | None = None

    def level(self, severity: Severity) -> float:
        """How strong."""
        return self.levels[SEVERITIES.index(severity)]

    @property
    def is_optical(self) -> bool:
        """Whether the light itself has to be rendered anew."""
        return any((self.rig, self.scene, self.moving, self.pattern))


def render_light(
    rig: SimulatedRig, scene: Scene, sequence: PatternSequence, change: Callable[[Pattern], Pattern] = lambda p: p
) -> tuple[np.ndarray, Renderer]:
    """(n, h, w) float32: the light of every frame in grey levels above dark, before any noise; and its renderer."""
    renderer = Renderer(rig, scene)
    patterns = [change(profile(sequence, k)) for k in range(len(sequence.frames))]
    light = np.stack([renderer.light(pattern) for pattern in patterns])
    if isinstance(scene, MirrorTable):
        second = Renderer(scene.second_projector(rig), scene.scene)
        for k, pattern in enumerate(patterns):
            light[k] += np.float32(scene.reflectivity) * second.light(pattern, exposure=renderer.exposure)
    return light, renderer


def hostile_light(
    fault: Fault, severity: Severity, rig: SimulatedRig, scene: Scene, sequence: PatternSequence, number: int
) -> tuple[np.ndarray, Renderer]:
    """As ``render_light``, with what the fault does to the rig, the scene and the patterns.

    Where the scene moves, the renderer is that of the middle of the phase steps of x, which depth comes from.
    """
    level = fault.level(severity)
    rig = fault.rig(rig, level, number) if fault.rig else rig
    scene = fault.scene(scene, level, number) if fault.scene else scene
    change = fault.pattern
    changed = (lambda p: change(p, level)) if change else (lambda p: p)
    places = fault.moving(scene, level) if fault.moving else [scene]
    parts = np.array_split(np.arange(len(sequence.frames)), len(places))
    rendered = [render_light(rig, place, sequence, changed) for place in places]
    light = [light[part] for (light, _), part in zip(rendered, parts, strict=True)]
    steps = [i for i, frame in enumerate(sequence.frames) if (frame.kind, frame.axis) == ("phase", "x")]
    middle = next(k for k, part in enumerate(parts) if steps[len(steps) // 2] in part)
    return np.concatenate(light), rendered[middle][1]


def expose_frames(
    rig: SimulatedRig,
    light: np.ndarray,
    sequence: PatternSequence,
    room: np.ndarray,
    number: int = 0,
    fault: Fault | None = None,
    severity: Severity = "mild",
    seed: int = 0,
) -> np.ndarray:
    """(n, h, w) uint8: what the camera records of the ``light`` (n, h, w), spoilt by the fault.

    ``room`` as ``Renderer.room_light`` gives it. The same ``number`` and ``seed`` give the same noise, fault or not.
    """
    level = fault.level(severity) if fault else 0.0
    name = zlib.crc32(repr(fault.words).encode()) if fault else 0
    shot = Shot(number, sequence, np.random.default_rng([rig.seed, seed, number, name]), room)
    if fault and fault.light:
        light = fault.light(light, level, shot)
    sensor = rig.sensor
    noise = np.array([sensor.dark_level, sensor.read_variance * _SUBLEVELS, sensor.shot_variance]) * _SUBLEVELS
    keys = np.random.default_rng([rig.seed, seed, number, 0xF0]).integers(0, 2**32, (len(light), 2), dtype=np.uint32)
    signal = np.empty(light.shape, np.uint16)
    for k, frame in enumerate(light):
        frame = frame * np.float32(_SUBLEVELS)
        digitise(frame, noise, 255.0 * _SUBLEVELS, NORMAL_QUANTILES, keys[k], signal[k])
    levels = signal.astype(np.float32) / np.float32(_SUBLEVELS)
    if fault and fault.signal:
        levels = fault.signal(levels, level, shot)
    frames = np.rint(np.clip(levels, 0, 255)).astype(np.uint8)
    return fault.frames(frames, level, shot) if fault and fault.frames else frames


_DRIFT = frozenset({"exposure-drift"})
_RIG = frozenset({"residuals", "moved", "motion", "outlier", "other-rig", "uncertain"})

FAULTS: Mapping[str, Fault] = {
    "auto-exposure": Fault(
        ("10 % rms from frame to frame", "20 %", "30 %"),
        (0.1, 0.2, 0.3),
        _DRIFT,
        must_measure=True,
        light=lambda light, rms, shot: frame_faults.scale_frames(
            light, frame_faults.drifting_gains(len(light), rms, shot.rng)
        ),
    ),
    "exposure-loop": Fault(
        ("begins 10 % too bright", "30 %", "60 %"),
        (0.1, 0.3, 0.6),
        _DRIFT | {"saturation"},
        light=lambda light, off, shot: frame_faults.scale_frames(light, frame_faults.exposure_loop_gains(light, off)),
    ),
    "white-balance": Fault(
        ("wanders by 3 %", "8 %", "15 %"), (0.03, 0.08, 0.15), _DRIFT, signal=frame_faults.shift_white_balance
    ),
    "jpeg": Fault(
        ("quality 85", "65", "50"),
        (85, 65, 50),
        frozenset({"jpeg", "noise"}),
        must_measure=True,
        frames=frame_faults.compress_jpeg,
    ),
    "gamma": Fault(
        ("1.8", "2.2", "2.8"), (1.8, 2.2, 2.8), frozenset({"gamma"}), must_measure=True, rig=scene_faults.set_gamma
    ),
    "clipping": Fault(
        ("white at 1.1 x full scale", "1.4 x", "2.5 x"),
        (1.1, 1.4, 2.5),
        frozenset({"saturation"}),
        rig=scene_faults.overexpose,
    ),
    "srgb": Fault(
        ("40 % of the sRGB curve", "70 %", "all of it"),
        (0.4, 0.7, 1.0),
        frozenset({"gamma"}),
        signal=frame_faults.encode_srgb,
    ),
    "flicker": Fault(
        ("bands of 5 %", "10 %", "20 %"),
        (0.05, 0.1, 0.2),
        frozenset({"flicker"}),
        must_measure=True,
        light=frame_faults.add_flicker,
    ),
    "room-flicker": Fault(
        ("5 % of a lamp in the room", "20 %", "60 %"),
        (0.05, 0.2, 0.6),
        frozenset({"flicker", "room-light"}),
        light=frame_faults.add_room_flicker,
    ),
    "frame-lag": Fault(
        ("one image behind", "two", "three"),
        (1, 2, 3),
        frozenset({"frame-lag"}),
        struck=(1, 3, ALL),
        frames=lambda frames, by, shot: frame_faults.delay_frames(frames, int(by)),
    ),
    "dropped-frame": Fault(
        ("a Gray frame lost", "a phase step lost", "both lost"),
        (0, 1, 2),
        frozenset({"missing-frame"}),
        struck=(1, 3, ALL),
        frames=frame_faults.lose_frames,
    ),
    "duplicate-frame": Fault(
        ("a Gray frame repeated", "a phase step", "two phase steps and a Gray frame"),
        (0, 1, 2),
        frozenset({"duplicate-frame", "missing-frame"}),
        struck=(1, 3, ALL),
        frames=frame_faults.repeat_frames,
    ),
    "swapped-frames": Fault(
        ("two Gray frames", "two phase steps", "a phase step and a Gray frame"),
        (0, 1, 2),
        frozenset({"frame-order"}),
        struck=(1, 3, ALL),
        frames=frame_faults.swap_neighbours,
    ),
    "exchanged-axes": Fault(
        ("all frames of x and y", "phase steps alone", "Gray frames alone"),
        (0, 1, 2),
        frozenset({"axes-swapped"}),
        frames=frame_faults.exchange_axis_frames,
    ),
    "reversed-axis": Fault(
        ("columns", "rows", "both"), (0, 1, 2), frozenset({"axis-reversed"}), pattern=scene_faults.reverse_pattern
    ),
    "reversed-bits": Fault(
        ("of x", "of both axes", "of both, complementary bit first"),
        (0, 1, 2),
        frozenset({"bit-order"}),
        frames=frame_faults.reverse_bits,
    ),
    "step-order": Fault(
        ("begins a quarter period late", "runs backwards", "even steps before odd"),
        (0, 1, 2),
        frozenset({"phase-offset", "gray-origin", "step-order"}),
        frames=frame_faults.reorder_steps,
    ),
    "room-light": Fault(
        ("a lamp of 5 % of the projector's light, switched on half way", "15 %", "50 %"),
        (0.05, 0.15, 0.5),
        frozenset({"room-light"}),
        must_measure=True,
        light=frame_faults.switch_lamp_on,
    ),
    "hot-pixels": Fault(
        ("0.1 % hot or dead", "0.5 %", "2 %"),
        (0.001, 0.005, 0.02),
        frozenset(),
        must_measure=True,
        frames=frame_faults.add_hot_pixels,
    ),
    "lens-dust": Fault(
        ("spots of 20 %", "40 %", "70 %"), (0.2, 0.4, 0.7), frozenset({"dark"}), light=frame_faults.add_lens_dust
    ),
    "board-dust": Fault(
        ("1 % of the board", "4 %", "10 %"), (0.01, 0.04, 0.1), frozenset(), scene=scene_faults.dirty_scene
    ),
    "vignetting": Fault(
        ("30 % less in the corners", "60 %", "90 %"),
        (0.3, 0.6, 0.9),
        frozenset({"dark"}),
        light=frame_faults.add_vignetting,
    ),
    "defocus": Fault(
        ("up to 1 px of 400 at one side", "2 px", "4 px"),
        (1, 2, 4),
        frozenset({"dark", "defocus"}),
        light=frame_faults.add_defocus_gradient,
    ),
    "colour-wheel": Fault(
        ("bands of 3 %", "8 %", "15 %"),
        (0.03, 0.08, 0.15),
        frozenset({"flicker", "exposure-drift"}),
        light=frame_faults.add_colour_wheel,
    ),
    "crosstalk": Fault(
        ("2 % of the image before", "6 %", "15 %"),
        (0.02, 0.06, 0.15),
        frozenset({"crosstalk", "frame-lag"}),
        light=frame_faults.add_crosstalk,
    ),
    "dim-projector": Fault(
        ("fringes of 24 grey levels", "12", "6"),
        (24, 12, 6),
        frozenset({"dark", "noise"}),
        rig=scene_faults.dim_projector,
    ),
    "motion": Fault(
        ("0.02 mm within the capture", "0.3 mm", "2 mm"),
        (0.02, 0.3, 2.0),
        frozenset({"moved", "motion"}),
        moving=scene_faults.moving_scenes,
    ),
    "focus-breathing": Fault(
        ("focal length within 0.02 %", "0.1 %", "0.5 %"),
        (0.0002, 0.001, 0.005),
        _RIG,
        directions=("calibration",),
        rig=scene_faults.refocus_camera,
    ),
    "thermal-drift": Fault(
        ("0.02 mrad over eight poses", "0.2 mrad", "1 mrad"),
        (0.02, 0.2, 1.0),
        _RIG,
        directions=("calibration",),
        rig=scene_faults.drift_projector,
    ),
    "knocked-rig": Fault(
        ("projector turned by 0.02 mrad since", "0.5 mrad", "3 mrad"),
        (0.02, 0.5, 3.0),
        _RIG,
        directions=("scan",),
        rig=scene_faults.knock_projector,
    ),
    "flexing-board": Fault(
        ("0.01 mm in each pose", "0.1 mm", "0.5 mm"),
        (0.01, 0.1, 0.5),
        _RIG,
        directions=("calibration",),
        scene=scene_faults.flex_board,
    ),
    "hand": Fault(
        ("reaches 8 mm over it", "35 mm", "80 mm"),
        (8, 35, 80),
        frozenset({"board"}),
        scene=lambda scene, reach, number: scene_faults.with_hand(scene, reach),
    ),
    "mirror-table": Fault(
        ("reflects 4 %", "15 %", "50 %"),
        (0.04, 0.15, 0.5),
        frozenset({"reflection", *_RIG}),
        scene=scene_faults.put_on_table,
    ),
    "second-board": Fault(
        ("60 mm wide, behind", "100 mm", "160 mm"), (60, 100, 160), frozenset(), scene=scene_faults.add_second_board
    ),
}
"""Every fault by name."""
