"""What a session's files say, as the panels see it. Nothing is remembered but what would be read again the same."""

import threading
from collections.abc import Callable, Mapping
from functools import partial
from itertools import combinations
from typing import Any

import numpy as np

from slviewer.calibration.diagnosis.verdict import Verdict
from slviewer.calibration.next_pose import outline_px
from slviewer.calibration.pixelwise import PixelwiseModel
from slviewer.calibration.splined.model import SplinedModel
from slviewer.calibration.stereo import StereoModel
from slviewer.errors import InputError, SessionError
from slviewer.fringe.presets import PRESETS
from slviewer.pipeline.calibration_verdict import last_verdict
from slviewer.pipeline.capture import PATTERNS
from slviewer.pipeline.models import (
    available,
    insisted,
    load_model,
    load_stereo_if_complete,
    preferred,
    recommended,
    rejection,
    validation,
)
from slviewer.pipeline.scale import scale_factor, told_scale
from slviewer.session.capture import Capture
from slviewer.session.measurements import FOLDER as MEASUREMENTS
from slviewer.session.names import natural_key
from slviewer.session.store import Session
from slviewer.target.board import Board
from slviewer.wizard.export_files import listed
from slviewer.wizard.planner import Planner, PlanRequest
from slviewer.wizard.pose_plan import PoseFeatures, PosePlan, plan, plan_at_hand, takes_time
from slviewer.wizard.snapshot import (
    CalibrationView,
    CentreDistance,
    ComparisonView,
    Foreseen,
    MergeView,
    ModelFigures,
    PoseState,
    PoseView,
    RigView,
    ScanView,
    SessionView,
    SplinedView,
    VerificationRow,
)
from slviewer.wizard.stored_views import merge_view, read_measurements
from slviewer.wizard.surfaces import nominals
from slviewer.wizard.tasks import lacking_for_splined


