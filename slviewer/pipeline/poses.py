"""The observation of each target pose, and the evidence of its frames, computed once and stored in
the session as `poses/<name>` and `evidence/<name>`."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any, cast

import numpy as np

from slviewer.calibration.diagnosis.evidence import PoseEvidence
from slviewer.calibration.diagnosis.frames import (
    fit_mean_turn,
    measure_axis,
    measure_motion_px,
    measure_white_delay,
)
from slviewer.calibration.diagnosis.numbering import detect_grid_size, place_by_neighbours
from slviewer.calibration.observe import (
    AXES,
    READING_VERSION,
    Observation,
    Smoothing,
    observe,
    pitch_px,
)
from slviewer.errors import BoardError, DamagedError, DetectionError, InputError
from slviewer.examination.light import Look
from slviewer.fringe.image_area import ImageArea, fill_dead
from slviewer.fringe.phase import PhaseMaps
from slviewer.fringe.sequence import Axis, PatternSequence, Size
from slviewer.geometry.polynomial import fit_polynomial
from slviewer.geometry.vectors import rms
from slviewer.pipeline.capture_phases import (
    capture_texture,
    check_capture,
    compute_ahead,
    decode_capture,
    look_at_capture,
    match_second,
)
from slviewer.pipeline.examination import examine_frames, load_or_save_examination
from slviewer.reconstruction.camera_match import Lines
from slviewer.records.record import to_plain
from slviewer.records.verdict import Cause, Examination, Finding
from slviewer.session.capture import Capture
from slviewer.session.store import Session
from slviewer.target.board import Board, Detection
from slviewer.target.detect import board_mask, detect

LINES_DEGREE = 5
"""Of the polynomial through a board's features: perspective and distortion leave less than
noise."""
EVIDENCE_VERSION = 14
"""Version of the examination; evidence that was stored by another version is computed again."""
NEAR_LINE = 0.4
"""Distance from a dead line, in pitches, within which a feature may be displaced by the line."""
POSES_AT_ONCE = 2
"""Poses read side by side: most of the work on one occupies one thread."""


@dataclass(frozen=True, eq=False)
class DecodedPose:
    """A look at the frames of a target pose with what they were decoded to; ``texture`` (h, w) or
    (h, w, 3) uint8 shows the board; ``matched``: what its board is observed by, where that is not
    the decoded phases but a second camera's coordinates; ``fault``: why there are none of these.
    """

    name: str
    sequence: PatternSequence
    look: Look
    phases: PhaseMaps
    texture: np.ndarray
    board: Board
    matched: PhaseMaps | None = None
    fault: str = ""

    @cached_property
    def image(self) -> np.ndarray:
        """The texture without the image's bars, its dead lines and pixels filled."""
        return cut_area(self.texture, self.look.area)

    def detect(self) -> Detection:
        """Detect the board in the image without its bars; features on its dead lines are skipped.
        Raises DetectionError."""
        return detect_in_area(self.board, self.image, self.look.area)


def cut_area(image: np.ndarray, area: ImageArea) -> np.ndarray:
    """Return an image (h, w) or (h, w, 3) without its area's bars, dead lines and pixels filled."""
    u0, v0, u1, v1 = area.box
    return fill_dead(image, area)[v0:v1, u0:u1]


def detect_in_area(
    board: Board, image: np.ndarray, area: ImageArea, several: bool = True
) -> Detection:
    """Detect a board in what ``cut_area`` returned, in pixels of the whole image; features on dead
    lines are skipped. ``several`` as in `detect`. Raises DetectionError."""
    try:
        detection = detect(board, image, several=several)
    except DetectionError as error:
        if constant := area.describe_cut():
            error.observation += f" (of the image without {constant})"
        raise
    pixels = detection.pixels + np.array(area.box[:2])
    reach = NEAR_LINE * pitch_px(board, detection)
    keep = np.ones(len(pixels), bool)
    for axis, place in area.lines.tolist():
        keep &= np.abs(pixels[:, axis] - place) > reach
    others = detection.others[:, keep] if len(detection.others) else detection.others
    return replace(detection, pixels=pixels[keep], ids=detection.ids[keep], others=others)


@dataclass(frozen=True)
class Judged:
    """A pose's observation, or None and the reason (``refused``); ``note``: what else is in view
    and not used."""

    name: str
    observation: Observation | None
    refused: str = ""
    evidence: PoseEvidence | None = None
    note: str = ""


