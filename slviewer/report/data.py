"""What a report is drawn from: plain values and arrays, so that whoever computed them needs to know
no drawing.

Lengths in mm, image errors in px; NaN is "unknown" everywhere. A mapping that is keyed by model
holds the models in the order in which they are to be shown, the one to beat ("stereo") first.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from slviewer.calibration.stereo import StereoModel
from slviewer.records.record import Record
from slviewer.records.verdict import Verdict
from slviewer.report.page import Figure

ByModel = Mapping[str, float]
"""One value a model, such as ``{"stereo": 0.198, "pixelwise": 0.076}``."""

Region = Literal["R1", "R2", "R3"]


@dataclass(frozen=True)
class PlaneRow:
    """A flat board at one pose. ``incidence``: its share in R1, R2 and R3, percent; ``letter_*``:
    the Letter's own."""

    name: str
    incidence: Mapping[str, float]
    rms_mm: ByModel
    noise_floor_mm: ByModel
    letter_incidence: Mapping[str, float] = field(default_factory=dict)
    letter_rms_mm: ByModel = field(default_factory=dict)


@dataclass(frozen=True)
class SphereRow:
    """A sphere of known ``true_radius_mm`` at one place, in depth range ``region``."""

    name: str
    region: str
    true_radius_mm: float
    rms_mm: ByModel
    noise_floor_mm: ByModel
    radius_mm: ByModel
    letter_rms_mm: ByModel = field(default_factory=dict)
    letter_radius_mm: ByModel = field(default_factory=dict)


@dataclass(frozen=True)
class SpacingRow:
    """The distance between the centres of two spheres, known and as each model measures it."""

    name: str
    known_mm: float
    measured_mm: ByModel


@dataclass(frozen=True)
class MergePair:
    """The alignment of one scan to the reference after ICP; ``overlap`` is a share, 0 to 1."""

    name: str
    reference: str
    rms_mm: float
    overlap: float
    letter_rms_mm: float = float("nan")


@dataclass(frozen=True, eq=False)
class PixelCurve:
    """One camera pixel's data, (n,) each, and the functions fitted to it (the Letter, eq. 9-11).

    ``coefficients`` (5,) c0 ... c4 for phase in rad and lengths in mm; ``rms_mm`` (3,) in z, x, y.
    """

    pixel: tuple[int, int]
    axis: str
    phase: np.ndarray
    z: np.ndarray
    x: np.ndarray
    y: np.ndarray
    coefficients: np.ndarray
    rms_mm: np.ndarray


@dataclass(frozen=True, eq=False)
class ErrorMaps:
    """Signed errors (h, w) mm, NaN at excluded pixels, of each model on one capture, with RMS and
    noise floor."""

    title: str
    maps: Mapping[str, np.ndarray]
    rms_mm: ByModel
    noise_floor_mm: float = float("nan")


@dataclass(frozen=True, eq=False)
class CloudView:
    """A scan to look at, ``points`` (h, w, 3) mm, NaN where invalid; or a merged cloud, ``points``
    (n, 3) with ``normals``, ``source`` (n,), the number of the scan that each comes from, and the
    ``names`` of these."""

    name: str
    points: np.ndarray
    normals: np.ndarray | None = None
    source: np.ndarray | None = None
    names: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class ReproductionData:
    """The Letter's experiments on a simulated rig.

    ``depth_range_mm`` bounds R2. ``rms_maps_mm`` (3, h, w) are the pixel-wise fits' RMS in z, x, y.
    ``plane_outlines`` holds, by plane, four or more points (n, 3) of it. ``reprojection_rms_px``
    and the Letter's have the keys camera, projector (and stereo, ours).
    """

    camera: tuple[int, int]
    projector: tuple[int, int]
    quick: bool
    seed: int
    poses: int
    depth_range_mm: tuple[float, float]
    reprojection_rms_px: Mapping[str, float]
    letter_reprojection_rms_px: Mapping[str, float]
    fit_rms_mm: Mapping[str, float]
    planes: Sequence[PlaneRow]
    spheres: Sequence[SphereRow]
    spacings: Sequence[SpacingRow]
    pairs: Sequence[MergePair]
    pixel_curve: PixelCurve | None
    rms_maps_mm: np.ndarray
    plane_maps: Sequence[ErrorMaps]
    sphere_maps: Sequence[ErrorMaps]
    plane_outlines: Mapping[str, np.ndarray]
    clouds: Sequence[CloudView]
    merged: CloudView | None
    poses_left_out: Mapping[str, str] = field(default_factory=dict)
    letter_points: Mapping[str, int] = field(default_factory=dict)


@dataclass(frozen=True)
class CaptureRow:
    """One capture. ``state``: used, unused, excluded, waiting or scan; ``why``: why it is not
    used."""

    name: str
    role: str
    state: Literal["used", "unused", "excluded", "scan", "waiting"]
    camera: tuple[int, int]
    projector: tuple[int, int] | None
    frames: int
    periods_px: Mapping[str, float]
    why: str = ""
    made: str = ""


@dataclass(frozen=True, eq=False)
class PoseResiduals:
    """Features of one board pose: camera ``pixels`` (n, 2) and ``camera``, ``projector`` residuals
    (n, 2) px.

    ``projector_pixels`` (n, 2) is where the projector's residuals belong. NaN: excluded or not
    read.
    """

    pixels: np.ndarray
    camera: np.ndarray
    projector_pixels: np.ndarray
    projector: np.ndarray


@dataclass(frozen=True, eq=False)
class CalibrationFigures:
    """A stereo calibration and the residuals of its poses' features, which may be empty where none
    were saved."""

    stereo: StereoModel
    residuals: Mapping[str, PoseResiduals] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class RecordsView:
    """The records of one kind by their labels, and pictures of them."""

    kind: type[Record]
    records: Mapping[str, Any]
    figures: Sequence[Figure] = ()


@dataclass(frozen=True, eq=False)
class ModelsView:
    """The models of a session: the one that is ``used`` and the one ``recommended``; ``scales``:
    {model: what correction of scale was applied, in words}."""

    used: str
    recommended: str
    scales: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class SessionData:
    """A session's captures, its calibrations, and the records made with them.

    ``verdict`` is that on the last attempt to calibrate; ``verdict_of_calibration``: whether that
    made ``calibration``. ``pixel_fits``: {axis: RMS (3, h, w) of the pixel-wise fits in z, x, y}.
    ``region``: the region of interest that is in effect, in words; ``edits``
    of scans in their order: scan and words.
    """

    name: str
    captures: Sequence[CaptureRow]
    calibration: CalibrationFigures | None = None
    pixel_fits: Mapping[str, np.ndarray] = field(default_factory=dict)
    records: Sequence[RecordsView] = ()
    warnings: Sequence[str] = ()
    verdict: Verdict | None = None
    verdict_of_calibration: bool = True
    models: ModelsView | None = None
    region: str = ""
    edits: Sequence[tuple[str, str]] = ()
