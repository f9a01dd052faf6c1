"""What a session holds, in words, and whether it is what was saved."""

from collections.abc import Callable, Iterable, Mapping
from functools import partial
from typing import Any

import numpy as np

from slviewer.errors import DamagedError, SlviewerError
from slviewer.pipeline.calibrate import load_last_verdict
from slviewer.pipeline.feedback import Progress, ignore_progress
from slviewer.pipeline.measurements import describe_measurement, load_measurements
from slviewer.pipeline.models import available_models, load_stereo, preferred_model
from slviewer.pipeline.open_session import SessionLike, opened
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
        lines = [f"{store.folder}: {len(captures)} capture{'s' * (len(captures) != 1)}"]
        lines += [
            f"  {name} was complete, and not yet in its place: it is now"
            for name in store.recovered
        ]
        parts: list[Callable[[], Iterable[str]]] = [
            partial(_describe_captures, store, captures),
            *(partial(_describe_calibration, store, name) for name in available_models(store)),
            partial(_describe_verdict, store),
            partial(_describe_measurements, store),
        ]
        for part in parts:
            try:
                lines += part()
            except SlviewerError as error:  # one damaged file hides nothing else
                damage.append(str(error))
        if not available_models(store):
            lines.append("no calibration yet: run `slviewer calibrate` with the --target in use")
        lines += [f"damaged: {fault}" for fault in dict.fromkeys(damage)]
    return "\n".join(lines)


def _check(store: Session, progress: Progress) -> str:
    """Read everything, and describe what was compared. Raises DamagedError that lists what is
    damaged, if anything."""
    (captures, faults), results = store.read_captures(), store.result_names()
    damage = [*faults.values(), *store.decision_faults()]
    checks: list[tuple[str, Callable[[], object]]] = [
        (capture.name, capture.verify) for capture in captures
    ]
    checks += [(name, partial(verify_result, store.folder / "results" / name)) for name in results]
    for i, (name, verify) in enumerate(checks):
        progress(i / len(checks), f"checking {name}")
        try:
            verify()
        except SlviewerError as error:
            damage.append(str(error))
    progress(1.0, "checked")
    counts = f"{len(captures)} captures and {len(results)} results"
    if damage:
        raise DamagedError(
            "\n  ".join([f"{store.folder}: {counts} were read, and this is damaged:", *damage])
        )
    return f"{store.folder}: {counts} are what was saved"


def _describe_captures(store: Session, captures: Iterable[Capture]) -> list[str]:
    """A line for each capture."""
    excluded = store.valid_decision("excluded") or {}
    notes = {name: f"  [excluded: {why}]" for name, why in excluded.items()}
    return [f"  {summarise_capture(capture)}{notes.get(capture.name, '')}" for capture in captures]


def _describe_calibration(store: Session, name: str) -> list[str]:
    """One model of the session's calibration, by name: what it was made from, its state, its
    accuracy."""
    state = store.state_of(f"calibration/{name}")
    meta = store.load_result(f"calibration/{name}", only=())[0]
    mark = ", the default" if name == preferred_model(store) else ""
    made = (
        f"imported from {meta['source']}"
        if "imported" in meta
        else f"from {len(meta['inputs'])} poses"
    )
    lines = [f"calibration {name}: {made}, {state}{mark}"]
    if "imported" in meta:
        lines += _describe_imported_calibration(meta)
    elif name == "stereo":
        rms = load_stereo(store).reprojection_rms_px
        lines.append("  reprojection RMS " + ", ".join(f"{k} {v:.3f} px" for k, v in rms.items()))
    return lines


def _describe_verdict(store: Session) -> list[str]:
    """The verdict on the last attempt to calibrate, where there was one."""
    verdict = load_last_verdict(store)
    return [] if verdict is None else [verdict.text()]


def _describe_measurements(store: Session) -> list[str]:
    """The measurements, a line each."""
    measured = load_measurements(store)
    heading = f"{len(measured)} measurement{'s' * (len(measured) != 1)}:"
    return [heading, *(f"  {describe_measurement(each)}" for each in measured)] if measured else []


def _describe_imported_calibration(meta: Mapping[str, Any]) -> list[str]:
    """Sizes, lenses and baseline of a calibration that was imported."""
    lines = []
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
