"""The one pass where there is a CUDA device: `one_pass` decides, and without one it is the
processor's."""

from dataclasses import replace
from typing import TYPE_CHECKING, TypeGuard

import numpy as np

from slviewer.calibration.pixelwise import PixelwiseModel
from slviewer.calibration.splined.model import SplinedModel
from slviewer.calibration.stereo import StereoModel
from slviewer.fringe.decode import decode, texture
from slviewer.fringe.sequence import Axis, PatternSequence
from slviewer.geometry import cuda_device
from slviewer.geometry.rig import StereoRig
from slviewer.reconstruction import onepass_kernels as kernels
from slviewer.reconstruction.onepass import Fast, LightLevels, OnePass, PassResult

if TYPE_CHECKING:  # it imports CUDA
    from slviewer.reconstruction.onepass_cuda_card import Card

COMPARED = 3
"""Scans of each pass that the processor computes too, before the device's are used alone."""
AGREED = 1e-5
"""Distance between two points, of their depth, that rounding explains: float32 keeps 6e-8, and the
dozens of operations from frames to points lose two digits."""
MOST_APART = 1e-3
"""Share of pixels beyond that: those on the edge of a mask's limit, or between two periods."""


def one_pass(sequence: PatternSequence, model: Fast, axis: Axis) -> OnePass:
    """Return the fastest one-pass reconstruction available: on the CUDA device, or else on the
    processor.

    Raises InputError as `OnePass` does; so does a stereo calibration where there is no device, see
    `has_pass`.
    """
    kind = OnePass if cuda_device.find_device() is None else CudaPass
    return kind(sequence, model, axis)


def has_pass(model: object) -> TypeGuard[Fast]:
    """Whether `one_pass` measures with a calibration here: pixelwise and splined always, stereo on
    a CUDA device."""
    if isinstance(model, StereoModel):
        return cuda_device.find_device() is not None
    return isinstance(model, PixelwiseModel | SplinedModel)


class CudaPass(OnePass):
    """`OnePass` on a CUDA device, for stereo calibrations too; for one thread at a time.

    Coefficients stay on the device, frames go there once, and maps come back when spikes are
    repaired. Frames and scans in memory from `cuda_device.allocate_frames` travel at full speed.
    Should the device fail, or measure anything else than the processor in its first scans, the
    processor goes on.
    """

    _card: "Card | None" = None
    _compared = 0

    def _pack_depths(self) -> tuple[kernels.Depths | StereoRig, tuple[int, int]]:
        """Return the calibration as the kernels take it, and the size (h, w) of its frames."""
        if isinstance(self.model, StereoModel):
            width, height = self.model.rig.camera.size
            return self.model.rig, (height, width)
        return super()._pack_depths()

    def run(
        self, frames: np.ndarray, light: LightLevels | None = None, out: PassResult | None = None
    ) -> PassResult:
        """Return the scan of frames (n, h, w) uint8 or uint16, spikes repaired; see
        `OnePass.run`."""
        frames, scan = self._begun(frames, light, out)
        if cuda_device.find_device() is not None:
            try:
                scan = self._run_on_device(frames, scan)
                if self._compared < COMPARED:
                    check_agreement(scan, self._run_on_processor(frames, scan.light))
                    self._compared += 1
                return scan
            # of the driver, the compiler, or memory: whatever it is, there is a processor
            except Exception as error:
                cuda_device.disable_device(error)
        self._card = None
        return self._run_on_processor(frames, scan.light, scan)

    def card(self, dtype: np.dtype) -> "Card":
        """Return the buffers and kernels on the device for frames of a dtype, for use step by step;
        its errors are not caught."""
        if self._card is None or self._card.dtype != dtype:
            from slviewer.reconstruction.onepass_cuda_card import Card

            self._card = None  # its memory goes before the next one's is asked for
            self._card = Card(self, dtype)
        return self._card

    def _run_on_device(self, frames: np.ndarray, scan: PassResult) -> PassResult:
        """Compute a scan of frames (n, h, w) on the CUDA device; its errors are not caught."""
        card = self.card(frames.dtype)
        card.load(frames)
        card.sweep(scan.light)
        card.repair_spikes()
        if self.texture >= 0:  # the device has no use for it
            np.copyto(scan.texture, frames[self.texture])
        # a camera of more bits than it seemed
        if higher := self._raise_white(frames, scan, card.fetch(scan)):
            return self._run_on_device(frames, replace(scan, light=higher))
        return scan

    def _run_on_processor(
        self, frames: np.ndarray, light: LightLevels, out: PassResult | None = None
    ) -> PassResult:
        """Compute a scan on the processor: of a table in the arrays of ``out`` where given, of
        stereo, which has no kernels of one pass, stage by stage in new ones."""
        if not isinstance(self.model, StereoModel):
            return super().run(frames, light, out)
        decoded = decode(self.sequence, frames, self.axis)
        points = self.model.points(decoded)
        return PassResult(
            self.axis,
            self.model.name,
            points,
            decoded.phase,
            decoded.reason,
            sigma_z=self.model.sigma_z(decoded, points),
            modulation=decoded.modulation,
            texture=texture(self.sequence, frames),
            light=replace(light, noise=decoded.noise),
        )


def check_agreement(found: PassResult, expected: PassResult) -> None:
    """Raise ArithmeticError where a device's scan is not the processor's: more than MOST_APART of
    the pixels are masked otherwise, or lie farther apart than AGREED of their depth."""
    z = expected.points[..., 2]
    with np.errstate(invalid="ignore"):
        distance = np.abs(found.points - expected.points).max(axis=-1)
        is_apart = (found.reason != expected.reason) | (distance > AGREED * z)
    is_apart |= np.isnan(found.points[..., 2]) != np.isnan(z)
    if (share := is_apart.mean()) > MOST_APART:
        raise ArithmeticError(
            f"{share:.1%} of its pixels are not what the processor measures in the same frames"
        )
