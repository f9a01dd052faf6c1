"""What panels draw from a session beyond the snapshot: clouds, error maps, curves, surfaces to
measure on. Nothing here changes the session."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from slviewer.calibration.pixelwise import PixelFit, PixelwiseModel
from slviewer.errors import InputError
from slviewer.fringe.hdr import radiance, toned
from slviewer.fringe.layout import to_eight_bits
from slviewer.fringe.sequence import Axis
from slviewer.inspection.regions import Region
from slviewer.pipeline.cloud_corrections import restrict_cloud
from slviewer.pipeline.measure import (
    MERGED,
    MeasuredSurface,
    Place,
    load_merged_surface,
    surface_from_cloud,
)
from slviewer.pipeline.models import load_model, load_stereo
from slviewer.pipeline.operation import is_up_to_date
from slviewer.pipeline.poses import load_observations
from slviewer.pipeline.report import curve_at
from slviewer.reconstruction.cloud import Cloud, Misfit
from slviewer.report.maps import PixelCurve
from slviewer.session.capture import Capture
from slviewer.session.ply import Ply, read_ply
from slviewer.session.scan_edits import load_region, restriction_inputs
from slviewer.session.store import Session
from slviewer.surface.selection import ViewCamera, select_connected, select_in_outline

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


def extrapolated_points(session: Session, name: str) -> np.ndarray:
    """Load the points (n, 3) mm of a capture that no target pose supports, without what edits and
    region remove."""
    whole = whole_cloud(session, name, extrapolated=True)
    if whole.extrapolated is None:
        return np.zeros((0, 3), np.float32)
    try:
        points = used_points(session, whole).points[whole.extrapolated]
    except InputError:  # nothing remains
        return np.zeros((0, 3), np.float32)
    return points[np.isfinite(points[:, 2])]


def used_points(session: Session, cloud: ScanCloud) -> ScanCloud:
    """Return a scan's cloud with NaN for what edits and region remove. InputError where nothing
    remains."""
    if session.load_capture(cloud.name).role != "scan":
        return cloud
    return restrict_cloud(session, cloud.name, cloud, load_region(session))


def whole_cloud(session: Session, name: str, extrapolated: bool = False) -> ScanCloud:
    """Load the reconstructed cloud of a capture with all of its points, extrapolated ones where
    these are wanted. Raises InputError where there is none."""
    meta, arrays = session.load_result(f"clouds/{name}")
    verified = f"verify/{name}"
    errors = session.load_result(verified)[1] if session.has_result(verified) else {}
    errors = {key.removeprefix("error_"): array for key, array in errors.items()}
    shape, misfit = arrays["points"].shape[:2], Misfit.pop_from(arrays)
    unknown = dict.fromkeys(("phase", "modulation"), np.full(shape, np.nan, np.float32))
    arrays = unknown | {"texture": np.full(shape, 128, np.uint8)} | arrays  # of an imported cloud
    known: dict[str, Any] = {"errors": errors, "misfit": misfit, **arrays}
    cloud = ScanCloud(name=name, model=meta["model"], axis=meta["axis"], **known)
    return cloud if extrapolated else cloud.supported()


def merged_cloud(session: Session, name: str) -> Ply:
    """Load the merged points of a merge."""
    return read_ply(session.exports / str(session.load_meta(f"merge/{name}")["ply"]))


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
            f"the pixel-wise model has no axis {axis}", f"choose one of {', '.join(model.fits)}"
        )
    h, w = model.fits[axis].rms_mm.shape[1:]
    if not (0 <= pixel[0] < w and 0 <= pixel[1] < h):
        raise InputError(
            f"pixel {pixel} lies outside the camera's {w}x{h}",
            "give column and row, counted from 0",
        )
    return curve_at(pixel, model, stereo, load_observations(session, list(stereo.poses)), axis)


def make_thumbnail(capture: Capture) -> bytes:
    """Return a small JPEG of the capture's texture, or of its brightest kind of frame where it has
    none."""
    image = capture.stack([capture.brightest_frame])[0]
    choice = capture.exposure_choice
    if choice is not None:
        image = toned(radiance(image, choice, capture.exposures_ms))
    scale = THUMBNAIL_PX / max(image.shape)
    small = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    small = to_eight_bits(small, capture.sequence.full_scale, int(image.max()))
    return bytes(cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, 80])[1])


def surface_to_measure(store: Session, name: str) -> MeasuredSurface:
    """Load a capture's reconstructed cloud, or a merge (``merge/<number>``), as a surface; the last
    one is kept.

    Raises InputError where there is none, or where what it was made from has changed since.
    """
    result = name if name.startswith(MERGED) else f"clouds/{name}"
    if not store.has_result(result):
        raise InputError(f"{name} is not reconstructed", "reconstruct it in the step Scan first")
    again = "merge again" if result == name else "reconstruct it again in the step Scan"
    if not is_up_to_date(store, result):
        raise InputError(f"the inputs of {name} have changed", f"{again}, then measure")
    cut = "" if result == name else str(restriction_inputs(store, [name]))
    return _read_surface(store.folder, name, store.load_meta(result)["hash"], cut)


@lru_cache(maxsize=1)
def _read_surface(folder: Path, name: str, *content: str) -> MeasuredSurface:
    """Read a surface of a session, whose ``content`` are hashes of what it is made from."""
    store = Session(folder, None)
    if name.startswith(MERGED):
        return load_merged_surface(store, name)
    cloud = load_scan_cloud(store, name)
    return surface_from_cloud(store, name, cloud)


def place_at(on: MeasuredSurface, origin: np.ndarray, direction: np.ndarray) -> Place | None:
    """Return the measured point closest to a ray from origin (3,) mm along direction (3,), in the
    surface's frame.

    None where the ray passes the surface.
    """
    index = nearest(on.points, origin, direction)
    return None if index is None else _to_place(on, index)


def snap(on: MeasuredSurface, point: np.ndarray) -> Place:
    """Return the place of the measured point closest to a point (3,) mm."""
    off = ((on.points - point) ** 2).sum(axis=-1)
    return _to_place(on, [int(i) for i in np.unravel_index(np.nanargmin(off), off.shape)])


def _to_place(on: MeasuredSurface, index: Sequence[int]) -> Place:
    """Return the place of the point with this index, (v, u) of an organised surface."""
    return (index[1], index[0]) if on.organised else index[0]


def point_at(on: MeasuredSurface, place: Place) -> np.ndarray:
    """Return the point (3,) mm of a place on the surface."""
    index = (place[1], place[0]) if isinstance(place, tuple) else (place,)
    return np.asarray(on.points[index], np.float64)


def box_in_view(on: MeasuredSurface, view: ViewCamera, corners: np.ndarray) -> Region:
    """Return the box, with sides along a view's, around what a rectangle shows of a surface: its
    connected part in the middle. ``corners`` (4, 2): in the view, 0 ... 1. InputError where it
    shows no measured point.
    """
    chosen = select_in_outline(on.points, view, corners) & on.measured
    if not chosen.any():
        raise InputError("the rectangle holds no measured point", "drag it over the surface")
    if on.organised:
        off = np.linalg.norm(
            view.project(on.points.astype(np.float64)) - corners.mean(axis=0), axis=-1
        )
        v, u = np.unravel_index(int(np.argmin(np.where(chosen, off, np.inf))), chosen.shape)
        chosen = select_connected(on.points, (int(u), int(v)), chosen)
    return Region.around(on.points[chosen].astype(np.float64), view.R_scene_view.T)
