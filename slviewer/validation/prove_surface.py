"""How far fused scans and their mesh lie off the object that they show, on a simulated rig whose truth is known."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from slviewer.inspection.deviation import deviation
from slviewer.reconstruction.cloud import Cloud
from slviewer.surface.fuse import fuse
from slviewer.surface.meshing import BuiltMesh, MeshingPlan, build_mesh
from slviewer.surface.shapes import Mesh, PointSet
from slviewer.validation.prove_accuracy import BandCheck

OVER_SINGLE = 1.3
"""A fused surface's deviation over that of the best single scan, at most."""
MESH_MM = 0.08


@dataclass(frozen=True, eq=False)
class SurfaceProof:
    """RMS deviations from the true mesh, mm: of each ``single`` scan, of their ``fused`` surface, and of the vertices
    of the watertight mesh of a turn, ``turned_mm``; ``meshed`` says how that was made."""

    single_mm: Mapping[str, float]
    fused_mm: float
    turned_mm: float
    meshed: BuiltMesh

    @property
    def checks(self) -> tuple[BandCheck, ...]:
        """All that is demanded."""
        ratio = self.fused_mm / min(self.single_mm.values())
        return (
            BandCheck("three depths, fused", "RMS deviation over the best single scan's", ratio, 0.3, OVER_SINGLE),
            BandCheck("turn, mesh", "RMS deviation from the true mesh in mm", self.turned_mm, 0.005, MESH_MM),
            BandCheck("turn, mesh", "watertight", float(self.meshed.topology.watertight), 1.0, 1.0),
        )

    def text(self) -> str:
        """For people."""
        single = ", ".join(f"{name} {rms:.4f}" for name, rms in self.single_mm.items())
        return "\n".join([
            f"RMS deviation from the true surface in mm: {single}; fused {self.fused_mm:.4f}; the turn's mesh "
            f"{self.turned_mm:.4f}",
            self.meshed.text(),
        ])  # fmt: skip

    def to_json(self) -> dict[str, Any]:
        """Plain values."""
        return {
            "single_mm": dict(self.single_mm),
            "fused_mm": self.fused_mm,
            "turned_mm": self.turned_mm,
            "mesh": self.meshed.to_json(),
        }


def prove_surface(
    depths: Mapping[str, Cloud],
    lying: Mapping[str, np.ndarray],
    depths_true: tuple[Mesh, Mapping[str, np.ndarray]],
    turn: Mapping[str, Cloud],
    turned: Mapping[str, np.ndarray],
    turn_true: tuple[Mesh, np.ndarray],
) -> SurfaceProof:
    """Fuse scans at three depths and those of a turn where they were registered, and mesh the turn.

    ``lying`` and ``turned``: poses (4, 4) into the frame of the scan that each began with, as registered. The true
    meshes come with T_camera_object (4, 4): of each scan at three depths, and of the frame that the turn lies in.
    """
    nominal, poses = depths_true
    single = {
        name: _rms(fuse({name: cloud}, {name: np.eye(4)}).surface, nominal, poses[name])
        for name, cloud in depths.items()
    }
    reference = next(name for name, T in lying.items() if np.allclose(T, np.eye(4)))
    fused = _rms(fuse(depths, lying).surface, nominal, poses[reference])
    whole, at = turn_true
    meshed = build_mesh(fuse(turn, turned).surface, MeshingPlan(watertight=True))
    return SurfaceProof(single, fused, _rms(PointSet(meshed.mesh.vertices), whole, at), meshed)


def _rms(surface: PointSet, nominal: Mesh, T_camera_object: np.ndarray) -> float:
    """After a best fit that begins at the truth."""
    found = deviation(
        surface.points, nominal, normals=surface.normals, initial=np.linalg.inv(np.asarray(T_camera_object))
    )
    return found.statistics()["rms"]
