"""An inspection plan on many parts: the record of part by characteristic, capability, and the files
of both."""

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import NoReturn

import msgspec

from slviewer.errors import InputError, SlviewerError, UsageError
from slviewer.evaluation.capability import process_capability
from slviewer.pipeline.feedback import Progress, Warn, ignore_progress, ignore_warnings, part
from slviewer.pipeline.measured_surface import MERGED, MeasuredSurface, load_surface
from slviewer.pipeline.models import ModelName
from slviewer.pipeline.open_session import SessionLike, match_names, opened
from slviewer.pipeline.operation import Findings
from slviewer.pipeline.part_inspection import fail_part, inspect_part
from slviewer.printable import format_csv
from slviewer.records.inspection import Inspection, PartResult
from slviewer.records.table import Value
from slviewer.report.session import write_parts_page
from slviewer.session.atomic import replace_file, to_json
from slviewer.session.inspection_plan import Plan, read_plan
from slviewer.session.layout import is_session
from slviewer.session.nominal import read_nominal
from slviewer.session.store import Session

Load = Callable[[Progress], MeasuredSurface]
FILES = ("parts.html", "parts.csv", "parts.json")
"""The report on parts, their table, and the record."""


def inspect_parts(
    plan: Path | str,
    sessions: Sequence[Path],
    *,
    scans: Sequence[str] = (),
    out: Path | None = None,
    model: ModelName | None = None,
    accept_rejected: bool = False,
    progress: Progress = ignore_progress,
    warn: Warn = ignore_warnings,
) -> Findings[Inspection]:
    """Inspect many parts by one plan: a table of part by characteristic, trends and capability as
    HTML, CSV and JSON.

    Ends with status 1 where a part fails or is undecided. What cannot be measured is named, and
    stops no other.

    Args:
        plan: The inspection plan, a TOML file; `slviewer plan` makes one.
        sessions: Session folders, or folders that hold some.
        scans: The scans that each show a part, or patterns such as 'part_*', or merge/1; by default
            every scan.
        out: Folder of the results; by default one beside the plan, named after it.
        model: Which calibration to use; by default each session's best one.
        accept_rejected: Use calibrations although their verdict rejects them.
    """
    read = read_plan(plan)
    sources: list[tuple[str, Load]] = []
    folders = list_sessions(sessions)
    for folder in folders:
        try:
            with opened(folder) as store:
                names = match_parts(store, scans)
        except SlviewerError as error:
            sources.append((folder.name, partial(_refuse, error)))
            continue
        for name in names:
            label = name if len(folders) == 1 else f"{folder.name}/{name}"
            sources.append((label, part_loader(folder, name, model, accept_rejected, warn)))
    # of several sessions
    found = msgspec.structs.replace(inspect_surfaces(read, sources, progress), inputs={})
    folder = Path(f"{Path(plan).with_suffix('')}-results") if out is None else out
    files = tuple(folder.absolute() / name for name in FILES)
    write_inspection(found, files)
    return Findings(Inspection, {found.plan: found}, files, tuple(f"-> {path}" for path in files))


def part_loader(
    session: SessionLike, scan: str, model: ModelName | None, accept_rejected: bool, warn: Warn
) -> Load:
    """Return what loads the surface of a part."""
    return lambda progress: load_surface(
        session, scan, model=model, accept_rejected=accept_rejected, progress=progress, warn=warn
    )


def inspect_surfaces(
    plan: Plan, sources: Sequence[tuple[str, Load]], progress: Progress = ignore_progress
) -> Inspection:
    """Inspect parts, each a name and what loads its surface. Raises SlviewerError where the plan's
    nominal model cannot be read."""
    nominal = None if plan.alignment.nominal is None else read_nominal(plan.alignment.nominal)
    parts, inputs, scales = list[PartResult](), dict[str, str](), dict[str, float]()
    for k, (name, load) in enumerate(sources):
        report = part(
            progress, k / len(sources), (k + 1) / len(sources), f"{k + 1} of {len(sources)}, {name}"
        )
        report(0.0, "loading")
        try:
            surface = load(report)
            inputs |= surface.inputs
            if surface.organised:
                scales[surface.model] = surface.scale
            parts.append(inspect_part(name, plan, surface, nominal))
        except SlviewerError as error:
            if error.exit_status == 130:  # cancelled
                raise
            parts.append(fail_part(name, plan, str(error)))
    capability = []
    for k, wanted in enumerate(plan.characteristic):
        values = [value for each in parts if (value := each.results[k].value) is not None]
        capability.append(process_capability(values, wanted.lower, wanted.upper))
    progress(1.0, "inspected")
    return Inspection(
        plan=plan.name,
        characteristic=plan.characteristic,
        parts=tuple(parts),
        capability=tuple(capability),
        alignment=plan.alignment.kind,
        inputs=inputs,
        scales=scales,
    )


def write_inspection(found: Inspection, files: Sequence[Path]) -> None:
    """Write what was found of parts as HTML, CSV and JSON."""
    html, csv, json = files
    table = found.list_results()
    rows: list[list[Value]] = [
        [column.heading for column in table.columns],
        *map(table.values, table.rows),
    ]
    replace_file(csv, format_csv(rows).encode("utf-8-sig"))
    replace_file(json, to_json(found))
    write_parts_page(html, found)


def list_sessions(folders: Sequence[Path]) -> list[Path]:
    """The sessions among folders, and those in folders that are none. Raises UsageError where there
    is none."""
    listed: list[Path] = []
    for folder in folders:
        inner = (
            [folder]
            if is_session(folder)
            else sorted(p for p in folder.glob("*") if p.is_dir() and is_session(p))
        )
        if not inner:
            raise UsageError(
                f"{folder} is not a session and holds none: give session folders, or a folder of"
                " them"
            )
        listed += inner
    if not listed:
        raise UsageError("no session named: give the folders of one or more")
    return listed


def match_parts(store: Session, patterns: Sequence[str]) -> list[str]:
    """The scans of a session that show a part. Raises InputError where there are none."""
    merges = [each for each in patterns if each.startswith(MERGED)]
    patterns = [each for each in patterns if each not in merges]
    names = store.capture_names("scan")
    if patterns or not merges:
        names = match_names(names, patterns, "scan", InputError) if patterns else names
        if not names:
            raise InputError("it holds no scan: scan the part first")
        return [*names, *merges]
    return merges


def _refuse(error: SlviewerError, report: Progress) -> NoReturn:
    """Raise the error in place of loading a surface."""
    raise error
