"""The observation of each target pose, computed once and stored in the session with its frames."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from slviewer.calibration.diagnosis.evidence import PoseEvidence
from slviewer.calibration.observe import READING_VERSION, Observation, Smoothing, observe
from slviewer.errors import DamagedError, InputError
from slviewer.fringe.phase import PhaseMap
from slviewer.fringe.sequence import Axis
from slviewer.pipeline.capture_phases import (
    capture_texture,
    check_capture,
    decode_capture,
    read_ahead,
)
from slviewer.pipeline.examination import examine_frames, load_or_save_examination
from slviewer.pipeline.pose_evidence import (
    DecodedPose,
    gather_evidence,
    load_evidence,
    save_evidence,
)
from slviewer.records.verdict import Examination
from slviewer.session.capture import Capture
from slviewer.session.store import Session
from slviewer.target.board import Board
from slviewer.target.detect import Detection, detect


@dataclass(frozen=True)
class Judged:
    """A pose's observation, or None and the reason (``refused``)."""

    name: str
    observation: Observation | None
    refused: str = ""
    evidence: PoseEvidence | None = None


def read_pose(
    pose: DecodedPose,
    smoothing: Smoothing,
    examine: bool = False,
    examined: Callable[[], Examination] | None = None,
    observed: Callable[[Observation], None] = lambda observation: None,
) -> Judged:
    """Return the observation of a decoded target pose, or the reason why there is none.

    ``examine``: with the evidence of its frames, which ``examined`` returns (computed if
    None). ``observed`` is called with the observation before the frames are checked, after which
    the pose may still be refused.
    """
    name, sequence, frames, phases = pose.name, pose.sequence, pose.frames, pose.phases
    detection: Detection | None = None
    observation: Observation | None = None
    refused = ""
    try:
        detection = detect(pose.board, pose.texture)
        observation = observe(name, pose.board, detection, phases, smoothing)
        observed(observation)
    except InputError as error:
        refused = str(error).removeprefix(f"{name}: ")
    checked = (examined or partial(examine_frames, sequence, frames))() if examine else None
    if observation is not None:
        try:
            check_capture(name, sequence, frames, phases, checked)
        except InputError as error:
            refused = str(error).removeprefix(f"{name}: ")
    evidence = None
    if checked is not None:
        evidence = gather_evidence(pose, checked, detection, observation, refused)
    return Judged(name, None if refused else observation, refused, evidence)


def read_stored_pose(
    store: Session,
    capture: Capture,
    frames: np.ndarray,
    phases: dict[Axis, PhaseMap],
    board: Board,
    smoothing: Smoothing,
    examine: bool = False,
    observed: Callable[[Observation], None] = lambda observation: None,
) -> Judged:
    """Read the pose as ``read_pose`` does, and save the result and the check of the frames in the
    session."""
    pose = DecodedPose(
        capture.name, capture.sequence, frames, phases, capture_texture(capture, frames), board
    )
    examined = partial(load_or_save_examination, store, capture, frames)
    judged = read_pose(pose, smoothing, examine, examined, observed)
    if judged.evidence is not None:
        save_evidence(store, capture, board, judged.evidence)
    meta = {
        "target": str(board),
        "smoothing": _list_settings(smoothing),
        "reading": READING_VERSION,
        "refused": judged.refused,
        "inputs": {capture.name: capture.hash},
    }
    arrays = judged.observation.to_arrays() if judged.observation else {}
    store.save_result(f"poses/{capture.name}", meta, arrays)
    return judged


def load_judged(store: Session, name: str, board: Board, smoothing: Smoothing) -> Judged | None:
    """Load the stored reading of a pose; None where it is of other frames, another board or another
    smoothing."""

    def decode(meta: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> Judged | None:
        """Return the reading, unless it is of another board, smoothing or version."""
        settings = (meta["target"], meta["smoothing"], meta.get("reading"))
        if settings != (str(board), _list_settings(smoothing), READING_VERSION):
            return None
        return Judged(name, _decode_observation(name, meta, arrays), meta["refused"])

    return store.decode_fresh(f"poses/{name}", decode)


def read_stored_poses(
    store: Session,
    names: Sequence[str],
    board: Board,
    smoothing: Smoothing,
    examine: bool = False,
    observed: Callable[[Observation], None] = lambda observation: None,
) -> Iterator[Judged]:
    """Yield every pose in order; frames are read only where no stored result is valid. Damaged
    frames refuse the pose.

    ``examine``: each with the evidence of its frames; ``observed`` as in ``read_pose``. Raises
    InputError where poses come from cameras or projectors of different size.
    """
    captures = [store.load_capture(name) for name in names]
    for capture in captures[1:]:
        first = captures[0]
        if (capture.size, capture.sequence.projector) != (first.size, first.sequence.projector):
            raise InputError(
                f"{capture.name} has a {_wxh(capture.size)} camera and a"
                f" {_wxh(capture.sequence.projector)} projector, {first.name} {_wxh(first.size)}"
                f" and {_wxh(first.sequence.projector)}: calibrate poses of one rig at one"
                " resolution"
            )
    cached = {name: load_judged(store, name, board, smoothing) for name in names}
    if examine:
        for name, judged in cached.items():
            evidence = load_evidence(store, name, board)
            cached[name] = replace(judged, evidence=evidence) if judged and evidence else None
    ahead = read_ahead([capture for capture in captures if cached[capture.name] is None])
    for name in names:
        judged = cached[name]
        if judged is None:
            capture, frames = next(ahead)
            try:
                phases = decode_capture(capture, frames.result())
                judged = read_stored_pose(
                    store, capture, frames.result(), phases, board, smoothing, examine, observed
                )
            except DamagedError as error:
                judged = Judged(name, None, str(error).removeprefix(f"{name}: "))
            del frames  # before the next are waited for
        yield judged


def load_observations(store: Session, names: Sequence[str]) -> list[Observation]:
    """Load the stored observations of the named poses."""
    observations = []
    for name in names:
        if store.has_result(f"poses/{name}"):
            observation = store.decode_result(f"poses/{name}", partial(_decode_observation, name))
            observations += [] if observation is None else [observation]
    return observations


def _decode_observation(
    name: str, meta: Mapping[str, Any], arrays: Mapping[str, np.ndarray]
) -> Observation | None:
    """Return the observation in a stored reading; None where the pose was refused."""
    return None if meta["refused"] else Observation.from_arrays(name, arrays)


def _list_settings(smoothing: Smoothing) -> list[str | int]:
    """Return the smoothing as plain values, to compare with stored ones."""
    return [smoothing.kind] if smoothing.kind == "spline" else [smoothing.kind, smoothing.degree]


def _wxh(size: tuple[int, int]) -> str:
    """Format a size (width, height) px as "WxH"."""
    return f"{size[0]}x{size[1]}"
