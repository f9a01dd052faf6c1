"""The wizard's state and its threads: the session, the rig, the jobs, and the snapshot made of
them.

Requests (`operator` and the `*_requests`) call in here; panels do not. Each attribute is written by
the engine alone.
"""

import contextlib
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from slviewer.calibration.observe import Observation, Smoothing
from slviewer.devices.protocols import CameraSettings
from slviewer.devices.world import SimulatedWorld
from slviewer.errors import DamagedError, InputError, SessionError, SlviewerError
from slviewer.pipeline.capture import measure_space, warn_of_captured
from slviewer.pipeline.check_results import Preflight
from slviewer.pipeline.examination import load_examination, load_or_save_examination
from slviewer.pipeline.poses import read_stored_poses
from slviewer.pipeline.rig_choice import Choice, RigSetup, SetUp, list_needed_pages, save_rig
from slviewer.registration.refusal import Reason
from slviewer.session.capture import Capture
from slviewer.session.reading import expand_user
from slviewer.session.store import Session
from slviewer.target.board import Board
from slviewer.wizard.acquisition import Acquisition
from slviewer.wizard.diagnostics import LogKeeper
from slviewer.wizard.jobs import Jobs, Reporter
from slviewer.wizard.live_scan import LiveCloud, LiveScan
from slviewer.wizard.notices import Notices, describe_failure
from slviewer.wizard.planner import Planner
from slviewer.wizard.pose_plan import plan_next_pose
from slviewer.wizard.preview_watcher import HandsFree, Watch, Watcher
from slviewer.wizard.publisher import Listeners, Publisher
from slviewer.wizard.result_views import make_thumbnail
from slviewer.wizard.session_reader import SessionReader
from slviewer.wizard.snapshot import (
    Brightness,
    ExposureChange,
    PreviewView,
    RigView,
    SessionView,
    Snapshot,
    WorldView,
)
from slviewer.wizard.steps import Facts, views
from slviewer.wizard.timing import Timing

READ_ATTEMPTS = 20
"""Snapshots in a row that may meet the session's files in the middle of a change."""


