"""The surfaces that the wizard measures on: reconstructed scans and merges, read from the
session."""

import threading
from pathlib import Path

import numpy as np

from slviewer.errors import InputError
from slviewer.inspection.regions import Region
from slviewer.pipeline.measure import (
    MERGED,
    MeasuredSurface,
    Place,
    load_merged_surface,
    surface_from_cloud,
)
from slviewer.pipeline.models import load_model
from slviewer.pipeline.stored_records import is_up_to_date
from slviewer.session.nominal import NOMINALS
from slviewer.session.scan_edits import restriction_inputs
from slviewer.session.store import Session
from slviewer.surface.selection import ViewCamera, select_connected, select_in_outline
from slviewer.wizard.result_views import load_scan_cloud, nearest


class Surfaces:
    """Loads surfaces to measure on, and caches the last one. Every method may be called from any
    thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._key: tuple[str, ...] | None = None
        self._cached: MeasuredSurface | None = None

    def load(self, store: Session, name: str) -> MeasuredSurface:
        """Load a capture's reconstructed cloud, or a merge (``merge/<number>``), as a surface.

        Raises InputError where there is none, or where what it was made from has changed since.
        """
        result = name if name.startswith(MERGED) else f"clouds/{name}"
        if not store.has_result(result):
            raise InputError(f"{name} is not reconstructed: reconstruct it in the step Scan first")
        again = "merge again" if result == name else "reconstruct it again in the step Scan"
        if not is_up_to_date(store, result):
            raise InputError(f"the inputs of {name} have changed: {again}, then measure")
        meta = store.load_result(result, only=())[0]
        cut = "" if result == name else str(restriction_inputs(store, [name]))
        key = (str(store.folder), result, str(meta["hash"]), cut)
        with self._lock:
            if self._key != key or self._cached is None:
                if result == name:
                    self._cached = load_merged_surface(store, name)
                else:
                    cloud = load_scan_cloud(store, name)
                    model = load_model(store, cloud.model)
                    self._cached = surface_from_cloud(store, name, cloud, model)
                self._key = key
            return self._cached


def place_at(on: MeasuredSurface, origin: np.ndarray, direction: np.ndarray) -> Place | None:
    """Return the measured point closest to a ray from origin (3,) mm along direction (3,), in the
    surface's frame.

    None where the ray passes the surface.
    """
    index = nearest(on.points, origin, direction)
    if index is None:
        return None
    return (index[1], index[0]) if on.organised else index[0]


def point_at(on: MeasuredSurface, place: Place) -> np.ndarray:
    """Return the point (3,) mm of a place on the surface."""
    index = (place[1], place[0]) if isinstance(place, tuple) else (place,)
    return np.asarray(on.points[index], np.float64)


def box_in_view(on: MeasuredSurface, view: ViewCamera, low: np.ndarray, high: np.ndarray) -> Region:
    """Return the box, with sides along a view's, around what a rectangle shows of a surface: its
    connected part in the middle. ``low``, ``high`` (2,): corners in the view, 0 ... 1. InputError
    where it shows no measured point.
    """
    corners = np.array([low, [high[0], low[1]], high, [low[0], high[1]]])
    chosen = select_in_outline(on.points, view, corners) & on.measured
    if not chosen.any():
        raise InputError("the rectangle holds no measured point: drag it over the surface")
    if on.organised:
        off = np.linalg.norm(view.project(on.points.astype(np.float64)) - (low + high) / 2, axis=-1)
        v, u = np.unravel_index(int(np.argmin(np.where(chosen, off, np.inf))), chosen.shape)
        chosen = select_connected(on.points, (int(u), int(v)), chosen)
    return Region.around(on.points[chosen].astype(np.float64), view.R_scene_view.T)


def list_nominals(folder: Path) -> tuple[str, ...]:
    """List the names of the nominal models in a session's folder."""
    entries = (folder / NOMINALS).glob("[!.]*")
    return tuple(sorted(entry.name for entry in entries))
