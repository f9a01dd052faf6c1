"""Where the target has been and should be held next, from the poses of a session, computed on a
thread of its own, as that takes about a second.

The first poses are spread by what they cover; from the third on, the rig is known well enough for
its information matrix to say which pose adds most.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from slviewer.calibration.guidance import MIN_POSES as MIN_POSES_FOR_RIG
from slviewer.calibration.guidance import (
    TRIALS,
    ExpectedNoise,
    GuidanceModel,
    estimate_rig,
    suggest_poses,
)
from slviewer.calibration.next_pose import (
    Coverage,
    Suggestion,
    approximate_pose,
    count_coverage,
    depth_range,
    describe_suggestion,
    estimated_lens,
    nominal_lens,
    projector_reach,
    suggest,
)
from slviewer.calibration.stereo import StereoModel
from slviewer.errors import InputError
from slviewer.fringe.image_area import Box, ImageArea, combine_areas
from slviewer.fringe.sequence import Size
from slviewer.geometry.lens import Lens
from slviewer.geometry.rigid import Mask
from slviewer.target.board import Board
from slviewer.wizard.service import LatestWorker, log


@dataclass(frozen=True, eq=False)
class PoseFeatures:
    """Features of one pose: `points` (n, 3) mm on the board, their `camera` and `projector` (n, 2)
    px.

    `noise_px`: noise of the projector's coordinates on bright places, px (NaN: unknown).
    `area`: the part of the camera's image that changed between the pose's frames (None: unknown).
    """

    points: np.ndarray
    camera: np.ndarray
    projector: np.ndarray
    noise_px: float = np.nan
    area: ImageArea | None = None


@dataclass(frozen=True, eq=False)
class PlanInput:
    """Input of a plan: the board, the sizes (width, height) px of both devices, the features of
    each pose that counts.

    `stereo`: calibration (None: none that can be used). `focal_px`: the lens's nominal focal
    length. `refused`: number of refused poses (as many suggestions failed and are passed over).
    `hashes`: {pose: hash of its frames}, and that of the calibration under an empty name; equal
    inputs have equal `key`.
    """

    board: Board
    camera: Size
    projector: Size
    features: Mapping[str, PoseFeatures]
    stereo: StereoModel | None = None
    focal_px: float | None = None
    refused: int = 0
    hashes: tuple[tuple[str, str], ...] = ()

    @cached_property
    def rig_key(self) -> tuple[object, ...]:
        """Hashable key of board and devices only."""
        return str(self.board), self.camera, self.projector

    @cached_property
    def key(self) -> tuple[object, ...]:
        """Hashable key of the input: equal where board, devices, poses, calibration and focal
        length are."""
        return *self.rig_key, self.hashes, self.focal_px, self.refused

    @cached_property
    def calibrated(self) -> StereoModel | None:
        """The stereo calibration, if its camera has this size; else None."""
        return self.stereo if self.stereo and self.stereo.rig.camera.size == self.camera else None

    @property
    def takes_time(self) -> bool:
        """Whether `plan_next_pose` evaluates a rig's information matrix (slow), rather than
        coverage alone."""
        return self.calibrated is not None or len(self.features) >= MIN_POSES_FOR_RIG

    @cached_property
    def area(self) -> ImageArea | None:
        """The part of the camera's image that changes; None for the whole image."""
        return combine_areas([f.area for f in self.features.values()])

    @cached_property
    def box(self) -> Box | None:
        """Box around the part of the camera's image that changes; None for the whole image."""
        area = self.area
        return None if area is None or area.bounds == (0, 0, *area.size) else area.bounds

    def crop(self, box: Box) -> "PlanInput":
        """Return the input as of a camera that has only a box of its image."""
        features = {
            name: replace(f, camera=f.camera - np.array(box[:2]), area=None)
            for name, f in self.features.items()
        }
        stereo = self.calibrated
        if stereo is not None:
            camera = _move_lens(stereo.rig.camera, box)
            stereo = replace(stereo, rig=replace(stereo.rig, camera=camera))
        size = box[2] - box[0], box[3] - box[1]
        return replace(self, camera=size, features=features, stereo=stereo)

    def initial_lens(self) -> Lens:
        """Return the nominal lens, else one estimated from the features."""
        if self.focal_px is not None:
            return nominal_lens(self.camera, self.focal_px)
        poses = self.features.values()
        return estimated_lens([f.points for f in poses], [f.camera for f in poses], self.camera)


