"""What restricts scans to a part of their points: the edits of each scan, `edits/SCAN`, and the
session's region.

Results that are made of such points name both as inputs, so that they are stale once one changes.
"""

import hashlib
from collections.abc import Iterable

import numpy as np

from slviewer.errors import DamagedError, InputError
from slviewer.session.decisions import REGION_INPUT
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
    name, capture = f"{FOLDER}/{scan}", store.load_capture(scan)
    if not store.has_result(name):
        return EditHistory()
    meta, arrays = store.load_result(name)
    if meta["capture"] != capture.hash:
        return EditHistory()
    try:
        if tuple(meta["size"]) != tuple(capture.size):
            raise InputError(
                f"they are of {meta['size']} pixels, the capture has {list(capture.size)}"
            )
        return EditHistory(
            tuple(
                _read_edit(i, entry, meta["size"], arrays) for i, entry in enumerate(meta["edits"])
            ),
            meta["applied"],
        )
    except (InputError, KeyError) as error:
        raise DamagedError(
            f"the edits of {scan} are damaged ({error}): restore {store.folder / 'results' / name}"
            " from a copy, or delete it, which forgets them"
        ) from error


def list_edits(store: Session, scan: str) -> tuple[tuple[str, ...], int]:
    """Return (the edits of a scan that are in effect, in words; the number of those that were
    undone)."""
    name = f"{FOLDER}/{scan}"
    meta = store.load_result(name, only=())[0] if store.has_result(name) else {}
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
    entries = [_to_plain(edit) for edit in history.edits]
    content = hashlib.blake2b(digest_size=20)
    for i, entry in enumerate(entries[: history.applied]):
        used = sorted((key, value) for key, value in entry.items() if key != "made")
        content.update(repr(used).encode() + arrays.get(str(i), np.zeros(0, np.uint8)).tobytes())
    meta = {
        "capture": capture.hash,
        "size": list(capture.size),
        "applied": history.applied,
        "edits": entries,
        "content": content.hexdigest() if history.applied else "",
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
    stored = None
    if region is not None:
        stored = {
            "centre_mm": list(region.centre_mm),
            "size_mm": list(region.size_mm),
            "rotation_deg": list(region.rotation_deg),
            "on": on,
        }
    store.decide("region", stored)


def restriction_inputs(
    store: Session, scans: Iterable[str], *, with_region: bool = True
) -> dict[str, str]:
    """Return {input: hash} of the edits of scans, and of the region, for `meta["inputs"]`; "" for
    what there is not."""
    inputs = {}
    for scan in scans:
        name = f"{FOLDER}/{scan}"
        inputs[name] = (
            str(store.load_result(name, only=())[0].get("content", ""))
            if store.has_result(name)
            else ""
        )
    if with_region:
        inputs[REGION_INPUT] = "".join(store.decision_hashes(REGION_INPUT))
    return inputs


def _to_plain(edit: Edit) -> dict[str, object]:
    """Return an edit as plain values, without its pixels."""
    plane = edit.plane
    return {
        "kind": edit.kind,
        "what": edit.what,
        "points": edit.points,
        "normal": None if plane is None else list(plane.normal),
        "offset_mm": None if plane is None else plane.offset_mm,
        "margin_mm": None if plane is None else plane.margin_mm,
        "made": edit.made,
    }


def _read_edit(
    index: int, entry: dict[str, object], size: tuple[int, int], arrays: dict[str, np.ndarray]
) -> Edit:
    """Return the edit of an entry; InputError, KeyError for one that does not fit the arrays."""
    what, points = str(entry["what"]), int(entry["points"])  # type: ignore[call-overload]
    made = str(entry.get("made", ""))
    if entry["kind"] == "pixels":
        return Edit(what, points, unpack_mask(arrays[str(index)], size), made=made)
    numbers = [*(entry["normal"] or ()), entry["offset_mm"], entry["margin_mm"]]  # type: ignore[misc]
    values = np.array(numbers, float)
    if (
        values.shape != (5,)
        or not np.isfinite(values).all()
        or abs(np.linalg.norm(values[:3]) - 1) > 1e-3
    ):
        raise InputError(f"the plane of edit {index + 1} has the numbers {numbers}")
    x, y, z, offset, margin = values.tolist()
    return Edit(what, points, plane=SupportPlane((x, y, z), offset, margin), made=made)
