"""Reported situations with variants: the right value, or a refusal whose remedy leads to it."""

from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory

from slviewer.pipeline.operation import Progress, track
from tests.proofs.proof import Proof
from tests.proofs.report_cases import (
    boards,
    calibration,
    captures,
    clouds,
    focus,
    models,
    parts,
)
from tests.proofs.report_cases.case import Case, Outcome, Workplace

FIELDS = (boards, calibration, captures, clouds, focus, models, parts)
CASES: Mapping[str, Case] = {name: case for field in FIELDS for name, case in field.CASES.items()}
"""Of each report and variant, what rebuilds and judges it."""


def rebuild_report(name: str, shared: Path) -> Outcome:
    """Rebuild one report in a folder of its own below ``shared``, where cases keep what they
    share."""
    with TemporaryDirectory(dir=shared) as folder:
        return CASES[name](Workplace(Path(folder), shared))


def prove_reports(scale: float, seed: int, progress: Progress) -> Proof:
    """Rebuild every report; ``scale`` and ``seed`` change nothing: each is small and fixed."""
    outcomes: dict[str, Outcome] = {}
    with TemporaryDirectory() as shared:
        for name, _, _ in track(progress, CASES):
            outcomes[name] = rebuild_report(name, Path(shared))
    rows = [
        {"report": name, "measured": it.measured, "truth": it.truth, "": "" if it.holds else "FAIL"}
        for name, it in outcomes.items()
    ]
    held = sum(it.holds for it in outcomes.values())
    summary = f"{held} of {len(outcomes)} reports give the right value, or a remedy that does"
    record = {"reports": {name: vars(it) for name, it in outcomes.items()}}
    return Proof(held == len(outcomes), scale, rows, record, below=[summary])
