"""Setting the region of interest of a session, and deleting points of a scan so that they can be
brought back."""

from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, dataclass
from datetime import UTC, datetime

import numpy as np

from slviewer.errors import InputError, UsageError
from slviewer.geometry.vectors import finite_rows
from slviewer.pipeline.cloud_corrections import OFF, parse_region
from slviewer.pipeline.models import ModelName, check_accepted
from slviewer.pipeline.operation import (
    Callbacks,
    Job,
    Progress,
    SessionLike,
    Warn,
    ignore_progress,
    ignore_warnings,
    opened,
    takes_settings,
)
from slviewer.pipeline.reconstruct import scan_cloud
from slviewer.session.scan_edits import list_edits, load_edits, load_region, save_edits, save_region
from slviewer.session.store import Session
from slviewer.surface.region_of_interest import RegionOfInterest
from slviewer.surface.selection import (
    Edit,
    EditHistory,
    Mask,
    SupportPlane,
    make_edit,
    select_connected,
    select_polygon,
    select_support,
)

SUPPORT = "support and below"
"""How the points of a support are said to be selected."""


@dataclass(frozen=True)
class ScanEdits:
    """The edits of a scan that are in effect, in words, how many were undone, and how many points
    remain, where that was computed."""

    scan: str
    edits: tuple[str, ...]
    undone: int
    remaining: int | None = None

    def text(self) -> str:
        """List the edits, numbered in their order."""
        lines = [f"{i}. {words}" for i, words in enumerate(self.edits, 1)] or [
            f"{self.scan} has no edits in effect"
        ]
        if self.remaining is not None:
            lines.append(f"{self.remaining} points remain")
        if self.undone:
            lines.append(f"{self.undone} undone: bring them back with --redo {self.undone}")
        return "\n".join(lines)


@dataclass(frozen=True)
class EditSettings(Callbacks):
    """Which points of a scan are deleted, or which edits are undone.

    Args:
        session: Session folder.
        scan: Name of the capture.
        polygon: Delete what the camera sees within this polygon: u v of three or more pixels
            (column, row).
        part: Delete the connected part of the surface that this pixel, u v, belongs to.
        support: Delete the plane that the object stands on, and all below it.
        margin: Millimetres above that plane that belong to it; by default three times the scatter
            of its points.
        invert: Delete everything else instead.
        undo: Undo so many edits, the last first.
        redo: Bring so many undone edits back.
        model: Which calibration to select points by; by default the best one available.
        accept_rejected: Use the calibration although its verdict rejects it.
    """

    session: SessionLike
    scan: str
    _: KW_ONLY
    polygon: Sequence[float] = ()
    part: Sequence[int] = ()
    support: bool = False
    margin: float | None = None
    invert: bool = False
    undo: int = 0
    redo: int = 0
    model: ModelName | None = None
    accept_rejected: bool = False

    def __post_init__(self) -> None:
        requests = (self.polygon, self.part, self.support, self.undo, self.redo)
        if sum(map(bool, requests)) > 1:
            raise UsageError(
                "do one thing at a time", "--polygon, --part, --support, --undo or --redo"
            )
        if (self.invert and not self.selects) or (self.margin is not None and not self.support):
            raise UsageError(
                "--invert needs --polygon, --part or --support, and --margin needs --support"
            )
        if self.part and len(self.part) != 2:
            raise UsageError(
                f"--part has {len(self.part)} numbers",
                "give u v of one pixel, such as --part 180 150",
            )
        if self.polygon and (len(self.polygon) % 2 or len(self.polygon) < 6):
            raise UsageError(
                f"--polygon has {len(self.polygon)} numbers", "give u v of three or more pixels"
            )

    @property
    def selects(self) -> bool:
        """Whether points are selected."""
        return bool(self.polygon or self.part or self.support)


@takes_settings(EditSettings)
def edit_scan(settings: EditSettings) -> ScanEdits:
    """Delete points of a scan, undo and redo that, or list what was deleted; the scan itself stays
    as it was captured.

    What is deleted is not used by reconstruct, merge, mesh, measure and export, with any later
    calibration too.
    """
    scan, undo, redo, remaining = settings.scan, settings.undo, settings.redo, None
    with opened(settings.session, write=bool(settings.selects or undo or redo)) as store:
        if undo or redo:
            history = load_edits(store, scan)
            save_edits(store, scan, history.undo(undo) if undo else history.redo(redo))
        elif not settings.selects:
            store.load_capture(scan)
        else:
            check_accepted(store, settings.accept_rejected)
            cloud, plane = scan_cloud(settings.job(store), scan, settings.model), None
            if cloud.normals is not None:
                raise InputError(
                    f"{scan} was imported as a cloud, whose points are not those of pixels",
                    "cut it with --roi where it is used, or before it is imported",
                )
            if settings.support:
                plane, selected = select_support(cloud.points, cloud.sigma_z, settings.margin)
                what = SUPPORT
            elif settings.part:
                u, v = settings.part
                selected, what = select_connected(cloud.points, (u, v)), "connected part"
            else:
                corners = np.reshape(settings.polygon, (-1, 2))
                selected, what = select_polygon(cloud.sigma_z.shape, corners), "polygon"
            if settings.invert:
                selected, what, plane = ~selected, f"all but {what}", None
            delete_points(store, [Selection(scan, cloud.points, selected, plane)], what)
            remaining = int(np.count_nonzero(cloud.mask & ~selected))
            settings.progress(1.0, "edited")
        return ScanEdits(scan, *list_edits(store, scan), remaining)


