"""Hand-eye calibration: where a camera is on a robot's flange, or beside a robot that carries the
board. A closed form gives the start (OpenCV 5.0 offers its own to C++ alone); a joint refinement
weights robot and camera by their uncertainties.

With A = T_base_flange (eye in hand) or its inverse (eye to hand), every pose of the board obeys
``A X B = Z``: ``B`` = T_camera_board is measured, X = T_flange_camera (T_base_camera) and
Z = T_base_board (T_flange_board) are sought. Small motions (6,) are a rotation vector (rad), then a
shift (mm)."""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from typing import Literal

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from scipy.special import chdtri

from slviewer.errors import InputError
from slviewer.geometry.rigid import (
    Floats,
    Mask,
    adjoint,
    coverage_radius,
    invert,
    move_by,
    rigid_transform,
    rotation_angle,
)
from slviewer.geometry.vectors import rms

Mounting = Literal["eye-in-hand", "eye-to-hand"]
MIN_POSES = 4
"""Three determine the twelve unknowns; a fourth shows whether they are right."""
MIN_TURN_DEG = 2.0
"""RMS rotation about a second axis below which the place along the first one is not determined: a
position noise of 0.05 mm would be amplified thirty times."""
MIN_TURN_SIGMAS = 10.0
ALIKE_DEG = 1.0
"""Largest median difference of the angles by which robot and camera turn, of what fits."""
REPEATED_DEG, REPEATED_SHARE = 2.0, 0.05
"""Rotation, and shift as a share of the spread of all poses, within which one repeats another."""
MAX_RATIO, MAX_SHARE = 3.0, 0.02
"""Residuals over their prediction, and over the spread of the poses, up to which poses belong to
their captures: an error of order, unit or convention leaves a residual of the poses' spread."""
EXPLAINED = 1.5
"""Residuals over their prediction up to which the noise explains them: 12 poses reach 1.3."""
ROUGH_SHARE = 0.2
BETTER = 5.0
"""Times smaller residuals by which another reading of the poses is preferred."""
OUTLIER = float(chdtri(6, 1e-4))
MOST_SHIFTED = 3
TRIALS, TRIAL_POSES = 100, 5
HALF_TURN = np.radians(170.0)


@dataclass(frozen=True, eq=False)
class HandEyeViews:
    """Poses of the robot and what the camera measured at each.

    ``robot`` (n, 4, 4): T_base_flange, mm, with standard deviations ``sigma_mm`` and ``sigma_rad``
    of each axis; ``board`` (n, 4, 4): T_camera_board, mm, with covariances (n, 6, 6) of small
    motions in the board's frame. ``symmetry``: in how many orientations about its z axis, through
    its origin, the board looks the same, so that ``board`` may be in any of them.
    """

    names: tuple[str, ...]
    robot: Floats
    board: Floats
    covariance: Floats
    sigma_mm: float
    sigma_rad: float
    mounting: Mounting = "eye-in-hand"
    symmetry: int = 1

    def select(self, chosen: np.ndarray) -> "HandEyeViews":
        """Return some of the poses, by indices or a mask."""
        names = tuple(np.array(self.names)[chosen].tolist())
        return replace(
            self,
            names=names,
            robot=self.robot[chosen],
            board=self.board[chosen],
            covariance=self.covariance[chosen],
        )

    def orient(self) -> "HandEyeViews":
        """Return the poses with a symmetric board turned so that it turns from pose to pose by the
        angles of the robot."""
        board, robot = self.board.copy(), self.robot[:, :3, :3]
        for i in range(1, len(board) if self.symmetry > 1 else 0):
            ways = board[i] @ self.ways
            seen = rotation_angle(np.swapaxes(board[:i, None, :3, :3], -1, -2) @ ways[:, :3, :3])
            turned = rotation_angle(np.swapaxes(robot[:i], -1, -2) @ robot[i])
            board[i] = ways[np.argmin(np.abs(seen - turned[:, None]).sum(0))]
        return replace(self, board=board)

    @property
    def ways(self) -> Floats:
        """(symmetry, 4, 4): the turns after which the board looks the same."""
        angles = np.arange(self.symmetry) * 2 * np.pi / self.symmetry
        return rigid_transform(Rotation.from_euler("z", angles[:, None]).as_matrix(), np.zeros(3))

    @property
    def A(self) -> Floats:
        """(n, 4, 4): what maps the camera's carrier to what carries the board."""
        return self.robot if self.mounting == "eye-in-hand" else invert(self.robot)

    @cached_property
    def spread_mm(self) -> float:
        """RMS distance of the camera's places, as seen from the board, from their middle."""
        places = invert(self.board)[:, :3, 3]
        return rms(np.linalg.norm(places - places.mean(0), axis=1))

    def residuals(self, X: Floats, Z: Floats) -> Floats:
        """(n, 6): the small motions from Z to A X B, in the board's frame."""
        E = invert(Z) @ self.A @ X @ self.board
        turns = Rotation.from_matrix(E[:, :3, :3]).as_rotvec()
        return np.hstack([turns, E[:, :3, 3]])

    def whiteners(self, X: Floats) -> Floats:
        """(n, 6, 6): what residuals are multiplied by to get unit variance: of the robot's noise at
        the board, and of the camera's."""
        to_board = invert(X @ self.board)
        if self.mounting == "eye-to-hand":
            to_board = invert(self.A @ X @ self.board)
        J = adjoint(to_board)
        noise = np.diag([self.sigma_rad**2] * 3 + [self.sigma_mm**2] * 3)
        covariance = J @ noise @ np.swapaxes(J, -1, -2) + self.covariance
        return np.linalg.inv(np.linalg.cholesky(covariance))


