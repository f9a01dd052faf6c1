"""An inspection plan on many parts: the table of part by characteristic, capability, and the files
of both."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NoReturn

from slviewer.errors import InputError, SlviewerError, UsageError
from slviewer.evaluation.capability import Capability, process_capability
from slviewer.evaluation.render import Row, render
from slviewer.inspection.parts import PartResult
from slviewer.pipeline.feedback import Progress, Warn, ignore_progress, ignore_warnings, part
from slviewer.pipeline.measured_surface import MERGED, MeasuredSurface, load_surface
from slviewer.pipeline.models import ModelName
from slviewer.pipeline.open_session import match_names, next_number, opened
from slviewer.pipeline.part_inspection import fail_part, inspect_part
from slviewer.printable import format_csv
from slviewer.records.acceptance import Decision
from slviewer.records.plain import to_plain
from slviewer.report.parts import write_parts_page
from slviewer.session.atomic import replace_file, to_json
from slviewer.session.inspection_plan import Plan, read_plan
from slviewer.session.layout import is_session
from slviewer.session.nominal import read_nominal
from slviewer.session.store import Session

RULE = (
    "decided with a guard band as in ISO 14253-1: pass where the value and its expanded uncertainty"
    " U (k = 2) stay within the limits, fail where the value is beyond one by more than U, else"
    " undecided"
)
COLUMNS = (
    "part",
    "characteristic",
    "kind",
    "value",
    "U (k = 2)",
    "unit",
    "nominal",
    "lower",
    "upper",
    "decision",
)


@dataclass(frozen=True)
class Inspection:
    """The results of all parts by a plan, in their order."""

    plan: Plan
    parts: tuple[PartResult, ...]
    files: tuple[Path, ...] = ()

    @property
    def failure(self) -> str:
        """How many parts do not pass; empty where all do."""
        failed, undecided = (self.parts_that("fail"), self.parts_that("undecided"))
        if not failed and not undecided:
            return ""
        listed = [f"{len(failed)} fail ({', '.join(failed)})"] if failed else []
        listed += [f"{len(undecided)} undecided ({', '.join(undecided)})"] if undecided else []
        return (
            f"of {len(self.parts)} parts {', '.join(listed)}: the table names the characteristics"
        )

    def parts_that(self, decision: Decision) -> list[str]:
        """The names of the parts of that decision."""
        return [each.part for each in self.parts if each.decision == decision]

    def capabilities(self) -> list[Capability | None]:
        """The capability of each characteristic, from the parts on which it was measured."""
        return [
            process_capability(
                [each.results[k].value for each in self.parts if each.results[k].value is not None],  # type: ignore[misc]
                wanted.lower,
                wanted.upper,
            )
            for k, wanted in enumerate(self.plan.characteristic)
        ]

    def to_json(self) -> dict[str, Any]:
        """Return the published values."""
        characteristics = zip(self.plan.characteristic, self.capabilities(), strict=True)
        return {
            "plan": self.plan.name,
            "rule": RULE,
            "characteristics": [
                to_plain(each) | {"capability": to_plain(c)} for each, c in characteristics
            ],
            "parts": [to_plain(each) | {"decision": each.decision} for each in self.parts],
        }

    def csv(self) -> str:
        """One row a part and characteristic."""
        rows: list[Iterable[object]] = [(*COLUMNS, "reason")]
        for each in self.parts:
            for wanted, result in zip(self.plan.characteristic, each.results, strict=True):
                limits = [
                    "" if v is None else f"{v:g}"
                    for v in (wanted.nominal, wanted.lower, wanted.upper)
                ]
                value, U = ("" if v is None else f"{v:.6f}" for v in (result.value, result.U))
                judged = (result.decision, result.reason)
                rows.append(
                    [each.part, wanted.name, wanted.kind, value, U, wanted.unit, *limits, *judged]
                )
        return format_csv(rows)

    def text(self) -> str:
        """Return the table for the terminal, then what could not be measured, capability, and the
        files."""
        rows: list[Row] = []
        for each in self.parts:
            row: Row = {"part": each.part}
            for result in each.results:
                mark = {"pass": "", "fail": " FAIL", "undecided": " ?"}[result.decision]
                row[result.name] = "–" if result.value is None else f"{result.value:.4f}{mark}"
            rows.append(row | {"part is": each.decision})
        lines = [render(rows)]
        lines += [
            f"{each.part}, {result.name}: not measured: {result.reason}"
            for each in self.parts
            for result in each.results
            if result.reason
        ]
        for wanted, c in zip(self.plan.characteristic, self.capabilities(), strict=True):
            if c is not None:
                lines.append(f"{wanted.name}: {describe_capability(c)}")
        lines += [RULE, *(f"-> {path}" for path in self.files)]
        return "\n".join(lines)


def describe_capability(c: Capability) -> str:
    """Cp and Cpk with their confidence intervals, in one line."""
    listed = [("Cp", c.cp), ("Cpk", c.cpk)]
    figures = [
        f"{name} {v[0]:.2f} (95 %: {v[1]:.2f} to {v[2]:.2f})" for name, v in listed if v is not None
    ]
    return f"{', '.join(figures)} of {c.parts} parts"


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
) -> Inspection:
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
    sources: list[tuple[str, Callable[[Progress], MeasuredSurface]]] = []
    folders = list_sessions(sessions)

    def load(folder: Path, scan: str, report: Progress) -> MeasuredSurface:
        """Load one part's surface."""
        return load_surface(
            folder, scan, model=model, accept_rejected=accept_rejected, progress=report, warn=warn
        )

    for folder in folders:
        try:
            names = _list_scans(folder, scans)
        except SlviewerError as error:
            sources.append((folder.name, partial(_refuse, error)))
            continue
        for name in names:
            label = name if len(folders) == 1 else f"{folder.name}/{name}"
            sources.append((label, partial(load, folder, name)))
    folder = Path(f"{Path(plan).with_suffix('')}-results") if out is None else out
    return write_inspection(inspect_surfaces(read, sources, progress), folder)


