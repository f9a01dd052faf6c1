"""Requests to measure on surfaces: points, distances, fits, sections, deviations from a nominal
model."""

import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Concatenate, ParamSpec

from slviewer.errors import InputError
from slviewer.evaluation.render import format_count
from slviewer.inspection.tolerance import DECIDED
from slviewer.pipeline import measurements
from slviewer.pipeline.compare import NominalComparison, compare_surface
from slviewer.pipeline.measured_surface import MeasuredSurface
from slviewer.pipeline.plan import TOLERANCE_MM, make_plan
from slviewer.pipeline.run_plan import RunPlanSettings, run_plan
from slviewer.session import atomic
from slviewer.session.atomic import rename
from slviewer.session.inspection_plan import OWN_PLAN, PLANS, list_plans, read_plan, write_plan
from slviewer.session.measurements import (
    Measurement,
    rename_measurement,
    restore_measurement,
    trash_measurement,
)
from slviewer.session.names import safe_name
from slviewer.session.nominal import NOMINALS, Units, read_nominal
from slviewer.session.store import Session
from slviewer.wizard.jobs import Reporter
from slviewer.wizard.requests import RequestHandler, request
from slviewer.wizard.surfaces import Surfaces

P = ParamSpec("P")
TABLE, PLAN = "measurements.csv", Path(OWN_PLAN).name
MEASURING, COMPARING = "Measuring", "Comparing with the nominal model"