class Engine:
    """Everything behind the requests. `capture_now` is called, on the preview's thread, for a
    hands-free capture."""

    def __init__(self, set_up: SetUp, capture_now: Callable[[], object], timing: Timing) -> None:
        self._set_up, self._capture_now = set_up, capture_now
        self.lock = threading.RLock()
        self.log = LogKeeper()
        self.preview: PreviewView | None = None
        self.preview_listeners = Listeners[PreviewView]()
        self.live: LiveScan | None = None  # the last one, whether it runs or not
        self.live_listeners = Listeners[LiveCloud]()
        self.hands_free = HandsFree(timing.hold_s, timing.count_s)
        self.bench: RigSetup | None = None
        self.preflight: Preflight | None = None  # of the rig in use
        self.exposure_change: ExposureChange | None = None  # of the rig in use
        self._autopilot = ""
        self._preparing: float | None = None
        self._merge_failure = ""
        self._merge_refusal: Reason | None = None
        self._choice: Choice | None = None
        self._rig_fault = ""  # why the chosen rig could not even be set up
        self._reader: SessionReader | None = None
        # captures by name and content hash, and the target
        self._queued: set[tuple[str, str, str]] = set()
        self._brightness: Brightness = ""
        # the publisher's thread alone writes these:
        # a session, and whether its poses were enough
        self._reached: tuple[Path | None, bool] = (
            None,
            False,
        )
        self._failed_reads, self._reported_faults = 0, set[str]()
        empty = Snapshot(
            0, None, RigView(), None, None, (), views(Facts(None, RigView(), None)), None, False, ""
        )
        self.publisher = Publisher(self._build_snapshot, empty, timing.retry_s)
        self.notices = Notices(self.publisher.mark_changed)
        self.jobs = Jobs(self.notices, self.publisher.mark_changed)
        compute = partial(plan_next_pose, trials=timing.trials)
        self._planner = Planner(lambda: self.publisher.mark_changed(session=True), compute)
        self.watcher = Watcher(self._handle_preview)
        self.acquisition = Acquisition(
            self.notices,
            self.publisher.mark_changed,
            self.watcher.offer,
            retry_s=timing.retry_s,
            previews_per_s=timing.previews_per_s,
        )
        self.publisher.listeners.add(self._follow_up)
        self.publisher.start()

    # session and rig

    @property
    def session(self) -> Session | None:
        """The open session; None where none is open."""
        reader = self._reader
        return None if reader is None else reader.session

    @property
    def reader(self) -> SessionReader:
        """The reader of the open session. Raises SessionError where none is open."""
        reader = self._reader
        if reader is None:
            raise SessionError("no session is open: open or create one first")
        return reader

    @property
    def store(self) -> Session:
        """The open session. Raises SessionError where none is open."""
        return self.reader.session

    @property
    def world(self) -> SimulatedWorld:
        """The scene of the simulated rig. Raises InputError where the rig is a real one."""
        world = self.bench.world if self.bench else None
        if world is None:
            raise InputError(
                "objects can be placed only before the simulated rig: choose it in the step Rig"
            )
        return world

    def open_session(self, path: Path | str, rig: Choice | None = None) -> None:
        """Open another session, with `rig`, else the one that it remembers, else the one in use.

        Jobs of the previous session are cancelled. If the remembered rig is not connected, the
        session opens without. Where the session is open already, only the rig changes.
        """
        with self.lock:
            if not self.acquisition.idle:
                raise InputError(
                    "a capture is running: wait for it, or cancel it, before you open another"
                    " session"
                )
            before = self.session
            if before is not None and expand_user(path).resolve() == before.folder.resolve():
                if rig:
                    self._restore_rig(before, rig)
                return
            store = Session.open_or_create(path)
            self.acquisition.stop_stream()
            self.jobs.cancel_all()
            self._reader, self._queued = SessionReader(store, self._planner), set()
            self._merge_failure = ""
            if before is not None:
                before.close()
            for name in store.recovered:
                self.notices.add(
                    "info",
                    f"{name} was complete when the program ended, and is in the session again",
                )
            try:
                self._restore_rig(store, rig)
            finally:
                self.update_board()

    def _restore_rig(self, store: Session, rig: Choice | None) -> None:
        """Use `rig`, else the rig saved in the session, else save the current one there; report one
        that fails."""
        choice = rig or store.valid_decision("rig")
        if choice and choice != self._choice:
            try:
                self.use_rig(choice)
            except SlviewerError as error:
                if rig:
                    raise
                self._forget_rig(choice, None)
                self._rig_fault = str(error)
                self.acquisition.use(None)
                self.notices.add_failure("Choosing the rig", error)
        elif self._choice is not None:
            self._remember(store, "rig", dict(self._choice))
            if exposure := store.valid_decision("exposure"):
                self.acquisition.set_camera(CameraSettings(**exposure))

    def use_rig(self, choice: Choice) -> None:
        """Use other devices from now on, in the session too.

        If it is the same rig again, the measured delay stays unless the choice has one, and so does
        the exposure that the session remembers.
        """
        with self.lock:
            store = self.session
            known = dict((store.valid_decision("rig") if store is not None else None) or {})
            same = {**known, "settle_ms": None} == {**choice, "settle_ms": None}
            if same and "settle_ms" in known and "settle_ms" not in choice:
                choice = {**choice, "settle_ms": known["settle_ms"]}
            bench = self._set_up(choice, self._parse_board())
            if store is not None and known != dict(choice):
                self._remember(store, "rig", dict(choice))
            if store is not None and not same:
                # those of another camera do not apply
                for decision in (
                    "exposure",
                    "exposures",
                    "levels",
                ):
                    self._remember(store, decision, None)
            exposure = store.valid_decision("exposure") if store is not None else None
            exposure = exposure or {
                key: choice[key] for key in ("exposure_ms", "gain") if choice.get(key)
            }
            self._forget_rig(choice, bench)
            self._rig_fault = ""
            self.acquisition.use(bench.rig, CameraSettings(**exposure) if exposure else None)

    @staticmethod
    def _remember(store: Session, what: str, value: Any) -> None:
        """Remember a decision of the rig's in the session, unless its decisions are damaged, which
        its faults name."""
        with contextlib.suppress(DamagedError):
            store.decide(what, value)

    def _forget_rig(self, choice: Choice, bench: RigSetup | None) -> None:
        """Forget what was measured with the rig before, and remember the new one."""
        self._choice, self.bench, self.preview = dict(choice), bench, None
        self.preflight = self.exposure_change = None

    def save_rig(self, name: str, what: str) -> None:
        """Save the rig in use, with its exposure, as a preset of the session."""
        if self._choice is None:
            raise InputError("no rig is in use: choose one in the step Rig")
        now = self.acquisition.view()
        exposure = {"exposure_ms": now.exposure_ms, "gain": now.gain}
        save_rig(
            self.store, name, {**self._choice, **{k: v for k, v in exposure.items() if v}}, what
        )

    def set_preflight(self, bench: RigSetup | None, result: Preflight) -> bool:
        """Store the result of a rig check, and use the delay that it measured; the session
        remembers it with the rig.

        Returns False, and changes nothing, where `bench` is no longer in use.
        """
        with self.lock:
            if self.bench is not bench:
                return False
            self.preflight = result
            if result.settle_ms is not None and self._choice is not None:
                self._choice = {**self._choice, "settle_ms": result.settle_ms}
                self.acquisition.set_delay(result.settle_ms)
                if self.session is not None:
                    self.session.decide("rig", dict(self._choice))
            return True

    def update_board(self) -> None:
        """Apply the current target: print it on the simulated board, and queue the evaluation of
        the poses by it."""
        board, world = self._parse_board(), self.bench.world if self.bench else None
        if board is not None and world is not None and board != world.board:
            world.print_board(board)
        self.queue_processing()
        self.publisher.mark_changed(session=True)

    def set_live(self, live: LiveScan) -> None:
        """Set the current live scan."""
        self.live = live

    def set_autopilot(self, act: str) -> None:
        """Set the autopilot's current act; empty: it is off."""
        self._autopilot = act
        self.publisher.mark_changed()

    def set_preparing(self, share: float | None) -> None:
        """Set the share of the kernels that are compiled in the background; None: none are being
        compiled."""
        self._preparing = share
        self.publisher.mark_changed()

    def set_merge_failure(self, why: str, reason: Reason | None = None) -> None:
        """Set why the last merge failed, empty: it did not; ``reason``: that of a refused
        registration."""
        self._merge_failure, self._merge_refusal = why, reason
        self.publisher.mark_changed()

    def close(self) -> None:
        """Stop all threads, close the devices and the session."""
        self.acquisition.close()
        self.watcher.close()
        self.jobs.close()
        self._planner.close()
        self.publisher.close()
        with self.lock:
            if self.session is not None:
                self.session.close()
        self.log.close()

    def _parse_board(self) -> Board | None:
        """Return the board of the session's target; None where none is chosen."""
        target = self._reader.target() if self._reader else ""
        return Board.parse(target) if target else None

    # the background

    def queue_processing(self) -> None:
        """Queue background jobs for captures without thumbnail, frame check or pose features."""
        reader = self._reader
        if reader is None:
            return
        target = reader.target()
        for capture in reader.session.captures():
            key = (capture.name, capture.hash, target)
            with self.lock:
                if key in self._queued:
                    continue
                self._queued.add(key)
            self.jobs.submit(
                f"Processing {capture.name}",
                partial(self._process_capture, reader, capture),
                lambda _: self.publisher.mark_changed(session=True),
                failed=partial(self._handle_processing_failure, reader, capture),
                background=True,
            )

    def reprocess(self, capture: Capture) -> None:
        """Process a restored capture again, whose results no longer exist."""
        with self.lock:
            self._queued = {key for key in self._queued if key[1] != capture.hash}
        self.queue_processing()

    def _process_capture(self, reader: SessionReader, capture: Capture, report: Reporter) -> None:
        """Make the thumbnail of a capture, check its frames, and read its features if it is a
        target pose."""
        if capture.name not in reader.session.capture_names():
            return  # deleted since
        if not reader.has_thumbnail(capture):
            reader.add_thumbnail(capture, make_thumbnail(capture))
            self.publisher.mark_changed(session=True)
        session = reader.session.guarded(report.saving)
        report(0.0, f"reading {capture.name}")
        is_new = load_examination(session, capture.name) is None
        try:
            if reader.needs_judging(capture, reader.target()):
                self._judge_pose(reader, session, capture)
        finally:
            if is_new:
                for sentence in load_or_save_examination(session, capture).warnings():
                    self.notices.add("warning", f"{capture.name}: {sentence}", "frames")
                warn_of_captured(
                    capture.name,
                    capture,
                    lambda text: self.notices.add("warning", text, "check-exposure"),
                )

    def _judge_pose(self, reader: SessionReader, session: Session, capture: Capture) -> None:
        """Read the features of a target pose, examine its frames, and save both; the next pose is
        planned meanwhile."""
        target = reader.target()

        def plan_next(observation: Observation) -> None:
            """Let the next pose be planned from the features, before the frames are examined."""
            reader.add_features(capture, target, observation)
            self.publisher.mark_changed(session=True)

        poses = read_stored_poses(
            session, [capture.name], Board.parse(target), Smoothing(), plan_next
        )
        judged = next(poses)
        if judged.observation is None:
            self.notices.add(
                "warning", f"{capture.name} cannot be used: {judged.refused}", "target-poses"
            )
        self.publisher.mark_changed(session=True)

    def _handle_processing_failure(
        self, reader: SessionReader, capture: Capture, error: BaseException
    ) -> None:
        """Report that a capture could not be processed, and store why it is unreadable."""
        self.notices.add_failure(f"Processing {capture.name}", error)
        if isinstance(error, InputError | DamagedError):
            reader.add_unreadable(capture, str(error))
        self.publisher.mark_changed(session=True)

    # previews

    def _handle_preview(self, view: PreviewView) -> None:
        """Publish an analysed preview, trigger hands-free capture, and update the brightness
        (preview thread)."""
        countdown = self.hands_free.countdown(
            view.board, not self.acquisition.idle, time.monotonic()
        )
        now = countdown is not None and countdown <= 0
        self.preview = view = replace(view, countdown_s=None if now else countdown)
        if now:
            self._capture_now()
        brightness = view.brightness if self.acquisition.view().light == "white" else ""
        if brightness != self._brightness:
            self._brightness = brightness
            self.publisher.mark_changed()
        self.preview_listeners.call(view)

    # snapshots

    def _build_snapshot(self, version: int, session_changed: bool) -> Snapshot:
        """Build the current snapshot without changing any state (publisher's thread)."""
        reader, bench, choice, rig = self._reader, self.bench, self._choice, self.acquisition.view()
        session, space, read_failure = (
            self.publisher.latest.session,
            None,
            self.publisher.latest.read_failure,
        )
        if reader is None:
            session = None
        else:
            if session_changed or session is None or session.folder != reader.session.folder:
                session, read_failure = self._read_session(reader, rig, session)
            try:
                camera = bench.rig.camera if bench is not None and rig.camera is not None else None
                space = measure_space(reader.session, camera, reader.count_frames(rig))
            except (SlviewerError, OSError) as error:
                read_failure = read_failure or describe_failure("Reading the session", error)
        if self._rig_fault:
            rig = replace(rig, state="lost", fault=self._rig_fault)
        world = _view_world(bench.world) if bench is not None and bench.world is not None else None
        rig = replace(
            rig,
            simulated=world is not None,
            choice=choice,
            pages=() if choice is None else list_needed_pages(choice),
        )
        return Snapshot(
            version=version,
            session=session,
            rig=rig,
            world=world,
            job=self.jobs.view(),
            notices=self.notices.all(),
            steps=views(Facts(session, rig, space, self._brightness)),
            space=space,
            hands_free=self.hands_free.is_on,
            autopilot=self._autopilot,
            preflight=self.preflight,
            exposure_change=self.exposure_change,
            live=self.live.figures() if self.live is not None and self.live.is_running else None,
            merge_failure=self._merge_failure,
            merge_refusal=self._merge_refusal,
            read_failure=read_failure,
            preparing=self._preparing,
        )

    def _read_session(
        self, reader: SessionReader, rig: RigView, before: SessionView | None
    ) -> tuple[SessionView | None, str]:
        """Return (the session, ""); where it cannot be read, (`before` if it is of the same folder,
        why)."""
        try:
            return reader.read(rig, self.bench.focal_px if self.bench else None), ""
        except Exception as error:  # most likely files were being changed
            is_same = before is not None and before.folder == reader.session.folder
            return before if is_same else None, describe_failure("Reading the session", error)

    def _follow_up(self, snapshot: Snapshot) -> None:
        """Act on a new snapshot: retry failed reads, plan the next pose, end hands-free capture."""
        session = snapshot.session
        faults = (
            (snapshot.read_failure,) if snapshot.read_failure else session.faults if session else ()
        )
        new_faults = [fault for fault in faults if fault not in self._reported_faults]
        self._reported_faults &= set(faults)
        self._failed_reads = self._failed_reads + 1 if new_faults else 0
        if 0 < self._failed_reads < READ_ATTEMPTS:
            self.publisher.mark_changed(session=True)
        elif new_faults:  # each is reported once, until it can be read again
            self._reported_faults |= set(new_faults)
            for fault in new_faults:
                self.notices.add("error", fault)
        self.watcher.watch(_choose_watch(session))
        if session is None:
            return
        if session.pending_plan is not None:
            self._planner.request(session.pending_plan)
            return
        reached, self._reached = self._reached, (session.folder, session.enough)
        if session.enough and reached != self._reached and self.hands_free.is_on:
            self.hands_free.switch(False)
            self.notices.add(
                "good", "the poses reach the wanted accuracy: hands-free capture has stopped"
            )


def _view_world(world: SimulatedWorld) -> WorldView:
    """Return what stands before the simulated rig, and its pose."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = world.pose.R, world.pose.t
    return WorldView(world.standing, T, world.turn_deg)


def _choose_watch(session: SessionView | None) -> Watch:
    """Return what to detect in the previews: the session's board, and the lens to estimate its pose
    with."""
    if session is None or not session.target:
        return Watch()
    return Watch(Board.parse(session.target), session.plan.lens if session.plan else None)
