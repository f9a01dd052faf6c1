"""The traditional stereo calibration of camera and projector (the Letter, eq. 1-8 and step 1)."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import cv2
import numpy as np

from slviewer.calibration.observe import Observation
from slviewer.calibration.soundness import check_enough, check_handedness, check_tilts
from slviewer.errors import CalibrationRejected
from slviewer.fringe.phase import PhaseMap
from slviewer.fringe.sequence import Axis
from slviewer.geometry.lens import Lens
from slviewer.geometry.rig import StereoRig
from slviewer.geometry.triangulation import depth_per_px, points_from_depth, triangulate
from slviewer.records import to_plain

MIN_FEATURES = 12
MAX_FOCAL_SIGMA = 0.05
"""Above this relative uncertainty the poses did not determine a focal length."""
MAX_REPROJECTION_PX = 2.0
"""Above this the features and the model do not belong together, whatever the cause."""
ROBUST_SIGMAS = 6.0
ITERATIONS = 200


@dataclass(frozen=True)
class StereoModel:
    """A calibrated camera and projector, and how well the poses agree with them.

    ``poses`` map board to camera (4, 4); ``pose_rms_px`` holds (camera, projector) reprojection RMS of each pose used;
    ``residuals_px`` (n, 4) holds camera and projector residuals of each pose's features (NaN: excluded or not read).
    """

    rig: StereoRig
    board: str
    axes: tuple[Axis, ...]
    reprojection_rms_px: Mapping[str, float]
    poses: Mapping[str, np.ndarray]
    pose_rms_px: Mapping[str, tuple[float, float]]
    left_out: Mapping[str, str]
    depth_range_mm: tuple[float, float] | None
    focal_sigma_px: Mapping[str, float]
    features_set_aside: int = 0
    residuals_px: Mapping[str, np.ndarray] = field(default_factory=dict, repr=False)

    name = "stereo"

    @property
    def baseline_mm(self) -> float:
        """Distance between the two devices' centres."""
        return float(np.linalg.norm(self.rig.t))

    @property
    def pinholes(self) -> StereoRig:
        """The rig itself."""
        return self.rig

    @property
    def residual_px(self) -> float:
        """How far, in projector px, the target poses' features miss their epipolar lines (1 sigma): lens distortion
        that Brown's polynomial lacks, and noise; 0 for a calibration made elsewhere."""
        rms = self.reprojection_rms_px
        if not rms:
            return 0.0
        magnification = self.rig.projector.K[1, 1] / self.rig.camera.K[1, 1]
        return float(np.hypot(rms["projector"], magnification * rms["camera"]) / np.sqrt(2))  # of one coordinate

    def sight(self, pixels: np.ndarray, projector: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Undistorted normalised coordinates (n, 2) of camera ``pixels`` (n, 2) and ``projector`` pixels (n, 2)."""
        return self.rig.camera.undistort(pixels), self.rig.projector.undistort(projector)

    def points(self, phase: PhaseMap) -> np.ndarray:
        """(h, w, 3) float32 mm from one axis (eq. 6-8, the distorted projection met exactly); NaN where invalid."""
        z = triangulate(self.rig, phase.coordinate, phase.axis)
        return points_from_depth(self.rig.camera.rays(), z)

    def sigma_z(self, phase: PhaseMap, points: np.ndarray) -> np.ndarray:
        """(h, w) mm: depth noise predicted from the phase noise, ``|dz/dphi| sigma_phi``."""
        z = points[..., 2].astype(float)
        per_rad = depth_per_px(self.rig, phase.axis, z) * phase.period_px / (2 * np.pi)
        return (per_rad * phase.sigma_phase).astype(np.float32)

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON, without the residuals; the inverse of `records.from_plain`."""
        data: dict[str, Any] = to_plain(replace(self, residuals_px={}))
        del data["residuals_px"]
        return data

    @classmethod
    def from_rig(cls, rig: StereoRig) -> "StereoModel":
        """A calibration of which only the rig is known: no poses, no residuals, no calibrated depths."""
        return cls(rig, "", ("x", "y"), {}, {}, {}, {}, None, {})


def calibrate_stereo(
    observations: Sequence[Observation],
    projector_size: tuple[int, int],
    board: str = "",
    left_out: Mapping[str, str] | None = None,
    *,
    strict: bool = True,
) -> StereoModel:
    """Pinhole and Brown (k1 k2 p1 p2 k3) for both devices, and their relative pose, from board features.

    Features beyond 6 robust sigma, and poses most of whose features are, are excluded and named. Raises
    CalibrationRejected where the poses cannot determine the devices: too few, all parallel, or features that
    contradict the model. Not ``strict``: a solution for diagnosis only, whatever it contradicts; raises only
    where there is none.
    """
    left_out = dict(left_out or {})
    kept: dict[str, np.ndarray] = {}
    for observation in observations:
        usable = np.isfinite(observation.projector).all(1) & np.isfinite(observation.camera).all(1)
        if len(observation.surfaces) < 2:
            only = ", ".join(observation.surfaces)
            left_out[observation.name] = f"holds the {only} axis alone: a calibration pose needs both x and y"
        elif usable.sum() < MIN_FEATURES:
            left_out[observation.name] = (
                f"{usable.sum()} of {len(usable)} features carry both projector coordinates: light the whole board"
            )
        else:
            kept[observation.name] = usable
    used = [o for o in observations if o.name in kept]
    check_enough(used, left_out)
    if strict:
        check_handedness(used)
        check_tilts(used)

    for _ in range(4):
        solution = _Solution.fit(used, [kept[o.name] for o in used], projector_size, strict)
        outliers = _find_outliers(solution, used, kept)
        if not (outliers and strict):  # a diagnosis keeps all features
            break
        for name, bad in outliers.items():
            kept[name] = kept[name] & ~bad
            if kept[name].sum() < max(MIN_FEATURES, 0.5 * len(bad)):
                left_out[name] = (
                    f"{bad.sum()} of {len(bad)} features disagree with the other poses: "
                    "was the board moved during the capture, or its grid shifted?"
                )
                used = [o for o in used if o.name != name]
        check_enough(used, left_out)
    model = solution.model(used, kept, board, left_out)
    if strict:
        _check_agreement(model)
    return model


@dataclass(frozen=True)
class _Solution:
    camera: Lens
    projector: Lens
    R: np.ndarray
    t: np.ndarray
    poses: list[tuple[np.ndarray, np.ndarray]]
    focal_sigma_px: dict[str, float]

    @classmethod
    def fit(
        cls, used: Sequence[Observation], kept: Sequence[np.ndarray], projector_size: tuple[int, int], strict: bool
    ) -> "_Solution":
        objects = [o.points[k].astype(np.float32) for o, k in zip(used, kept, strict=True)]
        cameras = [o.camera[k].astype(np.float32) for o, k in zip(used, kept, strict=True)]
        projectors = [o.projector[k].astype(np.float32) for o, k in zip(used, kept, strict=True)]
        criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, ITERATIONS, 1e-9)
        sigma: dict[str, float] = {}
        intrinsics = []
        for device, images, size in (("camera", cameras, used[0].size), ("projector", projectors, projector_size)):
            try:
                _, K, D, _, _, deviations, _, _ = cv2.calibrateCameraExtended(
                    objects, images, size, np.zeros((3, 3)), np.zeros(5), criteria=criteria
                )
            except cv2.error as error:
                raise CalibrationRejected(
                    f"the {device}'s lens could not be solved from {len(used)} poses: "
                    f"capture the board in more positions and tilts ({error.err})"
                ) from error
            sigma[device] = float(np.max(deviations.ravel()[:2]))
            relative = sigma[device] / float(min(K[0, 0], K[1, 1]))
            if strict and not relative < MAX_FOCAL_SIGMA:
                raise CalibrationRejected(
                    f"the poses leave the {device}'s focal length uncertain by {100 * relative:.0f} %: "
                    "tilt the board by 15 to 30 degrees in different directions, and vary its distance"
                )
            intrinsics.append((K, D.ravel()[:5]))
        (K_c, D_c), (K_p, D_p) = intrinsics
        _, K_c, D_c, K_p, D_p, R, T, _, _, rvecs, tvecs, _ = cv2.stereoCalibrateExtended(
            objects,
            cameras,
            projectors,
            K_c,
            D_c,
            K_p,
            D_p,
            used[0].size,
            np.eye(3),
            np.zeros((3, 1)),
            flags=cv2.CALIB_USE_INTRINSIC_GUESS,
            criteria=criteria,
        )
        for device, K in (("camera", K_c), ("projector", K_p)):
            if not min(K[0, 0], K[1, 1]) > 0:
                raise CalibrationRejected(
                    f"the poses give the {device} focal lengths of {K[0, 0]:.0f}, {K[1, 1]:.0f} px, as no lens has: "
                    "check the target's notation, the projector's size, the fringe period, and that x and y are not "
                    "exchanged"
                )
        return cls(
            Lens(np.array(K_c), np.array(D_c).ravel()[:5], used[0].size),
            Lens(np.array(K_p), np.array(D_p).ravel()[:5], projector_size),
            np.array(R),
            np.array(T).ravel(),
            [(cv2.Rodrigues(np.array(r))[0], np.array(t).ravel()) for r, t in zip(rvecs, tvecs, strict=True)],
            sigma,
        )

    @property
    def rig(self) -> StereoRig:
        return StereoRig(self.camera, self.projector, self.R, self.t)

    def residuals(self, index: int, observation: Observation) -> np.ndarray:
        """(n, 4) px: camera and projector residuals of every feature of one pose."""
        R, t = self.poses[index]
        X = observation.points @ R.T + t
        return np.hstack([observation.camera - self.camera.project(X), observation.projector - self.rig.project(X)])

    def model(
        self,
        used: Sequence[Observation],
        kept: Mapping[str, np.ndarray],
        board: str,
        left_out: Mapping[str, str],
    ) -> StereoModel:
        residuals, poses, pose_rms, depths = {}, {}, {}, []
        for i, o in enumerate(used):
            r = np.where(kept[o.name][:, None], self.residuals(i, o), np.nan)
            residuals[o.name] = r
            T = np.eye(4)
            T[:3, :3], T[:3, 3] = self.poses[i]
            poses[o.name] = T
            pose_rms[o.name] = (_rms_px(r[:, :2]), _rms_px(r[:, 2:]))
            depths.append((o.points @ T[:3, :3].T + T[:3, 3])[:, 2])
        every = np.concatenate(list(residuals.values()))
        rms = {"camera": _rms_px(every[:, :2]), "projector": _rms_px(every[:, 2:])}
        rms["stereo"] = float(np.sqrt((rms["camera"] ** 2 + rms["projector"] ** 2) / 2))
        z = np.concatenate(depths)
        return StereoModel(
            rig=self.rig,
            board=board,
            axes=("x", "y"),
            reprojection_rms_px=rms,
            poses=poses,
            pose_rms_px=pose_rms,
            left_out=left_out,
            depth_range_mm=(float(z.min()), float(z.max())),
            focal_sigma_px=self.focal_sigma_px,
            features_set_aside=int(sum((~k).sum() for name, k in kept.items() if name in poses)),
            residuals_px=residuals,
        )


