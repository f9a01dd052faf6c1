"""Whether the splined calibration measures as well as the camera's noise allows, and predicts its
own errors, on simulated rigs with known truth.

Each rig is calibrated with every model, which then measures the Letter's planes and spheres. All of
it happens in memory, one capture after another: a full-size session of so many would fill a disk.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain, combinations
from statistics import fmean
from time import perf_counter
from typing import Any

import numpy as np

from slviewer.calibration.observe import Observation
from slviewer.calibration.pixelwise import calibrate_pixelwise
from slviewer.calibration.splined.model import SplinedModel
from slviewer.calibration.splined.uncertainty import (
    Volume,
    remove_rigid_motion,
    select_depth_axis,
    sigma_3d,
    view_pixels,
    volume_sigmas,
    working_volume,
)
from slviewer.calibration.splined.unknowns import Arrangement
from slviewer.errors import InputError
from slviewer.evaluation.fit import Comparison, ShapeResult, ShapeSearch, fit_clouds
from slviewer.evaluation.letter import DEPTH_RANGE_MM, SPHERE_RADIUS_MM
from slviewer.evaluation.render import Row
from slviewer.fringe.phase import PhaseMap
from slviewer.fringe.sequence import Axis
from slviewer.geometry.vectors import rms
from slviewer.pipeline.operation import Progress, part, track
from slviewer.reconstruction.cloud import Cloud
from slviewer.reconstruction.reconstruct import Model
from slviewer.records.verification import Shape
from slviewer.simulation.boards import FLAT, BoardShape
from slviewer.simulation.plans import letter_plan
from slviewer.simulation.renderer import Renderer
from slviewer.simulation.rig import SimulatedRig, letter
from slviewer.simulation.scenes import Scene, Spheres
from tests.perfect_model import PerfectModel
from tests.proofs.proof import BandCheck, Proof, prove_checks
from tests.rendered_calibration import calibrate_rendered, render_phase

POSES = 25
COVERED = 6
"""Poses in which a pixel must have seen the board to be scored."""
FLOOR = PerfectModel.name
JUDGED = ("stereo", "splined", FLOOR)
"""Scored over the pixels that all three measure; other models over those of them that they measure
too."""
OVER_FLOOR = {"R1": 1.4, "R2": 1.1, "R3": 1.1}
"""Largest ratio of splined's RMS to the floor, in the mean over the planes of a region."""
BELOW_FLOOR = 0.9
"""No model beats the noise: what seems to is scored wrongly."""
OF_STEREO = 0.9
"""Stereo's RMS over splined's is at least this share of stereo's over the floor."""
PREDICTED = 0.1
RADIUS_MM, SPACING_MM = 0.015, 0.04
OVER_STEREO = 1.03
"""Of lenses without local distortion, where stereo lacks nothing."""
MIN_MEASURED = 0.9
"""Share of the pixels to be scored: a model that masks what it measures badly would look better
than it is."""
PREDICTED_BAND = (0.7, 1.5)
"""Of predicted over true error of the calibration, pooled over all rigs."""
GRID = (13, 10, 5)
"""Places where these are compared: columns, rows, depths."""


SphereFits = dict[str, tuple[Spheres, Mapping[str, ShapeResult]]]
"""Of each sphere: what it is, and every model's fit."""
BENT = BoardShape(bow_x_mm=0.1, bow_y_mm=0.1, twist_mm=0.05, misplaced_mm=0.02)


def rig_cases(seed: int, scale: float) -> dict[str, tuple[SimulatedRig, BoardShape]]:
    """The default rig and five others of the Letter's kind, and the shape of the board that each is
    calibrated with; another seed makes six others of the same kinds. ``scale``: resolution of the
    camera, as a share of the Letter's."""
    strong = letter(scale, seed + 3, local_distortion_px=0.2, texture="fine")
    return {
        "coarse": (letter(scale, seed), FLAT),
        "fine": (letter(scale, seed + 1, texture="fine"), FLAT),
        "coarse, bent board": (letter(scale, seed + 2), BENT),
        "fine and strong, bent board": (strong, BENT),
        "coarse again": (letter(scale, seed + 4), FLAT),
        "none": (letter(scale, seed + 5, local_distortion_px=0.0), FLAT),
    }


@dataclass(frozen=True)
class PlaneFigures:
    """``region``: the depth range of most of the plane. ``rms_mm`` by model, the floor included;
    ``predicted_mm``: the floor as the splined model predicts it. ``measured``: share of the pixels
    to be scored that the splined model measures."""

    region: str
    rms_mm: Mapping[str, float]
    predicted_mm: float
    pixels: int
    measured: float


