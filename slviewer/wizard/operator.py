"""What an operator can ask for, whichever face asks: every request returns at once, and never raises.

A request that cannot be granted becomes a notice, and returns False. Devices are asked on the acquisition thread and
computing is done by the worker, so that requests may come from any thread, a browser's callbacks too.
"""

import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Protocol, TypeVar

import numpy as np

from slviewer.devices.capture import check_exposures
from slviewer.devices.protocols import CameraSettings
from slviewer.devices.world import Thing
from slviewer.errors import InputError, SlviewerError
from slviewer.fringe.presets import PRESETS
from slviewer.pipeline.calibrate import CalibrationResult
from slviewer.pipeline.check_results import CheckVerdict, Preflight
from slviewer.pipeline.export import FORMATS, What, check_export
from slviewer.pipeline.models import available, check_accepted, insist, insisted
from slviewer.pipeline.rig_choice import Choice, SetUp, set_up
from slviewer.pipeline.verify import Shape
from slviewer.preflight.run import preflight
from slviewer.session.store import Session
from slviewer.simulation.boards import Pose
from slviewer.surface.meshing import MeshingPlan
from slviewer.target.board import Board
from slviewer.wizard import diagnostics, tasks
from slviewer.wizard.acquisition import LIGHTS
from slviewer.wizard.capture_requests import sequence_for_poses, take_pose, take_scan
from slviewer.wizard.engine import Engine
from slviewer.wizard.export_files import export_file
from slviewer.wizard.import_requests import ImportRequests
from slviewer.wizard.jobs import Reporter
from slviewer.wizard.live_requests import LiveRequests
from slviewer.wizard.measure_requests import MeasureRequests
from slviewer.wizard.merge_requests import MergeRequests
from slviewer.wizard.requests import request
from slviewer.wizard.snapshot import Level, PreviewView, Snapshot
from slviewer.wizard.surfaces import Surfaces

_CHECKED: dict[CheckVerdict, tuple[Level, str]] = {
    "good": ("good", "the rig is fit to capture with"),
    "warning": ("warning", "the rig can capture, and could do better: the step Rig says how"),
    "bad": ("error", "the rig is not fit to capture with: the step Rig says what to mend"),
    "unknown": ("warning", "the rig could not be checked: the step Rig says why"),
}

T = TypeVar("T")


class Player(Protocol):
    """What makes requests by itself, on a thread of its own: the autopilot."""

    @property
    def running(self) -> bool: ...

    def start(self) -> None:
        """Begin to make requests."""

    def stop(self) -> None:
        """Make no more requests."""


