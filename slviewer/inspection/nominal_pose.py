"""The pose of a scan on a nominal model: fitted, and searched from nothing."""

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.spatial.transform import Rotation

from slviewer.errors import InputError
from slviewer.geometry.rigid import (
    Floats,
    distance_jacobian,
    move_points,
    rigid_transform,
    turn_about,
)
from slviewer.geometry.robust import robust_sigma, tukey_weights
from slviewer.geometry.vectors import (
    rms_length,
    subsample,
    unit_vectors,
)
from slviewer.inspection.nominal_surface import MIN_NORMAL_COSINE, NEGLIGIBLE, NominalSurface
from slviewer.registration.pairwise import LEAST_AGREEMENT, LEAST_OVERLAP, MOST_SLACK, Progress
from slviewer.registration.refine import WORDS, Freedom, Shape, freedom_of
from slviewer.registration.refusal import Refused
from slviewer.registration.scan import PreparedScan, prepare_scan
from slviewer.registration.start import search_starts

SETTLING, SETTLING_ROUNDS = 8, 2
"""Places on either side that a pose is tried at along a motion that normals leave free; then as
many between two of them; and how often along each of several."""
HELD = 0.1
"""Of the points' variance: a motion that adds more to the mean squared distance is held, as by a
small feature."""
UNDAMPED = 1e-9
"""Of the trace of the information of a fit: raised where a step did not reduce the cost."""
SAMPLES = 60_000
"""Points of the nominal that a scan is aligned with, all around it."""
MAX_POINTS, FITTED_POINTS = 40_000, 3_000
"""Points of a scan in the coarse search, and in the fits from there."""
MIN_VISIBLE = 2_000
MIN_COUNTED = 100
RACED_POINTS, RACED_ITERATIONS, FINALISTS, LOSING = 300, 3, 3, 2.0
"""Of a scan by which many poses are fitted roughly; and how many of these, of costs up to so many
times the least, are then fitted by more points."""
REACH = 0.02
"""Of the nominal's diagonal: scan points farther from it do not count in the best fit."""
GOOD_ERROR = 0.002
"""Of the nominal's diagonal, or thrice the noise: points fit well that deviate less."""
EXACT_AGREEMENT = 0.995
"""Share of the points nearby that fit well: fewer may be small features out of place."""
GOOD_OVERLAP, MOST_OVERLAP, GOOD_AGREEMENT, NEAR = 0.6, 0.9, 0.95, 5.0
"""Shares of the scan that lie on the nominal of a likely pose, and of one than which no better is
searched for; there fit well so many of its points within so many reaches of the nominal."""
FAULTY_OVERLAP = 0.5
"""Share of the scan on the nominal of a pose at which a bent part, or one of another size, is
judged."""
PATIENCE, MOST_PATIENCE, BETTER_COST = 3, 8, 0.95
"""Sides searched without a pose of so much lower cost, after one whose points do not all fit well:
a part with an error has no better one; more where hardly half of them fit."""
LEAST_SCORE = 0.1
"""Share of the scan that must lie on the nominal after the coarse search: from there on a pose is
fitted. The part itself reaches 0.5 and more, other parts below 0.15."""
NOISE_COST = 1.2
"""Of a pose that noise explains, over the noise's own cost."""
MAX_ITERATIONS, FEW_ITERATIONS = 40, 10
VIEWS = [
    unit_vectors(np.array(view))
    for view in sorted(
        product((-1, 0, 1), repeat=3), key=lambda v: (np.count_nonzero(v), -abs(v[2]))
    )[1:]
]
"""From where a model is looked at: its sides, from below and above first, then its edges, then its
corners."""
TURNED_POINTS, TURN_ROUNDS = 1_000, 8
SHIFTED_POINTS, RIVAL_SHARE = 120, 0.6
"""Of a scan by which turned and shifted poses are chosen; and of those that lie near the model: so
many do at one that is tried."""
RIVALS = 24
"""Turned and shifted poses that are tried, half of them those of least cost, the others those with
most of the scan near the model."""
NUDGES_DEG, NUDGED = (-3.0, 3.0), 3
"""How far, and how many of the best of these, are turned on."""
FACE_SAMPLES, STEPS, ACROSS = 5_000, 200, 0.9
"""Points of the model, and steps of its extent, by which faces are met whose normals lie so near an
axis (cosine)."""
FLAT_TURNS = np.radians([deg for deg in range(15, 360, 15) if deg % 90])
"""About the axis along which a model is thinnest."""
RIGHT_TURNS = Rotation.create_group("O").as_matrix()
"""The rotations (24, 3, 3) of a cube, which none is among."""
MIN_FACING_COSINE = 0.1
AWAY = 3.0
"""Diagonals: from so far."""


