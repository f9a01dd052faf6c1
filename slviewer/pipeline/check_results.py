"""Results of the checks of a rig or of a capture."""

from dataclasses import dataclass, replace
from typing import Any, Literal

from slviewer.records.plain import to_plain

CheckVerdict = Literal["good", "warning", "bad", "unknown"]
"""Fit to capture; with reservations; not before it is corrected; could not be determined."""

CheckName = Literal[
    "screen", "latency", "order", "repeats", "exposure", "gamma", "pixels", "flicker", "ambient",
    "motion", "burst",
    "turntable", "description", "noise", "decoding",
]  # fmt: skip

_WORST_FIRST: tuple[CheckVerdict, ...] = ("bad", "warning", "good")


@dataclass(frozen=True)
class Check:
    """The result of one check: the finding in a ``sentence``; the ``remedy``, empty where none is
    needed; and the ``figures`` that it is based on, whose names contain their units.
    """

    name: CheckName
    verdict: CheckVerdict
    sentence: str
    remedy: str
    figures: dict[str, Any]


@dataclass(frozen=True)
class Preflight:
    """All checks of one rig, and what follows from them for its captures.

    ``settle_ms``: what `Rig.settle_ms` should be, None where it could not be measured. ``levels``:
    the table for `PatternSequence.levels` that makes the light proportional, None where it was not
    measured. ``exposure_ms``: the exposure to set, None where the one that is set is right, or
    unknown. ``seconds``: how long it took.
    """

    checks: tuple[Check, ...]
    settle_ms: float | None
    levels: tuple[int, ...] | None
    exposure_ms: float | None
    seconds: float

    @property
    def verdict(self) -> CheckVerdict:
        """The worst of all checks; what is unknown does not make a good rig worse."""
        verdicts = {check.verdict for check in self.checks}
        return next((verdict for verdict in _WORST_FIRST if verdict in verdicts), "unknown")

    def join(self, second: "Preflight") -> "Preflight":
        """Return the checks of two cameras: of each the worse one, which says where it is the
        ``second`` camera's. The longer wait is set, and the shorter exposure, if both are wrong."""
        others = {check.name: check for check in second.checks}
        joined = []
        for check in self.checks:
            other = others.get(check.name, check)
            pair = Preflight((check, other), None, None, None, 0.0)
            if other.verdict == pair.verdict != check.verdict:
                check = replace(other, sentence=f"Second camera: {other.sentence}")
            joined.append(check)
        settle = self.settle_ms, second.settle_ms
        exposure = self.exposure_ms, second.exposure_ms
        return Preflight(
            tuple(joined),
            None if None in settle else max(filter(None, settle), default=0.0),
            self.levels,
            None if None in exposure else min(filter(None, exposure), default=None),
            self.seconds + second.seconds,
        )

    def check(self, name: CheckName) -> Check:
        """The check called `name`. Raises KeyError."""
        return {check.name: check for check in self.checks}[name]

    @property
    def failure(self) -> str:
        """Why the command ends with status 1; empty unless something is bad."""
        if self.verdict != "bad":
            return ""
        return (
            "the rig or the capture is not fit to measure with: correct what is marked bad, then"
            " check, or capture, again"
        )

    def to_json(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return to_plain(self) | {"verdict": self.verdict, "seconds": round(self.seconds, 2)}

    def text(self) -> str:
        """Each check with its remedy, then what to set."""
        lines = []
        for check in self.checks:
            lines.append(f"{check.verdict:<8} {check.name}: {check.sentence}")
            if check.remedy:
                lines.append(f"         -> {check.remedy}")
        if self.settle_ms is not None:
            lines.append(f"settle_ms = {self.settle_ms:g} is the value to set in the rig's file")
        if self.exposure_ms is not None:
            lines.append(f"exposure_ms = {self.exposure_ms:g} would be better")
        return "\n".join([*lines, f"{self.verdict} after {self.seconds:.1f} s"])
