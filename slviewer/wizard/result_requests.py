"""Requests to calibrate, verify, reconstruct, merge, edit and export, and to choose what results
are made from."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from slviewer.errors import Cancelled, InputError, SlviewerError
from slviewer.pipeline.accept import ValidateSettings, validate
from slviewer.pipeline.calibrate import CalibrateSettings, calibrate
from slviewer.pipeline.edit import SUPPORT, Selection, delete_points, step_history
from slviewer.pipeline.export import What, check_export, default_file_name, export, formats
from slviewer.pipeline.feedback import Progress, Warn, part
from slviewer.pipeline.measure import MERGED
from slviewer.pipeline.merge import (
    PLACEMENTS,
    AlignSettings,
    MergeSettings,
    Picked,
    StartKind,
    align,
    merge,
    remove_placement,
)
from slviewer.pipeline.mesh import mesh
from slviewer.pipeline.models import (
    ModelName,
    accept_rejected_calibration,
    accepts_rejected,
    available_models,
    check_accepted,
)
from slviewer.pipeline.operation import Findings
from slviewer.pipeline.operations import OPERATIONS
from slviewer.pipeline.reconstruct import ReconstructSettings, VerifySettings, reconstruct, verify
from slviewer.pipeline.turn import WATERTIGHT, merge_turn
from slviewer.records.merge import Merge
from slviewer.records.verification import Shape
from slviewer.registration.refusal import Refused
from slviewer.session.names import clean_label
from slviewer.session.scan_edits import load_edits, load_region, save_region
from slviewer.session.store import Session
from slviewer.surface.meshing import MeshingPlan
from slviewer.surface.region_of_interest import RegionOfInterest
from slviewer.surface.selection import select_support
from slviewer.wizard.diagnostics import write_bundle
from slviewer.wizard.engine import Engine, request
from slviewer.wizard.jobs import Reporter
from slviewer.wizard.notices import describe_failure
from slviewer.wizard.result_views import load_scan_cloud, whole_cloud
from slviewer.wizard.session_reader import missing_for_splined

MERGING = "Merging"
_ALTERNATIVES = {
    "features": "use the initial alignment by picked points",
    "picked": "pick other points",
}
"""What else to try where scans cannot be aligned from a start, other than from those starts."""


class ResultRequests(Engine):
    """Requests that compute results from captures, and decisions about poses, scans and models."""

    @request("Excluding the pose")
    def exclude(self, name: str, why: str = "by hand") -> None:
        """Exclude a pose from calibrations."""
        self._store.exclude(name, why)

    @request("Including the pose")
    def include(self, name: str) -> None:
        """Include an excluded pose again."""
        self._store.include(name)

    @request("Deleting")
    def delete(self, name: str) -> None:
        """Move a capture, and its own results, to the session's trash."""
        store = self._store
        store.trash_capture(name)
        store.include(name)
        for kind in ("poses", "clouds", "verify", "trust", PLACEMENTS):
            if store.state_of(f"{kind}/{name}") != "absent":
                store.trash_result(f"{kind}/{name}")

    @request("Restoring")
    def undelete(self, name: str) -> None:
        """Restore a deleted capture from the trash; its results are computed again."""
        self._store.restore_last(name)
        restored = self._store.load_capture(name)
        with self._lock:
            self._queued = {key for key in self._queued if key[1] != restored.hash}
        self._queue_processing()

    @request("Renaming")
    def rename(self, name: str, label: str) -> None:
        """Set the label of a capture, any text; its files keep their name."""
        self._store.load_capture(name)
        self._set_label(name, label)

    def _set_label(self, name: str, label: str) -> None:
        """Store the operator's label of a capture; its name where that is blank."""
        labels = self._store.decision("names") or {}
        self._store.decide("names", {**labels, name: clean_label(label) or name})

    @request("Calibrating")
    def calibrate(self) -> None:
        """Calibrate every model that the included poses allow; others go to the trash."""
        target, models = self._reader.target(), ["stereo", "pixelwise"]
        if not target:
            raise InputError("choose the target first")
        if missing := missing_for_splined(self._store):
            self._warner("calibration")(f"no splined model: {missing}")
        else:
            models.append("splined")
        settings = CalibrateSettings(target, models, replace_all=True)
        self._run("Calibrating", calibrate, settings, "calibration")

    @request("Comparing the models")
    def compare_models(self) -> None:
        """Cross-validate the models on the target poses; the best one is then recommended, and
        used."""
        self._run("Comparing the models", validate, ValidateSettings(), "calibration")

    @request("Choosing the model")
    def choose_model(self, name: str) -> None:
        """Set the model that later steps use; empty: the recommended one."""
        if name and name not in (models := available_models(self._store)):
            raise InputError(
                f"the session has no {name} calibration: choose one of {', '.join(models)}"
            )
        self._store.decide("model", name or None)

    @request("Using the rejected calibration")
    def accept_rejected_calibration(self, on: bool) -> None:
        """Allow or forbid using the current calibration although it was rejected."""
        accept_rejected_calibration(self._store, on)

    @request("Verifying")
    def verify(self, names: Sequence[str], shape: Shape, radius_mm: float | None = None) -> None:
        """Compare the models on captures of a plane or a sphere; `radius_mm` helps to detect a
        sphere."""
        settings = VerifySettings(self._check_names(names), shape, radius=radius_mm, check=False)
        self._run("Verifying", verify, settings, "scans")

    @request("Reconstructing")
    def reconstruct(self, name: str, model: ModelName | None = None) -> None:
        """Reconstruct a capture, with the best model unless one is named."""
        self._store.load_capture(name)
        settings = ReconstructSettings(name, model, check=False)
        self._run("Reconstructing", reconstruct, settings, "scans")

    @request("Running the operation")
    def run(self, operation: str, **settings: Any) -> None:
        """Run any operation by the name of its command, with its settings."""
        if operation not in OPERATIONS:
            raise InputError(
                f"there is no operation {operation!r}: choose one of {', '.join(OPERATIONS)}"
            )
        chosen = OPERATIONS[operation]
        self._run(operation.capitalize(), chosen, chosen.settings(**settings))

    @request("Aligning")
    def align(self, *names: str) -> None:
        """Align reconstructed scans to those in place; without names all that were not aligned
        yet."""
        settings = AlignSettings(self._check_names(names), only_reconstructed=True)
        self._run("Aligning", align, settings, "merge")

    def _check_names(self, names: Sequence[str]) -> list[str]:
        """Return names of captures. Raises InputError for one that does not exist."""
        return [self._store.load_capture(name).name for name in names]

    @request("Undoing the alignment")
    def undo_alignment(self, name: str) -> None:
        """Take a scan away from the aligned ones."""
        remove_placement(self._store, name)

    @request("Switching the alignment of scans")
    def set_align_scans(self, on: bool) -> None:
        """Align each new scan to those before it as soon as it is reconstructed; those that are
        there at once."""
        self._store.decide("align_scans", on or None)
        if on:
            self.align()

    def _finish_scan(self, name: str) -> None:
        """Reconstruct a scan that was just captured, and align it where that is wanted."""
        self.reconstruct(name)
        if self._store.decision("align_scans"):
            self.align(name)

    # merges

    @request(MERGING)
    def merge(
        self,
        names: Sequence[str],
        reference: str,
        *,
        start: StartKind = "features",
        angle: float | None = None,
        picked: Picked | None = None,
    ) -> None:
        """Register scans, in the order in which they were captured, to a reference, and merge them.

        `undo_merge` undoes it; the snapshot shows why a merge failed until the next one. `start`,
        `angle` and `picked` as in `pipeline.merge`.
        """
        chosen = self._check_names(names)
        failed = self._begin_merge("picked" if picked else start)
        try:
            settings = MergeSettings(chosen, reference, start=start, angle=angle, picked=picked)
        except SlviewerError as error:
            failed(error)
            return
        self._run(MERGING, merge, settings, "merge", failed)

    def _merge_turn(self, names: list[str]) -> None:
        """Queue the merge of the scans of a turn by the angles of its turntable, and a watertight
        mesh of it in the exports; where that does not close, the merge stays."""
        store, warn = self._store, self._warner("merge")

        def work(report: Reporter) -> tuple[Findings[Merge], str]:
            """Merge and mesh; returns the merge, and a sentence about the mesh."""
            settings = MergeSettings(names, names[0], accept_rejected=accepts_rejected(store))
            guarded = store.guarded(report.saving)
            merged = merge_turn(guarded, settings, part(report, 0, 0.7), warn)
            (number,) = merged
            try:
                words = _export_file(
                    guarded, "merged-mesh", number, "ply", WATERTIGHT, part(report, 0.7, 1), warn
                )
            except Cancelled:
                raise
            except SlviewerError as error:
                words = "no watertight mesh was made"
                warn(f"{words}: {error}")
            report(1.0, "merged")
            return merged, words

        def describe(result: tuple[Findings[Merge], str]) -> str:
            """Describe the merge and the mesh in one sentence."""
            merged, words = result[0].only, result[1]
            worst = max(pair.rms_mm for pair in merged.pairs.values())
            return (
                f"{len(merged.scans)} scans merged on {merged.reference}, RMS up to {worst:.3f} mm;"
                f" {words}"
            )

        self._submit(MERGING, work, describe, self._begin_merge("turntable"))

    def _begin_merge(self, start: str) -> Callable[[BaseException], None]:
        """Forget why the last merge failed; returns what notes why this one did.

        `start` is its initial alignment, to which there are alternatives.
        """
        self._show(merge_failure="", merge_refusal=None)

        def failed(error: BaseException) -> None:
            """Store and report why the merge failed, and suggest another initial alignment where
            that may help."""
            text = describe_failure(MERGING, error)
            reason = error.reason if isinstance(error, Refused) else None
            if reason in ("overlap", "disagree"):
                other = "use the initial alignment by features, or by picked points"
                text = f"{text} Or {_ALTERNATIVES.get(start, other)}."
            self._show(merge_failure=text, merge_refusal=reason)
            self._notices.add("error", text, f"merge-{reason}" if reason else "merge")

        return failed

    def _last_merge(self, missing: str) -> str:
        """Return the number of the current merge. Raises InputError with ``missing`` without
        one."""
        session = self._publisher.refresh().session
        if session is None or session.merge is None:
            raise InputError(missing)
        return session.merge.name

    @request("Undoing the merge")
    def undo_merge(self) -> None:
        """Move the current merge to the trash; the previous one is current again."""
        number = self._last_merge("there is no merge to undo")
        self._store.trash_result(f"merge/{number}")
        (self._store.exports / f"merged_{number}.ply").unlink(missing_ok=True)

    # which points of scans are used

    @request("Setting the region")
    def set_region(self, region: RegionOfInterest, on: bool = True) -> None:
        """Make a box the session's region of interest, in effect or not."""
        save_region(self._store, region, on)

    @request("Switching the region")
    def switch_region(self, on: bool) -> None:
        """Put the last region of interest into effect, or use all points."""
        region = load_region(self._store, even_if_off=True)
        if region is None:
            raise InputError("there is no region yet: take the automatic one of a scan")
        save_region(self._store, region, on)

    @request("Setting the region")
    def fit_region(self, scan: str) -> None:
        """Make the box around all points of a reconstructed scan the region of interest."""
        save_region(self._store, RegionOfInterest.around(whole_cloud(self._store, scan).points))

    @request("Deleting points")
    def delete_points(self, selections: Sequence[Selection], what: str) -> None:
        """Delete what is selected of the points that are shown of one or several scans; `undo_edit`
        undoes it."""
        counts = delete_points(self._store, selections, what)
        self._notices.add(
            "info",
            f"{', '.join(counts)}: {sum(counts.values()):,} points deleted; Undo edit brings them"
            " back",
        )

    @request("Removing the support")
    def remove_support(self, *scans: str) -> None:
        """Delete the plane that the object stands on, and all below it, from scans; `undo_edit`
        undoes it for each.

        Scans without such a plane, and those that it was deleted from before, stay as they are,
        with a warning; where all of them do, it fails.
        """
        store, warn = self._store, self._warner("scans")

        def work(report: Reporter) -> str:
            """Delete the supports; returns a sentence about them."""
            selections, refused = list[Selection](), list[str]()
            for i, name in enumerate(scans):
                report(i / len(scans), f"removing the support from {name}")
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
            deleted = delete_points(store.guarded(report.saving), selections, SUPPORT)
            for reason in refused:
                warn(reason)
            report(1.0, "support removed")
            counts = ", ".join(f"{name} {count:,} points" for name, count in deleted.items())
            return f"support removed: {counts}; Undo edit brings it back"

        self._submit("Removing the support", work, str)

    @request("Undoing the edit")
    def undo_edit(self, *scans: str) -> None:
        """Undo the last edit of scans, of all those that it was made of."""
        step_history(self._store, scans)

    @request("Redoing the edit")
    def redo_edit(self, *scans: str) -> None:
        """Bring the last edit of scans that was undone back."""
        step_history(self._store, scans, redo=True)

    # files

    @request("Exporting")
    def export(
        self,
        what: What,
        name: str = "",
        file_format: str = "",
        plan: MeshingPlan | None = None,
        texture: int | None = None,
        white: str = "",
    ) -> None:
        """Write a file into the session's exports. `export.formats` lists the formats, the first is
        the default. `name`: the scan of a cloud or a mesh, the model of coefficients; a merge is
        the current one. `plan`: how to mesh; `texture`: side of its image, px, of a .glb or .obj;
        `white`: its white balance.
        """
        store, warn = self._store, self._warner("measurements")
        chosen = file_format or formats(what)[0]
        check_export(what, chosen)
        if what not in ("report", "table"):
            check_accepted(store, accepts_rejected(store))
        if what in ("cloud", "mesh"):
            store.load_capture(name)
        if what in ("merge", "merged-mesh"):
            name = self._last_merge("there is no merge yet: merge scans first")

        def write_textured(report: Reporter) -> str:
            """Write a mesh with a texture; returns a sentence that begins with the file's name."""
            source = f"{MERGED}{name}" if what == "merged-mesh" else name
            path = store.exports / default_file_name(what, name, chosen)
            made = mesh(
                store, [source], path, plan=plan, texture=texture, white=white,
                accept_rejected=accepts_rejected(store), progress=part(report, 0, 0.98), warn=warn,
            )  # fmt: skip
            assert made.textured is not None
            report(1.0, "exported")
            words = made.meshed.text().splitlines()[0]
            return f"{path.name} is ready to download: {words}; {made.textured.text()}"

        def write(report: Reporter) -> str:
            """Write any other file, as `_export_file` does."""
            return _export_file(
                store.guarded(report.saving), what, name, chosen, plan, report, warn
            )

        self._submit("Exporting", write if texture is None else write_textured, str)

    def report(self) -> bool:
        """Write the HTML report into the exports."""
        return self.export("report")

    @request("Collecting diagnostics")
    def diagnostic_bundle(self) -> None:
        """Write a zip with versions, settings, logs and small previews, without frames, into the
        exports."""
        self._submit(
            "Collecting diagnostics",
            partial(write_bundle, self._store, self._publisher.refresh(), self._preview, self._log),
            "{} is ready to download".format,
        )


def _export_file(
    session: Session,
    what: What,
    name: str,
    file_format: str,
    plan: MeshingPlan | None,
    progress: Progress,
    warn: Warn,
) -> str:
    """Write one file, as `pipeline.export.export` does; returns a sentence that begins with the
    file's name."""
    file_name = default_file_name(what, name, file_format)
    with session.staged_export(file_name) as path:
        exported = export(
            session, what, name, out=path, plan=plan, accept_rejected=accepts_rejected(session),
            progress=part(progress, 0, 0.98), warn=warn,
        )  # fmt: skip
    progress(1.0, "exported")
    return f"{file_name} is ready to download: {exported.words}"
