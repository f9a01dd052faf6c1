"""The clouds of captures, each by one model; scans of one object, registered and fused into one
surface; and where each is while they are captured."""

from collections import Counter
from collections.abc import Iterator, Mapping
from math import acos, degrees, dist

import msgspec
import numpy as np

from slviewer.records.record import Cell, Column, Count, Matrix4, Meta, Record, Share, Table, Vector

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
    standard deviation of its points rest on, in words, and notes on what was dropped or added.
    ``scalars``: names of the other values of its points; ``origin_mm``: where they count from."""

    file: str
    hash: str
    unit: str
    normals: str
    sigma: str
    notes: tuple[str, ...] = ()
    scalars: tuple[str, ...] = ()
    origin_mm: tuple[float, float, float] | None = None

    def text(self) -> str:
        """Describe where the points are from."""
        parts = [f"from {self.file} in {self.unit}", self.normals, self.sigma]
        if self.scalars:
            parts.append(f"kept: {', '.join(self.scalars)}")
        if self.origin_mm is not None:
            x, y, z = self.origin_mm
            parts.append(
                f"coordinates less the origin {x:.10g} {y:.10g} {z:.10g} mm, which export adds"
            )
        return "; ".join((*parts, *self.notes))


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
    ``normals`` (h, w, 3), ``sigma_z`` along these, and where they have such ``texture``, and
    ``scalars`` (h, w, k), which ``imported`` names.
    """

    kind = "clouds"
    title = "Clouds"
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
    def upgrade(cls, meta: Meta) -> Meta:
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
        if self.imported is not None:
            yield self.imported.text()

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


MIN_OVERLAP = 0.3
"""Share of a scan below which its overlap with another is reported."""
EXCLUDED = {
    "edges": "at depth edges",
    "grazing": "at grazing angles",
    "groups": "in small groups",
    "far": "far from everything else",
    "unconfirmed": "contradicted by other scans",
}
"""Why points of scans are not part of the surface."""


def rests_on_start(scan: str, onto: str, start: str, rival_mm: float) -> str:
    """State that the start of a registration decided between poses that fit alike."""
    return (
        f"{scan} -> {onto} rests on its start ({start}): another pose, {rival_mm:.3g} mm away, fits"
        " as well; see that it is right, or put coded markers on the object or beside it and start"
        " from markers"
    )


class Registered(msgspec.Struct, frozen=True, kw_only=True):
    """The registration of one scan onto another: RMS along the normal, and from point to point;
    ``overlap``, 0 to 1; one standard deviation of the pose at ``middle``, the centre of the
    overlap. Of a scan that the machine alone places, RMS is None. ``rival_mm``: distance of another
    pose that fits as well: the ``start`` decided."""

    scan: str = ""
    onto: str = ""
    rms_mm: float | None
    overlap: float
    T_reference_scan: Matrix4
    point_to_point_rms_mm: float | None = None
    agreement: float | None = None
    slack_mm: float | None = None
    gate_mm: float | None = None
    start: str = ""
    rival_mm: float | None = None
    sigma_shift_mm: float | None = None
    sigma_turn_deg: float | None = None
    middle: Vector | None = None

    @property
    def turned_deg(self) -> float:
        """The angle by which the scan was turned."""
        trace = float(np.trace(np.array(self.T_reference_scan)[:3, :3]))
        return degrees(acos(max(-1.0, min(1.0, (trace - 1) / 2))))

    @property
    def moved_mm(self) -> float | None:
        """How far the centre of the overlap was moved; None where an older merge lacks it."""
        if self.middle is None:
            return None
        T, middle = np.array(self.T_reference_scan), np.array(self.middle)
        return dist(middle, T[:3, :3].T @ (middle - T[:3, 3]))


class LoopClosure(msgspec.Struct, frozen=True):
    """The closure error of the pairs round these scans: as registered, and what the joint
    adjustment left."""

    scans: list[str]
    error_mm: float
    error_deg: float
    left_mm: float
    left_deg: float


class RefusedPair(msgspec.Struct, frozen=True):
    """Two scans that were not registered, or whose registration others contradict, and why."""

    scan: str
    onto: str
    why: str


class MarkerPair(msgspec.Struct, frozen=True):
    """Coded markers that two scans share, those that moved between them, and RMS distance of their
    corners."""

    scan: str
    onto: str
    ids: list[int]
    moved: list[int]
    rms_mm: float


class ContradictingPair(msgspec.Struct, frozen=True):
    """Share of the compared points that lie more than ``gate_mm`` in front of the other scan's
    surface."""

    scan: str
    onto: str
    share: float
    compared: Count
    gate_mm: float


