"""The traditional stereo calibration of camera and projector (the Letter, eq. 1-8 and step 1)."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import cv2
import numpy as np

from slviewer.calibration.board_pose import (
    CRITERIA,
    measure_focal_spread,
    solve_device,
    to_solver_unit,
)
from slviewer.calibration.known_camera import KnownCamera, Views, solve_beside
from slviewer.calibration.next_pose import nominal_lens
from slviewer.calibration.observe import Observation
from slviewer.errors import CalibrationRejected, InputError
from slviewer.examination.findings import mirroring_remedy
from slviewer.fringe.phase import PhaseMap
from slviewer.fringe.sequence import Axis, Size
from slviewer.geometry.lens import Lens
from slviewer.geometry.polynomial import fit_slopes
from slviewer.geometry.rig import StereoRig
from slviewer.geometry.rigid import (
    Floats,
    Floats32,
    Mask,
    largest_angle_deg,
    move_points,
    transform_from_rvec,
)
from slviewer.geometry.robust import RAYLEIGH_MEDIAN
from slviewer.geometry.triangulation import depth_per_px, points_from_depth, triangulate
from slviewer.geometry.vectors import (
    finite_rows,
    lengths,
    rms,
    rms_length,
    shared_rms,
    unit_vectors,
)
from slviewer.records.calibration import Reprojection, StereoFit, describe_stereo
from slviewer.records.record import from_plain, to_plain

MIN_FEATURES = 12
MAX_FOCAL_SIGMA = 0.05
"""Above this relative uncertainty the poses did not determine a focal length."""
MAX_REPROJECTION_PX = 2.0
"""Above this the features and the model do not belong together, whatever the cause."""
ROBUST_SIGMAS = 6.0
DEVICES = ("camera", "projector")
_SAVED_KEYS = {"excluded": "left_out", "features_excluded": "features_set_aside"}
"""Keys on disk of the fields whose names differ from them."""
MIN_POSES = 3
MIN_TILT_SPREAD_DEG = 4.0
LONG_LENS = 5.0
"""Focal length, in widths of the image, from which perspective is so weak that what Brown's
polynomial lacks disturbs it: ten times the usual, it was 10 % off and stated 0.4 %."""
FORESHORTENED_DEG = 15.0
"""Difference of tilts, by the boards' shapes, with which they are not parallel."""


