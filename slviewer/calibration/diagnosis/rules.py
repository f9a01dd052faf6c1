"""From evidence to causes: one rule a cause, and none that takes one cause for another.

What spoils the frames comes first, for nothing that follows can be trusted; then what is wrong with their description;
then single poses; then how the poses are spread. A finding that rejects explains whatever could be its consequence.
"""

from collections.abc import Callable, Iterator

from slviewer.calibration.diagnosis.capture_rules import (
    board_size,
    description,
    frame_faults,
    gamma,
    mirrored,
    period,
    rippled,
    saturation,
)
from slviewer.calibration.diagnosis.evidence import Evidence
from slviewer.calibration.diagnosis.poses import single_poses
from slviewer.calibration.diagnosis.spread_rules import corners, parallel, too_few, uncertain
from slviewer.calibration.diagnosis.verdict import Finding, Verdict

Rule = Callable[[Evidence], Iterator[Finding]]

STAGES: tuple[tuple[Rule, ...], ...] = (
    (frame_faults, saturation),
    (mirrored, period, description, board_size),
    (single_poses, gamma, rippled, too_few, parallel, corners, uncertain),
)


def judged(evidence: Evidence) -> Verdict:
    """What is to be said of a calibration, the root cause first."""
    found: list[Finding] = []
    for stage in STAGES:
        found += [finding for rule in stage for finding in rule(evidence)]
        if any(finding.severity == "rejected" for finding in found):
            return Verdict.of(found)
    if evidence.refusal:
        sentence, _, remedy = evidence.refusal.partition(": ")
        remedy = remedy or "take the poses again, and look at each before the next"
        found.append(Finding("residuals", "rejected", sentence, remedy))
    return Verdict.of(found)