@dataclass(frozen=True)
class RigFigures:
    """The figures of one rig: planes by name, and errors in mm by model, of the spheres' radii and
    of the spacings of their centres. ``seconds``: of rendering, calibrating and measuring."""

    rig: str
    seed: int
    has_local_distortion: bool
    planes: Mapping[str, PlaneFigures]
    radius_error_mm: Mapping[str, Mapping[str, float]]
    spacing_error_mm: Mapping[str, Mapping[str, float]]
    seconds: float


def prove_accuracy(scale: float, seed: int, progress: Progress) -> Proof:
    """Calibrate and measure the six of ``rig_cases``, one rig after another."""
    cases = track(progress, rig_cases(seed, scale))
    return judge_accuracy([measure_rig(name, *case, report) for name, case, report in cases], scale)


def judge_accuracy(rigs: Sequence[RigFigures], scale: float) -> Proof:
    """The proof from the figures of all rigs."""
    title = f"mean plane RMS in mm over pixels seen in {COVERED} poses or more, at scale {scale:g}"
    rows, checks = zip(*map(judge_rig, rigs), strict=True)
    return prove_checks([*chain(*checks)], scale, rows, {"rigs": rigs}, [title])


def judge_rig(rig: RigFigures) -> tuple[Row, list[BandCheck]]:
    """The printed table row of one rig: mean RMS by model, ratios to the floor and the largest
    errors; and the checks of these figures against their bounds."""
    planes = rig.planes.values()

    def mean_mm(model: str, region: str = "") -> float:
        """Mean plane RMS of a model, of one region or of all; NaN where no plane lies there."""
        chosen = [plane.rms_mm[model] for plane in planes if region in ("", plane.region)]
        return fmean(chosen) if chosen else math.nan

    means = {model: mean_mm(model) for model in ("stereo", "pixelwise", "splined", FLOOR)}
    over_floor = {r: mean_mm("splined", r) / mean_mm(FLOOR, r) for r in OVER_FLOOR}
    # of the plane where it is farthest from 1, or unknown
    predicted = max(
        (plane.predicted_mm / plane.rms_mm[FLOOR] for plane in planes),
        key=lambda ratio: math.inf if math.isnan(ratio) else abs(math.log(ratio)),
    )
    measured = float(np.mean([plane.measured for plane in planes]))
    radius, spacing = (
        np.max(np.abs(list(errors["splined"].values())))
        for errors in (rig.radius_error_mm, rig.spacing_error_mm)
    )
    stereo_gain = means[FLOOR] / means["splined"], OF_STEREO, 1 / BELOW_FLOOR
    bounds: dict[str, tuple[float, float, float]] = {
        "stereo over splined, of stereo over the floor,": stereo_gain,
        **{
            f"splined over the floor in {region}": (over_floor[region], BELOW_FLOOR, most)
            for region, most in OVER_FLOOR.items()
            if any(plane.region == region for plane in planes)
        },
        "predicted floor over the floor, of the worst plane,": (
            predicted,
            1 - PREDICTED,
            1 + PREDICTED,
        ),
        "share of the pixels that splined measures": (measured, MIN_MEASURED, 1.0),
        "largest error of a sphere's radius in mm": (radius, 0.0, RADIUS_MM),
        "largest error of a spacing in mm": (spacing, 0.0, SPACING_MM),
    }
    if not rig.has_local_distortion:
        ratio = means["splined"] / means["stereo"]
        bounds["splined over stereo"] = ratio, BELOW_FLOOR, OVER_STEREO
    checks = [BandCheck(rig.rig, what, *bound) for what, bound in bounds.items()]
    row = {
        "rig": rig.rig,
        "seed": rig.seed,
        **means,
        **{f"ratio {region}": ratio for region, ratio in over_floor.items()},
        "predicted ratio": predicted,
        "worst radius": radius,
        "worst spacing": spacing,
        "measured %": 100 * measured,
        "holds": "yes" if all(check.holds for check in checks) else "NO",
        "s": f"{rig.seconds:.0f}",
    }
    return row, checks


