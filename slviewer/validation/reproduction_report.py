"""The reproduction's results as what its report is drawn from."""

from collections.abc import Mapping, Sequence

import numpy as np

from slviewer.calibration.observe import Observation
from slviewer.evaluation import letter
from slviewer.evaluation.compare import Comparison
from slviewer.evaluation.plane import PlaneResult
from slviewer.evaluation.sphere import SphereResult
from slviewer.pipeline.report import curve_at
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
from slviewer.report.reproduction import reproduction_headlines, reproduction_sections, reproduction_title
from slviewer.validation.reproduction import Reproduction

SHOWN_PLANES = (1, 3, 8)
"""Those whose error maps the Letter shows."""
REGIONS = ("R1", "R2", "R3")


def write_reproduction(
    result: Reproduction, observations: Sequence[Observation], pixel: tuple[int, int], seed: int
) -> None:
    """Write ``result.report``; ``pixel`` (u, v) is the one whose curves are drawn."""
    data = _data(result, observations, pixel, seed)
    title, subtitle = reproduction_title(data)
    write_page(result.report, title, subtitle, reproduction_headlines(data), reproduction_sections(data))


def _data(
    result: Reproduction, observations: Sequence[Observation], pixel: tuple[int, int], seed: int
) -> ReproductionData:
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
        planes=[_plane_row(name, c, row) for (name, c), row in zip(result.planes.items(), letter.TABLE_1, strict=True)],
        spheres=[
            _sphere_row(name, c, row) for (name, c), row in zip(result.spheres.items(), letter.TABLE_2, strict=True)
        ],
        spacings=[SpacingRow(name, known, found) for name, (known, found) in result.spacings_mm.items()],
        pairs=[
            MergePair(
                name,
                merged.reference,
                pair.inlier_rmse_mm,
                pair.overlap,
                letter.EXPERIMENT_3_ICP_RMS_MM.get(name[-2:].upper(), float("nan")),
            )
            for name, pair in merged.pairs.items()
        ],
        pixel_curve=curve_at(pixel, pixelwise, stereo, observations, pixelwise.depth_axis),
        rms_maps_mm=fit.rms_mm,
        plane_maps=[error_maps(f"plane_{i:02d}", result.planes[f"plane_{i:02d}"]) for i in SHOWN_PLANES],
        sphere_maps=[error_maps(name, c) for name, c in result.spheres.items()],
        plane_outlines={name: _outline(c, stereo.rig.camera.rays()) for name, c in result.planes.items()},
        clouds=clouds,
        merged=CloudView("merged", whole.surface.points, whole.surface.normals, whole.source, whole.names),
        poses_left_out=stereo.left_out,
        letter_points=letter.EXPERIMENT_3_POINTS,
    )


def _plane_row(name: str, comparison: Comparison, theirs: letter.PlanePose) -> PlaneRow:
    return PlaneRow(
        name=name,
        incidence=comparison.incidence or {},
        rms_mm=_rms(comparison),
        noise_floor_mm=_floor(comparison),
        letter_incidence=dict(zip(REGIONS, theirs.incidence, strict=True)),
        letter_rms_mm={"stereo": theirs.stereo_mm, "pixelwise": theirs.pixelwise_mm},
    )


def _sphere_row(name: str, comparison: Comparison, theirs: letter.SpherePose) -> SphereRow:
    return SphereRow(
        name=name,
        region=theirs.region,
        true_radius_mm=letter.SPHERE_RADIUS_MM,
        rms_mm=_rms(comparison),
        noise_floor_mm=_floor(comparison),
        radius_mm={m: r.radius_mm for m, r in comparison.results.items() if isinstance(r, SphereResult)},
        letter_rms_mm={"stereo": theirs.stereo_mm, "pixelwise": theirs.pixelwise_mm},
        letter_radius_mm={"stereo": theirs.stereo_radius_mm, "pixelwise": theirs.pixelwise_radius_mm},
    )


def error_maps(title: str, comparison: Comparison) -> ErrorMaps:
    """The signed errors of every model over the pixels that counted."""
    maps = {m: np.where(r.inliers, r.error_map, np.nan) for m, r in comparison.results.items()}
    floors = list(_floor(comparison).values())
    return ErrorMaps(title, maps, _rms(comparison), floors[-1])


def _outline(comparison: Comparison, rays: np.ndarray) -> np.ndarray:
    """Points (n, 3) mm of the stereo model's plane, where the pixels that counted look at it."""
    result = comparison.results["stereo"]
    assert isinstance(result, PlaneResult)
    v, u = np.nonzero(result.inliers)
    chosen = np.arange(0, len(u), max(1, len(u) // 5000))
    d = np.column_stack([rays[v[chosen], u[chosen]], np.ones(len(chosen))])
    return d * (result.plane.offset / (d @ result.plane.normal))[:, None]


def _rms(comparison: Comparison) -> Mapping[str, float]:
    return {m: r.rms_mm for m, r in comparison.results.items()}


def _floor(comparison: Comparison) -> Mapping[str, float]:
    return {m: r.noise_floor_mm for m, r in comparison.results.items()}
