"""Images that a projector shows on a part."""

from typing import Any

from slviewer.records.record import Column, Record, Share, Table


class PartImage(Record, frozen=True, kw_only=True):
    """Images for the projector that show on a part what was measured on it.

    ``of``: what they show; ``illuminated_share``: of the projector's pixels; ``position_sigma_px``:
    position uncertainty of a colour (1 sigma), px of the projector, by noise and the calibration's
    residual; ``pixel_mm``: size of a projector pixel on the part; ``moved_px``: motion of the part
    since the scan, camera px, where a picture was compared. The array ``image`` (h, w, 3) uint8 is
    RGB.
    """

    kind = "part-image"
    title = "Images on the part"
    scan: str
    of: str
    illuminated_share: Share
    position_sigma_px: float
    pixel_mm: float
    moved_px: float | None = None

    def list_tables(self, name: str) -> list[Table]:
        """Return the table of the image."""
        figures: dict[Any, Any] = {
            "scan": self.scan,
            "shows": self.of,
            Column("illuminated", "%", digits=1): 100 * self.illuminated_share,
            Column("position uncertainty (1 sigma)", "px"): self.position_sigma_px,
            Column("on the part", "mm"): self.position_sigma_px * self.pixel_mm,
            Column("moved since the scan", "camera px"): self.moved_px,
        }
        return [Table.of([figures], "Image for the projector").without_empty()]

    def summary(self) -> str:
        """Return what is shown and how exactly, in one sentence."""
        return (
            f"{self.of} of {self.scan}: colours have a position uncertainty of"
            f" {self.position_sigma_px:.2f} px of the projector"
            f" ({self.position_sigma_px * self.pixel_mm:.3f} mm; 1 sigma)"
        )
