"""Results of the repeated experiments, as text, JSON and report."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from slviewer.calibration.observe import Observation
from slviewer.calibration.pixelwise import PixelwiseModel
from slviewer.calibration.stereo import StereoModel
from slviewer.evaluation import letter
from slviewer.evaluation.compare import Comparison
from slviewer.evaluation.render import render
from slviewer.evaluation.tables import letter_rows
from slviewer.pipeline.merge import MergedScans
from slviewer.pipeline.report import curve_at
from slviewer.records.plain import to_plain
from slviewer.report.data import (
    CloudView,
    ErrorMaps,
    MergePair,
    PlaneRow,
    ReproductionData,
    SpacingRow,
    SphereRow,
)
from slviewer.report.page import write_page
from slviewer.report.reproduction import (
    reproduction_headlines,
    reproduction_sections,
    reproduction_title,
)

MODELS = ("stereo", "pixelwise", "splined")


@dataclass(frozen=True)
class Reproduction:
    """The results of all experiments."""

    quick: bool
    stereo: StereoModel
    pixelwise: PixelwiseModel
    planes: Mapping[str, Comparison]
    spheres: Mapping[str, Comparison]
    spacings_mm: Mapping[str, tuple[float, Mapping[str, float]]]
    merged: MergedScans
    report: Path

    @property
    def in_range_ratio(self) -> float:
        """Mean stereo RMS over mean pixelwise RMS, over the planes with at least 87 % of their
        points in R2."""
        inside = [c for c in self.planes.values() if c.incidence and c.incidence["R2"] >= 87.0]
        means = [float(np.mean([c.results[m].rms_mm for c in inside])) for m in MODELS]
        return means[0] / means[1]

    @property
    def spacing_rms_mm(self) -> dict[str, float]:
        """RMS error of the distances between all pairs of sphere centres, by model."""
        return {
            m: float(
                np.sqrt(
                    np.mean(
                        [
                            (measured[m] - known) ** 2
                            for known, measured in self.spacings_mm.values()
                        ]
                    )
                )
            )
            for m in MODELS
        }

    def to_json(self) -> dict[str, Any]:
        """All figures that ``text`` shows, and the values that they are computed from."""
        return {
            "quick": self.quick,
            "reprojection_rms_px": dict(self.stereo.reprojection_rms_px),
            "fit_rms_mm": self.pixelwise.median_rms_mm(self.pixelwise.depth_axis),
            "planes": {name: to_plain(c.record()) for name, c in self.planes.items()},
            "spheres": {name: to_plain(c.record()) for name, c in self.spheres.items()},
            "in_range_ratio": self.in_range_ratio,
            "spacing_rms_mm": self.spacing_rms_mm,
            "merge": to_plain(self.merged.record),
            "report": str(self.report),
        }

    def text(self) -> str:
        """Both tables with the Letter's figures beside ours, and further results."""
        rms, theirs = self.stereo.reprojection_rms_px, letter.REPROJECTION_RMS_PX
        icp = letter.EXPERIMENT_3_ICP_RMS_MM
        spacing = self.spacing_rms_mm
        pairs = [
            f"  {name}: RMS {pair.point_to_point_rms_mm:.3f} mm point to point "
            f"(the Letter: {icp[name[-2:].upper()]:.2f}), "
            f"{pair.rms_mm:.3f} mm point to plane, overlap {100 * pair.overlap:.0f} %"
            for name, pair in self.merged.record.pairs.items()
        ]
        size = "x".join(map(str, self.stereo.rig.camera.size))
        return "\n".join(
            [
                f"Simulated rig, camera {size}, {len(self.stereo.poses)} target poses. RMS in mm.",
                (
                    f"Reprojection RMS: camera {rms['camera']:.3f} px, projector"
                    f" {rms['projector']:.3f} px (the Letter: {theirs['camera']:.3f},"
                    f" {theirs['projector']:.3f})."
                ),
                "",
                "Flat board (Table 1)",
                render(_select_columns(letter_rows(self.planes))),
                f"Planes at least 87 % in R2: stereo over pixelwise {self.in_range_ratio:.2f}.",
                "",
                f"Sphere of {2 * letter.SPHERE_RADIUS_MM:.0f} mm diameter (Table 2)",
                render(_select_columns(letter_rows(self.spheres))),
                "Distances between the sphere centres, RMS error: "
                + ", ".join(f"{m} {spacing[m]:.3f} mm" for m in MODELS)
                + ".",
                "",
                f"Object at three depths (experiment 3), reference {self.merged.record.reference}",
                *pairs,
                "",
                f"Report: {self.report}",
                (
                    f"Session: {self.report.parent / 'session'}"
                    f" ({_folder_size_gb(self.report.parent / 'session'):.1f} GB)"
                ),
            ]
        )


