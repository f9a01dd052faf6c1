"""Everything that panels draw: frozen values of one moment."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np

from slviewer.calibration.next_pose import Coverage, Suggestion
from slviewer.calibration.stereo import StereoModel
from slviewer.devices.browser import PageRole
from slviewer.devices.world import Thing
from slviewer.fringe.sequence import Size
from slviewer.pipeline.capture import Space
from slviewer.pipeline.examination import Preflight
from slviewer.pipeline.operation import Stored
from slviewer.pipeline.suggest_exposure import ExposureSuggestion
from slviewer.records.calibration import PixelwiseFit, Reprojection, SplinedFit
from slviewer.records.measurement import Measurement
from slviewer.records.merge import Merge, Placement, Reconstruction
from slviewer.records.record import Record
from slviewer.records.verdict import Verdict
from slviewer.registration.refusal import Reason
from slviewer.session.capture import Purpose, TurnStep
from slviewer.session.report_details import ReportDetails
from slviewer.surface.region_of_interest import RegionOfInterest
from slviewer.wizard.pose_plan import PlanInput, PosePlan

R = TypeVar("R", bound=Record)
Level = Literal["info", "good", "warning", "error"]
PoseState = Literal["judging", "good", "refused", "excluded", "used", "unused"]
StepState = Literal["blocked", "ready", "done"]
RigState = Literal["none", "opening", "open", "lost"]
Brightness = Literal["", "saturated", "dim"]

SATURATED, DIM = 0.005, 0.35
"""Share of saturated pixels above which, and brightness of the brightest ones below which, an image
is reported."""


@dataclass(frozen=True)
class ExposureChange:
    """Exposures that were suggested and set, and what they replaced: exposure and gain as the
    session remembers them, and the exposures of each capture, none where it
    was a single one."""

    suggestion: ExposureSuggestion
    exposure_before: dict[str, float | None]
    exposures_before_ms: tuple[float, ...]


@dataclass(frozen=True)
class WrittenFile:
    """A file that was written into the exports: its `name`, and in `words` what it holds."""

    name: str
    words: str

    def summary(self) -> str:
        """Return the notice about the file."""
        return f"{self.name} is ready to download: {self.words}"


@dataclass(frozen=True)
class Notice:
    """A message for the operator; `number` increases with each. `section`: of the help's page of
    findings, or none. `file`: that it announces."""

    number: int
    level: Level
    text: str
    time: datetime
    section: str = ""
    file: WrittenFile | None = None


@dataclass(frozen=True)
class JobView:
    """The running job: the `share` done, 0 ... 1, its current `stage`, for how many seconds, and
    how many jobs wait."""

    name: str
    share: float
    stage: str
    seconds: float
    can_cancel: bool
    background: bool
    waiting: int


@dataclass(frozen=True)
class CaptureProgress:
    """A running capture: frames captured, of how many, and how many captures wait behind it.

    Other work with the devices has a `stage`, and its `frame` of `frames` are percent.
    """

    name: str
    frame: int
    frames: int
    waiting: int
    stage: str = ""


@dataclass(frozen=True)
class RigView:
    """The devices: sizes of `camera`, `projector` and `second` camera are (width, height) px; what
    a device does not report, or is not there, is None."""

    state: RigState = "none"
    name: str = ""
    simulated: bool = False
    camera: Size | None = None
    projector: Size | None = None
    second: Size | None = None
    exposure_ms: float | None = None
    gain: float | None = None
    light: str = "white"  # what the projector shows between captures
    fault: str = ""  # why it is lost
    capture: CaptureProgress | None = None
    choice: Mapping[str, Any] | None = None  # as the operator chose it
    pages: tuple[PageRole, ...] = ()  # its devices that are pages in a browser
    notes: tuple[str, ...] = ()  # settings that its camera refused
    turntable: str = ""  # its name; empty: the rig has none

    @property
    def exposure(self) -> dict[str, float | None]:
        """Its exposure and gain, as the session remembers them."""
        return {"exposure_ms": self.exposure_ms, "gain": self.gain}

    @property
    def is_idle(self) -> bool:
        """Whether it is open, and nothing is captured."""
        return self.state == "open" and self.capture is None

    @property
    def is_recorded(self) -> bool:
        """Whether its captures are those of a recording."""
        return self.choice is not None and self.choice.get("driver") == "replay"


@dataclass(frozen=True, eq=False)
class PoseView:
    """One target pose. `T_camera_board` (4, 4) mm is exact where it is "used", else approximate,
    None if unknown; `rms_px` is (camera, projector) reprojection; `thumbnail` a JPEG, empty until
    made; `board_px` (4, 2) the board's outline in the camera's px.
    """

    name: str
    state: PoseState
    why: str
    T_camera_board: np.ndarray | None
    board_px: np.ndarray | None
    rms_px: tuple[float, float] | None
    thumbnail: bytes = field(repr=False)


@dataclass(frozen=True, eq=False)
class CalibrationView:
    """The session's calibration: the `stereo` model, the residuals of the model in use where it
    has any, and what is known of the others.

    `stale` names what changed since, empty where nothing did. `pixelwise`, `splined`: their fits,
    None where there is no such model. `best` is the model in use, `recommended` the one that would
    be if the operator had not `chosen` one (empty: he has not). `rejected` is the reason why the
    calibration was, empty where it was not; `is_pinned`: it is used all the same. `scales`: {model:
    the correction of scale applied, in words}. `missing`: what the poses lack for the splined
    model, empty where they allow it.
    """

    stereo: StereoModel
    reprojection: Reprojection
    models: tuple[str, ...]
    best: str
    stale: str = ""
    pixelwise: PixelwiseFit | None = None
    recommended: str = ""
    chosen: str = ""
    rejected: str = ""
    is_pinned: bool = False
    splined: SplinedFit | None = None
    scales: Mapping[str, str] = field(default_factory=dict)
    missing: str = ""

    @property
    def label(self) -> str:
        """The model whose residuals are shown, as texts name it."""
        model = self.reprojection.model
        return model if model == self.best else f"{model}, which {self.best} refines"

    @property
    def refused(self) -> str:
        """Why later steps do not use the calibration; empty where they do."""
        return "" if self.is_pinned else self.rejected


@dataclass(frozen=True, eq=False)
class ScanView:
    """One capture that is not a target pose. `cloud`: whether it is reconstructed: no, yes, or by
    an older calibration; `label` is the operator's name for it.
    """

    name: str
    label: str
    purpose: Purpose
    created: str
    cloud: Literal["absent", "fresh", "stale"]
    figures: Reconstruction  # of the cloud
    thumbnail: bytes = field(repr=False)
    placement: Placement | None = (
        None  # among the scans that are aligned as they come; None: it was not tried
    )
    turn_step: TurnStep | None = None  # of a turn on a turntable
    edits: tuple[str, ...] = ()  # that are in effect, in words
    undone_edits: int = 0  # which can be redone

    @property
    def shape(self) -> str:
        """The capture's purpose: "scan", of an object, "plane" or "sphere"; of a recorded one also
        what its name suggests."""
        if self.purpose != "scan":
            return self.purpose
        named = (each for each in ("plane", "sphere") if self.name.lower().startswith(each))
        return next(named, "scan")

    @property
    def is_placed(self) -> bool:
        """Whether the scan is in its place beside others."""
        return self.placement is not None and self.placement.is_good


@dataclass(frozen=True)
class ExportView:
    """A file made for other programs."""

    name: str
    path: Path
    bytes: int


@dataclass(frozen=True)
class StepView:
    """One step: its `instruction`, its `problems` with their remedies, `blocked_by`: why it cannot
    be done yet, and `is_doubtful`: whether it is done, with problems of its results."""

    key: str
    title: str
    instruction: str
    state: StepState
    blocked_by: str
    problems: tuple[str, ...]
    is_doubtful: bool = False


@dataclass(frozen=True, eq=False)
class WorldView:
    """The simulated scene: the object in it, its T_camera_object (4, 4) mm, and its turn about the
    vertical."""

    standing: Thing
    T_camera_object: np.ndarray
    turn_deg: float


@dataclass(frozen=True, eq=False)
class SessionView:
    """The content of a session's files.

    `plan`: what the poses cover and where the next should be, None before the devices' sizes are
    known; while it is interim, `pending_plan` is the input of the final one. `wanted_mm`: the 3D
    standard deviation that a calibration is to reach, the operator's or a default.
    """

    folder: Path
    target: str  # notation of the board, empty until one is chosen
    patterns: str  # name of the pattern sequence
    poses: tuple[PoseView, ...] = ()
    plan: PosePlan | None = None
    pending_plan: PlanInput | None = None
    wanted_mm: float = 0.0
    calibration: CalibrationView | None = None
    verdict: Verdict | None = (
        None  # on the last attempt to calibrate, even if it gave no calibration
    )
    verdict_of_calibration: bool = True  # whether that attempt made `calibration`
    records: tuple[Stored[Any], ...] = ()  # in natural order of their names
    scans: tuple[ScanView, ...] = ()
    deleted_measurements: int = 0  # how many can be restored
    nominals: tuple[str, ...] = ()  # names of the nominal models that were uploaded
    plans: tuple[str, ...] = ()  # paths of inspection plans in the session's folder
    exports: tuple[ExportView, ...] = ()
    deleted_poses: tuple[str, ...] = ()  # what can be restored, the last deleted first
    deleted_scans: tuple[str, ...] = ()
    is_linear: bool = False  # whether patterns are corrected by the measured table of grey levels
    exposures_ms: tuple[float, ...] = ()  # of every capture; empty: a single one, the camera's
    aligns_scans: bool = False  # each new scan to those before it
    region: RegionOfInterest | None = None  # in effect where `region_is_on`
    region_is_on: bool = False
    report_details: ReportDetails = field(default_factory=ReportDetails)  # of its title page
    faults: tuple[
        str, ...
    ] = ()  # what is damaged, or no capture, and missing here, with the remedy

    @property
    def enough(self) -> bool:
        """Whether the poses, all of which are judged, reach the wanted accuracy."""
        is_judged = all(pose.state != "judging" for pose in self.poses)
        return is_judged and self.plan is not None and self.plan.reaches(self.wanted_mm)

    @property
    def good_poses(self) -> int:
        """Number of poses that a calibration can use."""
        return sum(pose.state in ("good", "used", "unused") for pose in self.poses)

    @property
    def pending_scans(self) -> tuple[str, ...]:
        """Names of the scans of objects that have no up-to-date cloud."""
        scans = (scan for scan in self.scans if scan.shape == "scan")
        return tuple(scan.name for scan in scans if scan.cloud != "fresh")

    def list_records(self, kind: type[R]) -> list[Stored[R]]:
        """Return the session's records of a kind."""
        return [each for each in self.records if isinstance(each.record, kind)]

    @property
    def measurements(self) -> tuple[Stored[Measurement], ...]:
        """The session's measurements, in the order in which they were made."""
        return tuple(self.list_records(Measurement))

    @property
    def merge(self) -> Stored[Merge] | None:
        """The current merge, the last one; None where there is none."""
        merges = self.list_records(Merge)
        return merges[-1] if merges else None

    @property
    def coverage(self) -> Coverage | None:
        """What the poses cover; None before the devices' sizes are known."""
        return None if self.plan is None else self.plan.coverage

    def restriction(self, scan: str) -> tuple[RegionOfInterest | None, tuple[str, ...]]:
        """Return what the points of a scan are restricted by: the region in effect, and its
        edits."""
        edits = next((each.edits for each in self.scans if each.name == scan), ())
        return self.region if self.region_is_on else None, edits

    @property
    def suggestion(self) -> Suggestion | None:
        """The suggested next pose; None where there is no suggestion."""
        return None if self.plan is None else self.plan.suggestion


