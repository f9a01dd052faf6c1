"""What the operator's requests work on: the session, the rig, the threads, and the snapshot made of them.

Requests (`operator`) and captures (`capture_requests`) reach in here; panels do not.
"""

import shutil
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from slviewer.calibration.observe import Smoothing
from slviewer.devices.protocols import CameraSettings
from slviewer.devices.world import SimulatedWorld
from slviewer.errors import InputError, SessionError, SlviewerError
from slviewer.pipeline.check_results import Preflight
from slviewer.pipeline.frame_residuals import keep_residuals
from slviewer.pipeline.poses import judge_all
from slviewer.pipeline.rig_choice import Choice, RigSetup, SetUp, needs_page
from slviewer.pipeline.rig_presets import save_rig
from slviewer.session.capture import Capture
from slviewer.session.store import Session
from slviewer.target.board import Board
from slviewer.wizard.acquisition import Acquisition
from slviewer.wizard.diagnostics import LogKeeper
from slviewer.wizard.jobs import Jobs, Reporter
from slviewer.wizard.live_scan import Live, LiveCloud
from slviewer.wizard.notices import Notices
from slviewer.wizard.planner import Planner
from slviewer.wizard.preview_watcher import HandsFree, Watch, Watcher
from slviewer.wizard.publisher import Publisher
from slviewer.wizard.result_views import thumbnail
from slviewer.wizard.session_reader import SessionReader
from slviewer.wizard.snapshot import PreviewView, RigView, SessionView, Snapshot, Space, WorldView
from slviewer.wizard.steps import Brightness, Facts, views

SATURATED, DIM = 0.005, 0.35
"""Share of saturated pixels, and brightness of the brightest ones, from which on the operator is told."""
_PATIENCE = 20  # snapshots in a row that may find the session's files in the middle of a change


