"""A camera whose lens is known from a calibration of its own, and the projector's lens and pose
beside it."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from slviewer.calibration.board_pose import solve_pose
from slviewer.calibration.next_pose import nominal_lens
from slviewer.errors import CalibrationRejected, InputError
from slviewer.geometry.lens import Lens
from slviewer.geometry.rig import StereoRig
from slviewer.geometry.rigid import Floats, move_points, transform_from_rvec
from slviewer.records.verdict import Finding, Severity

STEPS = 100
CONVERGED = 1e-9
"""Relative decrease of the squared residuals at which the adjustment ends."""
LEAST_DAMPING, FIRST_DAMPING, MOST_DAMPING = 1e-9, 1e-3, 1e6
LENS, RIG = 9, 15
"""Unknowns of the projector's lens (fx fy cx cy k1 k2 p1 p2 k3), and with its rotation vector and
translation; those of the poses follow."""
UNSTATED_SIGMA = 0.002
"""Relative standard deviation of a focal length whose file states none: so much do calibrations
from a dozen pictures differ."""
MAX_RMS_RATIO = 1.5
"""Residuals in a fixed camera over those in a free one, from which on its lens is another."""
MAX_FOCAL_UNCERTAINTY = 0.02
"""Relative standard deviation from which on the poses do not determine a focal length well."""
SERIOUS_CHANGE = 0.0025
"""Of a focal length, from which on a fixed one is doubtful, whatever its file states."""
CHANGE_SIGMAS = 4.0
"""Least significant difference of a fixed focal length from what the poses give."""

Views = Sequence[tuple[Floats, Floats, Floats]]
"""Of each pose: points (n, 3) mm, and their pixels (n, 2) in camera and projector."""


@dataclass(frozen=True, eq=False)
class KnownCamera:
    """A camera's ``lens`` as the file ``name`` states it, and the standard deviation of its focal
    length: where a calibration starts, or what it keeps, if ``is_fixed``."""

    lens: Lens
    name: str
    is_fixed: bool = False
    focal_sigma_px: float = 0.0


@dataclass(frozen=True)
class CameraCheck:
    """A fixed camera compared with what the target poses give.

    ``change``: their focal length over that of the file ``name``, less 1; ``sigma``: its standard
    deviation by the poses; ``stated``: that of the file, relative too. ``rms_px``: residuals with
    the camera fixed, and free.
    """

    name: str
    change: float
    sigma: float
    stated: float
    rms_px: tuple[float, float] | None = None

    @property
    def is_significant(self) -> bool:
        """Whether the poses contradict the file's focal length."""
        return abs(self.change) > CHANGE_SIGMAS * self.sigma

    @property
    def uncertainty(self) -> float:
        """Relative standard deviation of the fixed focal length: at least what the poses
        contradict it by."""
        return max(self.stated, abs(self.change) * self.is_significant)


def judge_camera(check: CameraCheck | None) -> Iterator[Finding]:
    """Yield a finding where a fixed camera is not that of the poses; a note where the difference is
    small, and within the uncertainty of its file."""
    if check is None:
        return
    fixed, free = check.rms_px or (0.0, 0.0)
    is_misfit = fixed > MAX_RMS_RATIO * max(free, 0.02)
    if not (is_misfit or check.is_significant):
        return
    sentence = (
        f"the poses give the camera a focal length {100 * abs(check.change):.2f} +-"
        f" {100 * check.sigma:.2f} % {'longer' if check.change > 0 else 'shorter'} than"
        f" {check.name}, which is uncertain by {100 * check.stated:.2f} %"
    )
    if check.rms_px:
        sentence += (
            f"; residuals are {fixed:.3f} px with that lens and {free:.3f} px with a free one"
        )
    severity: Severity = "rejected" if is_misfit else "doubtful"
    if not is_misfit and abs(check.change) < min(2 * check.stated, SERIOUS_CHANGE):
        severity = "note"
    again = (
        "calibrate the camera alone again (--camera-only), with the focus, zoom and image size that"
        " it has now"
    )
    omit = "calibrate without --fix-camera, as these poses determine the camera, or "
    remedy = (omit if check.sigma < MAX_FOCAL_UNCERTAINTY else "") + again
    yield Finding("camera-file", severity, sentence, remedy)


