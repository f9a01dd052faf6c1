"""Examination of the frames of one capture."""

import msgspec

from slviewer.records.verdict import Cause, Finding

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

    ``light_rms``: relative variation of the light from frame to frame, 0 below what is corrected.
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