class MeasureRequests(RequestHandler):
    """Requests that measure on a scan or a merge, on the worker, and edit the list of
    measurements."""

    _surfaces: Surfaces

    def surface(self, name: str) -> MeasuredSurface:
        """Load a scan or merge to measure on, which is slow. Raises InputError where it cannot be
        measured on."""
        return self._surfaces.load(self._engine.store, name)

    @request(MEASURING)
    def measure(
        self,
        on: str,
        add: Callable[Concatenate[Session, MeasuredSurface, P], Measurement],
        *args: P.args,
        **kwargs: P.kwargs,
    ) -> None:
        """Measure on a surface by a function of `pipeline.measurements`: `measure("scan_01",
        add_distance, a, b)`."""
        store = self._engine.store

        def work(report: Reporter) -> Measurement:
            """Load the surface, then add and return the measurement."""
            report(0.0, f"measuring on {on}")
            surface = self._surfaces.load(store, on)
            return add(store.guarded(report.saving), surface, *args, **kwargs)

        self._submit(MEASURING, work, describe_quantities)

    @request(MEASURING)
    def measure_between(self, a: str, b: str) -> None:
        """Measure angles and distances between two points or fits, by their ids."""
        store = self._engine.store

        def work(report: Reporter) -> Measurement:
            """Add and return the relation of the two measurements."""
            return measurements.add_relation(store.guarded(report.saving), a, b)

        self._submit(MEASURING, work, describe_quantities)

    @request("Reading the nominal model")
    def upload_nominal(self, name: str, content: bytes) -> None:
        """Save an uploaded nominal model in the session, if it can be read."""
        self._save_upload(
            "Reading the nominal model",
            NOMINALS,
            name,
            content,
            lambda path: read_nominal(path).text(),
        )

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
                f"{name} is no plan: choose the .toml file that Make plan or slviewer plan wrote"
            )
        self._save_upload("Reading the plan", PLANS, name, content, describe)

    def _save_upload(
        self, title: str, place: str, name: str, content: bytes, read: Callable[[Path], str]
    ) -> None:
        """Save an uploaded file in a folder of the session, if ``read`` can read it, which
        describes it."""
        store, plain = self._engine.store, plain_name(name)

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
        store = self._engine.store
        if plan not in list_plans(store.folder):
            raise InputError(f"there is no plan {plan!r} in the session: make or upload one first")
        if not surfaces:
            raise InputError("no scan to inspect: reconstruct one in the step Scan first")

        self._run(
            "Running the plan",
            run_plan,
            RunPlanSettings(store.folder / plan, surfaces),
            "measurements",
        )

    @request(COMPARING)
    def compare_nominal(
        self, on: str, nominal: str, units: Units | None = None, tolerance_mm: float | None = None
    ) -> None:
        """Measure a surface's deviation from one of the session's nominal models after best fit;
        also writes a PLY."""
        store = self._engine.store
        path = store.folder / NOMINALS / safe_name(nominal)
        if not path.is_file():
            raise InputError(
                f"there is no nominal model {nominal!r} in the session: upload it first"
            )

        def work(report: Reporter) -> NominalComparison:
            """Compare the surface with the nominal model, and write the deviations as PLY into the
            exports."""
            report(0.0, f"reading {nominal}")
            ideal, surface = read_nominal(path, units), self._surfaces.load(store, on)
            name = f"{on.replace('/', '_')}_{path.stem}_deviation.ply"
            with store.guarded(report.saving).staged_export(name) as ply, _reword_errors():
                result = compare_surface(
                    store.guarded(report.saving),
                    surface,
                    ideal,
                    tolerance=tolerance_mm,
                    out=ply,
                    progress=report.within(0.05, 0.98),
                    warn=self._warner("measurements"),
                )
            for note in ideal.notes:
                self._warner("measurements")(f"{ideal.name}: {note}")
            report(1.0, "compared")
            return result

        self._submit(COMPARING, work, describe_deviation)

    @request("Renaming")
    def relabel_measurement(self, identity: str, name: str) -> None:
        """Rename a measurement; an empty name restores its original name."""
        rename_measurement(self._engine.store, identity, name)

    @request("Deleting")
    def delete_measurement(self, identity: str) -> None:
        """Move a measurement to the trash; results made from it are stale until it is restored."""
        trash_measurement(self._engine.store, identity)

    @request("Restoring")
    def undo_delete(self) -> None:
        """Restore the measurement that was deleted last."""
        restore_measurement(self._engine.store)

    @request("Writing the table")
    def export_measurements_table(self) -> None:
        """Write all measurements as CSV into the exports."""
        store = self._engine.store

        def work(report: Reporter) -> str:
            """Write the CSV into the exports; returns a sentence with the number of
            measurements."""
            with store.guarded(report.saving).staged_export(TABLE) as path:
                count = measurements.export_measurements(store, path)
            report(1.0, "written")
            return f"{TABLE} is ready to download: {count} measurement{'s' * (count != 1)}"

        self._submit("Writing the table", work, str)

    @request("Making the plan")
    def make_inspection_plan(self) -> None:
        """Write an inspection plan of the fits and relations into the exports, to repeat them on
        other scans."""
        store = self._engine.store

        def work(report: Reporter) -> str:
            """Write the plan into the exports; returns a sentence with what to do with it."""
            made = make_plan(
                store, TOLERANCE_MM, name=store.folder.name, warn=self._warner("measurements")
            )
            with store.guarded(report.saving).staged_export(PLAN) as path:
                write_plan(made, path)
            report(1.0, "written")
            return (
                f"{PLAN} is ready to download:"
                f" {format_count(len(made.characteristic), 'characteristic')}; set its limits, then"
                f" upload it below, or run slviewer inspect-parts {PLAN} SESSION..."
            )

        self._submit("Making the plan", work, str)


@contextmanager
def _reword_errors() -> Iterator[None]:
    """Reword InputErrors raised in the block: remove the command line's option ``--units``."""
    try:
        yield
    except InputError as error:
        raise InputError(
            str(error).replace("give --units ", "choose its units, ").replace("--units ", "")
        ) from error


def describe_quantities(measured: Measurement) -> str:
    """Describe a measurement in one sentence: its name and quantities."""
    values = "; ".join(quantity.text() for quantity in measured.quantities)
    return f"{measured.name}: {values}"


def describe_deviation(result: NominalComparison) -> str:
    """Describe a comparison in one sentence: RMS deviation in mm, and the decision against the
    tolerance."""
    text = (
        f"{result.scan} against {result.nominal.name}: RMS"
        f" {result.found.statistics()['rms']:.4f} mm"
    )
    if result.verdict is None:
        return text
    return (
        f"{text}; tolerance ± {result.verdict.tolerance_mm:g} mm:"
        f" {DECIDED[result.verdict.decision]}"
    )


def plain_name(name: str) -> str:
    """Return a valid file name for the session: ASCII letters, digits, '_', '-' and '.', at most
    100 characters."""
    plain = re.sub(r"[^A-Za-z0-9_.-]+", "_", Path(name).name).lstrip(".-")
    return safe_name(plain[-100:].lstrip(".-") or "nominal")
