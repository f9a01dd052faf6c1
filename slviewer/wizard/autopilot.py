"""Runs the whole wizard on the simulated rig, by the same requests as an operator, to show it to a newcomer."""

import threading
import time
from collections.abc import Callable
from functools import partial

import numpy as np

from slviewer.devices.world import Thing
from slviewer.errors import Cancelled, SlviewerError
from slviewer.inspection.regions import Region
from slviewer.pipeline.measured_surface import MeasuredSurface, Place
from slviewer.pipeline.measurements import add_distance, add_fit
from slviewer.simulation.boards import BoardScene
from slviewer.simulation.mesh import MeshScene
from slviewer.simulation.plans import objects, planes, spheres
from slviewer.simulation.scenes import Scene, Spheres
from slviewer.wizard.operator import Operator
from slviewer.wizard.snapshot import ScanView, Snapshot

RIG = {"driver": "simulated", "preset": "letter", "scale": 0.5, "seed": 0}
TARGET = "circles:21x16:9"
PLANE, SPHERE = "plane_04", "sphere_3"
"""Of the preset's plan, inside the calibrated depths."""
PATIENCE_S = 120.0
"""For one act."""


class Autopilot:
    """The whole wizard once. The snapshot names the current act; `before(act)` is called at the start of each."""

    def __init__(
        self,
        operator: Operator,
        *,
        poses: int = 10,
        pause_s: float = 0.0,
        before: Callable[[str], None] = lambda act: None,
    ) -> None:
        self._operator, self._before = operator, before
        self._poses, self._pause_s = poses, pause_s
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._play, name="slviewer autopilot", daemon=True)

    @property
    def running(self) -> bool:
        return self._thread.is_alive()

    def start(self) -> None:
        """Begin on a thread of its own."""
        self._thread.start()

    def stop(self) -> None:
        """Send no more requests; those under way are completed."""
        self._stopped.set()

    def _play(self) -> None:
        try:
            self.run()
            self._operator.notify("good", "autopilot has finished: every step is done")
        except Cancelled:
            self._operator.notify("info", "autopilot has stopped")
        except SlviewerError as error:
            self._operator.notify("error", f"autopilot has failed: {error}")

    def run(self) -> None:
        """Do all acts on this thread. Raises Cancelled when stopped, SlviewerError with the notice of a failed act."""
        try:
            self._operator.set_autopilot_status("Getting ready")
            self._prepare()
            self._calibrate()
            self._verify()
            self._scan()
            self._measure()
            self._act("Writing the report", self._operator.report)
        finally:
            self._operator.set_autopilot_status("")

    def _prepare(self) -> None:
        operator = self._operator
        if not self._settled().rig.simulated:
            self._act("Choosing the simulated rig", lambda: operator.choose_rig(RIG))
        if operator.wait_for(lambda s: s.rig.state == "open", PATIENCE_S) is None:
            raise SlviewerError("the simulated rig does not open")
        session = self._settled().session
        if session is None:
            raise SlviewerError("no session is open: open or create one first")
        if session.target != TARGET:
            self._act(f"Choosing the target {TARGET}", lambda: operator.choose_target(TARGET))

    def _calibrate(self) -> None:
        operator = self._operator
        tried = 0
        while (good := _good_poses(now := self._settled())) < self._poses and not (now.session and now.session.enough):
            tried += 1
            if tried > 2 * self._poses:
                raise SlviewerError(f"only {good} of {tried} poses could be used: see why the others were refused")
            session = operator.snapshot().session
            act = session.suggestion.sentence if session and session.suggestion else "Placing the board"
            self._act(act, operator.place_at_suggestion)
            self._act(f"Capturing pose {good + 1} of {self._poses}", operator.capture_pose)
        self._act("Calibrating", operator.calibrate)

    def _verify(self) -> None:
        operator = self._operator
        self._place("plane", planes()[PLANE])
        self._act("Capturing a plane", lambda: operator.capture_plane("A flat plate"))
        self._place("sphere", spheres()[SPHERE])
        self._act("Capturing a sphere", lambda: operator.capture_sphere("A sphere of 196 mm"))

    def _scan(self) -> None:
        operator = self._operator
        before = {scan.name for scan in _scans(operator.snapshot())}
        for label, scene in zip(("near", "middle", "far"), objects().values(), strict=True):
            self._place("object", scene)
            self._act(f"Scanning the object, {label}", partial(operator.capture_scan, f"Ammonite, {label}"))
        names = [scan.name for scan in _scans(operator.snapshot()) if scan.name not in before]
        self._act("Merging the three scans", lambda: operator.merge(names, names[-1]))

    def _measure(self) -> None:
        """Measure the sphere's radius and the object's width."""
        operator = self._operator
        scans = operator.snapshot().session.scans  # type: ignore[union-attr]
        sphere = next(scan.name for scan in reversed(scans) if scan.purpose == "sphere")
        region = _cap(operator.surface(sphere))
        self._act("Measuring the sphere", partial(operator.measure, sphere, add_fit, "sphere", region))
        latest = _scans(operator.snapshot())[-1].name
        a, b = _across(operator.surface(latest))
        self._act("Measuring the width of the object", partial(operator.measure, latest, add_distance, a, b))

    def _place(self, thing: Thing, scene: Scene) -> None:
        T = np.eye(4)
        if isinstance(scene, Spheres):
            T[:3, 3] = scene.centres[0]
        else:
            assert isinstance(scene, BoardScene | MeshScene)
            T[:3, :3], T[:3, 3] = scene.pose.R, scene.pose.t
        self._act(f"Placing the {thing}", lambda: self._operator.place(thing, T))

    def _act(self, act: str, request: Callable[[], bool]) -> None:
        """One request, until all that follows from it has ended."""
        self._operator.set_autopilot_status(act)
        self._before(act)
        if self._stopped.wait(self._pause_s):
            raise Cancelled("autopilot was stopped")
        last = max((notice.number for notice in self._operator.snapshot().notices), default=0)
        request()
        after = self._settled()
        for notice in after.notices:
            if notice.number > last and notice.level == "error":
                raise SlviewerError(f"{act}: {notice.text}")

    def _settled(self) -> Snapshot:
        end = time.monotonic() + PATIENCE_S
        while True:
            if self._stopped.is_set():
                raise Cancelled("autopilot was stopped")
            try:
                return self._operator.wait_until_idle(0.5)
            except SlviewerError:
                if time.monotonic() > end:
                    raise


def _good_poses(snapshot: Snapshot) -> int:
    poses = snapshot.session.poses if snapshot.session else ()
    return sum(pose.state in ("good", "used", "unused") for pose in poses)


def _cap(on: MeasuredSurface) -> Region:
    """A ball around the point nearest to the camera, of half the measured extent."""
    z = np.where(on.measured, on.points[..., 2], np.inf)
    top = on.points[np.unravel_index(int(np.argmin(z)), z.shape)]
    away = np.linalg.norm(on.points[on.measured] - top, axis=-1)
    return Region.ball(top, 0.5 * float(np.percentile(away, 95)))


def _across(on: MeasuredSurface) -> tuple[Place, Place]:
    """The two ends of the image row in which most was measured."""
    v = int(np.argmax(on.measured.sum(axis=1)))
    columns = np.flatnonzero(on.measured[v])
    return (int(columns[0]), v), (int(columns[-1]), v)


def _scans(snapshot: Snapshot) -> list[ScanView]:
    return [scan for scan in (snapshot.session.scans if snapshot.session else ()) if scan.purpose == "scan"]
