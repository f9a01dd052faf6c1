"""The Letter's experiments repeated on the simulated rig, with its tables beside ours: as text,
JSON and report."""

import json
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from slviewer.calibration.observe import Observation
from slviewer.calibration.pixelwise import PixelwiseModel
from slviewer.calibration.stereo import StereoModel
from slviewer.errors import InputError, UsageError
from slviewer.evaluation import letter
from slviewer.evaluation.fit import Comparison
from slviewer.geometry.vectors import thin_out
from slviewer.inputs import SEED
from slviewer.pipeline.calibrate import CalibrateSettings, calibrate
from slviewer.pipeline.merge import MergedScans, MergeSettings, merge_scans
from slviewer.pipeline.models import load_model, load_stereo
from slviewer.pipeline.operation import Job, Progress, Warn, ignore_progress, ignore_warnings, part
from slviewer.pipeline.poses import load_observations
from slviewer.pipeline.reconstruct import VerifySettings, compare_captures
from slviewer.pipeline.report import curve_at
from slviewer.pipeline.simulate import TARGET, TRUTH, simulate
from slviewer.records.record import Column, Row, Table, render_text, to_plain
from slviewer.records.verification import Shape, Verification, average, centre_distances_mm
from slviewer.report.page import write_page
from slviewer.report.reproduction import (
    ReproductionData,
    inside_ratio,
    reproduction_headlines,
    reproduction_sections,
    reproduction_title,
)
from slviewer.session.layout import is_session
from slviewer.session.store import Session
from slviewer.simulation.rig import check_scale

MODELS = ("stereo", "pixelwise", "splined")
QUICK_SCALE = 0.5
SESSION, MERGED = "session", "merged.ply"
FULL_SIZE = (1600, 1200)
BYTES_PER_PIXEL = 2200
"""Of the disk, per pixel of the camera: 2051 at scale 0.5, 2311 at 0.25."""
PIXEL = (500, 500)
"""Where the Letter shows its curves, at full resolution."""
OBJECTS = ("object_r1", "object_r2", "object_r3")
SHAPES: tuple[tuple[Shape, float, float], ...] = (("plane", 0.65, 0.75), ("sphere", 0.75, 0.82))
"""Shapes whose captures are compared, and the progress from and to which that takes."""
SHOWN_PLANES = (1, 3, 8)
"""Those whose error maps the Letter shows."""


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
        return inside_ratio(_list_records(self.planes))[0]

    @property
    def spacing_rms_mm(self) -> dict[str, float]:
        """RMS error of the distances between all pairs of sphere centres, by model."""
        errors = {
            m: [(measured[m] - known) ** 2 for known, measured in self.spacings_mm.values()]
            for m in MODELS
        }
        return {m: float(np.sqrt(np.mean(squares))) for m, squares in errors.items()}

    def to_json(self) -> dict[str, Any]:
        """All figures that ``text`` shows, and the values that they are computed from."""
        return {
            "quick": self.quick,
            "reprojection_rms_px": dict(self.stereo.reprojection_rms_px),
            "fit_rms_mm": self.pixelwise.median_rms_mm(self.pixelwise.depth_axis),
            "planes": to_plain(_list_records(self.planes)),
            "spheres": to_plain(_list_records(self.spheres)),
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
        planes, spheres = _list_records(self.planes), _list_records(self.spheres)
        pairs = [
            f"  {name}: RMS {pair.point_to_point_rms_mm:.3f} mm point to point "
            f"(the Letter: {icp[name[-2:].upper()]:.2f}), "
            f"{pair.rms_mm:.3f} mm point to plane, overlap {100 * pair.overlap:.0f} %"
            for name, pair in self.merged.record.pairs.items()
        ]
        size = "x".join(map(str, self.stereo.rig.camera.size))
        session = self.report.parent / SESSION
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
                _render_shapes(planes),
                f"Planes at least 87 % in R2: stereo over pixelwise {self.in_range_ratio:.2f}.",
                "",
                f"Sphere of {2 * letter.SPHERE_RADIUS_MM:.0f} mm diameter (Table 2)",
                _render_shapes(spheres),
                "Distances between the sphere centres, RMS error: "
                + ", ".join(f"{m} {spacing[m]:.3f} mm" for m in MODELS)
                + ".",
                "",
                f"Object at three depths (experiment 3), reference {self.merged.record.reference}",
                *pairs,
                "",
                f"Report: {self.report}",
                f"Session: {session} ({measure_disk_gb(session):.1f} GB)",
            ]
        )


