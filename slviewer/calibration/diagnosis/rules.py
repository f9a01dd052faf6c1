"""From evidence to causes: one rule a cause, and none that takes one cause for another.

What spoils the frames comes first, for nothing that follows can be trusted; then what is wrong with their description;
then single poses; then how the poses are spread. A finding that rejects explains whatever could be its consequence.
"""

from collections.abc import Callable, Iterator

from slviewer.calibration.diagnosis.capture_rules import (
    find_frame_faults,
    find_gamma,
    find_mirroring,
    find_ripple,
    find_saturation,
    find_wrong_board_size,
    find_wrong_description,
    find_wrong_period,
)
from slviewer.calibration.diagnosis.evidence import Evidence
from slviewer.calibration.diagnosis.poses import find_faulty_poses
from slviewer.calibration.diagnosis.spread_rules import find_corners, find_parallel, find_too_few, find_uncertain
from slviewer.calibration.diagnosis.verdict import Finding, Verdict

Rule = Callable[[Evidence], Iterator[Finding]]

STAGES: tuple[tuple[Rule, ...], ...] = (
    (find_frame_faults, find_saturation),
    (find_mirroring, find_wrong_period, find_wrong_description, find_wrong_board_size),
    (find_faulty_poses, find_gamma, find_ripple, find_too_few, find_parallel, find_corners, find_uncertain),
)


def judge_evidence(evidence: Evidence) -> Verdict:
    """The verdict on a calibration, root cause first."""
    found: list[Finding] = []
    for stage in STAGES:
        found += [finding for rule in stage for finding in rule(evidence)]
        if any(finding.severity == "rejected" for finding in found):
            return Verdict.of(found)
    if evidence.refusal:
        sentence, _, remedy = evidence.refusal.partition(": ")
        remedy = remedy or "capture the poses again, and check each before the next"
        found.append(Finding("residuals", "rejected", sentence, remedy))
    return Verdict.of(found)
