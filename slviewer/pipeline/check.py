"""Is the saved calibration still good? One capture of its board answers, and the session
remembers."""

from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime

import msgspec

from slviewer.calibration.drift import DriftReference, DriftView, build_reference, check_drift
from slviewer.calibration.observe import observe
from slviewer.calibration.stereo import StereoModel
from slviewer.errors import InputError
from slviewer.pipeline.calibrate import CalibrateSettings
from slviewer.pipeline.capture_phases import capture_texture, check_capture, decode_capture
from slviewer.pipeline.models import load_stereo, warn_if_stale
from slviewer.pipeline.operation import Found, Job, operation
from slviewer.pipeline.poses import load_observations
from slviewer.pipeline.stored_records import list_records, load_record, next_name
from slviewer.reconstruction.axis_agreement import check_sizes
from slviewer.records.calibration import ModelCalibration
from slviewer.records.drift import Drift
from slviewer.session.store import Session
from slviewer.target.board import Board
from slviewer.target.detect import detect

REFERENCE = "drift_reference"


@dataclass(frozen=True)
class CheckSettings:
    """What a calibration is checked with.

    Args:
        capture: Name of a capture, of any role, that shows the calibration's board.
    """

    capture: str


@operation("check", Drift, CheckSettings)
def check(job: Job, settings: CheckSettings) -> Iterator[Found[Drift]]:
    """Determine from one capture of the board whether the saved calibration is still good, and why
    if it is not.

    The session stores the answer as ``drift/1``, ``drift/2``, ... Raises DetectionError where the
    capture does not show the board, InputError where the calibration has too few poses for a
    decision, or was made elsewhere.
    """
    store, capture = job.store, settings.capture
    stereo = load_stereo(store)
    if not stereo.poses:
        raise InputError(
            f"the calibration of {store.folder} was made elsewhere and has no poses: a drift check"
            " needs them to know how well one board determines the projector's pose; run `slviewer"
            " calibrate` first"
        )
    warn_if_stale(store, job.warn)
    shot = store.load_capture(capture)
    job.progress(0.0, f"reading {capture}")
    frames = shot.stack()
    phases = decode_capture(shot, frames)
    check_capture(capture, shot.sequence, frames, phases, files=shot.files)
    check_sizes(capture, shot.size, shot.sequence.projector_size, stereo.rig)
    board = Board.parse(stereo.board)
    detection = detect(board, capture_texture(shot, frames))
    calibrated = CalibrateSettings(**load_record(store, ModelCalibration, "stereo").settings)
    observation = observe(capture, board, detection, phases, calibrated.step_2)
    job.progress(0.3, "fitting the calibration's own poses")
    drift = check_drift(
        _drift_reference(store, stereo, capture), DriftView.from_observation(observation)
    )
    before = load_drift_history(store)
    found = msgspec.structs.replace(
        drift,
        time=datetime.now(UTC).isoformat(timespec="seconds"),
        inputs=store.input_hashes(capture, "calibration/stereo"),
    )
    notes = ["earlier checks of this calibration:"] if before else []
    notes += [f"  {each.time[:16].replace('T', ' ')}  {each.summary()}" for each in before]
    yield Found(next_name(store, Drift), found, notes=tuple(notes))
    job.progress(1.0, "checked")


def _drift_reference(store: Session, stereo: StereoModel, capture: str) -> DriftReference:
    """Load or build the drift reference from the calibration's poses except the capture; stored, as
    it is slow."""
    if capture not in stereo.poses:
        saved = store.decode_fresh(
            REFERENCE, lambda _, arrays: DriftReference.from_arrays(stereo.rig, arrays)
        )
        if saved is not None:
            return saved
    poses = [name for name in stereo.poses if name != capture]
    reference = build_reference(
        stereo.rig, [DriftView.from_observation(o) for o in load_observations(store, poses)]
    )
    if capture not in stereo.poses and store.is_writable:
        meta = {"inputs": store.input_hashes("calibration/stereo", *poses)}
        store.save_result(REFERENCE, meta, reference.to_arrays())
    return reference


def load_drift_history(store: Session) -> list[Drift]:
    """Load the drift checks of the session's present calibration, the oldest first."""
    now = store.input_hashes("calibration/stereo")["calibration/stereo"]
    checks = [each.record for each in list_records(store, Drift)]
    return [each for each in checks if each.inputs.get("calibration/stereo") == now]