def measure_rig(name: str, rig: SimulatedRig, shape: BoardShape, progress: Progress) -> RigFigures:
    """Calibrate a rig from ``POSES`` rendered captures of a board, and measure the Letter's ten
    planes and six spheres with it."""
    start = perf_counter()
    plan = letter_plan(rig, poses=POSES, shape=shape)
    stereo, splined, observations = calibrate_rendered(rig, plan, part(progress, 0.0, 0.6))
    models: dict[str, Model] = {
        "stereo": stereo,
        "pixelwise": calibrate_pixelwise(observations, stereo),
        "splined": splined,
        FLOOR: PerfectModel(rig),
    }
    compared, spheres = measure_shapes(
        models,
        covered_pixels(observations),
        plan,
        lambda scene, number: render_phase(Renderer(rig, scene), "scan", number),
        part(progress, 0.6, 1.0),
    )
    planes: dict[str, PlaneFigures] = {}
    for key, (comparison, measured) in compared.items():
        shares, own = comparison.incidence or {}, comparison.results["splined"]
        planes[key] = PlaneFigures(
            max(shares, key=lambda region: shares[region]),
            {model: result.rms_mm for model, result in comparison.results.items()},
            own.noise_floor_mm,
            own.points,
            measured,
        )
    return RigFigures(
        name,
        rig.seed,
        len(rig.camera.waves) > 0,
        planes,
        {
            model: {
                key: fits[model].radius_mm - scene.radius_mm
                for key, (scene, fits) in spheres.items()
                if model in fits
            }
            for model in models
        },
        {model: spacing_errors(spheres, model) for model in models},
        perf_counter() - start,
    )


def measure_shapes(
    models: Mapping[str, Model],
    covered: np.ndarray,
    plan: Mapping[str, Scene],
    scan: Callable[[Scene, int], PhaseMap],
    progress: Progress,
) -> tuple[dict[str, tuple[Comparison, float]], SphereFits]:
    """Every model's fits to the planes and spheres of a plan as ``scan(scene, number)`` sees them,
    and of planes the share of the pixels that splined measures."""
    shapes = {key: scene for key, scene in plan.items() if key.startswith(("plane_", "sphere_"))}
    planes, spheres = dict[str, tuple[Comparison, float]](), SphereFits()
    for key, scene, _ in track(progress, shapes):
        shape: Shape = "sphere" if isinstance(scene, Spheres) else "plane"
        found = compare_fits(models, scan(scene, [*plan].index(key)), covered, shape)
        if isinstance(scene, Spheres):
            spheres[key] = scene, found[0].results
        else:
            planes[key] = found
    return planes, spheres


def spacing_errors(spheres: SphereFits, model: str) -> dict[str, float]:
    """Errors, mm, of the distances between the centres that a model measures, by their names."""
    known = [(key, *found) for key, found in spheres.items() if model in found[1]]
    return {
        f"{a} - {b}": math.dist(fits[model].sphere.centre, others[model].sphere.centre)
        - math.dist(first.centres[0], second.centres[0])
        for (a, first, fits), (b, second, others) in combinations(known, 2)
    }


def covered_pixels(observations: Sequence[Observation]) -> np.ndarray:
    """(h, w) bool: the camera pixels that saw the board in at least ``COVERED`` poses."""
    width, height = observations[0].size
    poses = np.zeros((height, width), int)
    for o in observations:
        u0, v0, u1, v1 = o.box
        poses[v0:v1, u0:u1] += o.region
    return np.asarray(poses >= COVERED)


def compare_fits(
    models: Mapping[str, Model], phase: PhaseMap, covered: np.ndarray, shape: Shape
) -> tuple[Comparison, float]:
    """Every model's fit to one capture over the covered pixels, and the share of these that splined
    measures."""
    clouds = {}
    for name, model in models.items():
        points = model.points(phase)
        sigma = model.sigma_z(phase, points)
        clouds[name] = Cloud(
            np.where(covered[..., None], points, np.float32(np.nan)), phase.axis, name, sigma
        )
    comparison = fit_clouds(
        shape,
        {name: clouds[name] for name in JUDGED},
        phase.illuminated,
        depth_range=DEPTH_RANGE_MM,
        radius=SPHERE_RADIUS_MM,
    )
    start = comparison.results["splined"].shape
    for name in clouds.keys() - set(JUDGED):
        points, sigma = clouds[name].points, clouds[name].sigma_z
        try:
            search = ShapeSearch(shape, points, sigma)
            comparison.results[name] = search.evaluate(comparison.common, start)
        except InputError:
            continue  # it measures nothing there
    to_score = comparison.region & clouds["stereo"].mask & clouds[FLOOR].mask
    return comparison, float(comparison.common.sum() / max(to_score.sum(), 1))