@dataclass(frozen=True)
class StereoModel:
    """A calibrated camera and projector with the target poses they were calibrated from.

    ``poses``: T_camera_board (4, 4) mm by pose name. ``reprojection_rms_px``: RMS length of the
    residuals of "camera", "projector" and "stereo" (both together); ``pose_rms_px``: (camera,
    projector) of each pose. ``excluded``: poses not used, with the reason. ``depth_range_mm``:
    nearest and farthest feature; None for a calibration made elsewhere. ``focal_sigma_px``:
    standard deviation of the focal length by device, or the difference of the fits with and without
    the other device where that is larger. ``features_excluded``: number of outliers
    among the features. ``residuals_px`` (n, 4): camera and projector residuals of each pose's
    features, NaN where excluded or not measured. ``fixed_camera``: the file whose lens the camera
    kept, or "".
    """

    rig: StereoRig
    board: str
    axes: tuple[Axis, ...]
    reprojection_rms_px: Mapping[str, float]
    poses: Mapping[str, Floats]
    pose_rms_px: Mapping[str, tuple[float, float]]
    excluded: Mapping[str, str]
    depth_range_mm: tuple[float, float] | None
    focal_sigma_px: Mapping[str, float]
    features_excluded: int = 0
    residuals_px: Mapping[str, Floats] = field(default_factory=dict, repr=False)
    fixed_camera: str = ""

    name = "stereo"

    @property
    def known_camera(self) -> KnownCamera | None:
        """The camera that was fixed; None where it was calibrated with the projector."""
        if not self.fixed_camera:
            return None
        return KnownCamera(self.rig.camera, self.fixed_camera, True, self.focal_sigma_px["camera"])

    @property
    def baseline_mm(self) -> float:
        """Distance between the two devices' centres."""
        return self.rig.baseline_mm

    @property
    def reprojection(self) -> Reprojection:
        """The residuals by pose; their pattern where the residuals themselves are at hand."""
        errors = [*self.residuals_px.values()]
        parts = zip(DEVICES, (np.s_[:2], np.s_[2:]), strict=True)
        pattern_px = {
            device: rms([shared_rms(each[:, part]) for each in errors])
            for device, part in parts
            if errors
        }
        total = {each: px for each, px in self.reprojection_rms_px.items() if each in DEVICES}
        return Reprojection("stereo", total, dict(self.pose_rms_px), pattern_px)

    @property
    def pinholes(self) -> StereoRig:
        """The rig as two pinhole cameras, which is the model itself."""
        return self.rig

    @property
    def residual_px(self) -> float:
        """Standard deviation in projector px of the features' distances from their epipolar lines.

        It holds noise and the lens distortion that Brown's polynomial lacks; 0 for a calibration
        made elsewhere.
        """
        total = self.reprojection_rms_px
        if not total:
            return 0.0
        magnification = self.rig.projector.K[1, 1] / self.rig.camera.K[1, 1]
        # of one coordinate
        return float(np.hypot(total["projector"], magnification * total["camera"]) / np.sqrt(2))

    def undistort_pairs(
        self, camera_pixels: Floats, projector_pixels: Floats
    ) -> tuple[Floats, Floats]:
        """Return the undistorted normalised coordinates (n, 2) of camera pixels (n, 2) and of
        projector pixels (n, 2).

        NaN where the inversion of the distortion fails.
        """
        return self.rig.camera.undistort(camera_pixels), self.rig.projector.undistort(
            projector_pixels
        )

    @property
    def device_rays(self) -> tuple[Floats, Floats]:
        """Undistorted normalised coordinates (h, w, 2) of each pixel of both devices."""
        return self.rig.camera.rays(), self.rig.projector.rays()

    def points(self, phase: PhaseMap) -> Floats32:
        """Triangulate the absolute phase of one axis (eq. 6-8, with exact inversion of the
        projector's distortion).

        Returns points (h, w, 3) float32 mm in the camera's frame; NaN where the phase is invalid.
        """
        z = triangulate(self.rig, phase.coordinate, phase.axis)
        return points_from_depth(self.rig.camera.rays(), z)

    def sigma_z(self, phase: PhaseMap, points: Floats32) -> Floats32:
        """Predict the standard deviation of depth (h, w) mm from the phase noise, ``|dz/dphi|
        sigma_phi``."""
        z = points[..., 2].astype(float)
        per_rad = depth_per_px(self.rig, phase.axis, z) * phase.period_px / (2 * np.pi)
        return (per_rad * phase.sigma_phase).astype(np.float32)

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON, without the residuals; ``from_dict`` is the inverse."""
        data: dict[str, Any] = to_plain(replace(self, residuals_px={}))
        del data["residuals_px"]
        return {_SAVED_KEYS.get(name, name): value for name, value in data.items()}

    def describe(self) -> StereoFit:
        """Return the figures of the fit."""
        pattern_px = self.reprojection.pattern_px
        return from_plain(describe_stereo(self.to_dict()) | {"pattern_px": pattern_px}, StereoFit)

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> "StereoModel":
        """Return the model that ``to_dict`` saved. Raises InputError that names an invalid
        field."""
        names = {key: name for name, key in _SAVED_KEYS.items()}
        return from_plain({names.get(key, key): value for key, value in data.items()}, cls)

    @classmethod
    def from_rig(cls, rig: StereoRig) -> "StereoModel":
        """Return a model of a rig that was calibrated elsewhere: no poses, no residuals, no
        calibrated depths."""
        return cls(rig, "", ("x", "y"), {}, {}, {}, {}, None, {})


def calibrate_stereo(
    observations: Sequence[Observation],
    projector_size: Size,
    board: str = "",
    excluded: Mapping[str, str] | None = None,
    *,
    strict: bool = True,
    camera: KnownCamera | None = None,
) -> StereoModel:
    """Calibrate camera and projector, pinhole and Brown (k1 k2 p1 p2 k3) each, and their relative
    pose (step 1).

    ``board``: its notation, stored with the model. ``excluded``: poses that were excluded before,
    with the reason. ``camera``: a known one, where its fit starts; one that is fixed stays, and
    boards may be parallel then. Features beyond 6 robust sigma are excluded, and so is a pose most
    of whose features are. Raises CalibrationRejected where the poses cannot determine the devices:
    too few, all parallel, or features that contradict the model. ``strict=False`` skips these
    checks and the exclusion of outliers, for diagnosis only; it raises CalibrationRejected only
    where OpenCV finds no solution.
    """
    excluded = dict(excluded or {})
    inliers: dict[str, Mask] = {}
    for observation in observations:
        measured = finite_rows(observation.projector, observation.camera)
        if len(observation.surfaces) < 2:
            only = ", ".join(observation.surfaces)
            excluded[observation.name] = (
                f"holds the {only} axis alone: a calibration pose needs both x and y"
            )
        elif measured.sum() < MIN_FEATURES:
            excluded[observation.name] = (
                f"{measured.sum()} of {len(measured)} features carry both projector coordinates: "
                "illuminate the whole board"
            )
        else:
            inliers[observation.name] = measured
    used = [o for o in observations if o.name in inliers]
    check_pose_count(len(used), excluded)
    if strict:
        check_handedness(used)
        check_tilts(used, camera)

    for remaining in range(4, -1, -1):
        model = _solve(used, inliers, projector_size, strict, camera)
        # a diagnosis keeps all features
        outliers = _detect_outliers(model) if strict and remaining else {}
        if not outliers:
            break
        for name, is_outlier in outliers.items():
            inliers[name] = inliers[name] & ~is_outlier
            if inliers[name].sum() < max(MIN_FEATURES, 0.5 * len(is_outlier)):
                excluded[name] = (
                    f"{is_outlier.sum()} of {len(is_outlier)} features disagree with the other"
                    " poses: was the board moved during the capture, or its grid shifted?"
                )
                used = [o for o in used if o.name != name]
        check_pose_count(len(used), excluded)
    if strict:
        _check_agreement(model)
    return replace(model, board=board, excluded=excluded)


def _solve(
    used: Sequence[Observation],
    inliers: Mapping[str, Mask],
    projector_size: Size,
    strict: bool,
    camera: KnownCamera | None,
) -> StereoModel:
    """Solve the rig from the inlier features, beside a fixed camera, or else both devices.

    Raises CalibrationRejected where OpenCV finds no solution or a focal length is not positive,
    and if ``strict`` where one is too uncertain.
    """
    views = [
        (o.points[inlier], o.camera[inlier], o.projector[inlier])
        for o, inlier in ((o, inliers[o.name]) for o in used)
    ]
    if camera is not None and camera.is_fixed:
        rig, placed, projector_sigma = solve_beside(camera, views, projector_size)
        sigma = {"camera": camera.focal_sigma_px, "projector": projector_sigma}
        if strict:
            _check_focal("projector", projector_sigma, rig.projector.K)
    else:
        rig, placed, sigma = _solve_both(views, (used[0].size, projector_size), strict, camera)
    poses = {o.name: T for o, T in zip(used, placed, strict=True)}
    residuals, depths = {}, []
    for o in used:
        X = move_points(poses[o.name], o.points)
        measured = np.hstack([o.camera, o.projector])
        errors = measured - np.hstack([rig.camera.project(X), rig.project(X)])
        residuals[o.name] = np.where(inliers[o.name][:, None], errors, np.nan)
        depths.append(X[:, 2])
    z = np.concatenate(depths)
    total = dict(zip(DEVICES, _device_rms(np.concatenate([*residuals.values()])), strict=True))
    total["stereo"] = float(np.sqrt((total["camera"] ** 2 + total["projector"] ** 2) / 2))
    return StereoModel(
        rig=rig,
        board="",
        axes=("x", "y"),
        reprojection_rms_px=total,
        poses=poses,
        pose_rms_px={name: _device_rms(each) for name, each in residuals.items()},
        excluded={},
        depth_range_mm=(float(z.min()), float(z.max())),
        focal_sigma_px=sigma,
        features_excluded=int(sum((~inliers[name]).sum() for name in residuals)),
        residuals_px=residuals,
        fixed_camera=camera.name if camera is not None and camera.is_fixed else "",
    )


def _solve_both(
    views: Views,
    sizes: tuple[Size, Size],
    strict: bool,
    camera: KnownCamera | None,
) -> tuple[StereoRig, list[Floats], dict[str, float]]:
    """Solve each device by itself, then both together with their relative pose.

    Returns the rig, T_camera_board (4, 4) mm of each pose, and the focal lengths' standard
    deviations; raises as ``_solve``.
    """
    points, cameras, projectors = (
        [each.astype(np.float32) for each in arrays] for arrays in zip(*views, strict=True)
    )
    objects, unit = to_solver_unit(points)
    sigma: dict[str, float] = {}
    intrinsics = []
    starts = None if camera is None else camera.lens, None
    for device, images, size, start in zip(
        DEVICES, (cameras, projectors), sizes, starts, strict=True
    ):
        solved = solve_device(device, points, images, size, start)
        sigma[device] = max(solved.focal_sigma_px)
        if solved.K[0, 0] > LONG_LENS * max(size):
            lens = _make_lens(solved.K, solved.D, size)
            spread = measure_focal_spread(points, images, lens)
            sigma[device] = max(sigma[device], spread * float(solved.K[0, 0]))
        if strict:
            _check_focal(device, sigma[device], solved.K)
        intrinsics += [solved.K, solved.D]
    K_c, D_c, K_p, D_p = intrinsics
    alone = [np.diag(K).copy() for K in (K_c, K_p)]  # OpenCV overwrites both
    _, K_c, D_c, K_p, D_p, R, T, _, _, rvecs, tvecs, _ = cv2.stereoCalibrateExtended(
        objects,
        cameras,
        projectors,
        K_c,
        D_c,
        K_p,
        D_p,
        sizes[0],
        np.eye(3),
        np.zeros((3, 1)),
        flags=cv2.CALIB_USE_INTRINSIC_GUESS,
        criteria=CRITERIA,
    )
    for device, f, K in zip(DEVICES, alone, (K_c, K_p), strict=True):
        if not min(K[0, 0], K[1, 1]) > 0:
            raise CalibrationRejected(
                f"the poses give the {device} focal lengths of {K[0, 0]:.0f}, {K[1, 1]:.0f} px, as"
                " no lens has",
                "check the target's notation, the projector's size, the fringe period, and that x"
                " and y are not exchanged",
            )
        # systematic errors, which the standard deviations lack, change the two fits differently
        change = np.abs(f / np.diag(K) - 1).max()
        sigma[device] = max(sigma[device], float(change * min(K[0, 0], K[1, 1])))
    lenses = _make_lens(K_c, D_c, sizes[0]), _make_lens(K_p, D_p, sizes[1])
    rig = StereoRig(*lenses, R, unit * T)
    poses = [transform_from_rvec(r, unit * t) for r, t in zip(rvecs, tvecs, strict=True)]
    return rig, poses, sigma


def _make_lens(K: np.ndarray, D: np.ndarray, size: Size) -> Lens:
    """Return a lens; raises CalibrationRejected where it cannot be, as of boards without
    perspective, whose focal length is infinite."""
    try:
        return Lens(K, D, size)
    except InputError as error:
        raise CalibrationRejected(
            f"the poses give a device a lens that cannot be ({error.observation})",
            "tilt the board by 15 to 30 degrees in different directions, and use lenses with"
            " perspective",
        ) from error


def _check_focal(device: str, sigma_px: float, K: Floats) -> None:
    """Raise CalibrationRejected where a focal length is too uncertain."""
    relative = sigma_px / float(min(K[0, 0], K[1, 1]))
    if not relative < MAX_FOCAL_SIGMA:
        raise CalibrationRejected(
            f"the poses leave the {device}'s focal length uncertain by {100 * relative:.0f} %",
            "tilt the board by 15 to 30 degrees in different directions, and vary its distance",
        )


def _device_rms(residuals: Floats) -> tuple[float, float]:
    """Return the RMS length of the residuals (n, 4) px in the camera and in the projector."""
    return rms_length(residuals[:, :2]), rms_length(residuals[:, 2:])


def _check_agreement(model: StereoModel) -> None:
    """Raise CalibrationRejected where the reprojection error is too large or a board is behind the
    camera."""
    total = model.reprojection_rms_px
    if total["stereo"] > MAX_REPROJECTION_PX:
        raise CalibrationRejected(
            f"the reprojection error is {total['stereo']:.1f} px (camera {total['camera']:.1f},"
            f" projector {total['projector']:.1f}), above {MAX_REPROJECTION_PX:g}",
            "check the target's notation, the projector's size, the fringe period, and that x and y"
            " are not exchanged",
        )
    if model.depth_range_mm is not None and model.depth_range_mm[0] <= 0:
        raise CalibrationRejected(
            "the solution puts the board behind the camera", "check the target's notation"
        )


def _detect_outliers(model: StereoModel) -> dict[str, Mask]:
    """Return the outliers (n,) bool among the inliers so far, of each pose that has some.

    An outlier's residual exceeds ROBUST_SIGMAS times the robust sigma of all features, in either
    device.
    """
    # in the camera and projector
    errors = {name: lengths(r.reshape(-1, 2, 2)) for name, r in model.residuals_px.items()}
    typical = np.nanmedian(np.concatenate([*errors.values()]), axis=0)
    limit = np.maximum(ROBUST_SIGMAS * typical / RAYLEIGH_MEDIAN, 0.05)
    outliers = {name: (each > limit).any(1) for name, each in errors.items()}
    return {name: is_outlier for name, is_outlier in outliers.items() if is_outlier.any()}


def check_pose_count(count: int, excluded: Mapping[str, str]) -> None:
    """Raise CalibrationRejected for fewer than MIN_POSES poses; the message lists the ``excluded``
    ones."""
    if count < MIN_POSES:
        why = "".join(f"; {name}: {reason}" for name, reason in excluded.items())
        raise CalibrationRejected(
            f"{count} usable pose{'s' * (count != 1)}, and at least {MIN_POSES} are needed",
            f"capture the board in more positions and tilts{why}",
        )


def check_tilts(used: Sequence[Observation], camera: KnownCamera | None) -> None:
    """Raise CalibrationRejected where all boards are nearly parallel, unless the camera is fixed.

    Parallel boards share their vanishing line and do not determine the focal length.
    """
    if camera is not None and camera.is_fixed:
        return
    spread = nominal_tilt_spread_deg(used)
    if spread < MIN_TILT_SPREAD_DEG:
        if (tilt := foreshortened_tilt_deg(used)) >= FORESHORTENED_DEG:
            raise CalibrationRejected(*describe_telecentric(tilt))
        raise CalibrationRejected(
            f"all {len(used)} poses are nearly parallel (tilts differ by {spread:.1f} degrees)",
            "tilt the board by 15 to 30 degrees, in different directions",
        )


def nominal_tilt_spread_deg(used: Sequence[Observation]) -> float:
    """Estimate the largest angle in degrees between two boards with a nominal lens; 0 for fewer
    than two boards."""
    normals = [_nominal_normal(o, _nominal_homography(o)) for o in used]
    return largest_angle_deg(np.array(normals)) if len(normals) > 1 else 0.0


def _nominal_homography(o: Observation) -> Floats:
    """Return the homography (3, 3) from mm on the board to what a nominal lens makes of pixels."""
    H, _ = cv2.findHomography(o.points[:, :2], o.camera)
    return np.asarray(np.linalg.solve(nominal_lens(o.size).K, H))


def _nominal_normal(o: Observation, H: Floats) -> Floats:
    """Return the board's normal (3,) from the line at infinity of its homography."""
    normal = unit_vectors(np.linalg.inv(H).T @ np.array([0.0, 0.0, 1.0]))
    return np.asarray(normal * np.sign(normal[2] or 1))


