"""Two rigs in one frame: their place against its U on drawn boards and spheres, and two rendered
rigs on one sphere."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from slviewer.geometry.lens import Lens
from slviewer.geometry.rigid import coverage_radius, invert, move_points, rigid_transform
from slviewer.geometry.shapes import fit_sphere
from slviewer.geometry.vectors import box_middle, rms
from slviewer.operations.hand_eye import measure_board
from slviewer.pipeline.operation import Progress
from slviewer.pipeline.simulate import TARGET
from slviewer.reconstruction.reconstruct import reconstruct_cloud
from slviewer.registration.rig_places import RigFit, Sighting, fit_rig, sight_board, sight_spheres
from slviewer.simulation.boards import Pose, printed_board
from slviewer.simulation.renderer import Renderer
from slviewer.simulation.rig import letter
from slviewer.simulation.scenes import Spheres
from slviewer.simulation.truth import rig_record
from slviewer.surface.fuse import fuse
from slviewer.target.board import Board
from slviewer.validation.bench_scaling import observe_rendered
from tests.perfect_model import PerfectModel
from tests.proofs.hand_eye import disturb
from tests.proofs.proof import BandCheck, Proof, prove_checks
from tests.rendered_calibration import render_phase

RUNS, CAPTURES = 200, 3
BOARD_MM, BOARD_DEG, SPHERE_MM = 0.02, 0.004, 0.01
DEPTH_MM, ANGLE_DEG, RADIUS_MM = 600.0, 50.0, 60.0
RENDERED_SCALE = 0.25


def place_rig(angle_deg: float) -> np.ndarray:
    """Return T_reference_rig (4, 4) of a rig that was turned about what the reference looks at."""
    R = Rotation.from_euler("yx", [angle_deg, 8.0], degrees=True).as_matrix()
    middle = np.array([0.0, 0.0, DEPTH_MM])
    return np.asarray(rigid_transform(R, middle - R @ middle))


def draw_sightings(rng: np.random.Generator, T: np.ndarray, by: str) -> list[Sighting]:
    """Return what two rigs see of one board, or of five spheres, at several places."""
    found = []
    for k in range(CAPTURES):
        turn = Rotation.from_rotvec(rng.normal(0, 0.3, 3)).as_matrix()
        place = np.array([0, 0, DEPTH_MM]) + rng.normal(0, 40, 3)
        own = np.asarray(rigid_transform(turn, place))
        if by == "board":
            noise = np.diag([np.radians(BOARD_DEG) ** 2] * 3 + [BOARD_MM**2] * 3)
            poses = disturb(rng, np.array([own, invert(T) @ own]), BOARD_MM, BOARD_DEG)
            found.append(sight_board(f"shared_{k}", (poses[0], noise), (poses[1], noise)))
        else:
            centres = move_points(own, rng.uniform(-120, 120, (5, 3)))
            other = move_points(invert(T), centres)[rng.permutation(5)]
            sigmas = np.full(5, SPHERE_MM)
            seen = [(each + rng.normal(0, SPHERE_MM, (5, 3)), sigmas) for each in (centres, other)]
            found.append(sight_spheres(f"shared_{k}", seen[0], seen[1]))
    return found


def measure_error(fit: RigFit, T: np.ndarray) -> np.ndarray:
    """Return the error (6,) of a rig's place: a turn (rad) and a shift (mm) at the middle."""
    found = Sighting("", fit.T, fit.covariance, fit.middle)
    return found.difference(T)


@dataclass(frozen=True)
class RenderedRigs:
    """Two rendered rigs on one sphere: the error of their place and U, mm; the merged radius, mm;
    the seam between their parts of the sphere, and the noise of a point, mm."""

    error_mm: float
    U_mm: float
    radius_error_mm: float
    seam_mm: float
    noise_mm: float