class Operator(LiveRequests, MergeRequests, MeasureRequests, ImportRequests):
    """The wizard: requests in, snapshots out. Close it, or use it in a `with` block."""

    def __init__(self, session: Path | str | None = None, rig: Choice | None = None, *, set_up: SetUp = set_up) -> None:
        """Opens `session`, made where it is missing, and `rig`, by default the one that the session remembers."""
        self._engine = Engine(set_up, self.capture_pose)
        self._autopilot: Player | None = None
        self._surfaces = Surfaces()
        if session is not None:
            self.open_session(session, rig)
        elif rig is not None:
            self.choose_rig(rig)

    def __enter__(self) -> "Operator":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # looking

    @property
    def session(self) -> Session | None:
        """The open session, for reading what `result_views` offers; None where none is open."""
        return self._engine.session

    def snapshot(self) -> Snapshot:
        """The latest snapshot."""
        return self._engine.publisher.latest

    def preview(self) -> PreviewView | None:
        """The latest preview; None until there is one."""
        return self._engine.preview

    def subscribe(
        self, callback: Callable[[Snapshot], None], preview: Callable[[PreviewView], None] | None = None
    ) -> Callable[[], None]:
        """Call back with every new snapshot, and with every preview, each on one thread; returns how to stop.

        Changes that come fast are told together. A callback must return soon.
        """
        engine = self._engine
        stop = engine.publisher.listen(callback)
        with engine.lock:
            if preview is not None:
                engine.preview_listeners = [*engine.preview_listeners, preview]

        def stop_both() -> None:
            stop()
            with engine.lock:
                engine.preview_listeners = [each for each in engine.preview_listeners if each is not preview]

        return stop_both

    def wait_for(self, condition: Callable[[Snapshot], bool], timeout_s: float) -> Snapshot | None:
        """The first snapshot for which `condition` holds; None where it took longer."""
        return self._engine.publisher.wait_for(condition, timeout_s)

    def settle(self, timeout_s: float = 60.0) -> Snapshot:
        """The snapshot after all captures and jobs that were asked for, with the next pose chosen.

        Raises SlviewerError where it took longer.
        """
        engine, end = self._engine, time.monotonic() + timeout_s
        while True:
            # captures first: each asks for its jobs before it ends
            idle = self.wait_for(
                lambda now: engine.acquisition.idle and engine.jobs.idle and not (now.session and now.session.planning),
                end - time.monotonic(),
            )
            if idle is None:
                raise SlviewerError(f"there is still work to be done after {timeout_s:g} s: cancel it, or wait longer")
            now = engine.publisher.now()
            if now.session is None or not now.session.planning:
                return now

    # session and rig

    @request("Opening the session")
    def open_session(self, path: Path | str, rig: Choice | None = None) -> None:
        """Open a session for writing, or make one, with `rig`, else the one that it remembers, else the one in use."""
        self._engine.open_session(path, rig)

    @request("Choosing the rig")
    def choose_rig(self, choice: Choice) -> None:
        """Use other devices from now on; `rig_choice` says what a choice is. The session remembers it."""
        self._engine.use_rig(choice)

    @request("Setting the exposure")
    def set_exposure(self, exposure_ms: float | None = None, gain: float | None = None) -> None:
        """Set exposure time and gain; None leaves one as it is. The snapshot tells what the camera really took.

        Where captures are taken in several exposures, these become longer or shorter with it.
        """
        now, session = self._engine.acquisition.view(), self.session
        settings = CameraSettings(exposure_ms or now.exposure_ms, gain or now.gain)
        self._engine.acquisition.apply(settings)
        if session is None:
            return
        with self._engine.lock:  # a slider that is dragged asks from several threads
            before = (session.decision("exposure") or {}).get("exposure_ms") or now.exposure_ms
            session.decide("exposure", {"exposure_ms": settings.exposure_ms, "gain": settings.gain})
            several = self._engine.reader.exposures_ms()
            if several and exposure_ms and before:  # they are multiples of it
                session.decide("exposures", check_exposures([each * exposure_ms / before for each in several]))

    @request("Setting the exposures")
    def set_exposures(self, exposures_ms: Sequence[float]) -> None:
        """Take every capture in several exposures, for shiny and dark parts; empty: in a single one."""
        self._engine.store.decide("exposures", check_exposures(exposures_ms) if exposures_ms else [])

    @request("Checking the rig")
    def check_rig(self) -> None:
        """Run the preflight, some 10 s; the snapshot tells what it found, and the delay that it measured is heeded."""
        engine = self._engine
        bench = engine.bench

        def done(found: Preflight) -> None:
            with engine.lock:
                if engine.bench is not bench:  # another rig was chosen meanwhile
                    return
                engine.preflight = found
                if found.settle_ms is not None:
                    engine.set_delay(found.settle_ms)
            level, words = _CHECKED[found.verdict]
            engine.notices.tell(level, words)

        engine.acquisition.run("Checking the rig", lambda rig, progress: preflight(rig, progress=progress), done)

    @request("Linearising the projector")
    def linearise(self, on: bool) -> None:
        """Project through the table of grey levels that the check of the rig has measured, or as it is."""
        found = self._engine.preflight
        if on and (found is None or found.levels is None):
            raise InputError("no table of grey levels is measured: check the rig first")
        self._engine.store.decide("levels", list(found.levels) if on and found and found.levels else None)

    @request("Saving the rig")
    def save_rig(self, name: str, what: str = "") -> None:
        """Keep the rig in use, with its exposure, under a name in the session; `rig_presets` finds it there."""
        self._engine.save_rig(name, what)

    @request("Changing the light")
    def shine(self, light: str) -> None:
        """What the projector shows between captures: "white", "grey", "dark", or "pattern" to focus by."""
        if light not in (*LIGHTS, "pattern"):
            raise InputError(f"there is no light {light!r}: choose {', '.join(LIGHTS)} or pattern")
        bench = self._engine.bench
        if light == "dark" and bench is not None and bench.reel is not None and not bench.reel.has_dark:
            raise InputError("the recording holds no dark frame: choose another light")
        self._engine.acquisition.shine(light, sequence_for_poses(self._engine) if light == "pattern" else None)

    # target, patterns, world

    @request("Choosing the target")
    def choose_target(self, notation: str) -> None:
        """The board that will be held before the rig; poses that were captured are judged by it anew."""
        board, engine = Board.parse(notation), self._engine
        with engine.lock:
            before = engine.reader.target()
            engine.store.decide("target", str(board))
            try:
                engine.board_changed()
            except InputError:  # a board that the simulated rig cannot show
                engine.store.decide("target", before)
                raise

    @request("Choosing the patterns")
    def choose_patterns(self, name: str) -> None:
        """The pattern sequence of later captures."""
        if name not in PRESETS:
            raise InputError(f"no pattern sequence is called {name!r}: use {', '.join(PRESETS)}")
        self._engine.store.decide("patterns", name)

    @request("Setting the accuracy wanted")
    def want_sigma(self, sigma_mm: float | None) -> None:
        """Ask for poses until a calibration is predicted to be this sure of points, mm; None: what usually suffices."""
        if sigma_mm is not None and not 0 < sigma_mm < 100:
            raise InputError(f"a standard deviation of {sigma_mm:g} mm cannot be wanted: give one above 0 mm")
        self._engine.store.decide("sigma_wanted_mm", sigma_mm)

    @request("Placing")
    def place(self, thing: Thing, T_camera_thing: np.ndarray | None = None) -> None:
        """Put "board", "plane", "sphere" or "object" before the simulated rig, at T_camera_thing or where it was."""
        T = None if T_camera_thing is None else np.asarray(T_camera_thing, float)
        if T is not None and T.shape != (4, 4):
            raise InputError(f"a pose of shape {T.shape} places nothing: give (4, 4)")
        self._engine.world.place(thing, None if T is None else Pose(T[:3, :3].copy(), T[:3, 3].copy()))

    @request("Placing")
    def bring(self, distance_mm: float | None = None, turn_deg: float | None = None) -> None:
        """Move what stands before the simulated rig to a distance on its ray; turn it so far about the vertical."""
        self._engine.world.bring(distance_mm, turn_deg)

    def place_at_suggestion(self) -> bool:
        """Put the simulated board where the next pose is suggested."""
        view = self._engine.publisher.now().session
        if view is None or view.suggestion is None:
            self._engine.notices.tell("error", "no pose is suggested yet: choose a rig and a target first")
            return False
        return self.place("board", view.suggestion.T_camera_board)

    # captures

    @request("Capturing the pose")
    def capture_pose(self) -> None:
        """Capture the board where it is; it is judged in the background."""
        self._engine.hands_free.took()  # first: what cannot be captured is not tried again with every preview
        take_pose(self._engine)

    @request("Retaking the pose")
    def retake_pose(self, name: str) -> None:
        """Capture the board again in place of a pose; the old one goes to the trash once the new one is saved."""
        take_pose(self._engine, name)

    @request("Capturing the scan")
    def capture_scan(self, label: str = "") -> None:
        """Capture an object and reconstruct it; `label` is the operator's name for it, any text."""
        take_scan(self._engine, "scan", label, self.reconstruct)

    @request("Capturing the plane")
    def capture_plane(self, label: str = "") -> None:
        """Capture a flat board and compare the models on it."""
        take_scan(self._engine, "plane", label, lambda name: self.verify([name], "plane"))

    @request("Capturing the sphere")
    def capture_sphere(self, label: str = "") -> None:
        """Capture a sphere and compare the models on it."""
        take_scan(self._engine, "sphere", label, lambda name: self.verify([name], "sphere"))

    @request("Switching hands-free capture")
    def set_hands_free(self, on: bool) -> None:
        """Capture a pose by itself whenever the board is held still in a new place."""
        self._engine.hands_free.on = on

    # poses and scans

    @request("Excluding the pose")
    def exclude(self, name: str, why: str = "by hand") -> None:
        """Leave a pose out of calibrations."""
        self._engine.store.exclude(name, why)

    @request("Including the pose")
    def include(self, name: str) -> None:
        """Take a pose back in."""
        self._engine.store.include(name)

    @request("Deleting")
    def delete(self, name: str) -> None:
        """Move a capture, and what was computed from it alone, to the session's trash."""
        store = self._engine.store
        store.trash_capture(name)
        store.include(name)
        for kind in ("poses", "clouds", "verify", "trust"):
            if store.state_of(f"{kind}/{name}") != "absent":
                store.trash_result(f"{kind}/{name}")

    @request("Bringing back")
    def undelete(self, name: str) -> None:
        """Bring a deleted capture back from the trash; what was computed from it is computed again."""
        self._engine.look_again(self._engine.store.restore_capture(name))

    @request("Renaming")
    def rename(self, name: str, label: str) -> None:
        """Give a capture a name for people, any text; its files keep theirs."""
        store = self._engine.store
        store.load_capture(name)
        store.decide("names", {**(store.decision("names") or {}), name: label.strip() or name})

    # computing

    @request("Calibrating")
    def calibrate(self) -> None:
        """Calibrate from the poses that are not excluded."""
        store, target = self._engine.store, self._engine.reader.target()
        if not target:
            raise InputError("choose the target first")
        engine = self._engine

        def done(result: CalibrationResult) -> None:
            engine.notices.tell(*tasks.told_calibration(result))
            engine.publisher.changed(session=True)

        def failed(error: BaseException) -> None:
            engine.notices.fail("Calibrating", error)
            engine.publisher.changed(session=True)  # what was rejected is kept, to look into

        engine.jobs.submit(
            "Calibrating", lambda r: tasks.make_calibration(store, target, r, self._warn), done, failed=failed
        )

    @request("Comparing the models")
    def compare_models(self) -> None:
        """Measure each target pose by calibrations made without it; the best model is then recommended, and used."""
        compare = partial(tasks.compare_models, self._engine.store, warn=self._warn)
        self._submit("Comparing the models", compare, tasks.told_comparison)

    @request("Choosing the model")
    def choose_model(self, name: str) -> None:
        """Use this model from now on; empty: the one that is recommended."""
        store = self._engine.store
        if name and name not in (there := available(store)):
            raise InputError(f"the session holds no {name} calibration: choose one of {', '.join(there)}")
        store.decide("model", name or None)

    @request("Using the rejected calibration")
    def use_anyway(self, on: bool) -> None:
        """Use the calibration at hand although it was rejected, or do so no more."""
        insist(self._engine.store, on)

    @request("Verifying")
    def verify(self, names: Sequence[str], shape: Shape, radius_mm: float | None = None) -> None:
        """Compare the models on captures of a plane or a sphere; `radius_mm`, roughly, helps to find a sphere."""
        store = self._engine.store
        chosen = [store.load_capture(name).name for name in names]
        measure = partial(tasks.measure, store, chosen, shape, radius_mm, warn=self._warn)
        self._submit("Verifying", measure, tasks.told_measures)

    @request("Reconstructing")
    def reconstruct(self, name: str, model: str | None = None) -> None:
        """Reconstruct a capture, by the best model unless one is named."""
        store = self._engine.store
        store.load_capture(name)
        self._submit(
            "Reconstructing",
            lambda r: tasks.make_cloud(store, name, model, r, self._warn),
            lambda points: f"{name}: {points} points",
        )

    @request("Exporting")
    def export(self, what: What, name: str = "", file_format: str = "", plan: MeshingPlan | None = None) -> None:
        """Write a file into the session's exports; `export.FORMATS` lists what there is and the formats, the first
        by default. `name` is the scan of a cloud or a mesh, and the model of coefficients; a merge is the current one.
        `plan` says how to mesh.
        """
        store, view = self._engine.store, self._engine.publisher.now().session
        chosen = file_format or FORMATS.get(what, ("",))[0]
        check_export(what, chosen)
        if what not in ("report", "table"):
            check_accepted(store, insisted(store))
        if what in ("cloud", "mesh"):
            store.load_capture(name)
        if what in ("merge", "merged-mesh"):
            if view is None or view.merge is None:
                raise InputError("there is no merge yet: merge scans first")
            name = view.merge.name
        self._submit(
            "Exporting",
            lambda r: export_file(store, what, name, chosen, plan, r, self._warn),
            str,
        )

    def report(self) -> bool:
        """Write the HTML report into the exports."""
        return self.export("report")

    @request("Collecting diagnostics")
    def diagnostic_bundle(self) -> None:
        """Write a zip with versions, settings, logs and small previews, no frames, into the exports."""
        engine = self._engine
        store, snapshot = engine.store, engine.publisher.now()
        self._submit(
            "Collecting diagnostics",
            lambda r: diagnostics.write_bundle(store, snapshot, engine.preview, engine.log, r),
            lambda file_name: f"{file_name} is ready to download",
        )

    # stopping

    @request("Cancelling")
    def cancel(self) -> None:
        """Cancel the capture that runs, else the job; an autopilot stops too."""
        if self._autopilot is not None:
            self._autopilot.stop()
        if not self._engine.acquisition.idle:
            self._engine.acquisition.cancel()
        else:
            self._engine.jobs.cancel()

    @request("Starting autopilot")
    def start_autopilot(self, autopilot: Player) -> None:
        """Let an autopilot make the requests, until it is done or `cancel` stops it."""
        with self._engine.lock:
            if self._autopilot is not None and self._autopilot.running:
                raise InputError("an autopilot is running already: cancel it first")
            self._autopilot = autopilot
            autopilot.start()

    def show_act(self, act: str) -> None:
        """Show in the snapshot what the autopilot does now; empty when it has ended."""
        self._engine.autopilot = act
        self._engine.publisher.changed()

    def tell(self, level: Level, text: str) -> None:
        """Put a sentence of the caller's own among the notices."""
        self._engine.notices.tell(level, text)

    def close(self) -> None:
        """Stop everything and let the session go; what was captured is saved already."""
        if self._autopilot is not None:
            self._autopilot.stop()
        self._engine.close()

    # inside

    def _warn(self, text: str) -> None:
        self._engine.notices.tell("warning", text)

    def _submit(
        self,
        name: str,
        make: Callable[[Reporter], T],
        sentence: Callable[[T], str],
        failed: Callable[[BaseException], None] | None = None,
    ) -> None:
        """A job of the operator's; `sentence(result)` says how it ended, `failed(error)` is called in place of that."""

        def done(result: T) -> None:
            self._engine.notices.tell("good", sentence(result))
            self._engine.publisher.changed(session=True)

        self._engine.jobs.submit(name, make, done, failed=failed)
