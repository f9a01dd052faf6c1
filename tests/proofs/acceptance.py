"""Proof that an acceptance test passes only what it has seen to be right: wrong spheres, ball bars
and planes, features that are covered, and a projector that was turned since the calibration."""

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from slviewer.errors import InputError
from slviewer.evaluation.acceptance import Artefact, conclude_test, measure_artefact
from slviewer.geometry.lens import Lens
from slviewer.geometry.rig import StereoRig
from slviewer.geometry.rigid import Floats, transform_from_rvec
from slviewer.geometry.shapes import fit_sphere
from slviewer.geometry.triangulation import points_from_depth, triangulate
from slviewer.geometry.vectors import unit_vectors
from slviewer.pipeline.operation import Progress, track
from slviewer.reconstruction.cloud import Cloud
from tests.proofs.proof import BandCheck, Proof, prove_checks

Radius = Callable[[Floats], Floats]
"""The radius, mm, of a ball in directions (..., 3) from its centre."""
CASES = 40
"""Of each fault, at scale 1."""
GRAZING = np.cos(np.radians(75.0))
"""Surfaces that are seen or lit less steeply are not measured."""
FACING = np.cos(np.radians(45.0))
"""Faults are put where both devices see the surface this steeply."""
RADIUS_MM, SPACING_MM, SIDE_MM = 19.05, 100.0, 130.0
MOST_FALSE_FAILS, MOST_UNDECIDED = 0.005, 0.02


def make_rig(pixels: int) -> StereoRig:
    """Return a rig whose camera has so many columns, with its projector 180 mm beside it."""
    size = pixels, 3 * pixels // 4
    centre = [(each - 1) / 2 for each in size]
    K = np.array([[2.4 * pixels, 0, centre[0]], [0, 2.4 * pixels, centre[1]], [0, 0, 1.0]])
    turned = transform_from_rvec(np.array([0.0, 0.3, 0.0]), np.zeros(3))[:3, :3]
    Kp = np.array([[1400.0, 0, 455.5], [0, 1400.0, 399.5], [0, 0, 1]])
    projector = Lens(Kp, np.zeros(5), (912, 800))
    place = np.array([180.0, 0.0, 10.0])
    return StereoRig(Lens(K, np.zeros(5), size), projector, turned, -turned @ place)


@dataclass(frozen=True)
class Situation:
    """One test: an artefact as it is, in ``places``, and what a test must not miss.

    ``radii`` of its balls; ``height``: of a plate, mm towards the camera, at its own coordinates
    (..., 2) mm. ``covered``: share of each feature that is not measured, on the side of its fault;
    ``lost``: share of the pixels that are not, anywhere; ``turned``: the projector since the
    calibration, rad; ``same_place``: all positions are one.
    """

    kind: str
    truth: str
    spacing_mm: float = SPACING_MM
    radii: tuple[Radius | float, ...] = ()
    height: Callable[[Floats], Floats] | None = None
    odd_position: bool = False
    covered: float = 0.0
    lost: float = 0.0
    turned: float = 0.0
    same_place: bool = False
    side: Floats = field(default_factory=lambda: np.array([0.0, 0.0, -1.0]))


def make_situation(fault: str, rng: np.random.Generator, limit_mm: float) -> Situation:
    """Return a situation with a fault of 1.5 to 4 times the limit; ``right``: with one below a
    fifth of it."""
    kind, _, what = fault.partition(", ")
    size = limit_mm * rng.uniform(1.5, 4.0)
    side = _visible_direction(rng)
    truth = "right" if what == "right" else "unseen" if what in UNSEEN else "wrong"
    base = Situation(kind, truth, radii=(RADIUS_MM,) * (2 if kind == "bar" else 1), side=side)
    sign = float(rng.choice([-1.0, 1.0]))
    if kind == "plate":
        return replace(base, height=_bend(what, size, limit_mm, rng))
    if what in ("length", "one position"):
        wrong = SPACING_MM + sign * size
        return replace(base, spacing_mm=wrong, odd_position=what == "one position")
    if what == "turned projector":
        return replace(base, turned=sign * rng.uniform(0.002, 0.012))
    if what == "sparse":
        return replace(base, lost=rng.uniform(0.3, 0.8))
    if what in UNSEEN:
        share = 0.0 if what == "same place" else rng.uniform(0.3, 0.6)
        ball = _dented(side, size, 0.5) if what == "covered fault" else RADIUS_MM
        return replace(
            base, radii=(ball, *base.radii[1:]), covered=share, same_place=what == "same place"
        )
    shapes: dict[str, Radius | float] = {
        "right": _oval(side, 0.2 * limit_mm),
        "radius": RADIUS_MM + sign * size,
        "oval": _oval(side, 2.0 * size),
        "dent": _dented(side, size, rng.uniform(0.25, 0.5)),
        "deep dent": _dented(side, 0.06 * RADIUS_MM + size, rng.uniform(0.3, 0.55)),
        "flat": _cut(side, rng.uniform(0.82, 0.95) * RADIUS_MM),
    }
    return replace(base, radii=(shapes[what], *base.radii[1:]))


