"""Requests that concern the session, the devices, the target, and the scene of the simulated
rig."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from slviewer.devices.capture import check_exposures
from slviewer.devices.protocols import CameraSettings, Rig
from slviewer.devices.world import Thing
from slviewer.errors import InputError
from slviewer.fringe.presets import PRESETS
from slviewer.pipeline.check_results import CheckVerdict, Preflight
from slviewer.pipeline.feedback import Progress
from slviewer.pipeline.rig_choice import Choice
from slviewer.pipeline.suggest_exposure import BUDGET_S, ExposureSuggestion, suggest_exposure
from slviewer.preflight.check_rig import preflight
from slviewer.simulation.boards import Pose
from slviewer.target.board import Board
from slviewer.wizard.acquisition import LIGHTS
from slviewer.wizard.capture_requests import pose_sequence, scan_sequence
from slviewer.wizard.requests import RequestHandler, request
from slviewer.wizard.snapshot import ExposureChange, Level

_CHECKED: dict[CheckVerdict, tuple[Level, str]] = {
    "good": ("good", "the rig is ready to capture"),
    "warning": ("warning", "the rig can capture; the step Rig lists possible improvements"),
    "bad": ("error", "the rig is not ready to capture: the step Rig lists what to correct"),
    "unknown": ("warning", "the rig could not be checked: the step Rig lists the reason"),
}


class RigRequests(RequestHandler):
    """Requests about the session, the devices, the target and the patterns."""

    @request("Opening the session")
    def open_session(self, path: Path | str, rig: Choice | None = None) -> None:
        """Open or create a session for writing, with `rig`, else the one that it remembers, else
        the one in use."""
        self._engine.open_session(path, rig)

    @request("Choosing the rig")
    def choose_rig(self, choice: Choice) -> None:
        """Use other devices from now on (see `rig_choice`). The session remembers it."""
        self._engine.use_rig(choice)

    @request("Setting the exposure")
    def set_exposure(self, exposure_ms: float | None = None, gain: float | None = None) -> None:
        """Set exposure time and gain; None leaves one as it is. The snapshot has what the camera
        really uses.

        Several exposures of each capture are scaled by the same factor.
        """
        engine = self._engine
        now, session = engine.acquisition.view(), engine.session
        settings = CameraSettings(exposure_ms or now.exposure_ms, gain or now.gain)
        engine.acquisition.set_camera(settings)
        if session is None:
            return
        with engine.lock:  # dragging a slider sends requests from several threads
            before = (session.decision("exposure") or {}).get("exposure_ms") or now.exposure_ms
            session.decide("exposure", {"exposure_ms": settings.exposure_ms, "gain": settings.gain})
            several = engine.reader.exposures_ms()
            if several and exposure_ms and before:
                session.decide(
                    "exposures", check_exposures([each * exposure_ms / before for each in several])
                )

    @request("Setting the exposures")
    def set_exposures(self, exposures_ms: Sequence[float]) -> None:
        """Set several exposures, ms, for every capture, for shiny and dark parts; empty: a single
        one."""
        self._engine.store.decide(
            "exposures", check_exposures(exposures_ms) if exposures_ms else []
        )

    @request("Suggesting the exposure")
    def suggest_exposure(self, for_scan: bool = False, budget_s: float = BUDGET_S) -> None:
        """Choose, with the patterns of a pose or of a scan, exposures that measure as much as
        possible, and set them.

        The snapshot has what they measure; `undo_exposure` sets the ones before.
        """
        engine, bench = self._engine, self._engine.bench
        sequence = scan_sequence(engine) if for_scan else pose_sequence(engine)
        current_ms = engine.reader.exposures_ms()

        def work(rig: Rig, progress: Progress) -> ExposureSuggestion:
            """Take the bracket and choose."""
            return suggest_exposure(
                rig, sequence, current_ms=current_ms, budget_s=budget_s, progress=progress
            )

        def done(suggestion: ExposureSuggestion) -> None:
            """Set what was chosen, if the rig is still in use."""
            with engine.lock:
                if engine.bench is not bench:
                    return
                store, now = engine.store, engine.acquisition.view()
                before = store.decision("exposure") or {
                    "exposure_ms": now.exposure_ms,
                    "gain": now.gain,
                }
                engine.exposure_change = ExposureChange(
                    suggestion, before, engine.reader.exposures_ms()
                )
                exposures = suggestion.exposures_ms
                self._decide_exposure(
                    {"exposure_ms": exposures[0], "gain": suggestion.gain},
                    exposures if len(exposures) > 1 else (),
                )
            engine.publisher.mark_changed(session=True)
            engine.notices.add("good", suggestion.text())

        engine.acquisition.run_task("Suggesting the exposure", work, done)

    @request("Undoing the exposure")
    def undo_exposure(self) -> None:
        """Set the exposures from before the last suggestion."""
        with self._engine.lock:
            change = self._engine.exposure_change
            if change is None:
                raise InputError("no suggested exposure is set: nothing can be undone")
            self._engine.exposure_change = None
            self._decide_exposure(change.exposure_before or {}, change.exposures_before_ms)

    def _decide_exposure(
        self, exposure: Mapping[str, float | None], exposures_ms: Sequence[float]
    ) -> None:
        """Set the camera's exposure and gain, and the exposures of each capture, none for a single
        one."""
        self._engine.acquisition.set_camera(CameraSettings(**exposure))
        self._engine.store.decide("exposure", dict(exposure))
        self._engine.store.decide("exposures", list(exposures_ms))

    @request("Checking the rig")
    def check_rig(self) -> None:
        """Run the preflight, about 10 s; the snapshot has its result, and the delay that it
        measured is used."""
        engine, bench = self._engine, self._engine.bench

        def done(result: Preflight) -> None:
            """Store the result of the check, and report its verdict, if the rig is still in use."""
            if engine.set_preflight(bench, result):
                engine.notices.add(*_CHECKED[result.verdict])

        engine.acquisition.run_task(
            "Checking the rig", lambda rig, progress: preflight(rig, progress=progress), done
        )

    @request("Linearising the projector")
    def set_linear_light(self, on: bool) -> None:
        """Switch the projector's linearisation, by the table of grey levels from the rig check, on
        or off."""
        levels = self._engine.preflight.levels if self._engine.preflight else None
        if on and levels is None:
            raise InputError("no table of grey levels is measured: check the rig first")
        self._engine.store.decide("levels", list(levels) if on and levels else None)

    @request("Saving the rig")
    def save_rig(self, name: str, what: str = "") -> None:
        """Save the rig in use, with its exposure, under a name in the session, where `rig_choice`
        lists it."""
        self._engine.save_rig(name, what)

    @request("Changing the light")
    def set_light(self, light: str) -> None:
        """Set what the projector shows between captures: "white", "grey", "dark", or "pattern" to
        focus by."""
        if light not in (*LIGHTS, "pattern"):
            raise InputError(f"there is no light {light!r}: choose {', '.join(LIGHTS)} or pattern")
        bench = self._engine.bench
        if (
            light == "dark"
            and bench is not None
            and bench.reel is not None
            and not bench.reel.has_dark
        ):
            raise InputError("the recording has no dark frame: choose another light")
        self._engine.acquisition.set_light(
            light, pose_sequence(self._engine) if light == "pattern" else None
        )

    @request("Choosing the target")
    def choose_target(self, notation: str) -> None:
        """Set the board; poses captured before are evaluated again with it."""
        board, engine = Board.parse(notation), self._engine
        with engine.lock:
            before = engine.reader.target()
            engine.store.decide("target", str(board))
            try:
                engine.update_board()
            except InputError:  # a board that the simulated rig cannot show
                engine.store.decide("target", before)
                raise

    @request("Choosing the patterns")
    def choose_patterns(self, name: str) -> None:
        """Set the pattern sequence of later captures."""
        if name not in PRESETS:
            raise InputError(f"no pattern sequence is called {name!r}: use {', '.join(PRESETS)}")
        self._engine.store.decide("patterns", name)

    @request("Setting the wanted accuracy")
    def set_wanted_sigma(self, sigma_mm: float | None) -> None:
        """Set the 3D standard deviation, mm, that the suggested poses aim for; None: the
        default."""
        if sigma_mm is not None and not 0 < sigma_mm < 100:
            raise InputError(
                f"a standard deviation of {sigma_mm:g} mm is not possible: give one above 0 mm"
            )
        self._engine.store.decide("sigma_wanted_mm", sigma_mm)

    @request("Placing")
    def place(self, thing: Thing, T_camera_object: np.ndarray | None = None) -> None:
        """Place a thing of `devices.world`, such as "board" or "sphere", in front of the simulated
        rig.

        At T_camera_object (4, 4) mm, or where it was.
        """
        T = None if T_camera_object is None else np.asarray(T_camera_object, float)
        if T is not None and T.shape != (4, 4):
            raise InputError(f"a pose has the shape {T.shape}: give (4, 4)")
        self._engine.world.place(
            thing, None if T is None else Pose(T[:3, :3].copy(), T[:3, 3].copy())
        )

    @request("Placing")
    def move_object(self, distance_mm: float | None = None, turn_deg: float | None = None) -> None:
        """Move the simulated object to a distance on its ray; turn it about the vertical."""
        self._engine.world.move(distance_mm, turn_deg)

    def place_at_suggestion(self) -> bool:
        """Place the simulated board at the suggested next pose; False, with a notice, where none is
        suggested."""
        session = self._engine.publisher.refresh().session
        if session is None or session.suggestion is None:
            self._engine.notices.add(
                "error", "no pose is suggested yet: choose a rig and a target first"
            )
            return False
        return self.place("board", session.suggestion.T_camera_board)
