"""Whether a camera's pixels and a board's cells are square, and a projector's rows and columns are
at right angles.

A print that is stretched in one direction gives a camera focal lengths that differ in x and y, as
pixels that are not square do; nearly all cameras have square ones. Only tilts of the board tell the
two apart, or the projector, which sees the same print. Where a projector's rows and columns are not
at right angles, the corners of its image were moved, as a correction of keystone does.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.special import stdtrit

from slviewer.calibration.board_pose import solve_device
from slviewer.errors import InputError
from slviewer.fringe.sequence import Size
from slviewer.geometry.lens import Lens
from slviewer.geometry.rigid import Floats, move_points
from slviewer.geometry.vectors import finite_rows
from slviewer.records.verdict import Finding
from slviewer.target.board import Board

MIN_ASPECT_ERROR = 1.5e-3
"""Aspects and shears below it may come from local lens distortion (6e-4 on simulated rigs with 0.15
px of it, and as much with a board bent by 0.3 mm)."""
DOUBT = 1e-4
"""Probability that an estimate differs from its true value by more than its limit."""
ASPECTS = (0.5, 1.0, 2.0)
"""Of square pixels, and of the diamond pixels of some DMDs."""
PROVEN = 5.0
"""Limits of its error by which the stretch of the print that tilts show is off the other
explanation: boards that are bent disturb it by more than its limit."""
MIN_SHARED = 0.25
"""The projector shares the camera's aspect, or not, where its own agrees to this share of it."""
MIN_SKEW_DEG = 0.5
"""Angles below it may come from lens distortion, which the fit lacks (0.25 on simulated rigs)."""

_MIN_FEATURES = 6
"""Of a pose, fewer of which its own position explains whatever the pixels are."""


@dataclass(frozen=True)
class Squareness:
    """Whether a camera's pixels, and a board's cells, are square; each with the limit that its
    error exceeds with a probability of `DOUBT`, estimated from the differences between the poses.

    ``aspect``: fy / fx, where the board is as described; ``shear``: of its x by its y. ``stretch``:
    of its y over its x, where the pixels' aspect is free: what the tilts of the poses alone show.
    ``explaining``: the stretch with which the pixels are square, tried; NaN where not estimated.
    ``skew_deg``: angle by which the projector's rows and columns are not at right angles.
    """

    aspect: float
    aspect_limit: float
    shear: float = 0.0
    shear_limit: float = np.inf
    stretch: float = 1.0
    stretch_limit: float = np.inf
    explaining: float = np.nan
    skew_deg: float = 0.0
    skew_limit_deg: float = np.inf

    @property
    def is_doubtful(self) -> bool:
        """Whether the pixels appear other than square, by more than lenses and boards disturb."""
        return abs(self.aspect - 1) > max(MIN_ASPECT_ERROR, self.aspect_limit)

    @property
    def is_sensor_proven(self) -> bool:
        """Whether the tilts of the poses leave no doubt that the pixels, not the board's cells, are
        other than square."""
        off_right, off_print = abs(self.stretch - 1), abs(self.stretch - self.explaining)
        return self.is_doubtful and off_right < self.stretch_limit < off_print / PROVEN

    @property
    def is_sheared(self) -> bool:
        """Whether the board's rows and columns are not at right angles."""
        return abs(self.shear) > max(MIN_ASPECT_ERROR, self.shear_limit)

    @property
    def is_skewed(self) -> bool:
        """Whether the projector's rows and columns are not at right angles."""
        return abs(self.skew_deg) > max(MIN_SKEW_DEG, self.skew_limit_deg)


