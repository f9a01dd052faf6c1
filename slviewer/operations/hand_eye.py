"""Hand-eye calibration of a session: its captures of the board, and the poses of the robot."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np
from scipy.spatial.transform import Rotation

from slviewer.calibration.centres import centroid_shifts
from slviewer.calibration.diagnosis.numbering import place_by_neighbours
from slviewer.calibration.hand_eye import (
    HandEyeFit,
    HandEyeViews,
    Mounting,
    Reading,
    plan_poses,
    solve_hand_eye,
)
from slviewer.calibration.observe import Observation, Smoothing
from slviewer.errors import InputError
from slviewer.fringe.sequence import Axis
from slviewer.geometry.lens import Lens
from slviewer.geometry.rigid import (
    Floats,
    coverage_radius,
    fit_rigid,
    invert,
    motion_jacobian,
    move_points,
    rigid_transform,
)
from slviewer.geometry.vectors import box_middle, finite_rows
from slviewer.pipeline.accept import LEAST_FEATURES, interpolate_points, map_board_phase
from slviewer.pipeline.cloud_corrections import describe_calibration, scale_factor
from slviewer.pipeline.imported_calibration import check_calibration
from slviewer.pipeline.machine_poses import SIGMA_DEG, SIGMA_MM, ImportPosesSettings
from slviewer.pipeline.models import (
    Model,
    ModelName,
    find_target,
    frame_of,
    load_model,
    load_stereo,
)
from slviewer.pipeline.operation import Found, Job, list_records, load_record, operation
from slviewer.pipeline.poses import read_stored_poses
from slviewer.pipeline.reconstruct import merge_name
from slviewer.records.machine import HandEye, HandEyePose, MachinePose, PlannedPose
from slviewer.records.merge import Merge
from slviewer.records.record import to_matrix, to_vector
from slviewer.session.importers.pose_files import (
    AngleUnit,
    Convention,
    LengthUnit,
    match_captures,
    read_pose_file,
)
from slviewer.session.store import Session
from slviewer.target.board import Board

PLANNED = 6


@dataclass(frozen=True)
class HandEyeSettings:
    """Which poses are used, and how they are read.

    Args:
        poses: CSV or JSON with the robot's pose of each capture of the board, as `import poses`
            reads it; by default the poses that it stored.
        mounting: eye-in-hand: the camera is on the flange, and the board is fixed; eye-to-hand: the
            camera is fixed, and the board is on the flange.
        merge: Merge, as merge/1, of scans of a part in place of captures of a board: how its
            surfaces were registered says how the camera moved.
        convention: How the rotations are written, where their columns do not state it: matrix,
            quaternion-wxyz, quaternion-xyzw, abb, kuka, fanuc or ur.
        unit: Of lengths; by default as the header states, else m of ur and mm of all others.
        angles: Unit of angles; by default as the header states, else rad of ur, deg of all others.
        sigma_mm: Standard deviation of the robot's positions, each axis: its accuracy within the
            motions, not its repeatability; by default as imported, else 0.05.
        sigma_deg: Standard deviation of the robot's rotations, about each axis; by default as
            imported, else 0.01.
        model: Which calibration to use; by default the best one available.
        plan: List six further poses that would reduce the uncertainty most.
        accept_rejected: Use the calibration although its verdict rejects it.
    """

    poses: Path | str | None = None
    mounting: Mounting = "eye-in-hand"
    merge: str = ""
    convention: Convention | None = None
    unit: LengthUnit | None = None
    angles: AngleUnit | None = None
    sigma_mm: Annotated[float | None, SIGMA_MM] = None
    sigma_deg: Annotated[float | None, SIGMA_DEG] = None
    model: ModelName | None = None
    plan: bool = False
    accept_rejected: bool = False


@dataclass(frozen=True, eq=False)
class RobotPoses:
    """The robot's poses (n, 4, 4) mm of captures by ``names``, with other readings of them, and
    the standard deviations of each axis."""

    names: tuple[str, ...]
    robot: Floats
    readings: list[Reading]
    sigma_mm: float
    sigma_deg: float


@operation("hand-eye", HandEye, HandEyeSettings)
def hand_eye(job: Job, settings: HandEyeSettings) -> Iterator[Found[HandEye]]:
    """Find the place of the camera on a robot from captures of the board, or of any part, with its
    uncertainty.

    Scans are merged and exported in the robot's frame then. Reports the residual of each pose, and
    those that move nothing new.
    """
    store = job.store
    check_calibration(job)
    if settings.merge:
        number = merge_name(store, settings.merge)
        merge = load_record(store, Merge, number)
        given = _read_robot_poses(store, settings, merge.scans)
        boards, skipped = _place_part(merge)
        of, symmetry, model, own = "part", 1, merge.model, {f"{Merge.kind}/{number}"}
    else:
        loaded = load_model(store, settings.model)
        given = _read_robot_poses(store, settings, store.capture_names("calibration"))
        boards, skipped, symmetry = measure_boards(job.part(0.0, 0.9), loaded, given.names)
        of, model, own = "board", loaded.name, set[str]()
    rows = [k for k, name in enumerate(given.names) if name in boards]
    if not rows:
        raise InputError(
            f"the {of} could not be measured in any of the {len(given.names)} captures that have a"
            " pose of the robot",
            "; ".join(f"{name}: {why}" for name, why in list(skipped.items())[:3]),
        )
    names = [given.names[k] for k in rows]
    views = HandEyeViews(
        tuple(names),
        given.robot[rows],
        np.array([boards[name][0] for name in names]),
        np.array([boards[name][1] for name in names]),
        given.sigma_mm,
        float(np.radians(given.sigma_deg)),
        settings.mounting,
        symmetry,
    )
    job.progress(0.9, "solving the place of the camera")
    fit = solve_hand_eye(views, [Reading(each.what, each.robot[rows]) for each in given.readings])
    for name, why in fit.excluded.items():
        job.warn(f"{name} is excluded: {why}; did something move, or was its pose read elsewhere?")
    record = make_record(fit, PLANNED if settings.plan else 0)
    used = describe_calibration(store, model, [*names, *own])
    origin = {key: used[key] for key in ("model", "scales", "inputs")}
    frame = frame_of(store, model)
    yield Found("", msgspec.structs.replace(record, frame=frame, skipped=skipped, **origin))


def make_record(fit: HandEyeFit, plan: int = 0) -> HandEye:
    """Return the record of a solution, with so many planned poses."""
    C, repeated = fit.covariance[:6, :6], fit.repeated()
    U = 2 * np.sqrt(np.diag(C))
    planned = zip(*plan_poses(fit, plan), strict=True)
    return HandEye(
        mounting=fit.views.mounting,
        T_carrier_camera=to_matrix(fit.X),
        T_other_board=to_matrix(fit.Z),
        U_mm=coverage_radius(C[3:, 3:]),
        U_deg=float(np.degrees(coverage_radius(C[:3, :3]))),
        U_axes_mm=to_vector(U[3:]),
        U_axes_deg=to_vector(np.degrees(U[:3])),
        covariance=C.tolist(),
        ratio=fit.ratio,
        poses={
            name: HandEyePose(
                float(np.linalg.norm(residual[3:])),
                float(np.degrees(np.linalg.norm(residual[:3]))),
                100 * float(gain) if np.isfinite(gain) else None,
                repeated.get(name, ""),
            )
            for name, residual, gain in zip(fit.views.names, fit.residuals, fit.gains, strict=True)
        },
        excluded=fit.excluded,
        plan=[
            PlannedPose(
                to_matrix(T),
                to_vector(Rotation.from_matrix(T[:3, :3]).as_euler("ZYX", degrees=True)),
                *reached.tolist(),
            )
            for T, reached in planned
        ],
    )


def _place_part(merge: Merge) -> tuple[dict[str, tuple[Floats, Floats]], dict[str, str]]:
    """Return T_camera_part (4, 4) mm of the scans of a merge, from the middle of their overlaps,
    and the covariance (6, 6) of small motions in the part's frame; and why others were skipped."""
    registered = {name: pair for name, pair in merge.pairs.items() if pair.middle}
    skipped = {
        name: "its surface was not registered: the machine alone placed it"
        for name in merge.pairs.keys() - registered.keys()
    }
    if not registered:
        return {}, skipped
    middle = np.mean(np.array([pair.middle for pair in registered.values()], float), axis=0)
    T_reference_part = rigid_transform(np.eye(3), middle)
    placed = {merge.reference: (T_reference_part, np.zeros((6, 6)))}
    for name, pair in registered.items():
        turn, shift = np.radians(pair.sigma_turn_deg or 0.0), pair.sigma_shift_mm or 0.0
        T_scan_part = invert(np.array(pair.T_reference_scan)) @ T_reference_part
        placed[name] = T_scan_part, np.diag([turn**2] * 3 + [shift**2] * 3)
    return placed, skipped


