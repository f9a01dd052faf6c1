"""Views of the merges and measurements that a session stores, read anew with every snapshot."""

from collections import Counter
from collections.abc import Mapping
from typing import Any

import numpy as np

from slviewer.session.measurements import FOLDER, NAMES, Measurement, measurement_from_meta
from slviewer.session.store import Session
from slviewer.wizard.snapshot import MergedLoop, MergedPair, MergeView


def merge_view(name: str, meta: Mapping[str, Any], stale: bool) -> MergeView:
    """The merge of that name from what was kept of it; one that was made before keeps less."""
    pairs = meta["pairs"]
    onto = [{"scan": scan, "onto": meta["reference"], **pair} for scan, pair in pairs.items()]
    stray: Counter[str] = Counter()
    for counts in meta.get("left_out", {}).values():
        stray.update(counts)
    return MergeView(
        name=name,
        reference=meta["reference"],
        scans=tuple(meta["scans"]),
        points=meta["points"],
        pairs={
            scan: (pair["rms_mm"], pair["overlap"], np.array(pair["T_reference_scan"])) for scan, pair in pairs.items()
        },
        stale=stale,
        registered=tuple(_pair(found) for found in meta.get("registered", onto)),
        loops=tuple(
            MergedLoop(tuple(loop["scans"]), *(loop[key] for key in ("error_mm", "error_deg", "left_mm", "left_deg")))
            for loop in meta.get("loops", ())
        ),
        dropped=tuple(pair["why"] for pair in meta.get("dropped", ())),
        refused=tuple(f"{pair['scan']} -> {pair['onto']}: {pair['why']}" for pair in meta.get("refused", ())),
        stray=stray,
        shared=meta.get("shared"),
    )


def _pair(found: Mapping[str, Any]) -> MergedPair:
    T = np.array(found["T_reference_scan"])
    turned = np.degrees(np.arccos(np.clip((np.trace(T[:3, :3]) - 1) / 2, -1, 1)))
    moved = None
    if "middle" in found:
        middle = np.array(found["middle"])
        before = T[:3, :3].T @ (middle - T[:3, 3])
        moved = float(np.linalg.norm(middle - before))
    return MergedPair(
        found["scan"],
        found["onto"],
        found["rms_mm"],
        found["overlap"],
        found.get("sigma_shift_mm"),
        found.get("sigma_turn_deg"),
        moved,
        float(turned),
        found.get("point_to_point_rms_mm"),
    )


def read_measurements(
    session: Session, hashes: Mapping[str, str], factors: Mapping[str, float]
) -> tuple[Measurement, ...]:
    """All measurements, in the order in which they were made, stale as ``pipeline.measurements.measurements`` says.

    ``hashes``: of captures, and of calibrations that are fresh; ``factors``: {model: correction of scale} now.
    """
    known, found, names = dict(hashes), [], session.decision(NAMES) or {}
    results = session.result_names()
    for kind in ("scale/", "merge/", f"{FOLDER}/"):  # each is made from captures and from those before it
        for result in (name for name in results if name.startswith(kind)):
            meta = session.load_result(result, only=())[0]
            if kind == f"{FOLDER}/":
                used = meta["data"].get("scale")
                scales = {} if used is None else {meta["model"]: used}
            else:
                scales = meta.get("scales", {})
            stale = _changed(meta.get("inputs", {}), known) or _changed(scales, factors)
            if kind == f"{FOLDER}/":
                found.append(measurement_from_meta(result.removeprefix(kind), meta, names, stale))
            if not stale:
                known[result] = meta["hash"]
    return tuple(found)


def _changed(used: Mapping[str, object], now: Mapping[str, object]) -> bool:
    return any(now.get(name) != value for name, value in used.items())
