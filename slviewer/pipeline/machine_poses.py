"""Poses of a robot, a CMM or a stage: stored with the captures that they belong to, and the places
of scans that follow from them."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np

from slviewer.errors import InputError
from slviewer.inputs import Input
from slviewer.pipeline.models import frame_of
from slviewer.pipeline.operation import (
    Found,
    Job,
    list_records,
    load_record,
    match_names,
    next_name,
    operation,
)
from slviewer.records.machine import HandEye, MachinePose
from slviewer.records.record import to_matrix
from slviewer.registration.machine_places import MachinePlace
from slviewer.session.importers.pose_files import (
    AngleUnit,
    Convention,
    LengthUnit,
    match_captures,
    read_pose_file,
)
from slviewer.session.store import Session

SIGMA_MM = Input(1e-6, 1e3, "mm", "Sigma")
SIGMA_DEG = Input(1e-6, 180.0, "°", "Sigma")
PoseOf = Literal["robot", "scan"]


@dataclass(frozen=True)
class ImportPosesSettings:
    """Which file is imported, and how it is read.

    Args:
        file: CSV or JSON with a pose for each capture: a column of their names, and x, y, z with
            qw, qx, qy, qz, or a, b, c (KUKA), w, p, r (Fanuc), or rx, ry, rz (ABB, UR); or 4x4
            matrices by rows.
        convention: How the rotations are written, where their columns do not state it: matrix,
            quaternion-wxyz, quaternion-xyzw, abb (quaternion w first, or rx, ry, rz about fixed
            axes), kuka, fanuc or ur (rotation vector).
        unit: Of lengths; by default as the header states, else m of ur and mm of all others.
        angles: Unit of angles; by default as the header states, else rad of ur, deg of all others.
        of: What the poses are of: robot, its flange or tool in its base, from which the camera
            follows by `hand-eye`; or scan, the camera itself, from a stage or a CMM.
        captures: Names of the captures, in the order of the file, where it names none; by default
            all scans.
        sigma_mm: Standard deviation of a position, each axis.
        sigma_deg: Standard deviation of a rotation, about each axis.
    """

    file: Path | str
    convention: Convention | None = None
    unit: LengthUnit | None = None
    angles: AngleUnit | None = None
    of: PoseOf = "robot"
    captures: Sequence[str] = ()
    sigma_mm: Annotated[float, SIGMA_MM] = 0.05
    sigma_deg: Annotated[float, SIGMA_DEG] = 0.01


@operation("import-poses", MachinePose, ImportPosesSettings)
def import_poses(job: Job, settings: ImportPosesSettings) -> Iterator[Found[MachinePose]]:
    """Store the poses of a robot, a CMM or a stage with the captures that were taken there, for
    `hand-eye` and `merge`."""
    read = read_pose_file(settings.file, settings.convention, settings.unit, settings.angles)
    poses, store, file = read.poses(), job.store, Path(settings.file).name
    names = store.capture_names()
    if not read.names:
        names = match_names(names, settings.captures, "capture", InputError)
        names = names if settings.captures else store.capture_names("scan")
        if len(names) != len(poses):
            raise InputError(
                f"{file} holds {len(poses)} poses without names, for {len(names)} captures",
                "add a column capture with their names, or name them by --captures",
            )
    matched, unknown = match_captures(read.names, names, file)
    if unknown:
        job.warn(f"no capture is called {', '.join(unknown)}: their poses are not stored")
    for name, k in matched.items():
        yield Found(
            name,
            MachinePose(
                T_base_machine=to_matrix(poses[k]),
                of=settings.of,
                sigma_mm=settings.sigma_mm,
                sigma_deg=settings.sigma_deg,
                file=file,
                convention=f"{read.convention}, {read.unit}, {read.angles}",
                inputs=store.input_hashes(name),
            ),
        )


def load_hand_eye(store: Session, model: str) -> HandEye:
    """Load the latest hand-eye calibration of a model's camera frame. Raises InputError where there
    is none, or it is of another calibration."""
    found = list_records(store, HandEye)
    if not found:
        raise InputError("the camera's place on the robot is not known", "run `slviewer hand-eye`")
    latest, frame = found[-1], frame_of(store, model)
    if latest.stale or latest.record.frame != frame:
        raise InputError(
            f"hand-eye calibration {latest.name} is of the {latest.record.frame}, and clouds are in"
            f" the frame of the {frame}",
            "run `slviewer hand-eye` again",
        )
    return latest.record


def place_inputs(store: Session, names: Sequence[str]) -> dict[str, str]:
    """Return the hashes of what the machine's places of scans were made from: its poses, and, of a
    robot's flange, the hand-eye calibration. The next one, which is absent, is an input too: where
    the camera has been placed anew, what was made by the place before is stale."""
    poses = [f"{MachinePose.kind}/{name}" for name in names]
    inputs = store.input_hashes(*poses)
    if any(load_record(store, MachinePose, name).of == "robot" for name in names):
        latest = list_records(store, HandEye)[-1].name
        inputs |= store.input_hashes(f"{HandEye.kind}/{latest}")
        inputs[f"{HandEye.kind}/{next_name(store, HandEye)}"] = ""
    return inputs


def load_places(store: Session, names: Sequence[str], model: str) -> dict[str, MachinePlace]:
    """Return the place of each scan by the machine's poses. Raises InputError for scans without
    one."""
    stored = {each.name: each.record for each in list_records(store, MachinePose)}
    if missing := [name for name in names if name not in stored]:
        raise InputError(
            f"no pose of a machine is stored with {', '.join(missing)}",
            "run `slviewer import poses`, or start from features",
        )
    by_robot = any(stored[name].of == "robot" for name in names)
    hand_eye = load_hand_eye(store, model) if by_robot else None
    places = dict[str, MachinePlace]()
    for name in names:
        pose = stored[name]
        variances = np.repeat([np.radians(pose.sigma_deg) ** 2, pose.sigma_mm**2], 3)
        noise, T = np.diag(variances), np.array(pose.T_base_machine)
        if pose.covariance:
            noise = np.array(pose.covariance)
        if hand_eye is None or pose.of == "scan":
            places[name] = MachinePlace(T, noise, np.zeros((6, 6)))
            continue
        X, covariance = np.array(hand_eye.T_carrier_camera), np.array(hand_eye.covariance)
        in_hand = hand_eye.mounting == "eye-in-hand"
        places[name] = MachinePlace.from_robot(T, noise, X, covariance, in_hand)
    return places