UNSEEN = ("covered", "covered fault", "same place", "sparse")
FAULTS = (
    "ball, right", "bar, right", "plate, right",
    "ball, radius", "ball, oval", "ball, dent", "ball, deep dent", "ball, flat",
    "ball, turned projector", "bar, turned projector", "bar, radius", "bar, dent", "bar, flat",
    "bar, length", "bar, one position",
    "plate, dent", "plate, deep dent", "plate, step", "plate, bow", "plate, bent corner",
    "ball, covered", "ball, covered fault", "ball, same place", "bar, covered fault",
    "bar, sparse",
)  # fmt: skip


def _visible_direction(rng: np.random.Generator) -> Floats:
    """Return a direction from a ball's centre that both devices see."""
    while True:
        side = unit_vectors(rng.normal(size=3) - [0, 0, 2.0])
        to_projector = unit_vectors(np.array([0.3, 0.0, -1.0]))
        if min(-side[2], side @ to_projector) > FACING:
            return np.asarray(side)


def _oval(side: Floats, range_mm: float) -> Radius:
    return lambda n: RADIUS_MM + range_mm * ((n @ side) ** 2 - 0.75)


def _dented(side: Floats, depth_mm: float, reach: float) -> Radius:
    """Return a ball with a dent of this depth, flat at its ground, within ``reach`` rad."""

    def radius(n: Floats) -> Floats:
        angle = np.arccos(np.clip(n @ side, -1, 1))
        return np.asarray(RADIUS_MM - depth_mm * np.clip(2 * (1 - angle / reach), 0, 1))

    return radius


def _cut(side: Floats, at_mm: float) -> Radius:
    """Return a ball that is cut flat at this distance from its centre."""
    return lambda n: np.minimum(RADIUS_MM, at_mm / np.maximum(n @ side, 1e-3))


def _bend(
    what: str, size: float, limit_mm: float, rng: np.random.Generator
) -> Callable[[Floats], Floats]:
    """Return the height of a plate with a fault."""
    place = rng.uniform(-0.3, 0.3, 2) * SIDE_MM
    radius = rng.uniform(0.08, 0.14) * SIDE_MM
    corner = rng.choice([-1.0, 1.0], 2)
    depth = {"deep dent": 4.0 + size, "dent": size}.get(what, 0.0)

    def height(xy: Floats) -> Floats:
        if what == "bow":
            return np.asarray(size * (2 * xy[..., 0] / SIDE_MM) ** 2)
        if what == "step":
            return np.asarray(size * (xy[..., 0] > place[0]))
        if what == "bent corner":
            beyond = xy @ corner / SIDE_MM - 0.55
            return np.asarray(0.5 * SIDE_MM * np.maximum(beyond, 0.0))
        if what == "right":
            return np.asarray(0.2 * limit_mm * (2 * xy[..., 0] / SIDE_MM) ** 2)
        off = np.linalg.norm(xy - place, axis=-1) / radius
        return np.asarray(-depth * np.clip(3 * (1 - off), 0, 1))

    return height


@dataclass(frozen=True)
class ArtefactView:
    """The true surface (h, w, 3) mm, and which feature each pixel shows, 0 for none."""

    points: Floats
    features: np.ndarray


