"""What was measured, as panels draw it: read with every snapshot, and so without looking at what it was made from."""

from collections.abc import Mapping

from slviewer.session.measurements import FOLDER, NAMES, Measurement, as_saved
from slviewer.session.store import Session


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
                found.append(as_saved(result.removeprefix(kind), meta, names, stale))
            if not stale:
                known[result] = meta["hash"]
    return tuple(found)


def _changed(used: Mapping[str, object], now: Mapping[str, object]) -> bool:
    return any(now.get(name) != value for name, value in used.items())
