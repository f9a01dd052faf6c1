"""Checks of R and T of an imported calibration by captures: any with patterns along both axes, the
board, or a sphere of known size. The session stores them, and the verdict on the calibration rests
on them."""

from collections.abc import Iterable
from contextlib import suppress

import msgspec
import numpy as np

from slviewer.calibration.board_pose import solve_pose
from slviewer.calibration.observe import observe
from slviewer.errors import DetectionError, InputError
from slviewer.evaluation.transform_hypotheses import (
    check_by_axes,
    check_by_board,
    check_by_single_axis,
    check_by_sphere,
)
from slviewer.fringe.phase import PhaseMaps
from slviewer.geometry.rig import StereoRig
from slviewer.geometry.rigid import move_points
from slviewer.geometry.vectors import lengths
from slviewer.pipeline.capture_phases import (
    capture_texture,
    decode_capture,
    look_at_capture,
    match_second,
)
from slviewer.pipeline.imported_verdict import judge_imported, list_transform_checks
from slviewer.pipeline.models import (
    check_accepted,
    find_target,
    load_pair,
    load_stereo,
    warn_of_calibration,
)
from slviewer.pipeline.operation import Job, next_name, save_record
from slviewer.reconstruction.axis_agreement import REFUSED_PX, check_sizes
from slviewer.reconstruction.camera_match import epipolar_lines
from slviewer.records.calibration import TransformCheck
from slviewer.session.capture import Capture
from slviewer.session.layout import time_now
from slviewer.session.store import Session
from slviewer.target.board import Board
from slviewer.target.detect import detect

REMEDY = (
    "it needs patterns along both axes of anything, the board (--target BOARD), or a sphere of"
    " known size (--radius MM); capture one of these, and run `slviewer check SESSION CAPTURE`"
)


def check_calibration(job: Job) -> None:
    """Check the calibration before clouds are made with it: whether it is accepted, stale, and, if
    it was imported, confirmed by a capture."""
    confirm_imported(job.store)
    check_accepted(job.store, job.accept_rejected)
    warn_of_calibration(job.store, job.warn)


def confirm_imported(store: Session) -> None:
    """Check an imported calibration by the session's captures with both axes, until one agrees; the
    session stores the checks."""
    if judge_imported(store) is None or not store.is_writable:
        return
    checks = list_transform_checks(store)
    if any(check.is_good for check in checks):
        return
    done = [check.inputs for check in checks]
    for capture in store.captures(with_frames=True):
        if not any(inputs.get(capture.name) == capture.hash for inputs in done):
            check = check_capture_axes(capture, load_stereo(store).rig)
            if check is not None:
                save_check(store, check)
                if check.is_good:
                    return


def check_capture_axes(capture: Capture, rig: StereoRig) -> TransformCheck | None:
    """Check R and T by both axes of a capture; None for one of other devices, or of one axis."""
    sizes = capture.size, capture.other_size
    if len(capture.sequence.axes) < 2 or sizes != (rig.camera.size, rig.projector.size):
        return None
    try:
        return check_by_axes(capture.name, rig, match_second(capture, decode_capture(capture)))
    except InputError as error:
        return TransformCheck(
            capture=capture.name, answer="undecided", evidence="two axes", remedy=str(error)
        )


def confirm_by_captures(captures: Iterable[Capture], rig: StereoRig) -> tuple[TransformCheck, ...]:
    """Return the checks of a calibration by captures with both axes, up to the first that decides;
    where there are none, that of the first capture with one axis. Raises InputError where that
    contradicts the calibration."""
    checks, singles = list[TransformCheck](), list[Capture]()
    for capture in captures:
        if (check := check_capture_axes(capture, rig)) is not None:
            checks.append(check)
            if check.answer != "undecided":
                break
        elif capture.second is None and capture.size == rig.camera.size:
            singles.append(capture)
    for capture in singles[: 0 if checks else 1]:
        with suppress(InputError):  # phases that are not absolute, or too dark
            phases = decode_capture(capture)
            checks.append(check_by_single_axis(capture.name, rig, phases))
    if checks and checks[-1].failure:
        raise InputError(checks[-1].failure)
    return tuple(checks)


def save_check(store: Session, check: TransformCheck) -> None:
    """Store a check of the session's calibration."""
    save_record(store, next_name(store, TransformCheck), _complete(store, check), {})


def _complete(store: Session, check: TransformCheck) -> TransformCheck:
    """Return a check with its time, and the hashes of what it is of."""
    return msgspec.structs.replace(
        check,
        time=time_now(),
        inputs=store.input_hashes(check.capture, "calibration/stereo"),
    )


def check_imported(job: Job, name: str, target: str, radius_mm: float | None) -> TransformCheck:
    """Check R and T of the session's imported calibration by a capture: by a sphere of this radius,
    by the board ``target`` (by default the session's, if it is in view), by both axes, or, where
    it has only one, whether that contradicts them.

    Raises DetectionError where a stated board is not in view, InputError where a capture is of
    another size, or its stated sphere is not in view.
    """
    store = job.store
    shot, rig = store.load_capture(name), load_stereo(store).rig
    check_sizes(name, shot.size, shot.other_size, rig)
    look = look_at_capture(shot)
    phases = match_second(
        shot, decode_capture(shot, look), lambda _: epipolar_lines(load_pair(store))
    )
    job.progress(0.4, "trying what R and T may mean")
    check = None
    if radius_mm is not None:
        best = max(phases.values(), key=lambda phase: np.count_nonzero(phase.mask))
        check = check_by_sphere(name, rig, best, radius_mm)
    elif notation := target or find_target(store):
        try:
            check = _check_on_board(name, rig, notation, capture_texture(shot, look.stack), phases)
        except DetectionError:
            if target:
                raise
    if check is None:
        whole = len(phases) > 1
        check = (check_by_axes if whole else check_by_single_axis)(name, rig, phases)
    if check.answer == "undecided" and not check.remedy:
        check = msgspec.structs.replace(check, remedy=REMEDY)
    return _complete(store, check)


def _check_on_board(
    name: str, rig: StereoRig, notation: str, texture: np.ndarray, phases: PhaseMaps
) -> TransformCheck:
    """Check R and T by the board of this notation in a capture."""
    board = Board.parse(notation)
    observation = observe(name, board, detect(board, texture), phases)
    camera, pixels = rig.camera, observation.camera
    pose = solve_pose(observation.points, pixels, camera.K, camera.D)
    points = None if pose is None else move_points(pose, observation.points)
    off_px = np.inf if points is None else np.median(lengths(camera.project(points) - pixels))
    if points is None or off_px > REFUSED_PX:
        raise InputError(
            f"{name}: the board is {off_px:.1f} px beside where the camera's matrix can have it",
            "check the board's notation, and the matrix and distortion of the camera",
        )
    return check_by_board(name, rig, points, observation.projector)
