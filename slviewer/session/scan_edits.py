"""What restricts scans to a part of their points: the edits of each scan, `edits/SCAN`, and the
session's region.

Results that are made of such points name both as inputs, so that they are stale once one changes.
"""

from collections.abc import Iterable
from typing import Any

import numpy as np

from slviewer.errors import DamagedError, InputError
from slviewer.records.record import from_plain, to_plain
from slviewer.session.decisions import REGION_INPUT
from slviewer.session.results import digest_bytes
from slviewer.session.store import Session
from slviewer.surface.region_of_interest import RegionOfInterest
from slviewer.surface.selection import (
    Edit,
    EditHistory,
    SupportPlane,
    describe_edit,
    pack_mask,
    unpack_mask,
)

FOLDER = "edits"


def load_edits(store: Session, scan: str) -> EditHistory:
    """Return the edits of a scan: none where it has none, or was captured again since.

    Raises InputError where there is no such scan, DamagedError where they cannot be read.
    """
    name, capture, meta = f"{FOLDER}/{scan}", store.load_capture(scan), _load_meta(store, scan)
    if not meta or meta["capture"] != capture.hash:
        return EditHistory()
    try:
        if tuple(meta["size"]) != tuple(capture.size):
            raise InputError(
                f"they are of {meta['size']} pixels, the capture has {list(capture.size)}"
            )
        arrays = store.load_result(name)[1]
        edits = [
            _read_edit(entry, arrays.get(str(i)), capture.size)
            for i, entry in enumerate(meta["edits"])
        ]
        return EditHistory(tuple(edits), meta["applied"])
    except InputError as error:
        raise DamagedError(
            f"the edits of {scan} are damaged ({error})",
            f"restore {store.folder / 'results' / name} from a copy, or delete it, which forgets"
            " them",
        ) from error


def list_edits(store: Session, scan: str) -> tuple[tuple[str, ...], int]:
    """Return (the edits of a scan that are in effect, in words; the number of those that were
    undone)."""
    meta = _load_meta(store, scan)
    if not meta or meta["capture"] != store.load_capture(scan).hash:
        return (), 0
    texts = tuple(describe_edit(entry["what"], entry["points"]) for entry in meta["edits"])
    return texts[: meta["applied"]], len(texts) - meta["applied"]


def save_edits(store: Session, scan: str, history: EditHistory) -> None:
    """Save the edits of a scan, with those that were undone, in place of those before."""
    capture = store.load_capture(scan)
    arrays = {
        str(i): pack_mask(edit.pixels)
        for i, edit in enumerate(history.edits)
        if edit.pixels is not None
    }
    entries = []
    for edit in history.edits:
        plane: dict[str, Any] = dict.fromkeys(("normal", "offset_mm", "margin_mm"))
        if edit.plane is not None:
            plane = {**to_plain(edit.plane), "normal": list(edit.plane.normal)}
        entry = {"kind": edit.kind, "what": edit.what, "points": edit.points}
        entries.append({**entry, **plane, "made": edit.made})
    content = []
    for i, entry in enumerate(entries[: history.applied]):
        used = sorted((key, value) for key, value in entry.items() if key != "made")
        content += [repr(used).encode(), arrays.get(str(i), np.zeros(0, np.uint8)).tobytes()]
    meta = {
        "capture": capture.hash,
        "size": list(capture.size),
        "applied": history.applied,
        "edits": entries,
        "content": digest_bytes(*content).hex() if content else "",
    }
    store.save_result(f"{FOLDER}/{scan}", meta, arrays)


def load_region(store: Session, *, even_if_off: bool = False) -> RegionOfInterest | None:
    """Return the session's region of interest; None where there is none, or it is switched off.

    Raises DamagedError where it cannot be read.
    """
    stored = store.decision("region")
    if not stored or not (stored["on"] or even_if_off):
        return None
    try:
        return RegionOfInterest(stored["centre_mm"], stored["size_mm"], stored["rotation_deg"])
    except InputError as error:
        raise DamagedError(
            f"{store.folder / 'decisions.json'} is damaged: {error}; set the region again"
        ) from error


def save_region(store: Session, region: RegionOfInterest | None, on: bool = True) -> None:
    """Make a box the session's region of interest, in effect or not (``on``); None forgets it."""
    store.decide("region", None if region is None else {**to_plain(region), "on": on})


def restriction_inputs(
    store: Session, scans: Iterable[str], *, with_region: bool = True
) -> dict[str, str]:
    """Return {input: hash} of the edits of scans, and of the region, for `meta["inputs"]`; "" for
    what there is not."""
    inputs = {f"{FOLDER}/{scan}": str(_load_meta(store, scan).get("content", "")) for scan in scans}
    if with_region:
        inputs[REGION_INPUT] = "".join(store.decision_hashes(REGION_INPUT))
    return inputs


def _load_meta(store: Session, scan: str) -> dict[str, Any]:
    """Return the stored edits of a scan, without pixels; empty where it has none."""
    name = f"{FOLDER}/{scan}"
    return store.load_meta(name) if store.has_result(name) else {}


def _read_edit(entry: dict[str, Any], packed: np.ndarray | None, size: tuple[int, int]) -> Edit:
    """Return the edit of an entry, and of its ``packed`` pixels; InputError for one that does not
    fit them."""
    what, points, made = entry["what"], entry["points"], entry.get("made", "")
    if entry["kind"] == "pixels":
        if packed is None:
            raise InputError(f"the pixels of {what!r} are missing")
        return Edit(what, points, unpack_mask(packed, size), made=made)
    plane = from_plain(entry, SupportPlane)
    numbers = [*plane.normal, plane.offset_mm, plane.margin_mm]
    if not np.isfinite(numbers).all() or abs(np.linalg.norm(plane.normal) - 1) > 1e-3:
        raise InputError(f"the plane of {what!r} has the numbers {numbers}")
    return Edit(what, points, plane=plane, made=made)
