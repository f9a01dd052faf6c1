"""Whether an inspection plan passes no wrong part and fails no right one: drawn parts with drawn
faults, measured in full or from one side with noise, spikes and clamps, against the truth."""

import tempfile
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import trimesh

from slviewer.inspection.regions import Region
from slviewer.pipeline.inspect_parts import inspect_surfaces
from slviewer.pipeline.measure import MeasuredSurface
from slviewer.pipeline.operation import Progress
from slviewer.records.acceptance import Decision
from slviewer.records.inspection import Characteristic, CharacteristicResult
from slviewer.registration.open3d_loader import open3d, raycasting_scene
from slviewer.session.inspection_plan import Alignment, Plan, PlanFeature
from tests.proofs.faulty_parts import (
    Array,
    FaultyPart,
    Rng,
    best_fit,
    draw_planned_part,
    fit_true,
    move_by,
    true_datum_frame,
    true_value,
    weigh,
)
from tests.proofs.proof import BandCheck, Proof, prove_checks

PARTS = 400
"""Parts at full size, each with some thirty characteristics."""
MOST_FALSE_FAILS, MOST_UNDECIDED = 0.005, 0.02
"""Share of the right characteristics that fail; of the clearly right ones that are undecided."""
CLEAR = 0.5
"""Share of the tolerance within which a part seen in full, with the lower noise and not locally
wrong there, must be decided."""
ENOUGH = {"plane": 500, "cylinder": 1_600, "sphere": 1_600}
"""Points of a feature, from which on it must be decided: a section of it holds a tenth."""
LOCAL = ("dent", "burr", "flat")
SHOWN, MIN_EVIDENCE = 0.25, 6
"""Of a local fault's size: so many points of the feature must deviate by more, or it is not
shown."""
Truth = Literal["right", "wrong", "unclear"]
DATUMS = ("base", "left", "front")
FITTED = (*DATUMS, "block", "pin", "hole", "dome")
KINDS = {"plane": "flatness", "cylinder": "cylindricity", "sphere": "roundness"}


@dataclass(frozen=True)
class PlanCase:
    """One characteristic of one part: its truth, and what the program said."""

    seed: int
    kind: str
    feature: str
    fault: str
    tolerances: float
    view: str
    alignment: str
    truth: Truth
    value: float
    limit: float
    is_clear: bool
    result: CharacteristicResult

    def text(self) -> str:
        """The case in one line."""
        r = self.result
        measured = "" if r.value is None else f"{r.value:.4g} ± {r.U or 0:.2g}, "
        return (
            f"seed {self.seed}: {self.kind} of {self.feature}, {self.fault} of"
            f" {self.tolerances:g} tolerances, {self.view}, {self.alignment}: {r.decision}"
            f" ({measured}true {self.value:.4g}, limit {self.limit:.4g}) {r.reason}"
        )


@dataclass(frozen=True, eq=False)
class MeasuredPart:
    """How a part is measured: its cloud in the camera's frame, ``T_camera_part`` (4, 4), whether
    places are seen, and the true motion into the plan's frame."""

    surface: MeasuredSurface
    T_camera_part: Array
    is_full: bool
    camera: Array
    mesh: Any
    names: Array
    clean: Array

    def seen(self, places: Array, normals: Array) -> Array:
        """Which places (n, 3) with normals (n, 3) to the outside the camera sees, (n,) bool."""
        return is_seen(self.mesh, self.camera, places, normals)


def is_seen(mesh: Any, camera: Array, places: Array, normals: Array) -> Array:
    """Which places of a part are seen from a camera (3,), in the part's frame."""
    towards = camera - places
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    facing = np.sum(towards * normals, axis=1) > 0.3
    starts = places + 0.01 * float(mesh.bounds[1].max()) * normals
    rays = open3d().core.Tensor(np.hstack([starts, towards]).astype(np.float32))
    hidden = raycasting_scene(mesh.vertices, mesh.faces).test_occlusions(rays).numpy()
    return np.asarray(facing & ~hidden)


def make_mesh(part: FaultyPart) -> Any:
    """The nominal mesh."""
    meshes = [trimesh.Trimesh(*patch.mesh(), process=False) for patch in part.patches.values()]
    return trimesh.util.concatenate(meshes)


