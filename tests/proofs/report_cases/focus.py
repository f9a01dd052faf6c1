"""A rig that changed after its calibration."""

from dataclasses import dataclass, replace

import numpy as np

from slviewer.pipeline.accept import check
from slviewer.pipeline.measure import measure
from slviewer.pipeline.reconstruct import ReconstructSettings, reconstruct, verify
from slviewer.pipeline.simulate import TARGET
from slviewer.records.measurement import Measurement
from slviewer.session.store import Session
from slviewer.simulation.mesh import MeshScene
from slviewer.simulation.plans import letter_plan, pose_at, rotation
from slviewer.simulation.rig import SimulatedRig, letter
from slviewer.simulation.scenes import Rays, Scene, Spheres, Surface, directions_of
from slviewer.target.board import Board
from tests.marked_scenes import cylinder_mesh
from tests.proofs.report_cases.case import BASE_SCALE, Case, Outcome, Workplace

DIAMETER_MM, RADIUS_MM = 196.0, 40.0
"""Of the sphere of the plan, and of a cylinder."""
CENTRE = (14.0, 6.0, 640.0)
SOUND_U_MM = 0.05
"""Largest U of the sphere's diameter by a rig that did not change."""
_RIG = letter(BASE_SCALE)


def _refocus(device: str, share: float) -> SimulatedRig:
    """Return the rig with the focal length of its camera or projector changed by a share."""
    lens = getattr(_RIG, device)
    fx, fy = lens.focal_px
    return replace(_RIG, **{device: replace(lens, focal_px=(fx * (1 + share), fy * (1 + share)))})


@dataclass(frozen=True, eq=False)
class LobedSphere(Spheres):
    """Spheres with three lobes of ``form_mm`` about the viewing direction."""

    form_mm: float = 0.1

    def trace(self, rays: Rays) -> Surface:
        """The intersections with spheres of each pixel's own radius."""
        surface, centre = super().trace(rays), self.centres[0]
        directions = directions_of(rays)
        squared = (directions**2).sum(-1)
        along = directions @ centre / squared
        for _ in range(4):
            x, y, _ = np.moveaxis((surface.points - centre) / self.radius_mm, -1, 0)
            radius = self.radius_mm + self.form_mm * (x**3 - 3 * x * y**2)
            with np.errstate(invalid="ignore"):
                z = along - np.sqrt(along**2 - (centre @ centre - radius**2) / squared)
            surface.points[...] = directions * z[..., None]
        return surface


TURNED = replace(_RIG, R=_RIG.R @ rotation(np.array([0.0, -1e-3, 0.0])))
SPHERE = Spheres(np.array([CENTRE]), DIAMETER_MM / 2)
LOBED = LobedSphere(np.array([CENTRE]), DIAMETER_MM / 2)


def _describe(measured: Measurement, name: str, true_mm: float) -> tuple[str, bool, bool]:
    """Return value, U and findings in words, whether U covers the truth, and whether a finding is
    about the calibration."""
    quantity, found = measured[name], " ".join(measured.warnings)
    assert quantity.U is not None
    is_doubted = "calibration" in found
    text = f"{quantity.format()}, {'calibration or form doubted' if is_doubted else 'no finding'}"
    return text, abs(quantity.value - true_mm) <= quantity.U, is_doubted


def _measure_sphere(
    rig: SimulatedRig, axes: str, changed: bool = True, scene: Scene = SPHERE
) -> Case:
    """Return the case of a sphere that is measured with the splined model."""

    def case(place: Workplace) -> Outcome:
        session = place.capture(rig, {"shot": scene}, 77, axes)
        ball = (*CENTRE, DIAMETER_MM / 2 + 3)
        measured = measure(session, "shot", "sphere", ball=ball, model="splined").only
        text, covers, doubted = _describe(measured, "diameter", DIAMETER_MM)
        U = measured["diameter"].U or 0.0
        holds = covers and doubted == changed and (changed or U < SOUND_U_MM)
        return Outcome(text, f"{DIAMETER_MM:g} mm within U", holds)

    return case


def _measure_cylinder(place: Workplace) -> Outcome:
    cylinder = MeshScene(*cylinder_mesh(RADIUS_MM, 120.0), pose_at((0, 0, 0), CENTRE))
    session = place.capture(_refocus("camera", 5e-3), {"shot": cylinder}, 77)
    ball = (*CENTRE[:2], CENTRE[2] - RADIUS_MM, 50.0)
    measured = measure(session, "shot", "cylinder", ball=ball, model="splined").only
    text, covers, doubted = _describe(measured, "diameter", 2 * RADIUS_MM)
    return Outcome(text, f"{2 * RADIUS_MM:g} mm within U", covers and doubted)


def _verify_plane(place: Workplace) -> Outcome:
    plane = letter_plan(_RIG, poses=3)["plane_04"]
    session = place.capture(_refocus("projector", 5e-3), {"shot": plane}, 77)
    verified = verify(session, ["shot"], "plane").only
    text = verified.warnings[0] if verified.warnings else "no finding"
    return Outcome(text, "a flat plane, and a finding", "calibration" in text)


def _check_board(place: Workplace) -> Outcome:
    """Follow the remedy: check the calibration with a new pose of its board."""
    board = letter_plan(_RIG, poses=9)["pose_05"]
    session = place.capture(_refocus("camera", 5e-3), {"shot": board}, 77, "xy", "calibration")
    found = check(session, "shot").only
    return Outcome(found.verdict, "no longer good", not found.is_good)


def _report_focus(place: Workplace) -> Outcome:
    """A camera that reports its focus, which was changed since the calibration."""
    session, warnings = place.base(), list[str]()
    with Session.open(session, write=True) as store:
        first, *_ = poses = store.captures("calibration")
        for pose in poses:
            details = {"board": Board.parse(TARGET), "settings": {"lens": {"focus": 40.0}}}
            store.save_capture(
                pose.name, "calibration", pose.sequence, pose.frames, force=True, **details
            )
        moved = {"lens": {"focus": 46.0}}
        store.save_capture("shot", "scan", first.sequence, first.frames, settings=moved)
    reconstruct.run(session, ReconstructSettings("shot", check=False), warn=warnings.append)
    text = next((each for each in warnings if "focus" in each), "no finding")
    return Outcome(text, "a warning of 46 instead of 40", "46" in text and "40" in text)


CASES: dict[str, Case] = {
    "camera refocused by 0.5 %, one axis": _measure_sphere(_refocus("camera", 5e-3), "x"),
    "camera refocused by 0.5 %, both axes": _measure_sphere(_refocus("camera", 5e-3), "xy"),
    "camera refocused by -0.3 %, one axis": _measure_sphere(_refocus("camera", -3e-3), "x"),
    "projector refocused by 0.5 %, one axis": _measure_sphere(_refocus("projector", 5e-3), "x"),
    "camera turned by 1 mrad, both axes": _measure_sphere(TURNED, "xy"),
    "camera turned by 1 mrad, one axis": _measure_sphere(TURNED, "x"),
    "rig as it was calibrated, one axis": _measure_sphere(_RIG, "x", changed=False),
    "rig as it was calibrated, both axes": _measure_sphere(_RIG, "xy", changed=False),
    "sphere with 0.1 mm of form": _measure_sphere(_RIG, "x", scene=LOBED),
    "cylinder by a camera refocused by 0.5 %": _measure_cylinder,
    "plane by a projector refocused by 0.5 %": _verify_plane,
    "board by a camera refocused by 0.5 %": _check_board,
    "camera that reports another focus": _report_focus,
}
