"""Requests to calibrate, verify, reconstruct, merge, edit, measure and export, and to choose what
results are made from."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np

from slviewer.calibration.diagnosis.rules import FEW_POSES
from slviewer.errors import Cancelled, InputError, SlviewerError
from slviewer.inspection.regions import Region
from slviewer.pipeline.accept import ValidateSettings, validate
from slviewer.pipeline.calibrate import CalibrateSettings, calibrate
from slviewer.pipeline.capture import WATERTIGHT, merge_turn
from slviewer.pipeline.compare import CompareSettings, compare
from slviewer.pipeline.export import What, check_export, default_file_name, export, formats
from slviewer.pipeline.inspect_parts import TOLERANCE_MM, RunPlanSettings, make_plan, run_plan
from slviewer.pipeline.measure import (
    MERGED,
    MeasuredSurface,
    MeasureSettings,
    Place,
    RelateSettings,
    export_measurements,
    measure,
    relate,
)
from slviewer.pipeline.measure import What as Tool
from slviewer.pipeline.merge import (
    AlignSettings,
    MergeSettings,
    Picked,
    StartKind,
    align,
    merge,
)
from slviewer.pipeline.mesh import mesh
from slviewer.pipeline.models import (
    ModelName,
    accept_rejected_calibration,
    accepts_rejected,
    available_models,
    check_accepted,
)
from slviewer.pipeline.operation import Job, load_record, load_stored, part
from slviewer.pipeline.operations import OPERATIONS
from slviewer.pipeline.reconstruct import ReconstructSettings, VerifySettings, reconstruct, verify
from slviewer.records.calibration import ModelCalibration
from slviewer.records.measurement import MeasuredRegion, Measurement
from slviewer.records.record import format_count, from_plain, to_plain
from slviewer.records.verification import Shape
from slviewer.registration.refusal import Refused
from slviewer.session.inspection_plan import OWN_PLAN, PLANS, list_plans, read_plan, write_plan
from slviewer.session.names import plain_name, safe_name
from slviewer.session.nominal import NOMINALS, read_nominal
from slviewer.session.report_details import encode_logo
from slviewer.surface.meshing import MeshingPlan
from slviewer.wizard.change_requests import ChangeRequests
from slviewer.wizard.diagnostics import write_bundle
from slviewer.wizard.engine import request
from slviewer.wizard.jobs import describe_failure
from slviewer.wizard.result_views import surface_to_measure
from slviewer.wizard.session_reader import missing_for_splined
from slviewer.wizard.snapshot import WrittenFile

TABLE, PLAN = "measurements.csv", Path(OWN_PLAN).name
MERGING, MEASURING, COMPARING = "Merging", "Measuring", "Comparing with the nominal model"
_ALTERNATIVES = {
    "features": "use the initial alignment by picked points",
    "picked": "pick other points",
}
"""What else to try where scans cannot be aligned from a start, other than from those starts."""


class ResultRequests(ChangeRequests):
    """Requests that compute results from captures, decisions about poses, scans and models, and
    measurements on a scan or a merge."""

    @request("Calibrating")
    def calibrate(self) -> None:
        """Calibrate every model that the included poses allow, from the same known camera as
        before; others go to the trash."""
        target, models = self._reader.target(), ["stereo", "pixelwise"]
        if not target:
            raise InputError("choose the target first")
        if not (missing := missing_for_splined(self._store)):
            models.append("splined")
        elif self._publisher.latest.content.good_poses >= FEW_POSES:  # else the verdict says so
            self._warner("calibration")(f"no splined model: {missing}")
        before: Mapping[str, Any] = {}
        if "stereo" in available_models(self._store):
            before = load_record(self._store, ModelCalibration, "stereo").settings
        known = {key: before[key] for key in ("camera", "fix_camera") if key in before}
        settings = CalibrateSettings(target, models, replace_all=True, **known)
        self._run("Calibrating", calibrate, settings, "calibration", change="calibrate")

    @request("Comparing the models")
    def compare_models(self) -> None:
        """Cross-validate the models on the target poses; the best one is then recommended, and
        used."""
        self._run("Comparing the models", validate, ValidateSettings(), "calibration")

    @request("Using the rejected calibration")
    def accept_rejected_calibration(self, on: bool) -> None:
        """Use the present calibration although it was rejected, or not."""
        accept_rejected_calibration(self._store, on)

    @request("Verifying")
    def verify(self, names: Sequence[str], shape: Shape, **inputs: Any) -> None:
        """Compare the models on captures of a plane or a sphere; `inputs`: further settings."""
        settings = VerifySettings(self._check_names(names), shape, check=False, **inputs)
        self._run("Verifying", verify, settings, "scans")

    @request("Reconstructing")
    def reconstruct(self, name: str, model: ModelName | None = None) -> None:
        """Reconstruct a capture, with the best model unless one is named."""
        self._store.load_capture(name)
        settings = ReconstructSettings(name, model, check=False)
        self._run("Reconstructing", reconstruct, settings, "scans")

    @request("Reconstructing")
    def reconstruct_all(self) -> None:
        """Reconstruct every scan that has no up-to-date cloud, with the model in use; one that
        cannot be reconstructed is named, and the others are."""
        pending = self._publisher.latest.content.pending_scans
        if not pending:
            raise InputError("every scan is reconstructed")

        def work(job: Job) -> str:
            """Reconstruct one after the other."""
            accepts, done = accepts_rejected(job.store), 0
            for k, name in enumerate(pending):
                settings = ReconstructSettings(name, check=False, accept_rejected=accepts)
                each = job.part(k / len(pending), (k + 1) / len(pending), name)
                try:
                    reconstruct.run(each.store, settings, each.progress, each.warn)
                    done += 1
                except Cancelled:
                    raise
                except SlviewerError as error:
                    job.warn(f"{self._label(name)} was not reconstructed: {error}")
                self._publisher.mark_changed()
            return f"{done} of {format_count(len(pending), 'scan')} reconstructed"

        self._work("Reconstructing", work, "scans")

    @request("Running the operation")
    def run(self, operation: str, **settings: Any) -> None:
        """Run any operation by the name of its command, with its settings."""
        if operation not in OPERATIONS:
            raise InputError(
                f"there is no operation {operation!r}", f"choose one of {', '.join(OPERATIONS)}"
            )
        chosen = OPERATIONS[operation]
        self._run(operation.capitalize(), chosen, chosen.settings(**settings))

    @request("Aligning")
    def align(self, *names: str) -> None:
        """Align reconstructed scans to those in place; without names all that were not aligned
        yet."""
        settings = AlignSettings(self._check_names(names), only_reconstructed=True)
        labels = " ".join(["align", ", ".join(map(self._label, names))]).strip()
        self._run("Aligning", align, settings, "merge", change=labels)

    def _check_names(self, names: Sequence[str]) -> list[str]:
        """Return names of captures. Raises InputError for one that does not exist."""
        return [self._store.load_capture(name).name for name in names]

    @request("Switching the alignment of scans")
    def set_align_scans(self, on: bool) -> None:
        """Align each new scan to those before it as soon as it is reconstructed; those that are
        there at once."""
        self._store.decide("align_scans", on or None)
        if on:
            self.align()

    # merges

    @request(MERGING)
    def merge(
        self,
        names: Sequence[str],
        reference: str,
        *,
        start: StartKind = "features",
        fixed: bool = False,
        angle: float | None = None,
        picked: Picked | None = None,
    ) -> None:
        """Register scans, in the order in which they were captured, to a reference, and merge them.

        The snapshot shows why a merge failed until the next one. `start`,
        `fixed`, `angle` and `picked` as in `pipeline.merge`.
        """
        chosen = self._check_names(names)
        failed = self._begin_merge("picked" if picked else start)
        try:
            settings = MergeSettings(
                chosen, reference, start=start, fixed=fixed, angle=angle, picked=picked
            )
        except SlviewerError as error:
            failed(error)
            return
        self._run(MERGING, merge, settings, "merge", failed=failed, finish=self._finish("merge"))

    def _merge_turn(self, names: list[str]) -> None:
        """Queue the merge of the scans of a turn by the angles of its turntable, and a watertight
        mesh of it in the exports; where that does not close, the merge stays."""

        def work(job: Job) -> str:
            """Merge and mesh; returns a sentence about both."""
            settings = MergeSettings(names, names[0], accept_rejected=accepts_rejected(job.store))
            found = merge_turn(job.store, settings, part(job.progress, 0, 0.7), job.warn)
            finish(found)
            ((number, merged),) = found.items()
            try:
                file = _export_file(job.part(0.7, 1), "merged-mesh", number, "ply", WATERTIGHT)
                words = file.summary()
            except Cancelled:
                raise
            except SlviewerError as error:
                words = "no watertight mesh was made"
                job.warn(f"{words}: {error}")
            job.progress(1.0, "merged")
            worst = max(pair.rms_mm or 0.0 for pair in merged.pairs.values())
            return (
                f"{len(merged.scans)} scans merged on {merged.reference}, RMS up to {worst:.3f} mm;"
                f" {words}"
            )

        finish = self._finish("merge")
        self._work(MERGING, work, "merge", self._begin_merge("turntable"))

    def _begin_merge(self, start: str) -> Callable[[BaseException], None]:
        """Forget why the last merge failed; returns what notes why this one did.

        `start` is its initial alignment, to which there are alternatives.
        """
        self.show(merge_failure="", merge_refusal=None)

        def failed(error: BaseException) -> None:
            """Store and report why the merge failed, and suggest another initial alignment where
            that may help."""
            text = describe_failure(MERGING, error)
            reason = error.reason if isinstance(error, Refused) else None
            if reason in ("overlap", "disagree"):
                other = "use the initial alignment by features, or by picked points"
                text = f"{text} Or {_ALTERNATIVES.get(start, other)}."
            self.show(merge_failure=text, merge_refusal=reason)
            self._notices.add("error", text, f"merge-{reason}" if reason else "merge")

        return failed

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
        is_full: bool = False,
    ) -> None:
        """Write a file into the session's exports. `export.formats` lists the formats, the first is
        the default. `name`: the scan of a cloud or a mesh, the model of coefficients; a merge is
        the current one. `plan`: how to mesh; `texture`: side of its image, px, of a .glb or .obj;
        `white`: its white balance. `is_full`: of a report, with all of the annex.
        """
        store, chosen = self._store, file_format or formats(what)[0]
        check_export(what, chosen)
        if what not in ("report", "table"):
            check_accepted(store, accepts_rejected(store))
        if what in ("cloud", "mesh"):
            store.load_capture(name)
        if what in ("merge", "merged-mesh"):
            name = self._last_merge("there is no merge yet: merge scans first")

        self._work(
            "Exporting",
            lambda job: _export_file(job, what, name, chosen, plan, texture, white, is_full),
            "measurements",
        )

    @request("Changing the title page")
    def set_report_details(self, **changed: Any) -> None:
        """Set some of what the title page of reports states."""
        self._store.set_report_details(**changed)

    @request("Reading the logo")
    def upload_logo(self, name: str, content: bytes) -> None:
        """Set an uploaded image as the report's logo."""
        self._store.set_report_details(logo=encode_logo(name, content))

    @request("Collecting diagnostics")
    def diagnostic_bundle(self) -> None:
        """Write a zip with versions, settings, logs and small previews, without frames, into the
        exports."""
        snapshot, preview = self._publisher.refresh(), self._preview
        self._work(
            "Collecting diagnostics",
            lambda job: write_bundle(job, snapshot, preview, self._log),
        )

    # measuring

    def surface(self, name: str) -> MeasuredSurface:
        """Load a scan or merge to measure on, which is slow. Raises InputError where it cannot be
        measured on."""
        return surface_to_measure(self._store, name)

    @request(MEASURING)
    def measure(
        self, on: str, what: Tool, at: Sequence[Place] = (), region: Region | None = None
    ) -> None:
        """Measure on a surface, at places of it, or in a region."""
        chosen = (
            {} if region is None else from_plain(to_plain(region), MeasuredRegion).to_settings()
        )
        chosen["at"] = [int(number) for number in np.ravel(at)] if len(at) else ()
        settings = MeasureSettings(on, what, **chosen, load=partial(surface_to_measure, name=on))
        self._run(MEASURING, measure, settings, "measurements", finish=self._finish("measure"))

    @request(MEASURING)
    def move_point(self, name: str, end: int, place: Place) -> None:
        """Measure again with one of the points of a measurement, from 0, at another place of its
        surface."""
        before = load_stored(self._store, Measurement, name)
        on, at = before.record.source, before.record.places()
        if before.stale or not at:
            raise InputError(f"{before.label} has no points on its surface", "measure again")
        at[end] = place
        settings = MeasureSettings(
            on, cast(Tool, before.record.what), [int(number) for number in np.ravel(at)],
            name=before.record.name, load=partial(surface_to_measure, name=on), replaces=name,
        )  # fmt: skip
        change = f"move a point of {before.label}"
        self._run(MEASURING, measure, settings, "measurements", change=change)

    @request(MEASURING)
    def measure_between(self, a: str, b: str) -> None:
        """Measure angles and distances between two points or fits, by their ids."""
        finish = self._finish("measure")
        self._run(MEASURING, relate, RelateSettings(a, b), "measurements", finish=finish)

    @request("Reading the nominal model")
    def upload_nominal(self, name: str, content: bytes) -> None:
        """Save an uploaded nominal model in the session, if it can be read."""
        title = "Reading the nominal model"
        self._save_upload(title, NOMINALS, name, content, lambda path: read_nominal(path).text())

    @request("Reading the plan")
    def upload_plan(self, name: str, content: bytes) -> None:
        """Save an uploaded inspection plan in the session, if it can be read. Its nominal model is
        the session's one of that file name."""

        def describe(path: Path) -> str:
            """Read the plan; returns a sentence about it."""
            plan = read_plan(path)
            return (
                f"{plan.name}: {format_count(len(plan.characteristic), 'characteristic')}; run it"
                " on a scan"
            )

        if not name.lower().endswith(".toml"):
            raise InputError(
                f"{name} is not a plan",
                "choose the .toml file that Make plan or slviewer plan wrote",
            )
        self._save_upload("Reading the plan", PLANS, name, content, describe)

    def _save_upload(
        self, title: str, place: str, name: str, content: bytes, read: Callable[[Path], str]
    ) -> None:
        """Save an uploaded file in a folder of the session, if ``read`` can read it, which
        describes it."""
        plain = plain_name(Path(name).name, "nominal")

        def work(job: Job) -> str:
            """Write the upload to its place if it can be read; returns its description."""
            job.progress(0.0, f"reading {plain}")
            target = job.store.folder / place / plain
            with job.store.staged_file(target, len(content)) as path:
                path.write_bytes(content)
                description = read(path)
            job.progress(1.0, "read")
            return description

        self._work(title, work)

    @request("Running the plan")
    def run_plan(self, plan: str, *surfaces: str) -> None:
        """Inspect surfaces, each a part, by a plan of `SessionView.plans`; also writes the report
        into the exports."""
        store = self._store
        if plan not in list_plans(store.folder):
            raise InputError(
                f"there is no plan {plan!r} in the session", "make or upload one first"
            )
        if not surfaces:
            raise InputError("no scan to inspect", "reconstruct one in the step Scan first")
        settings = RunPlanSettings(store.folder / plan, surfaces)
        self._run("Running the plan", run_plan, settings, "measurements")

    @request(COMPARING)
    def compare_nominal(self, on: str, nominal: str, **inputs: Any) -> None:
        """Measure a surface's deviation from one of the session's nominal models after best fit,
        with further settings of `compare`; also writes a PLY."""
        path = self._store.folder / NOMINALS / safe_name(nominal)
        if not path.is_file():
            raise InputError(
                f"there is no nominal model {nominal!r} in the session", "upload it first"
            )
        load = partial(surface_to_measure, name=on)
        settings = CompareSettings(on, path, load=load, **inputs)

        def failed(error: BaseException) -> None:
            """Report why, in the words of the panel."""
            self._notices.add_failure(COMPARING, _reword(error))

        finish = self._finish("compare")
        self._run(COMPARING, compare, settings, "measurements", failed=failed, finish=finish)

    @request("Writing the table")
    def export_measurements_table(self) -> None:
        """Write all measurements as CSV into the exports."""

        def write(job: Job, path: Path) -> str:
            """Write the CSV; returns the number of measurements in words."""
            return format_count(export_measurements(job.store, path), "measurement")

        self._export_by("Writing the table", TABLE, write)

    @request("Making the plan")
    def make_inspection_plan(self) -> None:
        """Write an inspection plan of the fits and relations into the exports, to repeat them on
        other scans."""

        def write(job: Job, path: Path) -> str:
            """Write the plan; returns what to do with it."""
            made = make_plan(job, TOLERANCE_MM, job.store.folder.name)
            write_plan(made, path)
            return (
                f"{format_count(len(made.characteristic), 'characteristic')}; set its limits, then"
                f" upload it below, or run slviewer inspect-parts {PLAN} SESSION..."
            )

        self._export_by("Making the plan", PLAN, write)

    def _export_by(self, title: str, name: str, write: Callable[[Job, Path], str]) -> None:
        """Queue the writing of a file into the exports; ``write`` returns words about it."""

        def work(job: Job) -> WrittenFile:
            """Write the file."""
            with job.store.staged_export(name) as path:
                words = write(job, path)
            job.progress(1.0, "written")
            return WrittenFile(name, words)

        self._work(title, work, "measurements")