def _check_agreement(model: StereoModel) -> None:
    rms = model.reprojection_rms_px
    if rms["stereo"] > MAX_REPROJECTION_PX:
        raise CalibrationRejected(
            f"the reprojection error is {rms['stereo']:.1f} px (camera {rms['camera']:.1f}, projector "
            f"{rms['projector']:.1f}), above {MAX_REPROJECTION_PX:g}: check the target's notation, the projector's "
            "size, the fringe period, and that x and y are not exchanged"
        )
    if model.depth_range_mm is not None and model.depth_range_mm[0] <= 0:
        raise CalibrationRejected("the solution puts the board behind the camera: check the target's notation")


def _rms_px(residuals: np.ndarray) -> float:
    """Root mean square length of 2-D residuals, as OpenCV reports it."""
    return float(np.sqrt(np.nanmean(np.sum(residuals**2, axis=1))))


def _find_outliers(
    solution: _Solution, used: Sequence[Observation], kept: Mapping[str, np.ndarray]
) -> dict[str, np.ndarray]:
    """Per pose, the features still in use that lie beyond ROBUST_SIGMAS of all features, in either device."""
    lengths = {}
    for i, o in enumerate(used):
        r = solution.residuals(i, o)
        lengths[o.name] = np.stack([np.hypot(r[:, 0], r[:, 1]), np.hypot(r[:, 2], r[:, 3])], axis=1)
    every = np.concatenate([lengths[o.name][kept[o.name]] for o in used])
    sigma = np.median(every, axis=0) / 1.1774  # of a Rayleigh distribution
    limit = np.maximum(ROBUST_SIGMAS * sigma, 0.05)
    outliers = {o.name: kept[o.name] & (lengths[o.name] > limit).any(1) for o in used}
    return {name: bad for name, bad in outliers.items() if bad.any()}
