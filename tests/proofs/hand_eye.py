"""Hand-eye calibrations of simulated robots: errors against the stated U, and motions and files
that cannot give a result."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from slviewer.calibration.hand_eye import (
    HandEyeFit,
    HandEyeViews,
    Mounting,
    Reading,
    solve_hand_eye,
)
from slviewer.errors import InputError
from slviewer.geometry.rigid import coverage_radius
from slviewer.pipeline.operation import Progress
from tests.proofs.proof import BandCheck, Proof, prove_checks

RUNS, POSES = 200, 12
ROBOT_MM, ROBOT_DEG = 0.05, 0.01
CAMERA_MM, CAMERA_DEG = 0.02, 0.004
"""What some hundred features of a board give."""
MOUNTINGS: tuple[Mounting, ...] = ("eye-in-hand", "eye-to-hand")


@dataclass(frozen=True, eq=False)
class Robot:
    """A simulated robot: its true hand-eye transforms (4, 4) mm, and what was measured."""

    X: np.ndarray
    Z: np.ndarray
    views: HandEyeViews


def rigid(R: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Return motions (n, 4, 4) of rotations (n, 3, 3) and shifts (n, 3)."""
    T = np.tile(np.eye(4), (len(t), 1, 1))
    T[:, :3, :3], T[:, :3, 3] = R, t
    return T


def disturb(rng: np.random.Generator, T: np.ndarray, mm: float, deg: float) -> np.ndarray:
    """Return poses (n, 4, 4) with noise of each axis."""
    turns = Rotation.from_rotvec(rng.normal(0, deg, (len(T), 3)), degrees=True).as_matrix()
    return T @ rigid(turns, rng.normal(0, mm, (len(T), 3)))


def draw_boards(rng: np.random.Generator, count: int) -> np.ndarray:
    """Return T_camera_board (n, 4, 4): tilted by up to 45 degrees, at 300 to 450 mm."""
    tilt, side = np.radians(rng.uniform(15, 45, count)), rng.uniform(0, 2 * np.pi, count)
    across = np.column_stack([np.cos(side), np.sin(side), np.zeros(count)])
    roll = Rotation.from_euler("z", rng.uniform(-120, 120, (count, 1)), degrees=True)
    turns = (roll * Rotation.from_rotvec(tilt[:, None] * across)).as_matrix()
    places = np.column_stack([rng.uniform(-40, 40, (count, 2)), rng.uniform(300, 450, count)])
    return rigid(turns, places)


def draw_robot(
    rng: np.random.Generator,
    mounting: Mounting,
    boards: np.ndarray | None = None,
    flanges: np.ndarray | None = None,
) -> Robot:
    """Return a robot at poses by which the camera sees ``boards``, or at ``flanges`` (n, 4, 4)."""
    in_hand = mounting == "eye-in-hand"
    turns = Rotation.random(2, random_state=rng).as_matrix()
    near, far = rng.uniform(-80, 80, 3), rng.uniform(400, 900, 3)
    X, Z = rigid(turns, np.array([near, far] if in_hand else [far, near]))
    if flanges is None:
        boards = draw_boards(rng, POSES) if boards is None else boards
        A = Z @ np.linalg.inv(X @ boards)
        flanges = A if in_hand else np.linalg.inv(A)
    A = flanges if in_hand else np.linalg.inv(flanges)
    boards = np.linalg.inv(A @ X) @ Z
    noise = np.diag([np.radians(CAMERA_DEG) ** 2] * 3 + [CAMERA_MM**2] * 3)
    views = HandEyeViews(
        tuple(f"pose_{k + 1:02d}" for k in range(len(flanges))),
        disturb(rng, flanges, ROBOT_MM, ROBOT_DEG),
        disturb(rng, boards, CAMERA_MM, CAMERA_DEG),
        np.repeat(noise[None], len(flanges), axis=0),
        ROBOT_MM,
        float(np.radians(ROBOT_DEG)),
        mounting,
    )
    return Robot(X, Z, views)


def measure_errors(robot: Robot, fit: HandEyeFit) -> np.ndarray:
    """Return the error (6,) of X: a turn (rad) and a shift (mm) in the frame that it maps to."""
    turn = Rotation.from_matrix(fit.X[:3, :3] @ robot.X[:3, :3].T).as_rotvec()
    return np.concatenate([turn, fit.X[:3, 3] - robot.X[:3, 3]])


def _shift_only(rng: np.random.Generator) -> np.ndarray:
    """Return flanges that do not turn."""
    return rigid(np.repeat(np.eye(3)[None], POSES, 0), rng.uniform(300, 500, (POSES, 3)))


def _turn_about_one(rng: np.random.Generator) -> np.ndarray:
    """Return flanges that turn about one axis of their own."""
    axis = rng.normal(size=3)
    axis /= np.linalg.norm(axis)
    turns = Rotation.from_rotvec(rng.uniform(-1, 1, (POSES, 1)) * axis).as_matrix()
    return rigid(turns, rng.uniform(300, 500, (POSES, 3)))


