"""Findings on a capture or a calibration, with causes and remedies; the examination of a capture's
frames; and the verdict on a calibration: good, doubtful or rejected."""

from collections.abc import Iterable, Mapping
from typing import Literal, get_args

import msgspec
from msgspec import structs

Level = Literal["good", "doubtful", "rejected"]
Severity = Literal["note", "doubtful", "rejected"]
"""note: repaired already, as by excluding a pose; doubtful: may be used with care; rejected: must
not be used."""
Cause = Literal[
    "frame-lag",
    "missing-frame",
    "duplicate-frame",
    "frame-order",
    "ghosting",
    "bit-order",
    "step-order",
    "phase-offset",
    "gray-origin",
    "gray-cell",
    "dark",
    "saturation",
    "blur",
    "room-light",
    "flicker",
    "exposure-drift",
    "axes-swapped",
    "axis-reversed",
    "fringe-period",
    "projector-size",
    "unreadable",
    "camera-file",
    "transform",
    "board-size",
    "board-numbering",
    "moved",
    "outlier",
    "gamma",
    "too-few-poses",
    "parallel-poses",
    "constant-pixels",
    "empty-corner",
    "uncertain",
    "residuals",
]
CAUSES: tuple[Cause, ...] = get_args(Cause)
"""From root causes to their consequences: a finding may explain those of later causes."""


class Finding(msgspec.Struct, frozen=True, rename={"observation": "sentence"}):
    """A detected fault: its cause and severity, the ``observation``, the ``remedy``, and where it
    is: the poses, or the frames of one capture, counted from 0, and the axis.

    ``value``: what fits instead of a described value, in the unit of the observation. JSON has the
    observation as "sentence".
    """

    cause: Cause
    severity: Severity
    observation: str
    remedy: str
    poses: tuple[str, ...] = ()
    frames: tuple[int, ...] = ()
    axis: Literal["x", "y"] | None = None
    value: float | None = None

    def text(self) -> str:
        """Return observation and remedy in one line."""
        return f"{self.observation}: {self.remedy}"


class Verdict(msgspec.Struct, frozen=True):
    """The findings, the root cause first; without any, the calibration is good. ``level``: severity
    of the worst finding; a verdict with notes only is good."""

    findings: tuple[Finding, ...] = ()
    level: Level = "good"

    def __post_init__(self) -> None:
        worst = self.findings[0].severity if self.findings else "note"
        structs.force_setattr(self, "level", "good" if worst == "note" else worst)

    @classmethod
    def of(cls, findings: Iterable[Finding]) -> "Verdict":
        """Return the verdict of findings sorted by severity, the worst first, then by cause, root
        causes first."""
        severities = get_args(Severity)
        ranked = sorted(
            findings, key=lambda f: (-severities.index(f.severity), CAUSES.index(f.cause))
        )
        return cls(tuple(ranked))

    def rename(self, words: Mapping[str, str]) -> "Verdict":
        """Return the verdict with other words for devices in its observations and remedies."""

        def renamed(text: str) -> str:
            """Return a text with the words replaced."""
            for word, other in words.items():
                text = text.replace(word, other)
            return text

        return Verdict(
            tuple(
                structs.replace(
                    each, observation=renamed(each.observation), remedy=renamed(each.remedy)
                )
                for each in self.findings
            )
        )

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


MOST_WARNINGS = 4
"""About one capture."""
ORDER_CAUSES: tuple[Cause, ...] = (
    "frame-lag", "missing-frame", "duplicate-frame", "frame-order", "step-order"
)  # fmt: skip
"""Causes by which images are not where the description has them."""
LIGHT_CAUSES: tuple[Cause, ...] = ("room-light", "flicker", "exposure-drift", "gamma", "ghosting")
"""Causes that leave every frame in its place, and the description true."""


class Examination(msgspec.Struct, frozen=True):
    """What was found about the frames of a capture, root causes first; nothing for a sound one.

    ``light_rms``: rms of the logarithms of the frames' gains, 0 below what is corrected.
    """

    findings: tuple[Finding, ...] = ()
    light_rms: float = 0.0

    @property
    def rejected(self) -> tuple[Finding, ...]:
        """The findings with which the capture must not be measured."""
        return tuple(f for f in self.findings if f.severity == "rejected")

    def warnings(self) -> list[str]:
        """Return the findings in words, at most ``MOST_WARNINGS``."""
        texts = list(dict.fromkeys(finding.text() for finding in self.findings))
        if len(texts) <= MOST_WARNINGS:
            return texts
        more = len(texts) - MOST_WARNINGS + 1
        return [
            *texts[: MOST_WARNINGS - 1],
            f"and {more} more findings: run the preflight, then capture again",
        ]
