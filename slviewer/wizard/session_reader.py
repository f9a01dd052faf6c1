"""Reads what a session's files contain, for the panels. Nothing is cached but what would be read
again the same."""

import threading
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeVar

import numpy as np

from slviewer.calibration.next_pose import outline_px
from slviewer.calibration.observe import Observation
from slviewer.calibration.stereo import StereoModel
from slviewer.errors import DamagedError, InputError, SessionError
from slviewer.fringe.presets import PRESETS
from slviewer.pipeline.calibrate import load_last_verdict
from slviewer.pipeline.capture import DEFAULT_PATTERNS
from slviewer.pipeline.models import (
    accepts_rejected,
    available_models,
    explain_board,
    find_target,
    load_model,
    load_stereo_if_complete,
    preferred_model,
    recommended_model,
    rejection_reason,
)
from slviewer.pipeline.scale import describe_scale, scale_factor
from slviewer.pipeline.stored_records import Stored, captures_of, read_record
from slviewer.records.kinds import RECORDS
from slviewer.records.measurement import Measurement
from slviewer.records.placement import Placement
from slviewer.records.reconstruction import Reconstruction
from slviewer.session.capture import Capture
from slviewer.session.inspection_plan import list_plans
from slviewer.session.names import join_names, natural_key
from slviewer.session.scan_edits import list_edits, load_region, restriction_inputs
from slviewer.session.store import Session
from slviewer.target.board import Board
from slviewer.wizard.export_files import list_exports
from slviewer.wizard.notices import describe_failure
from slviewer.wizard.planner import Planner
from slviewer.wizard.pose_plan import PlanInput, PoseFeatures, PosePlan
from slviewer.wizard.snapshot import (
    CalibrationView,
    PoseState,
    PoseView,
    RigView,
    ScanView,
    SessionView,
)
from slviewer.wizard.surfaces import list_nominals
from slviewer.wizard.tasks import missing_for_splined

MOST_CACHED = 500
T = TypeVar("T")


@dataclass(frozen=True)
class _Inputs:
    """Current inputs, to detect stale results.

    Captures by name, the operator's labels, hashes of captures and of fresh calibrations, and
    {model: correction of scale}.
    """

    captures: Mapping[str, Capture]
    labels: Mapping[str, str]
    hashes: Mapping[str, str]
    factors: Mapping[str, float]