def inspect_surfaces(
    plan: Plan,
    sources: Sequence[tuple[str, Callable[[Progress], MeasuredSurface]]],
    progress: Progress = ignore_progress,
) -> Inspection:
    """Inspect parts, each a name and what loads its surface. Raises SlviewerError where the plan's
    nominal model cannot be read."""
    nominal = None if plan.alignment.nominal is None else read_nominal(plan.alignment.nominal)
    results = []
    for k, (name, load) in enumerate(sources):
        report = part(
            progress, k / len(sources), (k + 1) / len(sources), f"{k + 1} of {len(sources)}, {name}"
        )
        report(0.0, "loading")
        try:
            results.append(inspect_part(name, plan, load(report), nominal))
        except SlviewerError as error:
            if error.exit_status == 130:  # cancelled
                raise
            results.append(fail_part(name, plan, str(error)))
    progress(1.0, "inspected")
    return Inspection(plan, tuple(results))


def save_inspection(store: Session, inspection: Inspection, inputs: Mapping[str, str]) -> None:
    """Save the results as `inspection/<number>`, which is stale once one of the ``inputs``, {name:
    hash}, changes."""
    meta = {
        "plan": inspection.plan.name,
        "characteristic": to_plain(inspection.plan.characteristic),
        "parts": to_plain(inspection.parts),
        "inputs": dict(inputs),
    }
    store.save_result(f"inspection/{next_number(store, 'inspection')}", meta, {})


def write_inspection(inspection: Inspection, folder: Path) -> Inspection:
    """Write the results as parts.html, parts.csv and parts.json to a folder."""
    html, csv, json = (folder.absolute() / f"parts.{ending}" for ending in ("html", "csv", "json"))
    replace_file(csv, inspection.csv().encode("utf-8-sig"))
    replace_file(json, to_json(inspection.to_json()))
    write_parts_page(html, inspection.plan, inspection.parts, inspection.capabilities(), RULE)
    return Inspection(inspection.plan, inspection.parts, (html, csv, json))


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
                f"{folder} is no session and holds none: give session folders, or a folder of them"
            )
        listed += inner
    if not listed:
        raise UsageError("no session named: give the folders of one or more")
    return listed


def _list_scans(folder: Path, patterns: Sequence[str]) -> list[str]:
    """The scans of a session that show a part. Raises InputError where there are none."""
    merges = [each for each in patterns if each.startswith(MERGED)]
    patterns = [each for each in patterns if each not in merges]
    with opened(folder) as store:
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
