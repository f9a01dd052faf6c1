"""From a stored capture to phase maps and a texture."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal, TypeVar, get_args

import cv2
import numpy as np

from slviewer.errors import InputError
from slviewer.examination.findings import describe_disturbance
from slviewer.examination.light import Look, estimate_frame_light, look_at
from slviewer.fringe.decode import decode, texture
from slviewer.fringe.frame_light import FrameLight
from slviewer.fringe.hdr import radiance, toned
from slviewer.fringe.image_area import fill_dead
from slviewer.fringe.layout import axis_layout, to_eight_bits, white_level
from slviewer.fringe.phase import PhaseMap, PhaseMaps, Reason
from slviewer.fringe.phase_shifting import dark_limit, dark_sigmas
from slviewer.fringe.scatter import SIGNIFICANT, measure_scatter
from slviewer.fringe.sequence import PatternSequence
from slviewer.pipeline.examination import (
    MUCH_CLIPPED,
    examine_frames,
    load_examination,
    load_or_save_examination,
)
from slviewer.pipeline.models import load_pair
from slviewer.pipeline.operation import (
    Progress,
    SessionLike,
    Warn,
    ignore_progress,
    ignore_warnings,
    opened,
)
from slviewer.reconstruction.camera_match import Lines, epipolar_lines, match_cameras
from slviewer.records.verdict import Examination
from slviewer.report.maps import REASON_LABELS, phase_maps, reason_shares
from slviewer.session.atomic import to_json
from slviewer.session.capture import Capture
from slviewer.session.exporters import write_exr
from slviewer.session.store import Session

T = TypeVar("T")
Computed = TypeVar("Computed")
NEAR_DARK = 2.0
"""A median modulation within this factor of the least that is decoded: much of the scene lies below
it."""
MIN_DECODED = 0.05
"""Share of the illuminated pixels that must decode: of sound captures, also cluttered ones, half
and more do."""
CONTRADICT = "contradict themselves or their neighbours"
_FAULTS = {
    Reason.SATURATED: ("are saturated", "lower the exposure or the gain, and capture again"),
    Reason.INCONSISTENT: (
        CONTRADICT,
        "keep the scene and the light still, raise the exposure, and check the description of the"
        " frames",
    ),
    Reason.INDIRECT: (
        "receive much light from other surfaces or through the material",
        "use the patterns micro, and see docs/howto/difficult-surfaces.md",
    ),
    Reason.OUTSIDE: (
        "lie outside the projector",
        "check the size of the projector and the periods",
    ),
}
"""Why illuminated pixels do not decode, and what to do."""


def decode_capture(
    capture: Capture, look: Look | None = None, *, relative: bool = False
) -> PhaseMaps:
    """Decode the absolute phase of every axis of a capture, by a ``look`` at its frames, taken here
    if None.

    Raises InputError for a phase that is not absolute, unless a ``relative`` one will do.
    """
    look = look or look_at_capture(capture)
    phases = decode_or_explain(capture.name, capture.sequence, look, capture.files)
    for axis, phase in phases.items():
        if phase.is_relative and not relative:
            raise InputError(
                f"the phase of axis {axis} repeats every {phase.unambiguous_px:g} px of the"
                " projector, so that it gives no projector coordinate",
                "`slviewer reconstruct --depth-range NEAR FAR` measures a scan whose depths are"
                " known, `slviewer decode` writes the phase as it is; calibrate with patterns that"
                " cover the projector",
                capture.name,
            )
    return phases


def match_second(
    capture: Capture,
    phases: PhaseMaps,
    lines: Callable[[np.ndarray], Lines] | None = None,
    warn: Warn = ignore_warnings,
) -> PhaseMaps:
    """Return what a capture is reconstructed from: its decoded ``phases``, or, where two cameras
    saw it, the coordinates of the second one, as `match_cameras` does.

    Its frames are examined as those of the first; ``warn`` is called with what is found.

    Raises InputError for frames that the examination rejects, for phases that are not absolute, and
    for patterns along one axis without ``lines``, which are asked for with the second camera's
    texture then.
    """
    second = capture.second
    if second is None:
        return phases
    look = look_at_capture(second)
    examination = examine_frames(second.sequence, look.stack, second.files, look)
    raise_rejected(second.name, examination)
    for message in examination.warnings():
        warn(f"{second.name}: {message}")
    known = None
    if lines is not None and len(phases) == 1:
        image = capture_texture(second, look.stack)
        known = lines(fill_dead(image, look.area))
    return match_cameras(phases, decode_capture(second, look), known)


def _calibrated_lines(session: Session, _: np.ndarray) -> Lines:
    """Return the epipolar lines of a session's cameras, whatever the texture."""
    return epipolar_lines(load_pair(session))