@dataclass(frozen=True, eq=False)
class HandEyeFit:
    """The solution: ``X`` and ``Z`` (4, 4) mm, their ``covariance`` (12, 12), of turns (rad) and
    shifts (mm) of X, then Z, in the frames that they map to, raised by ``ratio`` squared: the
    residuals over their prediction. ``residuals`` (n, 6) of the ``views`` used; ``rows``
    (n, 6, 12): their whitened derivatives. ``excluded``: why others were not used, by name."""

    views: HandEyeViews
    X: Floats
    Z: Floats
    covariance: Floats
    residuals: Floats
    rows: Floats
    ratio: float
    excluded: dict[str, str]

    @property
    def share(self) -> float:
        """RMS of the residual shifts over the spread of the poses."""
        shifts = np.linalg.norm(self.residuals[:, 3:], axis=1)
        return rms(shifts) / max(self.views.spread_mm, 1e-9)

    @property
    def fits(self) -> bool:
        """Whether the poses belong to their captures."""
        return self.ratio <= MAX_RATIO or self.share <= MAX_SHARE

    @property
    def is_explained(self) -> bool:
        """Whether the noise explains every residual."""
        outliers = _is_outlier(_distances(self.views, self.X, self.Z))
        return self.ratio <= EXPLAINED and not outliers.any()

    @cached_property
    def gains(self) -> Floats:
        """(n,): by which share U of the translation or the rotation of X, whichever more, is larger
        without each pose; inf where the others do not determine it."""
        N = np.einsum("nij,nik->jk", self.rows, self.rows)
        found = _split_traces(np.linalg.inv(N))
        gains = np.full(len(self.rows), np.inf)
        for k, J in enumerate(self.rows):
            without = N - J.T @ J
            if np.linalg.cond(_balance(without)) < 1e10:
                gains[k] = np.sqrt(_split_traces(np.linalg.inv(without)) / found).max() - 1
        return gains

    def repeated(self) -> dict[str, str]:
        """Return {pose: an earlier one that it repeats}."""
        views, found = self.views, dict[str, str]()
        for i, name in enumerate(views.names):
            E = invert(views.board[:i]) @ views.board[i]
            moved = np.linalg.norm(views.board[:i, :3, 3] - views.board[i, :3, 3], axis=1)
            alike = (np.degrees(rotation_angle(E[:, :3, :3])) < REPEATED_DEG) & (
                moved < REPEATED_SHARE * views.spread_mm
            )
            if alike.any():
                found[name] = views.names[int(np.argmax(alike))]
        return found


@dataclass(frozen=True, eq=False)
class Reading:
    """Another way to read poses of a robot: in words, and T_base_flange (n, 4, 4) mm."""

    what: str
    robot: Floats


