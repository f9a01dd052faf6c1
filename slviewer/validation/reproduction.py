"""What the repeated experiments gave, and how it is told."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from slviewer.calibration.pixelwise import PixelwiseModel
from slviewer.calibration.stereo import StereoModel
from slviewer.evaluation import letter
from slviewer.evaluation.compare import Comparison
from slviewer.evaluation.render import render
from slviewer.evaluation.tables import letter_rows
from slviewer.pipeline.merge import Merge

MODELS = ("stereo", "pixelwise", "splined")


@dataclass(frozen=True)
class Reproduction:
    """Everything that the experiments gave."""

    quick: bool
    stereo: StereoModel
    pixelwise: PixelwiseModel
    planes: Mapping[str, Comparison]
    spheres: Mapping[str, Comparison]
    spacings_mm: Mapping[str, tuple[float, Mapping[str, float]]]
    merged: Merge
    report: Path

    @property
    def in_range_ratio(self) -> float:
        """Mean stereo RMS over mean pixelwise RMS, over the planes that lie at least 87 % in R2."""
        inside = [c for c in self.planes.values() if c.incidence and c.incidence["R2"] >= 87.0]
        means = [float(np.mean([c.results[m].rms_mm for c in inside])) for m in MODELS]
        return means[0] / means[1]

    @property
    def spacing_rms_mm(self) -> dict[str, float]:
        """RMS error of the distances between all pairs of sphere centres, by model."""
        return {
            m: float(np.sqrt(np.mean([(found[m] - known) ** 2 for known, found in self.spacings_mm.values()])))
            for m in MODELS
        }

    def to_json(self) -> dict[str, Any]:
        """Every figure that ``text`` shows, and what stands behind it."""
        return {
            "quick": self.quick,
            "reprojection_rms_px": dict(self.stereo.reprojection_rms_px),
            "fit_rms_mm": self.pixelwise.median_rms_mm(self.pixelwise.depth_axis),
            "planes": {name: c.to_json() for name, c in self.planes.items()},
            "spheres": {name: c.to_json() for name, c in self.spheres.items()},
            "in_range_ratio": self.in_range_ratio,
            "spacing_rms_mm": self.spacing_rms_mm,
            "merge": self.merged.to_json(),
            "report": str(self.report),
        }

    def text(self) -> str:
        """Both tables with the Letter's figures beside ours, and what else there is to know."""
        rms, theirs = self.stereo.reprojection_rms_px, letter.REPROJECTION_RMS_PX
        icp = letter.EXPERIMENT_3_ICP_RMS_MM
        spacing = self.spacing_rms_mm
        pairs = [
            f"  {name}: RMS {pair.inlier_rmse_mm:.3f} mm point to point (the Letter: {icp[name[-2:].upper()]:.2f}), "
            f"{pair.rms_mm:.3f} mm point to plane, overlap {100 * pair.overlap:.0f} %"
            for name, pair in self.merged.pairs.items()
        ]
        size = "x".join(map(str, self.stereo.rig.camera.size))
        return "\n".join(
            [
                f"Simulated rig, camera {size}, {len(self.stereo.poses)} target poses. RMS in mm.",
                f"Reprojection RMS: camera {rms['camera']:.3f} px, projector {rms['projector']:.3f} px "
                f"(the Letter: {theirs['camera']:.3f}, {theirs['projector']:.3f}).",
                "",
                "Flat board (Table 1)",
                render(_terminal_columns(letter_rows(self.planes))),
                f"Planes at least 87 % in R2: stereo over pixelwise {self.in_range_ratio:.2f}.",
                "",
                f"Sphere of {2 * letter.SPHERE_RADIUS_MM:.0f} mm diameter (Table 2)",
                render(_terminal_columns(letter_rows(self.spheres))),
                "Distances between the sphere centres, RMS error: "
                + ", ".join(f"{m} {spacing[m]:.3f} mm" for m in MODELS)
                + ".",
                "",
                f"Object at three depths (experiment 3), reference {self.merged.reference}",
                *pairs,
                "",
                f"Report: {self.report}",
                f"Session: {self.report.parent / 'session'} ({_size_gb(self.report.parent / 'session'):.1f} GB)",
            ]
        )


def _terminal_columns(table: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The columns that fit a terminal; coverage and points set aside stand in the report."""
    return [{k: v for k, v in row.items() if "coverage" not in k and "set aside" not in k} for row in table]


def _size_gb(folder: Path) -> float:
    return sum(f.stat().st_size for f in folder.rglob("*") if f.is_file()) / 1e9
