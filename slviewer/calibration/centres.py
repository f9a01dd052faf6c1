"""From the centroids of circles' images to the images of their centres.

Perspective and distortion move the two apart, by some hundredths of a pixel where a board is tilted. A calibration's
own lens and poses say by how much, and a first calibration from the centroids knows them well enough: its error changes
the correction by a hundredth.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from slviewer.calibration.observe import Observation
from slviewer.calibration.stereo import StereoModel, calibrate_stereo
from slviewer.errors import InputError
from slviewer.geometry.lens import Lens

CORNERS = 64
"""Of the polygon that stands for a circle."""


def calibrate_centres(
    observations: Sequence[Observation],
    projector_size: tuple[int, int],
    board: str = "",
    left_out: Mapping[str, str] | None = None,
    *,
    strict: bool = True,
) -> tuple[StereoModel, list[Observation]]:
    """``calibrate_stereo`` from the circles' centroids, then once more from their centres; and the poses it used,
    centred.

    Raises what ``calibrate_stereo`` does.
    """
    stereo = calibrate_stereo(observations, projector_size, board, left_out, strict=strict)
    used = [o for o in observations if o.name in stereo.poses]
    corrected = move_to_centres(used, stereo)
    if all(new is old for new, old in zip(corrected, used, strict=True)):
        return stereo, used
    stereo = calibrate_stereo(corrected, projector_size, board, stereo.left_out, strict=strict)
    return stereo, [o for o in corrected if o.name in stereo.poses]


def centroid_shifts(lens: Lens, T_camera_board: np.ndarray, points: np.ndarray, radius_mm: float) -> np.ndarray:
    """(n, 2) px: the area centroid of each disc's image, less the image of its centre.

    Discs of ``radius_mm`` lie at ``points`` (n, 3) mm in the board's plane, at ``T_camera_board`` (4, 4). NaN where the
    lens does not see a disc.
    """
    if not radius_mm >= 0:
        raise InputError(f"circles of radius {radius_mm:g} mm were given: the radius is 0 or more")
    angles = 2 * np.pi * np.arange(CORNERS) / CORNERS
    # a regular polygon of a circle's area shares its second moments, which the shift comes from, to 1e-5
    reach = radius_mm * np.sqrt(2 * np.pi / (CORNERS * np.sin(2 * np.pi / CORNERS)))
    rim = reach * np.stack([np.cos(angles), np.sin(angles), np.zeros(CORNERS)], axis=1)
    R, t = T_camera_board[:3, :3], T_camera_board[:3, 3]
    centre = lens.project(points @ R.T + t)
    outline = lens.project((points[:, None] + rim) @ R.T + t) - centre[:, None]
    x, y = outline[..., 0], outline[..., 1]
    ahead = np.roll(outline, -1, axis=1)
    cross = x * ahead[..., 1] - ahead[..., 0] * y
    area = cross.sum(1)
    with np.errstate(invalid="ignore", divide="ignore"):
        moment = ((outline + ahead) * cross[..., None]).sum(1) / (3 * area[:, None])
    return np.where(area[:, None] != 0, moment, 0.0) if radius_mm else np.zeros_like(centre)


def move_to_centres(observations: Sequence[Observation], stereo: StereoModel) -> list[Observation]:
    """The same observations with circles at their centres, and their projector coordinates read there.

    Poses that ``stereo`` did not use stay as they are, and so do corners and circles that are centred already.
    """
    radii = [o.radius_mm for o in observations if o.radius_mm]
    radius = float(np.median(radii)) if radii else 0.0  # one board: what differs between poses is noise
    return [_move_to_centres(o, stereo, radius) if o.radius_mm and o.name in stereo.poses else o for o in observations]


def _move_to_centres(observation: Observation, stereo: StereoModel, radius_mm: float) -> Observation:
    shift = centroid_shifts(stereo.rig.camera, stereo.poses[observation.name], observation.points, radius_mm)
    projector = observation.projector
    if observation.slopes is not None:
        projector = projector - np.einsum("nij,nj->ni", observation.slopes, shift)
    return replace(observation, camera=observation.camera - shift, projector=projector, radius_mm=0.0)
