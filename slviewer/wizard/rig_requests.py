"""Requests that concern the session, the devices, the target, and the scene of the simulated
rig."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from slviewer.devices.capture import check_exposures
from slviewer.devices.protocols import CameraSettings, ImageProjector, Rig, check_image
from slviewer.devices.world import SimulatedWorld, Thing
from slviewer.errors import DamagedError, DeviceError, InputError, SlviewerError
from slviewer.fringe.presets import find_preset
from slviewer.fringe.sequence import PatternSequence, one_axis
from slviewer.pipeline.capture import choose_sequence, depth_axis
from slviewer.pipeline.duplicate import duplicate_calibration
from slviewer.pipeline.examination import CheckVerdict, Preflight
from slviewer.pipeline.operation import Progress
from slviewer.pipeline.rig_choice import Choice, RigSetup, save_rig
from slviewer.pipeline.suggest_exposure import BUDGET_S, ExposureSuggestion, suggest_exposure
from slviewer.preflight.check_rig import preflight
from slviewer.records.record import format_count
from slviewer.session.reading import expand_user
from slviewer.session.recent import unused_folder
from slviewer.session.store import Session
from slviewer.simulation.boards import Pose
from slviewer.target.board import Board
from slviewer.wizard.acquisition import LIGHTS, ShownImage
from slviewer.wizard.engine import Engine, remember_running, request
from slviewer.wizard.session_reader import SessionReader
from slviewer.wizard.snapshot import CalibrationView, ExposureChange, Level
from slviewer.wizard.undo import UndoHistory

T = TypeVar("T")
_CHECKED: dict[CheckVerdict, tuple[Level, str]] = {
    "good": ("good", "the rig is ready to capture"),
    "warning": ("warning", "the rig can capture; the step Rig lists possible improvements"),
    "bad": ("error", "the rig is not ready to capture: the step Rig lists what to correct"),
    "unknown": ("warning", "the rig could not be checked: the step Rig lists the reason"),
}


class RigRequests(Engine):
    """Requests about the session, the devices, the target and the patterns."""

    @request("Opening the session")
    def open_session(
        self, path: Path | str, rig: Choice | None = None, *, is_new: bool = False
    ) -> None:
        """Open or create a session for writing, with `rig`, else the one that it remembers, else
        the one in use. ``is_new``: only where there is none yet.

        Jobs of the previous session are cancelled. If the remembered rig is not connected, the
        session opens without. Where the session is open already, only the rig changes.
        """
        if not str(path).strip():
            raise InputError("no folder is named", "enter the folder of a session, or of a new one")
        with self._lock:
            if not self._acquisition.idle:
                raise InputError(
                    "a capture is running",
                    "wait for it, or cancel it, before you open another session",
                )
            before = self.session
            is_open = before and expand_user(path).resolve() == before.folder.resolve()
            if before and is_open and not is_new:
                if rig:
                    self._restore_rig(before, rig)
                return
            store = Session.create(path) if is_new else Session.open_or_create(path)
            self._acquisition.stop_stream()
            self._jobs.cancel_all()
            self._session_reader, self._queued = SessionReader(store, self._planner), set()
            self._history = UndoHistory(store)
            self.show(merge_failure="")
            if before:
                before.close()
                self._notices.clear()
            for name in store.recovered:
                self._notices.add(
                    "info",
                    f"{name} was complete when the program ended, and is in the session again",
                )
            if self._history.fault:
                self._notices.add("warning", self._history.fault)
            if interrupted := store.valid_decision("running"):
                remember_running(store, None)
                self._notices.add(
                    "warning",
                    f"{interrupted} was interrupted when the program ended: start it again; what"
                    " had been saved is there",
                )
            try:
                self._restore_rig(store, rig)
            finally:
                self._update_board()

    @request("Duplicating the calibration")
    def duplicate_calibration(self, folder: Path) -> None:
        """Make a session with the calibration of another one, beside it, and open it."""
        target = unused_folder(folder)
        poses = duplicate_calibration(folder, target)
        if self.open_session(target):
            count = format_count(len(poses), "pose")
            self._notices.add(
                "good", f"{target.name} has the calibration of {folder.name}, from {count}"
            )

    @request("Choosing the rig")
    def choose_rig(self, choice: Choice) -> None:
        """Use other devices from now on (see `rig_choice`). The session remembers it."""
        self._use_rig(choice)

    def _restore_rig(self, store: Session, rig: Choice | None) -> None:
        """Use `rig`, else the rig saved in the session, else save the current one there; report one
        that fails."""
        choice = rig or store.valid_decision("rig")
        if choice and choice != self._choice:
            try:
                self._use_rig(choice)
            except SlviewerError as error:
                if rig:
                    raise
                self._forget_rig(choice, None)
                self._acquisition.use(None, fault=str(error))
                self._notices.add_failure("Choosing the rig", error)
        elif self._choice is not None:
            _remember(store, rig=dict(self._choice))
            if exposure := store.valid_decision("exposure"):
                self._acquisition.set_camera(CameraSettings(**exposure))

    def _use_rig(self, choice: Choice) -> None:
        """Use other devices from now on, in the session too.

        If it is the same rig again, the measured delay stays unless the choice has one, and so does
        the exposure that the session remembers.
        """
        with self._lock:
            store, exposure = self.session, None
            known = dict((store.valid_decision("rig") if store else None) or {})
            same = {**known, "settle_ms": None} == {**choice, "settle_ms": None}
            if same:
                choice = {**known, **choice}
            bench = self._set_up(choice, self._parse_board())
            if store:
                if known != dict(choice):
                    _remember(store, rig=dict(choice))
                if not same:  # those of another camera do not apply
                    _remember(store, exposure=None, exposures=None, levels=None)
                exposure = store.valid_decision("exposure")
            exposure = exposure or {
                key: choice[key] for key in ("exposure_ms", "gain") if choice.get(key)
            }
            self._forget_rig(choice, bench)
            self._acquisition.use(bench.rig, CameraSettings(**exposure) if exposure else None)

    def _forget_rig(self, choice: Choice, bench: RigSetup | None) -> None:
        """Forget what was measured with the rig before, and remember the new one."""
        self._choice, self._bench, self._preview = dict(choice), bench, None
        self.show(preflight=None, exposure_change=None)

    @request("Setting the exposure")
    def set_exposure(self, exposure_ms: float | None = None, gain: float | None = None) -> None:
        """Set exposure time and gain; None leaves one as it is. The snapshot has what the camera
        really uses.

        Several exposures of each capture are scaled by the same factor.
        """
        now, session = self._acquisition.view(), self.session
        settings = CameraSettings(exposure_ms or now.exposure_ms, gain or now.gain)
        self._acquisition.set_camera(settings)
        if session is None:
            return
        with self._lock:  # dragging a slider sends requests from several threads
            before = (session.decision("exposure") or {}).get("exposure_ms") or now.exposure_ms
            session.decide("exposure", asdict(settings))
            several = self._reader.exposures_ms()
            if several and exposure_ms and before:
                session.decide(
                    "exposures", check_exposures([each * exposure_ms / before for each in several])
                )

    @request("Setting the exposures")
    def set_exposures(self, exposures_ms: Sequence[float]) -> None:
        """Set several exposures, ms, for every capture, for shiny and dark parts; empty: a single
        one."""
        self._store.decide("exposures", check_exposures(exposures_ms) if exposures_ms else [])

    @request("Suggesting the exposure")
    def suggest_exposure(self, for_scan: bool = False, budget_s: float = BUDGET_S) -> None:
        """Choose, with the patterns of a pose or of a scan, exposures that measure as much as
        possible, and set them.

        The snapshot has what they measure; `undo_exposure` sets the ones before.
        """
        sequence = self._scan_sequence() if for_scan else self._pose_sequence()
        current_ms = self._reader.exposures_ms()

        def done(suggestion: ExposureSuggestion) -> None:
            """Set what was chosen."""
            before = self._store.decision("exposure") or self._acquisition.view().exposure
            self.show(
                exposure_change=ExposureChange(suggestion, before, self._reader.exposures_ms())
            )
            first, *more = suggestion.exposures_ms
            self._decide_exposure(
                {"exposure_ms": first, "gain": suggestion.gain}, [first, *more] if more else []
            )
            self._notices.add("good", suggestion.text())

        self._use_bench(
            "Suggesting the exposure",
            lambda rig, progress: suggest_exposure(
                rig, sequence, current_ms=current_ms, budget_s=budget_s, progress=progress
            ),
            done,
        )

    def _use_bench(
        self, title: str, work: Callable[[Rig, Progress], T], done: Callable[[T], None]
    ) -> None:
        """Queue work with the open rig; ``done`` is called with its result unless another rig was
        chosen meanwhile."""
        bench = self._bench

        def finish(result: T) -> None:
            """Pass on the result, if the rig is still in use."""
            with self._lock:
                if self._bench is bench:
                    done(result)
            self._note_change()

        self._acquisition.run_task(title, work, finish)

    @request("Undoing the exposure")
    def undo_exposure(self) -> None:
        """Set the exposures from before the last suggestion."""
        with self._lock:
            change = self._shown.exposure_change
            if change is None:
                raise InputError("no suggested exposure is set: nothing can be undone")
            self.show(exposure_change=None)
            self._decide_exposure(change.exposure_before, change.exposures_before_ms)

    def _decide_exposure(
        self, exposure: Mapping[str, float | None], exposures_ms: Sequence[float]
    ) -> None:
        """Set the camera's exposure and gain, and the exposures of each capture, none for a single
        one."""
        self._acquisition.set_camera(CameraSettings(**exposure))
        self._store.decide("exposure", dict(exposure))
        self._store.decide("exposures", list(exposures_ms))

    @request("Checking the rig")
    def check_rig(self) -> None:
        """Run the preflight, about 10 s; the snapshot has its result, and the delay that it
        measured is used."""

        def done(result: Preflight) -> None:
            """Store the result of the check, and report its verdict."""
            self._set_preflight(result)
            self._notices.add(*_CHECKED[result.verdict])

        self._use_bench(
            "Checking the rig", lambda rig, progress: preflight(rig, progress=progress), done
        )

    def _set_preflight(self, result: Preflight) -> None:
        """Store the result of a rig check, and use the delay that it measured; the session
        remembers it with the rig."""
        self.show(preflight=result)
        if result.settle_ms is not None and self._choice is not None:
            self._choice = {**self._choice, "settle_ms": result.settle_ms}
            self._acquisition.set_delay(result.settle_ms)
            if self.session:
                self.session.decide("rig", self._choice)

    @request("Linearising the projector")
    def set_linear_light(self, on: bool) -> None:
        """Switch the projector's linearisation, by the table of grey levels from the rig check, on
        or off."""
        preflight = self._shown.preflight
        levels = preflight.levels if preflight else None
        if on and levels is None:
            raise InputError("no table of grey levels is measured", "check the rig first")
        self._store.decide("levels", list(levels) if on and levels else None)

    @request("Saving the rig")
    def save_rig(self, name: str, what: str = "") -> None:
        """Save the rig in use, with its exposure, under a name in the session, where `rig_choice`
        lists it."""
        if self._choice is None:
            raise InputError("no rig is in use", "choose one in the step Rig")
        exposure = {key: value for key, value in self._acquisition.view().exposure.items() if value}
        save_rig(self._store, name, {**self._choice, **exposure}, what)

    @request("Changing the light")
    def set_light(self, light: str) -> None:
        """Set what the projector shows between captures: "white", "grey", "dark", or "pattern" to
        focus by."""
        if light not in (*LIGHTS, "pattern"):
            raise InputError(
                f"there is no light {light!r}", f"choose {', '.join(LIGHTS)} or pattern"
            )
        reel = self._bench.reel if self._bench else None
        if light == "dark" and reel and not reel.has_dark:
            raise InputError("the recording has no dark frame", "choose another light")
        self._acquisition.set_light(light, self._pose_sequence() if light == "pattern" else None)

    @request("Showing the image")
    def show_image(self, image: np.ndarray) -> None:
        """Show an image (h, w, 3) uint8 RGB with the rig's projector between captures."""
        projector = self._require_bench().rig.projector
        if not isinstance(projector, ImageProjector):
            raise InputError(
                f"{projector.name} shows patterns alone, by its driver",
                "show the image's PNG file full screen on the projector, pixel by pixel",
            )
        self._acquisition.set_light("image", ShownImage(check_image(projector, image)))

    @request("Choosing the target")
    def choose_target(self, notation: str) -> None:
        """Set the board; poses captured before are evaluated again with it."""
        board = Board.parse(notation)
        with self._lock:
            before = self._reader.target()
            self._store.decide("target", str(board))
            try:
                self._update_board()
            except InputError:  # a board that the simulated rig cannot show
                self._store.decide("target", before)
                raise

    def _update_board(self) -> None:
        """Apply the current target: print it on the simulated board, and queue the evaluation of
        the poses by it."""
        board, world = self._parse_board(), self._scene
        if board and world and board != world.board:
            world.print_board(board)
        self._queue_processing()
        self._note_change()

    def _parse_board(self) -> Board | None:
        """Return the board of the session's target; None where none is chosen."""
        target = self._session_reader.target() if self._session_reader else ""
        return Board.parse(target) if target else None

    @request("Choosing the patterns")
    def choose_patterns(self, name: str) -> None:
        """Set the pattern sequence of later captures."""
        find_preset(name)
        self._store.decide("patterns", name)

    @request("Setting the wanted accuracy")
    def set_wanted_sigma(self, sigma_mm: float | None) -> None:
        """Set the 3D standard deviation, mm, that the suggested poses aim for; None: the
        default."""
        if sigma_mm is not None and not 0 < sigma_mm < 100:
            raise InputError(
                f"a standard deviation of {sigma_mm:g} mm is not possible", "give one above 0 mm"
            )
        self._store.decide("sigma_wanted_mm", sigma_mm)

    @request("Placing")
    def place(self, thing: Thing, T_camera_object: np.ndarray | None = None) -> None:
        """Place a thing of `devices.world`, such as "board" or "sphere", in front of the simulated
        rig.

        At T_camera_object (4, 4) mm, or where it was.
        """
        T = None if T_camera_object is None else np.asarray(T_camera_object, float)
        if T is not None and T.shape != (4, 4):
            raise InputError(f"a pose has the shape {T.shape}", "give (4, 4)")
        self._world.place(thing, None if T is None else Pose(T[:3, :3].copy(), T[:3, 3].copy()))

    @request("Placing")
    def move_object(self, distance_mm: float | None = None, turn_deg: float | None = None) -> None:
        """Move the simulated object to a distance on its ray; turn it about the vertical."""
        self._world.move(distance_mm, turn_deg)

    def place_at_suggestion(self) -> bool:
        """Place the simulated board at the suggested next pose; False, with a notice, where none is
        suggested."""
        suggestion = self._publisher.refresh().content.suggestion
        if suggestion is None:
            self._notices.add("error", "no pose is suggested yet: choose a rig and a target first")
            return False
        return self.place("board", suggestion.T_camera_board)

    @property
    def _world(self) -> SimulatedWorld:
        """The scene of the simulated rig. Raises InputError where the rig is a real one."""
        if self._scene is None:
            raise InputError(
                "objects can be placed only before the simulated rig", "choose it in the step Rig"
            )
        return self._scene

    # what captures project

    def _require_bench(self) -> RigSetup:
        """Return the rig in use. Raises DeviceError where none is chosen."""
        if self._bench is None:
            raise DeviceError("no rig is chosen", "choose one in the step Rig")
        return self._bench

    def _require_calibration(self, why: str) -> CalibrationView:
        """Return the session's calibration. Raises InputError with ``why`` where there is none."""
        calibration = self._publisher.refresh().calibration
        if calibration is None:
            raise InputError(f"calibrate first: {why}")
        return calibration

    def _pose_sequence(self) -> PatternSequence:
        """Return the sequence for target poses: the session's pattern sequence along both axes, or
        that of a recording."""
        sequence = choose_sequence(self._require_bench(), self._reader.patterns())
        levels = self._reader.levels()
        return sequence if levels is None else replace(sequence, levels=levels)

    def _scan_sequence(self) -> PatternSequence:
        """Return the sequence for scans: that of poses along the one axis that measures depth.
        InputError before a calibration."""
        calibration = self._require_calibration(
            "a capture cannot be measured without a calibration"
        )
        sequence = self._pose_sequence()
        if self._require_bench().reel:
            return sequence
        return one_axis(sequence, depth_axis(calibration.stereo.rig))  # half of the frames


def _remember(store: Session, **decisions: Any) -> None:
    """Remember decisions of the rig's in the session, unless its decisions are damaged, which its
    faults name."""
    with suppress(DamagedError):
        for what, value in decisions.items():
            store.decide(what, value)