def _exchange(robot: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return the poses with two of them exchanged."""
    order = np.arange(len(robot))
    a, b = rng.choice(len(robot), 2, replace=False)
    order[[a, b]] = b, a
    return robot[order]


def _scale(robot: np.ndarray, factor: float) -> np.ndarray:
    """Return the poses with their lengths multiplied."""
    return rigid(robot[:, :3, :3], factor * robot[:, :3, 3])


def _misread(robot: np.ndarray) -> np.ndarray:
    """Return the poses with KUKA's angles A, B, C read as Fanuc's W, P, R."""
    angles = Rotation.from_matrix(robot[:, :3, :3]).as_euler("ZYX")
    return rigid(Rotation.from_euler("xyz", angles).as_matrix(), robot[:, :3, 3])


Change = Callable[[np.ndarray, np.random.Generator], np.ndarray]
FILES: Mapping[str, tuple[Change, str]] = {
    "shifted by one row": (lambda T, rng: np.roll(T, 1, 0), "shifted by one row"),
    "shifted by two rows": (lambda T, rng: np.roll(T, -2, 0), "shifted by 2 rows"),
    "in reverse": (lambda T, rng: T[::-1], "reverse order"),
    "two exchanged": (_exchange, "exchange them"),
    "inverted": (lambda T, rng: np.linalg.inv(T), "inverted"),
    "in m": (lambda T, rng: _scale(T, 0.001), "in m"),
    "in inches": (lambda T, rng: _scale(T, 1 / 25.4), "in inches"),
    "KUKA read as Fanuc": (lambda T, rng: _misread(T), "KUKA"),
}
"""How a file differs from the truth, and the words that its refusal must hold."""
MOTIONS: Mapping[str, tuple[Callable[[np.random.Generator], np.ndarray], str]] = {
    "shifts alone": (_shift_only, "only shift"),
    "parallel axes": (_turn_about_one, "parallel axes"),
    "three poses": (lambda rng: _turn_about_one(rng)[:3], "3 poses"),
}


def list_refusals(
    rng: np.random.Generator, mounting: Mounting, files: Mapping[str, tuple[Change, str]] = FILES
) -> Iterator[tuple[str, str]]:
    """Yield each situation that must be refused, and how it was answered: refused with the reason,
    refused otherwise, or accepted."""
    for name, (draw, wanted) in MOTIONS.items():
        yield name, _answer(draw_robot(rng, mounting, flanges=draw(rng)).views, wanted)
    truth = draw_robot(rng, mounting).views
    for name, (change, wanted) in files.items():
        views = replace(truth, robot=change(truth.robot, rng))
        yield name, _answer(views, wanted, [Reading("their convention is KUKA", truth.robot)])


def _answer(views: HandEyeViews, wanted: str, readings: list[Reading] | None = None) -> str:
    """Return whether poses are refused with the wanted words."""
    try:
        solve_hand_eye(views, readings or [])
    except InputError as error:
        return "refused by name" if wanted in str(error) else f"refused otherwise: {error}"
    return "accepted"


def prove_hand_eye(scale: float, seed: int, progress: Progress) -> Proof:
    """Solve simulated robots, and count how often the errors are within U; refuse what determines
    no result."""
    count = max(8, round(RUNS * scale))
    errors, within, axes, ratios = [], [], [], []
    for k in range(count):
        progress(0.8 * k / count, "solving simulated robots")
        robot = draw_robot(np.random.default_rng([seed, k]), MOUNTINGS[k % 2])
        fit = solve_hand_eye(robot.views)
        error, C = measure_errors(robot, fit), fit.covariance[:6, :6]
        parts = [(error[:3], C[:3, :3]), (error[3:], C[3:, 3:])]
        errors.append([np.degrees(np.linalg.norm(error[:3])), np.linalg.norm(error[3:])])
        within.append([np.linalg.norm(part) <= coverage_radius(own) for part, own in parts])
        axes.append(np.abs(error) <= 2 * np.sqrt(np.diag(C)))
        ratios.append(fit.ratio)
    answers = dict[tuple[str, str], int]()
    for k in range(max(2, count // 40)):
        progress(0.8 + 8 * k / count, "refusing what determines no result")
        for name, answer in list_refusals(np.random.default_rng([seed, k, 1]), MOUNTINGS[k % 2]):
            answers[name, answer] = answers.get((name, answer), 0) + 1
    turn, shift = np.quantile(errors, 0.95, axis=0)
    shares = np.mean(within, axis=0)
    # 3 sigma of a share of so many runs
    slack = 3 * np.sqrt(0.95 * 0.05 / count)
    checks = [
        BandCheck("rotation", "share within U", shares[0], 0.95 - slack, 1),
        BandCheck("translation", "share within U", shares[1], 0.95 - slack, 1),
        BandCheck("each axis", "share within U", float(np.mean(axes)), 0.95 - slack, 0.99),
        BandCheck("translation", "95 % of the errors, mm", float(shift), 0, 0.1),
        BandCheck("residuals", "over their prediction", float(np.mean(ratios)), 0.9, 1.1),
    ]
    checks += [
        BandCheck(name, answer, number, 0, 0)
        for (name, answer), number in answers.items()
        if answer != "refused by name"
    ]
    rows = [
        {
            "of": name,
            "median": float(np.median(values)),
            "95th percentile": float(np.quantile(values, 0.95)),
            "within U %": 100 * float(share),
        }
        for name, values, share in zip(
            ("rotation, degrees", "translation, mm"), np.transpose(errors), shares, strict=True
        )
    ]
    below = [f"{name}: {answer}, {number} times" for (name, answer), number in answers.items()]
    above = [f"{count} simulated robots of {POSES} poses, seed {seed}"]
    return prove_checks(checks, scale, rows, {"turn_deg": turn, "shift_mm": shift}, above, below)
