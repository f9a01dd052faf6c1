"""What is said of a calibration: good, doubtful or rejected, why, and what to do."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Literal, get_args

Level = Literal["good", "doubtful", "rejected"]
Severity = Literal["note", "doubtful", "rejected"]
"""A note is mended already, as by leaving a pose out; what is doubtful may be used with care; what is rejected may not.
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
    """One cause: ``sentence`` says what was seen, ``remedy`` what to do, ``poses`` where it was seen."""

    cause: Cause
    severity: Severity
    sentence: str
    remedy: str
    poses: tuple[str, ...] = ()

    def text(self) -> str:
        """Both sentences in one."""
        return f"{self.sentence}: {self.remedy}"

    def to_json(self) -> dict[str, Any]:
        """Plain values."""
        return {
            "cause": self.cause,
            "severity": self.severity,
            "sentence": self.sentence,
            "remedy": self.remedy,
            "poses": list(self.poses),
        }

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> "Finding":
        """The inverse of ``to_json``."""
        return cls(data["cause"], data["severity"], data["sentence"], data["remedy"], tuple(data["poses"]))


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
        """The root cause and its remedy; empty where nothing was found."""
        return self.findings[0].text() if self.findings else ""

    def text(self) -> str:
        """For people."""
        lines = [f"verdict: {self.level}"]
        lines += [f"  {finding.severity}: {finding.text()}" for finding in self.findings]
        return "\n".join(lines)

    def to_json(self) -> dict[str, Any]:
        """Plain values."""
        return {"level": self.level, "findings": [finding.to_json() for finding in self.findings]}

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> "Verdict":
        """The inverse of ``to_json``."""
        return cls(tuple(Finding.from_json(finding) for finding in data["findings"]))