def _select_columns(table: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The columns that fit a terminal, without coverage and excluded points, which the report
    has."""
    return [
        {k: v for k, v in row.items() if "coverage" not in k and "set aside" not in k}
        for row in table
    ]


def _folder_size_gb(folder: Path) -> float:
    """Size of all files below a folder, GB."""
    return sum(f.stat().st_size for f in folder.rglob("*") if f.is_file()) / 1e9


SHOWN_PLANES = (1, 3, 8)
"""Those whose error maps the Letter shows."""
REGIONS = ("R1", "R2", "R3")


def write_reproduction(
    result: Reproduction, observations: Sequence[Observation], pixel: tuple[int, int], seed: int
) -> None:
    """Write ``result.report``; ``pixel`` (u, v) is the one whose curves are drawn."""
    data = _make_report_data(result, observations, pixel, seed)
    title, subtitle = reproduction_title(data)
    write_page(
        result.report, title, subtitle, reproduction_headlines(data), reproduction_sections(data)
    )


def _make_report_data(
    result: Reproduction, observations: Sequence[Observation], pixel: tuple[int, int], seed: int
) -> ReproductionData:
    """The report's input from the results, with the curves of one camera pixel (u, v)."""
    stereo, pixelwise, merged = result.stereo, result.pixelwise, result.merged
    fit = pixelwise.fits[pixelwise.depth_axis]
    clouds = [CloudView(name, cloud.points) for name, cloud in merged.clouds.items()]
    whole = merged.fused
    return ReproductionData(
        camera=stereo.rig.camera.size,
        projector=stereo.rig.projector.size,
        quick=result.quick,
        seed=seed,
        poses=len(stereo.poses),
        depth_range_mm=letter.DEPTH_RANGE_MM,
        reprojection_rms_px=stereo.reprojection_rms_px,
        letter_reprojection_rms_px=letter.REPROJECTION_RMS_PX,
        fit_rms_mm=pixelwise.median_rms_mm(pixelwise.depth_axis),
        planes=[
            _make_plane_row(name, c, row)
            for (name, c), row in zip(result.planes.items(), letter.TABLE_1, strict=True)
        ],
        spheres=[
            _make_sphere_row(name, c, row)
            for (name, c), row in zip(result.spheres.items(), letter.TABLE_2, strict=True)
        ],
        spacings=[
            SpacingRow(name, known, measured)
            for name, (known, measured) in result.spacings_mm.items()
        ],
        pairs=[
            MergePair(
                name,
                merged.record.reference,
                pair.point_to_point_rms_mm or float("nan"),
                pair.overlap,
                letter.EXPERIMENT_3_ICP_RMS_MM.get(name[-2:].upper(), float("nan")),
            )
            for name, pair in merged.record.pairs.items()
        ],
        pixel_curve=curve_at(pixel, pixelwise, stereo, observations, pixelwise.depth_axis),
        rms_maps_mm=fit.rms_mm,
        plane_maps=[
            error_maps(f"plane_{i:02d}", result.planes[f"plane_{i:02d}"]) for i in SHOWN_PLANES
        ],
        sphere_maps=[error_maps(name, c) for name, c in result.spheres.items()],
        plane_outlines={
            name: _outline_plane(c, stereo.rig.camera.rays()) for name, c in result.planes.items()
        },
        clouds=clouds,
        merged=CloudView(
            "merged", whole.surface.points, whole.surface.normals, whole.source, whole.names
        ),
        poses_left_out=stereo.excluded,
        letter_points=letter.EXPERIMENT_3_POINTS,
    )


def _make_plane_row(name: str, comparison: Comparison, theirs: letter.PlanePose) -> PlaneRow:
    """The report's row of one plane, beside the Letter's values."""
    return PlaneRow(
        name=name,
        incidence=comparison.incidence or {},
        rms_mm=_get_rms(comparison),
        noise_floor_mm=_get_noise_floor(comparison),
        letter_incidence=dict(zip(REGIONS, theirs.incidence, strict=True)),
        letter_rms_mm={"stereo": theirs.stereo_mm, "pixelwise": theirs.pixelwise_mm},
    )


def _make_sphere_row(name: str, comparison: Comparison, theirs: letter.SpherePose) -> SphereRow:
    """The report's row of one sphere, beside the Letter's values."""
    return SphereRow(
        name=name,
        region=theirs.region,
        true_radius_mm=letter.SPHERE_RADIUS_MM,
        rms_mm=_get_rms(comparison),
        noise_floor_mm=_get_noise_floor(comparison),
        radius_mm={m: r.radius_mm for m, r in comparison.results.items()},
        letter_rms_mm={"stereo": theirs.stereo_mm, "pixelwise": theirs.pixelwise_mm},
        letter_radius_mm={
            "stereo": theirs.stereo_radius_mm,
            "pixelwise": theirs.pixelwise_radius_mm,
        },
    )


def error_maps(title: str, comparison: Comparison) -> ErrorMaps:
    """The signed errors of every model over the pixels that counted."""
    maps = {m: np.where(r.inliers, r.error_map, np.nan) for m, r in comparison.results.items()}
    floors = list(_get_noise_floor(comparison).values())
    return ErrorMaps(title, maps, _get_rms(comparison), floors[-1])


def _outline_plane(comparison: Comparison, rays: np.ndarray) -> np.ndarray:
    """Points (n, 3) mm of the stereo model's plane on the rays of the evaluated pixels."""
    result = comparison.results["stereo"]
    v, u = np.nonzero(result.inliers)
    chosen = np.arange(0, len(u), max(1, len(u) // 5000))
    d = np.column_stack([rays[v[chosen], u[chosen]], np.ones(len(chosen))])
    return d * (result.plane.offset / (d @ result.plane.normal))[:, None]


def _get_rms(comparison: Comparison) -> Mapping[str, float]:
    """Return the RMS of each model, mm."""
    return {m: r.rms_mm for m, r in comparison.results.items()}


def _get_noise_floor(comparison: Comparison) -> Mapping[str, float]:
    """Noise floor of each model, mm."""
    return {m: r.noise_floor_mm for m, r in comparison.results.items()}