class PlacedByMachine(msgspec.Struct, frozen=True):
    """How far the surfaces place a scan beside its place by the machine, and U of that (k = 2);
    whether they ``agrees``, and whether the machine's place ``is_used``. Without figures, ``why``
    the surfaces do not show it."""

    scan: str
    is_used: bool
    shift_mm: float | None = None
    turn_deg: float | None = None
    U_mm: float | None = None
    U_deg: float | None = None
    agrees: bool = True
    why: str = ""

    def text(self) -> str:
        """Describe the comparison."""
        used = "the machine's place is used" if self.is_used else "the surfaces' place is used"
        if self.shift_mm is None:
            return f"{self.scan}: {used}, and the surfaces do not show whether it holds: {self.why}"
        stated = (
            f"{self.scan}: the surfaces place it {self.shift_mm:.3g} mm and {self.turn_deg:.2g}°"
            f" beside the machine's pose (U {self.U_mm:.2g} mm and {self.U_deg:.2g}°); {used}"
        )
        if self.agrees:
            return stated
        return (
            f"{stated}. They contradict each other: see that the pose belongs to this scan, that"
            " part and scanner did not move on their mounts, and that the machine is as accurate as"
            " stated"
        )


class Merge(Record, frozen=True, kw_only=True):
    """Scans registered onto one of them, and fused into one surface, by the joint adjustment of all
    pairs.

    ``pairs``: every scan but the reference on it; ``registered``: the pairs that the merge was made
    from; ``loops`` that these close, the worst first; ``dropped``: pairs that the others
    contradict. ``machine``: scans placed by a machine. ``static_points`` stand still while the
    object moves; ``left_out``: {scan: {why: points}}; ``shared``: share of the ``points`` seen by
    several scans. ``depths``: of scans that are partly outside the calibrated depths. ``ply``: the
    file in the session's exports; ``scale``, ``restrictions``: correction of scale, edits and
    region in words.
    """

    kind = "merge"
    title = "Merges"
    reference: str
    scans: list[str]
    pairs: dict[str, Registered]
    points: Count = 0
    ply: str = ""
    model: str = ""
    scale: str = ""
    registered: list[Registered] = []
    loops: list[LoopClosure] = []
    dropped: list[RefusedPair] = []
    refused: list[RefusedPair] = []
    markers: list[MarkerPair] = []
    machine: list[PlacedByMachine] = []
    static_points: dict[str, Count] = {}
    contradictions: list[ContradictingPair] = []
    left_out: dict[str, dict[str, Count]] = {}
    shared: float | None = None
    restrictions: list[str] = []
    depths: dict[str, DepthCheck] = {}

    @property
    def poses(self) -> dict[str, np.ndarray]:
        """T_reference_scan (4, 4) mm of each scan, the reference first."""
        placed = {name: np.array(pair.T_reference_scan) for name, pair in self.pairs.items()}
        return {self.reference: np.eye(4), **placed}

    @property
    def is_good(self) -> bool:
        """Whether the scans are within the calibrated depths, and where a machine has them."""
        return not self.depths and all(each.agrees for each in self.machine)

    @classmethod
    def upgrade(cls, meta: Meta) -> Meta:
        """Add the registered pairs, which merges of version 0.1 lack: theirs are those on the
        reference."""
        if "registered" in meta or not {"pairs", "reference"} <= meta.keys():
            return meta
        onto = [
            {**pair, "scan": scan, "onto": meta["reference"]}
            for scan, pair in meta["pairs"].items()
        ]
        return {**meta, "registered": onto}

    @property
    def excluded(self) -> Counter[str]:
        """{why: points of all scans that are not part of the surface}."""
        counts: Counter[str] = Counter()
        for each in self.left_out.values():
            counts.update(each)
        return counts

    def summary(self) -> str:
        """Return RMS and overlap of each scan on the reference."""
        pairs = (
            f"{n} placed by the machine"
            if p.rms_mm is None
            else f"{n} RMS {p.rms_mm:.3f} mm, overlap {100 * p.overlap:.0f} %"
            for n, p in self.pairs.items()
        )
        merged = f"merged on {self.reference}: {'; '.join(pairs)}"
        if not self.depths:
            return merged
        return f"{merged}; outside the calibrated depths: {', '.join(self.depths)}"

    def figures(self) -> dict[str, float]:
        """Return the RMS and overlap of each registered pair, and the number of points."""
        pairs = {
            f"{p.scan} on {p.onto} {key}": getattr(p, key)
            for p in self.registered
            for key in ("rms_mm", "overlap")
            if p.rms_mm is not None
        }
        return {"points": float(self.points), **pairs}

    def list_tables(self, name: str) -> list[Table]:
        """Return a table of the pairs and one of the loops, and notes of all that was excluded."""
        marked = {(each.scan, each.onto): each for each in self.markers}
        rows = []
        for pair in sorted(self.registered, key=lambda p: self.reference not in (p.scan, p.onto)):
            marks = marked.get((pair.scan, pair.onto))
            is_enough = pair.overlap >= MIN_OVERLAP or pair.rms_mm is None
            overlap = Cell(
                None if pair.rms_mm is None else 100 * pair.overlap, "" if is_enough else "worse"
            )
            rows.append(
                {
                    "scan": pair.scan,
                    "onto": pair.onto,
                    Column("RMS", "mm"): Cell(pair.rms_mm, "strong"),
                    Column("point to point", "mm", detail=True): pair.point_to_point_rms_mm,
                    Column("overlap", "%", digits=0): overlap,
                    Column("sigma", "mm", digits=4): pair.sigma_shift_mm,
                    Column("sigma", "°", digits=4, detail=True): pair.sigma_turn_deg,
                    Column("moved", "mm", digits=2): pair.moved_mm,
                    Column("turned", "°", digits=2, detail=True): pair.turned_deg,
                    Column("common markers", detail=True): marks and len(marks.ids),
                    Column("their corners", "mm", detail=True): marks and marks.rms_mm,
                }
            )
        caption = f"Merge {name}: registered pairs"
        tables = [Table.of(rows, caption, self._list_notes()).without_empty()]
        if self.loops:
            rows = [
                {
                    "loop": " – ".join([*loop.scans, loop.scans[0]]),
                    Column("before", "mm"): loop.error_mm,
                    Column("before", "°", digits=4, detail=True): loop.error_deg,
                    Column("after", "mm"): loop.left_mm,
                    Column("after", "°", digits=4, detail=True): loop.left_deg,
                }
                for loop in self.loops
            ]
            caption = "closure error of its loops, before and after the joint adjustment"
            tables.append(Table.of(rows, f"Merge {name}: {caption}"))
        return tables

    def _list_notes(self) -> list[str]:
        shared = (
            ""
            if self.shared is None
            else f", {100 * self.shared:.0f} % of them seen by several scans"
        )
        notes = [f"{self.points:,} points in the frame of {self.reference}{shared}."]
        notes += [
            f"{rests_on_start(each.scan, each.onto, each.start, each.rival_mm)}."
            for each in self.registered
            if each.rival_mm is not None
        ]
        notes += [f"{scan}: {each.text()}." for scan, each in self.depths.items()]
        notes += [f"{each.text()}." for each in self.machine]
        notes += [f"Excluded: {each.why}." for each in self.dropped]
        notes += [
            f"Not registered: {each.scan} onto {each.onto}: {each.why}." for each in self.refused
        ]
        if counts := [
            f"{count:,} {EXCLUDED.get(why, why)}" for why, count in self.excluded.items() if count
        ]:
            notes.append(f"Excluded points: {', '.join(counts)}.")
        if self.contradictions:
            worst = max(self.contradictions, key=lambda each: each.share)
            notes.append(
                f"Contradicting points: {100 * worst.share:.2g} % at most of what both scans of a"
                f" pair cover lie more than {worst.gate_mm:.2g} mm in front of the other's surface."
            )
        return [*notes, *(f"{each}." for each in (*self.restrictions, self.scale) if each)]


