"""Requests to set the region of interest, and to delete points of scans so that they can be brought
back."""

from collections.abc import Sequence
from functools import partial

from slviewer.errors import InputError
from slviewer.pipeline.edit import Selection, delete_points, step_history
from slviewer.session.scan_edits import load_region, save_region
from slviewer.surface.region_of_interest import RegionOfInterest
from slviewer.wizard import tasks
from slviewer.wizard.requests import RequestHandler, request
from slviewer.wizard.result_views import whole_cloud


class EditRequests(RequestHandler):
    """Requests that change which points of scans are used."""

    @request("Setting the region")
    def set_region(self, region: RegionOfInterest, on: bool = True) -> None:
        """Make a box the session's region of interest, in effect or not."""
        save_region(self._engine.store, region, on)

    @request("Switching the region")
    def switch_region(self, on: bool) -> None:
        """Put the last region of interest into effect, or use all points."""
        store = self._engine.store
        region = load_region(store, even_if_off=True)
        if region is None:
            raise InputError("there is no region yet: take the automatic one of a scan")
        save_region(store, region, on)

    @request("Setting the region")
    def fit_region(self, scan: str) -> None:
        """Make the box around all points of a reconstructed scan the region of interest."""
        store = self._engine.store
        save_region(store, RegionOfInterest.around(whole_cloud(store, scan).points))

    @request("Deleting points")
    def delete_points(self, selections: Sequence[Selection], what: str) -> None:
        """Delete what is selected of the points that are shown of one or several scans; `undo_edit`
        undoes it."""
        counts = delete_points(self._engine.store, selections, what)
        self._engine.notices.add(
            "info",
            f"{', '.join(counts)}: {sum(counts.values()):,} points deleted; Undo edit brings them"
            " back",
        )

    @request("Removing the support")
    def remove_support(self, *scans: str) -> None:
        """Delete the plane that the object stands on, and all below it, from scans; `undo_edit`
        undoes it for each."""
        remove = partial(
            tasks.remove_support, self._engine.store, list(scans), warn=self._warner("scans")
        )
        self._submit("Removing the support", remove, tasks.describe_removal)

    @request("Undoing the edit")
    def undo_edit(self, *scans: str) -> None:
        """Undo the last edit of scans, of all those that it was made of."""
        step_history(self._engine.store, scans)

    @request("Redoing the edit")
    def redo_edit(self, *scans: str) -> None:
        """Bring the last edit of scans that was undone back."""
        step_history(self._engine.store, scans, redo=True)