def _move_lens(lens: Lens, box: Box) -> Lens:
    """Return the lens of a camera that has only a box of its image, the box in pixels of the
    lens's own image."""
    K = lens.K.copy()
    K[:2, 2] -= box[:2]
    return replace(lens, K=K, size=(box[2] - box[0], box[3] - box[1]))


USUAL_SIGMA = 4e-5
"""Default of the wanted sigma, as a share of the middle depth: below a single point's noise, so
that more poses would hardly improve a scan."""
MOST_PLANS = 8
"""Plans cached, so that excluding a pose and including it again does not compute one twice."""
MIN_POSES = 8
"""Fewer are never enough: errors show only where poses can be compared."""


@dataclass(frozen=True, eq=False)
class PosePlan:
    """Known poses, what they cover, and the suggestion for the next one.

    ``sigma_mm``: the 3D standard deviation that a calibration from these poses is predicted to have
    over the working volume (RMS), None before the rig is known well enough; ``sigma_next_mm``: with
    the suggested pose added. ``usual_mm``: the default of the wanted sigma. ``image`` (h, w) bool:
    the part of the camera's image that changes; None for the whole image.
    """

    lens: Lens
    poses: Mapping[str, np.ndarray]
    coverage: Coverage
    suggestion: Suggestion | None
    usual_mm: float
    sigma_mm: float | None = None
    sigma_next_mm: float | None = None
    image: Mask | None = None

    def reaches(self, wanted_mm: float) -> bool:
        """Whether the predicted sigma is at most `wanted_mm` and there are at least `MIN_POSES`
        poses."""
        return (
            self.sigma_mm is not None
            and self.sigma_mm <= wanted_mm
            and len(self.poses) >= MIN_POSES
        )

    def uncrop(self, box: Box, area: ImageArea) -> "PosePlan":
        """Return the plan of a camera's box, in pixels of its whole image, of which ``area``
        changes."""
        size = area.size
        suggestion = self.suggestion
        if suggestion is not None:
            outline = suggestion.outline_px + np.array(box[:2])
            suggestion = replace(suggestion, outline_px=outline)
        whole = -box[0], -box[1], size[0] - box[0], size[1] - box[1]
        lens = _move_lens(self.lens, whole)
        return replace(self, lens=lens, suggestion=suggestion, image=area.image)


def plan_next_pose(given: PlanInput, trials: int = TRIALS) -> PosePlan:
    """Plan the next pose by information gain, from ``trials`` drawn candidates.

    The rig is the calibrated one, else one estimated from the poses. Of the camera's image counts
    the box that changes.
    """
    if given.box and given.area:
        return plan_next_pose(given.crop(given.box), trials).uncrop(given.box, given.area)
    poses = list(given.features.values())
    if given.calibrated:
        rig, known = given.calibrated.rig, given.calibrated.poses
    else:
        rough = estimate_rig(
            [f.points for f in poses], [f.camera for f in poses], [f.projector for f in poses],
            (given.camera, given.projector),
        )  # fmt: skip
        if rough is None:
            return _plan_by_coverage(given, given.initial_lens(), {})
        rig, known = rough[0], dict(zip(given.features, rough[1], strict=True))
    spread = _plan_by_coverage(given, rig.camera, known, suggests=False)
    expected = ExpectedNoise().with_noise(
        np.array([f.noise_px for f in poses]) / given.projector[0]
    )
    try:
        guidance = suggest_poses(
            GuidanceModel(rig, given.board, expected), list(spread.poses.values()), trials
        )
    except (InputError, np.linalg.LinAlgError):
        # devices that share no view: better coverage may repair it
        guidance = None
    if guidance is None:
        return _plan_by_coverage(given, rig.camera, known)
    T = guidance.poses[given.refused % len(guidance.poses)]
    return replace(
        spread,
        suggestion=describe_suggestion(given.board, rig.camera, T),
        sigma_mm=guidance.sigma_mm,
        sigma_next_mm=guidance.sigma_next_mm,
    )


def quick_plan(given: PlanInput, before: PosePlan | None) -> PosePlan:
    """Plan the next pose by coverage alone, in a few milliseconds.

    Poses come from the calibration, else from the lens of the plan `before`, else from the initial
    lens.
    """
    if given.box and given.area:
        if before:
            before = replace(before, lens=_move_lens(before.lens, given.box))
        return quick_plan(given.crop(given.box), before).uncrop(given.box, given.area)
    if given.calibrated:
        return _plan_by_coverage(given, given.calibrated.rig.camera, given.calibrated.poses)
    if before:
        return _plan_by_coverage(given, before.lens, before.poses)
    return _plan_by_coverage(given, given.initial_lens(), {})