@dataclass(frozen=True)
class LiveView:
    """A live scan: clouds computed per second, 0 before the first, and of those shown;
    `latency_ms`: the median from the start of a cloud's capture until it is sent to the screens,
    None before one was; `points` of the latest cloud, and the share of them that is `outside` the
    calibrated depths.
    """

    clouds_per_s: float
    shown_per_s: float
    latency_ms: float | None
    points: int
    outside: float = 0.0


@dataclass(frozen=True, eq=False)
class Snapshot:
    """Everything at one moment; `version` grows with each change. `session` is None until one is
    open."""

    version: int = 0
    session: SessionView | None = None
    rig: RigView = RigView()
    world: WorldView | None = None  # None for real devices
    job: JobView | None = None
    notices: tuple[Notice, ...] = ()
    steps: tuple[StepView, ...] = ()
    space: Space | None = None
    hands_free: bool = False
    autopilot: str = ""  # what it does now; empty where it is off
    preflight: Preflight | None = None  # result of the last check of the rig in use
    exposure_change: ExposureChange | None = (
        None  # the last suggestion for the rig in use, unless it was undone
    )
    live: LiveView | None = None  # None while no live scan runs
    merge_failure: str = ""  # why the last merge was refused, or failed
    merge_refusal: Reason | None = None  # that of its registration
    read_failure: str = (
        ""  # why this is not the current state: files that could not be read just now
    )
    preparing: float | None = (
        None  # share of the kernels compiled in the background; None while none are
    )
    brightness: Brightness = ""  # of the camera's image in white light
    next_undo: str = ""  # what was done last and can be undone; empty where nothing can
    next_redo: str = ""  # what was undone last
    planning_s: float = 0.0  # for so long the next pose has been computed

    @property
    def is_busy(self) -> bool:
        """Whether a job runs that the operator requested."""
        return self.job is not None and not self.job.background

    @property
    def content(self) -> SessionView:
        """The content of the session, which is empty until one is open."""
        return self.session or SessionView(Path(), "", "")

    @property
    def calibration(self) -> CalibrationView | None:
        """The session's calibration; None where there is none."""
        return self.content.calibration

    def step(self, key: str) -> StepView:
        """Return the step called `key`."""
        return next(step for step in self.steps if step.key == key)

    def pose(self, name: str) -> PoseView | None:
        """Return the pose called `name`; None where there is none."""
        return next((pose for pose in self.content.poses if pose.name == name), None)

    def scan(self, name: str) -> ScanView | None:
        """Return the scan called `name`; None where there is none."""
        return next((scan for scan in self.content.scans if scan.name == name), None)