@dataclass(frozen=True, eq=False)
class Selection:
    """Points of a scan that are to be deleted: the ``selected`` (h, w) of its ``points`` (h, w, 3)
    mm, and the ``plane`` that they all lie below of, where they do."""

    scan: str
    points: np.ndarray
    selected: Mask
    plane: SupportPlane | None = None


def delete_points(store: Session, selections: Sequence[Selection], what: str) -> dict[str, Edit]:
    """Delete what is selected of one or several scans, in one step: {scan: its edit}. ``what``: how
    it was selected. Scans of which nothing is selected stay as they are.

    InputError where nothing is selected at all, or nothing would remain of a scan.
    """
    made = datetime.now(UTC).isoformat(timespec="milliseconds")
    edits = dict[str, Edit]()
    for each in selections:
        measured = finite_rows(each.points)
        if not (each.selected & measured).any():
            continue
        edit = make_edit(each.points, each.selected, what, each.plane, made)
        if edit.points == (total := int(np.count_nonzero(measured))):
            raise InputError(
                f"all {total} points of {each.scan} are selected",
                "select fewer, or delete the scan",
            )
        edits[each.scan] = edit
    if not edits:
        raise InputError("no point is selected", "select some first")
    with store.together():
        for scan, edit in edits.items():
            save_edits(store, scan, load_edits(store, scan).add(edit))
    return edits


def step_history(store: Session, scans: Sequence[str], *, redo: bool) -> dict[str, str]:
    """Undo the last edit among those of several scans, of all scans that it was made of; or bring
    back (``redo``) what was undone last. Returns {scan: when it was made}. InputError where there
    is none."""
    made = {
        scan: edit.made for scan in scans if (edit := _next_edit(load_edits(store, scan), redo))
    }
    if not made:
        raise InputError(f"no edit can be {'redone' if redo else 'undone'}: there is none")
    when = min(made.values()) if redo else max(made.values())
    # of edits whose time is not known, the first one's alone
    names = [scan for scan, time in made.items() if time == when][: None if when else 1]
    stepped = dict.fromkeys(names, when)
    step_edits(store, stepped, redo=redo)
    return stepped


def step_edits(store: Session, made: Mapping[str, str], *, redo: bool) -> None:
    """Undo the last edit of each scan, or bring back (``redo``) the one that was undone last, in
    one step. InputError where that is not the one that was made at the time {scan: time}."""
    with store.together():
        for scan, time in made.items():
            history = load_edits(store, scan)
            edit = _next_edit(history, redo)
            if edit is None or edit.made != time:
                raise InputError(f"the edits of {scan} have changed since")
            save_edits(store, scan, history.redo(1) if redo else history.undo(1))


def _next_edit(history: EditHistory, redo: bool) -> Edit | None:
    """Return the edit that is undone next, or brought back next; None where there is none."""
    return next(iter(history.undone[:1] if redo else history.active[-1:]), None)


def set_region(
    session: SessionLike,
    *,
    roi: str = "",
    around: str = "",
    model: ModelName | None = None,
    accept_rejected: bool = False,
    progress: Progress = ignore_progress,
    warn: Warn = ignore_warnings,
) -> str:
    """Set the region of interest of a session, or show it: points of scans outside of it are
    ignored.

    It holds for reconstruct, merge, mesh, measure and export, unless their own --roi states another
    one.

    Args:
        session: Session folder.
        roi: The box: x0,x1,y0,y1,z0,z1 in mm in the camera's frame (x right, y down, z away), or a
            TOML file with centre_mm, size_mm and rotation_deg; off switches it off, on switches the
            last one on.
        around: A scan: the box around all of its points.
        model: Which calibration to use for that scan; by default the best one available.
        accept_rejected: Use the calibration although its verdict rejects it.
    """
    if roi and around:
        raise UsageError(
            "state the region with --roi, or take it from a scan with --around", "one of both"
        )
    with opened(session, write=bool(roi or around)) as store:
        region = load_region(store, even_if_off=True)
        if around:
            check_accepted(store, accept_rejected)
            job = Job(store, progress, warn, accept_rejected)
            cloud = scan_cloud(job, around, model, OFF)
            region = RegionOfInterest.around(cloud.points)
        elif roi not in ("", OFF, "on"):
            region = parse_region(roi)
        elif roi == "on" and region is None:
            raise InputError(
                "the session has no region of interest yet", "state its box, or use --around SCAN"
            )
        if roi or around:
            save_region(store, region, roi != OFF)
        if region is None:
            return "the session has no region of interest: all points are used"
        state = "on" if load_region(store) is not None else "off: all points are used"
        return f"region of interest: {region.text()} ({state})"
