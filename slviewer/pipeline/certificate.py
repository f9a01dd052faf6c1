"""What a report was made from, kept in it, and whether its figures follow from the session's
frames.

A certificate names the hash of every frame, capture and result and the versions of the software,
and holds the figures.
"""

import html
import platform
import shutil
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np

from slviewer import __version__
from slviewer.errors import InputError, SlviewerError
from slviewer.pipeline.calibrate import CalibrateSettings, calibrate
from slviewer.pipeline.cloud_corrections import load_scale_correction
from slviewer.pipeline.models import available_models
from slviewer.pipeline.operation import (
    Job,
    Progress,
    SessionLike,
    ignore_progress,
    list_records,
    load_record,
    opened,
    save_record,
)
from slviewer.pipeline.operations import OPERATIONS
from slviewer.records.calibration import ModelCalibration, StereoFit
from slviewer.records.kinds import all_kinds
from slviewer.records.record import Column, Record, Rows, Table, format_count
from slviewer.report.page import CERTIFICATE, Section, page_digest, split_page
from slviewer.session.atomic import to_json
from slviewer.session.capture import Capture
from slviewer.session.decisions import REGION_INPUT
from slviewer.session.nominal import NOMINALS
from slviewer.session.reading import MAX_JSON_BYTES, expand_user, read_file
from slviewer.session.scan_edits import FOLDER as EDITS
from slviewer.session.scan_edits import (
    load_edits,
    load_region,
    restriction_inputs,
    save_edits,
    save_region,
)
from slviewer.session.store import Session

SCHEMA = 1
PACKAGES = ("numpy", "scipy", "opencv-python-headless", "numba", "trimesh")
"""Whose versions a certificate names, besides Python's and our own."""
RELATIVE = 1e-3
"""Difference of a figure, as a share of it, up to which it is the same: other processors round
otherwise."""
ABSOLUTE = 2e-6
"""... and in the figure's own unit, mm or px."""
COUNT_SCATTER = 0.05
"""... and of a count, as a share of its square root: where few are counted, all have to agree; of
many, one may lie on either side of its limit by rounding."""
_MAX_REPORT_BYTES = 1 << 28
FRAMES = "frames of "
_BY_OPERATOR = ("excluded by the operator", "not among the poses", "excluded for this calibration")

Figures = dict[str, dict[str, float]]
"""{result: {figure: value}}, with the unit in the figure's name."""
State = Literal["same", "differs", "not recomputed", "missing"]
IN_WORDS: Mapping[State, str] = {
    "same": "follows from the frames",
    "differs": "DIFFERS",
    "not recomputed": "not recomputed",
    "missing": "MISSING",
}


class CertifiedCapture(msgspec.Struct, frozen=True):
    """A capture that a report was made from; ``frames``: the hash of each."""

    role: str
    hash: str
    frames: list[str]


class Certificate(msgspec.Struct, frozen=True):
    """What a report was made from. ``captures`` by name; ``results``: {name: hash}; ``page``:
    digest of the page without this certificate and its date."""

    schema: int
    session: str
    software: dict[str, str]
    captures: dict[str, CertifiedCapture]
    results: dict[str, str]
    figures: Figures
    page: str = ""


@dataclass(frozen=True)
class CheckedItem:
    """One thing that was checked, what was found, and a sentence on it."""

    what: str
    state: State
    detail: str = ""


@dataclass(frozen=True)
class ReportCheck:
    """Whether a report's figures follow from a session's frames."""

    checks: tuple[CheckedItem, ...]

    @property
    def failure(self) -> str:
        """Which checks failed, as a sentence; empty where none did."""
        failed = [check.what for check in self.checks if check.state in ("differs", "missing")]
        return f"the report does not follow from the session: {', '.join(failed)}" if failed else ""

    def to_json(self) -> dict[str, Any]:
        """Return the published values of ``verify-report --json``."""
        return {"holds": not self.failure, "checks": self.checks}

    def text(self) -> str:
        """Return the result as a report for the terminal."""
        intact = [
            each for each in self.checks if each.what.startswith(FRAMES) and each.state == "same"
        ]
        lines = [
            f"{each.what}: {IN_WORDS[each.state]}{each.detail and f' ({each.detail})'}"
            for each in self.checks
            if each not in intact
        ]
        if intact:
            lines.insert(1, f"frames of {format_count(len(intact), 'capture')}: as they were")
        left = sum(each.state == "not recomputed" for each in self.checks)
        end = f"; {format_count(left, 'item')} could not be checked" if left else ""
        return "\n".join([*lines, f"{'DOES NOT HOLD' if self.failure else 'HOLDS'}{end}"])