def reproduce(
    out: Path | str | None = None,
    *,
    quick: bool = False,
    scale: float | None = None,
    seed: Annotated[int, SEED] = 0,
    say: Warn = ignore_warnings,
    progress: Progress = ignore_progress,
    warn: Warn = ignore_warnings,
) -> Reproduction:
    """Repeat the Letter's experiments on the simulated rig, and put its figures beside ours.

    Args:
        quick: Half resolution; its figures are its own.
        scale: Resolution of the camera, as a share of 1600x1200 px; by default 1, or 0.5 with
            --quick.
        out: Folder for the session and the report; by default reproduction, or reproduction-quick.
        seed: Another seed is another rig of the same kind.

    The session stays in ``out/session``, and serves the next run with the same settings. ``say`` is
    called with the disk space that this takes before anything is computed.
    """
    out = choose_folder(out, quick)
    session = out / SESSION
    if scale is None:
        scale = QUICK_SCALE if quick else 1.0
    elif quick:
        raise UsageError(f"--quick is --scale {QUICK_SCALE:g}", "give one of both")
    check_scale(scale)
    say(_check_disk(out, scale))
    _simulate(session, scale, seed, part(progress, 0.0, 0.4))
    calibrate.run(session, CalibrateSettings(TARGET, MODELS), part(progress, 0.4, 0.65), warn)
    with Session.open(session) as store:
        names = store.capture_names("scan")
        stereo, pixelwise = load_stereo(store), load_model(store, "pixelwise")
        observations = load_observations(store, list(stereo.poses))
        assert isinstance(pixelwise, PixelwiseModel)
        comparisons = []
        for shape, start, end in SHAPES:
            compared = compare_captures(
                Job(store, part(progress, start, end), warn),
                VerifySettings(
                    [name for name in names if name.startswith(shape)],
                    shape,
                    MODELS,
                    letter.DEPTH_RANGE_MM,
                    letter.SPHERE_RADIUS_MM,
                ),
            )
            comparisons.append({each.capture.name: each.found for each in compared})
        planes, spheres = comparisons
        settings = MergeSettings(OBJECTS, OBJECTS[-1], out / MERGED, "pixelwise")
        with merge_scans(Job(store, part(progress, 0.82, 0.9)), settings) as merged:
            spacings = _compare_spacings(session, spheres)
    result = Reproduction(
        quick=quick,
        stereo=stereo,
        pixelwise=pixelwise,
        planes=planes,
        spheres=spheres,
        spacings_mm=spacings,
        merged=merged,
        report=out / "report.html",
    )
    progress(0.92, "drawing the report")
    pixel = (round((PIXEL[0] + 0.5) * scale - 0.5), round((PIXEL[1] + 0.5) * scale - 0.5))
    data = _make_report_data(result, observations, pixel, seed)
    headlines, sections = reproduction_headlines(data), reproduction_sections(data)
    write_page(result.report, *reproduction_title(data), headlines, sections)
    progress(1.0, "reproduced")
    return result


def choose_folder(out: Path | str | None, quick: bool) -> Path:
    """Return the folder of the session and the report: the given one, else one of the working
    folder."""
    return Path(out or ("reproduction-quick" if quick else "reproduction"))


def clean_reproduction(out: Path) -> str:
    """Remove the session and the merged cloud that `reproduce` left in a folder, and return what
    was removed. The report stays.

    Raises InputError where the folder holds no session that was simulated for this.
    """
    session = out / SESSION
    if not _load_truth(session):
        raise InputError(
            f"{out} holds no session of an earlier run", "give its folder with --out, or --quick"
        )
    used_gb = measure_disk_gb(out)
    shutil.rmtree(session)
    (out / MERGED).unlink(missing_ok=True)
    return f"{used_gb - measure_disk_gb(out):.1f} GB removed from {out}"


def measure_disk_gb(folder: Path) -> float:
    """Return the size of all files in a folder, GB."""
    return sum(file.stat().st_size for file in folder.rglob("*") if file.is_file()) / 1e9


def _check_disk(out: Path, scale: float) -> str:
    """Return how much disk space the results take, and where. Raises InputError where there is too
    little."""
    there = next(each for each in (out.absolute(), *out.absolute().parents) if each.is_dir())
    free_gb = shutil.disk_usage(there).free / 1e9
    width, height = (scale * side for side in FULL_SIZE)
    needed_gb = BYTES_PER_PIXEL * width * height / 1e9
    missing_gb = needed_gb - (measure_disk_gb(out) if out.is_dir() else 0.0)
    if missing_gb > free_gb:
        raise InputError(
            f"The session takes about {needed_gb:.1f} GB, and {free_gb:.1f} GB are free at {there}",
            "choose another folder with --out, or --quick",
        )
    return (
        f"The session takes about {needed_gb:.1f} GB in {out.absolute()} ({free_gb:.0f} GB are"
        " free); --clean removes it"
    )