@dataclass(frozen=True, eq=False)
class NominalPose:
    """A scan's pose ``T`` (4, 4) mm, T_nominal_scan, on a nominal model.

    ``cost``: mean of the points' squared distances over that of the reach, each at most 1, and up
    to twice as large where they show the surface from behind; 1 there on a solid. ``overlap``:
    share of the scan on the nominal; ``agreement``: share of these among the points that face it
    nearby. ``is_good``: nearly all points fit well, ``is_exact``: all but a few. ``gate_mm``:
    distance of the points on it.
    """

    T: Floats
    cost: float
    overlap: float
    agreement: float
    is_good: bool
    is_exact: bool
    gate_mm: float

    @property
    def is_likely(self) -> bool:
        """Whether most of the scan lies on the nominal."""
        return self.overlap >= GOOD_OVERLAP and self.agreement >= LEAST_AGREEMENT


def fit_pose(
    points: Floats,
    normals: Floats | None,
    surface: NominalSurface,
    T: np.ndarray,
    reach: float,
    robust: bool = False,
    report: Progress = lambda share: None,
    iterations: int | None = None,
) -> tuple[Floats, Floats, Floats, Floats]:
    """Fit the pose of least squared distances of the points that belong to the nominal, by
    Gauss-Newton, damped where a step does not reduce their capped mean, as along a face that slides
    on itself; ``robust``: by fewer ``iterations``, with Tukey's weights, on either side of it.

    Returns T (4, 4), and of the points in the last iteration their places (k, 3), the Jacobian
    (k, 6) about the mean of these, and distances (k,) mm. Raises InputError for too few.
    """
    trial = np.array(T, np.float64)
    iterations = iterations or (FEW_ITERATIONS if robust else MAX_ITERATIONS)
    damping, least = UNDAMPED, np.inf
    for turn in range(iterations):
        report(turn / iterations)
        off, towards = surface.distances(
            points, normals, trial, reach, either_side=robust, at_edges=robust
        )
        counted, cost = np.isfinite(off), float(np.mean(_cap(off / reach)))
        is_few = np.count_nonzero(counted) < MIN_COUNTED
        if (is_few and turn) or (cost >= least and not robust):  # nothing held the step
            damping *= 100
        elif is_few:
            raise InputError(
                f"Only {np.count_nonzero(counted)} points of the scan lie within {reach:.3g} mm of"
                " the nominal model: does it show that part?"
            )
        else:
            T, least = trial, cost
            moved, away = move_points(T, points[counted]), off[counted]
            middle = moved.mean(axis=0)
            J = distance_jacobian(moved - middle, towards[counted])
            scale = np.repeat([rms_length(moved - middle), 1.0], 3)
            scaled = J / scale
            weighted = scaled * tukey_weights(away, reach / 4.685)[:, None] if robust else scaled
            information, gradient = weighted.T @ scaled, weighted.T @ away
        damped = information + damping * np.trace(information) * np.eye(6)
        change = -np.linalg.solve(damped, gradient) / scale
        if np.abs(J @ change).max() < (1e-3 if robust else 1e-5):
            break
        trial = turn_about(change[:3], middle, change[3:]) @ T
    return T, moved, J, away