def solve_beside(
    camera: KnownCamera, views: Views, size: tuple[int, int]
) -> tuple[StereoRig, list[Floats], float]:
    """Solve the projector's lens and pose, and the boards' poses, by least squares of all residuals
    in px; the camera's lens stays.

    ``size``: of the projector. Returns the rig, T_camera_board (4, 4) mm of each pose, and the
    standard deviation of the projector's focal length in px. Raises CalibrationRejected without a
    solution.
    """
    lens, projector = camera.lens, nominal_lens(size)
    solutions = [solve_pose(X, pixels, lens.K, lens.D) for X, pixels, _ in views]
    boards = [T for T in solutions if T is not None]
    T = None
    if len(boards) == len(views):
        placed = [move_points(T, X) for T, (X, *_) in zip(boards, views, strict=True)]
        pixels = np.concatenate([each for *_, each in views])
        T = solve_pose(np.concatenate(placed), pixels, projector.K, projector.D)
    if T is None:
        raise CalibrationRejected(
            f"the boards have no pose in the camera of {camera.name} or in the projector",
            "check the file, and the target's notation",
        )
    start = [projector.parameters[:LENS], *(_motion(each) for each in (T, *boards))]
    try:
        unknowns, squares, H = _adjust(np.concatenate(start), lens, views)
        covariance = np.linalg.inv(H)
        solved = Lens.from_parameters(unknowns[:LENS], size)
    except (np.linalg.LinAlgError, InputError) as error:
        raise CalibrationRejected(
            "the poses leave the projector undetermined",
            "capture the board in more positions and tilts",
        ) from error
    count = sum(4 * len(X) for X, *_ in views) - len(unknowns)
    sigma = np.sqrt(covariance.diagonal()[:2].max() * squares / max(count, 1))
    T, *boards = (transform_from_rvec(m[:3], m[3:]) for m in unknowns[LENS:].reshape(-1, 6))
    # a longer lens of the camera puts boards farther away, and makes the projector's longer too
    common = solved.K[0, 0] * camera.focal_sigma_px / lens.K[0, 0]
    return StereoRig(lens, solved, T[:3, :3], T[:3, 3]), boards, float(np.hypot(sigma, common))


def _motion(T: Floats) -> Floats:
    """Return rotation vector and translation (6,) of T (4, 4)."""
    return np.concatenate([cv2.Rodrigues(T[:3, :3])[0].ravel(), T[:3, 3]])


def _adjust(unknowns: Floats, lens: Lens, views: Views) -> tuple[Floats, float, Floats]:
    """Adjust all unknowns by Levenberg and Marquardt's method; return them, the sum of the squared
    residuals, and the normal matrix."""
    squares, H, g = _normal_equations(unknowns, lens, views)
    damping = FIRST_DAMPING
    for _ in range(STEPS):
        step = np.linalg.solve(H + damping * np.diag(H.diagonal()), g)
        after = _normal_equations(unknowns + step, lens, views)
        if after[0] < squares:
            is_converged = after[0] > squares * (1 - CONVERGED)
            unknowns, (squares, H, g) = unknowns + step, after
            damping = max(damping / 10, LEAST_DAMPING)
            if is_converged:
                break
        elif damping > MOST_DAMPING:
            break
        else:
            damping *= 10
    return unknowns, squares, H


def _normal_equations(unknowns: Floats, lens: Lens, views: Views) -> tuple[float, Floats, Floats]:
    """Return the sum of the squared residuals, J'J, and J'r."""
    fx, fy, cx, cy, *D = unknowns[:LENS]
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    H, g, squares = np.zeros((len(unknowns),) * 2), np.zeros(len(unknowns)), 0.0
    for first, (X, in_camera, in_projector) in zip(
        range(RIG, len(unknowns), 6), views, strict=True
    ):
        rvec, tvec = unknowns[first : first + 3], unknowns[first + 3 : first + 6]
        camera, by_pose = cv2.projectPoints(X, rvec, tvec, lens.K, lens.D)
        r, t, *d = cv2.composeRT(rvec, tvec, unknowns[LENS : LENS + 3], unknowns[LENS + 3 : RIG])
        projector, by = cv2.projectPoints(X, r, t, K, np.array(D))
        of_board, of_rig = (np.block([d[i : i + 2], d[i + 4 : i + 6]]) for i in (0, 2))
        J = np.vstack(
            [
                np.hstack([np.zeros((len(by), RIG)), by_pose[:, :6]]),
                np.hstack([by[:, 6:15], by[:, :6] @ of_rig, by[:, :6] @ of_board]),
            ]
        )
        r = np.concatenate([(in_camera - camera[:, 0]), (in_projector - projector[:, 0])]).ravel()
        part = np.r_[:RIG, first : first + 6]
        H[np.ix_(part, part)] += J.T @ J
        g[part] += J.T @ r
        squares += float(r @ r)
    return squares, H, g
