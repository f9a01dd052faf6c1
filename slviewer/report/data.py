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
from slviewer.session.capture import Capture


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


@dataclass(frozen=True)
class CaptureUse:
    """Whether the calibration uses a capture, and ``why`` it does not."""

    capture: Capture
    state: Literal["used", "unused", "excluded", "scan", "waiting"]
    why: str = ""


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
class SessionData:
    """A session's captures, its calibrations, and the records made with them.

    ``verdict`` is that on the last attempt to calibrate; ``verdict_of_calibration``: whether that
    made ``calibration``. ``pixel_fits``: {axis: RMS (3, h, w) of the pixel-wise fits in z, x, y}.
    ``model``: the one that is used, and the one ``recommended``; ``scales``: {model: what
    correction of scale was applied, in words}. ``region``: the region of interest that is in
    effect, in words; ``edits``
    of scans in their order: scan and words.
    """

    name: str
    captures: Sequence[CaptureUse]
    calibration: CalibrationFigures | None = None
    pixel_fits: Mapping[str, np.ndarray] = field(default_factory=dict)
    records: Sequence[RecordsView] = ()
    warnings: Sequence[str] = ()
    verdict: Verdict | None = None
    verdict_of_calibration: bool = True
    model: str = ""
    recommended: str = ""
    scales: Mapping[str, str] = field(default_factory=dict)
    region: str = ""
    edits: Sequence[tuple[str, str]] = ()