def measure_part(
    part: FaultyPart, rng: Rng, points: int, noise: float, is_full: bool
) -> MeasuredPart:
    """Draw the cloud of a part: noise (mm) along the normals, a clamp in half of the cases, and
    isolated wrong points."""
    S = part.size_mm
    mesh = make_mesh(part)
    turn = rng.uniform(0, 2 * np.pi)
    tilt = np.radians(rng.uniform(10, 35))
    towards = np.array([np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.cos(tilt)])
    camera = 4 * S * towards
    side = np.cross(towards, [0.0, 0.0, 1.0])
    side /= np.linalg.norm(side)
    R = np.array([side, np.cross(-towards, side), -towards])
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, -R @ camera
    total = sum(weigh(each) * each.area for each in part.patches.values())
    names, places, normals = [], [], []
    for name, patch in part.patches.items():
        n = round(points * weigh(patch) * patch.area / total)
        source = part.replaced.get(name, patch) if part.fault.kind == "missing" else patch
        where, facing = part.true_points(
            name, (source if name == part.fault.feature else patch).draw(n, rng)
        )
        names.append(np.full(n, name))
        places.append(where)
        normals.append(facing)
    if rng.uniform() < 0.5:
        where, facing = _draw_clamp(part, rng, points)
        names.append(np.full(len(where), "clamp"))
        places.append(where)
        normals.append(facing)
    owner, clean, facing = (np.concatenate(each) for each in (names, places, normals))
    if not is_full:
        seen = is_seen(mesh, camera, clean, facing)
        owner, clean, facing = owner[seen], clean[seen], facing[seen]
    cloud = clean + noise * rng.normal(size=(len(clean), 1)) * facing
    wrong = rng.choice(len(cloud), int(rng.uniform(0.001, 0.005) * len(cloud)), replace=False)
    away = rng.normal(size=(len(wrong), 3))
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    reach = np.exp(rng.uniform(np.log(3 * part.tolerance_mm), np.log(0.1 * S), (len(wrong), 1)))
    cloud[wrong] += reach * away
    devices = np.array([[0.0, 0, 0], [0.3 * S, 0, 0]])
    surface = MeasuredSurface(
        move_by(T, cloud).astype(np.float32),
        np.full(len(cloud), noise, np.float32),
        "part",
        "" if is_full else "splined",
        {},
        normals=(facing @ R.T).astype(np.float32) if rng.uniform() < 0.5 else None,
        views=() if is_full else (devices,),
    )
    return MeasuredPart(surface, T, is_full, camera, mesh, owner, clean)


def _draw_clamp(part: FaultyPart, rng: Rng, points: int) -> tuple[Array, Array]:
    """Points of a small box beside the pin, the hole, the dome or the block, and their normals."""
    patch = part.patches[str(rng.choice(["pin", "hole", "dome", "block"]))]
    r, half = abs(patch.size[0]), part.size_mm / 40
    angle = np.pi / 2 * rng.integers(4)  # on the feature's own tile, and beside no other
    gap = rng.uniform(r + 1.3 * half, max(r + 1.4 * half, part.size_mm / 6 - half))
    middle = np.r_[patch.origin[:2] + gap * np.array([np.cos(angle), np.sin(angle)]), 2 * half]
    count = points // 60
    local, normals = rng.uniform(-1, 1, (count, 3)), np.zeros((count, 3))
    which, sign = rng.integers(0, 3, count), rng.choice([-1.0, 1.0], count)
    normals[np.arange(count), which] = sign
    local[np.arange(count), which] = sign
    return middle + local * half * [1, 1, 2], normals