def foreshortened_tilt_deg(used: Sequence[Observation]) -> float:
    """Estimate by how many degrees two boards' tilts differ at least, where their shapes show that
    and their perspective shows no tilt at all; 0 otherwise.

    A tilt t shortens the image of a board in one direction by cos t. With J the derivative of the
    image, seen along the normal that perspective shows, J J^T is then the same but for its size for
    boards that are parallel, turned in their plane or not, whatever the shape of the pixels.
    """
    shapes = []
    for o in used:
        H = _nominal_homography(o)
        normal = _nominal_normal(o, H)
        if np.degrees(np.arccos(min(normal[2], 1.0))) > MIN_TILT_SPREAD_DEG:
            return 0.0
        right = unit_vectors(np.cross([0.0, 1.0, 0.0], normal))
        seen = np.array([right, np.cross(normal, right), normal]) @ H
        x, y, depth = seen @ [*o.points[:, :2].mean(axis=0), 1.0]
        J = (seen[:2, :2] - np.outer([x, y], seen[2, :2]) / depth) / depth
        shapes.append(J @ J.T / abs(np.linalg.det(J)))
    ratios = [
        np.linalg.eigvals(np.linalg.solve(one, other)).real.max()
        for k, one in enumerate(shapes)
        for other in shapes[:k]
    ]
    return float(np.degrees(np.arccos(1 / max(*ratios, 1.0)))) if ratios else 0.0


