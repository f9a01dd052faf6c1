"""One measurement on a scan by its command's arguments, and edits of the list of those that a
session holds."""

from collections.abc import Sequence
from pathlib import Path
from typing import Literal, NoReturn

from slviewer.errors import UsageError
from slviewer.inspection.regions import Region
from slviewer.pipeline.feedback import Progress, Warn, ignore_progress, ignore_warnings
from slviewer.pipeline.measured_surface import MERGED, Place, load_surface
from slviewer.pipeline.measurements import (
    add_distance,
    add_fit,
    add_point,
    add_relation,
    add_section,
    describe_measurement,
    export_measurements,
    load_measurements,
)
from slviewer.pipeline.models import ModelName, available_models
from slviewer.pipeline.open_session import SessionLike, opened
from slviewer.session.measurements import (
    Measurement,
    rename_measurement,
    restore_measurement,
    trash_measurement,
)
from slviewer.session.store import Session

What = Literal["point", "distance", "section", "plane", "sphere", "cylinder"]


def measure(
    session: SessionLike,
    scan: str,
    what: What,
    *,
    at: Sequence[int] = (),
    ball: Sequence[float] = (),
    box: Sequence[float] = (),
    name: str = "",
    model: ModelName | None = None,
    roi: str = "",
    accept_rejected: bool = False,
    progress: Progress = ignore_progress,
    warn: Warn = ignore_warnings,
) -> Measurement:
    """Measure on a scan: a distance between points, a section, a shape fitted to a region; the
    session stores it.

    Args:
        session: Session folder.
        scan: Name of the capture, or merge/1 and the like for a merge of the session.
        what: point, distance and section take --at; plane, sphere and cylinder take --ball or
            --box.
        at: Pixel u v (column, row of the camera's picture) of the point, or u v u v of both ends of
            the distance or section; for a merge the points' numbers in its file, from 0.
        ball: The region to fit to: centre x y z and radius, mm, in the camera's frame (x right, y
            down, z away). All points within this radius of the centre: for a sphere, a little more
            than its own radius.
        box: The region to fit to: two corners x y z x y z, mm, in the camera's frame.
        name: What to call it.
        model: Which calibration to use; by default the best one available.
        roi: Region of interest, outside of which points are ignored: x0,x1,y0,y1,z0,z1 in mm in the
            camera's frame (x right, y down, z away), a TOML file, or off; by default the session's.
            A merge was cut when it was made.
        accept_rejected: Use the calibration although its verdict rejects it.
    """
    fitted = what in ("plane", "sphere", "cylinder")
    if fitted and (len(ball), len(box)) not in ((4, 0), (0, 6)):
        raise UsageError(
            f"a {what} needs its region: give --ball x y z radius, or --box x y z x y z, in mm"
        )
    ends = 1 if what == "point" else 2
    if not fitted and len(at) not in (ends, 2 * ends):
        _raise_place_error(what, ends, "pixel u v")
    with opened(session, write=True) as store:
        on = load_surface(
            store,
            scan,
            model=model,
            roi=roi,
            accept_rejected=accept_rejected,
            progress=progress,
            warn=warn,
        )
        if fitted:
            region = Region.ball(ball[:3], ball[3]) if ball else Region.box(box[:3], box[3:])
            measured = add_fit(store, on, what, region, name)  # type: ignore[arg-type]
            _warn_of_partial_uncertainty(store, measured, warn)
            return measured
        numbers = 2 if on.organised else 1
        if len(at) != ends * numbers:
            _raise_place_error(what, ends, "pixel u v" if on.organised else "index")
        places: list[Place] = [
            (at[i], at[i + 1]) if on.organised else at[i] for i in range(0, len(at), numbers)
        ]
        if what == "point":
            return add_point(store, on, places[0], name)
        measured = (add_distance if what == "distance" else add_section)(
            store, on, places[0], places[1], name
        )
        _warn_of_partial_uncertainty(store, measured, warn)
        return measured


def _warn_of_partial_uncertainty(store: Session, measured: Measurement, warn: Warn) -> None:
    """Warn where the uncertainty of a measurement lacks the calibration's part, with the remedy."""
    if all(quantity.whole for quantity in measured.quantities):
        return
    cause = "the model " + " or ".join(
        each for each in measured.model.split(", ") if each != "splined"
    )
    if any(source.startswith(MERGED) for source in measured.source.split(", ")):
        cause, remedy = (
            "a merge",
            "measure on one of its scans with the splined model (--model splined)",
        )
    elif "splined" in available_models(store):
        remedy = "measure with the splined model (--model splined)"
    else:
        remedy = (
            "calibrate with the splined model, which takes eight poses or more, and measure with it"
        )
    warn(
        f"{measured.name}: U is too small, as {cause} does not know the calibration's part:"
        f" {remedy}"
    )


def _raise_place_error(what: What, ends: int, which: str) -> NoReturn:
    """Raise UsageError: the option --at does not have one place for each end of what is
    measured."""
    example = (
        " ".join(("180 150", "220 150")[:ends])
        if which == "pixel u v"
        else " ".join(("1200", "3400")[:ends])
    )
    raise UsageError(
        f"a {what} needs --at with the {which} of {'its point' if ends == 1 else 'both its ends'}, "
        f"such as --at {example}"
    )


def edit_measurements(
    session: SessionLike,
    *,
    relate: tuple[str, str] | None = None,
    name: tuple[str, str] | None = None,
    delete: Sequence[str] = (),
    bring_back: bool = False,
    csv: Path | None = None,
    warn: Warn = ignore_warnings,
) -> str:
    """List the measurements that a session holds.

    Args:
        session: Session folder.
        relate: Two of them, such as m1 m2: their distances and angles are measured too.
        name: One of them, and what to call it from now on.
        delete: Some of them, to the trash.
        bring_back: Undo the last deletion.
        csv: Write them all to this table too.
    """
    if not (relate or name or delete or bring_back):
        return _list_measurements(session, csv)
    with opened(session, write=True) as store:
        if relate:
            _warn_of_partial_uncertainty(store, add_relation(store, *relate), warn)
        if name:
            rename_measurement(store, *name)
        for each in delete:
            trash_measurement(store, each)
        if bring_back:
            restore_measurement(store)
        return _list_measurements(store, csv)


def _list_measurements(session: SessionLike, csv: Path | None) -> str:
    """Return the session's measurements as text, and write them to a CSV file where one is
    given."""
    lines = [describe_measurement(each) for each in load_measurements(session)] or [
        "nothing was measured yet"
    ]
    if csv is not None:
        lines.append(f"{export_measurements(session, csv)} measurements -> {csv}")
    return "\n".join(lines)