@dataclass(frozen=True, eq=False)
class Order:
    """Another order of the poses: in words, and the indices of poses and of their captures."""

    what: str
    poses: np.ndarray
    captures: np.ndarray


def solve_hand_eye(views: HandEyeViews, readings: Sequence[Reading] = ()) -> HandEyeFit:
    """Solve X and Z from poses that are matched to captures.

    Poses that contradict all others are excluded. Raises InputError for too few poses, motions that
    do not determine the result, and poses that do not belong to their captures: with the reading
    among ``readings``, or the order, that does fit.
    """
    check_motions(views)
    views = views.orient()
    fit = _fit_consensus(views)
    if fit.fits:
        return fit
    best = fit.ratio / BETTER, ""
    orders = _list_orders(len(views.names))
    for reading, order in product((*_list_readings(views), *readings), orders):
        other = replace(views.select(order.captures), robot=reading.robot[order.poses]).orient()
        solved = _try_fit(other) if _is_plausible(other) else None
        if solved is not None and solved.ratio < best[0] and solved.fits:
            best = 0.5 * solved.ratio, " and ".join(filter(None, (reading.what, order.what)))
            if solved.ratio <= EXPLAINED:
                break
    left = rms(np.linalg.norm(fit.residuals[:, 3:], axis=1))
    observed = (
        f"the {len(views.names)} poses of the robot do not belong to their captures: the board"
        f" would be {left:.3g} mm RMS off its place, in motions of {views.spread_mm:.3g} mm"
    )
    if best[1]:
        raise InputError(observed, f"they fit if {best[1]}: correct that, and run this again")
    raise InputError(
        observed,
        "no other order, unit or convention fits either; check that each pose was read while its"
        " capture was taken, that board and robot's base did not move, and that all poses are of"
        " one tool",
    )


def check_motions(views: HandEyeViews) -> None:
    """Raise InputError where the poses are too few, or their rotations do not determine the
    result: which, and what to add."""
    n = len(views.names)
    if n < MIN_POSES:
        raise InputError(
            f"{n} poses of the robot have a capture of the board, and at least {MIN_POSES} are"
            " needed",
            "add poses that tilt the flange by 20 to 40 degrees about different axes",
        )
    turns, axes = measure_turns(views)
    noise = np.sqrt(2) * np.degrees(views.sigma_rad)
    least = max(MIN_TURN_DEG, MIN_TURN_SIGMAS * noise)
    if turns[0] < least:
        raise InputError(
            f"the {n} poses only shift the robot: they turn by {turns[0]:.2g} degrees RMS, and the"
            " place of the camera shows in rotations alone",
            "add poses that tilt the flange by 20 to 40 degrees about two axes",
        )
    if turns[1] < least:
        axis = ", ".join(f"{each:.2f}" for each in axes[0] + 0.0)
        across = "xyz"[int(np.argmin(np.abs(axes[0])))]
        raise InputError(
            f"all rotations of the {n} poses are about parallel axes, ({axis}) of the flange: they"
            f" turn by {turns[1]:.2g} degrees RMS about any other, so that the camera's place along"
            " that axis is not determined",
            f"add poses that also turn the flange by 20 to 40 degrees about its {across} axis",
        )


def measure_turns(views: HandEyeViews) -> tuple[Floats, Floats]:
    """Return the RMS rotation, degrees, between poses about three axes of the flange, the largest
    first, and these unit vectors (3, 3), in rows."""
    R = views.robot[:, :3, :3]
    i, j = np.triu_indices(len(R), 1)
    turns = Rotation.from_matrix(np.swapaxes(R[i], 1, 2) @ R[j]).as_rotvec(degrees=True)
    values, vectors = np.linalg.eigh(turns.T @ turns / len(turns))
    return np.sqrt(np.maximum(values[::-1], 0)), vectors.T[::-1]


def _fit_consensus(views: HandEyeViews) -> HandEyeFit:
    """Fit all poses, or those that agree where a few contradict all others, which are named."""
    fit = _fit(views)
    if fit is not None and fit.is_explained:
        return fit
    agree = _select_agreeing(views)
    kept = None if agree is None else _try_fit(views.select(agree))
    if kept is not None and kept.fits and (fit is None or kept.ratio < fit.ratio / EXPLAINED):
        return _exclude(views, kept)
    if fit is None:
        raise InputError(
            "no place of the camera explains the poses of the robot",
            "check that each belongs to its capture",
        )
    return fit


