"""The wizard's state and its threads: the session, the rig, the jobs, and the snapshot made of
them.

The requests are methods of its subclasses (the `*_requests`, `operator`), which alone write the
state; panels see snapshots. `request` makes a method a request: granted or refused at once, without
raising. What was done last in a session can be undone (`undo`).
"""

import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from functools import partial, wraps
from pathlib import Path
from typing import Any, Concatenate, ParamSpec, TypeVar

import numpy as np

from slviewer.calibration.observe import Observation, Smoothing
from slviewer.devices.world import SimulatedWorld
from slviewer.errors import (
    CalibrationRejected,
    DamagedError,
    InputError,
    SessionError,
    SlviewerError,
)
from slviewer.pipeline.capture import Space, measure_space, warn_of_captured
from slviewer.pipeline.examination import load_examination, load_or_save_examination
from slviewer.pipeline.models import accepts_rejected
from slviewer.pipeline.operation import Findings, Job, Operation, Warn
from slviewer.pipeline.poses import read_stored_poses
from slviewer.pipeline.rig_choice import Choice, RigSetup, SetUp, list_needed_pages
from slviewer.session.capture import Capture
from slviewer.session.store import Session
from slviewer.simulation.boards import Pose
from slviewer.target.board import Board
from slviewer.wizard.acquisition import Acquisition
from slviewer.wizard.diagnostics import LogKeeper
from slviewer.wizard.jobs import Jobs, Notices, Reporter, describe_failure
from slviewer.wizard.live_scan import LiveCloud, LiveScan
from slviewer.wizard.pose_plan import Planner
from slviewer.wizard.preview_watcher import HandsFree, Watch, Watcher
from slviewer.wizard.publisher import Listeners, Publisher
from slviewer.wizard.result_views import make_thumbnail
from slviewer.wizard.service import Timing
from slviewer.wizard.session_reader import SessionReader
from slviewer.wizard.snapshot import (
    PreviewView,
    RigView,
    SessionView,
    Snapshot,
    WorldView,
    WrittenFile,
)
from slviewer.wizard.steps import views
from slviewer.wizard.undo import Step, UndoHistory, replaced_by


def remember_running(store: Session, title: str | None) -> None:
    """Remember what a session's job computes, None once it has ended, if it can be written."""
    with suppress(SlviewerError, OSError):
        store.decide("running", title)


READ_ATTEMPTS = 20
"""Snapshots in a row that may meet the session's files in the middle of a change."""

P = ParamSpec("P")
T = TypeVar("T")
Handler = TypeVar("Handler", bound="Engine")
Request = Callable[Concatenate[Any, P], bool]


def request(action: str) -> Callable[[Callable[Concatenate[Handler, P], None]], Request[P]]:
    """Return a decorator: the method then returns whether its request was granted, and an error
    becomes a notice."""

    def decorate(function: Callable[Concatenate[Handler, P], None]) -> Request[P]:
        """Wrap a method as a request."""

        @wraps(function)
        def handle(self: Handler, /, *args: P.args, **kwargs: P.kwargs) -> bool:
            """Call the method; return True, or False with a notice where it raised an error."""
            try:
                function(self, *args, **kwargs)
            except Exception as error:
                self._notices.add_failure(action, error)
                return False
            finally:
                self._note_change()
            return True

        return handle

    return decorate


