"""Requests that change what the session holds, and can be undone: exclusions and names, deleted
captures, edits and region of scans, merges and measurements; and to undo and redo the last one."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from slviewer.errors import InputError
from slviewer.pipeline.edit import SUPPORT, Selection, delete_points, step_history
from slviewer.pipeline.measure import rename_measurement, restore_measurement
from slviewer.pipeline.merge import PLACEMENTS
from slviewer.pipeline.models import available_models
from slviewer.pipeline.operation import Findings, Job, load_stored
from slviewer.records.measurement import Measurement
from slviewer.records.merge import Merge
from slviewer.session.names import clean_label
from slviewer.session.scan_edits import load_edits, load_region, save_region
from slviewer.session.store import Session
from slviewer.surface.region_of_interest import RegionOfInterest
from slviewer.surface.selection import Edit, select_support
from slviewer.wizard.engine import Engine, request
from slviewer.wizard.result_views import load_scan_cloud, whole_cloud
from slviewer.wizard.undo import Move, Restore, Several, Step, StepEdits, decide, remove

_RESULTS_OF_CAPTURE = ("poses", "clouds", "verify", "trust", PLACEMENTS)


class ChangeRequests(Engine):
    """Requests whose changes `undo` takes back, the last one first."""

    @request("Undoing")
    def undo(self) -> None:
        """Take back what was done last, as the snapshot names it."""
        self._notices.add("info", f"Undone: {self._history.undo()}")
        self._queue_processing()

    @request("Redoing")
    def redo(self) -> None:
        """Do again what was undone last, as the snapshot names it."""
        self._notices.add("info", f"Done again: {self._history.redo()}")
        self._queue_processing()

    def _make(self, name: str, step: Step) -> None:
        """Make a change of the session that can be undone, of this name."""
        store = self._store
        self._add_change(store, name, step.make(store))

    def _decide(self, name: str, what: str, change: Callable[[], object]) -> None:
        """Make a change of a decision of the session that can be undone, of this name."""
        store = self._store
        self._add_change(store, name, decide(store, what, change))

    def _finish(self, verb: str) -> Callable[[Findings[Any]], None]:
        """Return what adds the records that an operation made, numbered ones, to what can be
        undone, named after the verb."""
        store = self._store

        def add(found: Findings[Any]) -> None:
            """Add the records."""
            labels = ", ".join(record.label(name) for name, record in found.items())
            removal = self._removal(found.kind.kind, list(found))
            self._add_change(store, f"{verb} {labels}", removal)

        return add

    def _label(self, name: str) -> str:
        """Return the operator's label of a capture."""
        return str((self._store.valid_decision("names") or {}).get(name, name))

    # captures

    @request("Excluding the pose")
    def exclude(self, name: str, why: str = "by hand") -> None:
        """Exclude a capture from calibrations from now on, with the reason."""
        change = partial(self._store.exclude, name, why)
        self._decide(f"exclude {self._label(name)}", "excluded", change)

    @request("Including the pose")
    def include(self, name: str) -> None:
        """Include a capture again."""
        change = partial(self._store.include, name)
        self._decide(f"include {self._label(name)}", "excluded", change)

    @request("Deleting")
    def delete(self, name: str) -> None:
        """Move a capture, and its own results, to the session's trash."""
        store = self._store
        results = (f"{kind}/{name}" for kind in _RESULTS_OF_CAPTURE)
        names = [name, *(each for each in results if store.has_result(each))]
        title, back = f"delete {self._label(name)}", remove(names).make(store)
        included = decide(store, "excluded", partial(store.include, name))
        self._add_change(store, title, Several([included, back]))
        self._queue_processing()

    @request("Restoring")
    def undelete(self, name: str) -> None:
        """Restore a deleted capture from the trash; its results are computed again."""
        self._make(f"restore {self._label(name)}", Restore(name))
        self._queue_processing()

    @request("Renaming")
    def rename(self, name: str, label: str) -> None:
        """Set the label of a capture, any text; its files keep their name."""
        self._store.load_capture(name)
        change = partial(self._set_label, name, label)
        self._decide(f"rename {self._label(name)}", "names", change)

    def _set_label(self, name: str, label: str) -> None:
        """Store the operator's label of a capture; its name where that is blank."""
        labels = self._store.decision("names") or {}
        self._store.decide("names", {**labels, name: clean_label(label) or name})

    # results

    @request("Choosing the model")
    def choose_model(self, name: str) -> None:
        """Set the model that later steps use; empty: the recommended one."""
        store = self._store
        if name and name not in (models := available_models(store)):
            raise InputError(
                f"the session has no {name} calibration", f"choose one of {', '.join(models)}"
            )
        change = partial(store.decide, "model", name or None)
        self._decide(f"use {name or 'the recommended'} model", "model", change)

    @request("Undoing the alignment")
    def undo_alignment(self, name: str) -> None:
        """Move the placement of a scan to the trash, so that it can be aligned again."""
        placement = f"{PLACEMENTS}/{name}"
        if self._store.has_result(placement):
            title = f"remove the alignment of {self._label(name)}"
            self._make(title, remove([placement]))

    def _last_merge(self, missing: str) -> str:
        """Return the number of the current merge. Raises InputError with ``missing`` without
        one."""
        merge = self._publisher.refresh().content.merge
        if merge is None:
            raise InputError(missing)
        return merge.name

    @request("Undoing the merge")
    def undo_merge(self) -> None:
        """Move the current merge to the trash; the previous one is current again."""
        number = self._last_merge("there is no merge to undo")
        removal = self._removal(Merge.kind, [number])
        self._make(f"remove merge {number}", removal)

    def _removal(self, kind: str, names: Sequence[str]) -> Step:
        """Return the step that moves numbered records to the trash, a merge with its PLY."""
        trash = remove([f"{kind}/{name}" for name in names])
        if kind != Merge.kind:
            return trash
        files = [f"merged_{name}.ply" for name in names]
        return Several([trash, *(Move(f"exports/{file}", f"trash/{file}") for file in files)])

    @request("Renaming")
    def relabel_measurement(self, name: str, label: str) -> None:
        """Call a measurement otherwise; an empty label restores its original one."""
        store = self._store
        before = load_stored(store, Measurement, name).label
        change = partial(rename_measurement, store, name, label)
        self._decide(f"rename {before}", Measurement.labels, change)

    @request("Deleting")
    def delete_measurement(self, name: str) -> None:
        """Move a measurement to the trash; what was made from it becomes stale."""
        label = load_stored(self._store, Measurement, name).label
        self._make(f"delete {label}", self._removal(Measurement.kind, [name]))

    @request("Restoring")
    def undo_delete(self) -> None:
        """Bring the measurement back that was deleted last."""
        found = restore_measurement(self._store)
        reverse = self._removal(Measurement.kind, [found.name])
        self._add_change(self._store, f"restore {found.label}", reverse)

    # which points of scans are used

    @request("Setting the region")
    def set_region(self, region: RegionOfInterest, on: bool = True) -> None:
        """Make a box the session's region of interest, in effect or not."""
        self._save_region("set the region", region, on)

    @request("Switching the region")
    def switch_region(self, on: bool) -> None:
        """Put the last region of interest into effect, or use all points."""
        region = load_region(self._store, even_if_off=True)
        if region is None:
            raise InputError("there is no region yet", "take the automatic one of a scan")
        self._save_region(f"switch the region {'on' if on else 'off'}", region, on)

    @request("Setting the region")
    def fit_region(self, scan: str) -> None:
        """Make the box around all points of a reconstructed scan the region of interest."""
        region = RegionOfInterest.around(whole_cloud(self._store, scan).points)
        self._save_region("set the region", region)

    def _save_region(self, title: str, region: RegionOfInterest, on: bool = True) -> None:
        """Save the region of interest, in effect or not."""
        self._decide(title, "region", partial(save_region, self._store, region, on))

    @request("Deleting points")
    def delete_points(self, selections: Sequence[Selection], what: str) -> None:
        """Delete what is selected of the points that are shown of one or several scans."""
        edits = delete_points(self._store, selections, what)
        total = sum(edit.points for edit in edits.values())
        self._add_edits(self._store, f"delete {total:,} points", edits)
        self._notices.add(
            "info", f"{', '.join(edits)}: {total:,} points deleted; Ctrl+Z brings them back"
        )

    def _add_edits(self, store: Session, name: str, edits: dict[str, Edit]) -> None:
        """Add edits that were made to what can be undone."""
        made = {scan: edit.made for scan, edit in edits.items()}
        self._add_change(store, name, StepEdits(made))

    @request("Removing the support")
    def remove_support(self, *scans: str) -> None:
        """Delete the plane that the object stands on, and all below it, from scans.

        Scans without such a plane, and those that it was deleted from before, stay as they are,
        with a warning; where all of them do, it fails.
        """

        def work(job: Job) -> str:
            """Delete the supports; returns a sentence about them."""
            store, selections, refused = job.store, list[Selection](), list[str]()
            for i, name in enumerate(scans):
                job.progress(i / len(scans), f"removing the support from {name}")
                if any(edit.plane is not None for edit in load_edits(store, name).active):
                    refused.append(
                        f"{name}: its support was removed before; Undo edit brings it back"
                    )
                    continue
                try:
                    cloud = load_scan_cloud(store, name)
                    plane, selected = select_support(cloud.points, cloud.sigma_z)
                    selections.append(Selection(name, cloud.points, selected, plane))
                except InputError as error:
                    refused.append(f"{name}: {error}")
            if not selections:
                raise InputError("; ".join(refused) or "no scan is reconstructed yet")
            edits = delete_points(store, selections, SUPPORT)
            self._add_edits(opened, f"remove the support of {', '.join(edits)}", edits)
            for reason in refused:
                job.warn(reason)
            job.progress(1.0, "support removed")
            counts = ", ".join(f"{name} {edit.points:,} points" for name, edit in edits.items())
            return f"support removed: {counts}; Ctrl+Z brings it back"

        opened = self._store
        self._work("Removing the support", work, "scans")

    @request("Undoing the edit")
    def undo_edit(self, *scans: str) -> None:
        """Undo the last edit of scans, of all those that it was made of."""
        self._step_edits(scans, redo=False)

    @request("Redoing the edit")
    def redo_edit(self, *scans: str) -> None:
        """Bring the last edit of scans that was undone back."""
        self._step_edits(scans, redo=True)

    def _step_edits(self, scans: Sequence[str], redo: bool) -> None:
        """Undo or redo the last edit of scans."""
        made = step_history(self._store, scans, redo=redo)
        name = f"{'redo' if redo else 'undo'} the edit of {', '.join(made)}"
        self._add_change(self._store, name, StepEdits(made, not redo))