def read_pose(
    pose: DecodedPose,
    smoothing: Smoothing,
    examine: bool = True,
    examined: Callable[[], Examination] | None = None,
    observed: Callable[[Observation], None] | None = None,
) -> Judged:
    """Return the observation of a decoded target pose, or the reason why there is none.

    ``examine``: with the evidence of its frames, which ``examined`` returns (computed if
    None). ``observed`` is called with the observation before the frames are checked, after which
    the pose may still be refused.
    """
    name, sequence, frames, phases = pose.name, pose.sequence, pose.look.stack, pose.phases
    detection: Detection | None = None
    observation: Observation | None = None
    refused, misfit = "", None
    try:
        if pose.fault:
            raise InputError(pose.fault)
        detection, area = pose.detect(), pose.look.area
        observation = observe(name, pose.board, detection, pose.matched or phases, smoothing, area)
        if pose.matched and len(phases) == 2:
            with suppress(InputError):  # the cameras do without
                light = observe(name, pose.board, detection, phases, smoothing, area)
                observation = replace(observation, light=light)
        if observed is not None:
            observed(observation)
    except InputError as error:
        refused = str(error).removeprefix(f"{name}: ")
        if isinstance(error, BoardError) and error.cause:
            cause = cast(Cause, error.cause)
            misfit = Finding(cause, "rejected", error.observation, error.remedy)
    examine_them = examined or partial(examine_frames, sequence, frames, look=pose.look)
    checked = examine_them() if examine else None
    if observation is not None:
        try:
            check_capture(name, sequence, frames, phases, checked)
        except InputError as error:
            refused = str(error).removeprefix(f"{name}: ")
    evidence = None
    if checked is not None:
        evidence = gather_evidence(pose, checked, detection, observation, refused, misfit)
    note = detection.note if detection else ""
    return Judged(name, None if refused else observation, refused, evidence, note)


def read_stored_pose(
    store: Session,
    capture: Capture,
    look: Look,
    board: Board,
    smoothing: Smoothing,
    observed: Callable[[Observation], None] | None,
) -> Judged:
    """Decode the frames of a pose, read it as ``read_pose`` does, and save the result and
    the check of the frames in the session."""
    phases, texture = decode_capture(capture, look), capture_texture(capture, look.stack)
    matched, fault = None, ""
    try:
        if capture.second:
            first = fill_dead(texture, look.area)
            lines = partial(board_lines, board, next(iter(phases)), first)
            matched = match_second(capture, phases, lines)
    except InputError as error:
        fault = str(error)
    decoded = capture.name, capture.sequence, look, phases, texture, board
    pose = DecodedPose(*decoded, matched, fault)
    examined = partial(load_or_save_examination, store, capture, look)
    judged = read_pose(pose, smoothing, True, examined, observed)
    inputs = {capture.name: capture.hash}
    evidence = {"evidence": to_plain(judged.evidence), "inputs": inputs}
    store.save_result(f"evidence/{capture.name}", _evidence_settings(board) | evidence, {})
    reading = {"refused": judged.refused, "note": judged.note, "inputs": inputs}
    arrays = judged.observation.to_arrays() if judged.observation else {}
    store.save_result(
        f"poses/{capture.name}", _reading_settings(board, smoothing) | reading, arrays
    )
    return judged


def _evidence_settings(board: Board) -> dict[str, Any]:
    """Return what stored evidence must agree with to be used."""
    return {"target": str(board), "look": EVIDENCE_VERSION}


def _reading_settings(board: Board, smoothing: Smoothing) -> dict[str, Any]:
    """Return what a stored reading must agree with to be used."""
    settings: list[str | int] = [smoothing.kind]
    if smoothing.kind != "spline":
        settings.append(smoothing.degree)
    return {"target": str(board), "smoothing": settings, "reading": READING_VERSION}


def board_lines(board: Board, axis: Axis, first: np.ndarray, second: np.ndarray) -> Lines:
    """Return the board's coordinate, mm, that varies along the fringes of ``axis``, at each pixel
    of two cameras' textures: by a polynomial through the features, within the board's outline.

    Raises DetectionError where one does not show the board.
    """
    maps, sigmas, along = list[np.ndarray](), list[float](), -1
    for texture in (first, second):
        height, width = texture.shape[:2]
        detection = detect(board, texture)
        (u, v), points = detection.pixels.T, board.points[detection.ids][:, :2]
        if along < 0:
            slopes = np.linalg.lstsq(np.column_stack([u, v, np.ones(len(u))]), points, rcond=None)[
                0
            ]
            along = int(np.argmax(np.abs(slopes[1 if axis == "x" else 0])))
        values = points[:, along]
        fit = fit_polynomial(u, v, values, None, (width, height), LINES_DEGREE, robust=True)
        inside = board_mask(board, detection, (height, width))
        maps.append(np.where(inside, fit.evaluate_grid((height, width)), np.nan))
        # what the coefficients take of the scatter
        share = (LINES_DEGREE + 1) * (LINES_DEGREE + 2) / 2 / len(u)
        sigmas.append(rms(values - fit.evaluate(u, v)) * share**0.5)
    return Lines(maps[0], maps[1], (sigmas[0], sigmas[1]), AXES)