def _plan_by_coverage(
    given: PlanInput, lens: Lens, known: Mapping[str, np.ndarray], suggests: bool = True
) -> PosePlan:
    """Plan the next pose by coverage, with a suggestion if ``suggests``; poses (4, 4) that are not
    ``known`` are estimated with the lens."""
    poses = {}
    for name, one in given.features.items():
        T = known[name] if name in known else approximate_pose(one.points, one.camera, lens)
        if T is not None:
            poses[name] = T
    placed = list(poses.values())
    usual_mm = USUAL_SIGMA * float(np.mean(depth_range(given.board, lens)))
    by_coverage = PosePlan(
        lens,
        poses,
        count_coverage(given.board, lens, placed),
        None,
        usual_mm,
        image=given.area.image if given.area else None,
    )
    if not suggests:
        return by_coverage
    reached = None
    if poses:
        points = np.concatenate(
            [given.features[n].points @ T[:3, :3].T + T[:3, 3] for n, T in poses.items()]
        )
        projected = np.concatenate([given.features[n].projector for n in poses])
        reached = projector_reach(points, projected, given.projector)
    try:
        suggestion = suggest(given.board, lens, placed, illuminated=reached, skip=given.refused)
    except InputError:  # nothing fits into the view
        return by_coverage
    return replace(by_coverage, suggestion=suggestion)


class Planner(LatestWorker[PlanInput]):
    """Provides the best plan available; `changed()` is called, on the planner's thread, when a
    better one is ready.

    Only the latest request is computed, from so many ``trials``.
    """

    def __init__(self, changed: Callable[[], None], trials: int = TRIALS) -> None:
        self._changed, self._trials = changed, trials
        self._plans: dict[object, tuple[PosePlan, bool]] = {}  # and whether it is final
        # the last one that was computed and looked up
        self._latest: tuple[PlanInput, PosePlan] | None = None
        self._requested: object = None
        super().__init__("slviewer planner", self._compute_plan)

    def look_up(self, given: PlanInput) -> tuple[PosePlan, bool]:
        """Return (the best plan available, whether it is final). One that is not final is improved
        by `request`.

        Until then its poses are those of the last final plan for the same board and devices, and
        its suggestion and sigma are that plan's as long as poses were only added.
        """
        with self._condition:
            if cached := self._plans.get(given.key):
                if cached[1] and given.takes_time:
                    self._latest = given, cached[0]
                return cached
            latest = self._latest
        if not given.takes_time:
            return self._cache_plan(given, plan_next_pose(given, self._trials), True)
        if latest is None or latest[0].rig_key != given.rig_key:
            return self._cache_plan(given, quick_plan(given, None), False)
        earlier, plan = latest
        same = {name for name, _ in {*earlier.hashes} & {*given.hashes}}
        poses = {name: T for name, T in plan.poses.items() if name in same}
        interim = quick_plan(given, replace(plan, poses=poses))
        if earlier.features.keys() <= same:
            suggestion = plan.suggestion or interim.suggestion
            interim = replace(interim, sigma_mm=plan.sigma_mm, suggestion=suggestion)
        return self._cache_plan(given, interim, False)

    def request(self, given: PlanInput) -> None:
        """Compute the plan for this input in the background, in place of an earlier request."""
        with self._condition:
            if self._requested == given.key or self._plans.get(given.key, (None, False))[1]:
                return
            self._requested = given.key
        self.offer(given)

    def _compute_plan(self, given: PlanInput) -> None:
        """Compute the requested plan on the planner's thread and store it; an interim plan where
        computing fails."""
        if given.key != self._requested:
            return
        try:
            computed = plan_next_pose(given, self._trials)
        except Exception:  # the operator can go on without a suggestion
            log.exception("the next pose could not be computed")
            computed, _ = self.look_up(given)
        self._cache_plan(given, computed, True)
        self._changed()

    def _cache_plan(self, given: PlanInput, plan: PosePlan, final: bool) -> tuple[PosePlan, bool]:
        """Cache a plan under its input's key, dropping the oldest where the cache is full; returns
        what `look_up` does."""
        with self._condition:
            while len(self._plans) >= MOST_PLANS:
                self._plans.pop(next(iter(self._plans)))
            self._plans[given.key] = plan, final
        return plan, final
