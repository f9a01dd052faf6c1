"""An inspection plan on scans of a session."""

from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path

from slviewer.pipeline.inspect_parts import (
    FILES,
    inspect_surfaces,
    match_parts,
    part_loader,
    write_inspection,
)
from slviewer.pipeline.models import ModelName
from slviewer.pipeline.open_session import next_number
from slviewer.pipeline.operation import Found, Job, operation
from slviewer.records.inspection import Inspection
from slviewer.session.inspection_plan import Plan, read_plan
from slviewer.session.nominal import NOMINALS
from slviewer.session.store import Session


@dataclass(frozen=True)
class RunPlanSettings:
    """By which plan which scans are inspected.

    Args:
        plan: The inspection plan, a TOML file; `slviewer plan` makes one.
        scans: The scans that each show a part, or patterns such as 'part_*', or merge/1; by default
            every scan.
        model: Which calibration to use; by default the best one available.
        accept_rejected: Use the calibration although its verdict rejects it.
    """

    plan: Path | str
    scans: Sequence[str] = ()
    model: ModelName | None = None
    accept_rejected: bool = False


@operation("run-plan", Inspection, RunPlanSettings)
def run_plan(job: Job, settings: RunPlanSettings) -> Iterator[Found[Inspection]]:
    """Inspect scans of a session, each a part, by a plan; its exports then hold parts.html,
    parts.csv and parts.json.

    Ends with status 1 where a part fails or is undecided. What cannot be measured is named, and
    stops no other.
    """
    store = job.store
    plan = _use_own_nominal(store, read_plan(settings.plan))
    sources = [
        (name, part_loader(store, name, settings.model, settings.accept_rejected, job.warn))
        for name in match_parts(store, settings.scans)
    ]
    found = inspect_surfaces(plan, sources, job.progress)
    with ExitStack() as placed:
        write_inspection(found, [placed.enter_context(store.staged_export(name)) for name in FILES])
        files = tuple(store.exports / name for name in FILES)
        yield Found(
            str(next_number(store, Inspection.kind)),
            found,
            files=files,
            notes=tuple(f"-> {path}" for path in files),
        )


def _use_own_nominal(store: Session, plan: Plan) -> Plan:
    """Return the plan with the session's own nominal model in place of one of the same file
    name."""
    if plan.alignment.nominal is None:
        return plan
    own = store.folder / NOMINALS / Path(plan.alignment.nominal).name
    return (
        replace(plan, alignment=replace(plan.alignment, nominal=str(own)))
        if own.is_file()
        else plan
    )
