"""The cloud of a capture, by one model."""

from collections.abc import Iterator, Mapping
from typing import Any, ClassVar

import msgspec

from slviewer.records.record import Count, Record, Share
from slviewer.records.table import Column, Table

REPORTED_RAISE = 1.2
"""Times its predicted noise that a calibration's residual is, from which raising sigma is
reported."""


REPORTED_OUTSIDE = 0.02
"""Share of the points outside the calibrated depths, from which on it is reported."""


class DepthCheck(msgspec.Struct, frozen=True):
    """How a cloud lies to the depths, near and far end in mm, between which the board was when the
    rig was calibrated: the share of its points ``outside``, their ``nearest`` and ``farthest``
    depth, and the median of their ``sigma``; ``is_whole``: with what the calibration leaves
    uncertain there, else that is not known, and sigma is of noise alone."""

    calibrated_mm: tuple[float, float]
    outside: Share
    nearest_mm: float | None = None
    farthest_mm: float | None = None
    sigma_mm: float | None = None
    is_whole: bool = False

    @property
    def is_good(self) -> bool:
        """Whether hardly any point is outside."""
        return self.outside <= REPORTED_OUTSIDE

    def text(self) -> str:
        """Describe the points outside, and what their sigma is worth; empty where there are hardly
        any."""
        if self.is_good or self.sigma_mm is None:
            return ""
        near, far = self.calibrated_mm
        worth = (
            "which includes what the calibration leaves uncertain there"
            if self.is_whole
            else "of noise alone: how wrong the calibration is there is not known"
        )
        return (
            f"{100 * self.outside:.0f} % of the points are outside the calibrated depths,"
            f" {near:.0f} to {far:.0f} mm, at {self.nearest_mm:.0f} to {self.farthest_mm:.0f} mm:"
            f" their sigma is {self.sigma_mm:.3f} mm, {worth}. Move the part to the calibrated"
            " depths, or add target poses there"
        )