def decode_frames(
    name: str, sequence: PatternSequence, frames: np.ndarray, light: FrameLight | None = None
) -> PhaseMaps:
    """Decode the phase of every axis, absolute or not, under equal light; errors name the capture.

    ``light`` of the frames is estimated if None.
    """
    try:
        light = light or estimate_frame_light(sequence, frames)
        return {axis: decode(sequence, frames, axis, light) for axis in sequence.axes}
    except InputError as error:
        raise error.within(name) from error


def decode_or_explain(
    name: str, sequence: PatternSequence, look: Look, files: Sequence[str] = ()
) -> PhaseMaps:
    """Decode as `decode_frames` does; where that fails, raise InputError with what the examination
    of the frames rejects, if it does."""
    try:
        return decode_frames(name, sequence, look.stack, look.light)
    except InputError:
        raise_rejected(name, examine_frames(sequence, look.stack, files, look))
        raise


def decode_examined(
    name: str, sequence: PatternSequence, frames: np.ndarray, files: Sequence[str] = ()
) -> PhaseMaps:
    """Examine the frames (n, h, w), decode them, and check what was decoded.

    Raises InputError like `check_capture`, and for frames that cannot be decoded; what the
    examination rejects comes first, as it explains the others. ``files``: names of the frames'
    files.
    """
    look = look_at(sequence, frames)
    examination = examine_frames(sequence, frames, files, look)
    raise_rejected(name, examination)
    phases = decode_frames(name, sequence, frames, look.light)
    check_capture(name, sequence, frames, phases, examination)
    return phases


def raise_rejected(name: str, examination: Examination) -> None:
    """Raise InputError where the examination of a capture rejects it."""
    if examination.rejected:
        *others, last = examination.rejected
        observation = "; ".join([*(f.text() for f in others), last.observation])
        raise InputError(observation, last.remedy, name)


def check_capture(
    name: str,
    sequence: PatternSequence,
    frames: np.ndarray,
    phases: PhaseMaps,
    examination: Examination | None = None,
    files: Sequence[str] = (),
) -> None:
    """Raise InputError where the frames (n, h, w) contradict their description, or next to nothing
    of them decodes.

    ``examination``: of these frames, made here if None. ``files``: names of the frames' files.
    """
    examination = examination or examine_frames(sequence, frames, files)
    raise_rejected(name, examination)
    for axis, phase in phases.items():
        illuminated, decoded = np.count_nonzero(phase.illuminated), np.count_nonzero(phase.mask)
        if decoded and decoded >= MIN_DECODED * illuminated:
            continue
        if illuminated:
            share, fault, remedy = max(
                (phase.share(each), *fault) for each, fault in _FAULTS.items()
            )
            if fault == CONTRADICT and examination.findings:
                *others, last = examination.findings
                fault = "; ".join([CONTRADICT, *(f.text() for f in others), last.observation])
                remedy = last.remedy
            raise InputError(
                f"{decoded} of {illuminated} illuminated pixels"
                f" ({100 * decoded / illuminated:.1f} %) give a coordinate along {axis};"
                f" {100 * share:.0f} % of them {fault}",
                remedy,
                name,
            )
        if unexplained := estimate_frame_light(sequence, frames).unexplained:
            disturbance = describe_disturbance(unexplained)
            raise InputError(
                f"no pixel carries a readable {axis} pattern: {disturbance.observation}",
                disturbance.remedy,
                name,
            )
        middle = float(np.median(phase.modulation))
        raise InputError(
            f"no pixel carries a readable {axis} pattern (the modulation is {middle:.1f} grey"
            " levels in the median)",
            "raise the exposure or the projector's brightness",
            name,
        )


