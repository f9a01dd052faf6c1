"""Whether a saved calibration is still good, by one later capture of its board."""

from collections.abc import Mapping
from typing import Any, ClassVar, Literal

from slviewer.records.record import Record, Vector
from slviewer.records.table import Cell, Column, Table, format_signed

DriftVerdict = Literal["still good", "recalibrate"]


class Drift(Record, frozen=True, kw_only=True):
    """One board against the saved calibration: whether the rig is still as it was.

    Sigmas are standard deviations. ``turn_mrad``, ``shift_mm``: estimated rotation about and
    translation along the projector's own axes. ``scale_ppm``: apparent growth of the board;
    ``across_px``: mean offset across the epipolar lines, None with one axis; ``misfit_px``: RMS
    that no movement explains. ``chance``: p-value of the change if nothing moved. ``seen_alone``:
    size in mrad and mm at which each rotation and translation would be detected with 95 %
    probability if it were the only change. ``unseen``: descriptions of changes that would not be
    detected. ``time``: ISO 8601, UTC.
    """

    kind: ClassVar[str] = "drift"
    title: ClassVar[str] = "Drift"
    is_history: ClassVar[bool] = True
    capture: str
    axes: tuple[Literal["x", "y"], ...]
    verdict: DriftVerdict
    reasons: tuple[str, ...]
    turn_mrad: Vector
    turn_sigma_mrad: Vector
    shift_mm: Vector
    shift_sigma_mm: Vector
    baseline_mm: float
    baseline_sigma_mm: float
    scale_ppm: float
    scale_sigma_ppm: float
    across_px: float | None
    across_sigma_px: float | None
    misfit_px: float
    chance: float
    seen_alone: tuple[float, float, float, float, float, float]
    unseen: tuple[str, ...]
    time: str = ""

    @classmethod
    def upgrade(cls, meta: Mapping[str, Any]) -> Mapping[str, Any]:
        """Convert a record of version 0.2, whose figures were one entry."""
        if not isinstance(old := meta.get("checked"), Mapping):
            return meta
        settings = {"capture": old.get("capture")}
        return {**old, "inputs": meta.get("inputs", {}), "operation": "check", "settings": settings}

    @property
    def is_good(self) -> bool:
        """Whether the calibration is still good."""
        return self.verdict == "still good"

    def summary(self) -> str:
        """Return the verdict and its reasons in one sentence."""
        because = f", because {'; '.join(self.reasons)}" if self.reasons else ""
        return f"{self.capture}: {self.verdict}{because}"

    def figures(self) -> dict[str, float]:
        """Return the apparent growth of the board, and what no movement explains."""
        return {"scale_ppm": self.scale_ppm, "misfit_px": self.misfit_px}

    @classmethod
    def tables(cls, found: Mapping[str, "Drift"]) -> list[Table]:  # type: ignore[override]
        """Return a table of the checks, the latest first, and one of what the latest found of each
        axis."""
        rows = [
            {
                "check": name,
                Column("time, UTC", detail=True): each.time[:16].replace("T", " "),
                "capture": each.capture,
                "answer": Cell(each.verdict, "better" if each.is_good else "worse"),
                Column("change of scale", "ppm", digits=0): each.scale_ppm,
                Column("±", "ppm", digits=0): each.scale_sigma_ppm,
                Column("epipolar error", "px", digits=4): each.across_px,
                Column("±", "px", digits=4, detail=True): each.across_sigma_px,
                Column("misfit", "px", detail=True): each.misfit_px,
            }
            for name, each in reversed(list(found.items()))
        ]
        *_, (name, latest) = found.items()
        return [
            Table.of(rows, "Drift checks, the latest first").without_empty(),
            latest._list_movements(name),
        ]

    def _list_movements(self, name: str) -> Table:
        rows = [
            {
                "axis of the projector": axis,
                Column("turn", "mrad"): self.turn_mrad[k],
                Column("±", "mrad"): self.turn_sigma_mrad[k],
                Column("shift", "µm", digits=0): 1e3 * self.shift_mm[k],
                Column("±", "µm", digits=0): 1e3 * self.shift_sigma_mm[k],
                Column("turn", "mrad", "detectable", digits=4, detail=True): self.seen_alone[k],
                Column("shift", "µm", "detectable", digits=1, detail=True): (
                    1e3 * self.seen_alone[3 + k]
                ),
            }
            for k, axis in enumerate("xyz")
        ]
        baseline = 1e3 * self.baseline_mm
        notes = [
            f"{self.summary()}.",
            f"Baseline {format_signed(baseline)} ± {1e3 * self.baseline_sigma_mm:.0f} µm.",
            (
                "A pan and a shift along x look nearly alike, as do a nod and a shift along y:"
                " their sum is known far better than each. Detectable: if it is the only change."
            ),
            *(f"Not detectable: {what}." for what in self.unseen),
        ]
        return Table.of(rows, f"Check {name}: how the projector has moved", notes)
