"""A second camera beside the simulated rig: its lens, its place, and the scene as it sees it."""

from dataclasses import dataclass, replace

import numpy as np

from slviewer.fringe.sequence import PatternSequence
from slviewer.simulation.boards import BoardScene, Pose
from slviewer.simulation.decals import MarkedScene
from slviewer.simulation.mesh import MeshScene
from slviewer.simulation.renderer import Renderer
from slviewer.simulation.rig import SimulatedRig, read_preset, sample_arrangement, sample_device
from slviewer.simulation.scenes import Scene, Spheres


@dataclass(frozen=True, eq=False)
class SecondCamera:
    """A second camera: ``rig``, it with the same projector and light, and X_second = R X_first + t
    (mm)."""

    rig: SimulatedRig
    R: np.ndarray
    t: np.ndarray

    def pair(self, rig: SimulatedRig) -> SimulatedRig:
        """Return the first camera's ``rig`` with this camera in the projector's place, as it is
        calibrated."""
        return replace(rig, projector=self.rig.camera, R=self.R, t=self.t)

    def view(self, scene: Scene) -> Scene:
        """Return a scene of the first camera's frame in the second's."""
        pose = pose_of(scene)
        return move_scene(scene, Pose(self.R @ pose.R, self.R @ pose.t + self.t))

    def capture(self, scene: Scene, sequence: PatternSequence, seed: int = 0) -> np.ndarray:
        """(n, h, w) uint8: what it sees of a scene of the first camera's frame, as
        `Renderer.capture`."""
        return Renderer(self.rig, self.view(scene)).capture(sequence, seed)


def second_camera(rig: SimulatedRig) -> SecondCamera:
    """Return the second camera of a rig of `letter`, on the other side of its projector; its own
    lens, drawn by the rig's seed, and its own noise."""
    preset = read_preset()
    lens, place = np.random.SeedSequence([rig.seed, 0x52]).spawn(2)
    camera = replace(sample_device(lens, preset, "camera"), scale=rig.camera.scale)
    R, t = sample_arrangement(place, preset, "second_arrangement")
    to_projector = rig.R @ R.T
    seen = replace(
        rig, camera=camera, R=to_projector, t=rig.t - to_projector @ t, seed=rig.seed ^ 0x52000
    )
    return SecondCamera(seen, R, t)


def pose_of(scene: Scene) -> Pose:
    """Return T_camera_thing of a scene; identity rotation for a sphere."""
    if isinstance(scene, Spheres):
        return Pose(np.eye(3), scene.centres[0])
    assert isinstance(scene, BoardScene | MeshScene | MarkedScene)
    return scene.pose


def move_scene(scene: Scene, pose: Pose) -> Scene:
    """Return a scene moved to another pose; of a sphere only the centre moves."""
    if isinstance(scene, Spheres):
        return replace(scene, centres=pose.t[None].astype(float))
    if isinstance(scene, MarkedScene):
        return replace(scene, scene=move_scene(scene.scene, pose), pose=pose)
    assert isinstance(scene, BoardScene | MeshScene)
    return replace(scene, pose=pose)