def load_judged(store: Session, name: str, board: Board, smoothing: Smoothing) -> Judged | None:
    """Load the stored reading of a pose, and the evidence of its frames; None where one is missing,
    or of other frames, another board, another smoothing or another version."""

    def decode_evidence(meta: Mapping[str, Any], _: object) -> PoseEvidence | None:
        """Return the evidence, if it is current."""
        is_current = _evidence_settings(board).items() <= meta.items()
        return PoseEvidence.from_json(meta["evidence"]) if is_current else None

    def decode(meta: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> Judged | None:
        """Return the reading, if it is current."""
        if not _reading_settings(board, smoothing).items() <= meta.items():
            return None
        observation = _decode_observation(name, meta, arrays)
        return Judged(name, observation, meta["refused"], evidence, meta.get("note", ""))

    evidence = store.decode_fresh(f"evidence/{name}", decode_evidence, only=())
    return None if evidence is None else store.decode_fresh(f"poses/{name}", decode)


def read_stored_poses(
    store: Session,
    names: Sequence[str],
    board: Board,
    smoothing: Smoothing,
    observed: Callable[[Observation], None] | None = None,
) -> Iterator[Judged]:
    """Yield every pose in order, with the evidence of its frames; these are read only where no
    stored result is valid. Damaged frames refuse the pose.

    ``observed`` as in ``read_pose``. Raises InputError where poses come from cameras or projectors
    of different size.
    """
    captures = [store.load_capture(name) for name in names]
    for capture in captures[1:]:
        first = captures[0]
        own, others = ((each.size, _other_size(each)) for each in (capture, first))
        if own != others or bool(capture.second) != bool(first.second):
            (a, b), (c, d) = (map(_wxh, each) for each in (own, others))
            other = "second camera" if capture.second else "projector"
            raise InputError(
                f"{capture.name} has a {a} camera and a {b} {other}, {first.name} {c} and {d}",
                "calibrate poses of one rig at one resolution",
            )
    cached = {name: load_judged(store, name, board, smoothing) for name in names}
    missing = [capture for capture in captures if cached[capture.name] is None]

    def read(capture: Capture) -> Judged:
        """Read a pose, which damaged frames refuse."""
        try:
            look = look_at_capture(capture)
            return read_stored_pose(store, capture, look, board, smoothing, observed)
        except DamagedError as error:
            return Judged(capture.name, None, str(error).removeprefix(f"{capture.name}: "))

    ahead = compute_ahead(read, missing, POSES_AT_ONCE)
    for name in names:
        yield cached[name] or next(ahead)[1].result()


def load_observations(store: Session, names: Sequence[str]) -> list[Observation]:
    """Load the stored observations of the named poses, numbered as the calibration did."""
    observations = []
    for name in names:
        if store.has_result(f"poses/{name}"):
            observation = store.decode_result(f"poses/{name}", partial(_decode_observation, name))
            observations += [] if observation is None else [observation]
    return place_by_neighbours(observations)


def _decode_observation(
    name: str, meta: Mapping[str, Any], arrays: Mapping[str, np.ndarray]
) -> Observation | None:
    """Return the observation in a stored reading; None where the pose was refused."""
    return None if meta["refused"] else Observation.from_arrays(name, arrays)


def _other_size(capture: Capture) -> Size:
    """Return the size px of the device beside the camera. Raises InputError where the projector's
    is not known."""
    return capture.other_size or capture.sequence.projector


def _wxh(size: Size) -> str:
    """Format a size (width, height) px as "WxH"."""
    return f"{size[0]}x{size[1]}"


def gather_evidence(
    pose: DecodedPose,
    examination: Examination,
    detection: Detection | None,
    observation: Observation | None,
    refused: str,
    misfit: Finding | None,
) -> PoseEvidence:
    """Evidence from a decoded pose. ``detection`` and ``observation``: its board and its phase,
    None where they could not be read, for the reason ``refused``; ``misfit``: by which
    the board contradicts its description; ``examination``: of its frames.
    """
    sequence, frames, board = pose.sequence, pose.look.stack, pose.board
    grid, on_board, moved_px = None, None, np.nan
    is_oriented = False
    if detection is None:
        grid = detect_grid_size(board, pose.image)
    else:
        is_marked = detection.marked and board.columns != board.rows  # a square has no mirror image
        is_oriented = is_marked or board.kind == "charuco"
        on_board = board_mask(board, detection, pose.texture.shape)
        pitch = float(np.median(pitch_px(board, detection)))
        moved_px = measure_motion_px(sequence, frames, detection.pixels, pitch)
    turn = None
    if observation is not None:
        turn = fit_mean_turn(observation.camera, observation.projector)
    return PoseEvidence(
        name=pose.name,
        refused=refused,
        grid=grid,
        axes={
            axis: measure_axis(sequence, frames, phase, on_board)
            for axis, phase in pose.phases.items()
        },
        findings=examination.findings,
        displaced=measure_white_delay(sequence, frames),
        moved_px=moved_px,
        turn=turn,
        misfit=misfit,
        upright=is_oriented,
    )
