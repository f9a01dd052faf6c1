"""Verdict on a calibration: good, doubtful or rejected, its causes, and remedies."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Literal, get_args

from slviewer.calibration.splined.residual_noise import Noise
from slviewer.records import to_plain

Level = Literal["good", "doubtful", "rejected"]
Severity = Literal["note", "doubtful", "rejected"]
"""A note is repaired already, as by leaving a pose out; what is doubtful may be used with care; what is rejected may
not.
"""
Cause = Literal[
    "frame-lag",
    "missing-frame",
    "frame-order",
    "bit-order",
    "step-order",
    "phase-offset",
    "gray-origin",
    "gray-cell",
    "dark",
    "saturation",
    "axes-swapped",
    "axis-reversed",
    "fringe-period",
    "projector-size",
    "unreadable",
    "board-size",
    "board-numbering",
    "moved",
    "outlier",
    "gamma",
    "too-few-poses",
    "parallel-poses",
    "empty-corner",
    "uncertain",
    "residuals",
]
CAUSES: tuple[Cause, ...] = get_args(Cause)
"""From what spoils everything that follows to what is only its consequence: a finding explains those after it."""


@dataclass(frozen=True)
class Finding:
    """One cause: ``sentence``: the observation; ``remedy``: what to do; ``poses``: where it was observed."""

    cause: Cause
    severity: Severity
    sentence: str
    remedy: str
    poses: tuple[str, ...] = ()

    def text(self) -> str:
        """Both sentences in one."""
        return f"{self.sentence}: {self.remedy}"


@dataclass(frozen=True)
class Verdict:
    """The findings, the root cause first; without any, the calibration is good."""

    findings: tuple[Finding, ...] = ()

    @classmethod
    def of(cls, findings: Iterable[Finding]) -> "Verdict":
        """Findings in order: what rejects before what is doubtful before notes, causes before their consequences."""
        severities = get_args(Severity)
        ranked = sorted(findings, key=lambda f: (-severities.index(f.severity), CAUSES.index(f.cause)))
        return cls(tuple(ranked))

    @property
    def level(self) -> Level:
        """As bad as the worst finding; notes leave it good."""
        worst = self.findings[0].severity if self.findings else "note"
        return "good" if worst == "note" else worst

    @property
    def causes(self) -> tuple[Cause, ...]:
        """The cause of each finding."""
        return tuple(finding.cause for finding in self.findings)

    @property
    def reason(self) -> str:
        """The root cause and its remedy; empty without findings."""
        return self.findings[0].text() if self.findings else ""

    def text(self) -> str:
        """For people."""
        lines = [f"verdict: {self.level}"]
        lines += [f"  {finding.severity}: {finding.text()}" for finding in self.findings]
        return "\n".join(lines)

    def to_json(self) -> dict[str, Any]:
        """Plain values; the inverse of `records.from_plain`."""
        return {"level": self.level, **to_plain(self)}


DOUBTFUL_RATIO = 4.0
"""Of residuals over predicted noise. On clean rigs, whose lenses bend as no polynomial does, it is 0.5 to 1.1, and 0.8
on real Gray code. A block of 5 by 5 camera pixels whose noise is fully alike, as after demosaicing or compression,
scatters by up to five times what is predicted of independent pixels: in part, as such noise is, by less than four."""
EXPLAINING_CAUSES = ("gamma", "saturation", "moved", "frame-lag", "frame-order", "missing-frame")
REJECTED_RATIO = 25.0
REJECTED_PX = 1.0
"""Beyond both the phases contradict the geometry, whatever the noise: a column more or less than was measured."""


def judge_splined(verdict: Verdict, noise: Noise) -> Verdict:
    """The verdict with what the joint adjustment's residuals add to it; a cause that explains them is known already
    where one of ``EXPLAINING_CAUSES`` was found."""
    ratios: Mapping[str, float] = dict(zip("xy", noise.ratio, strict=True))
    axis = max(ratios, key=lambda name: ratios[name])
    ratio, px = ratios[axis], noise.sample_px["xy".index(axis)]
    if ratio < DOUBTFUL_RATIO:
        return verdict
    known = [finding.cause for finding in verdict.findings if finding.cause in EXPLAINING_CAUSES]
    because = f" (probable cause: {known[0]}, named above)" if known else ""
    rejected = ratio > REJECTED_RATIO and px > REJECTED_PX
    finding = Finding(
        "residuals",
        "rejected" if rejected else "doubtful",
        f"the residuals of the joint adjustment in {axis}, {px:.2f} px, are {ratio:.1f} times the predicted noise"
        f"{because}",
        "see that light, exposure and rig did not change while a pose was captured, that the projector scales nothing, "
        "and that its response is linear; sigmas of clouds are raised by that factor",
    )
    return Verdict.of([*verdict.findings, finding])
