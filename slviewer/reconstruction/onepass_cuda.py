"""The one pass where there is a CUDA device: `one_pass` decides, and without one it is the
processor's."""

from dataclasses import replace
from typing import TYPE_CHECKING, Any, TypeGuard

import numpy as np

from slviewer.calibration.pixelwise import PixelwiseModel
from slviewer.calibration.splined.model import SplinedModel
from slviewer.calibration.stereo import StereoModel
from slviewer.errors import InputError
from slviewer.fringe.decode import decode, pack_levels, texture
from slviewer.fringe.layout import clip_level
from slviewer.fringe.sequence import Axis, PatternSequence
from slviewer.geometry import cuda_device
from slviewer.reconstruction.onepass import (
    LightLevels,
    OnePass,
    PassResult,
    PassTask,
    one_pass_layout,
    texture_frame,
)

if TYPE_CHECKING:  # it imports CUDA
    from slviewer.reconstruction.onepass_cuda_card import Card

Fast = PixelwiseModel | SplinedModel | StereoModel


def one_pass(sequence: PatternSequence, model: Fast, axis: Axis) -> OnePass:
    """Return the fastest one-pass reconstruction available: on the CUDA device, or else on the
    processor.

    Raises InputError as `OnePass` does; so does a stereo calibration where there is no device, see
    `has_pass`.
    """
    if cuda_device.find_device() is not None:
        return CudaPass(sequence, model, axis)  # type: ignore[arg-type]
    return OnePass(sequence, model, axis)  # type: ignore[arg-type]


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
    Should the device fail, the processor goes on.
    """

    def __init__(self, sequence: PatternSequence, model: Fast, axis: Axis) -> None:
        self._card: Card | None = None
        if isinstance(model, StereoModel):
            self.sequence, self.model, self.axis = sequence, model, axis  # type: ignore[assignment]
            self._layout = one_pass_layout(self.sequence, self.axis)
            if self.axis not in self.model.axes:
                raise InputError(
                    f"The stereo calibration has no axis {self.axis}: choose another axis."
                )
            self._texture, self._ladder = texture_frame(self.sequence), pack_levels(self._layout)
        else:
            super().__init__(sequence, model, axis)

    def _empty(self, shape: tuple[int, ...], dtype: Any) -> np.ndarray:
        """Return an uninitialised array in page-locked memory, for fast transfers."""
        return cuda_device.allocate_frames(shape, dtype)

    @property
    def shape(self) -> tuple[int, int]:
        """(h, w) of the frames that the calibration belongs to."""
        if isinstance(self.model, StereoModel):
            width, height = self.model.rig.camera.size
            return height, width
        return super().shape

    def run(
        self, frames: np.ndarray, light: LightLevels | None = None, out: PassResult | None = None
    ) -> PassResult:
        """Return the scan of frames (n, h, w) uint8 or uint16, spikes repaired; see
        `OnePass.run`."""
        return self._scan(frames, light, out, True)

    def sweep(
        self, frames: np.ndarray, light: LightLevels | None = None, out: PassResult | None = None
    ) -> PassResult:
        """Return the scan of frames (n, h, w) after the first pass, without spike repair; see
        `OnePass.sweep`."""
        return self._scan(frames, light, out, False)

    def repair_spikes(self, scan: PassResult) -> None:
        """Repair the spikes of a scan from `sweep` in place; InputError for a stereo
        calibration."""
        if isinstance(self.model, StereoModel):
            raise InputError(
                "a stereo calibration's spikes are repaired where they are found: use run, not"
                " sweep"
            )
        super().repair_spikes(scan)

    def card(self, dtype: np.dtype) -> "Card":
        """Return the buffers and kernels on the device for frames of a dtype, for use step by step;
        its errors are not caught."""
        if self._card is None or self._card.dtype != dtype:
            from slviewer.reconstruction.onepass_cuda_card import Card

            self._card = None  # its memory goes before the next one's is asked for
            self._card = Card(self._job(), dtype)
        return self._card

    def _scan(
        self, frames: np.ndarray, light: LightLevels | None, out: PassResult | None, repaired: bool
    ) -> PassResult:
        """Compute a scan on the CUDA device, or on the processor where there is no device or it
        fails."""
        frames, scan = self._begun(frames, light, out)
        if cuda_device.find_device() is not None:
            try:
                return self._scan_on_device(frames, scan, repaired)
            except (
                Exception
                # of the driver, the compiler, or memory: whatever it is, there is a processor
            ) as error:
                cuda_device.disable_device(error)
        self._card = None
        if isinstance(self.model, StereoModel):
            return self._scan_on_processor(frames, scan)
        return (
            super().run(frames, scan.light, scan)
            if repaired
            else super().sweep(frames, scan.light, scan)
        )

    def _scan_on_device(self, frames: np.ndarray, scan: PassResult, repaired: bool) -> PassResult:
        """Compute a scan of frames (n, h, w) on the CUDA device; its errors are not caught."""
        card = self.card(frames.dtype)
        card.load(frames)
        card.sweep(scan.light)
        if repaired:
            card.repair_spikes()
        if self._texture >= 0:  # the device has no use for it
            np.copyto(scan.texture, frames[self._texture])
        highest = card.fetch(scan)
        # a camera of more bits than it seemed
        if clip_level(frames.dtype, highest, self.sequence.full_scale) > scan.light.white:
            return self._scan_on_device(frames, replace(scan, light=self.light(frames)), repaired)
        return scan

    def _job(self) -> PassTask:
        """Return the description of the work from which the device's kernels are compiled."""
        depths = self.model.rig if isinstance(self.model, StereoModel) else self._depths
        frames = tuple(self.sequence.select(self.axis))
        return PassTask(
            self.shape, self.axis, self._layout, frames, self._ladder, depths, self._texture < 0
        )

    def _scan_on_processor(self, frames: np.ndarray, scan: PassResult) -> PassResult:
        """Compute a stereo calibration's scan on the processor."""
        assert isinstance(self.model, StereoModel)
        decoded = decode(self.sequence, frames, self.axis)
        points = self.model.points(decoded)
        sigma = self.model.sigma_z(decoded, points)
        light = LightLevels(decoded.noise, scan.light.mean, scan.light.white)
        return PassResult(
            self.axis, self.model.name, points, decoded.phase, decoded.reason, sigma,
            decoded.modulation,
            texture(self.sequence, frames), light,
        )  # fmt: skip
