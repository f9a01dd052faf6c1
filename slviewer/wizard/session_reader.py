"""Reads what a session's files contain, for the panels, and what a list of sessions shows of each.
Descriptions of captures and results that did not change are not read again
(`session.reading.identify`); features of poses are kept."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import numpy as np

from slviewer.calibration.next_pose import count_cells, outline_px
from slviewer.calibration.observe import Observation
from slviewer.calibration.pixelwise import POSES_FOR_PIXELWISE
from slviewer.errors import DamagedError, SessionError, SlviewerError
from slviewer.fringe.image_area import AREA, ImageArea
from slviewer.fringe.presets import PRESETS
from slviewer.geometry.vectors import finite_rows
from slviewer.pipeline.capture import DEFAULT_PATTERNS
from slviewer.pipeline.cloud_corrections import describe_scale
from slviewer.pipeline.models import (
    accepts_rejected,
    available_models,
    explain_board,
    find_target,
    load_last_verdict,
    load_model,
    load_reprojection,
    load_stereo_if_complete,
    load_stereo_verdict,
    preferred_model,
    recommended_model,
    rejection_reason,
)
from slviewer.pipeline.operation import Stored, captures_of, load_record, load_stored
from slviewer.records.calibration import ModelCalibration
from slviewer.records.kinds import all_kinds
from slviewer.records.measurement import Measurement
from slviewer.records.merge import Placement, Reconstruction
from slviewer.records.record import format_count, format_counts
from slviewer.records.verdict import Level
from slviewer.session.capture import Capture, Role, read_capture
from slviewer.session.inspection_plan import list_plans
from slviewer.session.names import join_names
from slviewer.session.nominal import NOMINALS
from slviewer.session.scan_edits import list_edits, load_region
from slviewer.session.store import Session
from slviewer.target.board import Board
from slviewer.wizard.jobs import describe_failure
from slviewer.wizard.pose_plan import PlanInput, Planner, PoseFeatures, PosePlan
from slviewer.wizard.result_views import make_thumbnail
from slviewer.wizard.snapshot import (
    CalibrationView,
    ExportView,
    PoseState,
    PoseView,
    RigView,
    ScanView,
    SessionView,
)

P = ParamSpec("P")
T = TypeVar("T")


class SessionReader:
    """Reads one session repeatedly."""

    def __init__(self, session: Session, planner: Planner) -> None:
        self.session = session
        self.thumbnails: dict[str, bytes] = {}  # by the content hash of a capture
        self._planner = planner
        # why poses cannot be evaluated, by name, content hash and target
        self.unreadable: dict[tuple[str, str, str], str] = {}
        # by content hash and target, also of poses that are not judged yet
        self._features: dict[tuple[str, str], PoseFeatures] = {}
        self._faults: list[str] = []  # what could not be read this time
        self._captures: dict[str, Capture] = {}  # that can be read, this time

    def add_features(self, capture: Capture, target: str, observation: Observation) -> None:
        """Store the features of a pose whose frames are still being examined, for the plan of the
        next pose."""
        sigma = observation.samples.sigma if observation.samples else np.zeros(0)
        seen = observation.points, observation.camera, observation.projector
        self._features[capture.hash, target] = _make_features(*seen, sigma, observation.area)

    def target(self) -> str:
        """Return the board's notation, empty where it is unknown or a board of a plugin that is not
        installed."""
        notation = find_target(self.session)
        return "" if explain_board(notation) else notation

    def patterns(self) -> str:
        """Return the name of the pattern sequence."""
        return str(self.session.valid_decision("patterns") or DEFAULT_PATTERNS)

    def needs_judging(self, capture: Capture, target: str) -> bool:
        """Whether this is a target pose whose features were not read with this target yet."""
        return (
            capture.role == "calibration"
            and bool(target)
            and (capture.name, capture.hash, target) not in self.unreadable
            and self._load_judgement(capture, target) is None
        )

    def count_frames(self, rig: RigView) -> int | None:
        """Return the number of frames of the next pose; None where the projector's size is
        unknown."""
        if rig.projector is None:
            return None
        return PRESETS[self.patterns()](rig.projector).count_images(self.exposures_ms())

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
        length. To be called by one thread.
        """
        session, target = self.session, self.target()
        sound, faults = session.read_captures()
        unknown = explain_board(find_target(session))
        self._faults = [*faults.values(), *session.decision_faults(), *filter(None, [unknown])]
        self._captures = {capture.name: capture for capture in sound}
        calibration = self._attempt("the calibration", self._read_calibration)
        scans = [capture for capture in sound if capture.role == "scan"]
        poses, plan, pending = self._read_poses(target, calibration, rig, focal_px)
        records = tuple(self._read_records())
        labels = session.valid_decision("names") or {}
        verdict = self._attempt("the verdict", load_last_verdict, session)
        judged = calibration and load_stereo_verdict(session)
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
            scans=tuple(self._read_scan(scan, records, labels) for scan in scans),
            deleted_measurements=sum(
                name.startswith(f"{Measurement.kind}/") for name in session.deleted_results()
            ),
            nominals=tuple(sorted(each.name for each in (session.folder / NOMINALS).glob("[!.]*"))),
            plans=list_plans(session.folder),
            exports=tuple(
                ExportView(each.name, each, each.stat().st_size)
                for each in sorted((session.folder / "exports").glob("[!.]*"))
                if each.is_file()
            ),
            exposures_ms=self.exposures_ms(),
            is_linear=self.levels() is not None,
            aligns_scans=bool(session.valid_decision("align_scans")),
            region=self._attempt("the region", load_region, session, even_if_off=True),
            region_is_on=bool((session.valid_decision("region") or {}).get("on")),
            report_details=session.report_details(),
            deleted_poses=_list_deleted(session, "calibration"),
            deleted_scans=_list_deleted(session, "scan"),
            faults=tuple(dict.fromkeys(self._faults)),
        )

    def _attempt(
        self, what: str, read: Callable[P, T], *args: P.args, **options: P.kwargs
    ) -> T | None:
        """Return what `read` returns, or None where it fails, which is one of the session's faults
        then."""
        try:
            return read(*args, **options)
        except Exception as error:  # damaged files may make their reader fail in any way
            self._faults.append(describe_failure(f"Reading {what}", error))
            return None

    # poses

    def _load_judgement(self, capture: Capture, target: str) -> dict[str, Any] | None:
        """Return the `meta` of a pose's result; None unless it was made from these frames and this
        board."""
        result = f"poses/{capture.name}"
        with suppress(DamagedError):  # the pose is evaluated again
            if self.session.has_result(result):
                meta = self.session.load_meta(result)
                made_of = meta["inputs"].get(capture.name), meta.get("target")
                return meta if made_of == (capture.hash, target) else None
        return None

    def _read_poses(
        self, target: str, calibration: CalibrationView | None, rig: RigView, focal_px: float | None
    ) -> tuple[tuple[PoseView, ...], PosePlan | None, PlanInput | None]:
        """Return (the poses, the plan after them, the input of the final plan where this one is
        interim)."""
        captures = [each for each in self._captures.values() if each.role == "calibration"]
        judged = [(pose, *self._judge(pose, target, calibration)) for pose in captures]
        features = {pose.name: seen for pose, _, _, seen in judged if seen}
        refused = sum(state == "refused" for _, state, _, _ in judged)
        given = self._plan_input(target, calibration, rig, focal_px, features, refused)
        plan, is_final = self._planner.look_up(given) if given else (None, True)
        if any(pose.is_of_pair for pose in captures):
            plan = _cover_second(plan, given)
        poses = plan.poses if plan else {}
        used_px = calibration.reprojection.pose_rms_px if calibration else {}
        views = tuple(
            PoseView(
                name=pose.name,
                state=state,
                why=why,
                T_camera_board=(T := poses.get(pose.name)),
                board_px=outline_px(given.board, plan.lens, T)
                if given and plan and T is not None
                else None,
                rms_px=used_px.get(pose.name) if state == "used" else None,
                thumbnail=self.thumbnails.get(pose.hash, b""),
            )
            for pose, state, why, _ in judged
        )
        return views, plan, None if is_final else given

    def _plan_input(
        self,
        target: str,
        calibration: CalibrationView | None,
        rig: RigView,
        focal_px: float | None,
        features: Mapping[str, PoseFeatures],
        refused: int,
    ) -> PlanInput | None:
        """Return what the next pose is planned from; None before target and sizes are known."""
        camera, projector = rig.camera, rig.projector
        for first in [each for each in self._captures.values() if each.role == "calibration"][:1]:
            camera, projector = first.size, first.other_size
        if not target or camera is None or projector is None:
            return None
        stereo = None if calibration is None or calibration.refused else calibration.stereo
        hashes = [(name, self._captures[name].hash) for name in features]
        if stereo:
            hashes.append(("", self.session.load_meta("calibration/stereo")["hash"]))
        return PlanInput(
            Board.parse(target), camera, projector, features, stereo, focal_px, refused,
            tuple(hashes),
        )  # fmt: skip

    def _judge(
        self, pose: Capture, target: str, calibration: CalibrationView | None
    ) -> tuple[PoseState, str, PoseFeatures | None]:
        """Return the state of a target pose, the reason, which is empty where there is none, and
        the features of one that counts, early ones until it is judged."""
        excluded = self.session.valid_decision("excluded") or {}
        if pose.name in excluded:
            return "excluded", excluded[pose.name], None
        if why := self.unreadable.get((pose.name, pose.hash, target)):
            return "refused", why, None
        meta = self._load_judgement(pose, target)
        if meta is None:
            return "judging", "", self._features.get((pose.hash, target))
        if meta["refused"]:
            return "refused", str(meta["refused"]), None
        features = self._attempt(
            f"the features of {pose.name}", self._load_features, pose, target, meta
        )
        if calibration:
            made_from = self.session.load_meta("calibration/stereo").get("inputs", {})
            if made_from.get(pose.name) == pose.hash:
                return "used", "", features
            why = calibration.stereo.excluded.get(pose.name, "")
            # such a pose was included again since
            if why and not why.startswith("excluded by the operator"):
                return "unused", why, features
        return "good", "", features

    def _load_features(self, pose: Capture, target: str, meta: Mapping[str, Any]) -> PoseFeatures:
        """Load the features of a pose and the median noise of its projector coordinates, unless
        they are known."""
        key = pose.hash, target
        if key not in self._features:
            # older versions saved no samples
            wanted = {"points", "camera", "projector", "samples_sigma"}
            names = {each for each in meta["arrays"] if each in wanted or each.startswith(AREA)}
            arrays = self.session.load_result(f"poses/{pose.name}", only=names)[1]
            sigma = arrays.get("samples_sigma", np.zeros(0))
            area = ImageArea.from_arrays(arrays)
            seen = {each: arrays[each] for each in ("points", "camera", "projector")}
            self._features[key] = _make_features(**seen, sigma=sigma, area=area)
        return self._features[key]

    # calibration

    def _read_calibration(self) -> CalibrationView | None:
        """Read the session's calibration, and what makes it stale; None without a complete stereo
        model."""
        session = self.session
        models = available_models(session)
        if "stereo" not in models:
            return None
        meta = self.session.load_meta("calibration/stereo")
        stereo = load_stereo_if_complete(session)
        if stereo is None:
            return None
        fits = {model: self._load_fit(model) for model in models if model != "stereo"}
        foreign = (
            "it was saved by another version of slviewer: calibrate again"
            if None in fits.values()
            else ""
        )
        chosen, best = session.valid_decision("model"), preferred_model(session)
        return CalibrationView(
            stereo=stereo,
            reprojection=load_reprojection(session, stereo, best),
            models=models,
            best=best,
            stale=foreign or self._describe_changes(meta["inputs"]),
            pixelwise=fits.get("pixelwise"),
            recommended=recommended_model(session),
            chosen=str(chosen) if chosen in models else "",
            rejected=rejection_reason(session),
            is_pinned=accepts_rejected(session),
            splined=fits.get("splined"),
            scales={model: words for model in models if (words := describe_scale(session, model))},
            missing="" if "splined" in models or not stereo.poses else missing_for_splined(session),
        )

    def _load_fit(self, model: str) -> Any:
        """Load the figures of a model's fit; None where another version saved a model that cannot
        be read."""
        if fit := load_record(self.session, ModelCalibration, model).fit:
            return fit
        with suppress(SessionError):  # version 0.2 stored none
            return load_model(self.session, model).describe()
        return None

    def _describe_changes(self, inputs: Mapping[str, str]) -> str:
        """Describe which poses of a calibration were retaken, deleted or excluded since; empty
        where none was."""
        excluded, captures = self.session.valid_decision("excluded") or {}, self._captures
        gone = [n for n, used in inputs.items() if n not in captures or captures[n].hash != used]
        dropped = [n for n in inputs if n in excluded]
        for names, change in ((gone, "retaken or deleted"), (dropped, "excluded")):
            if names:
                verb = "was" if len(names) == 1 else "were"
                return f"{join_names(names, 3)} {verb} {change} since: calibrate again"
        return ""

    # verifications, scans, merges, measurements

    def _read_records(self) -> Iterator[Stored[Any]]:
        """Read all records of existing captures, with whether they are stale."""
        for result in self.session.result_names():
            kind, _, name = result.partition("/")
            if kind in all_kinds():
                stored = self._attempt(result, load_stored, self.session, all_kinds()[kind], name)
                if stored and self._captures.keys() >= set(captures_of(name, stored.record)):
                    yield stored

    def _read_scan(
        self, capture: Capture, records: Sequence[Stored[Any]], labels: Mapping[str, str]
    ) -> ScanView:
        """Return the view of a scan capture: its label, and the figures and staleness of its
        cloud."""
        own = {type(each.record): each for each in records if each.name == capture.name}
        found, place = own.get(Reconstruction), own.get(Placement)
        edits, undone = self._attempt(
            f"the edits of {capture.name}", list_edits, self.session, capture.name
        ) or ((), 0)
        return ScanView(
            name=capture.name,
            label=str(labels.get(capture.name, capture.name)),
            purpose=capture.purpose,
            created=str(capture.meta.get("created", "")),
            cloud="absent" if found is None else "stale" if found.stale else "fresh",
            figures=Reconstruction() if found is None else found.record,
            thumbnail=self.thumbnails.get(capture.hash, b""),
            placement=place.record if place and not place.stale else None,
            turn_step=capture.turn_step,
            edits=edits,
            undone_edits=undone,
        )