def _read_robot_poses(
    store: Session, settings: HandEyeSettings, captures: Sequence[str]
) -> RobotPoses:
    """Return the poses of the file, or the imported ones, of the captures. Raises InputError where
    there are none."""
    if settings.poses is None:
        found = [each for each in list_records(store, MachinePose) if each.name in captures]
        stored = {each.name: each.record for each in found if each.record.of == "robot"}
        if not stored:
            raise InputError(
                f"no pose of a robot is stored with any of the {len(captures)} captures",
                "give --poses FILE, or `slviewer import poses` first",
            )
        first = next(iter(stored.values()))
        return RobotPoses(
            tuple(stored),
            np.array([each.T_base_machine for each in stored.values()]),
            [],
            settings.sigma_mm or first.sigma_mm,
            settings.sigma_deg or first.sigma_deg,
        )
    read = read_pose_file(settings.poses, settings.convention, settings.unit, settings.angles)
    file, poses = Path(settings.poses).name, read.poses()
    if not read.names and len(poses) != len(captures):
        raise InputError(
            f"{file} holds {len(poses)} poses without names, for {len(captures)} captures",
            "add a column capture with their names",
        )
    matched, _ = match_captures(read.names, captures, file)
    rows = list(matched.values())
    return RobotPoses(
        tuple(matched),
        poses[rows],
        [Reading(what, other[rows]) for what, other in read.readings()],
        settings.sigma_mm or ImportPosesSettings.sigma_mm,
        settings.sigma_deg or ImportPosesSettings.sigma_deg,
    )


