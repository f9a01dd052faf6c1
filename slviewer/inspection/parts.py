"""What was measured and decided of parts by an inspection plan."""

from dataclasses import dataclass

from slviewer.records.acceptance import Decision


@dataclass(frozen=True)
class CharacteristicResult:
    """A characteristic of one part: its ``value`` and ``U`` (k = 2), and the ``decision``; or the
    ``reason`` why it could not be measured. ``whole``: whether U holds the calibration's part."""

    name: str
    value: float | None
    U: float | None
    decision: Decision
    reason: str = ""
    whole: bool = True


@dataclass(frozen=True)
class PartResult:
    """The characteristics of one part, in the plan's order."""

    part: str
    results: tuple[CharacteristicResult, ...]

    @property
    def decision(self) -> Decision:
        """ "fail" where one characteristic fails, else "undecided" where one is, else "pass"."""
        decisions = [each.decision for each in self.results]
        return (
            "fail" if "fail" in decisions else "undecided" if "undecided" in decisions else "pass"
        )