def make_certificate(store: Session) -> Certificate:
    """Return the certificate of a session as it is, without the digest of a page; reads every
    frame."""
    return Certificate(
        SCHEMA,
        store.folder.name,
        _list_versions(),
        {c.name: CertifiedCapture(c.role, c.hash, c.verify()) for c in store.captures()},
        {name: store.input_hashes(name)[name] for name in store.result_names()},
        collect_figures(store),
    )


def collect_figures(store: Session) -> Figures:
    """Return the figures of the records that are fresh."""
    return {
        f"{kind.kind}/{each.name}": figures
        for kind in all_kinds().values()
        for each in list_records(store, kind)
        if not each.stale and (figures := each.record.figures())
    }


def verify_report(
    session: SessionLike, report: Path | str, *, progress: Progress = ignore_progress
) -> ReportCheck:
    """Recompute a report's figures from the raw frames of a session, and compare.

    Args:
        session: Session folder with the captures that the report was made from.
        report: The .html file that `report` wrote.

    The page, every frame, calibration and record is checked; what cannot be recomputed
    (measurements on merges, and comparisons with models whose file is gone) is listed. The session
    is not changed.
    """
    page, certificate = read_certificate(expand_user(report))
    with opened(session) as store:
        changed_page = "its text, pictures or numbers were changed after it was written"
        checks = [
            CheckedItem("page", "same", "as it was written")
            if page_digest(page) == certificate.page
            else CheckedItem("page", "differs", changed_page)
        ]
        then = certificate.software
        changed = [
            f"{name} {then.get(name, '?')} then, {now} now"
            for name, now in _list_versions().items()
            if then.get(name) != now
        ]
        if changed:
            checks.append(CheckedItem("software", "not recomputed", "; ".join(changed)))
        progress(0.02, "reading the frames")
        captures = {capture.name: capture for capture in store.captures()}
        frames = [
            CheckedItem(f"{FRAMES}{name}", *_check_frames(captures.get(name), given))
            for name, given in certificate.captures.items()
        ]
        checks += frames
        if all(check.state == "same" for check in frames):
            with (
                tempfile.TemporaryDirectory(prefix="slviewer-") as folder,
                Session.create(Path(folder, "session")) as fresh,
            ):
                repetition = _Repetition(store, fresh, certificate, progress)
                made = repetition.compute_figures()
            checks += [
                _compare(name, given, made.get(name), repetition.why)
                for name, given in certificate.figures.items()
            ]
    progress(1.0, "compared")
    return ReportCheck(tuple(checks))


def read_certificate(path: Path) -> tuple[str, Certificate]:
    """Return a report's page and its certificate; InputError where it has none that can be read."""
    try:
        page = read_file(path, _MAX_REPORT_BYTES).decode()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(
            f"{path} cannot be read ({error})", "give a report that slviewer wrote"
        ) from error
    _, content, _ = split_page(page, CERTIFICATE)
    if content is None:
        raise InputError(
            f"{path.name} holds no certificate",
            "write the report again with this version of slviewer",
        )
    if len(content) > MAX_JSON_BYTES:
        raise InputError(
            f"the certificate in {path.name} is longer than any", "write the report again"
        )
    try:
        certificate = msgspec.json.decode(html.unescape(content), type=Certificate)
    except (msgspec.DecodeError, RecursionError) as error:
        raise InputError(
            f"the certificate in {path.name} is damaged ({error})", "write the report again"
        ) from error
    if certificate.schema > SCHEMA:
        raise InputError(f"{path.name} was written by a newer slviewer", "update slviewer")
    return page, certificate


def _list_versions() -> dict[str, str]:
    """Return the versions of Python, slviewer and what it computes with."""
    return {"slviewer": __version__, "python": platform.python_version()} | {
        name: version(name) for name in PACKAGES
    }


