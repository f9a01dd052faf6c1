"""Requests to calibrate, verify, reconstruct and export, and to choose what results are made
from."""

from collections.abc import Sequence
from functools import partial
from typing import Any

from slviewer.errors import InputError
from slviewer.pipeline.align import FOLDER as PLACEMENTS
from slviewer.pipeline.align import AlignSettings, align, remove_placement
from slviewer.pipeline.calibrate import CalibrateSettings, calibrate
from slviewer.pipeline.export import What, check_export, default_file_name, formats
from slviewer.pipeline.measured_surface import MERGED
from slviewer.pipeline.models import (
    ModelName,
    accept_rejected_calibration,
    accepts_rejected,
    available_models,
    check_accepted,
)
from slviewer.pipeline.operations import OPERATIONS
from slviewer.pipeline.reconstruct import ReconstructSettings, VerifySettings, reconstruct, verify
from slviewer.pipeline.validate import ValidateSettings, validate
from slviewer.records.verification import Shape
from slviewer.session.names import clean_label
from slviewer.surface.meshing import MeshingPlan
from slviewer.wizard import diagnostics, tasks
from slviewer.wizard.export_files import export_file, export_textured
from slviewer.wizard.requests import RequestHandler, request


class ResultRequests(RequestHandler):
    """Requests that compute results from captures, and decisions about poses, scans and models."""

    @request("Excluding the pose")
    def exclude(self, name: str, why: str = "by hand") -> None:
        """Exclude a pose from calibrations."""
        self._engine.store.exclude(name, why)

    @request("Including the pose")
    def include(self, name: str) -> None:
        """Include an excluded pose again."""
        self._engine.store.include(name)

    @request("Deleting")
    def delete(self, name: str) -> None:
        """Move a capture, and its own results, to the session's trash."""
        store = self._engine.store
        store.trash_capture(name)
        store.include(name)
        for kind in ("poses", "clouds", "verify", "trust", PLACEMENTS):
            if store.state_of(f"{kind}/{name}") != "absent":
                store.trash_result(f"{kind}/{name}")

    @request("Restoring")
    def undelete(self, name: str) -> None:
        """Restore a deleted capture from the trash; its results are computed again."""
        store = self._engine.store
        store.restore_last(name)
        self._engine.reprocess(store.load_capture(name))

    @request("Renaming")
    def rename(self, name: str, label: str) -> None:
        """Set the label of a capture, any text; its files keep their name."""
        store = self._engine.store
        store.load_capture(name)
        store.decide("names", {**(store.decision("names") or {}), name: clean_label(label) or name})

    @request("Calibrating")
    def calibrate(self) -> None:
        """Calibrate every model that the included poses allow; others go to the trash."""
        engine, target = self._engine, self._engine.reader.target()
        if not target:
            raise InputError("choose the target first")
        models = ["stereo", "pixelwise"]
        if missing := tasks.missing_for_splined(engine.store):
            self._warner("calibration")(f"no splined model: {missing}")
        else:
            models.append("splined")

        def failed(error: BaseException) -> None:
            """Report why the calibration failed, and mark the session as changed."""
            engine.notices.add_failure("Calibrating", error)
            # a rejected calibration is saved, to be inspected
            engine.publisher.mark_changed(session=True)

        settings = CalibrateSettings(target, models, replace_all=True)
        self._run("Calibrating", calibrate, settings, "calibration", failed)

    @request("Comparing the models")
    def compare_models(self) -> None:
        """Cross-validate the models on the target poses; the best one is then recommended, and
        used."""
        self._run("Comparing the models", validate, ValidateSettings(), "calibration")

    @request("Choosing the model")
    def choose_model(self, name: str) -> None:
        """Set the model that later steps use; empty: the recommended one."""
        store = self._engine.store
        if name and name not in (models := available_models(store)):
            raise InputError(
                f"the session has no {name} calibration: choose one of {', '.join(models)}"
            )
        store.decide("model", name or None)

    @request("Using the rejected calibration")
    def accept_rejected_calibration(self, on: bool) -> None:
        """Allow or forbid using the current calibration although it was rejected."""
        accept_rejected_calibration(self._engine.store, on)

    @request("Verifying")
    def verify(self, names: Sequence[str], shape: Shape, radius_mm: float | None = None) -> None:
        """Compare the models on captures of a plane or a sphere; `radius_mm` helps to detect a
        sphere."""
        store = self._engine.store
        chosen = [store.load_capture(name).name for name in names]
        self._run(
            "Verifying",
            verify,
            VerifySettings(chosen, shape, radius=radius_mm, check=False),
            "scans",
        )

    @request("Reconstructing")
    def reconstruct(self, name: str, model: ModelName | None = None) -> None:
        """Reconstruct a capture, with the best model unless one is named."""
        self._engine.store.load_capture(name)
        self._run(
            "Reconstructing", reconstruct, ReconstructSettings(name, model, check=False), "scans"
        )

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
        chosen = [self._engine.store.load_capture(name).name for name in names]
        self._run("Aligning", align, AlignSettings(chosen, only_reconstructed=True), "merge")

    @request("Undoing the alignment")
    def undo_alignment(self, name: str) -> None:
        """Take a scan away from the aligned ones."""
        remove_placement(self._engine.store, name)

    @request("Switching the alignment of scans")
    def set_align_scans(self, on: bool) -> None:
        """Align each new scan to those before it as soon as it is reconstructed; those that are
        there at once."""
        self._engine.store.decide("align_scans", on or None)
        if on:
            self.align()

    def _finish_scan(self, name: str) -> None:
        """Reconstruct a scan that was just captured, and align it where that is wanted."""
        self.reconstruct(name)
        if self._engine.store.decision("align_scans"):
            self.align(name)

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
        store, view = self._engine.store, self._engine.publisher.refresh().session
        chosen = file_format or formats(what)[0]
        check_export(what, chosen)
        if what not in ("report", "table"):
            check_accepted(store, accepts_rejected(store))
        if what in ("cloud", "mesh"):
            store.load_capture(name)
        if what in ("merge", "merged-mesh"):
            if view is None or view.merge is None:
                raise InputError("there is no merge yet: merge scans first")
            name = view.merge.name
        if texture is None:
            write = partial(export_file, store, what, name, chosen, plan)
        else:
            source = f"{MERGED}{name}" if what == "merged-mesh" else name
            write = partial(
                export_textured,
                store,
                source,
                default_file_name(what, name, chosen),
                plan,
                texture,
                white,
            )
        self._submit("Exporting", partial(write, warn=self._warner("measurements")), str)

    def report(self) -> bool:
        """Write the HTML report into the exports."""
        return self.export("report")

    @request("Collecting diagnostics")
    def diagnostic_bundle(self) -> None:
        """Write a zip with versions, settings, logs and small previews, without frames, into the
        exports."""
        engine = self._engine
        store, snapshot = engine.store, engine.publisher.refresh()
        self._submit(
            "Collecting diagnostics",
            lambda report: diagnostics.write_bundle(
                store, snapshot, engine.preview, engine.log, report
            ),
            lambda file_name: f"{file_name} is ready to download",
        )
