"""The truth of a simulated capture as plain values, for a file that only scoring reads."""

from typing import Any

from slviewer.errors import InputError
from slviewer.simulation.boards import BoardScene
from slviewer.simulation.lens import SimulatedLens
from slviewer.simulation.mesh import MeshScene
from slviewer.simulation.rig import SimulatedRig
from slviewer.simulation.scenes import Scene, Spheres


def rig_record(rig: SimulatedRig) -> dict[str, Any]:
    """JSON-able: both lenses (waves included), R and t with X_p = R X_c + t in mm, sensor, light
    and seed."""
    return {
        "camera": _lens_record(rig.camera),
        "projector": _lens_record(rig.projector),
        "R": rig.R.tolist(),
        "t": rig.t.tolist(),
        "sensor": vars(rig.sensor),
        "light": vars(rig.light),
        "seed": rig.seed,
    }


def scene_record(scene: Scene) -> dict[str, Any]:
    """JSON-able: the shape and its pose; mm, camera frame; poses as T_camera_board or
    T_camera_object (4, 4)."""
    if isinstance(scene, BoardScene):
        return {
            "shape": "plane",
            "board": str(scene.board) if scene.board else None,
            "T_camera_board": scene.pose.matrix.tolist(),
            **{name: getattr(scene.shape, name) for name in ("bow_x_mm", "bow_y_mm", "twist_mm")},
            "corner_mm": list(scene.corner),
            "plate_mm": list(scene.plate),
        }
    if isinstance(scene, Spheres):
        return {"shape": "sphere", "centres": scene.centres.tolist(), "radius_mm": scene.radius_mm}
    if isinstance(scene, MeshScene):
        return {"shape": "mesh", "T_camera_object": scene.pose.matrix.tolist()}
    raise InputError(
        f"a scene of type {type(scene).__name__} has no record", "use a board, spheres or a mesh"
    )


def _lens_record(lens: SimulatedLens) -> dict[str, Any]:
    """The lens at its own scale as K and D in OpenCV's order; the waves stay in px of the full
    resolution."""
    (fx, fy), (cx, cy), s = lens.focal_px, lens.centre_px, lens.scale
    return {
        "size": list(lens.size),
        "K": [
            [fx * s, 0.0, (cx + 0.5) * s - 0.5],
            [0.0, fy * s, (cy + 0.5) * s - 0.5],
            [0.0, 0.0, 1.0],
        ],
        "D": list(lens.brown),
        "scale": s,
        "waves": lens.waves.tolist(),
    }
