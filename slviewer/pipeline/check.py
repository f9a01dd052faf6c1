"""Is the saved calibration still good? One capture of its board answers, and the session remembers."""

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

from slviewer.calibration.drift.check import Drift, check_drift
from slviewer.calibration.drift.reference import DriftReference, build_reference
from slviewer.calibration.drift.view import DriftView
from slviewer.calibration.observe import Smoothing, observe
from slviewer.calibration.stereo import StereoModel
from slviewer.errors import InputError
from slviewer.pipeline.capture_phases import capture_texture, check_capture, decode_capture
from slviewer.pipeline.feedback import Progress, Warn, ignore_progress, ignore_warnings
from slviewer.pipeline.models import load_stereo, warn_if_stale
from slviewer.pipeline.open_session import SessionLike, next_number, numbered_results, opened
from slviewer.pipeline.poses import load_observations
from slviewer.reconstruction.axis_agreement import check_sizes
from slviewer.records.plain import from_plain, to_plain
from slviewer.session.store import Session
from slviewer.target.board import Board
from slviewer.target.detect import detect

REFERENCE = "drift_reference"


@dataclass(frozen=True)
class DriftRecord:
    """One result of the drift check: ``time`` is ISO 8601, UTC; ``calibration`` the hash of what was checked."""

    time: str
    calibration: str
    drift: Drift

    def to_json(self) -> dict[str, Any]:
        """Return the record as plain values."""
        return {"time": self.time, "calibration": self.calibration} | to_plain(self.drift)


@dataclass(frozen=True)
class CheckResult:
    """The ``latest`` drift check, and those ``before`` of the same calibration, the oldest first."""

    latest: DriftRecord
    before: tuple[DriftRecord, ...]

    @property
    def drift(self) -> Drift:
        """The drift estimate of the latest check."""
        return self.latest.drift

    def to_json(self) -> dict[str, Any]:
        """Return the published values of ``check --json``."""
        return self.latest.to_json() | {"before": [checked.to_json() for checked in self.before]}

    def text(self) -> str:
        """Return a report for the terminal: the verdict, then the history."""
        lines = [self.drift.text()]
        if self.before:
            lines.append("earlier checks of this calibration:")
            lines += [f"  {describe_check(checked)}" for checked in self.before]
        return "\n".join(lines)


def describe_check(checked: DriftRecord) -> str:
    """Describe one record of the history in a line."""
    d = checked.drift
    across = "" if d.across_px is None else f", {d.across_px:+.4f} px off its epipolar lines"
    return (
        f"{checked.time[:16].replace('T', ' ')}  {d.capture}: {d.verdict}; board {d.scale_ppm:+.0f} +- "
        f"{d.scale_sigma_ppm:.0f} ppm{across}"
    )


def check(
    session: SessionLike, capture: str, *, progress: Progress = ignore_progress, warn: Warn = ignore_warnings
) -> CheckResult:
    """Determine from one capture of the board whether the saved calibration is still good, and why if it is not.

    Args:
        session: Session folder.
        capture: Name of a capture, of any role, that shows the calibration's board.

    The session stores the answer as ``drift/1``, ``drift/2``, ... Raises DetectionError where the capture does not show
    the board, InputError where the calibration has too few poses for a decision, or was made elsewhere.
    """
    with opened(session, write=True) as store:
        stereo = load_stereo(store)
        if not stereo.poses:
            raise InputError(
                f"the calibration of {store.folder} was made elsewhere and has no poses: a drift check needs them "
                "to know how well one board determines the projector's pose; run `slviewer calibrate` first"
            )
        warn_if_stale(store, warn)
        shot = store.load_capture(capture)
        progress(0.0, f"reading {capture}")
        frames = shot.stack()
        phases = decode_capture(shot, frames)
        check_capture(capture, shot.sequence, frames, phases, files=shot.files)
        check_sizes(capture, shot.size, shot.sequence.projector_size, stereo.rig)
        board = Board.parse(stereo.board)
        observation = observe(
            capture, board, detect(board, capture_texture(shot, frames)), phases, _calibration_smoothing(store)
        )
        progress(0.3, "fitting the calibration's own poses")
        drift = check_drift(_drift_reference(store, stereo, capture), DriftView.from_observation(observation))
        progress(0.95, "saving")
        calibration = store.input_hashes("calibration/stereo")["calibration/stereo"]
        before = tuple(checked for checked in load_drift_history(store) if checked.calibration == calibration)
        latest = DriftRecord(datetime.now(UTC).isoformat(timespec="seconds"), calibration, drift)
        inputs = store.input_hashes(capture, "calibration/stereo")
        store.save_result(f"drift/{next_number(store, 'drift')}", {"checked": latest.to_json(), "inputs": inputs}, {})
        progress(1.0, "checked")
    return CheckResult(latest, before)


def _drift_reference(store: Session, stereo: StereoModel, capture: str) -> DriftReference:
    """Load or build the drift reference from the calibration's poses except the capture; stored, as it is slow."""
    if capture not in stereo.poses:
        saved = store.decode_fresh(REFERENCE, lambda _, arrays: DriftReference.from_arrays(stereo.rig, arrays))
        if saved is not None:
            return saved
    poses = [name for name in stereo.poses if name != capture]
    reference = build_reference(stereo.rig, [DriftView.from_observation(o) for o in load_observations(store, poses)])
    if capture not in stereo.poses:
        meta = {"inputs": store.input_hashes("calibration/stereo", *poses)}
        store.save_result(REFERENCE, meta, reference.to_arrays())
    return reference


def load_drift_history(store: Session) -> tuple[DriftRecord, ...]:
    """Load every drift check of the session, the oldest first."""

    def decode(meta: Mapping[str, Any], _: object) -> DriftRecord:
        """Return the record of one check."""
        values = meta["checked"]
        return DriftRecord(values["time"], values["calibration"], from_plain(values, Drift))

    return tuple(store.decode_result(name, decode, only=()) for name in numbered_results(store, "drift"))


def _calibration_smoothing(store: Session) -> Smoothing:
    """The smoothing of the calibration's own poses."""
    settings = store.load_result("calibration/stereo", only=())[0]["settings"]
    return Smoothing(settings["smoothing"], settings["degree"])