def loss_warnings(sequence: PatternSequence, frames: np.ndarray, phases: PhaseMaps) -> list[str]:
    """Return warnings where saturation or weak fringes mask many pixels of a decoded capture (n, h,
    w)."""
    messages = []
    saturated = max((phase.share(Reason.SATURATED) for phase in phases.values()), default=0.0)
    if saturated > MUCH_CLIPPED:
        white = white_level(sequence, frames, range(len(frames)))
        messages.append(
            f"{100 * saturated:.0f} % of the illuminated pixels are saturated and masked: lower the"
            f" exposure or the gain until white stays below grey level {white:.0f}, where the"
            " camera clips"
        )
    for axis, phase in phases.items():
        if not (phase.steps and phase.mask.any()):
            continue
        modulation = float(np.median(phase.modulation[phase.mask]))
        least = least_modulation(sequence, frames, phase)
        if modulation < NEAR_DARK * least:
            if unexplained := estimate_frame_light(sequence, frames).unexplained:
                cause = describe_disturbance(unexplained).text()
                messages.append(f"{cause}; pixels of a modulation below {least:.1f} are masked")
                break
            messages.append(
                f"the {axis} fringes are weak for the noise of these frames: their modulation is"
                f" {modulation:.0f} grey levels in the median, and pixels below"
                f" {least:.1f} are masked; make the patterns brighter (longer exposure,"
                " wider aperture, nearer projector, darker room)"
            )
            break
    return messages + scatter_warnings(phases)


def least_modulation(sequence: PatternSequence, frames: np.ndarray, phase: PhaseMap) -> float:
    """Return the modulation, grey levels, below which pixels of the median background are
    masked."""
    background = np.array([np.median(phase.background[phase.mask])], np.float32)
    white = white_level(sequence, frames, sequence.select(phase.axis))
    sigmas = dark_sigmas(axis_layout(sequence, phase.axis))
    return float(dark_limit(background, phase.noise, white, sigmas)[0])


def scatter_warnings(phases: PhaseMaps) -> list[str]:
    """Return warnings where neighbouring pixels scatter more than the camera's noise explains: by
    how much, and what to do."""
    worst = max(phases.values(), key=lambda phase: phase.sigma_scale, default=None)
    if worst is None or worst.sigma_scale <= SIGNIFICANT:
        return []
    if measure_scatter(worst).is_compressed:
        cause = "the images were compressed (JPEG blocks of 8 x 8 pixels)"
        cure = "record PNG, TIFF or raw images"
    else:
        cause, cure = "sharpening or compression may be the cause", "switch them off in the camera"
    return [
        f"{cause}: along {worst.axis} neighbouring pixels scatter {worst.sigma_scale:.1f} times as"
        f" much as the camera's noise explains, and the stated uncertainty includes this; {cure}"
    ]


def capture_texture(capture: Capture, frames: np.ndarray, *, stretch: bool = True) -> np.ndarray:
    """Return the image of the scene under white light, (h, w) or (h, w, 3) uint8.

    ``stretch``: as `convert_to_8bit` does, in which boards are detected whatever the exposure; else
    255 is the camera's full scale where it is known, as for display.
    """
    colour = capture.texture
    image = texture(capture.sequence, frames) if colour is None else colour
    choice = capture.exposure_choice
    if colour is None and choice is not None:
        return toned(radiance(image, choice, capture.exposures_ms))
    full_scale = capture.sequence.full_scale
    return convert_to_8bit(
        image if stretch or full_scale is None else to_eight_bits(image, full_scale)
    )


def convert_to_8bit(image: np.ndarray) -> np.ndarray:
    """Convert an image to uint8, its brightest pixel 255 where it has 16 bits."""
    if image.dtype == np.uint16:
        image = cv2.convertScaleAbs(image, alpha=255.0 / max(int(image.max()), 1))
    return np.ascontiguousarray(image, np.uint8)


