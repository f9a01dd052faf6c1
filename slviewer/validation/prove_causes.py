"""Whether every fault of a calibration is called by its name, and clean ones by none."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from time import perf_counter
from typing import Any

from slviewer.calibration.diagnosis.attempt import Attempt
from slviewer.calibration.diagnosis.verdict import Cause
from slviewer.evaluation.render import render
from slviewer.pipeline.feedback import Progress, ignore_progress
from slviewer.simulation.boards import BoardShape
from slviewer.simulation.rig import letter
from slviewer.target.board import Board
from slviewer.validation.faulty_captures import BOARD, FAULTS, POSES, FaultBench

BOARDS = (BOARD, Board.parse("circles:14x11:13"), Board.parse("circles:17x13:11"), Board.parse("chessboard:10x7:18"))
"""That clean calibrations are made from in turn."""


@dataclass(frozen=True)
class CauseCase:
    """One fault: the ``cause`` that must be named first (None: none must be), and the ``attempt`` that it spoilt."""

    name: str
    cause: Cause | None
    attempt: Attempt
    seconds: float

    @property
    def named(self) -> bool:
        """Whether the first finding is the true cause; of a clean calibration, whether there is none."""
        causes = self.attempt.verdict.causes
        return causes[:1] == (self.cause,) if self.cause else not causes


@dataclass(frozen=True)
class CauseProof:
    """What came of all faults."""

    cases: tuple[CauseCase, ...]
    scale: float

    @property
    def holds(self) -> bool:
        """Whether every cause was named, and no clean calibration alarmed."""
        return all(case.named for case in self.cases)

    def confusion(self) -> dict[str, dict[str, int]]:
        """{true cause: {cause named first: how often}}; 'none' stands for no finding."""
        table: dict[str, dict[str, int]] = {}
        for case in self.cases:
            row = table.setdefault(case.cause or "none", {})
            named = next(iter(case.attempt.verdict.causes), "none")
            row[named] = row.get(named, 0) + 1
        return table

    def text(self) -> str:
        """For people: a line a case."""
        table: list[dict[str, Any]] = [
            {
                "fault": case.name,
                "cause": case.cause or "none",
                "named": ", ".join(case.attempt.verdict.causes) or "none",
                "verdict": case.attempt.verdict.level,
                "right": "yes" if case.named else "NO",
                "s": round(case.seconds, 1),
            }
            for case in self.cases
        ]
        right = sum(case.named for case in self.cases)
        return f"{render(table)}\n{right} of {len(self.cases)} named rightly, at scale {self.scale:g}"

    def to_json(self) -> dict[str, Any]:
        """Plain values."""
        return {
            "scale": self.scale,
            "holds": self.holds,
            "confusion": self.confusion(),
            "cases": [
                {
                    "fault": case.name,
                    "cause": case.cause,
                    "causes": list(case.attempt.verdict.causes),
                    "level": case.attempt.verdict.level,
                    "reason": case.attempt.verdict.reason,
                }
                for case in self.cases
            ],
        }


def prove_causes(
    scale: float = 0.5,
    *,
    faults: Sequence[str] = tuple(FAULTS),
    clean: int = 20,
    poses: int = POSES,
    steps: int = 18,
    seed: int = 0,
    progress: Progress = ignore_progress,
) -> CauseProof:
    """Every fault in turn, then ``clean`` calibrations of different rigs, poses and boards.

    ``scale``: resolution of the camera, as a share of the Letter's. ``poses`` of each rig, captured in so many phase
    ``steps``.
    """
    cases: list[CauseCase] = []
    total = len(faults) + clean
    bench = FaultBench(letter(scale, seed), count=poses, steps=steps)
    for name in faults:
        progress(len(cases) / total, name)
        cause, fault = FAULTS[name]
        begun = perf_counter()
        attempt = fault(bench)
        cases.append(CauseCase(name, cause, attempt, perf_counter() - begun))
    for name, attempt, seconds in _clean(scale, clean, poses, steps, seed):
        cases.append(CauseCase(name, None, attempt, seconds))
        progress(len(cases) / total, name)
    progress(1.0, "proven")
    return CauseProof(tuple(cases), scale)


def _clean(scale: float, count: int, poses: int, steps: int, seed: int) -> Iterator[tuple[str, Attempt, float]]:
    for k in range(count):
        begun = perf_counter()
        board = BOARDS[k % len(BOARDS)]
        bench = FaultBench(
            letter(scale, seed + 1 + k), board, poses + k % 5, BoardShape(misplaced_mm=0.01 * (k % 3)), steps
        )
        yield (
            f"clean, seed {seed + 1 + k}, {board}, {bench.count} poses",
            bench.attempt(bench.examine_all()),
            perf_counter() - begun,
        )
