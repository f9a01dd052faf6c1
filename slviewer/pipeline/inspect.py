"""What a session holds, in words."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from slviewer.pipeline.calibration_verdict import load_last_verdict
from slviewer.pipeline.measurements import describe_measurement, load_measurements
from slviewer.pipeline.models import available_models, load_stereo, preferred_model
from slviewer.pipeline.open_session import SessionLike, opened
from slviewer.session.capture import Capture


def inspect(session: SessionLike) -> str:
    """List what a session holds, and what is stale.

    Args:
        session: Session folder.
    """
    with opened(session) as store:
        excluded = store.excluded()
        captures = store.captures()
        lines = [f"{store.folder}: {len(captures)} capture{'s' * (len(captures) != 1)}"]
        for capture in captures:
            note = f"  [excluded: {excluded[capture.name]}]" if capture.name in excluded else ""
            lines.append(f"  {summarise_capture(capture)}{note}")
        for name in available_models(store):
            state = store.state_of(f"calibration/{name}")
            meta = store.load_result(f"calibration/{name}", only=())[0]
            mark = ", the default" if name == preferred_model(store) else ""
            made = f"imported from {meta['source']}" if "imported" in meta else f"from {len(meta['inputs'])} poses"
            lines.append(f"calibration {name}: {made}, {state}{mark}")
            if "imported" in meta:
                lines += _describe_imported_calibration(meta)
            elif name == "stereo":
                rms = load_stereo(store).reprojection_rms_px
                lines.append("  reprojection RMS " + ", ".join(f"{k} {v:.3f} px" for k, v in rms.items()))
        verdict = load_last_verdict(store)
        if verdict is not None:
            lines.append(verdict.text())
        measured = load_measurements(store)
        if measured:
            lines.append(f"{len(measured)} measurement{'s' * (len(measured) != 1)}:")
            lines += [f"  {describe_measurement(each)}" for each in measured]
        if not available_models(store):
            lines.append("no calibration yet: run `slviewer calibrate` with the --target in use")
    return "\n".join(lines)


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
        f"{axis} {'period' if sequence.periods_px(axis) else 'Gray cell'} {sequence.period_px(axis):g} px"
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