class Engine:
    """The state behind the requests. `capture_now` is called, on the preview's thread, for a
    hands-free capture."""

    def __init__(self, set_up: SetUp, capture_now: Callable[[], object], timing: Timing) -> None:
        self._set_up, self._capture_now = set_up, capture_now
        self._lock = threading.RLock()
        self._log = LogKeeper()
        self._preview: PreviewView | None = None
        self._preview_listeners = Listeners[PreviewView]()
        self._live: LiveScan | None = None  # the last one, whether it runs or not
        self._live_listeners = Listeners[LiveCloud]()
        self._hands_free = HandsFree(timing)
        self._suggested_at_capture: np.ndarray | None = None  # the pose, T_camera_board (4, 4) mm
        self._history = UndoHistory()
        self._bench: RigSetup | None = None
        self._choice: Choice | None = None
        self._session_reader: SessionReader | None = None
        # captures by name and content hash, and the target
        self._queued: set[tuple[str, str, str]] = set()
        # the publisher's thread alone writes these:
        # a session, and whether its poses were enough
        self._reached: tuple[Path | None, bool] = (None, False)
        self._failed_reads, self._reported_faults = 0, set[str]()
        # what later snapshots show beside what is read for each
        self._shown = Snapshot(steps=views(Snapshot()))
        self._publisher = Publisher(self._build_snapshot, self._shown, timing.retry_s)
        changed = self._publisher.mark_changed
        self._notices = Notices(changed)
        self._jobs = Jobs(self._notices, changed, self._note_change)
        self._planner = Planner(self._note_change, timing.trials)
        self._watcher = Watcher(self._handle_preview)
        self._acquisition = Acquisition(self._notices, changed, self._watcher.offer, timing)
        # what others ask of the parts
        self.wait_for, self.subscribe_live = self._publisher.wait_for, self._live_listeners.add
        self.notify, self.notices = self._notices.add, self._notices.all
        self._publisher.listeners.add(self._follow_up)
        self._publisher.start()

    @property
    def session(self) -> Session | None:
        """The open session, to be read by `result_views`; None where none is open."""
        reader = self._session_reader
        return None if reader is None else reader.session

    @property
    def _scene(self) -> SimulatedWorld | None:
        """The scene of the simulated rig; None where another or none is chosen."""
        return self._bench.world if self._bench else None

    @property
    def _reader(self) -> SessionReader:
        """The reader of the open session. Raises SessionError where none is open."""
        reader = self._session_reader
        if reader is None:
            raise SessionError("no session is open", "open or create one first")
        return reader

    @property
    def _store(self) -> Session:
        """The open session. Raises SessionError where none is open."""
        return self._reader.session

    def close(self) -> None:
        """Stop all threads, close the devices and the session; captures are saved already."""
        for part in (
            self._acquisition,
            self._watcher,
            self._jobs,
            self._planner,
            self._publisher,
            self._log,
        ):
            part.close()
        with self._lock:
            if self.session:
                self.session.close()

    def _note_change(self) -> None:
        """Request a snapshot: the session's files have changed."""
        self._publisher.mark_changed(session=True)

    def show(self, **changes: Any) -> None:
        """Change fields of the next snapshots."""
        with self._lock:
            self._shown = replace(self._shown, **changes)
        self._publisher.mark_changed()

    # work

    def _warner(self, section: str) -> Warn:
        """Return a function that adds a warning to the notices, with its section of the help."""
        return lambda text: self._notices.add("warning", text, section)

    def _work(
        self,
        title: str,
        work: Callable[[Job], Findings[Any] | WrittenFile | str],
        section: str = "",
        failed: Callable[[BaseException], None] | None = None,
        finish: Callable[[Findings[Any]], None] | None = None,
    ) -> None:
        """Queue work on the session, which no longer saves once it was cancelled; what it returns
        becomes a notice, and `failed(error)` replaces that of a failure. `finish(found)` is called
        with what it found. ``section``: of the help, of the notices. Warnings that the result
        states are not repeated."""
        store, warnings = self._store, list[str]()

        def add_warnings(stated: str = "") -> None:
            """Add those of the work's warnings to the notices that are not stated."""
            for text in dict.fromkeys(warnings):
                if text not in stated:
                    self._notices.add("warning", text, section)

        def done(found: Findings[Any] | WrittenFile | str) -> None:
            """Add what the work found to the notices."""
            is_good = True
            if isinstance(found, Findings):
                if finish is not None:
                    finish(found)
                is_good = all(each.is_good for each in found.values())
            text = found if isinstance(found, str) else found.summary()
            add_warnings(text)
            if text:
                file = found if isinstance(found, WrittenFile) else None
                self._notices.add("good" if is_good else "warning", text, section, file)

        def end_failed(error: BaseException) -> None:
            """Add the warnings, and the failure; a verdict is stated in the section."""
            add_warnings()
            if failed:
                failed(error)
            elif isinstance(error, CalibrationRejected):
                self._notices.add("error", str(error), section)
            else:
                self._notices.add_failure(title, error)

        def run(report: Reporter) -> Findings[Any] | WrittenFile | str:
            """Do the work; the session remembers what runs, for when the program is ended."""
            remember_running(store, title)
            try:
                return work(Job(store.guarded(report.saving), report, warnings.append))
            finally:
                remember_running(store, None)

        self._jobs.submit(title, run, done, failed=end_failed)

    def _run(
        self,
        title: str,
        operation: Operation[..., Any, Any],
        settings: Any,
        section: str = "",
        change: str = "",
        **callbacks: Any,
    ) -> None:
        """Queue an operation as `_work`, with its ``callbacks``. A calibration that the operator
        uses although it was rejected is used. ``change``: the name under which its results can be
        undone."""
        opened = self._store

        def work(job: Job) -> Findings[Any]:
            """Run the operation."""
            used = settings
            if accepts_rejected(job.store) and hasattr(settings, "accept_rejected"):
                used = replace(settings, accept_rejected=True)
            if not change:
                return operation.run(job.store, used, job.progress, job.warn)
            with job.store.keep_replaced(operation.record.kind, "verdict") as replaced:
                try:
                    return operation.run(job.store, used, job.progress, job.warn)
                finally:  # a rejected calibration is saved too
                    if replaced:
                        self._add_change(opened, change, replaced_by(opened, replaced))

        self._work(title, work, section, **callbacks)

    def _add_change(self, store: Session, name: str, reverse: Step) -> None:
        """Add a change of a session to what can be undone, as long as that session is open."""
        with self._lock:
            if store is self.session:
                self._history.add(name, reverse)
        self._publisher.mark_changed()

    # the background

    def _queue_processing(self) -> None:
        """Queue background jobs for captures without thumbnail, frame check or pose features."""
        reader = self._session_reader
        if reader is None:
            return
        target, captures = reader.target(), reader.session.captures()
        there = {(capture.name, capture.hash) for capture in captures}
        with self._lock:  # a deleted or retaken capture that is restored is processed again
            self._queued = {key for key in self._queued if key[:2] in there}
        for capture in captures:
            key = (capture.name, capture.hash, target)
            with self._lock:
                if key in self._queued or capture.is_imported_cloud:
                    continue
                self._queued.add(key)
            self._jobs.submit(
                f"Processing {capture.name}",
                partial(self._process_capture, reader, capture),
                background=True,
            )

    def _process_capture(self, reader: SessionReader, capture: Capture, report: Reporter) -> None:
        """Make the thumbnail of a capture, check its frames, and read its features if it is a
        target pose."""
        if capture.name not in reader.session.capture_names():
            return  # deleted since
        try:
            if capture.hash not in reader.thumbnails:
                reader.thumbnails[capture.hash] = make_thumbnail(capture)
                self._note_change()
            session = reader.session.guarded(report.saving)
            report(0.0, f"reading {capture.name}")
            is_new = load_examination(session, capture.name) is None
            try:
                if reader.needs_judging(capture, reader.target()):
                    self._judge_pose(reader, session, capture)
            finally:
                if is_new:
                    for sentence in load_or_save_examination(session, capture).warnings():
                        self._warner("frames")(f"{capture.name}: {sentence}")
                    warn_of_captured(capture.name, capture, self._warner("check-exposure"))
        except (InputError, DamagedError) as error:
            reader.unreadable[capture.name, capture.hash, reader.target()] = str(error)
            raise

    def _judge_pose(self, reader: SessionReader, session: Session, capture: Capture) -> None:
        """Read the features of a target pose, examine its frames, and save both; the next pose is
        planned meanwhile."""
        target = reader.target()

        def plan_next(observation: Observation) -> None:
            """Let the next pose be planned from the features, before the frames are examined."""
            reader.add_features(capture, target, observation)
            self._note_change()

        poses = read_stored_poses(
            session, [capture.name], Board.parse(target), Smoothing(), plan_next
        )
        judged = next(poses)
        if judged.observation is None:
            self._warner("target-poses")(f"{capture.name} cannot be used: {judged.refused}")
        elif judged.note:
            self._warner("target-poses")(f"{capture.name}: {judged.note}")

    # previews

    def _switch_hands_free(self, on: bool) -> None:
        """Switch hands-free capture on or off."""
        self._hands_free.is_on = self._acquisition.is_followed = on

    def _handle_preview(self, view: PreviewView) -> None:
        """Publish an analysed preview, trigger hands-free capture, and update the brightness
        (preview thread)."""
        countdown = self._hands_free.countdown(
            view.board, not self._acquisition.idle, time.monotonic()
        )
        now = countdown is not None and countdown <= 0
        self._preview = view = replace(
            view, countdown_s=None if now else countdown, awaited=self._hands_free.awaited
        )
        if now:
            self._capture_now()
        elif self._hands_free.needs_move:
            self._follow_suggestion()
        brightness = view.brightness if self._acquisition.view().light == "white" else ""
        if brightness != self._shown.brightness:
            self.show(brightness=brightness)
        self._preview_listeners.call(view)

    def _follow_suggestion(self) -> None:
        """Move the simulated board, which nobody holds, to the pose that is suggested since the
        last capture."""
        world, session = self._scene, self._publisher.latest.content
        suggestion = session.suggestion
        if world is None or suggestion is None or session.pending_plan or session.enough:
            return
        T, before = suggestion.T_camera_board, self._suggested_at_capture
        if before is None or not np.array_equal(T, before):
            self._suggested_at_capture = T
            world.place("board", Pose(T[:3, :3].copy(), T[:3, 3].copy()))

    # snapshots

    def _build_snapshot(self, version: int, session_changed: bool) -> Snapshot:
        """Build the current snapshot without changing any state (publisher's thread)."""
        reader, choice = self._session_reader, self._choice
        rig = self._acquisition.view()
        session, space, read_failure = None, None, ""
        if reader:
            session, space, read_failure = self._read_session(reader, rig, session_changed)
        world = self._scene
        rig = replace(
            rig, simulated=world is not None, choice=choice, pages=list_needed_pages(choice or {})
        )
        live = self._live
        now = replace(
            self._shown,
            version=version,
            session=session,
            rig=rig,
            world=None
            if world is None
            else WorldView(world.standing, world.pose.matrix, world.turn_deg),
            job=self._jobs.view(),
            planning_s=self._planner.busy_s,
            notices=self._notices.all(),
            space=space,
            hands_free=self._hands_free.is_on,
            live=live.figures() if live and live.is_running else None,
            read_failure=read_failure,
            next_undo=self._history.next_undo,
            next_redo=self._history.next_redo,
        )
        return replace(now, steps=views(now))

    def _read_session(
        self, reader: SessionReader, rig: RigView, changed: bool
    ) -> tuple[SessionView | None, Space | None, str]:
        """Return (the session, its space, why reading failed); a session that cannot be read stays
        as it was."""
        before, bench, space = self._publisher.latest, self._bench, None
        session, failure = before.session, "" if changed else before.read_failure
        if session is None or session.folder != reader.session.folder:
            session, failure, changed = None, "", True
        try:
            if changed:
                session = reader.read(rig, bench.focal_px if bench else None)
            cameras = bench.rig.cameras if bench and rig.camera is not None else ()
            space = measure_space(reader.session, cameras, reader.count_frames(rig))
        except Exception as error:  # most likely files were being changed
            failure = failure or describe_failure("Reading the session", error)
        return session, space, failure

    def _follow_up(self, snapshot: Snapshot) -> None:
        """Act on a new snapshot: retry failed reads, plan the next pose, end hands-free capture."""
        session = snapshot.content
        faults = (snapshot.read_failure,) if snapshot.read_failure else session.faults
        new_faults = [fault for fault in faults if fault not in self._reported_faults]
        self._reported_faults &= set(faults)
        self._failed_reads = self._failed_reads + 1 if new_faults else 0
        if 0 < self._failed_reads < READ_ATTEMPTS:
            self._note_change()
        elif new_faults:  # each is reported once, until it can be read again
            self._reported_faults |= set(new_faults)
            for fault in new_faults:
                self._notices.add("error", fault)
        watch = Watch()
        if session.target:
            plan = session.plan
            lens, image = (plan.lens, plan.image) if plan else (None, None)
            watch = Watch(Board.parse(session.target), lens, image)
        is_new_board = watch.board != self._watcher.watch.board
        self._watcher.watch = watch
        if is_new_board:
            self._watcher.repeat()
        if session.pending_plan:
            self._planner.request(session.pending_plan)
            return
        reached, self._reached = self._reached, (session.folder, session.enough)
        if session.enough and reached != self._reached and self._hands_free.is_on:
            self._switch_hands_free(False)
            self._notices.add(
                "good", "the poses reach the wanted accuracy: hands-free capture has stopped"
            )
