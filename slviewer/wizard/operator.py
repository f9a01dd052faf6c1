"""The wizard without a browser: every request returns at once, and never raises.

A request that cannot be granted becomes a notice, and returns False. Devices are used on the
acquisition thread and the worker computes, so that requests may come from any thread, a browser's
callbacks too. Captures are requested here: of the target, of objects, planes and spheres, in short
and in live scans, on a turntable, and from files.
"""

import io
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from slviewer.devices.capture import CapturedFrames
from slviewer.devices.protocols import Rig
from slviewer.errors import InputError, SlviewerError
from slviewer.fringe.presets import short
from slviewer.fringe.sequence import PatternSequence
from slviewer.geometry import cuda_device
from slviewer.pipeline.capture import (
    FULL_TURN_DEG,
    STEPS,
    capture_sequence,
    capture_turn,
    check_space,
    depth_axis,
    missing_steps,
    next_turn,
    plan_turn,
    recorded_steps,
    save_frames,
)
from slviewer.pipeline.import_captures import (
    Role,
    describe_import,
    import_captures,
    import_opencv_calibration,
)
from slviewer.pipeline.import_cloud import import_cloud
from slviewer.pipeline.operation import Job, Progress, part
from slviewer.pipeline.rig_choice import Choice, SetUp, place_object, require_turntable, set_up
from slviewer.session import atomic
from slviewer.session.capture import Purpose, TurnStep
from slviewer.session.importers.archive import CLOUD_SUFFIXES, unpack, unpacked_size
from slviewer.session.importers.clouds import FORMATS
from slviewer.session.names import new_name, plain_name
from slviewer.session.reading import expand_user
from slviewer.wizard.engine import request
from slviewer.wizard.live_scan import LiveCloud, LiveScan
from slviewer.wizard.result_requests import ResultRequests
from slviewer.wizard.rig_requests import RigRequests
from slviewer.wizard.service import Service, Timing
from slviewer.wizard.snapshot import PreviewView, Snapshot
from slviewer.wizard.undo import Several, decide, replaced_by

IMPORTING = "Importing"
BOARD_S = 10.0
"""Age of a detection up to which the board is taken to be in view still: no image is searched while
something is captured."""
CALIBRATIONS = (".yml", ".yaml", ".xml", ".json")
UNPACKED = "import"
"""Name in the session's folder beside which an upload is unpacked: the session clears what a crash
leaves of it."""