def search_pose(
    points: Floats,
    normals: Floats | None,
    surface: NominalSurface,
    sigma_mm: float | None,
    report: Progress,
    has_camera: bool = True,
    views: Sequence[Floats] = VIEWS,
) -> Floats:
    """The pose (4, 4), T_nominal_scan, of a scan's points (n, 3) mm; the nominal's triangles may
    face either way.

    A scan that ``has_camera`` shows one side of a part: poses are searched on what a camera sees of
    the nominal from each of the ``views`` (on all of it first without), and fitted to all of it,
    until one fits well; else the one of least cost is taken. Among the poses of a symmetric part
    the choice does not change the deviations. Raises ``Refused`` where the best does not fit, or
    the shape does not hold it.
    """
    points = subsample(points, MAX_POINTS)
    normals = None if normals is None else subsample(normals, MAX_POINTS)
    scan = prepare_scan("scan", points, normals, sigma_mm, has_camera)
    few, some = subsample(points, FITTED_POINTS), subsample(points, TURNED_POINTS)
    few_normals = None if normals is None else subsample(normals, FITTED_POINTS)
    own = None if normals is None else subsample(normals, TURNED_POINTS)
    best: NominalPose | None = None
    score, in_vain = 0.0, 0
    for side, camera in _list_sides(surface, has_camera, views, report):
        starts = search_starts(scan, side, min(scan.size, side.size))
        score, in_vain = max(score, starts[0].score), in_vain + 1
        poses = [
            rigid_transform(np.eye(3), camera) @ start.T
            for start in starts
            if start.score >= LEAST_SCORE
        ]
        found = _choose_pose(some, own, surface, sigma_mm, poses, best)
        if found is None:
            continue
        if best is None or found.cost < BETTER_COST * best.cost:
            best, in_vain = _improve_pose(some, own, surface, sigma_mm, found), 0
        if best.is_good or in_vain >= (PATIENCE if best.overlap >= GOOD_OVERLAP else MOST_PATIENCE):
            break
    if best is None:
        raise Refused(
            "overlap",
            f"{NOT_ALIGNED}: at most {100 * score:.0f} % of it lies on a side of the model, in any"
            " of its poses.",
        )
    with suppress(InputError):  # the points that it is then judged by fit better than these
        best = _fit_start(few, few_normals, surface, best.T, sigma_mm)
    _refuse_if_doubtful(best)
    T, shape = _settle(few, few_normals, surface, best, MOST_SLACK * scan.size)
    if shape is not None:
        raise Refused(
            shape,
            f"The scan could not be aligned to the nominal model: what it shows of it"
            f" {WORDS[shape]}, so that nothing holds the pose: scan edges, corners or bumps of the"
            " part too, or merge scans of several sides.",
        )
    return T


def _choose_pose(
    points: Floats,
    normals: Floats | None,
    surface: NominalSurface,
    sigma_mm: float | None,
    starts: Sequence[Floats],
    best: NominalPose | None,
) -> NominalPose | None:
    """Return the pose of least cost, ``best`` or one fitted from ``starts`` (4, 4), of which those
    that a few of the points fit best are tried."""
    some = subsample(points, RACED_POINTS)
    own = None if normals is None else subsample(normals, RACED_POINTS)
    raced = list[NominalPose]()
    for T in starts:
        with suppress(InputError):  # hardly any of it lies there
            raced.append(_fit_start(some, own, surface, T, sigma_mm, is_rough=True))
    raced.sort(key=lambda pose: pose.cost)
    for rough in raced[:FINALISTS]:
        if rough.cost > LOSING * min(raced[0].cost, np.inf if best is None else best.cost):
            break
        with suppress(InputError):
            pose = _fit_start(points, normals, surface, rough.T, sigma_mm)
            if best is None or pose.cost < best.cost:
                best = pose
    return best


def _improve_pose(
    points: Floats,
    normals: Floats | None,
    surface: NominalSurface,
    sigma_mm: float | None,
    pose: NominalPose,
) -> NominalPose:
    """Return the pose of least cost among those turned by right angles about the model's main axes,
    as a plate fits in four ways but for its small features; and where no pose is good, by a few
    degrees from there; the pose itself where noise alone is left."""
    # costs are squares of reaches; where the noise is not known, it excuses nothing
    noise_cost = ((sigma_mm or 0) / (REACH * surface.diagonal)) ** 2
    if pose.is_exact and pose.is_good and pose.cost <= NOISE_COST * noise_cost:
        return pose
    for _ in range(TURN_ROUNDS):
        starts = _list_turned(points, normals, surface, pose)
        other = _choose_pose(points, normals, surface, sigma_mm, starts, pose) or pose
        if other.cost > BETTER_COST * pose.cost:
            break
        pose = other
    return pose