class SessionReader:
    """Reads one session again and again, and keeps what is dear to read under its content hash."""

    def __init__(self, session: Session, planner: Planner) -> None:
        self.session = session
        self._planner = planner
        self._kept: dict[Any, Any] = {}
        self._lock = threading.Lock()
        self._thumbnails: dict[str, bytes] = {}
        self._unreadable: dict[tuple[str, str], str] = {}

    def add_thumbnail(self, capture: Capture, jpeg: bytes) -> None:
        """A small picture that was made of a capture."""
        with self._lock:
            self._thumbnails[capture.hash] = jpeg

    def add_unreadable(self, capture: Capture, why: str) -> None:
        """A pose whose judging failed, and why: it would fail again, and the session keeps no answer."""
        with self._lock:
            self._unreadable[capture.hash, self.target()] = why

    def target(self) -> str:
        """The board's notation: as decided, else that of the calibration or of the poses; empty where none says."""
        decided = self.session.decision("target")
        if decided:
            return str(decided)
        stereo = load_stereo_if_complete(self.session)
        if stereo is not None and stereo.board:
            return stereo.board
        return next((str(c.meta["board"]) for c in self.session.captures("calibration") if c.meta.get("board")), "")

    def patterns(self) -> str:
        """The name of the pattern sequence."""
        return str(self.session.decision("patterns") or PATTERNS)

    def has_thumbnail(self, capture: Capture) -> bool:
        """Whether a small picture was made of it."""
        return capture.hash in self._thumbnails

    def lacks_judgement(self, capture: Capture, target: str) -> bool:
        """Whether this is a pose that nobody has tried to read with this target."""
        if capture.role != "calibration" or not target or (capture.hash, target) in self._unreadable:
            return False
        return self._judged(capture, target) is None

    def frames_of_a_pose(self, rig: RigView) -> int | None:
        """How many frames the next pose will have; None where no rig says."""
        if rig.projector is None:
            return None
        patterns, projector = self.patterns(), rig.projector
        shown = self._keep(("frames", patterns, projector), lambda: len(PRESETS[patterns](projector).frames))
        return shown * max(1, len(self.exposures_ms()))

    def levels(self) -> tuple[int, ...] | None:
        """The table of grey levels that makes the projector's light proportional, where the operator wants it."""
        decided = self.session.decision("levels")
        return tuple(int(level) for level in decided) if decided else None

    def exposures_ms(self) -> tuple[float, ...]:
        """The exposures of every capture; empty: a single one, the camera's."""
        return tuple(float(exposure) for exposure in self.session.decision("exposures") or ())

    def sigma_wanted_mm(self) -> float | None:
        """The 3D sigma that poses are to reach, where the operator says so."""
        decided = self.session.decision("sigma_wanted_mm")
        return float(decided) if decided else None

    def read(self, rig: RigView, focal_px: float | None) -> SessionView:
        """The session now. `rig` tells sizes before there are poses; `focal_px` is its lens's nominal focal length."""
        session, target = self.session, self.target()
        captures = {capture.name: capture for capture in session.captures()}
        stereo, calibration = self._calibration(captures)
        labels = session.decision("names") or {}
        hashes = {name: capture.hash for name, capture in captures.items()}
        if calibration is not None:
            for model in calibration.models:
                name = f"calibration/{model}"
                if self._fresh(name, hashes):
                    hashes[name] = self._meta(name)["hash"]
        poses, planned, planning = self._poses(captures, target, stereo, calibration, rig, focal_px)
        factors = {model: scale_factor(session, model) for model in calibration.models} if calibration else {}
        rows, distances = self._verifications(captures, labels, hashes, factors)
        verdict = last_verdict(session)
        merges = [name for name in self._results("merge/") if set(self._meta(name)["scans"]) <= set(captures)]
        return SessionView(
            folder=session.folder,
            target=target,
            patterns=self.patterns(),
            poses=poses,
            lens=None if planned is None else planned.lens,
            coverage=None if planned is None else planned.coverage,
            suggestion=None if planned is None else planned.suggestion,
            foreseen=None if planned is None else self._foreseen(planned),
            planning=planning,
            calibration=calibration,
            verdict=verdict,
            verdict_of_calibration=self._is_of_calibration(verdict, stereo),
            verifications=rows,
            distances=distances,
            scans=tuple(self._scan(c, labels, hashes, factors) for c in captures.values() if c.role == "scan"),
            merge=self._merge(merges[-1], hashes, factors) if merges else None,
            merges=len(merges),
            measurements=read_measurements(session, hashes, factors),
            deleted_measurements=sum(name.startswith(f"{MEASUREMENTS}-") for name in session.deleted_results()),
            nominals=nominals(session.folder),
            exports=listed(session),
            exposures_ms=self.exposures_ms(),
            linear=self.levels() is not None,
            deleted_poses=tuple(session.deleted_captures("calibration")),
            deleted_scans=tuple(session.deleted_captures("scan")),
        )

    # poses

    def _judged(self, capture: Capture, target: str) -> dict[str, Any] | None:
        """The `meta` of what the session knows of a pose, if it is of these frames and this board."""
        if not self.session.has_result(f"poses/{capture.name}"):
            return None
        meta = self._meta(f"poses/{capture.name}")
        return meta if meta["inputs"].get(capture.name) == capture.hash and meta["target"] == target else None

    def _poses(
        self,
        captures: Mapping[str, Capture],
        target: str,
        stereo: StereoModel | None,
        calibration: CalibrationView | None,
        rig: RigView,
        focal_px: float | None,
    ) -> tuple[tuple[PoseView, ...], PosePlan | None, bool]:
        """(the poses, the plan after them, whether it is still being thought of)."""
        excluded = self.session.excluded()
        used = self._meta("calibration/stereo").get("inputs", {}) if stereo is not None else {}
        features: dict[str, PoseFeatures] = {}
        states: dict[str, tuple[PoseState, str]] = {}
        for name, capture in captures.items():
            if capture.role != "calibration":
                continue
            meta = self._judged(capture, target) if target else None
            if meta is not None and not meta["refused"]:
                features[name] = self._features(name, meta["hash"])
            states[name] = self._state(capture, target, meta, excluded, used, calibration)
        if not target:
            return self._views(captures, states, {}, None, calibration, ""), None, False
        first = next((c for c in captures.values() if c.role == "calibration"), None)
        camera, projector = (first.size, first.sequence.projector_size) if first else (rig.camera, rig.projector)
        planned, planning = None, False
        if camera is not None and projector is not None:
            counted = {name: f for name, f in features.items() if states[name][0] not in ("excluded", "refused")}
            refused = sum(state == "refused" for state, _ in states.values())
            trusted = None if calibration is not None and calibration.refused else stereo
            model = self._meta("calibration/stereo")["hash"] if trusted is not None else ""
            poses = tuple((name, captures[name].hash) for name in counted)
            board = Board.parse(target)
            asked = PlanRequest(target, camera, projector, poses, model, focal_px, refused)
            known = board, camera, projector, counted, trusted, focal_px, refused
            if takes_time(counted, trusted, camera):
                at_hand = partial(plan_at_hand, *known)
                planned, planning = self._planner.plan(asked, at_hand, partial(plan, *known))
            else:
                planned = self._keep(asked, partial(plan, *known))
        return self._views(captures, states, features, planned, calibration, target), planned, planning

    def _foreseen(self, planned: PosePlan) -> Foreseen:
        decided = self.sigma_wanted_mm()
        wanted = planned.usual_mm if decided is None else decided
        return Foreseen(planned.sigma_mm, planned.sigma_next_mm, wanted, planned.reaches(wanted))

    def _state(
        self,
        capture: Capture,
        target: str,
        meta: Mapping[str, Any] | None,
        excluded: Mapping[str, str],
        used: Mapping[str, str],
        calibration: CalibrationView | None,
    ) -> tuple[PoseState, str]:
        if capture.name in excluded:
            return "excluded", excluded[capture.name]
        if (capture.hash, target) in self._unreadable:
            return "refused", self._unreadable[capture.hash, target]
        if meta is None:
            return "judging", ""
        if meta["refused"]:
            return "refused", str(meta["refused"])
        if used.get(capture.name) == capture.hash:
            return "used", ""
        if calibration is not None and capture.name in calibration.left_out:
            why = calibration.left_out[capture.name]
            if not why.startswith("excluded by the operator"):  # it was included again since
                return "left out", why
        return "good", ""

    def _views(
        self,
        captures: Mapping[str, Capture],
        states: Mapping[str, tuple[PoseState, str]],
        features: Mapping[str, PoseFeatures],
        planned: PosePlan | None,
        calibration: CalibrationView | None,
        target: str,
    ) -> tuple[PoseView, ...]:
        views = []
        for name, (state, why) in states.items():
            T = None if planned is None else planned.poses.get(name)
            board_px = None
            if planned is not None and T is not None:
                board_px = outline_px(Board.parse(target), planned.lens, T)
            views.append(
                PoseView(
                    name=name,
                    state=state,
                    why=why,
                    created=str(captures[name].meta.get("created", "")),
                    T_camera_board=T,
                    calibrated=state == "used",
                    board_px=board_px,
                    rms_px=calibration.pose_rms_px.get(name) if calibration and state == "used" else None,
                    thumbnail=self._thumbnails.get(captures[name].hash, b""),
                )
            )
        return tuple(views)

    def _features(self, name: str, content_hash: str) -> PoseFeatures:
        def load() -> PoseFeatures:
            said = ("points", "camera", "projector")
            try:
                arrays = self.session.load_result(f"poses/{name}", only=(*said, "samples_sigma"))[1]
            except InputError:  # read before samples were kept
                arrays = self.session.load_result(f"poses/{name}", only=said)[1]
            sigma = arrays.pop("samples_sigma", np.zeros(0))
            known = sigma[np.isfinite(sigma)]
            return PoseFeatures(**arrays, noise_px=float(np.median(known)) if known.size else np.nan)

        return self._keep(("features", content_hash), load)

    # calibration

    def _calibration(self, captures: Mapping[str, Capture]) -> tuple[StereoModel | None, CalibrationView | None]:
        session = self.session
        models = available(session)
        if "stereo" not in models:
            return None, None
        meta = self._meta("calibration/stereo")
        made_of = ("stereo", meta["hash"], tuple(captures)[:1])
        stereo: StereoModel | None = self._keep(made_of, lambda: load_stereo_if_complete(session))
        if stereo is None:
            return None, None
        fit_rms: dict[str, Mapping[str, float]] = {}
        if "pixelwise" in models:
            key = ("pixelwise", self._meta("calibration/pixelwise")["hash"])
            fit_rms = self._keep(key, lambda: _fit_rms(session))
        splined = None
        if "splined" in models:
            splined = self._keep(("splined", self._meta("calibration/splined")["hash"]), lambda: _splined(session))
        foreign = ""
        if ("pixelwise" in models and not fit_rms) or ("splined" in models and splined is None):
            foreign = "it was saved by another version of slviewer: calibrate again"
        rig = stereo.rig
        return stereo, CalibrationView(
            models=models,
            best=preferred(session),
            stale=foreign or self._stale(meta["inputs"], captures),
            target=stereo.board,
            poses=tuple(stereo.poses),
            left_out=stereo.left_out,
            reprojection_px=stereo.reprojection_rms_px,
            pose_rms_px=stereo.pose_rms_px,
            depth_range_mm=stereo.depth_range_mm,
            baseline_mm=stereo.baseline_mm,
            K_camera=rig.camera.K,
            D_camera=rig.camera.D,
            K_projector=rig.projector.K,
            D_projector=rig.projector.D,
            R=rig.R,
            t=rig.t,
            focal_sigma_px=stereo.focal_sigma_px,
            fit_rms_mm=fit_rms,
            recommended=recommended(session),
            chosen=str(decided) if (decided := session.decision("model")) in models else "",
            rejected=rejection(session),
            insisted=insisted(session),
            features_set_aside=stereo.features_set_aside,
            splined=splined,
            comparison=_comparison(session),
            scales={model: words for model in models if (words := told_scale(session, model))},
            lacks="" if "splined" in models or not stereo.poses else lacking_for_splined(session),
        )

    def _is_of_calibration(self, verdict: Verdict | None, stereo: StereoModel | None) -> bool:
        if verdict is None or stereo is None:
            return False
        judged = self._meta("calibration/stereo").get("verdict")
        return bool(judged == verdict.to_json())

    def _stale(self, inputs: Mapping[str, str], captures: Mapping[str, Capture]) -> str:
        excluded = self.session.excluded()
        gone = [n for n, used in inputs.items() if n not in captures or captures[n].hash != used]
        left = [n for n in inputs if n in excluded]
        if gone:
            return f"{_listed(gone)} {'was' if len(gone) == 1 else 'were'} retaken or deleted since: calibrate again"
        if left:
            return f"{_listed(left)} {'was' if len(left) == 1 else 'were'} excluded since: calibrate again"
        return ""

    # verifications, scans, merges

    def _verifications(
        self,
        captures: Mapping[str, Capture],
        labels: Mapping[str, str],
        hashes: Mapping[str, str],
        factors: Mapping[str, float],
    ) -> tuple[tuple[VerificationRow, ...], tuple[CentreDistance, ...]]:
        rows, centres = [], {}
        for result in self._results("verify/"):
            name, meta = result.removeprefix("verify/"), self._meta(result)
            if name not in captures:
                continue
            stale = not self._fresh(result, hashes, factors)
            for model, figures in meta["models"].items():
                rows.append(
                    VerificationRow(
                        capture=name,
                        label=str(labels.get(name, name)),
                        shape=meta["shape"],
                        model=model,
                        incidence=meta["incidence"],
                        stale=stale,
                        masked=meta.get("masked", {}).get(model),
                        **figures,
                    )
                )
            if not stale:
                centres.update({(name, model): np.array(c) for model, c in meta["centres_mm"].items()})
        distances = [
            CentreDistance((a, b), model, float(np.linalg.norm(one - other)))
            for ((a, model), one), ((b, same), other) in combinations(centres.items(), 2)
            if model == same
        ]
        return tuple(rows), tuple(distances)

    def _scan(
        self, capture: Capture, labels: Mapping[str, str], hashes: Mapping[str, str], factors: Mapping[str, float]
    ) -> ScanView:
        result = f"clouds/{capture.name}"
        meta = self._meta(result) if self.session.has_result(result) else None
        depths = None if meta is None else (float(meta["depth_mm"][0]), float(meta["depth_mm"][1]))
        return ScanView(
            name=capture.name,
            label=str(labels.get(capture.name, capture.name)),
            purpose=capture.meta.get("settings", {}).get("purpose", "scan"),
            created=str(capture.meta.get("created", "")),
            cloud="absent" if meta is None else "fresh" if self._fresh(result, hashes, factors) else "stale",
            model="" if meta is None else meta["model"],
            points=0 if meta is None else meta["points"],
            depth_mm=depths,
            noise_mm=None if meta is None else meta["noise_mm"],
            masked=None if meta is None else meta.get("masked"),
            scale="" if meta is None else meta.get("scale", ""),
            thumbnail=self._thumbnails.get(capture.hash, b""),
        )

    def _merge(self, result: str, hashes: Mapping[str, str], factors: Mapping[str, float]) -> MergeView:
        name = result.removeprefix("merge/")
        return self._keep(  # type: ignore[no-any-return]
            ("merge", self._meta(result)["hash"], stale := not self._fresh(result, hashes, factors)),
            lambda: merge_view(name, self._meta(result), stale),
        )

    # files

    def _results(self, prefix: str) -> list[str]:
        return sorted((n for n in self.session.result_names() if n.startswith(prefix)), key=natural_key)

    def _meta(self, result: str) -> dict[str, Any]:
        return self.session.load_result(result, only=())[0]

    def _fresh(self, result: str, hashes: Mapping[str, str], factors: Mapping[str, float] | None = None) -> bool:
        """Whether every input is there with the hash it had, and is fresh itself, and no scale was changed since."""
        meta = self._meta(result)
        scales = meta.get("scales", {}) if factors is not None else {}
        return all(hashes.get(name) == used for name, used in meta.get("inputs", {}).items()) and all(
            (factors or {}).get(model) == factor for model, factor in scales.items()
        )

    def _keep(self, key: Any, make: Callable[[], Any]) -> Any:
        if key not in self._kept:
            if len(self._kept) > 500:
                self._kept.clear()
            self._kept[key] = make()
        return self._kept[key]


