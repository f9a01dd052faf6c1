"""The cloud of a capture, by one model."""

from collections.abc import Mapping
from typing import Any, ClassVar

import msgspec

from slviewer.records.record import Count, Record
from slviewer.records.table import Column, Table

REPORTED_RAISE = 1.2
"""Times its predicted noise that a calibration's residual is, from which raising sigma is
reported."""


class ImportedPoints(msgspec.Struct, frozen=True):
    """Where an imported cloud is from: name, hash and unit of its file, what the normals and the
    standard deviation of its points rest on, in words, and notes on what was dropped or added."""

    file: str
    hash: str
    unit: str
    normals: str
    sigma: str
    notes: tuple[str, ...] = ()


class Reconstruction(Record, frozen=True, kw_only=True):
    """Captures as clouds, each by one model along one pattern axis, before edits and region.

    Arrays, on the camera's grid: ``points`` (h, w, 3) float32 mm, ``sigma_z`` mm, ``phase`` rad,
    ``modulation`` (h, w) float32, NaN where invalid; ``texture`` (h, w) or (h, w, 3) uint8; of some
    models ``sigma_calibration`` and ``sigma_edges`` (h, w) float32 mm; of some captures the parts
    ``excess_px`` and ``change`` of a `Misfit`. ``depth_mm``: 1st and 99th
    percentile; ``noise_mm`` and ``sigma_calibration_mm``: medians, of the depth's noise and of what
    the calibration leaves uncertain; ``raised``: the calibration's residuals over their predicted
    noise, by which sigmas are raised; ``misfit_px``: by how much, at most, the axes of the capture
    miss each other beyond what is predicted, None where they do not; ``masked``: share of the
    pixels, 0 to 1, outside the calibrated region, None for models that mask none; ``scale``: the
    correction of scale, in words; ``frame``: the one that the points are in, in words.
    ``imported``: of points from a file, in rows that mean nothing; their arrays are ``points``,
    ``normals`` (h, w, 3), ``sigma_z`` along these, and ``texture`` where they have colours.
    """

    kind: ClassVar[str] = "clouds"
    title: ClassVar[str] = "Clouds"
    model: str = ""
    axis: str = "x"
    points: Count = 0
    depth_mm: tuple[float, float] | None = None
    noise_mm: float | None = None
    sigma_calibration_mm: float | None = None
    raised: float = 1.0
    misfit_px: float | None = None
    masked: float | None = None
    scale: str = ""
    frame: str = ""
    imported: ImportedPoints | None = None

    @classmethod
    def upgrade(cls, meta: Mapping[str, Any]) -> Mapping[str, Any]:
        """Add the settings, which records of version 0.2 lack."""
        captures = [name for name in meta.get("inputs", {}) if "/" not in name]
        if "operation" in meta or not captures:
            return meta
        settings = {"capture": captures[0], "model": meta.get("model"), "axis": meta.get("axis")}
        return {**meta, "operation": "reconstruct", "settings": settings}

    def summary(self) -> str:
        """Return how many points there are."""
        return f"{self.points:,} points"

    def figures(self) -> dict[str, float]:
        """Return the number of points and the median noise of their depth."""
        return {"points": float(self.points)} | (
            {} if self.noise_mm is None else {"noise_mm": self.noise_mm}
        )

    @classmethod
    def tables(cls, found: Mapping[str, "Reconstruction"]) -> list[Table]:  # type: ignore[override]
        """Return one table with a line for each cloud."""
        rows = [
            {
                "capture": name,
                "model": each.model or "imported",
                Column("axis", align="centre", detail=True): each.axis,
                "points": each.points,
                Column("nearest", "mm", digits=0): each.depth_mm and each.depth_mm[0],
                Column("farthest", "mm", digits=0): each.depth_mm and each.depth_mm[1],
                Column("noise", "mm"): each.noise_mm,
                Column("calibration", "mm", digits=4, detail=True): each.sigma_calibration_mm,
                Column("masked", "%", digits=1, detail=True): (
                    None if each.masked is None else 100 * each.masked
                ),
                Column("scale", detail=True): each.scale,
            }
            for name, each in found.items()
        ]
        raised = [
            f"{name}: sigma was raised: the calibration's residuals in {each.axis} are"
            f" {each.raised:.1f} times their predicted noise, and what disturbs its phases disturbs"
            " this capture's as well."
            for name, each in found.items()
            if each.raised > REPORTED_RAISE
        ]
        raised += [
            f"{name}: sigma was raised: the x and y patterns disagree by up to"
            f" {each.misfit_px:.2f} px more than predicted."
            for name, each in found.items()
            if each.misfit_px is not None
        ]
        frames = {each.frame: None for each in found.values() if each.frame}
        note = (
            "Nearest and farthest: 1 % and 99 % of the depths. Noise and calibration: medians of"
            " the standard deviations of depth, by the capture's noise and by what the calibration"
            " leaves uncertain."
        )
        imported = [
            f"{name}: {'; '.join((f'from {i.file} in {i.unit}', i.normals, i.sigma, *i.notes))}."
            for name, each in found.items()
            if (i := each.imported) is not None
        ]
        notes = [note, *raised, *imported, *(f"Frame: {frame}." for frame in frames)]
        return [Table.of(rows, cls.title, notes).without_empty()]