def _list_turned(
    points: Floats, normals: Floats | None, surface: NominalSurface, pose: NominalPose
) -> list[Floats]:
    """Return poses (4, 4) at which nearly as much of a scan lies near the model: turned by right
    angles, and moved to where its ends meet; and on by a few degrees where the ``pose`` is not
    exact."""
    some = subsample(points, SHIFTED_POINTS)
    own = None if normals is None else subsample(normals, SHIFTED_POINTS)
    axes, middle = surface.main_axes()
    reach = REACH * surface.diagonal
    places, facing = surface.sample(FACE_SAMPLES)
    either = abs if not surface.is_solid else np.asarray  # of unknown sides
    model = _Faces(places @ axes, either(facing @ axes))
    unknown = np.zeros_like(points) if normals is None else normals
    tried = [pose.T]  # the first stays as it is
    turns = RIGHT_TURNS
    if not pose.is_good:  # a plate fits roughly however it is turned in its plane
        thin = np.eye(3)[np.ptp(model.places, axis=0).argmin()]
        flat = Rotation.from_rotvec(np.outer(FLAT_TURNS, thin)).as_matrix()
        over = 2 * np.diag(np.roll(thin, 1)) - np.eye(3)  # half a turn about an axis in the plane
        turns = np.concatenate([turns, flat, flat @ over])
    for R in axes @ turns @ axes.T:
        T = rigid_transform(R, middle - R @ middle) @ pose.T
        scan = _Faces(move_points(T, points) @ axes, either(unknown @ T[:3, :3].T @ axes))
        tried += _list_shifted(scan, model, axes, T, reach / 2)
    moved = np.concatenate([move_points(T, some) for T in tried])
    turned = None if own is None else np.concatenate([own @ T[:3, :3].T for T in tried])
    off, _ = surface.distances(
        moved, turned, np.eye(4), 2 * reach, either_side=not surface.is_solid
    )
    off = off.reshape(len(tried), -1)
    shares, costs = np.isfinite(off).mean(axis=1), _cap(off / reach).mean(axis=1)
    # half of them by cost: what lies near the model may lie on another of its faces
    ranked = dict.fromkeys((*np.argsort(costs)[: RIVALS // 2], *np.argsort(-shares)[:RIVALS]))
    order = [k for k in ranked if shares[k] >= RIVAL_SHARE * shares[0]][:RIVALS]
    starts = [tried[k] for k in order if k]
    if pose.is_exact:
        return starts
    nudges = [turn_about(np.radians(deg) * axis, middle) for axis in axes.T for deg in NUDGES_DEG]
    return starts + [nudge @ tried[k] for k in order[:NUDGED] for nudge in nudges]


def _list_shifted(
    scan: "_Faces", model: "_Faces", axes: Floats, T: Floats, step: float
) -> list[Floats]:
    """Return a pose (4, 4) as it is, and shifted along any of the model's ``axes`` so that the
    lower or the upper ends of scan and model meet, or most of the faces across it: turned over, a
    plate lies elsewhere. Shifts of less than a ``step`` mm apart are one."""
    low, high = np.percentile(scan.places, [1, 99], axis=0)
    ends = (model.places.min(axis=0) - low, model.places.max(axis=0) - high)
    listed = []
    for each in zip(np.zeros(3), scan.best_shifts(model), *ends, strict=True):
        apart = [x for k, x in enumerate(each) if all(abs(x - y) > step for y in each[:k])]
        listed.append(apart)
    return [rigid_transform(np.eye(3), axes @ shift) @ T for shift in product(*listed)]


@dataclass(frozen=True, eq=False)
class _Faces:
    """``places`` (n, 3) mm of a surface along three axes, and ``facing`` (n, 3) how far it faces
    along each."""

    places: Floats
    facing: Floats

    def best_shifts(self, model: "_Faces") -> Floats:
        """The shifts (3,) mm by which most of the faces across each axis meet those of a model; 0
        where there are none."""
        both = np.concatenate([self.places, model.places])
        edges = np.linspace(both.min(), both.max(), STEPS + 1)
        shifts = np.zeros(3)
        for k in range(3):
            met = np.zeros(2 * STEPS - 1)
            for sign in (1, -1):
                own, others = (
                    np.histogram(faces.places[sign * faces.facing[:, k] > ACROSS, k], edges)[0]
                    for faces in (self, model)
                )
                met += np.correlate(others, own, "full")
            if met.any():
                shifts[k] = (int(met.argmax()) - STEPS + 1) * (edges[1] - edges[0])
        return shifts


def improve_pose(
    points: Floats,
    normals: Floats | None,
    surface: NominalSurface,
    sigma_mm: float | None,
    T: Floats,
) -> Floats:
    """Return the pose (4, 4) of least cost about ``T`` (4, 4) and its right turns."""
    some = subsample(points, TURNED_POINTS)
    own = None if normals is None else subsample(normals, TURNED_POINTS)
    return _improve_pose(
        some, own, surface, sigma_mm, _fit_start(some, own, surface, T, sigma_mm)
    ).T


def _list_sides(
    surface: NominalSurface, has_camera: bool, views: Sequence[Floats], report: Progress
) -> Iterator[tuple[PreparedScan, Floats]]:
    """Yield what a camera sees of the nominal from each of the ``views``, and its centre (3,) mm;
    first all of it, from the origin, for a scan without camera."""
    places, facing = surface.sample(SAMPLES)
    if not has_camera:
        yield prepare_scan("nominal model", places, facing, has_camera=False), np.zeros(3)
    for turn, view in enumerate(views):
        report(turn / len(views))
        towards = np.where(facing @ view < 0, -1.0, 1.0)[:, None] * facing
        visible = surface.seen_from(places, towards, view, MIN_FACING_COSINE)
        if np.count_nonzero(visible) < MIN_VISIBLE:
            continue
        camera = surface.middle + AWAY * surface.diagonal * view
        with suppress(InputError):  # all of a thin model is seen at grazing angles
            yield prepare_scan("nominal model", places[visible] - camera, towards[visible]), camera


NOT_ALIGNED = (
    "The scan could not be aligned to the nominal model: see that it shows this part, at this size,"
    " and that little else is in view"
)


def _fit_start(
    points: Floats,
    normals: Floats | None,
    surface: NominalSurface,
    T: Floats,
    sigma_mm: float | None,
    is_rough: bool = False,
) -> NominalPose:
    """Fit the pose of points (n, 3) from ``T`` (4, 4), coarse to fine, and judge it: the better of
    both; ``is_rough``: by few iterations. InputError where they do not lie on the nominal."""
    reach = REACH * surface.diagonal
    gate = max(reach / 3, 3 * (sigma_mm or 0.0))
    widths = [3 * gate + 2 * reach, 2 * gate, gate]
    if is_rough:
        for within in widths:
            T = fit_pose(points, normals, surface, T, within, True, iterations=RACED_ITERATIONS)[0]
        return _judge_pose(points, normals, surface, T, sigma_mm)
    given = _judge_pose(points, normals, surface, T, sigma_mm)
    for within in widths[1:] if given.is_likely else widths:
        T = fit_pose(points, normals, surface, T, within, robust=True)[0]
    fitted = _judge_pose(points, normals, surface, T, sigma_mm)
    return min(fitted, given, key=lambda pose: pose.cost)


def _judge_pose(
    points: Floats,
    normals: Floats | None,
    surface: NominalSurface,
    T: Floats,
    sigma_mm: float | None,
) -> NominalPose:
    """Judge how well points (n, 3) fit at a pose ``T`` (4, 4)."""
    sigma, reach = sigma_mm or 0.0, REACH * surface.diagonal
    gate, good = max(reach / 3, 3 * sigma), max(GOOD_ERROR * surface.diagonal, 3 * sigma)
    away, towards = surface.signed(move_points(T, points))
    cosine = np.ones(len(points)) if normals is None else ((normals @ T[:3, :3].T) * towards).sum(1)
    near = np.abs(away) < NEAR * reach
    faces = ~(np.abs(cosine) < MIN_NORMAL_COSINE)  # an unknown normal excludes nothing
    off = np.where(faces & (np.abs(away) <= 4 * gate), np.abs(away), np.nan)
    behind = float(np.mean((off <= gate) & (cosine < MIN_NORMAL_COSINE)))
    fitting, cost = np.sum(off <= good), float(np.mean(_cap(off / reach)))
    return NominalPose(
        T,
        cost=cost + behind * (1 if surface.is_solid else cost),
        overlap=float(np.mean(off <= gate)),
        agreement=float(np.sum(off <= gate) / max(1, np.isfinite(off).sum())),
        is_good=bool(fitting >= max(MOST_OVERLAP * len(points), GOOD_AGREEMENT * np.sum(near))),
        is_exact=bool(fitting >= EXACT_AGREEMENT * np.sum(near)),
        gate_mm=gate,
    )


def _cap(off: Floats) -> Floats:
    """Squares of distances (n,) over the reach, at most 1, also for NaN."""
    return np.fmin(off**2, 1.0)


def _settle(
    points: Floats, normals: Floats | None, surface: NominalSurface, pose: NominalPose, most: float
) -> tuple[Floats, Shape | None]:
    """Return the pose (4, 4) moved to where edges hold it, along the motions that the normals of
    what the scan shows leave free: moved on, points lie beyond the surface. Second, the shape by
    the motions that leave the scan on the nominal for more than ``most`` mm at its rim all the
    same; None where it has none."""
    reach = REACH * surface.diagonal

    def mean_square(T: Floats) -> float:
        """Mean squared distance, mm²."""
        off, _ = surface.distances(points, normals, T, reach, either_side=True)
        return reach**2 * float(np.mean(_cap(off / reach)))

    _, moved, J, away = fit_pose(points, normals, surface, pose.T, pose.gate_mm, robust=True)
    middle = moved.mean(axis=0)
    radius = rms_length(moved - middle)
    J = J / np.repeat([radius, 1.0], 3)
    error = max(robust_sigma(away, about=0.0), NEGLIGIBLE)
    freedom = freedom_of(J.T @ J / len(J), error)
    slack, T = freedom.slack_mm.copy(), pose.T
    free = np.flatnonzero(slack > most / 2)
    steps = [(most * m[:3] / radius, most * m[3:]) for m in freedom.motions[free]]
    rounds = SETTLING_ROUNDS if len(steps) > 1 else 1  # one motion opens another
    for turn, shift in rounds * steps:
        shares = np.linspace(-1, 1, 2 * SETTLING + 1)
        for width in (1.0, 1 / SETTLING):
            moves = [turn_about(w * turn, middle, w * shift) @ T for w in width * shares]
            T = min(moves, key=mean_square)
    for k, (turn, shift) in zip(free, steps, strict=True):
        ends = (turn_about(sign * turn, middle, sign * shift) @ T for sign in (1, -1))
        if min(mean_square(end) for end in ends) > mean_square(T) + HELD * error**2:
            slack[k] = 0.0  # edges hold it
    return T, Freedom(np.sort(slack), freedom.motions[np.argsort(slack)]).shape(most)


def _refuse_if_doubtful(pose: NominalPose) -> None:
    """Raise ``Refused`` for a pose that does not fit."""
    is_likely = pose.overlap >= FAULTY_OVERLAP
    if pose.overlap < LEAST_OVERLAP or (pose.agreement < LEAST_AGREEMENT and not is_likely):
        raise Refused(
            "disagree",
            f"{NOT_ALIGNED}: in the best pose only {100 * pose.overlap:.0f} % of it lies on the"
            f" model, {100 * pose.agreement:.0f} % of the points that face it nearby.",
        )