class SessionReader:
    """Reads one session repeatedly, and caches what is slow to read by its content hash."""

    def __init__(self, session: Session, planner: Planner) -> None:
        self.session = session
        self._planner = planner
        self._cache: dict[Any, Any] = {}
        self._lock = threading.Lock()
        self._thumbnails: dict[str, bytes] = {}
        self._unreadable: dict[tuple[str, str, str], str] = {}  # by name, content hash and target
        self._features: dict[tuple[str, str], PoseFeatures] = {}  # of poses that are not judged yet
        self._faults: list[str] = []  # what could not be read this time

    def add_thumbnail(self, capture: Capture, jpeg: bytes) -> None:
        """Store the thumbnail of a capture."""
        with self._lock:
            self._thumbnails[capture.hash] = jpeg

    def add_features(self, capture: Capture, target: str, observation: Observation) -> None:
        """Store the features of a pose whose frames are still being examined, for the plan of the
        next pose."""
        sigma = observation.samples.sigma if observation.samples else np.zeros(0)
        with self._lock:
            seen = observation.points, observation.camera, observation.projector
            self._features[capture.hash, target] = _make_features(*seen, sigma)

    def add_unreadable(self, capture: Capture, why: str) -> None:
        """Store why a pose cannot be evaluated, so that it is not tried again."""
        with self._lock:
            self._unreadable[capture.name, capture.hash, self.target()] = why

    def target(self) -> str:
        """Return the board's notation, empty where it is unknown or a board of a plugin that is not
        installed."""
        notation = find_target(self.session)
        return "" if explain_board(notation) else notation

    def patterns(self) -> str:
        """Return the name of the pattern sequence."""
        return str(self.session.valid_decision("patterns") or DEFAULT_PATTERNS)

    def has_thumbnail(self, capture: Capture) -> bool:
        """Whether a thumbnail of the capture is stored."""
        return capture.hash in self._thumbnails

    def needs_judging(self, capture: Capture, target: str) -> bool:
        """Whether this is a target pose whose features were not read with this target yet."""
        if (
            capture.role != "calibration"
            or not target
            or (capture.name, capture.hash, target) in self._unreadable
        ):
            return False
        return self._load_judgement(capture, target) is None

    def count_frames(self, rig: RigView) -> int | None:
        """Return the number of frames of the next pose; None where the projector's size is
        unknown."""
        if rig.projector is None:
            return None
        patterns, projector = self.patterns(), rig.projector
        shown = self._get_cached(
            ("frames", patterns, projector), lambda: len(PRESETS[patterns](projector).frames)
        )
        return int(shown) * max(1, len(self.exposures_ms()))

    def levels(self) -> tuple[int, ...] | None:
        """Return the table of grey levels that linearises the projector; None where it is not
        used."""
        return tuple(int(level) for level in self.session.valid_decision("levels") or ()) or None

    def exposures_ms(self) -> tuple[float, ...]:
        """Return the exposures of every capture, ms; empty: a single one, the camera's."""
        return tuple(float(exposure) for exposure in self.session.valid_decision("exposures") or ())

    def read(self, rig: RigView, focal_px: float | None) -> SessionView:
        """Read the session's current state; what is damaged is missing from it, and named in its
        `faults`.

        `rig` has the devices' sizes until there are poses, `focal_px` is its lens's nominal focal
        length.
        """
        session, target = self.session, self.target()
        sound, faults = session.read_captures()
        unknown = explain_board(find_target(session))
        self._faults = [*faults.values(), *session.decision_faults(), *filter(None, [unknown])]
        captures = {capture.name: capture for capture in sound}
        calibration = self._attempt(
            "the calibration", lambda: self._read_calibration(captures), None
        )
        scans = [capture.name for capture in sound if capture.role == "scan"]
        inputs = self._read_inputs(captures, scans, calibration.models if calibration else ())
        poses, plan, pending = self._read_poses(captures, target, calibration, rig, focal_px)
        records = self._read_records(inputs)
        of_scan = {name: [each for each in records if each.name == name] for name in scans}
        verdict = self._attempt("the verdict", lambda: load_last_verdict(session), None)
        judged = None if calibration is None else self._load_record("calibration/stereo").verdict
        return SessionView(
            folder=session.folder,
            target=target,
            patterns=self.patterns(),
            poses=poses,
            plan=plan,
            pending_plan=pending,
            wanted_mm=float(session.valid_decision("sigma_wanted_mm") or 0.0)
            or (plan.usual_mm if plan else 0.0),
            calibration=calibration,
            verdict=verdict,
            verdict_of_calibration=verdict is not None and verdict == judged,
            records=records,
            scans=tuple(self._read_scan(captures[name], of_scan[name], inputs) for name in scans),
            deleted_measurements=sum(
                name.startswith(f"{Measurement.kind}/") for name in session.deleted_results()
            ),
            nominals=list_nominals(session.folder),
            plans=list_plans(session.folder),
            exports=list_exports(session),
            exposures_ms=self.exposures_ms(),
            is_linear=self.levels() is not None,
            aligns_scans=bool(session.valid_decision("align_scans")),
            region=self._attempt(
                "the region", lambda: load_region(session, even_if_off=True), None
            ),
            region_is_on=bool((session.valid_decision("region") or {}).get("on")),
            deleted_poses=tuple(session.deleted_captures("calibration")),
            deleted_scans=tuple(session.deleted_captures("scan")),
            faults=tuple(dict.fromkeys(self._faults)),
        )

    def _read_inputs(
        self, captures: Mapping[str, Capture], scans: Sequence[str], models: Sequence[str]
    ) -> _Inputs:
        """Read the current inputs of results: captures, edits of scans, and calibrations of these
        models."""
        session = self.session
        cuts = self._attempt(
            "edits and region", lambda: restriction_inputs(session, scans), dict[str, str]()
        )
        hashes = cuts | {name: capture.hash for name, capture in captures.items()}
        for name in (f"calibration/{model}" for model in models):
            meta = self._load_meta(name)
            if not _has_changed(meta["inputs"], hashes):
                hashes[name] = meta["hash"]
        for name in self._list_results("scale/"):
            meta = self._load_meta(name)
            if not _has_changed(meta.get("inputs", {}), hashes):
                hashes[name] = meta["hash"]
        factors = {model: scale_factor(session, model) for model in models}
        return _Inputs(captures, session.valid_decision("names") or {}, hashes, factors)

    def _attempt(self, what: str, read: Callable[[], T], otherwise: T) -> T:
        """Return what `read()` returns, or `otherwise` where that fails, which is one of the
        session's faults then."""
        try:
            return read()
        except Exception as error:  # damaged files may make their reader fail in any way
            self._faults.append(describe_failure(f"Reading {what}", error))
            return otherwise

    # poses

    def _load_judgement(self, capture: Capture, target: str) -> dict[str, Any] | None:
        """Return the `meta` of a pose's result; None unless it was made from these frames and this
        board."""
        try:
            meta = self._find_meta(f"poses/{capture.name}")
        except DamagedError:  # the pose is evaluated again
            return None
        return (
            meta
            if meta
            and meta["inputs"].get(capture.name) == capture.hash
            and meta["target"] == target
            else None
        )

    def _read_poses(
        self,
        captures: Mapping[str, Capture],
        target: str,
        calibration: CalibrationView | None,
        rig: RigView,
        focal_px: float | None,
    ) -> tuple[tuple[PoseView, ...], PosePlan | None, PlanInput | None]:
        """Return (the poses, the plan after them, the input of the final plan where this one is
        interim)."""
        poses = [capture for capture in captures.values() if capture.role == "calibration"]
        judged = {pose.name: self._load_judgement(pose, target) for pose in poses}
        states = {
            pose.name: self._determine_pose_state(pose, target, judged[pose.name], calibration)
            for pose in poses
        }
        camera, projector = (
            (poses[0].size, poses[0].sequence.projector_size)
            if poses
            else (rig.camera, rig.projector)
        )
        plan = given = None
        is_final = True
        if target and camera is not None and projector is not None:
            usable = [pose for pose in poses if states[pose.name][0] not in ("excluded", "refused")]
            features = self._read_features(usable, target, judged)
            stereo = None if calibration is None or calibration.refused else calibration.stereo
            hashes = [(name, captures[name].hash) for name in features]
            if stereo is not None:
                hashes.append(("", self._load_meta("calibration/stereo")["hash"]))
            refused = sum(state == "refused" for state, _ in states.values())
            given = PlanInput(
                Board.parse(target),
                camera,
                projector,
                features,
                stereo,
                focal_px,
                refused,
                tuple(hashes),
            )
            plan, is_final = self._planner.look_up(given)
        views = tuple(
            self._view_pose(pose, *states[pose.name], target, plan, calibration) for pose in poses
        )
        return views, plan, None if is_final else given

    def _view_pose(
        self,
        pose: Capture,
        state: PoseState,
        why: str,
        target: str,
        plan: PosePlan | None,
        calibration: CalibrationView | None,
    ) -> PoseView:
        """Return the view of a target pose: its state, and where the board is by the plan."""
        T = plan.poses.get(pose.name) if plan else None
        return PoseView(
            name=pose.name,
            state=state,
            why=why,
            created=str(pose.meta.get("created", "")),
            T_camera_board=T,
            calibrated=state == "used",
            board_px=(
                None if plan is None or T is None else outline_px(Board.parse(target), plan.lens, T)
            ),
            rms_px=(
                calibration.stereo.pose_rms_px.get(pose.name)
                if calibration and state == "used"
                else None
            ),
            thumbnail=self._thumbnails.get(pose.hash, b""),
        )

    def _determine_pose_state(
        self,
        pose: Capture,
        target: str,
        meta: Mapping[str, Any] | None,
        calibration: CalibrationView | None,
    ) -> tuple[PoseState, str]:
        """Return the state of a target pose and the reason, which is empty where there is none."""
        excluded = self.session.valid_decision("excluded") or {}
        if pose.name in excluded:
            return "excluded", excluded[pose.name]
        if (pose.name, pose.hash, target) in self._unreadable:
            return "refused", self._unreadable[pose.name, pose.hash, target]
        if meta is None:
            return "judging", ""
        if meta["refused"]:
            return "refused", str(meta["refused"])
        if calibration is not None:
            if self._load_meta("calibration/stereo").get("inputs", {}).get(pose.name) == pose.hash:
                return "used", ""
            why = calibration.stereo.excluded.get(pose.name, "")
            # such a pose was included again since
            if why and not why.startswith("excluded by the operator"):
                return "unused", why
        return "good", ""

    def _read_features(
        self, poses: Sequence[Capture], target: str, judged: Mapping[str, Mapping[str, Any] | None]
    ) -> dict[str, PoseFeatures]:
        """Return the features of poses by name, those seen early until a pose is judged; poses
        without are missing."""
        features = {}
        for pose in poses:
            seen, meta = self._features.get((pose.hash, target)), judged[pose.name]
            if meta is not None:
                load = partial(self._load_features, pose.name, meta["hash"])
                seen = self._attempt(f"the features of {pose.name}", load, None)
            if seen is not None:
                features[pose.name] = seen
        return features

    def _load_features(self, name: str, content_hash: str) -> PoseFeatures:
        """Load the features of a pose and the median noise of its projector coordinates; cached by
        content hash."""

        def load() -> PoseFeatures:
            """Load the features from the pose's saved result."""
            names = ("points", "camera", "projector")
            try:
                arrays = self.session.load_result(f"poses/{name}", only=(*names, "samples_sigma"))[
                    1
                ]
            except InputError:  # saved before samples were
                arrays = self.session.load_result(f"poses/{name}", only=names)[1]
            return _make_features(
                **{each: arrays[each] for each in names},
                sigma=arrays.get("samples_sigma", np.zeros(0)),
            )

        return self._get_cached(("features", content_hash), load)  # type: ignore[no-any-return]

    # calibration

    def _read_calibration(self, captures: Mapping[str, Capture]) -> CalibrationView | None:
        """Read the session's calibration, and what makes it stale; None without a complete stereo
        model."""
        session = self.session
        models = available_models(session)
        if "stereo" not in models:
            return None
        hashes = {model: self._load_meta(f"calibration/{model}")["hash"] for model in models}
        made_of = ("stereo", hashes["stereo"], tuple(captures)[:1])
        stereo: StereoModel | None = self._get_cached(
            made_of, lambda: load_stereo_if_complete(session)
        )
        if stereo is None:
            return None
        fits = {model: self._load_fit(model) for model in models if model != "stereo"}
        foreign = (
            "it was saved by another version of slviewer: calibrate again"
            if None in fits.values()
            else ""
        )
        return CalibrationView(
            stereo=stereo,
            models=models,
            best=preferred_model(session),
            stale=foreign
            or self._describe_changes(self._load_meta("calibration/stereo")["inputs"], captures),
            pixelwise=fits.get("pixelwise"),
            recommended=recommended_model(session),
            chosen=str(decided) if (decided := session.valid_decision("model")) in models else "",
            rejected=rejection_reason(session),
            is_pinned=accepts_rejected(session),
            splined=fits.get("splined"),
            scales={model: words for model in models if (words := describe_scale(session, model))},
            missing="" if "splined" in models or not stereo.poses else missing_for_splined(session),
        )

    def _load_fit(self, model: str) -> Any:
        """Load the figures of a model's fit; None where another version saved a model that cannot
        be read."""
        record = self._load_record(f"calibration/{model}")

        def describe() -> Any:
            """Return the figures of the model itself: version 0.2 stored none."""
            with suppress(SessionError):
                return load_model(self.session, model).describe()
            return None

        hashed = self._load_meta(f"calibration/{model}")["hash"]
        return record.fit or self._get_cached(("fit", hashed), describe)

    def _describe_changes(self, inputs: Mapping[str, str], captures: Mapping[str, Capture]) -> str:
        """Describe which poses of a calibration were retaken, deleted or excluded since; empty
        where none was."""
        excluded = self.session.valid_decision("excluded") or {}
        gone = [n for n, used in inputs.items() if n not in captures or captures[n].hash != used]
        dropped = [n for n in inputs if n in excluded]
        for names, change in ((gone, "retaken or deleted"), (dropped, "excluded")):
            if names:
                verb = "was" if len(names) == 1 else "were"
                return f"{join_names(names, 3)} {verb} {change} since: calibrate again"
        return ""

    # verifications, scans, merges, measurements

    def _read_records(self, inputs: _Inputs) -> tuple[Stored[Any], ...]:
        """Read all records of existing captures, with whether they are stale."""
        known = dict(inputs.hashes)  # with those of fresh records, which others are made from

        def read(result: str) -> Stored[Any] | None:
            """Read one record by its result name; None where a capture of it is gone."""
            name, meta, record = (
                result.partition("/")[2],
                self._load_meta(result),
                self._load_record(result),
            )
            if not set(captures_of(name, record)) <= set(inputs.captures):
                return None
            stale = _has_changed(record.inputs, known) or _has_changed(
                record.scales, inputs.factors
            )
            if not stale:
                known[result] = meta["hash"]
            labels = self.session.valid_decision(record.labels) or {}
            return Stored(name, str(labels.get(name) or record.label(name)), record, stale)

        # which are made from merges
        kinds = sorted(RECORDS, key=lambda kind: kind == Measurement.kind)
        names = [name for kind in kinds for name in self._list_results(f"{kind}/")]
        records = [self._attempt(name, partial(read, name), None) for name in names]
        return tuple(record for record in records if record is not None)

    def _read_scan(
        self, capture: Capture, records: Sequence[Stored[Any]], inputs: _Inputs
    ) -> ScanView:
        """Return the view of a scan capture: its label, and the figures and staleness of its
        cloud."""
        found = next((each for each in records if isinstance(each.record, Reconstruction)), None)
        place = next((each for each in records if isinstance(each.record, Placement)), None)
        edits, undone = self._attempt(
            f"the edits of {capture.name}",
            partial(list_edits, self.session, capture.name),
            (tuple[str, ...](), 0),
        )
        return ScanView(
            name=capture.name,
            label=str(inputs.labels.get(capture.name, capture.name)),
            purpose=capture.meta.get("settings", {}).get("purpose", "scan"),
            created=str(capture.meta.get("created", "")),
            cloud="absent" if found is None else "stale" if found.stale else "fresh",
            figures=Reconstruction() if found is None else found.record,
            thumbnail=self._thumbnails.get(capture.hash, b""),
            placement=place.record if place is not None and not place.stale else None,
            turn_step=capture.turn_step,
            edits=edits,
            undone_edits=undone,
        )

    # files

    def _list_results(self, prefix: str) -> list[str]:
        """List the names of the results with a prefix, in natural order."""
        return sorted(
            (n for n in self.session.result_names() if n.startswith(prefix)), key=natural_key
        )

    def _find_meta(self, name: str) -> dict[str, Any]:
        """Return the `meta` of a result, empty where there is none."""
        return self._load_meta(name) if self.session.has_result(name) else {}

    def _load_record(self, result: str) -> Any:
        """Load a record by its result name; cached by content hash."""
        kind, meta = RECORDS[result.partition("/")[0]], self._load_meta(result)
        return self._get_cached(("record", meta["hash"]), lambda: read_record(kind, meta))

    def _load_meta(self, result: str) -> dict[str, Any]:
        """Load the `meta` of a result, without its arrays."""
        return self.session.load_result(result, only=())[0]

    def _get_cached(self, key: Any, make: Callable[[], Any]) -> Any:
        """Return the cached value of a key, computed by `make()` where missing; a full cache is
        cleared."""
        if key not in self._cache:
            if len(self._cache) > MOST_CACHED:
                self._cache.clear()
            self._cache[key] = make()
        return self._cache[key]


def _make_features(
    points: np.ndarray, camera: np.ndarray, projector: np.ndarray, sigma: np.ndarray
) -> PoseFeatures:
    """Return features (n, 3) mm, (n, 2) and (n, 2) px, with the median of their samples' standard
    deviations, px."""
    known = sigma[np.isfinite(sigma)]
    return PoseFeatures(
        points, camera, projector, float(np.median(known)) if known.size else np.nan
    )


def _has_changed(used: Mapping[str, object], now: Mapping[str, object]) -> bool:
    """Whether any name of `used` is missing from `now` or has another value there."""
    return any(now.get(name) != value for name, value in used.items())