def _export_file(
    job: Job,
    what: What,
    name: str,
    file_format: str,
    plan: MeshingPlan | None,
    texture: int | None = None,
    white: str = "",
    is_full: bool = False,
) -> WrittenFile:
    """Write one file, as `pipeline.export.export` does, or a mesh with a texture."""
    store, file_name = job.store, default_file_name(what, name, file_format)
    options: dict[str, Any] = {
        "plan": plan, "accept_rejected": accepts_rejected(store),
        "progress": part(job.progress, 0, 0.98), "warn": job.warn,
    }  # fmt: skip
    if texture is None:
        with store.staged_export(file_name) as path:
            words = export(store, what, name, out=path, full=is_full, **options).words
    else:
        source = f"{MERGED}{name}" if what == "merged-mesh" else name
        out = store.exports / file_name
        made = mesh(store, [source], out, texture=texture, white=white, **options)
        assert made.textured is not None
        words = f"{made.meshed.text().splitlines()[0]}; {made.textured.text()}"
    job.progress(1.0, "exported")
    return WrittenFile(file_name, words)


def _reword(error: BaseException) -> BaseException:
    """Return an error without the command line's option ``--units``."""
    if not isinstance(error, InputError):
        return error
    return InputError(
        str(error).replace("give --units ", "choose its units, ").replace("--units ", "")
    )