def _check_frames(capture: Capture | None, given: CertifiedCapture) -> tuple[State, str]:
    """Read a capture that the report names, and compare the hash of each frame; returns what was
    found, and a sentence on it."""
    if capture is None:
        return "missing", "the session has no such capture, or it is damaged"
    try:
        now = capture.verify()
    except SlviewerError as error:
        return "differs", str(error)
    if now == given.frames and capture.hash == given.hash:
        return "same", f"{len(now)} frames"
    changed = [i for i, (a, b) in enumerate(zip(given.frames, now, strict=False), 1) if a != b]
    where = f"frame {changed[0]}" if changed else "the description of the capture"
    return "differs", f"{where} is another than the report's"


@dataclass(frozen=True)
class _Repetition:
    """What a report shows of the session ``store``, computed from the frames alone in the new
    session ``fresh``. ``why``: {result: why it was not}."""

    store: Session
    fresh: Session
    certificate: Certificate
    progress: Progress
    why: dict[str, str] = field(default_factory=dict)

    def compute_figures(self) -> Figures:
        """Calibrate, run the operations again, and return the figures that they find."""
        store, fresh = self.store, self.fresh
        for name in self.certificate.captures:
            _link(store.load_capture(name).folder, fresh.folder / "captures" / name)
        for name in fresh.capture_names("scan"):
            save_edits(fresh, name, load_edits(store, name))
            if fresh.load_capture(name).is_imported_cloud:
                self._take_over(f"clouds/{name}")
        save_region(fresh, load_region(store))
        if (store.folder / NOMINALS).is_dir():
            _link(store.folder / NOMINALS, fresh.folder / NOMINALS)
        if "calibration/stereo" in self.certificate.figures:
            self.progress(0.1, "calibrating")
            self._calibrate()
        return collect_figures(fresh) | self._run_operations()

    def _take_over(self, result: str) -> None:
        """Copy a result of the session as it is."""
        saved, arrays = self.store.load_result(result)
        self.fresh.save_result(result, _without_own(saved), arrays)

    def _calibrate(self) -> None:
        """Calibrate from the frames with the settings of the session's calibration, and take over
        its scale."""
        store, fresh, models = self.store, self.fresh, available_models(self.store)
        results = [f"calibration/{name}" for name in models]
        record = load_record(store, ModelCalibration, "stereo")
        stereo = record.fit
        if isinstance(stereo, StereoFit) and record.settings:
            poses = [
                name
                for name in (*stereo.poses, *stereo.excluded)
                if name in fresh.taken_names()
                and not stereo.excluded.get(name, "").startswith(_BY_OPERATOR)
            ]
            settings = CalibrateSettings(**record.settings)
            if settings.camera and store.has_result(str(settings.camera)):
                self._take_over(str(settings.camera))
            with self._note_failure(*results):
                calibrate.run(fresh, replace(settings, models=models, poses=poses, exclude=()))
        else:
            self.why.update(
                dict.fromkeys(
                    results, "it was imported: its figures are not from the session's frames"
                )
            )
            for result in results:
                saved, arrays = store.load_result(result)
                fresh.save_result(result, _without_own(saved), arrays)
        for model in available_models(fresh):
            if (applied := load_scale_correction(store, model)) is not None:
                inputs = fresh.input_hashes(f"calibration/{model}")
                fresh.save_result(f"scale/{model}", {**_without_own(applied), "inputs": inputs}, {})

    def _run_operations(self) -> Figures:
        """Run the operations that found the session's records again, with their settings; return
        the figures."""
        runs: dict[tuple[str, bytes], dict[str, Record]] = {}
        for result in self.certificate.figures:
            kind, _, name = result.partition("/")
            if kind not in all_kinds() or kind == ModelCalibration.kind:
                continue
            with self._note_failure(result):
                record = load_record(self.store, all_kinds()[kind], name)
                if record.operation not in OPERATIONS:
                    raise InputError(
                        "an older version of slviewer made it",
                        "make it again, and write the report again",
                    )
                _check_restrictions(self.store, record)
                run = record.operation, to_json(record.settings)
                runs.setdefault(run, {})[result] = record
        figures: Figures = {}
        for k, ((name, _), records) in enumerate(runs.items()):
            self.progress(0.6 + 0.4 * k / len(runs), f"repeating {name}")
            operation, (record, *_) = OPERATIONS[name], records.values()
            # the session is read alone: its files stay as they are
            with self._note_failure(*records), Session.open(self.fresh.folder) as reading:
                made_from = (
                    each
                    for each, used in record.inputs.items()
                    if used and each.partition("/")[0] in all_kinds()
                )
                if missing := [each for each in made_from if not reading.has_result(each)]:
                    raise InputError(
                        f"{', '.join(missing)}, which it was made from, is not made again"
                    )
                for found in operation.find(Job(reading), operation.settings(**record.settings)):
                    # a number here may be another than that of before
                    is_numbered = found.record.is_number(found.name)
                    names = records if is_numbered else [f"{found.record.kind}/{found.name}"]
                    figures |= dict.fromkeys(names, found.record.figures())
                    if is_numbered and not found.files:  # others may be made from it
                        for each in names:
                            name = each.partition("/")[2]
                            save_record(self.fresh, name, found.record, found.arrays)
        return figures

    @contextmanager
    def _note_failure(self, *results: str) -> Iterator[None]:
        """Context manager that notes why these results failed, and goes on."""
        try:
            yield
        except SlviewerError as error:
            self.why.update(dict.fromkeys(results, str(error)))