def render_rigs(scale: float, seed: int) -> RenderedRigs:
    """Render two rigs that look at one board in three places, then at one sphere, and merge it.

    Their models are the true ones: the errors are those of relating and merging.
    """
    rigs, T = (letter(scale, seed), letter(scale, seed + 1)), place_rig(ANGLE_DEG)
    board = Board.parse(TARGET)
    cameras = [rig_record(rig)["camera"] for rig in rigs]
    lenses = [Lens(np.array(c["K"]), np.array(c["D"]), tuple(c["size"])) for c in cameras]
    models = [PerfectModel(rig) for rig in rigs]
    to_rig = (np.eye(4), invert(T))
    middle, sightings = box_middle(board.points), []
    for k, (tilt, lean) in enumerate(((0, 0), (6, -10), (-6, 10))):
        R = Rotation.from_euler("yx", [ANGLE_DEG / 2 + tilt, lean], degrees=True).as_matrix()
        own = rigid_transform(R, np.array([0, 0, DEPTH_MM + 10 * k]) - R @ middle)
        measured = []
        for rig, model, lens, frame in zip(rigs, models, lenses, to_rig, strict=True):
            pose = frame @ own
            scene = printed_board(board, Pose(pose[:3, :3], pose[:3, 3]), seed=seed)
            observed = observe_rendered(rig, scene, f"shared_{k}", 10 * k)
            found = measure_board(model, lens, board, observed)  # type: ignore[arg-type]
            assert found is not None
            measured.append(found)
        sightings.append(sight_board(f"shared_{k}", measured[0], measured[1]))
    fit = fit_rig(sightings)
    centre, clouds = np.array([0.0, 0.0, DEPTH_MM]), {}
    for name, rig, model, frame in zip("ab", rigs, models, to_rig, strict=True):
        sphere = Spheres(move_points(frame, centre[None]), RADIUS_MM)
        phase = render_phase(Renderer(rig, sphere), name, 7)
        clouds[name] = reconstruct_cloud(model, {"x": phase}, "x")
    merged = fuse(clouds, {"a": np.eye(4), "b": fit.T})
    points = np.asarray(merged.surface.points, float)
    fitted = fit_sphere(points)
    parts = [move_points(M, clouds[n].measured) for n, M in (("a", np.eye(4)), ("b", fit.T))]
    off = [np.linalg.norm(part - fitted.centre, axis=1) - fitted.radius for part in parts]
    shared = [part[np.abs(part[:, 0] - centre[0]) < RADIUS_MM / 3] for part in parts]
    heights = [np.linalg.norm(part - fitted.centre, axis=1) - fitted.radius for part in shared]
    return RenderedRigs(
        float(np.linalg.norm(measure_error(fit, T)[3:])),
        fit.U_mm,
        abs(fitted.radius - RADIUS_MM),
        float(abs(np.median(heights[0]) - np.median(heights[1]))),
        rms(np.concatenate(off)),
    )


def prove_relate_rigs(scale: float, seed: int, progress: Progress) -> Proof:
    """Relate drawn rigs, and count how often the errors are within U; merge one sphere that two
    rendered rigs see."""
    count, rows, checks = max(20, round(RUNS * scale)), [], []
    slack = 3 * np.sqrt(0.95 * 0.05 / count)
    for number, by in enumerate(("board", "spheres")):
        within, errors, ratios = [], [], []
        for k in range(count):
            progress(0.4 * (number + k / count) / 2, f"relating drawn rigs by the {by}")
            rng = np.random.default_rng([seed, number, k])
            T = place_rig(rng.uniform(-120, 120))
            fit = fit_rig(draw_sightings(rng, T, by))
            turn, shift = measure_error(fit, T).reshape(2, 3)
            C = fit.covariance
            within.append(
                [
                    np.linalg.norm(turn) <= coverage_radius(C[:3, :3]),
                    np.linalg.norm(shift) <= coverage_radius(C[3:, 3:]),
                ]
            )
            errors.append(np.linalg.norm(shift))
            ratios.append(fit.ratio or 0.0)
        shares = np.mean(within, axis=0)
        checks += [
            BandCheck(by, f"share of {what} within U", float(share), 0.95 - slack, 1)
            for what, share in zip(("rotations", "translations"), shares, strict=True)
        ]
        checks.append(
            BandCheck(by, "residuals over prediction", float(np.mean(ratios)), 0.85, 1.15)
        )
        rows.append(
            {
                "by": by,
                "rigs": count,
                "median, µm": 1000 * float(np.median(errors)),
                "rotations within U, percent": 100 * float(shares[0]),
                "translations within U, percent": 100 * float(shares[1]),
            }
        )
    progress(0.5, "rendering two rigs")
    seen = render_rigs(RENDERED_SCALE, seed)
    checks += [
        BandCheck("rendered", "error of the place, mm", seen.error_mm, 0, max(seen.U_mm, 0.02)),
        BandCheck("rendered", "error of the radius, mm", seen.radius_error_mm, 0, 0.02),
        BandCheck("rendered", "seam over noise", seen.seam_mm / seen.noise_mm, 0, 1),
    ]
    below = [f"two rendered rigs on one sphere: {seen}"]
    return prove_checks(checks, scale, rows, {"rendered": vars(seen)}, [f"seed {seed}"], below)