def _simulate(session: Path, scale: float, seed: int, progress: Progress) -> None:
    """Simulate the session unless it has this scale and seed already; raises an error if it has
    other data."""
    if is_session(session):
        made = _load_truth(session)
        if (made.get("scale"), made.get("seed")) == (scale, seed):
            return
        with Session.open(session) as store:
            if made or store.capture_names():
                raise InputError(
                    f"{session} holds another simulation",
                    "choose another folder with --out, or delete it",
                )
        shutil.rmtree(session)  # an interrupted run's, with nothing in it
    simulate(session, scale=scale, seed=seed, progress=progress)


def _load_truth(session: Path) -> dict[str, Any]:
    """The stored ground truth of a simulated session; empty where there is none."""
    path = session / TRUTH
    truth: dict[str, Any] = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
    return truth


def _compare_spacings(
    session: Path, spheres: Mapping[str, Comparison]
) -> dict[str, tuple[float, Mapping[str, float]]]:
    """{pair: (true distance, distance by model)} of the sphere centres, mm: scored against the
    simulation's truth."""
    centres = {
        name: np.array(record["centres"][0])
        for name, record in _load_truth(session)["spheres"].items()
    }
    return {
        f"{a} - {b}": (float(np.linalg.norm(centres[a] - centres[b])), measured)
        for (a, b), measured in centre_distances_mm(_list_records(spheres)).items()
    }


def _make_report_data(
    result: Reproduction, observations: Sequence[Observation], pixel: tuple[int, int], seed: int
) -> ReproductionData:
    """The report's input from the results, with the curves of one camera pixel (u, v)."""
    stereo, pixelwise, merged = result.stereo, result.pixelwise, result.merged
    axis = pixelwise.depth_axis
    shown = {name: result.planes[name] for name in (f"plane_{i:02d}" for i in SHOWN_PLANES)}
    return ReproductionData(
        quick=result.quick,
        seed=seed,
        stereo=stereo,
        pixel_curve=curve_at(pixel, pixelwise, stereo, observations, axis),
        rms_maps_mm=pixelwise.fits[axis].rms_mm,
        planes=_list_records(result.planes),
        spheres=_list_records(result.spheres),
        spacings_mm=result.spacings_mm,
        error_maps={
            name: {
                f"error_{m}": np.where(r.inliers, r.error_map, np.nan)
                for m, r in each.results.items()
            }
            for name, each in {**shown, **result.spheres}.items()
        },
        plane_outlines={
            name: _outline_plane(c, stereo.rig.camera.rays()) for name, c in result.planes.items()
        },
        merge=merged.record,
        clouds={name: cloud.points for name, cloud in merged.clouds.items()},
        fused=merged.fused,
    )


def _render_shapes(found: Mapping[str, Verification]) -> str:
    """The table of planes or spheres for the terminal: a line for each capture and one of means,
    with the Letter's figures beside ours."""
    shape = next(iter(found.values())).shape
    theirs = {name: letter.find_pose(name, shape) for name in found}
    rows = [_make_row(name, each, theirs[name]) for name, each in found.items()]
    ours, letters = (average(shape, each.values()) for each in (found, theirs))
    mean = _make_row("mean", ours, letters)
    mean |= {title: mm for title, mm in letter.MEANS_MM.items() if title in mean}
    return render_text(Table.of(rows, footer=[mean]))


def _make_row(name: str, ours: Verification, theirs: Verification) -> Row:
    """The figures of one capture by each model, and the Letter's."""
    shares = (f"{share:.1f}".removesuffix(".0") for share in (ours.incidence or {}).values())
    row: Row = {"capture": name, Column("R1/R2/R3 %", align="right"): "/".join(shares) or None}
    for model, fit in ours.models.items():
        row |= {f"{model} mm": fit.rms_mm, f"{model} floor": fit.noise_floor_mm}
        if fit.radius_mm is not None:
            row[f"{model} radius"] = fit.radius_mm
    first, second = MODELS[:2]
    row["ratio"] = ours.rms_mm[first] / ours.rms_mm[second]
    row |= {f"Letter {model}": mm for model, mm in theirs.rms_mm.items()}
    if theirs.models:
        row["Letter ratio"] = theirs.rms_mm[first] / theirs.rms_mm[second]
    return row | {f"Letter {model} radius": mm for model, mm in theirs.radii_mm.items()}


def _list_records(comparisons: Mapping[str, Comparison]) -> dict[str, Verification]:
    """The figures of comparisons without their maps."""
    return {name: each.record() for name, each in comparisons.items()}


def _outline_plane(comparison: Comparison, rays: np.ndarray) -> np.ndarray:
    """Points (n, 3) mm of the stereo model's plane on the rays of the evaluated pixels."""
    result = comparison.results["stereo"]
    v, u = thin_out(np.argwhere(result.inliers), 5000).T
    d = np.column_stack([rays[v, u], np.ones(len(u))])
    return d * (result.plane.offset / (d @ result.plane.normal))[:, None]