def _select_agreeing(views: HandEyeViews) -> Mask | None:
    """(n,): the poses that agree with more than half of all, by least median of squares over small
    subsets; None where all do, or too few."""
    n, starts = len(views.names), list[tuple[float, Floats]]()
    rng = np.random.default_rng(0)
    for _ in range(TRIALS if n > TRIAL_POSES + 1 else 0):
        start = _start(views.select(rng.choice(n, TRIAL_POSES, replace=False)))
        if start is not None:
            distances = _distances(views, *start)
            starts.append((float(np.median(distances)), distances))
    if not starts:
        return None
    nearest = np.argsort(min(starts, key=lambda each: each[0])[1])
    half = _try_fit(views.select(nearest[: max(MIN_POSES, n // 2 + 1)]))
    if half is None:
        return None
    agree = ~_is_outlier(_distances(views, half.X, half.Z))
    return agree if max(TRIAL_POSES, 2 * n / 3) <= agree.sum() < n else None


def _exclude(views: HandEyeViews, kept: HandEyeFit) -> HandEyeFit:
    """Return the fit of most poses with the others named. Raises InputError where one of these
    fits the robot's pose of another capture."""
    residuals = views.residuals(kept.X, kept.Z)
    limit = OUTLIER * max(kept.ratio, 1) ** 2
    excluded, exchanged = dict[str, str](), list[str]()
    for i, name in enumerate(views.names):
        if name in kept.views.names:
            continue
        for way in views.ways:
            here = replace(views.select(np.full(len(views.names), i)), robot=views.robot)
            turned = replace(here, board=here.board @ way)
            suited = _distances(turned, kept.X, kept.Z) <= limit
            exchanged += [f"{name} the one of {views.names[j]}" for j in np.flatnonzero(suited)]
        turn, shift = np.linalg.norm(residuals[i].reshape(2, 3), axis=1)
        excluded[name] = (
            f"{shift:.3g} mm and {np.degrees(turn):.2g} degrees off what the"
            f" {len(kept.views.names)} others agree on"
        )
    if exchanged:
        raise InputError(
            "poses of the robot stand beside the wrong captures:"
            f" {'; '.join(f'{name}, {why}' for name, why in excluded.items())}",
            f"{', '.join(exchanged)} fits: exchange them, and run this again",
        )
    return replace(kept, excluded=excluded)


def _list_readings(views: HandEyeViews) -> list[Reading]:
    """Return the poses as given, and turned round."""
    given, inverse = views.robot, invert(views.robot)
    scaled = (
        (1000.0, "their lengths are in m"), (0.001, "their lengths are in µm"),
        (25.4, "their lengths are in inches"),
    )  # fmt: skip
    other = "eye-to-hand" if views.mounting == "eye-in-hand" else "eye-in-hand"
    turned = (
        f"the transforms are inverted (flange to base is wanted), or the camera is mounted {other}"
    )
    readings = [Reading("", given), Reading(turned, inverse)]
    for factor, what in scaled:
        robot = given.copy()
        robot[:, :3, 3] *= factor
        readings += [Reading(what, robot), Reading(f"{what} and {turned}", invert(robot))]
    transposed = given.copy()
    transposed[:, :3, :3] = np.swapaxes(given[:, :3, :3], 1, 2)
    return [*readings, Reading("their rotations are transposed", transposed)]


def _list_orders(n: int) -> list[Order]:
    """Return orders in which n poses may have been matched to n captures."""
    there = np.arange(n)
    orders = [Order("", there, there), Order("the poses are in reverse order", there[::-1], there)]
    for k in range(1, min(MOST_SHIFTED, n - MIN_POSES - 1) + 1):
        rows = "one row" if k == 1 else f"{k} rows"
        what = f"the poses are shifted by {rows}: a capture's pose stands {rows}"
        orders += [
            Order(f"{what} later", there[k:], there[:-k]),
            Order(f"{what} earlier", there[:-k], there[k:]),
        ]
    return orders


def _is_outlier(distances: Floats) -> Mask:
    """(n,): the poses that the noise, raised to what half of them show, does not explain."""
    return distances > OUTLIER * max(1.0, float(np.median(distances)) / chdtri(6, 0.5))


def _distances(views: HandEyeViews, X: Floats, Z: Floats) -> Floats:
    """(n,): the squared Mahalanobis distances of the residuals."""
    whitened = np.einsum("nij,nj->ni", views.whiteners(X), views.residuals(X, Z))
    return np.asarray(np.sum(whitened**2, axis=1))


def _is_plausible(views: HandEyeViews) -> bool:
    """Whether robot and camera turn by the same angles from pose to pose, in the median, which no
    place of the camera changes, and the closed form leaves little."""
    i, j = np.triu_indices(len(views.names), 1)
    robot, board = views.robot[:, :3, :3], np.swapaxes(views.board[:, :3, :3], 1, 2)
    turned, seen = (rotation_angle(R[i] @ np.swapaxes(R[j], 1, 2)) for R in (robot, board))
    if np.degrees(np.median(np.abs(turned - seen))) > ALIKE_DEG:
        return False
    start = _start(views)
    if start is None:
        return False
    shifts = np.linalg.norm(views.residuals(*start)[:, 3:], axis=1)
    return rms(shifts) < ROUGH_SHARE * views.spread_mm


def _try_fit(views: HandEyeViews) -> HandEyeFit | None:
    """Fit poses whose motions determine the result; None where they do not."""
    try:
        check_motions(views)
    except InputError:
        return None
    return _fit(views)


def _fit(views: HandEyeViews) -> HandEyeFit | None:
    """Refine the closed form; None where there is none."""
    start = _start(views)
    if start is None:
        return None
    X, Z = start
    for _ in range(2):  # the weights depend on the place of the camera
        W = views.whiteners(X)
        X0, Z0 = X, Z

        def whitened(step: Floats, W: Floats = W, X: Floats = X0, Z: Floats = Z0) -> Floats:
            """Return the whitened residuals (6 n,) of changed X and Z."""
            moved = views.residuals(move_by(X, step[:6]), move_by(Z, step[6:]))
            return np.einsum("nij,nj->ni", W, moved).ravel()

        solved = least_squares(whitened, np.zeros(12), x_scale="jac", max_nfev=20)
        X, Z = move_by(X, solved.x[:6]), move_by(Z, solved.x[6:])
    return _evaluate(views, X, Z)


def _start(views: HandEyeViews) -> tuple[Floats, Floats] | None:
    """Return X and Z in closed form, by Park and Martin, "Robot sensor calibration: solving AX = XB
    on the Euclidean group": rotation, then translation; None where the motions determine none."""
    A, B = views.A, views.board
    i, j = np.triu_indices(len(A), 1)
    a, b = invert(A[j]) @ A[i], B[j] @ invert(B[i])  # a X = X b
    turns, seen = (Rotation.from_matrix(each[:, :3, :3]).as_rotvec() for each in (a, b))
    # the axis of half a turn has no sign
    usable = np.linalg.norm(turns, axis=1) < HALF_TURN
    if usable.sum() < 2:
        return None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # of parallel axes
        R = Rotation.align_vectors(turns[usable], seen[usable])[0].as_matrix()
    equations = (a[:, :3, :3] - np.eye(3)).reshape(-1, 3)
    shifts = (b[:, :3, 3] @ R.T - a[:, :3, 3]).ravel()
    X = rigid_transform(R, np.linalg.lstsq(equations, shifts)[0])
    each = A @ X @ B
    turn = Rotation.from_matrix(each[:, :3, :3]).mean().as_matrix()
    return X, rigid_transform(turn, np.median(each[:, :3, 3], axis=0))


def _evaluate(views: HandEyeViews, X: Floats, Z: Floats) -> HandEyeFit:
    """Return the fit with residuals and covariance at a solution."""
    residuals, rows = views.residuals(X, Z), weighted_jacobian(views, X, Z)
    ratio = float(np.sqrt(_distances(views, X, Z).sum() / max(residuals.size - 12, 1)))
    N = np.einsum("nij,nik->jk", rows, rows)
    covariance = max(1.0, ratio) ** 2 * np.linalg.pinv(N, hermitian=True)
    return HandEyeFit(views, X, Z, covariance, residuals, rows, ratio, {})


def weighted_jacobian(views: HandEyeViews, X: Floats, Z: Floats) -> Floats:
    """(n, 6, 12): derivatives of the whitened residuals by small motions of X and of Z."""
    steps = np.diag([1e-5] * 3 + [1e-3] * 3 + [1e-5] * 3 + [1e-3] * 3)
    J = [
        (
            views.residuals(move_by(X, step[:6]), move_by(Z, step[6:]))
            - views.residuals(move_by(X, -step[:6]), move_by(Z, -step[6:]))
        )
        / (2 * step.sum())
        for step in steps
    ]
    return np.einsum("nij,njk->nik", views.whiteners(X), np.stack(J, axis=-1))


def _balance(N: Floats) -> Floats:
    """Return a matrix scaled to a diagonal of ones."""
    scale = np.sqrt(np.maximum(np.diag(N), 1e-300))
    return N / np.outer(scale, scale)


def _split_traces(covariance: Floats) -> Floats:
    """(2,): the variances of the rotation and of the translation of X."""
    return np.array([np.trace(covariance[:3, :3]), np.trace(covariance[3:6, 3:6])])


def plan_poses(fit: HandEyeFit, count: int) -> tuple[Floats, Floats]:
    """Return the poses T_base_flange (count, 4, 4) mm that would reduce U most, one after the
    other, and U after each (count, 2): of the translation, mm, and of the rotation, degrees.

    The camera looks at the board's origin from about the distances of the present poses, tilted by
    20 or 40 degrees to any side, and turned about its axis.
    """
    views = fit.views
    boards = _list_candidates(views.board)
    A = fit.Z @ invert(fit.X @ boards)
    robot = A if views.mounting == "eye-in-hand" else invert(A)
    candidates = replace(
        views,
        names=("",) * len(robot),
        robot=robot,
        board=boards,
        covariance=np.repeat(np.median(views.covariance, axis=0)[None], len(robot), axis=0),
    )
    rows = weighted_jacobian(candidates, fit.X, fit.Z) / max(1.0, fit.ratio)
    gained = np.einsum("nij,nik->njk", rows, rows)
    N = np.linalg.inv(fit.covariance)
    now = _split_traces(fit.covariance)
    chosen, reached = list[int](), list[tuple[float, float]]()
    for _ in range(count):
        covariances = np.linalg.inv(N + gained)
        summed = [(_split_traces(each) / now).sum() for each in covariances]
        costs = np.where(np.isin(np.arange(len(summed)), chosen), np.inf, summed)
        best = int(np.argmin(costs))
        N = N + gained[best]
        C = covariances[best]
        chosen.append(best)
        turn_deg = float(np.degrees(coverage_radius(C[:3, :3])))
        reached.append((coverage_radius(C[3:6, 3:6]), turn_deg))
    return robot[chosen], np.array(reached).reshape(-1, 2)


def _list_candidates(boards: Floats) -> Floats:
    """Return poses T_camera_board (m, 4, 4) in which the camera looks at the board's origin, from
    the side that the present ``boards`` (n, 4, 4) show."""
    facing = boards[np.argmax(np.abs(boards[:, 2, 2])), :3, :3]
    upright, _ = Rotation.align_vectors([[0, 0, np.sign(facing[2, 2])]], [facing[:, 2]])
    found = []
    for distance in np.quantile(np.linalg.norm(boards[:, :3, 3], axis=1), [0.1, 0.9]):
        for tilt, side, roll in product((20, 40), range(0, 360, 45), (-120, -60, 0, 60, 120, 180)):
            across = [np.cos(np.radians(side)), np.sin(np.radians(side)), 0]
            turned = Rotation.from_rotvec(np.radians(tilt) * np.array(across))
            about = Rotation.from_euler("z", roll, degrees=True)
            R = (about * turned * upright).as_matrix() @ facing
            found.append(rigid_transform(R, np.array([0, 0, distance])))
    return np.array(found)