class Placement(Record, frozen=True, kw_only=True):
    """Scans aligned one after the other, each to those before it: a merge starts from there.

    ``T_first_scan`` maps a scan's points, mm, into the frame of the first aligned scan; None where
    it could not be aligned, with the reason ``why``. ``onto``: the scan that it was aligned to,
    empty for the first, with the RMS of the distances along the normal and the share of its points
    that overlap. ``seen_again``: share of the surface that more than one scan sees, of the last.
    """

    kind = "placement"
    title = "Places of scans"
    has_figures = False  # a scan's place depends on the order in which the others were aligned
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

    @classmethod
    def tables(cls, found: Mapping[str, "Placement"]) -> list[Table]:  # type: ignore[override]
        """Return one table with a line for each scan."""
        rows = [
            {
                "scan": name,
                "onto": each.onto,
                Column("RMS", "mm"): each.rms_mm,
                Column("overlap", "%", digits=0): (
                    None if each.overlap is None else 100 * each.overlap
                ),
                "kept apart because": Cell(each.why, "worse"),
            }
            for name, each in found.items()
        ]
        again = [each.seen_again for each in found.values() if each.seen_again is not None]
        notes = (
            [f"{100 * again[-1]:.0f} % of the surface is seen by more than one scan."]
            if again
            else []
        )
        return [Table.of(rows, cls.title, notes).without_empty()]
