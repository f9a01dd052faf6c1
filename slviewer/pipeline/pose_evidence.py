"""What one target pose says of itself, computed once and kept in the session as `evidence/<name>`."""

from collections.abc import Mapping

import numpy as np

from slviewer.calibration.diagnosis.evidence import PoseEvidence
from slviewer.calibration.diagnosis.frames import fit_mean_turn, measure_axis, measure_motion_px, measure_white_delay
from slviewer.calibration.diagnosis.numbering import detect_grid_size
from slviewer.calibration.observe import Observation, pitch_px
from slviewer.fringe.phase import PhaseMap
from slviewer.fringe.sequence import Axis, PatternSequence
from slviewer.pipeline.frame_check import FrameCheck
from slviewer.records import to_plain
from slviewer.session.capture import Capture
from slviewer.session.store import Session
from slviewer.target.board import Board
from slviewer.target.detect import Detection, board_mask

LOOK = 3
"""How poses are examined; what a session keeps of another look is looked at anew."""


def examine(
    name: str,
    sequence: PatternSequence,
    frames: np.ndarray,
    phases: Mapping[Axis, PhaseMap],
    board: Board,
    texture: np.ndarray,
    check: FrameCheck,
    found: Detection | None,
    seen: Observation | None,
    refused: str = "",
) -> PoseEvidence:
    """What the decoded frames (n, h, w) of a pose say. ``found`` and ``seen``: its board and its phase, where they
    could be read; ``refused``: why not; ``check``: of its frames.
    """
    on_board = board_mask(board, found, texture.shape) if found is not None else None
    suspects = {suspect.frame: suspect for suspect in check.suspects}
    return PoseEvidence(
        name=name,
        refused=refused,
        grid=detect_grid_size(board, texture) if found is None else None,
        axes={axis: measure_axis(sequence, frames, phase, on_board) for axis, phase in phases.items()},
        suspects=tuple(suspects[i] for i in sorted(suspects)),
        displaced=measure_white_delay(sequence, frames),
        moved_px=np.nan
        if found is None
        else measure_motion_px(sequence, frames, found.pixels, float(np.median(pitch_px(board, found)))),
        turn=None if seen is None else fit_mean_turn(seen.camera, seen.projector),
        contradictions=check.contradictions if refused else (),
    )


def keep_evidence(store: Session, capture: Capture, board: Board, evidence: PoseEvidence) -> None:
    """Keep it in the session."""
    meta = {
        "target": str(board),
        "look": LOOK,
        "evidence": to_plain(evidence),
        "inputs": {capture.name: capture.hash},
    }
    store.save_result(f"evidence/{capture.name}", meta, {})


def known_evidence(store: Session, name: str, board: Board) -> PoseEvidence | None:
    """What is kept of a pose, if it is for these frames and this board."""
    result = f"evidence/{name}"
    if store.state_of(result) != "fresh":
        return None
    meta = store.load_result(result, only=())[0]
    if (meta["target"], meta.get("look")) != (str(board), LOOK):
        return None
    return PoseEvidence.from_json(meta["evidence"])