class Engine:
    """Everything behind the requests. `capture_now` is called, on the watcher's thread, when hands-free has decided."""

    def __init__(self, set_up: SetUp, capture_now: Callable[[], object]) -> None:
        self._set_up, self._capture_now = set_up, capture_now
        self.lock = threading.RLock()
        self.log = LogKeeper()
        self.preview: PreviewView | None = None
        self.preview_listeners: list[Callable[[PreviewView], None]] = []
        self.live: Live | None = None  # the last one, whether it runs or not
        self.live_listeners: list[Callable[[LiveCloud], None]] = []
        self.hands_free = HandsFree()
        self.autopilot = ""
        self.bench: RigSetup | None = None
        self.preflight: Preflight | None = None  # of the rig in use
        self.not_merged = ""  # why, where the latest merge that was asked for came to nothing
        self._choice: Choice | None = None
        self._rig_fault = ""  # why the chosen rig could not even be set up
        self._reader: SessionReader | None = None
        self._session_view: SessionView | None = None
        self._unreadable = 0
        self._enough = False  # whether the poses were, when that was last known for sure
        self._queued: set[tuple[str, str]] = set()
        self._brightness: Brightness = ""
        nothing = Facts(None, RigView(), None)
        empty = Snapshot(0, None, RigView(), None, None, (), views(nothing), None, False, "")
        self.publisher = Publisher(self._make_snapshot, empty)
        self.notices = Notices(self.publisher.changed)
        self.jobs = Jobs(self.notices, self.publisher.changed)
        self._planner = Planner(lambda: self.publisher.changed(session=True))
        self.watcher = Watcher(self._seen)
        self.acquisition = Acquisition(self.notices, self.publisher.changed, self.watcher.offer)
        self.publisher.start()

    # session and rig

    @property
    def session(self) -> Session | None:
        reader = self._reader
        return None if reader is None else reader.session

    @property
    def reader(self) -> SessionReader:
        """Of the open session. Raises SessionError where none is open."""
        reader = self._reader
        if reader is None:
            raise SessionError("no session is open: open one first, or make a new one")
        return reader

    @property
    def store(self) -> Session:
        """The open session. Raises SessionError where none is open."""
        return self.reader.session

    @property
    def world(self) -> SimulatedWorld:
        """What stands before the simulated rig. Raises InputError where the rig is a real one."""
        world = self.bench.world if self.bench else None
        if world is None:
            raise InputError("only the simulated rig's things can be placed: choose it in the step Rig")
        return world

    def open_session(self, path: Path | str, rig: Choice | None = None) -> None:
        """Open another session, with `rig`, else the one that it remembers, else the one in use.

        Jobs of the session before are cancelled. Where the remembered rig is not connected, the session opens without.
        """
        with self.lock:
            if not self.acquisition.idle:
                raise InputError("a capture is on its way: wait for it, or cancel it, before another session is opened")
            before = self.session
            if before is not None and Path(path).expanduser().absolute() == before.folder:
                return
            store = Session.open_or_create(path)
            self.acquisition.unstream()
            self.jobs.cancel_all()
            self._reader, self._session_view, self._queued = SessionReader(store, self._planner), None, set()
            self._enough, self.not_merged = False, ""
            if before is not None:
                before.close()
            try:
                self._use_rig_of(store, rig)
            finally:
                self.board_changed()

    def _use_rig_of(self, store: Session, rig: Choice | None) -> None:
        choice = rig or store.decision("rig")
        if choice and choice != self._choice:
            try:
                self.use_rig(choice)
            except SlviewerError as error:
                if rig:
                    raise
                self._choice, self.bench, self.preview, self.preflight = dict(choice), None, None, None
                self._rig_fault = str(error)
                self.acquisition.use(None)
                self.notices.fail("Choosing the rig", error)
        elif self._choice is not None:
            store.decide("rig", dict(self._choice))
            if exposure := store.decision("exposure"):
                self.acquisition.apply(CameraSettings(**exposure))

    def use_rig(self, choice: Choice) -> None:
        """Use other devices from now on; chosen once more, with the delay that was measured unless the choice has one,
        and with the exposure that the session remembers for them.
        """
        with self.lock:
            store = self.session
            known = dict((store.decision("rig") if store is not None else None) or {})
            same = {**known, "settle_ms": None} == {**choice, "settle_ms": None}
            if same and "settle_ms" in known and "settle_ms" not in choice:
                choice = {**choice, "settle_ms": known["settle_ms"]}
            bench = self._set_up(choice, self._board())
            if store is not None and known != dict(choice):
                store.decide("rig", dict(choice))
            if store is not None and not same:
                store.decide("exposure", None)  # that of another camera says nothing
                store.decide("exposures", None)
                store.decide("levels", None)
            exposure = store.decision("exposure") if store is not None else None
            exposure = exposure or {key: choice[key] for key in ("exposure_ms", "gain") if choice.get(key)}
            self._choice, self.bench, self.preview, self.preflight = dict(choice), bench, None, None
            self._rig_fault = ""
            self.acquisition.use(bench.rig, CameraSettings(**exposure) if exposure else None)

    def set_delay(self, settle_ms: float) -> None:
        """Wait so long between "shown" and the grab from now on; the session remembers it with the rig."""
        with self.lock:
            if self._choice is None or self.bench is None:
                return
            self._choice = {**self._choice, "settle_ms": settle_ms}
            self.acquisition.set_delay(settle_ms)
            if self.session is not None:
                self.session.decide("rig", dict(self._choice))

    def save_rig(self, name: str, what: str) -> None:
        """Keep the rig in use, with its exposure, as one of the session's own."""
        if self._choice is None:
            raise InputError("no rig is in use: choose one in the step Rig")
        now = self.acquisition.view()
        exposure = {"exposure_ms": now.exposure_ms, "gain": now.gain}
        save_rig(self.store, name, {**self._choice, **{k: v for k, v in exposure.items() if v}}, what)

    def board_changed(self) -> None:
        """Look for the board that is now the target, stand it before a simulated rig, and judge the poses by it."""
        board, world = self._board(), self.bench.world if self.bench else None
        if board is not None and world is not None and board != world.board:
            world.print_board(board)
        self._watch()
        self.queue_unfinished()

    def space(self, frames: int | None = None) -> Space | None:
        """Free space where the session is, and what so many frames need (those of the next capture where None)."""
        store, rig = self.session, self.acquisition.view()
        if store is None:
            return None
        needed = None
        if frames is not None and rig.camera is not None and self.bench is not None:
            needed = frames * rig.camera[0] * rig.camera[1] * self.bench.rig.camera.dtype.itemsize
        return Space(shutil.disk_usage(store.folder).free, needed)

    def close(self) -> None:
        """Stop all threads, close the devices, let the session go."""
        self.acquisition.close()
        self.watcher.close()
        self.jobs.close()
        self._planner.close()
        self.publisher.close()
        with self.lock:
            if self.session is not None:
                self.session.close()
        self.log.close()

    def _board(self) -> Board | None:
        target = self._reader.target() if self._reader else ""
        return Board.parse(target) if target else None

    def _watch(self) -> None:
        view = self._session_view
        self.watcher.look_for(Watch(self._board(), view.lens if view else None))

    # the background

    def queue_unfinished(self) -> None:
        """Judge poses and make thumbnails, in the background, of whatever lacks them."""
        reader = self._reader
        if reader is None:
            return
        target = reader.target()
        for capture in reader.session.captures():
            key = (capture.hash, target)
            with self.lock:
                if key in self._queued:
                    continue
                self._queued.add(key)
            self.jobs.submit(
                f"Looking at {capture.name}",
                partial(self._finish, reader, capture),
                lambda _: self.publisher.changed(session=True),
                failed=partial(self._judging_failed, reader, capture),
                background=True,
            )

    def look_again(self, capture: Capture) -> None:
        """The same for a capture that was looked at before, and whose results are gone."""
        with self.lock:
            self._queued = {key for key in self._queued if key[0] != capture.hash}
        self.queue_unfinished()

    def _finish(self, reader: SessionReader, capture: Capture, report: Reporter) -> None:
        if capture.name not in reader.session.capture_names():
            return  # deleted since
        if not reader.has_thumbnail(capture):
            reader.add_thumbnail(capture, thumbnail(capture))
            self.publisher.changed(session=True)
        target = reader.target()
        if reader.lacks_judgement(capture, target):
            report(0.0, f"looking at {capture.name}")
            session = reader.session.guarded(report.saving)
            judged = next(judge_all(session, [capture.name], Board.parse(target), Smoothing()))
            if judged.observation is None:
                self.notices.tell("warning", f"{capture.name} cannot be used: {judged.refused}")
            self.publisher.changed(session=True)  # before what may wait
        if reader.session.state_of(f"trust/{capture.name}") != "fresh":
            for sentence in keep_residuals(reader.session.guarded(report.saving), capture.name):
                self.notices.tell("warning", f"{capture.name}: {sentence}")

    def _judging_failed(self, reader: SessionReader, capture: Capture, error: BaseException) -> None:
        self.notices.fail(f"Looking at {capture.name}", error)
        if isinstance(error, InputError):
            reader.add_unreadable(capture, str(error))
        self.publisher.changed(session=True)

    # previews

    def _seen(self, view: PreviewView) -> None:
        """A preview was looked at (on the watcher's thread)."""
        countdown = self.hands_free.countdown(view.board, not self.acquisition.idle, time.monotonic())
        now = countdown is not None and countdown <= 0
        self.preview = view = replace(view, countdown_s=None if now else countdown)
        if now:
            self._capture_now()
        brightness: Brightness = "saturated" if view.saturated > SATURATED else "dim" if view.brightest < DIM else ""
        if self.acquisition.view().light != "white":
            brightness = ""
        if brightness != self._brightness:
            self._brightness = brightness
            self.publisher.changed()
        for listener in self.preview_listeners:
            listener(view)

    def publish_live(self, cloud: LiveCloud) -> None:
        """Call every listener with a live cloud (on the live scan's thread)."""
        for listener in self.live_listeners:
            listener(cloud)

    # snapshots

    def _make_snapshot(self, version: int, session_changed: bool) -> Snapshot:
        """(On the publisher's thread.)"""
        reader, bench, rig = self._reader, self.bench, self.acquisition.view()
        if reader is not None and (session_changed or self._session_view is None):
            self._read(reader, rig, bench)
        session = self._session_view if reader is not None else None
        space = self.space(reader.frames_of_a_pose(rig) if reader is not None else None)
        choice = self._choice
        if self._rig_fault:
            rig = replace(rig, state="lost", fault=self._rig_fault)
        rig = replace(
            rig,
            simulated=bench is not None and bench.world is not None,
            choice=choice,
            page=choice is not None and needs_page(choice),
        )
        world = None
        if bench is not None and bench.world is not None:
            T, pose = np.eye(4), bench.world.pose
            T[:3, :3], T[:3, 3] = pose.R, pose.t
            world = WorldView(bench.world.standing, T, bench.world.turn_deg)
        return Snapshot(
            version=version,
            session=session,
            rig=rig,
            world=world,
            job=self.jobs.view(),
            notices=self.notices.all(),
            steps=views(Facts(session, rig, space, self._brightness)),
            space=space,
            hands_free=self.hands_free.on,
            autopilot=self.autopilot,
            preflight=self.preflight,
            live=self.live.figures() if self.live is not None and self.live.running else None,
            not_merged=self.not_merged,
        )

    def _read(self, reader: SessionReader, rig: RigView, bench: RigSetup | None) -> None:
        try:
            view = self._session_view = reader.read(rig, bench.focal_px if bench else None)
            self._unreadable = 0
            before, self._enough = self._enough, self._enough if view.planning else view.enough
            if self.hands_free.on and self._enough and not before:
                self.hands_free.on = False
                self.notices.tell("good", "the poses are enough for the accuracy wanted: hands-free has stopped")
        except (SlviewerError, OSError) as error:  # files were being changed, most likely: read them once more
            self._unreadable += 1
            if self._unreadable < _PATIENCE:
                self.publisher.changed(session=True)
            elif self._unreadable == _PATIENCE:  # told once, until it can be read again
                self.notices.fail("Reading the session", error)
        self._watch()
