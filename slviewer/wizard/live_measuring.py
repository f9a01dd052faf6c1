"""From the frames of a short sequence to the points that can be believed."""

from dataclasses import dataclass, field, replace

import numpy as np

from slviewer.fringe.decode import decode
from slviewer.fringe.sequence import Axis, PatternSequence
from slviewer.geometry.rig import StereoRig
from slviewer.reconstruction.axis_agreement import check_sizes
from slviewer.reconstruction.onepass import OnePass, Scan
from slviewer.reconstruction.onepass_cuda import has_pass, one_pass
from slviewer.reconstruction.reconstruct import Model
from slviewer.wizard.live_motion import hide_moved


@dataclass(eq=False)
class Measuring:
    """A short sequence, a calibration, and the scale that was applied to it; ``calibrated``: the rig whose sizes the
    frames must have. For one thread at a time."""

    sequence: PatternSequence
    axis: Axis
    model: Model
    factor: float = 1.0
    calibrated: StereoRig | None = None
    _fast: OnePass | None = field(init=False, repr=False, default=None)
    _before: Scan | None = field(init=False, repr=False, default=None)

    def __post_init__(self) -> None:
        if has_pass(self.model):
            self._fast = one_pass(self.sequence, self.model, self.axis)

    def cloud(self, frames: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(points (h, w, 3) float32 mm, texture (h, w)) of the frames (n, h, w); both are new arrays.

        As `reconstruct` has them, but that what moved between the frames is NaN too. Raises InputError for frames that
        are not those of the sequence, or of another camera.
        """
        if self.calibrated is not None:
            height, width = frames.shape[1:]
            check_sizes("the live scan", (width, height), self.sequence.projector_size, self.calibrated)
        if self._fast is not None:
            scan = self._fast.run(frames, out=self._room())
            self._before, points = scan, scan.points
            phase, modulation, noise = scan.phase, scan.modulation, scan.light.noise
        else:
            decoded = decode(self.sequence, frames, self.axis)
            points = self.model.points(decoded)
            phase, modulation, noise = decoded.phase, decoded.modulation, decoded.noise
        hide_moved(self.sequence, frames, self.axis, phase, modulation, noise, points)
        if self.factor != 1.0:
            points *= np.float32(self.factor)
        return points, frames[-1].copy()

    def _room(self) -> Scan | None:
        """The arrays of the scan before, but its points, which somebody may be drawing."""
        before = self._before
        return None if before is None else replace(before, points=np.empty_like(before.points))