def _fit_rms(session: Session) -> dict[str, Mapping[str, float]]:
    """By axis and coefficients; nothing of a calibration that another version has saved."""
    try:
        model = load_model(session, "pixelwise")
    except SessionError:
        return {}
    assert isinstance(model, PixelwiseModel)
    return {axis: model.median_rms_mm(axis) for axis in model.axes}


def _splined(session: Session) -> SplinedView | None:
    """None of a calibration that another version has saved."""
    try:
        model = load_model(session, "splined")
    except SessionError:
        return None
    assert isinstance(model, SplinedModel)
    found, fits = model.summary(), model.bundle.fits
    low, high = found["board_height_mm"]
    return SplinedView(
        noise_px=found["noise_px"],
        local_px=found["local_distortion_rms_px"],
        height_mm=(low, high),
        misplaced_mm=found["board_offsets_rms_mm"],
        lit=found["cells_lit"],
        left_out=found["left_out"],
        trust={name: (fit.camera_trust, fit.projector_trust) for name, fit in fits.items()},
        turned=model.bundle.turned,
    )


def _comparison(session: Session) -> ComparisonView | None:
    found = validation(session)
    if found is None:
        return None
    figures = ("plane_mm", "board_mm", "scale_ppm", "camera_px", "projector_px")
    rows = (ModelFigures(model, *(found.rms(model, figure) for figure in figures)) for model in found.models)
    return ComparisonView(tuple(rows), len(next(iter(found.poses.values()))), len(found.folds), found.failed)


def _listed(names: list[str]) -> str:
    return ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")