class ProjectorFill(msgspec.Struct, frozen=True):
    """The ``points`` that the second of two cameras does not see, and the projector can measure:
    whether they were filled by it (``is_used``), and by how much, mm RMS, the projector differs
    from the cameras where both measure, and is predicted to; None where too little could be
    compared."""

    points: Count
    is_used: bool
    different_mm: float | None = None
    predicted_mm: float | None = None

    def text(self) -> str:
        """Describe what was filled, or why nothing was; empty where there is nothing to fill."""
        if not self.points:
            return ""
        if self.different_mm is None:
            return (
                f"{self.points:,} points that the second camera does not see are left unmeasured:"
                " too few others are measured by the projector and by the cameras to compare them"
            )
        differs = (
            f"where both measure, the projector is {self.different_mm:.3f} mm beside the cameras,"
            f" and {self.predicted_mm:.3f} mm are predicted"
        )
        if self.is_used:
            return (
                f"{self.points:,} points that the second camera does not see were measured by the"
                f" projector; {differs}"
            )
        return (
            f"{self.points:,} points that the second camera does not see are left unmeasured:"
            f" {differs}. It moved, or its focus changed, since the calibration: calibrate again to"
            " measure them too"
        )


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
    models ``sigma_calibration`` and ``sigma_edges`` (h, w) float32 mm, and of some captures
    ``extrapolated`` (h, w) bool: points that no target pose supports; of some captures the parts
    ``excess_px`` and ``change`` of a `Misfit`. ``depth_mm``: 1st and 99th
    percentile; ``noise_mm`` and ``sigma_calibration_mm``: medians, of the depth's noise and of what
    the calibration leaves uncertain; ``raised``: the calibration's residuals over their predicted
    noise, by which sigmas are raised; ``misfit_px``: by how much, at most, the axes of the capture
    miss each other beyond what is predicted, None where they do not; ``masked``: share of the
    pixels, 0 to 1, outside the calibrated region, None for models that know none;
    ``extrapolated``: number of stored points there, beside the ``points``, whose sigma has the
    median ``extrapolated_mm``; ``scale``: the
    correction of scale, in words; ``frame``: the one that the points are in, in words.
    ``depths``: the share of the points outside the calibrated depths, and what their sigma is
    worth; None where no such depths are known.
    ``fill``: of two cameras, what the projector measured where the second one does not see.
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
    extrapolated: Count = 0
    extrapolated_mm: float | None = None
    scale: str = ""
    frame: str = ""
    depths: DepthCheck | None = None
    fill: ProjectorFill | None = None
    imported: ImportedPoints | None = None

    @classmethod
    def upgrade(cls, meta: Mapping[str, Any]) -> Mapping[str, Any]:
        """Add the settings, which records of version 0.2 lack."""
        captures = [name for name in meta.get("inputs", {}) if "/" not in name]
        if "operation" in meta or not captures:
            return meta
        settings = {"capture": captures[0], "model": meta.get("model"), "axis": meta.get("axis")}
        return {**meta, "operation": "reconstruct", "settings": settings}

    @property
    def is_good(self) -> bool:
        """Whether the points are within the calibrated depths, as far as these are known."""
        return self.depths is None or self.depths.is_good

    def summary(self) -> str:
        """Return how many points there are, and how many are outside the calibrated depths."""
        if self.depths is None or self.depths.is_good:
            return f"{self.points:,} points"
        share = 100 * self.depths.outside
        return f"{self.points:,} points, {share:.0f} % of them outside the calibrated depths"

    def figures(self) -> dict[str, float]:
        """Return the number of points and the median noise of their depth."""
        return {"points": float(self.points)} | (
            {} if self.noise_mm is None else {"noise_mm": self.noise_mm}
        )

    def list_notes(self) -> Iterator[str]:
        """Yield what is to be known of the points beside their figures, as sentences without a
        stop."""
        if self.raised > REPORTED_RAISE:
            yield (
                f"sigma was raised: the calibration's residuals in {self.axis} are"
                f" {self.raised:.1f} times their predicted noise, and what disturbs its phases"
                " disturbs this capture's as well"
            )
        if self.misfit_px is not None:
            yield (
                "sigma was raised: the x and y patterns disagree by up to"
                f" {self.misfit_px:.2f} px more than predicted"
            )
        if self.depths and not self.depths.is_good:
            yield self.depths.text()
        if self.extrapolated and self.extrapolated_mm is not None:
            yield (
                f"{self.extrapolated:,} more points are extrapolated, as no target pose illuminated"
                f" what they look through: their sigma is {self.extrapolated_mm:.3f} mm in the"
                " median. Merges, measurements, meshes and exported clouds are without them"
            )
        if self.fill and (text := self.fill.text()):
            yield text
        if (i := self.imported) is not None:
            yield "; ".join((f"from {i.file} in {i.unit}", i.normals, i.sigma, *i.notes))

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
                Column("outside", "%", digits=0): (
                    100 * each.depths.outside if each.depths and each.depths.outside else None
                ),
                Column("noise", "mm"): each.noise_mm,
                Column("calibration", "mm", digits=4, detail=True): each.sigma_calibration_mm,
                Column("extrapolated", detail=True): each.extrapolated or None,
                Column("unsupported", "%", digits=1, detail=True): (
                    None if each.masked is None else 100 * each.masked
                ),
                Column("scale", detail=True): each.scale,
            }
            for name, each in found.items()
        ]
        frames = {each.frame: None for each in found.values() if each.frame}
        note = (
            "Nearest and farthest: 1 % and 99 % of the depths. Outside: share of the points outside"
            " the depths of the target poses. Noise and calibration: medians of"
            " the standard deviations of depth, by the capture's noise and by what the calibration"
            " leaves uncertain."
        )
        texts = [f"{name}: {text}." for name, each in found.items() for text in each.list_notes()]
        notes = [note, *texts, *(f"Frame: {frame}." for frame in frames)]
        return [Table.of(rows, cls.title, notes).without_empty()]
