"""What a session holds, in words, and whether it is what was saved; and what is in its trash."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial

import numpy as np

from slviewer.errors import DamagedError, InputError, SlviewerError
from slviewer.evaluation.render import format_count, render
from slviewer.pipeline.calibrate import load_last_verdict
from slviewer.pipeline.feedback import Progress, ignore_progress
from slviewer.pipeline.measure import describe_measurement
from slviewer.pipeline.models import available_models, load_stereo, preferred_model
from slviewer.pipeline.open_session import SessionLike, match_names, opened
from slviewer.pipeline.stored_records import list_records
from slviewer.records.measurement import Measurement
from slviewer.session.capture import Capture
from slviewer.session.results import verify_result
from slviewer.session.store import Session


def inspect(
    session: SessionLike, *, check: bool = False, progress: Progress = ignore_progress
) -> str:
    """List what a session holds, and what is stale or damaged.

    Args:
        session: Session folder.
        check: Read every capture and result, and compare it with the hash that it was saved with;
            ends with status 1 where anything is damaged.
    """
    with opened(session) as store:
        if check:
            return _check(store, progress)
        captures, faults = store.read_captures()
        damage = [*faults.values(), *store.decision_faults()]
        lines = [f"{store.folder}: {format_count(len(captures), 'capture')}"]
        lines += [
            f"  {name} was complete, and not yet in its place: it is now"
            for name in store.recovered
        ]
        models = available_models(store)
        with _collecting(damage):
            excluded = store.valid_decision("excluded") or {}
            for capture in captures:
                why = excluded.get(capture.name)
                note = f"  [excluded: {why}]" if why else ""
                lines.append(f"  {summarise_capture(capture)}{note}")
        for name in models:
            with _collecting(damage):
                lines += _describe_calibration(store, name)
        with _collecting(damage):
            if (verdict := load_last_verdict(store)) is not None:
                lines.append(verdict.text())
        with _collecting(damage):
            if measured := list_records(store, Measurement):
                lines.append(f"{format_count(len(measured), 'measurement')}:")
                lines += [f"  {describe_measurement(each)}" for each in measured]
        if not models:
            lines.append("no calibration yet: run `slviewer calibrate` with the --target in use")
        lines += [f"damaged: {fault}" for fault in dict.fromkeys(damage)]
    return "\n".join(lines)


def _check(store: Session, progress: Progress) -> str:
    """Read everything, and describe what was compared. Raises DamagedError that lists what is
    damaged, if anything."""
    (captures, faults), results = store.read_captures(), store.result_names()
    damage = [*faults.values(), *store.decision_faults()]
    checks: list[tuple[str, Callable[[], object]]] = [(each.name, each.verify) for each in captures]
    checks += [(name, partial(verify_result, store.folder / "results" / name)) for name in results]
    for i, (name, verify) in enumerate(checks):
        progress(i / len(checks), f"checking {name}")
        with _collecting(damage):
            verify()
    progress(1.0, "checked")
    counts = f"{len(captures)} captures and {len(results)} results"
    if damage:
        raise DamagedError(
            "\n  ".join([f"{store.folder}: {counts} were read, and this is damaged:", *damage])
        )
    return f"{store.folder}: {counts} are what was saved"


@contextmanager
def _collecting(damage: list[str]) -> Iterator[None]:
    """Context manager: an error of slviewer ends the block and is added; one damaged file hides
    nothing else."""
    try:
        yield
    except SlviewerError as error:
        damage.append(str(error))


def _describe_calibration(store: Session, name: str) -> list[str]:
    """One model of the session's calibration, by name: what it was made from, its state, its
    accuracy."""
    state = store.state_of(f"calibration/{name}")
    meta = store.load_result(f"calibration/{name}", only=())[0]
    mark = ", the default" if name == preferred_model(store) else ""
    if "imported" not in meta:
        lines = [f"calibration {name}: from {len(meta['inputs'])} poses, {state}{mark}"]
        if name == "stereo":
            rms = load_stereo(store).reprojection_rms_px.items()
            lines.append("  reprojection RMS " + ", ".join(f"{k} {v:.3f} px" for k, v in rms))
        return lines
    lines = [f"calibration {name}: imported from {meta['source']}, {state}{mark}"]
    for device in ("camera", "projector"):
        K, size = np.array(meta["imported"][f"K_{device}"]), meta[device]
        size_text = f"{size[0]}x{size[1]} px" if size else "size not stated (the captures' is used)"
        lines.append(
            f"  {device} {size_text}, focal length {K[0, 0]:.1f}, {K[1, 1]:.1f} px, "
            f"principal point {K[0, 2]:.1f}, {K[1, 2]:.1f} px"
        )
    T = np.array(meta["imported"]["T"])
    return [*lines, f"  baseline {np.linalg.norm(T):.1f} mm; it states no reprojection error"]


def summarise_capture(capture: Capture) -> str:
    """A capture in one line: sizes, axes, frames, and the finest pattern of each axis."""
    sequence, (width, height) = capture.sequence, capture.size
    patterns = ", ".join(
        f"{axis} {'period' if sequence.periods_px(axis) else 'Gray cell'}"
        f" {sequence.period_px(axis):g} px"
        for axis in sequence.axes
    )
    size = sequence.projector_size
    projector = f"{size[0]}x{size[1]}" if size else "of unknown size"
    line = (
        f"{capture.name:<16} {capture.role:<12} camera {width}x{height}, projector {projector}, "
        f"{'axis' if len(sequence.axes) == 1 else 'axes'} {' and '.join(sequence.axes)}, "
        f"{len(sequence.frames)} frames, {patterns}"
    )
    if capture.exposures_ms:
        line += f", exposures {', '.join(f'{exposure:g}' for exposure in capture.exposures_ms)} ms"
    return line + (", colour" if capture.meta.get("texture") else "")


def restore(session: SessionLike, names: Sequence[str] = ()) -> str:
    """List what is in a session's trash, or bring back what is named.

    Captures and results that were deleted or replaced are in the trash. What has a restored name
    now goes there in exchange, in one step.

    Args:
        session: Session folder.
        names: What to bring back: names, the last deleted of each, or patterns such as
            'calibration/*', or the name of one folder in the trash; without any, the trash is
            listed.
    """
    with opened(session, write=bool(names)) as store:
        trashed = store.trashed()
        if not names:
            if not trashed:
                return f"nothing is in the trash of {store.folder}"
            rows = [
                {
                    "name": each.name,
                    "kind": "capture" if each.is_capture else "result",
                    "deleted (UTC)": f"{each.time:%Y-%m-%d %H:%M:%S}",
                    "folder in the trash": each.place.name,
                }
                for each in trashed
            ]
            return render(rows)
        latest = {each.name: each for each in reversed(trashed)}
        latest |= {each.place.name: each for each in trashed}
        found = match_names(list(latest), names, "item of the trash", InputError)
        chosen = list(
            dict.fromkeys(  # patterns match no folders
                latest[name] for name in found if name in names or name == latest[name].name
            )
        )
        store.restore(chosen)
        return "\n".join(
            f"restored: {each.name}, deleted {each.time:%Y-%m-%d %H:%M:%S} UTC" for each in chosen
        )
