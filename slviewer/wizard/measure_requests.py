"""Requests to measure on surfaces: points, distances, fits, sections, deviations from a nominal
model."""

import re
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from slviewer.errors import InputError
from slviewer.evaluation.render import format_count
from slviewer.inspection.regions import Region
from slviewer.pipeline.compare import CompareSettings, compare
from slviewer.pipeline.inspect_parts import TOLERANCE_MM, RunPlanSettings, make_plan, run_plan
from slviewer.pipeline.measure import (
    MeasuredSurface,
    MeasureSettings,
    Place,
    RelateSettings,
    What,
    export_measurements,
    measure,
    relate,
    rename_measurement,
    restore_measurement,
    trash_measurement,
)
from slviewer.pipeline.operation import Job
from slviewer.records.measurement import MeasuredRegion
from slviewer.records.plain import from_plain, to_plain
from slviewer.session import atomic
from slviewer.session.atomic import rename
from slviewer.session.inspection_plan import OWN_PLAN, PLANS, list_plans, read_plan, write_plan
from slviewer.session.names import safe_name
from slviewer.session.nominal import NOMINALS, Units, read_nominal
from slviewer.wizard.engine import Engine, request
from slviewer.wizard.jobs import Reporter
from slviewer.wizard.surfaces import Surfaces

TABLE, PLAN = "measurements.csv", Path(OWN_PLAN).name
MEASURING, COMPARING = "Measuring", "Comparing with the nominal model"


class MeasureRequests(Engine):
    """Requests that measure on a scan or a merge, on the worker, and edit the list of
    measurements."""

    _surfaces: Surfaces

    def surface(self, name: str) -> MeasuredSurface:
        """Load a scan or merge to measure on, which is slow. Raises InputError where it cannot be
        measured on."""
        return self._surfaces.load(self._store, name)

    @request(MEASURING)
    def measure(
        self, on: str, what: What, at: Sequence[Place] = (), region: Region | None = None
    ) -> None:
        """Measure on a surface, at places of it, or in a region."""
        chosen = (
            {} if region is None else from_plain(to_plain(region), MeasuredRegion).to_settings()
        )
        chosen["at"] = [int(number) for number in np.ravel(at)] if len(at) else ()
        settings = MeasureSettings(on, what, **chosen, load=partial(self._surfaces.load, name=on))
        self._run(MEASURING, measure, settings, "measurements")

    @request(MEASURING)
    def measure_between(self, a: str, b: str) -> None:
        """Measure angles and distances between two points or fits, by their ids."""
        self._run(MEASURING, relate, RelateSettings(a, b), "measurements")

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
                f"{name} is not a plan: choose the .toml file that Make plan or slviewer plan wrote"
            )
        self._save_upload("Reading the plan", PLANS, name, content, describe)

    def _save_upload(
        self, title: str, place: str, name: str, content: bytes, read: Callable[[Path], str]
    ) -> None:
        """Save an uploaded file in a folder of the session, if ``read`` can read it, which
        describes it."""
        store, plain = self._store, plain_name(name)

        def work(report: Reporter) -> str:
            """Write the upload to its place if it can be read; returns its description."""
            report(0.0, f"reading {plain}")
            target = store.folder / place / plain
            with atomic.staged_folder(target, len(content)) as folder:
                (folder / plain).write_bytes(content)
                description = read(folder / plain)
                report.saving()
                rename(folder / plain, target)
            atomic.discard(folder)
            report(1.0, "read")
            return description

        self._submit(title, work, str)

    @request("Running the plan")
    def run_plan(self, plan: str, *surfaces: str) -> None:
        """Inspect surfaces, each a part, by a plan of `SessionView.plans`; also writes the report
        into the exports."""
        store = self._store
        if plan not in list_plans(store.folder):
            raise InputError(f"there is no plan {plan!r} in the session: make or upload one first")
        if not surfaces:
            raise InputError("no scan to inspect: reconstruct one in the step Scan first")
        settings = RunPlanSettings(store.folder / plan, surfaces)
        self._run("Running the plan", run_plan, settings, "measurements")

    @request(COMPARING)
    def compare_nominal(
        self, on: str, nominal: str, units: Units | None = None, tolerance_mm: float | None = None
    ) -> None:
        """Measure a surface's deviation from one of the session's nominal models after best fit;
        also writes a PLY."""
        path = self._store.folder / NOMINALS / safe_name(nominal)
        if not path.is_file():
            raise InputError(
                f"there is no nominal model {nominal!r} in the session: upload it first"
            )
        load = partial(self._surfaces.load, name=on)
        settings = CompareSettings(on, path, tolerance_mm, units, load=load)

        def failed(error: BaseException) -> None:
            """Report why, in the words of the panel."""
            self._notices.add_failure(COMPARING, _reword(error))

        self._run(COMPARING, compare, settings, "measurements", failed)

    @request("Renaming")
    def relabel_measurement(self, identity: str, name: str) -> None:
        """Rename a measurement; an empty name restores its original name."""
        rename_measurement(self._store, identity, name)

    @request("Deleting")
    def delete_measurement(self, identity: str) -> None:
        """Move a measurement to the trash; results made from it are stale until it is restored."""
        trash_measurement(self._store, identity)

    @request("Restoring")
    def undo_delete(self) -> None:
        """Restore the measurement that was deleted last."""
        restore_measurement(self._store)

    @request("Writing the table")
    def export_measurements_table(self) -> None:
        """Write all measurements as CSV into the exports."""
        store = self._store

        def write(path: Path) -> str:
            """Write the CSV; returns the number of measurements in words."""
            return format_count(export_measurements(store, path), "measurement")

        self._submit_export("Writing the table", TABLE, write)

    @request("Making the plan")
    def make_inspection_plan(self) -> None:
        """Write an inspection plan of the fits and relations into the exports, to repeat them on
        other scans."""
        store, warn = self._store, self._warner("measurements")

        def write(path: Path) -> str:
            """Write the plan; returns what to do with it."""
            made = make_plan(Job(store, warn=warn), TOLERANCE_MM, store.folder.name)
            write_plan(made, path)
            return (
                f"{format_count(len(made.characteristic), 'characteristic')}; set its limits, then"
                f" upload it below, or run slviewer inspect-parts {PLAN} SESSION..."
            )

        self._submit_export("Making the plan", PLAN, write)

    def _submit_export(self, title: str, name: str, write: Callable[[Path], str]) -> None:
        """Queue the writing of a file into the exports; ``write`` returns words about it."""
        store = self._store

        def work(report: Reporter) -> str:
            """Write the file; returns a sentence about it."""
            with store.guarded(report.saving).staged_export(name) as path:
                words = write(path)
            report(1.0, "written")
            return f"{name} is ready to download: {words}"

        self._submit(title, work, str)


def _reword(error: BaseException) -> BaseException:
    """Return an error without the command line's option ``--units``."""
    if not isinstance(error, InputError):
        return error
    return InputError(
        str(error).replace("give --units ", "choose its units, ").replace("--units ", "")
    )


def plain_name(name: str) -> str:
    """Return a valid file name for the session: ASCII letters, digits, '_', '-' and '.', at most
    100 characters."""
    plain = re.sub(r"[^A-Za-z0-9_.-]+", "_", Path(name).name).lstrip(".-")
    return safe_name(plain[-100:].lstrip(".-") or "nominal")