@dataclass(frozen=True, eq=False)
class PredictedErrors:
    """One calibration: ``predicted`` (n,) mm and ``true`` (n,) mm errors over its working volume,
    in 3D without the rigid motion that fits the supported places best; ``supported`` (n,) bool."""

    predicted: np.ndarray
    true: np.ndarray
    supported: np.ndarray

    def row(self, rig: str) -> dict[str, Any]:
        """The figures in mm; NaN where target poses support everything."""
        inside, elsewhere = self.supported, ~self.supported
        predicted, true, predicted_elsewhere, true_elsewhere = (
            rms(errors[places])
            for places in (inside, elsewhere)
            for errors in (self.predicted, self.true)
        )
        return {
            "rig": rig,
            "supported": float(np.mean(inside)),
            "predicted": predicted,
            "true": true,
            "ratio": predicted / true,
            "below_2_sigma": float(np.mean((self.true < 2 * self.predicted)[inside])),
            "ratio_elsewhere": predicted_elsewhere / true_elsewhere,
        }


def prove_uncertainty(scale: float, seed: int, progress: Progress) -> Proof:
    """Calibrate rigs of different lenses and boards from rendered captures, and compare what each
    predicts of its errors with these. ``scale``: resolution of the camera, as a share of the
    Letter's.

    Raises CalibrationRejected where one cannot be calibrated.
    """
    rigs = {}
    for name, (rig, shape), report in track(progress, rig_cases(seed, scale)):
        plan = letter_plan(rig, poses=POSES, shape=shape)
        rigs[name] = compare_with_truth(calibrate_rendered(rig, plan, report)[1], rig)
    return judge_uncertainty(rigs, scale)


def judge_uncertainty(rigs: Mapping[str, PredictedErrors], scale: float) -> Proof:
    """The proof: whether the ratio of predicted to true errors, pooled over the rigs, lies in
    ``PREDICTED_BAND``."""
    fields = zip(*(vars(each).values() for each in rigs.values()), strict=True)
    pooled = PredictedErrors(*map(np.concatenate, fields)).row("pooled")
    rows = [each.row(name) for name, each in rigs.items()] + ([pooled] if len(rigs) > 1 else [])
    table = [
        {
            "rig": row["rig"],
            "supported %": 100 * row["supported"],
            "predicted um": round(1000 * row["predicted"], 1),
            "true um": round(1000 * row["true"], 1),
            "predicted / true": round(row["ratio"], 2),
            "below 2 sigma %": round(100 * row["below_2_sigma"], 1),
            "where no pose captures": round(row["ratio_elsewhere"], 2),
        }
        for row in rows
    ]
    least, most = PREDICTED_BAND
    holds = least <= pooled["ratio"] <= most
    line = (
        f"predicted over true 3D error, pooled over {len(rigs)} rigs of {POSES} poses at scale"
        f" {scale:g}: {pooled['ratio']:.2f} {'lies' if holds else 'does NOT lie'} between {least}"
        f" and {most}; where no pose captures {pooled['ratio_elsewhere']:.2f}"
    )
    return Proof(
        holds, scale, table, {"poses": POSES, "ratio": pooled["ratio"], "rigs": rows}, below=[line]
    )


def compare_with_truth(model: SplinedModel, true: SimulatedRig) -> PredictedErrors:
    """The errors that a calibration of a simulated rig predicts over the working volume, and its
    true ones."""
    bundle, rig = model.bundle, model.rig
    columns, rows, depths = GRID
    volume = working_volume(rig, bundle.depth_range_mm, columns=columns, rows=rows, depths=depths)
    axis = select_depth_axis(rig, volume)
    errors = true_errors(true, rig, volume, axis)
    known = np.isfinite(errors).all(axis=1)
    volume = volume.select(known)
    supported = volume.supported(rig, bundle.camera_poses > 0, bundle.projector_poses > 0)
    predicted = volume_sigmas(bundle, axis, volume)
    return PredictedErrors(
        predicted,
        sigma_3d(remove_rigid_motion(errors[known].reshape(1, -1), volume.points, supported)),
        supported,
    )


def true_errors(true: SimulatedRig, rig: Arrangement, volume: Volume, axis: Axis) -> np.ndarray:
    """(n, 3) mm: the point that the calibrated ``rig`` measures for camera pixels at the volume's
    depths, less the true one; NaN where a lens has no answer."""
    row = 0 if axis == "x" else 1
    rays = np.column_stack([true.camera.undistort(volume.pixels), np.ones(len(volume.z))])
    points = rays * volume.z[:, None]
    measured = true.project(points)[:, row]
    z = volume.z.copy()
    for _ in range(6):  # Newton, the slope from a step of a ten-thousandth
        here, there = (
            view_pixels(rig, volume.pixels, depths)[1][:, row] for depths in (z, 1.0001 * z)
        )
        z = z + 1e-4 * z * (measured - here) / (there - here)
    return view_pixels(rig, volume.pixels, z)[0] - points
