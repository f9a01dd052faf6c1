"""Camera and projector in the 3D view: nominal before the calibration, as calibrated after it."""

import numpy as np

from slviewer.calibration.next_pose import nominal_lens
from slviewer.gui.scene import CAMERA, PROJECTOR, Scene
from slviewer.wizard.snapshot import CalibrationView, Snapshot

LAYER = "devices"


class Devices:
    """Keeps their pyramids up to date."""

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self._drawn: tuple[CalibrationView | None, tuple[int, int] | None] = (None, None)

    def draw(self, snapshot: Snapshot) -> None:
        """Show the devices of this snapshot."""
        calibration = snapshot.session.calibration if snapshot.session else None
        camera, projector = snapshot.rig.camera, snapshot.rig.projector
        if (calibration, camera) == self._drawn:
            return
        self._drawn = (calibration, camera)
        self._scene.clear(LAYER)
        if camera is not None:
            K = nominal_lens(camera).K if calibration is None else calibration.K_camera
            self._scene.device(LAYER, "camera", K, camera, np.eye(4), CAMERA)
        if projector is not None and calibration is not None:
            T = np.eye(4)  # T_camera_projector: the inverse of X_p = R X_c + t
            T[:3, :3], T[:3, 3] = calibration.R.T, -calibration.R.T @ calibration.t
            self._scene.device(LAYER, "projector", calibration.K_projector, projector, T, PROJECTOR)