def measure_squareness(
    lens: Lens, poses: Sequence[Floats], points: Sequence[Floats], pixels: Sequence[Floats]
) -> Squareness:
    """Measure the aspect of a camera's pixels and a board's stretch and shear.

    ``lens`` and ``poses``, T_camera_board (4, 4) mm: a solution from ``points`` (n, 3) mm and
    ``pixels`` (n, 2) of each pose, NaN where excluded. Takes one Gauss-Newton step from it; limits
    are the jackknife's over the poses, without those of too few features to tell.
    """
    K, D, systems, kept = lens.K, lens.D, [], []
    for T, X, measured in zip(poses, points, pixels, strict=True):
        used = finite_rows(measured)
        if np.count_nonzero(used) < _MIN_FEATURES:
            continue
        X, measured = X[used], measured[used]
        kept.append((X, measured))
        rvec, _ = cv2.Rodrigues(T[:3, :3])
        projected, J = cv2.projectPoints(X, rvec, T[:3, 3], K, D)
        residual = (measured - projected[:, 0]).ravel()
        on_board = J[:, 3:6].reshape(-1, 2, 3) @ T[:3, :3]  # by the features' positions, mm
        shear, stretch = (on_board[..., k] * X[:, 1, None] for k in (0, 1))
        aspect = K[1, 1] * J[:, 7]
        focal = K[0, 0] * J[:, 6] + aspect
        shared = np.column_stack([focal, J[:, 8:15], aspect, shear.ravel(), stretch.ravel()])
        Q, _ = np.linalg.qr(J[:, :6])  # what a move of the board does not explain
        systems.append((shared - Q @ (Q.T @ shared), residual - Q @ (Q.T @ residual)))
    if len(systems) < 2:
        return Squareness(float(K[1, 1] / K[0, 0]), np.inf)
    described, described_limits = _fit_jackknife([(J[:, :-1], r) for J, r in systems])
    free, free_limits = _fit_jackknife(systems)
    squareness = Squareness(
        float(K[1, 1] / K[0, 0] * np.exp(described[8])),
        float(described_limits[8]),
        float(described[9]),
        float(described_limits[9]),
        float(1 + free[10]),
        float(free_limits[10]),
    )
    if not squareness.is_doubtful:
        return squareness
    return replace(squareness, explaining=_explain_aspect(kept, lens.size))


def measure_skew(
    points: Sequence[Floats], pixels: Sequence[Floats], projected: Sequence[Floats], size: Size
) -> tuple[float, float]:
    """Return by how many degrees the angle between a projector's rows and columns is not right, and
    the limit that its error exceeds with a probability of `DOUBT`.

    The camera is solved by itself, from ``points`` (n, 3) mm on the board and ``pixels`` (n, 2) of
    each pose, as the projector's own lens would disturb it; then the projection of what it sees to
    ``projected`` (n, 2) px of the projector is linear, but for its lens distortion. NaN: excluded.
    """
    used = [finite_rows(*each) for each in zip(pixels, projected, strict=True)]
    kept = [k for k, each in enumerate(used) if np.count_nonzero(each) >= _MIN_FEATURES]
    X, seen, shown = (
        [each[k][used[k]].astype(float) for k in kept] for each in (points, pixels, projected)
    )
    camera = solve_device("camera", X, seen, size)
    placed = [move_points(T, each) for T, each in zip(camera.poses, X, strict=True)]
    far = float(np.abs(np.concatenate(placed)).max())
    wide = float(np.abs(np.concatenate(shown)).max())
    rows = [_projection_rows(x / far, px / wide) for x, px in zip(placed, shown, strict=True)]
    normal = np.array([A.T @ A for A in rows])
    total = normal.sum(axis=0)
    skew = _skew_deg(total)
    fewer = np.array([_skew_deg(total - each) for each in normal])
    count = len(fewer)
    sigma = float(np.sqrt((count - 1) / count * np.sum((fewer - fewer.mean()) ** 2)))
    return skew, -float(stdtrit(count - 1, DOUBT / 2)) * sigma


def _projection_rows(X: Floats, pixels: Floats) -> Floats:
    """Return equations (2 n, 12) of a linear projection (3, 4) of points (n, 3) to pixels (n, 2),
    all about 1."""
    near = np.column_stack([X, np.ones(len(X))])
    u, v = pixels.T[..., None]
    none = np.zeros_like(near)
    return np.concatenate([np.hstack([near, none, -u * near]), np.hstack([none, near, -v * near])])


def _skew_deg(normal: Floats) -> float:
    """Return the angle by which rows and columns of the projection are not at right angles."""
    P = np.linalg.eigh(normal)[1][:, 0].reshape(3, 4)
    K = cv2.RQDecomp3x3(P[:, :3])[1]
    return float(np.degrees(np.arctan(K[0, 1] / K[0, 0])))


def _fit_jackknife(systems: Sequence[tuple[Floats, Floats]]) -> tuple[Floats, Floats]:
    """Solve the poses' equations (J (m, k), r (m,)) together; return the solution (k,) and the
    limits of its errors, inf where a pose alone determines it."""
    normal = [J.T @ J for J, _ in systems]
    total = np.sum(normal, axis=0)
    try:
        x = np.linalg.solve(total, np.sum([J.T @ r for J, r in systems], axis=0))
        changes = [
            np.linalg.solve(total - N, J.T @ (r - J @ x))
            for N, (J, r) in zip(normal, systems, strict=True)
        ]
    except np.linalg.LinAlgError:
        return np.zeros(len(total)), np.full(len(total), np.inf)
    count = len(systems)
    sigma = np.sqrt((count - 1) / count * np.sum(np.square(changes), axis=0))
    return x, -stdtrit(count - 1, DOUBT / 2) * sigma