def describe_telecentric(tilt_deg: float) -> tuple[str, str]:
    """Return what a lens without perspective does to boards whose tilts differ so much, and the
    remedy."""
    return (
        f"the boards are foreshortened as by tilts that differ by {tilt_deg:.0f} degrees, but their"
        " far sides appear no smaller than their near ones: the camera's lens is telecentric, or"
        " too long for its distance",
        "use a lens with perspective; this calibration does not know rays that are parallel",
    )


def check_handedness(used: Sequence[Observation]) -> None:
    """Raise CalibrationRejected where projector coordinates are a mirror image of the camera's in
    most poses."""
    mirrored = sum(
        _handedness(o.points, o.camera) * _handedness(o.points, o.projector) < 0 for o in used
    )
    if mirrored > len(used) / 2:
        raise CalibrationRejected(
            f"in {mirrored} of {len(used)} poses the projector's coordinates are a mirror image of"
            " what the camera sees",
            mirroring_remedy(
                "switch off the projector's rear or mirror mode, or exchange the x and y (V and H)"
                " patterns"
            ),
        )


def _handedness(points: Floats, pixels: Floats) -> float:
    """Return the determinant of the affine map from board points (n, 3) mm to pixels (n, 2):
    negative if mirrored."""
    return float(np.linalg.det(fit_slopes(points[:, :2], pixels)))