def draw_plan(part: FaultyPart, scene: MeasuredPart, rng: Rng, kind: str, nominal: Path) -> Plan:
    """The plan of a part, in its own frame, or in the camera's where nothing aligns it."""
    S, T = part.size_mm, np.eye(4)
    if kind == "none":
        T = scene.T_camera_part
    elif kind == "3-2-1":
        T = np.linalg.inv(place_corner(part))
    margin, inside = S * rng.uniform(0.02, 0.05), float(rng.choice([0.9, 1.05]))
    features = []
    for name in FITTED:
        patch = part.patches[name]
        a, b = patch.size
        if patch.kind == "plane":
            half = np.array([0.9 * a, 0.9 * b, margin])
        elif patch.kind == "cylinder":
            half = np.array([a + margin, a + margin, inside * b])
        else:
            half = np.array([a + margin] * 3)
        region = Region("box", patch.origin, half, patch.axes)
        if patch.kind == "sphere" and inside > 1:
            region = Region.ball(patch.origin, a + margin)
        place = tuple(move_by(T, patch.origin[None])[0].tolist())
        axis = None if patch.kind == "sphere" else tuple((T[:3, :3] @ patch.axes[2]).tolist())
        radius = None if patch.kind == "plane" else a
        region = region.moved(T)
        features.append(PlanFeature(name, patch.kind, region, place, axis, radius))  # type: ignore[arg-type]
        if kind == "best fit":
            features.append(PlanFeature(f"{name} surface", "surface", region))
    alignment = Alignment()
    if kind == "3-2-1":
        start = T @ np.linalg.inv(scene.T_camera_part)
        alignment = Alignment(
            "3-2-1",
            None,
            DATUMS,
            tuple(map(tuple, start.tolist())),  # type: ignore[arg-type]
        )
    elif kind == "best fit":
        alignment = Alignment("best fit", str(nominal))
    return Plan("faults", tuple(features), tuple(_list_characteristics(part, kind)), alignment)


def _list_characteristics(part: FaultyPart, alignment: str) -> Iterator[Characteristic]:
    """Yield the characteristics of a part with their limits."""
    t, at = part.tolerance_mm, part.patches

    def about(kind: str, names: tuple[str, ...], value: float, unit: str = "mm") -> Characteristic:
        off = t if unit == "mm" else float(np.degrees(t / at["left"].size[0]))
        name = f"{' '.join(names)} {kind}"
        return Characteristic(name, kind, names, value, value - off, value + off, unit)

    for name in FITTED:
        form = KINDS[at[name].kind]
        yield Characteristic(f"{name} {form}", form, (name,), upper=t)
        yield Characteristic(f"{name} position", "position", (name,), upper=2 * t)
        if at[name].kind != "plane":
            yield about("diameter", (name,), 2 * at[name].size[0])
        if alignment == "best fit":
            yield Characteristic(f"{name} profile", "profile", (f"{name} surface",), upper=2 * t)
    for name in ("pin", "hole"):
        yield Characteristic(f"{name} roundness", "roundness", (name,), upper=t)
        yield Characteristic(f"{name} square", "perpendicularity", (name, "base"), upper=t)
    yield Characteristic("left square", "perpendicularity", ("left", "base"), upper=t)
    yield Characteristic("block parallel", "parallelism", ("block", "base"), upper=t)
    yield about("distance", ("block", "base"), at["block"].origin[2] - at["base"].origin[2])
    across = at["pin"].origin[:2] - at["hole"].origin[:2]
    yield about("distance of the axes", ("pin", "hole"), float(np.linalg.norm(across)))
    yield about("height of the centre", ("base", "dome"), 0.0)
    upper = float(np.degrees(t / at["left"].size[0]))
    yield Characteristic("left angle", "angle", ("left", "base"), 90, 90 - upper, 90 + upper, "deg")
    yield Characteristic("block angle", "angle", ("block", "base"), 0, None, upper, "deg")


