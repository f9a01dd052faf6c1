"""Where the uncertainty of a measured length comes from, in the manner of the GUM."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from slviewer.evaluation.render import render
from slviewer.records.plain import to_plain

COVERAGE = 2.0


@dataclass(frozen=True)
class Contribution:
    """One source: its standard uncertainty ``u_mm`` for the budget's length, None where nothing is known of it.

    ``kind`` A: from repeated observations; B: from anything else.
    """

    source: str
    u_mm: float | None
    kind: str
    how: str


@dataclass(frozen=True)
class ErrorBudget:
    """The contributions to a length of ``length_mm``."""

    length_mm: float
    contributions: tuple[Contribution, ...]

    @property
    def U_mm(self) -> float:
        """Expanded uncertainty (k = 2) of all known contributions."""
        known = [c.u_mm for c in self.contributions if c.u_mm is not None]
        return COVERAGE * float(np.sqrt(np.sum(np.square(known))))

    @property
    def unknown(self) -> tuple[str, ...]:
        """Sources of unknown uncertainty, which U does not include."""
        return tuple(c.source for c in self.contributions if c.u_mm is None)

    def text(self) -> str:
        """Return the budget as a table for the terminal."""
        table = [
            {
                "source": c.source,
                "u mm": "unknown" if c.u_mm is None else f"{c.u_mm:.4f}",
                "type": c.kind,
                "from": c.how,
            }
            for c in self.contributions
        ]
        without = f", WITHOUT {' and '.join(self.unknown)}" if self.unknown else ""
        return "\n".join(
            [
                f"uncertainty of a length of {self.length_mm:.0f} mm:",
                render(table),
                f"U = {self.U_mm:.4f} mm (k = 2){without}",
            ]
        )

    def to_json(self) -> dict[str, Any]:
        """The fields, U and what it lacks."""
        return to_plain(self) | {"U_mm": self.U_mm, "k": COVERAGE, "unknown": self.unknown}
