"""The decoded phase of a capture as files for other programs."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np

from slviewer.errors import InputError
from slviewer.fringe.phase import PhaseMap, Reason
from slviewer.fringe.sequence import Axis
from slviewer.pipeline.capture_phases import decode_captures
from slviewer.pipeline.feedback import Progress, Warn, ignore_progress, ignore_warnings
from slviewer.pipeline.open_session import SessionLike, opened
from slviewer.report.maps import REASON_LABELS, phase_maps, reason_shares
from slviewer.session.atomic import to_json
from slviewer.session.exporters import write_exr

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
}
"""What the codes of the files `reason_<axis>` stand for."""


@dataclass(frozen=True)
class DecodedFiles:
    """A decoded capture and the files that it was written to, by what they hold."""

    capture: str
    phases: Mapping[Axis, PhaseMap]
    folder: Path
    files: Mapping[str, str]

    def to_json(self) -> dict[str, Any]:
        """What `decoded.json` explains: files, units, codes, and the figures of each axis."""
        return {
            "capture": self.capture,
            "files": dict(self.files),
            "units": {
                "phase": (
                    "rad, 2 pi u / period_px, 0 at the centre of projector column (row) 0; NaN:"
                    " masked"
                ),
                "coordinate": (
                    "projector px, 0 at the centre of column (row) 0; modulo unambiguous_px where"
                    " that is a number; NaN: masked"
                ),
                "sigma": (
                    "projector px, standard deviation of the coordinate by the camera's noise; NaN:"
                    " masked"
                ),
                "modulation": (
                    "grey levels, amplitude of the fringes; of Gray code alone half its contrast"
                ),
                "reason": "uint8 code, see reasons",
            },
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
            shares = ", ".join(
                f"{name} {100 * share:.1f} %" for name, share in figures["shares"].items()
            )
            lines.append(f"{self.capture}, axis {axis}: {shares}")
            if not phase.mask.any():
                continue
            what = "cells of Gray code" if phase.steps == 0 else "period"
            what += f" {phase.period_px:g} px"
            if phase.is_relative:
                what += f", known only modulo {phase.unambiguous_px:g} px"
            lines.append(
                f"  {what}: coordinates"
                f" {figures['coordinate_px'][0]:.1f}-{figures['coordinate_px'][1]:.1f} px,"
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
    valid = phase.mask
    shares = {
        REASON_LABELS[reason]: round(share, 6) for reason, share in reason_shares(phase).items()
    }
    figures: dict[str, Any] = {
        "period_px": phase.period_px,
        "steps": phase.steps,
        "unambiguous_px": phase.unambiguous_px if phase.is_relative else None,
        "shares": shares,
    }
    names = (
        "coordinate_px",
        "median_modulation",
        "median_background",
        "noise_levels",
        "median_sigma_px",
    )
    if not valid.any():
        return figures | dict.fromkeys(names)
    coordinate = phase.coordinate[valid]
    modulation, background, sigma = (
        float(np.median(each[valid]))
        for each in (phase.modulation, phase.background, phase.sigma_px)
    )
    a, b = phase.noise
    values = (
        [float(coordinate.min()), float(coordinate.max())],
        modulation,
        background,
        float(np.sqrt(a + b * background)),
        sigma,
    )
    return figures | dict(zip(names, values, strict=True))


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
    if file_format not in ("npy", "exr"):
        raise InputError(f"maps cannot be written as '{file_format}': use npy or exr")
    folder = Path(out)
    with opened(session) as store:
        progress(0.1, "decoding")
        _, _, phases = next(decode_captures(store, [capture], warn, relative=True))
    progress(0.6, "writing")
    folder.mkdir(parents=True, exist_ok=True)
    save = write_exr if file_format == "exr" else np.save
    files: dict[str, str] = {}
    for axis, phase in phases.items():
        maps = {
            "phase": phase.phase,
            "coordinate": phase.coordinate,
            "sigma": phase.sigma_px,
            "modulation": phase.modulation,
            "reason": phase.reason,
        }
        for name, values in maps.items():
            suffix = "png" if name == "reason" and file_format == "exr" else file_format
            files[f"{name}_{axis}"] = file = f"{name}_{axis}.{suffix}"
            if suffix == "png":
                (folder / file).write_bytes(cv2.imencode(".png", values)[1].tobytes())
            else:
                save(folder / file, values)
    files["picture"] = "decoded.png"
    (folder / "decoded.png").write_bytes(phase_maps(capture, phases).png)
    result = DecodedFiles(capture, phases, folder, files)
    (folder / "decoded.json").write_bytes(to_json(result.to_json()))
    progress(1.0, "decoded")
    return result