def judge_planned_part(seed: int) -> list[PlanCase]:
    """Draw one part, inspect it by its plan, and compare each verdict with the truth."""
    rng = np.random.default_rng([seed, 77])
    points = int(rng.integers(5_000, 20_000))
    part = draw_planned_part(rng, points)
    t = part.tolerance_mm
    share = float(rng.choice([0.1, 1 / 3]))
    is_full = bool(rng.uniform() < 0.6)
    kind = str(rng.choice(["none", "3-2-1", "best fit"], p=[0.45, 0.45, 0.1]))
    scene = measure_part(part, rng, points, share * t, is_full)
    with tempfile.TemporaryDirectory() as folder:
        nominal = Path(folder, "part.ply")
        if kind == "best fit":
            scene.mesh.export(nominal)
        plan = draw_plan(part, scene, rng, kind, nominal)
        inspection = inspect_surfaces(plan, [("part", lambda report: scene.surface)])
    truths = [_fit_all(part, scene, kind, only_seen) for only_seen in (False, True)]
    if kind == "best fit":  # how far a fault moves the part depends on what the fit weighs
        truths += [_fit_all(part, scene, "none", only_seen) for only_seen in (False, True)]
    off, feet = _find_feet(scene.mesh, scene.clean)
    is_clamp = scene.names == "clamp"
    near = np.concatenate([scene.clean[is_clamp], feet[is_clamp]])
    hidden = {each.name for each in plan.feature if each.region.within(near).any()}
    deviating = off[scene.names == part.fault.feature] > SHOWN * abs(part.fault.mm)
    is_shown = part.fault.kind not in LOCAL or int(deviating.sum()) >= MIN_EVIDENCE
    setup = _Setup(seed, "full" if is_full else "one side", kind, share)
    return [
        _judge(setup, part, scene, wanted, result, truths, hidden, is_shown)
        for wanted, result in zip(plan.characteristic, inspection.parts[0].results, strict=True)
    ]


def _find_feet(mesh: Any, points: Array) -> tuple[Array, Array]:
    """Distances (n,) mm of points (n, 3) from the nominal mesh, and the nearest places (n, 3)."""
    scene = raycasting_scene(mesh.vertices, mesh.faces)
    tensor = open3d().core.Tensor(points.astype(np.float32))
    feet = scene.compute_closest_points(tensor)["points"].numpy().astype(np.float64)
    return np.linalg.norm(points - feet, axis=1), feet


@dataclass(frozen=True)
class _Setup:
    """Of a part: its ``seed``, view and alignment, and ``noise`` as a share of the tolerance."""

    seed: int
    view: str
    alignment: str
    noise: float


def _judge(
    setup: _Setup,
    part: FaultyPart,
    scene: MeasuredPart,
    wanted: Characteristic,
    result: CharacteristicResult,
    truths: Sequence[dict[str, Any]],
    hidden: set[str],
    is_shown: bool,
) -> PlanCase:
    """Compare one verdict with its truths, of all of the part and of what is seen."""
    fault, names = part.fault, tuple(name.removesuffix(" surface") for name in wanted.features)
    values = [_value_of(wanted.kind, names, part, found) for found in truths]
    inside = [_is_inside(value, wanted) for value in values]
    truth: Truth = "unclear"
    # what a clamp stands on is as wrong as one that has grown there
    if len(set(inside)) == 1 and not (wanted.kind == "profile" and hidden & {*wanted.features}):
        truth = "right" if inside[0] else "wrong"
    own = fault.feature in names
    if own and not is_shown:
        truth = "unclear"
    assert wanted.upper is not None
    return PlanCase(
        setup.seed,
        wanted.kind,
        " ".join(names),
        fault.kind if own or fault.kind == "shrunk" else "elsewhere",
        fault.tolerances,
        setup.view,
        setup.alignment,
        truth,
        values[0],
        wanted.upper,
        _is_clear(part, scene, setup, names, _deviation(values[0], wanted)),
        result,
    )


def _is_clear(
    part: FaultyPart, scene: MeasuredPart, setup: _Setup, names: Sequence[str], off: float
) -> bool:
    """Whether a right characteristic, ``off`` by a share of its tolerance, must be decided."""
    if part.fault.feature in names and part.fault.kind in LOCAL:
        return False
    if setup.alignment == "3-2-1" and part.fault.feature in DATUMS:
        return False  # features may lie where the plan has others
    is_dense = all(np.sum(scene.names == n) >= ENOUGH[part.patches[n].kind] for n in names)
    return scene.is_full and is_dense and setup.noise < 0.2 and off <= CLEAR


def _deviation(value: float, wanted: Characteristic) -> float:
    """How far a value is off its nominal, as a share of the tolerance."""
    assert wanted.upper is not None
    if wanted.lower is None:
        return value / wanted.upper
    middle = (wanted.lower + wanted.upper) / 2
    return abs(value - middle) / (wanted.upper - middle)


def _is_inside(value: float, wanted: Characteristic) -> bool:
    """Whether a true value is within the limits."""
    low = -np.inf if wanted.lower is None else wanted.lower
    return bool(low <= value <= (np.inf if wanted.upper is None else wanted.upper))


