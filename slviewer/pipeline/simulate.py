"""A session filled by the simulated rig, with the truth in a file of its own."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import numpy as np

from slviewer.errors import InputError
from slviewer.fringe.presets import p18
from slviewer.fringe.sequence import PatternSequence, one_axis
from slviewer.inputs import SEED, Input
from slviewer.pipeline.capture_phases import compute_ahead
from slviewer.pipeline.imported_verdict import SIMULATED_TRUTH
from slviewer.pipeline.models import save_imported_stereo
from slviewer.pipeline.operation import Progress, ignore_progress
from slviewer.session.capture import NewCapture
from slviewer.session.ply import write_ply
from slviewer.session.store import Session
from slviewer.simulation.boards import printed_board
from slviewer.simulation.plans import letter_plan, objects, target_poses
from slviewer.simulation.renderer import Renderer
from slviewer.simulation.rig import SimulatedRig, letter
from slviewer.simulation.scenes import Scene
from slviewer.simulation.second_camera import second_camera
from slviewer.simulation.truth import rig_record, scene_record
from slviewer.simulation.turning import stone, turning
from slviewer.target.board import Board

TARGET = "circles:21x16:9"
TRUTH = "truth.json"
"""In the session's folder: read by nothing but what scores a result."""
KINDS = ("pose", "plane", "sphere", "object", "turn")
Preset = Literal["letter", "turn", "pair"]
NOMINAL = "stone.ply"
"""Beside the truth: the surface of what turns, in its own frame, for comparing with."""
MIN_POSES = 3


def simulate(
    session: Path | str,
    *,
    preset: Preset = "letter",
    scale: float = 1.0,
    poses: Annotated[int, Input(0, 1000)] = 25,
    seed: Annotated[int, SEED] = 0,
    progress: Progress = ignore_progress,
) -> list[str]:
    """Fill a new session with captures of a simulated rig: target poses, planes, spheres, an object
    at three depths.

    The preset turn has, besides target poses, the object turned by up to 15 degrees between its
    three depths, and another on a turntable, in twelve steps round.

    Args:
        session: Session folder to make.
        preset: letter: planes, spheres and an object at three depths; turn: an object at three
            depths, and another on a turntable; pair: as letter, seen by two cameras.
        scale: Resolution of the camera, as a share of 1600x1200 px; 0.25 is quick.
        poses: How many target poses.
        seed: Another seed is another rig of the same kind.

    Returns the captures' names: ``pose_XX`` (both axes), ``plane_01`` ... ``plane_10``,
    ``sphere_1`` ... ``sphere_6``, ``object_r1`` ... ``object_r3``, ``turn_01`` ... ``turn_12``
    (axis x).
    """
    if preset not in get_args(Preset):
        raise InputError(
            f"no rig preset is called {preset!r}", f"use {' or '.join(get_args(Preset))}"
        )
    if not MIN_POSES <= poses <= 200:
        raise InputError(f"{poses} target poses cannot be simulated", f"choose {MIN_POSES} to 200")
    board = Board.parse(TARGET)
    rig = letter(scale, seed)
    plan = turn_plan(rig, board, poses) if preset == "turn" else letter_plan(rig, board, poses)
    second = second_camera(rig) if preset == "pair" else None
    both = p18(rig.projector.size)
    truth: dict[str, Any] = {
        "preset": preset,
        "scale": scale,
        "seed": seed,
        "target": TARGET,
        "rig": rig_record(rig),
        **({"second": rig_record(second.rig)} if second else {}),
    }
    numbers = {name: i for i, name in enumerate(plan)}

    def rendered(names: list[str], sequence: PatternSequence) -> Iterator[NewCapture]:
        """One capture after another; the next one is rendered while one is saved."""

        source = f"simulated: {preset}, scale {scale:g}, seed {seed}"

        def render(name: str) -> NewCapture:
            """Return a capture."""
            scene, number = plan[name], numbers[name]
            seen = None
            if second is not None:
                frames = second.capture(scene, sequence, number)
                seen = NewCapture(name, sequence, frames, None, source)
            frames = Renderer(rig, scene).capture(sequence, number)
            return NewCapture(name, sequence, frames, None, source, second=seen)

        for name, capture in compute_ahead(render, names):
            progress(numbers[name] / len(plan), f"rendering {name}")
            yield capture.result()

    with Session.create(session) as store:
        groups = {kind: [n for n in plan if n.startswith(f"{kind}_")] for kind in KINDS}
        scans = [n for n in plan if n not in groups["pose"]]
        store.save_captures(rendered(groups["pose"], both), "calibration", board=board)
        store.save_captures(rendered(scans, one_axis(both, "x")), "scan")
        for kind, names in groups.items():
            if names:
                truth[f"{kind}s"] = {name: scene_record(plan[name]) for name in names}
        (store.folder / TRUTH).write_text(json.dumps(truth, indent=1) + "\n")
        if groups["turn"]:
            vertices, triangles = stone()
            write_ply(store.folder / NOMINAL, vertices, faces=triangles)
    progress(1.0, "simulated")
    return list(plan)


def turn_plan(rig: SimulatedRig, board: Board, poses: int) -> dict[str, Scene]:
    """Return the scenes of the preset "turn", by name of the capture."""
    targets = {
        f"pose_{i:02d}": printed_board(board, pose, seed=rig.seed)
        for i, pose in enumerate(target_poses(rig, board, poses), 1)
    }
    return {**targets, **objects("moved_objects"), **turning()}


def save_true_stereo(store: Session, rig: SimulatedRig, **other: np.ndarray) -> None:
    """Make a simulated rig's true lenses and pose the session's stereo calibration, local
    distortion apart.

    ``other``: matrices K_camera (3, 3), D_camera (5,), K_projector, D_projector, R (3, 3) or T (3,)
    mm that replace the true ones.
    """
    record = rig_record(rig)
    lenses = {
        f"{name}_{device}": np.array(record[device][name])
        for name in "KD"
        for device in ("camera", "projector")
    }
    save_imported_stereo(
        store,
        {**lenses, "R": rig.R, "T": rig.t, **other},
        source=SIMULATED_TRUTH,
        camera=rig.camera.size,
        projector=rig.projector.size,
    )
