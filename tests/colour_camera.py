"""The simulated camera with colours: a reddish scene, of which it decodes green."""

import numpy as np

from slviewer.devices.protocols import Camera, CameraSettings, Rig, extract_channel


class ColouredCamera:
    """Any camera, as one that sees red and blue in fixed shares of its grey."""

    RED, BLUE = 0.8, 0.5

    def __init__(self, camera: Camera) -> None:
        self._camera = camera
        self.name, self.size, self.dtype = "the coloured camera", camera.size, camera.dtype

    def open(self) -> None:
        self._camera.open()

    def close(self) -> None:
        self._camera.close()

    def settings(self) -> CameraSettings:
        return self._camera.settings()

    def apply(self, settings: CameraSettings) -> CameraSettings:
        return self._camera.apply(settings)

    def grab(self, out: np.ndarray) -> None:
        extract_channel(self.grab_colour(), "green", out)

    def grab_colour(self) -> np.ndarray:
        width, height = self.size
        grey = np.empty((height, width), self.dtype)
        self._camera.grab(grey)
        return np.rint(grey[..., None] * [self.RED, 1.0, self.BLUE]).astype(self.dtype)


def coloured(rig: Rig) -> Rig:
    """`rig` with colours."""
    return Rig(rig.name, ColouredCamera(rig.camera), rig.projector, rig.settle_ms)
