"""Evidence of one target pose, computed once and stored in the session as `evidence/<name>`."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from slviewer.calibration.diagnosis.evidence import PoseEvidence
from slviewer.calibration.diagnosis.frames import (
    fit_mean_turn,
    measure_axis,
    measure_motion_px,
    measure_white_delay,
)
from slviewer.calibration.diagnosis.numbering import detect_grid_size
from slviewer.calibration.observe import Observation, pitch_px
from slviewer.fringe.phase import PhaseMap
from slviewer.fringe.sequence import Axis, PatternSequence
from slviewer.records.plain import to_plain
from slviewer.records.verdict import Examination
from slviewer.session.capture import Capture
from slviewer.session.store import Session
from slviewer.target.board import Board
from slviewer.target.detect import Detection, board_mask

EVIDENCE_VERSION = 4
"""Version of the examination; evidence that was stored by another version is computed again."""


@dataclass(frozen=True, eq=False)
class DecodedPose:
    """The frames (n, h, w) of a target pose with what they were decoded to; ``texture`` (h, w) or
    (h, w, 3) uint8 shows the board."""

    name: str
    sequence: PatternSequence
    frames: np.ndarray
    phases: Mapping[Axis, PhaseMap]
    texture: np.ndarray
    board: Board


def gather_evidence(
    pose: DecodedPose,
    examination: Examination,
    detection: Detection | None,
    observation: Observation | None,
    refused: str = "",
) -> PoseEvidence:
    """Evidence from a decoded pose. ``detection`` and ``observation``: its board and its phase,
    None where they could not be read, for the reason ``refused``; ``examination``: of its frames.
    """
    sequence, frames, board = pose.sequence, pose.frames, pose.board
    on_board = board_mask(board, detection, pose.texture.shape) if detection is not None else None
    return PoseEvidence(
        name=pose.name,
        refused=refused,
        grid=detect_grid_size(board, pose.texture) if detection is None else None,
        axes={
            axis: measure_axis(sequence, frames, phase, on_board)
            for axis, phase in pose.phases.items()
        },
        findings=examination.findings,
        displaced=measure_white_delay(sequence, frames),
        moved_px=(
            np.nan
            if detection is None
            else measure_motion_px(
                sequence, frames, detection.pixels, float(np.median(pitch_px(board, detection)))
            )
        ),
        turn=(
            None
            if observation is None
            else fit_mean_turn(observation.camera, observation.projector)
        ),
    )


def save_evidence(store: Session, capture: Capture, board: Board, evidence: PoseEvidence) -> None:
    """Save the evidence of a pose in the session."""
    meta = {
        "target": str(board),
        "look": EVIDENCE_VERSION,
        "evidence": to_plain(evidence),
        "inputs": {capture.name: capture.hash},
    }
    store.save_result(f"evidence/{capture.name}", meta, {})


def load_evidence(store: Session, name: str, board: Board) -> PoseEvidence | None:
    """Load the stored evidence of a pose; None where it is missing, or of other frames or another
    board."""

    def decode(meta: Mapping[str, Any], _: object) -> PoseEvidence | None:
        """Return the evidence, unless it is of another board or version."""
        current = (meta["target"], meta.get("look")) == (str(board), EVIDENCE_VERSION)
        return PoseEvidence.from_json(meta["evidence"]) if current else None

    return store.decode_fresh(f"evidence/{name}", decode, only=())
