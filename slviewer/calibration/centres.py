"""Correction of circle centroids to the images of the circles' centres.

Perspective and distortion separate the two by some hundredths of a pixel on a tilted board. The
shift follows from the lens and the board's pose; those of a first calibration from the centroids
are accurate enough, as their error changes the correction by 1 % only.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from slviewer.calibration.known_camera import KnownCamera
from slviewer.calibration.observe import Observation
from slviewer.calibration.stereo import StereoModel, calibrate_stereo
from slviewer.errors import InputError
from slviewer.geometry.lens import Lens
from slviewer.geometry.rigid import Floats, move_points

CORNERS = 64
"""Corners of the polygon that approximates a circle."""


def calibrate_centres(
    observations: Sequence[Observation],
    projector_size: tuple[int, int],
    board: str,
    excluded: Mapping[str, str] | None = None,
    *,
    strict: bool = True,
    camera: KnownCamera | None = None,
) -> tuple[StereoModel, list[Observation]]:
    """Run ``calibrate_stereo`` on the circles' centroids, correct these to centres, and run it
    again.

    Parameters and errors are those of ``calibrate_stereo``. Returns the model and the corrected
    observations of the poses that it used.
    """
    how: dict[str, Any] = {"strict": strict, "camera": camera}
    stereo = calibrate_stereo(observations, projector_size, board, excluded, **how)
    used = [o for o in observations if o.name in stereo.poses]
    corrected = move_to_centres(used, stereo)
    if all(new is old for new, old in zip(corrected, used, strict=True)):
        return stereo, used
    stereo = calibrate_stereo(corrected, projector_size, board, stereo.excluded, **how)
    return stereo, [o for o in corrected if o.name in stereo.poses]


def centroid_shifts(lens: Lens, T_camera_board: Floats, points: Floats, radius_mm: float) -> Floats:
    """Return the shift (n, 2) px from the image of each circle's centre to the area centroid of the
    circle's image.

    Circles of ``radius_mm`` have their centres at ``points`` (n, 3) mm in the board's plane;
    ``T_camera_board`` (4, 4) mm. NaN where a circle is not in the lens's field of view. Raises
    InputError for a negative radius.
    """
    if not radius_mm >= 0:
        raise InputError(
            f"circles of radius {radius_mm:g} mm were given", "the radius is 0 or more"
        )
    angles = 2 * np.pi * np.arange(CORNERS) / CORNERS
    # a regular polygon of a circle's area shares its second moments, which the shift comes from, to
    # 1e-5
    reach = radius_mm * np.sqrt(2 * np.pi / (CORNERS * np.sin(2 * np.pi / CORNERS)))
    rim = reach * np.stack([np.cos(angles), np.sin(angles), np.zeros(CORNERS)], axis=1)
    centre = lens.project(move_points(T_camera_board, points))
    outline = lens.project(move_points(T_camera_board, points[:, None] + rim)) - centre[:, None]
    ahead = np.roll(outline, -1, axis=1)
    cross = outline[..., 0] * ahead[..., 1] - ahead[..., 0] * outline[..., 1]
    area = cross.sum(1)
    with np.errstate(invalid="ignore", divide="ignore"):
        moment = ((outline + ahead) * cross[..., None]).sum(1) / (3 * area[:, None])
    return np.where(area[:, None] != 0, moment, 0.0) if radius_mm else np.zeros_like(centre)


def move_to_centres(observations: Sequence[Observation], stereo: StereoModel) -> list[Observation]:
    """Return the observations with circle centroids corrected to centres, and projector coordinates
    moved alike.

    Poses that ``stereo`` did not use, corners, and circles that are corrected already are returned
    unchanged.
    """
    radii = [o.radius_mm for o in observations if o.radius_mm]
    # one board: what differs between poses is noise
    radius = float(np.median(radii)) if radii else 0.0
    corrected = []
    for o in observations:
        if o.radius_mm and o.name in stereo.poses:
            shift = centroid_shifts(stereo.rig.camera, stereo.poses[o.name], o.points, radius)
            projector = o.projector
            if o.slopes is not None:
                projector = projector - np.einsum("nij,nj->ni", o.slopes, shift)
            o = replace(o, camera=o.camera - shift, projector=projector, radius_mm=0.0)
        corrected.append(o)
    return corrected
