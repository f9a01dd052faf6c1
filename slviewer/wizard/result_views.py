"""What panels draw from a session beyond the snapshot: clouds, error maps, curves. Nothing here
changes the session."""

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np

from slviewer.calibration.pixelwise import PixelFit, PixelwiseModel
from slviewer.errors import InputError
from slviewer.fringe.hdr import radiance, toned
from slviewer.fringe.layout import to_eight_bits
from slviewer.fringe.sequence import Axis
from slviewer.pipeline.merge import AlignedScans, load_placements, view_places
from slviewer.pipeline.models import load_model, load_stereo
from slviewer.pipeline.poses import load_observations
from slviewer.pipeline.report import curve_at
from slviewer.pipeline.scan_edits import restrict_cloud
from slviewer.reconstruction.cloud import Cloud
from slviewer.report.maps import PixelCurve
from slviewer.session.capture import Capture
from slviewer.session.ply import Ply, read_ply
from slviewer.session.scan_edits import load_region
from slviewer.session.store import Session

THUMBNAIL_PX = 240


@dataclass(frozen=True, eq=False, kw_only=True)
class ScanCloud(Cloud):
    """The cloud of a capture, with its `name`; `phase` (rad) and `modulation` (h, w) float32, NaN
    where invalid; `errors`: {model: (h, w) float32 mm} signed distances from the fitted plane or
    sphere, NaN where not measured.
    """

    name: str
    phase: np.ndarray
    modulation: np.ndarray
    texture: np.ndarray
    errors: Mapping[str, np.ndarray]

    @property
    def measured_count(self) -> int:
        """How many of its points are not NaN."""
        return int(np.count_nonzero(np.isfinite(self.points[..., 2])))

    def nearest(self, origin: np.ndarray, direction: np.ndarray) -> tuple[int, int] | None:
        """Return (u, v) of the measured pixel closest to a ray (camera frame, mm); None if none is
        near."""
        index = nearest(self.points, origin, direction)
        return None if index is None else (index[1], index[0])


def nearest(
    points: np.ndarray, origin: np.ndarray, direction: np.ndarray
) -> tuple[int, ...] | None:
    """Return the index of the point (..., 3) closest to a ray, within 1 % of its depth, the front
    before the back.

    None where there is none; NaN points are ignored.
    """
    ways = points - origin
    along = ways @ (direction / np.linalg.norm(direction))
    off = np.sqrt(np.maximum((ways**2).sum(-1) - along**2, 0))
    score = np.where((along > 0) & (off < 0.01 * along), off + 0.02 * along, np.inf)
    index = np.unravel_index(int(np.argmin(score)), score.shape)
    return tuple(int(i) for i in index) if np.isfinite(score[index]) else None


def load_scan_cloud(session: Session, name: str) -> ScanCloud:
    """Load the reconstructed cloud of a capture, of a scan without what edits and region remove.

    Raises InputError where it was not reconstructed, or nothing remains of it.
    """
    return used_points(session, whole_cloud(session, name))


def used_points(session: Session, cloud: ScanCloud) -> ScanCloud:
    """Return a scan's cloud with NaN for what edits and region remove. InputError where nothing
    remains."""
    if session.load_capture(cloud.name).role != "scan":
        return cloud
    return restrict_cloud(session, cloud.name, cloud, load_region(session))


def whole_cloud(session: Session, name: str) -> ScanCloud:
    """Load the reconstructed cloud of a capture with all of its points. Raises InputError where
    there is none."""
    meta, arrays = session.load_result(f"clouds/{name}")
    verified = f"verify/{name}"
    errors = session.load_result(verified)[1] if session.has_result(verified) else {}
    errors = {key.removeprefix("error_"): array for key, array in errors.items()}
    return ScanCloud(name=name, model=meta["model"], axis=meta["axis"], errors=errors, **arrays)


def aligned_scans(session: Session) -> AlignedScans:
    """Load the scans in place, thinned, with the number of scans that see each point."""
    return view_places(load_placements(session), {}, session)


def merged_cloud(session: Session, name: str) -> Ply:
    """Load the merged points of a merge."""
    return read_ply(session.exports / str(session.load_result(f"merge/{name}", only=())[0]["ply"]))


def pixel_fits(session: Session) -> Mapping[Axis, PixelFit]:
    """Load the pixel-wise fits by axis: RMS maps, poses, coefficients."""
    model = load_model(session, "pixelwise")
    assert isinstance(model, PixelwiseModel)
    return model.fits


def pixel_curve(session: Session, pixel: tuple[int, int], axis: Axis) -> PixelCurve | None:
    """Return the data and fit of z-phi, x-z, y-z at a pixel (u, v); None where it was not
    fitted."""
    model = load_model(session, "pixelwise")
    stereo = load_stereo(session)
    assert isinstance(model, PixelwiseModel)
    if axis not in model.fits:
        raise InputError(
            f"the pixel-wise model has no axis {axis}: choose one of {', '.join(model.fits)}"
        )
    h, w = model.fits[axis].rms_mm.shape[1:]
    if not (0 <= pixel[0] < w and 0 <= pixel[1] < h):
        raise InputError(
            f"pixel {pixel} lies outside the camera's {w}x{h}: give column and row, counted from 0"
        )
    return curve_at(pixel, model, stereo, load_observations(session, list(stereo.poses)), axis)


def make_thumbnail(capture: Capture) -> bytes:
    """Return a small JPEG of the capture's texture, or of its brightest kind of frame where it has
    none."""
    order = ("texture", "white", "phase", "gray")
    frames = capture.sequence.frames
    index = min(
        range(len(frames)),
        key=lambda k: order.index(frames[k].kind) if frames[k].kind in order else 9,
    )
    image = capture.stack([index])[0]
    choice = capture.exposure_choice
    if choice is not None:
        image = toned(radiance(image, choice, capture.exposures_ms))
    scale = THUMBNAIL_PX / max(image.shape)
    small = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    small = to_eight_bits(small, capture.sequence.full_scale, int(image.max()))
    return bytes(cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, 80])[1])