def _make_features(
    points: np.ndarray,
    camera: np.ndarray,
    projector: np.ndarray,
    sigma: np.ndarray,
    area: ImageArea | None,
) -> PoseFeatures:
    """Return features (n, 3) mm, (n, 2) and (n, 2) px, with the median of their samples' standard
    deviations, px, and the ``area`` of the camera's image."""
    known = sigma[np.isfinite(sigma)]
    noise_px = float(np.median(known)) if known.size else np.nan
    return PoseFeatures(points, camera, projector, noise_px, area)


def _cover_second(plan: PosePlan | None, given: PlanInput | None) -> PosePlan | None:
    """Return a plan with what the poses cover of a second camera's image."""
    if plan is None or given is None:
        return plan
    seen = [each.projector[finite_rows(each.projector)] for each in given.features.values()]
    cells = count_cells(seen, given.projector)
    return replace(plan, coverage=replace(plan.coverage, second=cells))


def _list_deleted(session: Session, role: Role) -> tuple[str, ...]:
    """Return the names of the captures of a role that can be restored, the last deleted first."""
    used, names = session.taken_names(), list[str]()
    for each in session.trashed():
        if each.is_capture and each.name not in (*used, *names):
            with suppress(DamagedError):
                if read_capture(each.place).role == role:
                    names.append(each.name)
    return tuple(names)