def _fit_all(part: FaultyPart, scene: MeasuredPart, kind: str, only_seen: bool) -> dict[str, Any]:
    """The true features in the frame of the plan; without those that are missing, or of which less
    than 200 places are seen."""
    fits, points = {}, {}
    seen = scene.seen if only_seen and not scene.is_full else None
    for name in FITTED:
        own = part.dense(name, seen)
        if len(own) >= 200 and not (part.fault.kind == "missing" and name == part.fault.feature):
            points[name] = own
            fits[name] = fit_true(part.patches[name], own, part.patches[name].axes[2])
    T = np.eye(4)
    if kind == "3-2-1" and {*DATUMS} <= fits.keys():
        T = place_corner(part) @ true_datum_frame(fits)
    elif kind == "best fit":
        belongs = scene.names != "clamp"
        T = best_fit(part, scene.names[belongs], scene.clean[belongs])
    return {
        name: fit_true(part.patches[name], move_by(T, own), part.patches[name].axes[2])
        for name, own in points.items()
    }


def place_corner(part: FaultyPart) -> Array:
    """The motion (4, 4) from the frame of the nominal datums to that of the part."""
    T = np.eye(4)
    T[:3, 3] = [-3 * part.size_mm / 6, -2 * part.size_mm / 6, 0.0]
    return T


def _value_of(kind: str, names: tuple[str, ...], part: FaultyPart, found: dict[str, Any]) -> float:
    """The true value of a characteristic; infinite where a feature is missing."""
    if any(name not in found for name in names):
        return np.inf
    return true_value(kind, names, part, found)


def prove_plan_faults(scale: float, seed: int, progress: Progress) -> Proof:
    """Inspect parts with one fault each, and count verdicts by truth.

    ``scale``: share of the parts of a full run. Right characteristics count as clearly right where
    the part is seen in full with noise of a tenth of the tolerance, and is off by at most half of
    it by a fault that is not local; where the value and U overlap the limit else, undecided is
    right. What depends on a side that is not seen is counted apart.
    """
    count = max(2, round(scale * PARTS))
    cases: list[PlanCase] = []
    for i in range(count):
        progress(i / count, f"part {i + 1} of {count}")
        cases += judge_planned_part(1_000_000 * seed + i)
    return summarize_verdicts(cases, scale)


def summarize_verdicts(cases: Sequence[PlanCase], scale: float) -> Proof:
    """The tables of truth and verdict by kind of characteristic and by fault, and the cases whose
    verdict is wrong."""
    wrong = [c for c in cases if c.truth == "wrong"]
    right = [c for c in cases if c.truth == "right"]
    clear = [c for c in right if c.is_clear]
    passes = [c for c in wrong if c.result.decision == "pass"]
    fails = [c for c in right if c.result.decision == "fail"]
    undecided = [c for c in clear if c.result.decision == "undecided"]
    rows = [
        _list_row(f"{field}: {value}", [c for c in cases if getattr(c, field) == value])
        for field in ("kind", "fault")
        for value in dict.fromkeys(getattr(c, field) for c in cases)
    ]
    checks = [
        BandCheck("wrong", "number that pass", len(passes), 0, 0),
        BandCheck("right", "share that fails", len(fails) / len(right), 0, MOST_FALSE_FAILS),
        BandCheck(
            "clearly right",
            "share undecided",
            len(undecided) / max(len(clear), 1),
            0,
            MOST_UNDECIDED,
        ),
    ]
    lines = [f"FALSE PASS {c.text()}" for c in passes] + [f"FALSE FAIL {c.text()}" for c in fails]
    lines += [f"UNDECIDED {c.text()}" for c in undecided[:60]]
    return prove_checks(checks, scale, rows, {"cases": cases}, below=lines)


def _list_row(title: str, cases: Sequence[PlanCase]) -> dict[str, Any]:
    """Counts of truth x verdict."""
    row: dict[str, Any] = {"characteristic": title}
    decisions: tuple[Decision, ...] = ("pass", "fail", "undecided")
    for truth in ("right", "wrong", "unclear"):
        counts = Counter(c.result.decision for c in cases if c.truth == truth)
        row |= {f"{truth} {decision}": counts[decision] for decision in decisions}
    return row