def _link(folder: Path, place: Path) -> None:
    """Let a folder appear in another place; a copy where the system makes no links."""
    try:
        place.symlink_to(folder, target_is_directory=True)
    except OSError:
        shutil.copytree(folder, place)


def _without_own(meta: Mapping[str, Any]) -> dict[str, Any]:
    """Return a stored meta without what the session writes itself."""
    return {key: value for key, value in meta.items() if key not in ("hash", "arrays", "checksums")}


def _check_restrictions(store: Session, record: Record) -> None:
    """Raise InputError where the edits and the region that a record was made with are not the
    session's."""
    used, start = record.inputs, f"{EDITS}/"
    scans = [name.removeprefix(start) for name in used if name.startswith(start)]
    if not scans:
        return
    if REGION_INPUT not in used and not record.settings.get("roi"):
        raise InputError("it was made with a region of its own")
    now = restriction_inputs(store, scans)
    if any(used.get(name, value) != value for name, value in now.items()):
        raise InputError(f"edits of {', '.join(scans)}, or the region, have changed since")


def _compare(
    name: str, given: Mapping[str, float], made: Mapping[str, float] | None, why: Mapping[str, str]
) -> CheckedItem:
    """Return whether a result's figures are those that were computed again."""
    if made is None:
        reason = why.get(name, "the session no longer holds what it was made with")
        return CheckedItem(name, "not recomputed", reason)
    for key, value in given.items():
        now = made.get(key, np.nan)
        is_count = now == np.round(now) and value == np.round(value)
        least = COUNT_SCATTER * np.sqrt(abs(value)) if is_count else ABSOLUTE
        if not np.isclose(now, value, rtol=RELATIVE, atol=least, equal_nan=True):
            return CheckedItem(name, "differs", f"{key}: {value:.6g} in the report, {now:.6g} now")
    return CheckedItem(name, "same", f"{len(given)} figures")


def certify_page(certificate: Certificate, page: str) -> str:
    """Return the certificate of the page with that digest, as JSON."""
    return msgspec.json.encode(msgspec.structs.replace(certificate, page=page)).decode()


def certificate_section(certificate: Certificate, *, is_full: bool = True) -> Section:
    """Return what a certificate names, as a section of the report; unless ``is_full``, how much it
    names."""
    contents: dict[str, tuple[list[str], Rows]] = {
        "Calibrations and records": (
            ["result", "hash"],
            [[name, certificate.results[name]] for name in certificate.figures],
        ),
        "Software": (["software", "version"], [[*each] for each in certificate.software.items()]),
    }
    text = (
        "What the figures were computed from, beside the captures. `slviewer verify-report` reads"
        " this file and the session, computes the figures again from the frames, and says whether"
        " they agree."
    )
    tables = [
        Table([*map(Column, titles)], rows, caption)
        for caption, (titles, rows) in contents.items()
        if rows and is_full
    ]
    captures = format_count(len(certificate.captures), "capture")
    results = format_count(len(certificate.results), "result")
    kept = (
        f"This file holds the hashes of {captures} and {results}, and the versions of the software."
    )
    return Section("Certificate", text if is_full else [text, kept], tables, is_annex=True)