def missing_for_splined(session: Session) -> str:
    """Describe what the poses lack for the splined model; empty where they allow it."""
    excluded = session.excluded()
    poses = [capture for capture in session.captures("calibration") if capture.name not in excluded]
    both = sum(len(capture.sequence.axes) == 2 for capture in poses)
    if both >= POSES_FOR_PIXELWISE:
        return ""
    needed = f"it needs {POSES_FOR_PIXELWISE} target poses with patterns along both axes"
    if len(poses) < POSES_FOR_PIXELWISE:
        return f"{needed}, and there are {both}: capture more"
    return (
        f"{needed}, and only {both} of {len(poses)} have them: choose patterns of both axes, and"
        " capture more"
    )


@dataclass(frozen=True)
class SessionOverview:
    """A session: when it was changed last, what it `holds` in words, the verdict on its
    calibration, None where there is none, and a JPEG of its first scan, else pose.

    `fault`: why it cannot be read, empty where it can.
    """

    folder: Path
    changed: datetime
    holds: str = ""
    is_calibrated: bool = False
    verdict: Level | None = None
    thumbnail: bytes = b""
    fault: str = ""


def read_overview(folder: Path) -> SessionOverview:
    """Read what a list shows of a session; a damaged one has a fault."""
    parts = [folder / name for name in ("session.json", "decisions.json", "captures", "results")]
    times = [part.stat().st_mtime for part in parts if part.exists()]
    changed = datetime.fromtimestamp(max(times, default=0.0)).astimezone()
    try:
        with Session.open(folder) as session:
            return _read(session, changed)
    except SlviewerError as error:
        return SessionOverview(folder, changed, fault=str(error))


def _read(session: Session, changed: datetime) -> SessionOverview:
    """Read the overview of an open session."""
    captures = session.captures()
    holds = format_counts(each.purpose for each in captures)
    if n := sum(name.startswith(f"{Measurement.kind}/") for name in session.result_names()):
        holds += f", {format_count(n, 'measurement')}"
    verdict, is_calibrated = None, "stereo" in available_models(session)
    with suppress(SlviewerError):
        verdict = load_last_verdict(session)
    picture = b""
    with_frames = [each for each in captures if not each.is_imported_cloud]
    for capture in sorted(with_frames, key=lambda each: each.purpose == "scan", reverse=True):
        with suppress(SlviewerError):
            picture = make_thumbnail(capture)
            break
    level = verdict.level if verdict else None
    return SessionOverview(session.folder, changed, holds, is_calibrated, level, picture)
