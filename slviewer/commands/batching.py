"""The same work for the captures of many sessions."""

from pathlib import Path
from typing import Literal

from tyro.conf import Positional

from slviewer.commands.parsing import ModelName, deferred, ui, write_json
from slviewer.errors import SlviewerError


@deferred
def batch(
    sessions: Positional[tuple[str, ...]],
    do: Literal["reconstruct", "verify", "mesh"],
    captures: tuple[str, ...] = (),
    shape: Literal["plane", "sphere"] | None = None,
    radius: float | None = None,
    model: ModelName | None = None,
    scheduler: str | None = None,
    json: Path | None = None,
    accept_rejected: bool = False,
) -> None:
    """Reconstruct, verify or mesh the captures of many sessions, on this machine's cores or a Dask cluster.

    What it makes is what each command makes alone, in each session's exports. A capture that fails is named in the end,
    with status 1, and stops no other.

    Args:
        sessions: Session folders that all workers see, or addresses such as s3://bucket/session.
        do: What to do with each capture.
        captures: Their names, or patterns such as 'plane_*'; by default all scans.
        shape: What the captures show, with --do verify.
        radius: Nominal radius of the spheres, mm, with --do verify.
        model: Which calibration to use; by default each session's best one, and all there are with --do verify.
        scheduler: Address of a Dask scheduler, such as tcp://host:8786; by default a cluster of this machine's cores.
        json: Write the summary to this file too.
        accept_rejected: Use calibrations although their verdict rejects them.
    """
    from slviewer.pipeline import batch

    result = batch.batch(
        sessions,
        do,
        captures=captures,
        shape=shape,
        radius=radius,
        model=model,
        scheduler=scheduler,
        accept_rejected=accept_rejected,
        **ui(),
    )
    write_json(json, result.to_json())
    print(result.text())
    if result.failed:
        raise SlviewerError(f"{len(result.failed)} of the batch failed: the summary says which, and why")