def view_balls(rig: StereoRig, centres: Floats, situation: Situation) -> ArtefactView:
    """Return what the camera sees of balls at ``centres`` (n, 3) mm, lit by the projector."""
    rays = np.dstack([rig.camera.rays(), np.ones(rig.camera.size[::-1])])
    depth = np.full(rays.shape[:2], np.inf)
    features = np.zeros(depth.shape, int)
    source = -rig.R.T @ rig.t
    for number, (centre, radius) in enumerate(zip(centres, situation.radii, strict=True), 1):
        of = radius if callable(radius) else _constant(radius)
        near = np.linalg.norm(rays * centre[2] - centre, axis=2) < 1.5 * RADIUS_MM
        r, n = rays[near], np.broadcast_to(unit_vectors(-centre), (near.sum(), 3))
        for _ in range(12):
            z = _meet_sphere(r, centre, of(n))
            n = unit_vectors(r * np.nan_to_num(z, nan=centre[2])[:, None] - centre)
        seen = -np.sum(n * unit_vectors(r), axis=1)
        lit = np.sum(n * unit_vectors(source - r * z[:, None]), axis=1)
        shown = (z < depth[near]) & (np.minimum(seen, lit) > GRAZING)
        depth[near] = np.where(shown, z, depth[near])
        features[near] = np.where(shown, number, features[near])
    points = rays * np.where(features > 0, depth, np.nan)[..., None]
    for number, centre in enumerate(centres, 1):
        shown = features == number
        along = (points - centre) @ situation.side
        hidden = shown & (along > np.quantile(along[shown], 1 - situation.covered))
        points[hidden & (situation.covered > 0)] = np.nan
    return ArtefactView(points, features)


def _constant(radius: float) -> Radius:
    return lambda n: np.full(n.shape[:-1], radius)


def _meet_sphere(rays: Floats, centre: Floats, radius: Floats) -> Floats:
    """Return the depth (n,) at which rays (n, 3) meet a ball first; NaN where they do not."""
    b, rr = rays @ centre, np.sum(rays**2, axis=1)
    with np.errstate(invalid="ignore"):
        return np.asarray((b - np.sqrt(b**2 - rr * (centre @ centre - radius**2))) / rr)


def view_plate(rig: StereoRig, T: Floats, situation: Situation) -> ArtefactView:
    """Return what the camera sees of a square plate at T_camera_plate (4, 4)."""
    rays = np.dstack([rig.camera.rays(), np.ones(rig.camera.size[::-1])])
    height = np.zeros(rays.shape[:2])
    assert situation.height is not None
    for _ in range(6):  # the height is towards the camera, along -z of the plate
        z = (T[:3, 2] @ T[:3, 3] - height) / (rays @ T[:3, 2])
        xy = (rays * z[..., None] - T[:3, 3]) @ T[:3, :2]
        height = situation.height(xy)
    inside = (np.abs(xy) < SIDE_MM / 2).all(axis=2)
    return ArtefactView(rays * np.where(inside, z, np.nan)[..., None], inside.astype(int))


def capture_places(
    rig: StereoRig, situation: Situation, rng: np.random.Generator
) -> Iterator[ArtefactView]:
    """Yield the artefact in each position of a test."""
    count = 6 if situation.kind == "plate" else 7
    for i, near in enumerate(np.linspace(480.0, 640.0, count)):
        z = 560.0 if situation.same_place else near + rng.uniform(-8.0, 8.0)
        away = 0.0 if situation.same_place else 1.0
        middle = away * rng.uniform(-0.05, 0.05, 2) * z
        turn = rng.normal(0, 0.2 * away, 3)
        T = transform_from_rvec(turn, np.array([*middle, z]))
        if situation.kind == "plate":
            yield view_plate(rig, T, situation)
            continue
        spacing = SPACING_MM if situation.odd_position and i else situation.spacing_mm
        along = spacing / 2 * np.array([[-1.0], [1.0]]) * T[:3, 0]
        centres = T[:3, 3] + (along if situation.kind == "bar" else np.zeros((1, 3)))
        yield view_balls(rig, centres, situation)


def _measure(rig: StereoRig, turned: float, points: Floats) -> Floats:
    """Return the points that a rig measures whose projector was turned since its calibration."""
    if not turned:
        return points
    R = transform_from_rvec(np.array([0.0, turned, 0.0]), np.zeros(3))[:3, :3]
    now = StereoRig(rig.camera, rig.projector, R @ rig.R, R @ rig.t)
    column = now.project(points.reshape(-1, 3))[:, 0].reshape(points.shape[:2])
    return np.asarray(points_from_depth(rig.camera.rays(), triangulate(rig, column, "x")), float)


def describe_artefact(situation: Situation, limit_mm: float) -> Artefact:
    """Return the certificate of what the artefact should be."""
    kinds = {"ball": "sphere", "bar": "ball-bar", "plate": "plane"}
    values: dict[str, Any] = {"expansion_ppm_K": 11.5, "expansion_U_ppm_K": 1.0}
    if situation.radii:
        values |= {"diameter_mm": 2 * RADIUS_MM, "diameter_U_mm": 0.001}
    if situation.kind == "bar":
        values |= {"spacing_mm": SPACING_MM, "spacing_U_mm": 0.001}
    limits = {"flatness_mm": limit_mm} if situation.kind == "plate" else {"size_mm": limit_mm}
    limits |= {"spacing_mm": limit_mm} if situation.kind == "bar" else {}
    limits |= {} if situation.kind == "plate" else {"form_mm": limit_mm}
    measured = {"temperature_C": 20.0, "temperature_U_K": 0.1, "captures": ["*"]}
    given = {"kind": kinds[situation.kind], "calibrated": values, "measured": measured}
    return Artefact.from_dict({**given, "limits": limits})