def measure_boards(
    job: Job, model: Model, names: Sequence[str]
) -> tuple[dict[str, tuple[Floats, Floats]], dict[str, str], int]:
    """Return T_camera_board (4, 4) mm and its covariance (6, 6) of each capture, by the clouds of
    the ``model``; why others were skipped; and in how many orientations the board looks the
    same."""
    board = Board.parse(find_target(job.store))
    judged = []
    for k, each in enumerate(read_stored_poses(job.store, names, board, Smoothing())):
        job.progress(0.5 * k / len(names), f"reading {each.name}")
        judged.append(each)
    skipped = {each.name: each.refused for each in judged if each.observation is None}
    observations = place_by_neighbours([each.observation for each in judged if each.observation])
    measured = dict[str, tuple[Floats, Floats]]()
    lens, factor = load_stereo(job.store).rig.camera, scale_factor(job.store, model.name)
    for k, observation in enumerate(observations):
        job.progress(
            0.5 + 0.5 * k / len(observations), f"measuring the board in {observation.name}"
        )
        found = measure_board(model, lens, board, observation, factor)
        if found is None:
            skipped[observation.name] = "too few of the board's features could be measured"
        else:
            measured[observation.name] = found
    is_marked = all(observation.marked for observation in observations)
    is_symmetric = board.kind in ("circles", "acircles", "chessboard") and not is_marked
    return measured, skipped, (4 if board.columns == board.rows else 2) if is_symmetric else 1


def measure_board(
    model: Model, lens: Lens, board: Board, observation: Observation, factor: float = 1.0
) -> tuple[Floats, Floats] | None:
    """Return T_camera_board (4, 4) mm, from the middle of the board's features, and the covariance
    (6, 6) of a small turn (rad) and shift (mm) in the board's frame, by the scatter of the features
    in the model's cloud, enlarged by a ``factor``; None where it measures too few of them.

    ``lens``: the camera's, by which circles' centroids are moved to their centres.
    """
    axis: Axis = "x" if "x" in observation.surfaces else "y"
    cloud = factor * np.asarray(model.points(map_board_phase(observation, axis)))
    placed, pixels = observation.points - box_middle(board.points), observation.camera
    for is_first in (True, False):
        features = interpolate_points(cloud, pixels)
        read = finite_rows(features)
        if np.count_nonzero(read) < LEAST_FEATURES:
            return None
        points = placed[read]
        T = fit_rigid(points, features[read])
        if is_first:
            pixels = pixels - centroid_shifts(lens, T, placed, observation.radius_mm)
    residuals = (features[read] - move_points(T, points)) @ T[:3, :3]
    J = motion_jacobian(points)
    inverse = np.linalg.inv(np.einsum("nij,nik->jk", J, J))
    # of each feature's own scatter: depth scatters more than the directions across
    moved = np.einsum("jk,nik,ni->nj", inverse, J, residuals)
    return T, moved.T @ moved * len(points) / (len(points) - 6)
