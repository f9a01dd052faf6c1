"""What each target pose says, computed once and kept in the session beside the frames it came from."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from slviewer.calibration.observe import READING, Observation, Smoothing, observe
from slviewer.errors import DetectionError, InputError
from slviewer.fringe.phase import PhaseMap
from slviewer.fringe.sequence import Axis
from slviewer.session.capture import Capture
from slviewer.session.store import Session
from slviewer.target.board import Board
from slviewer.target.detect import detect
from slviewer.workflow.decoding import capture_texture, check_projector, decoded


@dataclass(frozen=True)
class Judged:
    """A pose's observation, or why there is none."""

    name: str
    observation: Observation | None
    refused: str = ""


def judge(
    store: Session,
    capture: Capture,
    frames: np.ndarray,
    phases: dict[Axis, PhaseMap],
    board: Board,
    smoothing: Smoothing,
) -> Judged:
    """Detect the board and read the pose, and keep what was found in the session.

    Raises InputError where the codes contradict the projector's size: that is no fault of one pose.
    """
    check_projector(capture.name, capture.sequence, phases)
    try:
        found = detect(board, capture_texture(capture, frames))
        judged = Judged(capture.name, observe(capture.name, board, found, phases, smoothing))
    except DetectionError as error:
        judged = Judged(capture.name, None, str(error))
    meta = {
        "target": str(board),
        "smoothing": _settings(smoothing),
        "reading": READING,
        "refused": judged.refused,
        "inputs": {capture.name: capture.hash},
    }
    arrays = judged.observation.to_arrays() if judged.observation else {}
    store.save_result(f"poses/{capture.name}", meta, arrays)
    return judged


def known(store: Session, name: str, board: Board, smoothing: Smoothing) -> Judged | None:
    """What ``judge`` kept of a pose, if it was for these frames, this board and this smoothing."""
    result = f"poses/{name}"
    if store.state_of(result) != "fresh":
        return None
    meta = store.load_result(result, only=())[0]
    if (meta["target"], meta["smoothing"], meta.get("reading")) != (str(board), _settings(smoothing), READING):
        return None
    if meta["refused"]:
        return Judged(name, None, meta["refused"])
    return Judged(name, Observation.from_arrays(name, store.load_result(result)[1]))


def judge_all(store: Session, names: Sequence[str], board: Board, smoothing: Smoothing) -> Iterator[Judged]:
    """Every pose in order; frames are read only where a pose is not known yet.

    Raises InputError where poses come from cameras or projectors of different size.
    """
    captures = [store.load_capture(name) for name in names]
    for capture in captures[1:]:
        first = captures[0]
        if (capture.size, capture.sequence.projector) != (first.size, first.sequence.projector):
            raise InputError(
                f"{capture.name} has a {_wxh(capture.size)} camera and a {_wxh(capture.sequence.projector)} projector, "
                f"{first.name} {_wxh(first.size)} and {_wxh(first.sequence.projector)}: "
                "calibrate poses of one rig at one resolution"
            )
    kept = {name: known(store, name, board, smoothing) for name in names}
    fresh = decoded(store, [name for name in names if kept[name] is None])
    for name in names:
        yield kept[name] or judge(store, *next(fresh), board, smoothing)


def load_observations(store: Session, names: Sequence[str]) -> list[Observation]:
    """Observations that the session keeps, of poses by name."""
    found = []
    for name in names:
        if store.state_of(f"poses/{name}") != "absent":
            meta, arrays = store.load_result(f"poses/{name}")
            if not meta["refused"]:
                found.append(Observation.from_arrays(name, arrays))
    return found


def _settings(smoothing: Smoothing) -> list[str | int]:
    return [smoothing.kind] if smoothing.kind == "spline" else [smoothing.kind, smoothing.degree]


def _wxh(size: tuple[int, int]) -> str:
    return f"{size[0]}x{size[1]}"