def judge_situation(fault: str, rig: StereoRig, rng: np.random.Generator) -> tuple[str, str]:
    """Return the truth of a situation, and the decision of its test."""
    noise_mm = float(rng.uniform(0.005, 0.03))
    limit_mm = max(0.1, 8.0 * noise_mm)
    situation = make_situation(fault, rng, limit_mm)
    artefact, positions = describe_artefact(situation, limit_mm), []
    errors = [0.0]
    for i, capture in enumerate(capture_places(rig, situation, rng)):
        true = _measure(rig, situation.turned, capture.points)
        errors += _list_errors(true, capture.features, situation)
        z = true[..., 2] + rng.normal(0, noise_mm, true.shape[:2])
        z[rng.random(z.shape) < (situation.lost or rng.uniform(0.0, 0.05))] = np.nan
        points = (true * (z / true[..., 2])[..., None]).astype(np.float32)
        sigma = np.where(np.isfinite(z), noise_mm, np.nan).astype(np.float32)
        cloud = Cloud(points, "x", "stereo", sigma)
        try:
            positions.append(
                measure_artefact(artefact, cloud, f"p{i}", f"p{i}", projector=-rig.R.T @ rig.t)
            )
        except InputError:
            return situation.truth, "refused"
    test = conclude_test(artefact, "stereo", positions)
    truth = situation.truth
    if situation.turned:
        truth = "wrong" if max(errors) > 1.2 * limit_mm else "close"
        truth = "right" if max(errors) < 0.5 * limit_mm else truth
    decision = test.decision or "undecided"
    return truth, "undecided" if decision == "pass" and test.lacks else decision


def _list_errors(points: Floats, features: np.ndarray, situation: Situation) -> list[float]:
    """Return the errors of size and spacing of noiseless points, each feature's fitted by all of
    its own, and the range of their form."""
    if not situation.turned:
        return []
    balls = []
    errors = []
    for number in range(1, features.max() + 1):
        own = points[features == number]
        own = own[np.isfinite(own).all(axis=1)]
        balls.append(fit_sphere(own))
        errors += [abs(2 * (balls[-1].radius - RADIUS_MM)), float(np.ptp(balls[-1].distance(own)))]
    if len(balls) == 2:
        apart = float(np.linalg.norm(balls[1].centre - balls[0].centre))
        errors.append(abs(apart - SPACING_MM))
    return errors


def prove_acceptance(scale: float, seed: int, progress: Progress) -> Proof:
    """Test artefacts that are right, wrong, or not seen whole; none that is not right passes."""
    rig, counts = make_rig(320), dict[str, Counter[tuple[str, str]]]()
    cases = max(2, round(CASES * scale))
    for fault, number, report in track(progress, {each: i for i, each in enumerate(FAULTS)}):
        counts[fault] = Counter()
        for case in range(cases):
            rng = np.random.default_rng([seed, number, case])
            counts[fault][judge_situation(fault, rig, rng)] += 1
            report((case + 1) / cases, fault)
    rows = []
    for fault, found in counts.items():
        for truth in sorted({truth for truth, _ in found}):
            answers = {
                answer: found[truth, answer] for answer in ("pass", "fail", "undecided", "refused")
            }
            rows.append({"artefact and fault": fault, "truth": truth, **answers})
    total = Counter[tuple[str, str]]()
    for found in counts.values():
        total.update(found)
    right = sum(n for (truth, _), n in total.items() if truth == "right")
    false_passes = total["wrong", "pass"] + total["unseen", "pass"]
    checks = [
        BandCheck("acceptance", "false passes", false_passes, 0, 0),
        BandCheck("acceptance", "false fails", total["right", "fail"] / right, 0, MOST_FALSE_FAILS),
        BandCheck(
            "acceptance",
            "undecided, right and in full view",
            (total["right", "undecided"] + total["right", "refused"]) / right,
            0,
            MOST_UNDECIDED,
        ),
    ]
    above = [f"{cases} tests of each fault, seed {seed}: truth and decision"]
    return prove_checks(checks, scale, rows, {"seed": seed, "cases": cases}, above)