def decode_captures(
    session: Session,
    names: Sequence[str],
    warn: Warn,
    *,
    relative: bool = False,
    check: bool = True,
    matched: bool = True,
) -> Iterator[tuple[Capture, np.ndarray, PhaseMaps]]:
    """Captures with their frames and phases, in order; the next one's frames are read while one is
    processed.

    ``warn`` is called with frames that contradict the others, and with the reasons why many pixels
    are masked; ``relative`` as in `decode_capture`. ``check``: compare the frames of captures that
    have no saved comparison. ``matched``: what two cameras saw is matched by the session's
    calibration, as in `match_second`; else the phases are those of the projector.
    """
    captures = [session.load_capture(name) for name in names]
    for capture, looking in compute_ahead(look_at_capture, captures):
        look = looking.result()
        frames, phases = look.stack, decode_capture(capture, look, relative=relative)
        if warn is not ignore_warnings:
            compared = (
                load_or_save_examination(session, capture, look)
                if check
                else load_examination(session, capture.name)
            )
            messages = compared.warnings() if compared else []
            for message in [*messages, *loss_warnings(capture.sequence, frames, phases)]:
                warn(f"{capture.name}: {message}")
        if matched and capture.second is not None:
            lines = partial(_calibrated_lines, session)
            phases = match_second(capture, phases, lines, warn)
        yield capture, frames, phases


def look_at_capture(capture: Capture) -> Look:
    """Read the frames of a capture, and look at them. Raises DamagedError where they are not what
    was saved."""
    return look_at(capture.sequence, capture.stack())


def compute_ahead(
    compute: Callable[[T], Computed], items: Sequence[T], at_once: int = 1
) -> Iterator[tuple[T, Future[Computed]]]:
    """Yield items with what is computed of them, whose `result()` may raise; the next ``at_once``
    items are computed while one is processed."""
    with ThreadPoolExecutor(at_once) as worker:
        ahead = [worker.submit(compute, item) for item in items[:at_once]]
        for i, item in enumerate(items):
            computed = ahead.pop(0)
            wait([computed])
            ahead += [worker.submit(compute, each) for each in items[i + at_once :][:1]]
            yield item, computed


MapFormat = Literal["npy", "exr"]
REASONS = {
    Reason.VALID: "the phase is valid",
    Reason.DARK: (
        "too little modulation for the noise: shadow, black surface, or outside of the projector's"
        " light"
    ),
    Reason.SATURATED: "the camera clipped the patterns",
    Reason.INCONSISTENT: (
        "a bit could not be decided, or the fringe order contradicts the phase or the neighbourhood"
    ),
    Reason.OUTSIDE: "the coordinate lies outside of the projector",
    Reason.INDIRECT: "much of the light came by way of other surfaces or through the material",
    Reason.UNSEEN: "the second camera does not see the point, or sees an edge there",
}
"""What the codes of the files `reason_<axis>` stand for."""
_UNITS = {
    "phase": "rad, 2 pi u / period_px, 0 at the centre of projector column (row) 0; NaN: masked",
    "coordinate": (
        "projector px, 0 at the centre of column (row) 0; modulo unambiguous_px where that is a"
        " number; NaN: masked"
    ),
    "sigma": (
        "projector px, standard deviation of the coordinate by the camera's noise; NaN: masked"
    ),
    "modulation": "grey levels, amplitude of the fringes; of Gray code alone half its contrast",
    "reason": "uint8 code, see reasons",
}
_AXIS_FIGURES = (
    "coordinate_px", "median_modulation", "median_background", "noise_levels", "median_sigma_px",
)  # fmt: skip


@dataclass(frozen=True)
class DecodedFiles:
    """A decoded capture and the files that it was written to, by what they hold."""

    capture: str
    phases: PhaseMaps
    folder: Path
    files: Mapping[str, str]

    def to_json(self) -> dict[str, Any]:
        """What `decoded.json` explains: files, units, codes, and the figures of each axis."""
        return {
            "capture": self.capture,
            "files": dict(self.files),
            "units": _UNITS,
            "reasons": {
                str(int(reason)): f"{REASON_LABELS[reason]}: {words}"
                for reason, words in REASONS.items()
            },
            "axes": {axis: axis_figures(phase) for axis, phase in self.phases.items()},
        }

    def text(self) -> str:
        """Return the result as a report for the terminal."""
        lines = []
        for axis, phase in self.phases.items():
            figures = axis_figures(phase)
            shares = (f"{name} {100 * share:.1f} %" for name, share in figures["shares"].items())
            lines.append(f"{self.capture}, axis {axis}: {', '.join(shares)}")
            if figures["coordinate_px"] is None:
                continue
            low, high = figures["coordinate_px"]
            what = "period" if phase.steps else "cells of Gray code"
            only = f", known only modulo {phase.unambiguous_px:g} px" if phase.is_relative else ""
            lines.append(
                f"  {what} {phase.period_px:g} px{only}: coordinates {low:.1f}-{high:.1f} px,"
                f" modulation {figures['median_modulation']:.1f} and noise"
                f" {figures['noise_levels']:.2f} grey levels, sigma"
                f" {figures['median_sigma_px']:.4f} px (medians)"
            )
        lines.append(f"{len(self.files)} files -> {self.folder}; decoded.json explains them")
        return "\n".join(lines)