@dataclass(frozen=True, eq=False)
class BoardSeen:
    """The board in the preview: features (n, 2) and outline (4, 2), camera px, and its approximate
    pose (4, 4) mm.

    `still_s`: seconds since it last moved; `time_s`: when the image was captured, by the monotonic
    clock.
    """

    pixels: np.ndarray
    outline: np.ndarray
    still_s: float
    T_camera_board: np.ndarray | None
    time_s: float


@dataclass(frozen=True, eq=False)
class PreviewView:
    """The latest frame as a panel shows it, apart from the snapshot since it changes many times a
    second.

    `image` (h, w) uint8 is `scale` times the camera's size. `histogram` (64,) are shares of the
    pixels by grey level. `board` is None where none is detected, and `missing` is then the reason.
    `countdown_s`: seconds until a hands-free capture, None where none is coming. `second`: what a
    second camera sees, None where there is none.
    """

    number: int
    image: np.ndarray
    scale: float
    saturated: float
    brightest: float  # 99.5th percentile, as a share of the camera's range
    histogram: np.ndarray
    board: BoardSeen | None
    missing: str
    countdown_s: float | None
    frames_per_s: float
    awaited: str = ""  # what hands-free capture waits for
    second: np.ndarray | None = None

    @property
    def brightness(self) -> Brightness:
        """Whether the image is saturated, dim, or neither."""
        return "saturated" if self.saturated > SATURATED else "dim" if self.brightest < DIM else ""