class Operator(RigRequests, ResultRequests):
    """The wizard: requests in, snapshots out. Close it, or use it in a `with` block."""

    def __init__(
        self,
        session: Path | str | None = None,
        rig: Choice | None = None,
        *,
        set_up: SetUp = set_up,
        timing: Timing | None = None,
    ) -> None:
        """Open or create `session`, with `rig`, by default the one that the session remembers."""
        super().__init__(set_up, self.capture_pose, timing or Timing())
        self._autopilot: Service | None = None
        if session is not None:
            self.open_session(session, rig)
        elif rig is not None:
            self.choose_rig(rig)

    def __enter__(self) -> "Operator":
        """Return the operator itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the operator."""
        self.close()

    def snapshot(self) -> Snapshot:
        """Return the latest snapshot."""
        return self._publisher.latest

    def preview(self) -> PreviewView | None:
        """Return the latest preview; None until there is one."""
        return self._preview

    def watch_previews(self, seen: bool) -> None:
        """State whether somebody sees the previews; each is grabbed until this is called."""
        self._acquisition.is_seen = seen

    def subscribe(
        self,
        callback: Callable[[Snapshot], None],
        preview: Callable[[PreviewView], None] | None = None,
    ) -> Callable[[], None]:
        """Call back with every new snapshot, and with every preview, each always on the same
        thread.

        Returns a function that unsubscribes. A callback must return soon, and must not wait for
        another snapshot.
        """
        unsubscribe = ExitStack()
        unsubscribe.callback(self._publisher.listeners.add(callback))
        if preview:
            unsubscribe.callback(self._preview_listeners.add(preview))
        return unsubscribe.close

    def wait_until_idle(self, timeout_s: float = 60.0) -> Snapshot:
        """Wait until all captures, jobs and the plan of the next pose are complete; returns the
        snapshot.

        Raises SlviewerError after `timeout_s`.
        """
        end = time.monotonic() + timeout_s
        while True:
            # captures first: each submits its jobs before it ends
            idle = self.wait_for(
                lambda now: (
                    self._acquisition.idle and self._jobs.idle and not now.content.pending_plan
                ),
                end - time.monotonic(),
            )
            if idle is None:
                raise SlviewerError(
                    f"work is still running after {timeout_s:g} s", "cancel it, or wait longer"
                )
            now = self._publisher.refresh()
            if not now.content.pending_plan and self._publisher.is_current:
                return now

    @request("Cancelling")
    def cancel(self) -> None:
        """Cancel the running capture, else the running job; an autopilot stops too."""
        if self._autopilot:
            self._autopilot.stop()
        if not self._acquisition.idle:
            self._acquisition.cancel()
        else:
            self._jobs.cancel()

    @request("Starting autopilot")
    def start_autopilot(self, autopilot: Service) -> None:
        """Start an autopilot, which sends requests until it is done or `cancel` stops it."""
        with self._lock:
            if self._autopilot and self._autopilot.running:
                raise InputError("an autopilot is running already", "cancel it first")
            self._autopilot = autopilot
            autopilot.start()

    def close(self) -> None:
        """Stop everything and close the session; captures are saved already."""
        if self._autopilot:
            self._autopilot.stop()
        super().close()

    # captures

    @request("Capturing the pose")
    def capture_pose(self) -> None:
        """Capture the board where it is; its features are evaluated in the background."""
        self._capture_pose()

    @request("Retaking the pose")
    def retake_pose(self, name: str) -> None:
        """Capture the board in place of a pose; the old one goes to the trash once the new one is
        saved."""
        if self._store.load_capture(name).role != "calibration":
            raise InputError(f"{name} is not a target pose", "capture another scan instead")
        self._capture_pose(name)

    @request("Capturing the scan")
    def capture_scan(
        self, label: str = "", purpose: Purpose = "scan", *, anyway: bool = False
    ) -> None:
        """Capture an object and reconstruct it, or a flat plate or a sphere, and compare the models
        on it; these `anyway`: also while the board is in view. `label` is the operator's name for
        it, any text."""
        if purpose != "scan" and not anyway:
            self._require_no_board()
        name = self._next_name(purpose)
        self._queue_capture(
            name,
            self._scan_sequence(),
            lambda captured: self._save_scan(name, purpose, captured, label),
        )

    @request("Switching hands-free capture")
    def set_hands_free(self, on: bool) -> None:
        """Capture a pose whenever the board is held still in a new place."""
        self._switch_hands_free(on)

    def _capture_pose(self, retaken: str = "") -> None:
        """Queue the capture of a target pose, in place of the one that is retaken."""
        # first: a capture that fails is not repeated with every preview
        self._hands_free.note_capture()
        suggestion = self._publisher.latest.content.suggestion
        self._suggested_at_capture = suggestion.T_camera_board if suggestion else None
        store, target = self._store, self._reader.target()
        name = retaken or self._next_name("pose")
        if not target:
            raise InputError("choose the target first: a pose is judged by it")

        def save(captured: CapturedFrames) -> None:
            """Save the captured frames as a target pose; a retaken pose is included again."""
            save_frames(store, name, "pose", captured, board=target, force=bool(retaken))
            if retaken:
                before = next(each.place for each in store.trashed() if each.name == name)
                excluded = decide(store, "excluded", partial(store.include, name))
                back = Several([excluded, replaced_by(store, {name: before})])
                self._add_change(store, f"retake {self._label(name)}", back)
            self._queue_processing()

        self._queue_capture(name, self._pose_sequence(), save)

    def _require_no_board(self) -> None:
        """Raise InputError while the live image shows the board."""
        view, world = self._preview, self._scene
        board = view.board if view else None
        if board is None:
            return
        # the simulated rig shows another image only where its scene has changed
        is_there = world.standing == "board" if world else time.monotonic() - board.time_s < BOARD_S
        if is_there:
            raise InputError(
                "the board is in view, and would be measured",
                "take it away, or choose to capture with the board in view",
            )

    def _save_scan(
        self,
        name: str,
        purpose: Purpose,
        captured: CapturedFrames,
        label: str = "",
        turn_step: TurnStep | None = None,
    ) -> None:
        """Save captured frames with the operator's label; reconstruct a scan, and align it where
        that is wanted, or compare the models on a plane or a sphere."""
        save_frames(self._store, name, purpose, captured, turn_step=turn_step)
        if label.strip():
            self._set_label(name, label)
        self._queue_processing()
        if purpose in ("plane", "sphere"):
            self.verify([name], purpose)
            return
        self.reconstruct(name)
        if self._store.decision("align_scans"):
            self.align(name)

    def _queue_capture(
        self, name: str, sequence: PatternSequence, save: Callable[[CapturedFrames], object]
    ) -> None:
        """Queue a capture. Raises SessionError where the disk is too full."""
        reel, exposures = self._require_bench().reel, self._reader.exposures_ms()
        self._check_space(name, sequence.count_images(exposures))

        def finish(captured: CapturedFrames) -> None:
            """Save the capture, and advance a replayed recording."""
            save(captured)
            self._note_change()
            if reel:
                # the next recording may lack these
                if self._acquisition.view().light in ("dark", "pattern", "image"):
                    self._acquisition.set_light("white")
                reel.advance()

        self._acquisition.capture(name, sequence, finish, exposures)

    def _check_space(self, name: str, frames: int) -> None:
        """Raise SessionError where the disk has no room for so many frames."""
        check_space(self._store, self._require_bench().rig.cameras, frames, name)

    def _next_name(self, kind: str) -> str:
        """Return the next unused name, such as pose_07, counting saved, queued and deleted
        captures: those in the trash can come back."""
        deleted = [each.name for each in self._store.trashed() if each.is_capture]
        used = [*self._store.taken_names(), *self._acquisition.names(), *deleted]
        numbers = [name.removeprefix(f"{kind}_") for name in used]
        number = max((int(number) for number in numbers if number.isdecimal()), default=0) + 1
        return f"{kind}_{number:02d}"

    # live

    @request("Scanning live")
    def start_live(self) -> None:
        """Start a live scan, which ends at `stop_live`, a capture, another rig or session, or a
        fault."""
        calibration = self._require_calibration("a live scan needs a calibration")
        bench = self._require_bench()
        if bench.reel:
            raise InputError(
                "a recording holds only its own patterns", "choose a real rig or the simulated one"
            )
        if bench.rig.second is not None:
            raise InputError(
                "Cannot scan live",
                "it takes one camera and its projector, and this rig has two cameras. Capture scans"
                " one by one.",
            )
        axis = depth_axis(calibration.stereo.rig)
        sequence = replace(short(bench.rig.projector.size, axis), levels=self._reader.levels())
        live = LiveScan(
            self._store, axis, sequence, self._acquisition, self._notices,
            self._live_listeners.call, self._publisher.mark_changed,
        )  # fmt: skip
        live.start()
        self._live = live

    @request("Choosing the processor")
    def use_graphics_card(self, on: bool) -> None:
        """Let the graphics card compute live scans from the next one on, or the processor."""
        cuda_device.use_device(on)

    @request("Ending the live scan")
    def stop_live(self) -> None:
        """End the live scan, if one runs."""
        self._acquisition.stop_stream()

    @request("Saving the live scan")
    def save_live(self, label: str = "") -> None:
        """Save the frames of the latest live cloud as a scan, and reconstruct it; the live scan
        goes on."""
        live = self._live
        shot = live.stream.copy_latest() if live and live.is_running else None
        if live is None or shot is None:
            raise InputError("no live scan runs", "start one, and wait for a cloud")
        name = self._next_name("scan")
        self._check_space(name, len(shot.frames))
        source = self._acquisition.view().name
        captured = CapturedFrames(shot.frames, shot.settings, live.stream.sequence, source)
        self._save_scan(name, "scan", captured, label)

    @property
    def live_captures(self) -> int:
        """The number of short captures of the latest live scan, including those without a cloud."""
        return 0 if self._live is None else self._live.stream.captured

    def count_live_shown(self, cloud: LiveCloud) -> None:
        """Record that a cloud was sent to the browsers, which ends its latency."""
        if self._live:
            self._live.count_shown(cloud)

    # all round

    @request("Scanning all round")
    def scan_all_round(
        self, steps: int = STEPS, range_deg: float = FULL_TURN_DEG, *, then_merge: bool = True
    ) -> None:
        """Capture and reconstruct the steps of a turn; `then_merge` merges them and makes a
        watertight mesh."""
        self._scan_turn(plan_turn(next_turn(self._store), steps, range_deg), then_merge)

    @request("Resuming the turn")
    def resume_turn(self, *, then_merge: bool = True) -> None:
        """Capture the missing steps of the last turn."""
        self._scan_turn(missing_steps(self._store), then_merge)

    def _scan_turn(self, steps: Sequence[TurnStep], then_merge: bool) -> None:
        """Queue the capture of steps of one turn, each reconstructed while the table turns on."""
        store, sequence, turn = self._store, self._scan_sequence(), steps[0].turn
        bench = self._require_bench()
        require_turntable(bench.rig)
        exposures, recorded = self._reader.exposures_ms(), recorded_steps(store, turn)
        self._check_space(turn, sequence.count_images(exposures) * len(steps))
        place_object(bench)

        def work(rig: Rig, progress: Progress) -> None:
            """Capture all steps."""

            def capture_step(step: TurnStep, progress: Progress) -> None:
                """Capture and save one step, and queue its reconstruction."""
                captured = capture_sequence(rig, sequence, exposures, progress)
                self._save_scan(step.name, "scan", captured, turn_step=step)

            capture_turn(rig, steps, capture_step, recorded, progress, self._warner("scans"))

        def done(_: None) -> None:
            """Report the captured turn, and queue its merge."""
            names = [step.name for step in recorded_steps(store, turn)]
            self._notices.add("good", f"{turn}: {len(names)} scans all round")
            if then_merge:
                self._merge_turn(names)

        self._acquisition.run_task("Scanning all round", work, done)

    # files

    @request(IMPORTING)
    def import_folder(
        self, folder: Path | str, layout: str = "detect", role: Role = "calibration", **options: Any
    ) -> None:
        """Import the captures in a folder of this computer; `options` as `import_captures` takes
        them."""
        path = str(folder).strip()
        if not path:
            raise InputError(
                "no folder is named",
                "enter the path of a folder on the computer that runs slviewer",
            )
        self._work(
            IMPORTING,
            lambda job: self._import(job, expand_user(path), layout, role, options),
            "frames",
        )

    @request(IMPORTING)
    def import_zip(
        self,
        name: str,
        content: bytes,
        layout: str = "detect",
        role: Role = "calibration",
        **options: Any,
    ) -> None:
        """Import the captures and clouds in a zip that was uploaded as `name`; images outside of
        folders become one capture of that name."""

        def work(job: Job) -> str:
            """Unpack the zip into a temporary folder and import it."""
            archive, words = io.BytesIO(content), f"unpacking {name}"
            job.progress(0.0, words)
            place, size = job.store.folder / UNPACKED, unpacked_size(archive)
            with atomic.staged_folder(place, size) as staged:
                folder = staged / new_name(
                    plain_name(Path(name).stem, "capture").strip("._-") or "capture"
                )
                folder.mkdir()
                try:
                    unpacking = part(job.progress, 0, 0.2)
                    source, warnings = unpack(archive, folder, lambda done: unpacking(done, words))
                    for warning in warnings:
                        job.warn(warning)
                    origin = {"origin": name, **options}
                    return self._import_unpacked(job.part(0.2, 1), source, layout, role, origin)
                finally:
                    atomic.discard(staged)

        self._work(IMPORTING, work, "frames")

    @request(IMPORTING)
    def import_file(self, name: str, content: bytes) -> None:
        """Import a file of any known kind: a zip of captures, which become scans once there is a
        calibration, else target poses; a cloud or mesh as a scan; an OpenCV calibration."""
        suffix = Path(name).suffix.lower()
        if suffix == ".zip":
            role: Role = "scan" if self._publisher.latest.calibration else "calibration"
            self.import_zip(name, content, role=role)
            return
        if suffix not in (*FORMATS, *CALIBRATIONS):
            raise InputError(
                f"{name} cannot be imported",
                "drop a folder or a zip of captures, a cloud, a mesh, or a calibration of OpenCV",
            )

        def work(job: Job) -> str:
            """Write the file where an importer can read it, and import it."""
            with atomic.staged_folder(job.store.folder / UNPACKED, len(content)) as staged:
                try:
                    file = staged / (plain_name(Path(name).stem, "upload") + suffix)
                    file.write_bytes(content)
                    if suffix in CALIBRATIONS:
                        import_opencv_calibration(file, job.store, warn=job.warn)
                        return f"the calibration of {name} was imported"
                    made = import_cloud(job.store, [file], progress=job.progress, warn=job.warn)
                    return made.summary() or f"{name} was imported as a scan"
                finally:
                    atomic.discard(staged)

        self._work(IMPORTING, work)

    def _import_unpacked(
        self, job: Job, source: Path, layout: str, role: Role, options: dict[str, Any]
    ) -> str:
        """Import the clouds in an unpacked zip, then its captures; returns sentences about
        them."""
        texts = []
        files = [each for each in sorted(source.rglob("*")) if each.is_file()]
        clouds = [each for each in files if each.suffix.lower() in CLOUD_SUFFIXES]
        if clouds:
            texts.append(import_cloud(job.store, clouds, warn=job.warn).summary())
        for each in clouds:
            each.unlink()
        if len(files) > len(clouds):
            texts.append(self._import(job, source, layout, role, options))
        return "; ".join(texts)

    def _import(
        self, job: Job, source: Path, layout: str, role: Role, options: dict[str, Any]
    ) -> str:
        """Import the captures in a folder, and queue their processing; returns a sentence about
        them."""
        names = import_captures(
            source, job.store, layout, role=role, progress=job.progress, warn=job.warn, **options
        )
        self._queue_processing()
        return describe_import(names, role=role)