def axis_figures(phase: PhaseMap) -> dict[str, Any]:
    """Shares of the pixels by reason, and medians over the valid ones; None where no pixel is
    valid.

    ``noise_levels`` is the standard deviation of one frame at the median background, in grey
    levels.
    """
    valid, shares = phase.mask, reason_shares(phase)
    figures: dict[str, Any] = dict.fromkeys(_AXIS_FIGURES)
    if valid.any():
        coordinate, (a, b) = phase.coordinate[valid], phase.noise
        maps = (phase.modulation, phase.background, phase.sigma_px)
        modulation, background, sigma = (float(np.median(each[valid])) for each in maps)
        coordinates = [float(coordinate.min()), float(coordinate.max())]
        noise = float(np.sqrt(a + b * background))
        values = (coordinates, modulation, background, noise, sigma)
        figures = dict(zip(_AXIS_FIGURES, values, strict=True))
    return {
        "period_px": phase.period_px,
        "steps": phase.steps,
        "unambiguous_px": phase.unambiguous_px if phase.is_relative else None,
        "shares": {REASON_LABELS[why]: round(share, 6) for why, share in shares.items()},
        **figures,
    }


def write_decoded(
    session: SessionLike,
    capture: str,
    out: Path | str,
    *,
    file_format: MapFormat = "npy",
    progress: Progress = ignore_progress,
    warn: Warn = ignore_warnings,
) -> DecodedFiles:
    """Decode a capture: absolute phase and projector coordinate of each pixel, the mask with its
    reasons, a picture.

    Args:
        session: Session folder.
        capture: Name of the capture.
        out: Folder for the files; made if it does not exist. decoded.json in it explains them.
        file_format: npy (NumPy) or exr (OpenEXR) for the maps, float32, NaN where masked.

    For each axis ``phase`` (rad), ``coordinate`` and ``sigma`` (projector px), ``modulation`` (grey
    levels, not masked) as (h, w) maps, and ``reason``, uint8 codes, as .npy or .png; the picture is
    ``decoded.png``. Files of the same names are replaced. Raises InputError like `decode_capture`.
    """
    if file_format not in get_args(MapFormat):
        raise InputError(f"maps cannot be written as '{file_format}'", "use npy or exr")
    folder, files = Path(out), dict[str, str]()
    with opened(session) as store:
        progress(0.1, "decoding")
        _, _, phases = next(decode_captures(store, [capture], warn, relative=True, matched=False))
    progress(0.6, "writing")
    folder.mkdir(parents=True, exist_ok=True)
    for axis, phase in phases.items():
        for name in _UNITS:
            values = getattr(phase, "sigma_px" if name == "sigma" else name)
            suffix = "png" if name == "reason" and file_format == "exr" else file_format
            files[f"{name}_{axis}"] = f"{name}_{axis}.{suffix}"
            path = folder / f"{name}_{axis}.{suffix}"
            if suffix == "png":
                path.write_bytes(cv2.imencode(".png", values)[1].tobytes())
            elif suffix == "exr":
                write_exr(path, values)
            else:
                np.save(path, values)
    files["picture"] = "decoded.png"
    (folder / "decoded.png").write_bytes(phase_maps(capture, phases).png)
    result = DecodedFiles(capture, phases, folder, files)
    (folder / "decoded.json").write_bytes(to_json(result.to_json()))
    progress(1.0, "decoded")
    return result
