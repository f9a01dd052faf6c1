"""Whether every fault of a calibration is named as its cause, and sound calibrations raise no
alarm."""

from collections import Counter, defaultdict
from collections.abc import Callable, Sequence
from functools import partial
from time import perf_counter

from slviewer.calibration.diagnosis.diagnose import DiagnosedCalibration
from slviewer.evaluation.render import Row
from slviewer.pipeline.feedback import Progress, ignore_progress
from slviewer.records.verdict import Cause
from slviewer.simulation.boards import BoardShape
from slviewer.simulation.rig import letter
from slviewer.target.board import Board
from slviewer.validation.faulty_captures import BOARD, FAULTS, POSES, FaultBench
from slviewer.validation.proof import Proof, track

BOARDS = (
    BOARD,
    Board.parse("circles:14x11:13"),
    Board.parse("circles:17x13:11"),
    Board.parse("chessboard:10x7:18"),
)
"""That calibrations without a fault are made from in turn."""


def prove_causes(
    scale: float = 0.5,
    *,
    faults: Sequence[str] = tuple(FAULTS),
    clean: int = 20,
    poses: int = POSES,
    steps: int = 18,
    seed: int = 0,
    progress: Progress = ignore_progress,
) -> Proof:
    """Every fault in turn, then ``clean`` calibrations of different rigs, poses and boards.

    ``scale``: resolution of the camera, as a share of the Letter's. ``poses`` of each rig, captured
    in so many phase ``steps``. A fault passes where the first finding is its cause, a clean
    calibration where there is none.
    """
    bench = FaultBench(letter(scale, seed), count=poses, steps=steps)
    cases: dict[str, tuple[Cause | None, Callable[[], DiagnosedCalibration]]] = {
        name: (FAULTS[name][0], partial(FAULTS[name][1], bench)) for name in faults
    }
    for k in range(clean):
        board, count, rig_seed = BOARDS[k % len(BOARDS)], poses + k % 5, seed + 1 + k
        sound = FaultBench(
            letter(scale, rig_seed), board, count, BoardShape(misplaced_mm=0.01 * (k % 3)), steps
        )
        cases[f"clean, seed {rig_seed}, {board}, {count} poses"] = (
            None,
            partial(_attempt_clean, sound),
        )
    rows: list[Row] = []
    record = []
    confusion: dict[str, Counter[str]] = defaultdict(Counter)
    for name, (cause, attempt), _ in track(progress, cases):
        start = perf_counter()
        verdict = attempt().verdict
        first = next(iter(verdict.causes), "none")
        confusion[cause or "none"][first] += 1
        rows.append({
            "fault": name,
            "cause": cause or "none",
            "named": ", ".join(verdict.causes) or "none",
            "verdict": verdict.level,
            "right": "yes" if first == (cause or "none") else "NO",
            "s": round(perf_counter() - start, 1),
        })  # fmt: skip
        record.append({
            "fault": name, "cause": cause, "causes": list(verdict.causes), "level": verdict.level,
            "reason": verdict.reason,
            "findings": [finding.sentence for finding in verdict.findings],
        })  # fmt: skip
    right = sum(row["right"] == "yes" for row in rows)
    line = f"{right} of {len(rows)} named rightly, at scale {scale:g}"
    return Proof(
        right == len(rows), scale, rows, {"confusion": confusion, "cases": record}, below=[line]
    )


def _attempt_clean(bench: FaultBench) -> DiagnosedCalibration:
    """The diagnosed calibration from captures without a fault."""
    return bench.attempt(bench.examine_clean())
