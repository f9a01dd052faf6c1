"""Where scans of one object are, beside those that were captured before."""

from collections.abc import Mapping
from typing import ClassVar

from slviewer.records.record import Matrix4, Record, Share
from slviewer.records.table import Cell, Column, Table, Value


class Placement(Record, frozen=True, kw_only=True):
    """Scans aligned one after the other, each to those before it: a merge starts from there.

    ``T_first_scan`` maps a scan's points, mm, into the frame of the first aligned scan; None where
    it could not be aligned, with the reason ``why``. ``onto``: the scan that it was aligned to,
    empty for the first, with the RMS of the distances along the normal and the share of its points
    that overlap. ``seen_again``: share of the surface that more than one scan sees, of the last.
    """

    kind: ClassVar[str] = "placement"
    title: ClassVar[str] = "Places of scans"
    T_first_scan: Matrix4 | None = None
    onto: str = ""
    rms_mm: float | None = None
    overlap: Share | None = None
    why: str = ""
    seen_again: Share | None = None

    @property
    def is_good(self) -> bool:
        """Whether the scan has its place."""
        return self.T_first_scan is not None

    def summary(self) -> str:
        """Return where the scan is in one sentence."""
        if self.T_first_scan is None:
            return f"kept apart: {self.why}"
        if not self.onto or self.rms_mm is None or self.overlap is None:
            return "the first scan, which others are aligned to"
        return (
            f"aligned to {self.onto}: RMS {self.rms_mm:.3f} mm, overlap {100 * self.overlap:.0f} %"
        )

    def figures(self) -> dict[str, float]:
        """Return none: a scan's place depends on the order in which the others were aligned."""
        return {}

    @classmethod
    def tables(cls, found: Mapping[str, "Placement"]) -> list[Table]:  # type: ignore[override]
        """Return one table with a line for each scan."""
        columns = [
            Column("scan"),
            Column("onto"),
            Column("RMS", "mm"),
            Column("overlap", "%", digits=0),
            Column("kept apart because"),
        ]
        rows: list[list[Value | Cell]] = [
            [
                name,
                p.onto,
                p.rms_mm,
                None if p.overlap is None else 100 * p.overlap,
                Cell(p.why, "worse"),
            ]
            for name, p in found.items()
        ]
        again = [each.seen_again for each in found.values() if each.seen_again is not None]
        notes = (
            [f"{100 * again[-1]:.0f} % of the surface is seen by more than one scan."]
            if again
            else []
        )
        return [Table(columns, rows, cls.title, notes).without_empty()]
