"""Registering scans taken at different depths, and merging them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from slviewer.errors import UsageError
from slviewer.reconstruction.cloud import Cloud
from slviewer.registration.merge import Merged
from slviewer.registration.merge import merge as merge_clouds
from slviewer.session.ply import write_ply
from slviewer.workflow.decoding import capture_texture, decoded
from slviewer.workflow.feedback import Progress, Warn, part, unheard, unwarned
from slviewer.workflow.models import check_accepted, load_model, preferred, warn_if_stale
from slviewer.workflow.opening import SessionLike, opened
from slviewer.workflow.scaling import corrected_cloud, told_scale
from slviewer.workflow.trust import told


@dataclass(frozen=True)
class Merge:
    """A merged cloud, how its scans were registered, and the file it went to. ``scale`` says, in words, what correction
    of scale is in it."""

    merged: Merged
    clouds: Mapping[str, Cloud]
    reference: str
    out: Path
    scale: str = ""

    def to_json(self) -> dict[str, Any]:
        """The contract of ``merge --json``."""
        return {
            "reference": self.reference,
            "pairs": {
                name: {
                    "rms_mm": pair.rms_mm,
                    "overlap": pair.overlap,
                    "T_reference_scan": pair.T_reference_scan.tolist(),
                }
                for name, pair in self.merged.pairs.items()
            },
        }

    def text(self) -> str:
        """For people."""
        lines = [
            f"{name} -> {self.reference}: RMS {pair.rms_mm:.3f} mm, overlap {100 * pair.overlap:.0f} %"
            for name, pair in self.merged.pairs.items()
        ]
        if self.scale:
            lines.append(self.scale)
        return "\n".join([*lines, f"{len(self.merged.points)} points -> {self.out}"])


def merge(
    session: SessionLike,
    captures: Sequence[str],
    reference: str,
    out: Path | str,
    *,
    model: str | None = None,
    accept_rejected: bool = False,
    progress: Progress = unheard,
    warn: Warn = unwarned,
) -> Merge:
    """Reconstruct scans, register each to ``reference`` by point-to-plane ICP, and write them as one PLY."""
    names = list(dict.fromkeys([*captures, reference]))
    if len(names) < 2:
        raise UsageError(f"only {reference} was named: name the scans to merge with it")
    with opened(session) as store:
        check_accepted(store, accept_rejected)
        fitted = load_model(store, model or preferred(store))
        warn_if_stale(store, warn)
        scale, clouds = told_scale(store, fitted.name), {}
        for i, (shot, frames, phases) in enumerate(decoded(store, names)):
            for sentence in told(store, shot.name, frames):
                warn(f"{shot.name}: {sentence}")
            progress(0.5 * i / len(names), f"reconstructing {shot.name}")
            clouds[shot.name] = corrected_cloud(store, fitted, phases, texture=capture_texture(shot, frames))
    registering = part(progress, 0.5, 0.9)
    merged = merge_clouds(clouds, reference, lambda done: registering(done, "registering"))
    progress(0.9, "writing")
    Path(out).parent.mkdir(parents=True, exist_ok=True)
    each = [cloud.sigmas(cloud.mask) for cloud in (clouds[name] for name in merged.names)]
    scalars = {what: np.concatenate([sigmas[what] for sigmas in each]) for what in each[0]}
    write_ply(Path(out), merged.points, colours=merged.colours, normals=merged.normals, scalars=scalars)
    progress(1.0, "merged")
    return Merge(merged, clouds, reference, Path(out), scale)