def _explain_aspect(features: Sequence[tuple[Floats, Floats]], size: tuple[int, int]) -> float:
    """Return the stretch of the board's y over its x with which the camera, solved again, has
    square pixels."""
    images = [pixels for _, pixels in features]
    stretch = 1.0
    for _ in range(3):
        scaled = [X * [1.0, stretch, 1.0] for X, _ in features]
        K = solve_device("camera", scaled, images, size).K
        stretch *= float(K[1, 1] / K[0, 0])
    return stretch


def nearest_aspect(aspect: float) -> float:
    """Return the aspect of a projector's pixels that is nearest to the measured one."""
    return min(ASPECTS, key=lambda each: abs(np.log(aspect / each)))


def judge_squareness(
    notation: str, squareness: Squareness, projector_aspect: float = np.nan
) -> Iterator[Finding]:
    """Yield findings where the camera's pixels, and the board's cells, are not square.

    ``notation``: of the board; ``projector_aspect``: fy / fx of the projector, if there is one.
    None where the projector's rows and columns are not at right angles, which disturbs the others.
    """
    s = squareness
    if s.is_skewed:
        return
    if s.is_sensor_proven:
        yield Finding(
            "board-size",
            "note",
            f"the camera's pixels are {s.aspect:.4f} (+- {s.aspect_limit:.4f}) times as wide as"
            " high: by the poses' tilts alone, the board's print is right"
            f" ({s.stretch:.4f} (+- {s.stretch_limit:.4f}) times as long along y, for its length"
            f" along x, and not {s.explaining:.4f} times)",
            "see that the camera joins or skips rows or columns by intention, and that no program"
            " scales its images; nothing else needs to be done",
        )
    elif s.is_doubtful:
        yield Finding(
            "board-size",
            "doubtful",
            f"the camera's pixels appear {s.aspect:.4f} (+- {s.aspect_limit:.4f}) times as wide as"
            " high, and those of hardly any sensor are: either the board's print is"
            f" {s.explaining:.4f} times as long along y, for its length along x, as its notation"
            " says, or the sensor's pixels are not square, or its images were scaled"
            + _compare_stretches(s, projector_aspect),
            _advise_pitches(Board.parse(notation), s.explaining),
        )
    if s.is_sheared:
        angle, limit = (float(np.degrees(each)) for each in (s.shear, s.shear_limit))
        yield Finding(
            "board-size",
            "doubtful",
            f"the board's rows and columns are at {90 - angle:.2f} (+- {limit:.2f}) degrees",
            "measure both diagonals of the print, which are equal where it is right, and print the"
            " board anew, with another printer, or use a plate",
        )


def _compare_stretches(s: Squareness, projector_aspect: float) -> str:
    """Return which of print and sensor the poses' tilts or the projector support, "" where
    neither does."""
    off_right, off_print = abs(s.stretch - 1), abs(s.stretch - s.explaining)
    near, far = sorted([off_right, off_print])
    if far > s.stretch_limit > near:
        text = f"the poses' tilts alone, {s.stretch:.4f} (+- {s.stretch_limit:.4f}) times,"
        is_print = off_print < off_right
    else:
        change = np.log(projector_aspect / nearest_aspect(projector_aspect / s.aspect))
        share = change / np.log(s.aspect)
        if not (abs(share) < MIN_SHARED or abs(share - 1) < MIN_SHARED):
            return ""
        is_print = abs(share - 1) < MIN_SHARED
        text = f"the projector, whose aspect of {projector_aspect:.4f} "
        text += "shares the factor," if is_print else "does not,"
    return f" ({text} support{'s' * ('tilts' not in text)} the {'print' if is_print else 'sensor'})"


def _advise_pitches(board: Board, stretch: float) -> str:
    """Return the remedy for a board whose print is stretched along y, for its length along x, by a
    factor."""
    columns, rows = np.ptp(board.nodes, axis=0).tolist()
    x, y = board.pitches.tolist()
    cases = []
    for pitches in ((x / stretch, y), (x, y * stretch)):
        try:
            each = replace(
                board, pitch_mm=float(f"{pitches[0]:.5g}"), pitch_y_mm=float(f"{pitches[1]:.5g}")
            )
        except InputError:
            return "measure the board's pitch along both directions, and use one with square cells"
        cases.append(
            f"for {columns * pitches[0]:.2f} mm along x and {rows * pitches[1]:.2f} mm along y give"
            f" the board as {each}"
        )
    return (
        f"measure the print along both directions, over {columns:g} pitches along x and {rows:g}"
        f" along y: {', '.join(cases)}, for {columns * x:.2f} mm and {rows * y:.2f} mm the print is"
        " right, and so is this calibration; for other lengths, give the pitches they make"
    )
