"""What an operator can ask of surfaces: points, distances, fits, sections, deviations from a nominal model."""

import os
import re
from abc import abstractmethod
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

from slviewer.errors import InputError
from slviewer.inspection.regions import Region
from slviewer.inspection.tolerance import DECIDED
from slviewer.pipeline import measurements
from slviewer.pipeline.compare import Compared, compare_surface
from slviewer.pipeline.measured_surface import MeasuredSurface, Place
from slviewer.session import atomic
from slviewer.session.measurements import Measurement
from slviewer.session.names import safe_name
from slviewer.session.nominal import Units, read_nominal
from slviewer.session.store import Session
from slviewer.wizard.export_files import delivered
from slviewer.wizard.jobs import Reporter
from slviewer.wizard.requests import RequestHandler, request
from slviewer.wizard.surfaces import NOMINALS, Surfaces

TABLE = "measurements.csv"
MEASURING, COMPARING = "Measuring", "Comparing with the nominal model"
T = TypeVar("T")


class MeasureRequests(RequestHandler):
    """Measuring on a scan or a merge, each by the worker; and the list of what was measured."""

    _surfaces: Surfaces

    def surface(self, name: str) -> MeasuredSurface:
        """A scan or merge as it is measured on; reading it takes its time, and InputError says why it cannot be."""
        return self._surfaces.of(self._engine.store, name)

    @request(MEASURING)
    def measure_point(self, on: str, at: Place) -> None:
        """Keep a picked point, for what lies between it and others."""
        self._measure(on, lambda store, surface: measurements.add_point(store, surface, at))

    @request(MEASURING)
    def measure_distance(self, on: str, a: Place, b: Place) -> None:
        """Between two picked points."""
        self._measure(on, lambda store, surface: measurements.add_distance(store, surface, a, b))

    @request(MEASURING)
    def measure_shape(self, on: str, shape: measurements.Shape, region: Region) -> None:
        """Fit a plane, a sphere or a cylinder to a region."""
        self._measure(on, lambda store, surface: measurements.add_fit(store, surface, shape, region))

    @request(MEASURING)
    def measure_section(self, on: str, a: Place, b: Place) -> None:
        """Cut the surface through two picked points and the camera."""
        self._measure(on, lambda store, surface: measurements.add_section(store, surface, a, b))

    @request(MEASURING)
    def measure_between(self, a: str, b: str) -> None:
        """Angles and distances between two points or fits, by their ids."""
        store = self._engine.store

        def work(report: Reporter) -> Measurement:
            report(0.0, "measuring")
            found = measurements.add_relation(store.guarded(report.saving), a, b)
            report(1.0, "measured")
            return found

        self._submit(MEASURING, work, told)

    @request("Reading the nominal model")
    def take_nominal(self, name: str, content: bytes) -> None:
        """Keep a nominal model that was uploaded in the session, if it is one that can be used."""
        store, plain = self._engine.store, plain_name(name)

        def work(report: Reporter) -> str:
            report(0.0, f"looking at {plain}")
            target = store.folder / NOMINALS / plain
            with atomic.staged_folder(target, len(content)) as folder:
                (folder / plain).write_bytes(content)
                found = read_nominal(folder / plain).text()
                report.saving()
                os.replace(folder / plain, target)
            atomic.discard(folder)
            report(1.0, "read")
            return found

        self._submit("Reading the nominal model", work, str)

    @request(COMPARING)
    def compare_nominal(
        self, on: str, nominal: str, units: Units | None = None, tolerance_mm: float | None = None
    ) -> None:
        """How far a surface lies off one of the session's nominal models after best fit; kept, and written as a PLY."""
        store = self._engine.store
        path = store.folder / NOMINALS / safe_name(nominal)
        if not path.is_file():
            raise InputError(f"there is no nominal model {nominal!r} in the session: upload it first")

        def work(report: Reporter) -> Compared:
            report(0.0, f"reading {nominal}")
            ideal, surface = read_nominal(path, units), self._surfaces.of(store, on)
            name = f"{on.replace('/', '_')}_{path.stem}_deviation.ply"
            with delivered(store, name, report) as ply, _asked_here():
                found = compare_surface(
                    store.guarded(report.saving),
                    surface,
                    ideal,
                    tolerance=tolerance_mm,
                    out=ply,
                    progress=report.within(0.05, 0.98),
                    warn=self._warn,
                )
            for note in ideal.notes:
                self._warn(f"{ideal.name}: {note}")
            report(1.0, "compared")
            return found

        self._submit(COMPARING, work, told_comparison)

    @request("Renaming")
    def rename_measurement(self, identity: str, name: str) -> None:
        """Give a measurement a name; an empty one gives back its first."""
        measurements.rename(self._engine.store, identity, name)

    @request("Deleting")
    def delete_measurement(self, identity: str) -> None:
        """Move a measurement to the trash; what was made from it becomes stale until it is back."""
        measurements.remove(self._engine.store, identity)

    @request("Bringing back")
    def restore_measurement(self) -> None:
        """Bring the measurement back that was deleted last."""
        measurements.restore(self._engine.store)

    @request("Writing the table")
    def write_measurements(self) -> None:
        """Write all measurements as CSV into the exports."""
        store = self._engine.store

        def work(report: Reporter) -> str:
            with delivered(store, TABLE, report) as path:
                count = measurements.export_measurements(store, path)
            report(1.0, "written")
            return f"{TABLE} is ready to download: {count} measurement{'s' * (count != 1)}"

        self._submit("Writing the table", work, str)

    def _measure(self, on: str, make: Callable[[Session, MeasuredSurface], Measurement]) -> None:
        store = self._engine.store

        def work(report: Reporter) -> Measurement:
            report(0.0, f"measuring on {on}")
            surface = self._surfaces.of(store, on)
            report(0.5, f"measuring on {on}")
            found = make(store.guarded(report.saving), surface)
            report(1.0, "measured")
            return found

        self._submit(MEASURING, work, told)

    @abstractmethod
    def _submit(self, name: str, make: Callable[[Reporter], T], sentence: Callable[[T], str]) -> None: ...

    @abstractmethod
    def _warn(self, text: str) -> None: ...


@contextmanager
def _asked_here() -> Iterator[None]:
    """Where other units are asked for, in words that hold without a command line too."""
    try:
        yield
    except InputError as error:
        raise InputError(str(error).replace("give --units ", "choose its units, ").replace("--units ", "")) from error


def told(measured: Measurement) -> str:
    """A measurement in a sentence."""
    read = "; ".join(quantity.text() for quantity in measurements.quantities_of(measured))
    return f"{measured.name}: {read}"


def told_comparison(found: Compared) -> str:
    """A comparison in a sentence."""
    said = f"{found.scan} against {found.nominal.name}: RMS {found.found.statistics()['rms']:.4f} mm"
    if found.verdict is None:
        return said
    return f"{said}; tolerance ± {found.verdict.tolerance_mm:g} mm: {DECIDED[found.verdict.decision]}"


def plain_name(name: str) -> str:
    """A file's name as a session may hold it: ASCII letters, digits, '_', '-' and '.'."""
    plain = re.sub(r"[^A-Za-z0-9_.-]+", "_", Path(name).name).lstrip(".-")
    return safe_name(plain[-100:].lstrip(".-") or "nominal")
