"""Verdict on a calibration: good, doubtful or rejected, with causes and remedies."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Literal, get_args

from slviewer.calibration.splined.residual_noise import Noise
from slviewer.records.plain import to_plain

Level = Literal["good", "doubtful", "rejected"]
Severity = Literal["note", "doubtful", "rejected"]
"""note: repaired already, as by excluding a pose; doubtful: may be used with care; rejected: must
not be used."""
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
"""From root causes to their consequences: a finding may explain those of later causes."""


@dataclass(frozen=True)
class Finding:
    """A detected fault: its cause and severity, the observation (``sentence``), the ``remedy``, and
    the poses."""

    cause: Cause
    severity: Severity
    sentence: str
    remedy: str
    poses: tuple[str, ...] = ()

    def text(self) -> str:
        """Return observation and remedy in one line."""
        return f"{self.sentence}: {self.remedy}"


@dataclass(frozen=True)
class Verdict:
    """The findings, the root cause first; without any, the calibration is good."""

    findings: tuple[Finding, ...] = ()

    @classmethod
    def of(cls, findings: Iterable[Finding]) -> "Verdict":
        """Return the verdict of findings sorted by severity, the worst first, then by cause, root
        causes first."""
        severities = get_args(Severity)
        ranked = sorted(
            findings, key=lambda f: (-severities.index(f.severity), CAUSES.index(f.cause))
        )
        return cls(tuple(ranked))

    @property
    def level(self) -> Level:
        """Severity of the worst finding; a verdict with notes only is good."""
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
        """Return a report of several lines for the terminal."""
        lines = [f"verdict: {self.level}"]
        lines += [f"  {finding.severity}: {finding.text()}" for finding in self.findings]
        return "\n".join(lines)

    def to_json(self) -> dict[str, Any]:
        """Return plain values, which `records.from_plain` reads back."""
        return {"level": self.level, **to_plain(self)}


DOUBTFUL_RATIO = 4.0
"""Ratio of residuals to predicted noise. It is 0.5 to 1.1 on clean simulated rigs with local
distortion, and 0.8 on real Gray code. Noise that is correlated between pixels, as after demosaicing
or compression, raises it to less than 4: it would be 5 if the 5 by 5 camera pixels of a block had
identical noise."""
EXPLAINING_CAUSES = ("gamma", "saturation", "moved", "frame-lag", "frame-order", "missing-frame")
REJECTED_RATIO = 25.0
REJECTED_PX = 1.0
"""Beyond both limits the phases contradict the geometry, whatever the noise."""


def judge_splined(verdict: Verdict, noise: Noise) -> Verdict:
    """Return the verdict with a finding added where the joint adjustment's residuals exceed their
    predicted noise.

    The finding names the first of ``EXPLAINING_CAUSES`` among the others as its probable cause.
    """
    ratio, px, axis = max(zip(noise.ratio, noise.sample_px, "xy", strict=True))
    if ratio < DOUBTFUL_RATIO:
        return verdict
    known = [finding.cause for finding in verdict.findings if finding.cause in EXPLAINING_CAUSES]
    because = f" (probable cause: {known[0]}, named above)" if known else ""
    finding = Finding(
        "residuals",
        "rejected" if ratio > REJECTED_RATIO and px > REJECTED_PX else "doubtful",
        f"the residuals of the joint adjustment in {axis}, {px:.2f} px, are {ratio:.1f} times the"
        f" predicted noise{because}",
        "see that light, exposure and rig did not change while a pose was captured, that the"
        " projector scales nothing, and that its response is linear; sigmas of clouds are raised by"
        " that factor",
    )
    return Verdict.of([*verdict.findings, finding])
