"""Runs the whole wizard on the simulated rig, by the same requests as an operator, to show it to a
newcomer."""

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from slviewer.devices.world import Thing
from slviewer.errors import Cancelled, SlviewerError
from slviewer.inspection.regions import Region
from slviewer.simulation.boards import BoardScene
from slviewer.simulation.mesh import MeshScene
from slviewer.simulation.plans import objects, planes, spheres
from slviewer.simulation.scenes import Scene, Spheres
from slviewer.wizard.operator import Operator
from slviewer.wizard.service import Service
from slviewer.wizard.snapshot import Snapshot

RIG = {"driver": "simulated", "preset": "letter", "scale": 0.5, "seed": 0}
TARGET = "circles:21x16:9"
PLANE, SPHERE = "plane_04", "sphere_3"
"""Of the preset's plan, inside the calibrated depths."""
PATIENCE_S = 300.0
"""Time limit of one act: the first ones may wait until everything is compiled."""


class Autopilot(Service):
    """Runs the whole wizard once. The snapshot names the current act; `before(act)` is called at
    the start of each.

    ``patience_s``: the time limit of one act. ``pause_s``: the pause before each.
    """

    def __init__(
        self,
        operator: Operator,
        *,
        poses: int = 10,
        pause_s: float = 0.0,
        patience_s: float = PATIENCE_S,
        before: Callable[[str], None] = lambda act: None,
    ) -> None:
        super().__init__("slviewer autopilot")
        self._operator, self._before, self._patience_s = operator, before, patience_s
        self._poses, self._pause_s = poses, pause_s

    def _serve(self) -> None:
        """Run all acts, and report completion, cancellation or failure as a notice."""
        try:
            self.run()
            self._operator.notify("good", "autopilot has finished: every step is done")
        except Cancelled:
            self._operator.notify("info", "autopilot has stopped")
        except SlviewerError as error:
            self._operator.notify("error", f"autopilot has failed: {error}")

    def run(self) -> None:
        """Do all acts on this thread. Raises Cancelled when stopped, SlviewerError with the notice
        of a failed act."""
        try:
            self._operator.show(autopilot="Getting ready")
            self._prepare()
            self._calibrate()
            self._verify()
            self._scan()
            self._measure()
            self._perform_act("Writing the report", self._operator.export, "report")
        finally:
            self._operator.show(autopilot="")

    def _prepare(self) -> None:
        """Choose the simulated rig and the target, unless they are in use. Raises SlviewerError."""
        operator = self._operator
        if not self._wait_until_settled().rig.simulated:
            self._perform_act("Choosing the simulated rig", operator.choose_rig, RIG)
        if operator.wait_for(lambda s: s.rig.state == "open", self._patience_s) is None:
            raise SlviewerError("the simulated rig does not open")
        if self._wait_until_settled().content.target != TARGET:
            self._perform_act(f"Choosing the target {TARGET}", operator.choose_target, TARGET)

    def _calibrate(self) -> None:
        """Capture suggested poses until there are enough, then calibrate. Raises SlviewerError if
        too many fail."""
        operator, tried = self._operator, 0
        while not (now := self._wait_until_settled().content).enough:
            if now.good_poses >= self._poses:
                break
            tried += 1
            if tried > 2 * self._poses:
                raise SlviewerError(
                    f"only {now.good_poses} of {tried} poses could be used",
                    "see why the others were refused",
                )
            act = now.suggestion.sentence if now.suggestion else "Placing the board"
            self._perform_act(act, operator.place_at_suggestion)
            act = f"Capturing pose {now.good_poses + 1} of {self._poses}"
            self._perform_act(act, operator.capture_pose)
        self._perform_act("Calibrating", operator.calibrate)

    def _verify(self) -> None:
        """Capture a simulated plane and a simulated sphere."""
        operator = self._operator
        self._place("plane", planes()[PLANE])
        self._perform_act("Capturing a plane", operator.capture_scan, "A flat plate", "plane")
        self._place("sphere", spheres()[SPHERE])
        self._perform_act(
            "Capturing a sphere", operator.capture_scan, "A sphere of 196 mm", "sphere"
        )

    def _scan(self) -> None:
        """Scan the simulated object at three distances, and merge the scans."""
        operator = self._operator
        before = self._list_scans("scan")
        for label, scene in objects("shown_objects").items():
            self._place("object", scene)
            self._perform_act(
                f"Scanning the object, {label}", operator.capture_scan, f"Ammonite, {label}"
            )
        names = [name for name in self._list_scans("scan") if name not in before]
        self._perform_act("Merging the three scans", operator.merge, names, names[-1])

    def _measure(self) -> None:
        """Measure the sphere's radius and the object's width."""
        operator = self._operator
        sphere, latest = self._list_scans("sphere")[-1], self._list_scans("scan")[-1]
        on = operator.surface(sphere)
        # a ball around the point nearest to the camera, its radius half the measured extent
        z = np.where(on.measured, on.points[..., 2], np.inf)
        top = on.points[np.unravel_index(int(np.argmin(z)), z.shape)]
        away = np.linalg.norm(on.points[on.measured] - top, axis=-1)
        region = Region.ball(top, 0.5 * float(np.percentile(away, 95)))
        self._perform_act("Measuring the sphere", operator.measure, sphere, "sphere", region=region)
        # the ends of the row of the image with the most measured points
        measured = operator.surface(latest).measured
        v = int(np.argmax(measured.sum(axis=1)))
        columns = np.flatnonzero(measured[v])
        ends = (int(columns[0]), v), (int(columns[-1]), v)
        self._perform_act(
            "Measuring the width of the object", operator.measure, latest, "distance", ends
        )

    def _place(self, thing: Thing, scene: Scene) -> None:
        """Request that an object be placed at its scene's pose in front of the simulated rig."""
        T = np.eye(4)
        if isinstance(scene, Spheres):
            T[:3, 3] = scene.centres[0]
        else:
            assert isinstance(scene, BoardScene | MeshScene)
            T = scene.pose.matrix
        self._perform_act(f"Placing the {thing}", self._operator.place, thing, T)

    def _perform_act(
        self, act: str, request: Callable[..., bool], *args: Any, **options: Any
    ) -> None:
        """Send one request and wait until all its work has ended. Raises SlviewerError with the
        notice of a failure."""
        self._operator.show(autopilot=act)
        self._before(act)
        with self._condition:
            if self._condition.wait_for(lambda: self._closing, self._pause_s):
                raise Cancelled("autopilot was stopped")
        last = max((notice.number for notice in self._operator.snapshot().notices), default=0)
        request(*args, **options)
        for notice in self._wait_until_settled().notices:
            if notice.number > last and notice.level == "error":
                raise SlviewerError(f"{act}: {notice.text}")

    def _list_scans(self, purpose: str) -> list[str]:
        """List the names of captures made for a purpose: scan, plane or sphere."""
        return [
            scan.name
            for scan in self._wait_until_settled().content.scans
            if scan.purpose == purpose
        ]

    def _wait_until_settled(self) -> Snapshot:
        """Wait until no work runs; returns the snapshot. Raises Cancelled when stopped,
        SlviewerError on timeout."""
        end = time.monotonic() + self._patience_s
        while True:
            if self._closing:
                raise Cancelled("autopilot was stopped")
            try:
                return self._operator.wait_until_idle(0.5)
            except SlviewerError:
                if time.monotonic() > end:
                    raise
