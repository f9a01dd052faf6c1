"""Dimensions read off scans: measured, listed, written as a table."""

from pathlib import Path
from typing import Literal

from tyro.conf import Positional

from slviewer.commands.parsing import ModelName, deferred, ui


@deferred
def measure(
    session: Positional[Path],
    scan: Positional[str],
    what: Positional[Literal["point", "distance", "section", "plane", "sphere", "cylinder"]],
    at: tuple[int, ...] = (),
    ball: tuple[float, ...] = (),
    box: tuple[float, ...] = (),
    name: str = "",
    model: ModelName | None = None,
    accept_rejected: bool = False,
) -> None:
    """Measure on a scan: a distance between points, a section, a shape fitted to a region; the session keeps it.

    Args:
        session: Session folder.
        scan: Name of the capture, or merge/1 and the like for a merge that the session keeps.
        what: point, distance and section take --at; plane, sphere and cylinder take --ball or --box.
        at: Pixel u v (column, row of the camera's picture) of the point, or u v u v of both ends of the distance or
            section; for a merge the points' numbers in its file, from 0.
        ball: The region to fit to: centre x y z and radius, mm, in the camera's frame (x right, y down, z away).
        box: The region to fit to: two corners x y z x y z, mm, in the camera's frame.
        name: What to call it.
        model: Which calibration to use; by default the best one available.
        accept_rejected: Use the calibration although its verdict rejects it.
    """
    from slviewer.pipeline import measure
    from slviewer.pipeline.measurements import in_words

    made = measure.measure(
        session, scan, what, at=at, ball=ball, box=box, name=name, model=model, accept_rejected=accept_rejected, **ui()
    )
    print(in_words(made))


@deferred
def measurements(
    session: Positional[Path],
    relate: tuple[str, str] | None = None,
    name: tuple[str, str] | None = None,
    delete: tuple[str, ...] = (),
    bring_back: bool = False,
    csv: Path | None = None,
) -> None:
    """List the measurements that a session holds.

    Args:
        session: Session folder.
        relate: Two of them, such as m1 m2: their distances and angles are measured too.
        name: One of them, and what to call it from now on.
        delete: Some of them, to the trash.
        bring_back: Undo the last deletion.
        csv: Write them all to this table too.
    """
    from slviewer.pipeline import measure

    print(measure.tell_measurements(session, relate=relate, name=name, delete=delete, bring_back=bring_back, csv=csv))
