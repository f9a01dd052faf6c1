"""What a session holds, in words."""

from slviewer.session.capture import Capture
from slviewer.workflow.diagnosing import last_verdict
from slviewer.workflow.measuring import in_words, measurements
from slviewer.workflow.models import available, load_stereo, preferred
from slviewer.workflow.opening import SessionLike, opened


def inspect(session: SessionLike) -> str:
    """Captures with their role, size and sequence, calibrations with their quality, and what is stale."""
    with opened(session) as store:
        excluded = store.excluded()
        captures = store.captures()
        lines = [f"{store.folder}: {len(captures)} capture{'s' * (len(captures) != 1)}"]
        for capture in captures:
            note = f"  [excluded: {excluded[capture.name]}]" if capture.name in excluded else ""
            lines.append(f"  {summary(capture)}{note}")
        for name in available(store):
            state = store.state_of(f"calibration/{name}")
            poses = store.load_result(f"calibration/{name}", only=())[0]["inputs"]
            mark = ", the default" if name == preferred(store) else ""
            made = f"from {len(poses)} poses" if poses else "made elsewhere"
            lines.append(f"calibration {name}: {made}, {state}{mark}")
            if name == "stereo":
                rms = load_stereo(store).reprojection_rms_px
                if rms:
                    lines.append("  reprojection RMS " + ", ".join(f"{k} {v:.3f} px" for k, v in rms.items()))
        verdict = last_verdict(store)
        if verdict is not None:
            lines.append(verdict.text())
        measured = measurements(store)
        if measured:
            lines.append(f"{len(measured)} measurement{'s' * (len(measured) != 1)}:")
            lines += [f"  {in_words(each)}" for each in measured]
        if not available(store):
            lines.append("no calibration yet: run `slviewer calibrate` with the --target in use")
    return "\n".join(lines)


def summary(capture: Capture) -> str:
    """A capture in one line."""
    sequence, (width, height) = capture.sequence, capture.size
    periods = ", ".join(f"{axis} {sequence.period_px(axis):g} px" for axis in sequence.axes)
    size = sequence.projector_size
    projector = f"{size[0]}x{size[1]}" if size else "of unknown size"
    said = (
        f"{capture.name:<16} {capture.role:<12} camera {width}x{height}, projector {projector}, "
        f"{len(sequence.frames)} frames, period {periods}"
    )
    if capture.exposures_ms:
        said += f", exposures {', '.join(f'{exposure:g}' for exposure in capture.exposures_ms)} ms"
    return said + (", colour" if capture.meta.get("texture") else "")
