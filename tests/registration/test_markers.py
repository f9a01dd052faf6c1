"""Coded markers hold what a plane, a sphere and a cylinder leave open."""

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
import pytest
from facts import missing_facts

from slviewer.errors import InputError
from slviewer.fringe.decode import texture
from slviewer.fringe.presets import p18
from slviewer.fringe.sequence import one_axis
from slviewer.geometry.rigid import move_points, rigid_transform
from slviewer.pipeline.capture_phases import decode_frames
from slviewer.reconstruction.cloud import Cloud
from slviewer.reconstruction.reconstruct import reconstruct_cloud
from slviewer.registration.markers import (
    MeasuredMarkers,
    fit_marker_pose,
    marker_notes,
    measure_markers,
)
from slviewer.registration.multiway import Starts, register_all
from slviewer.registration.refusal import Refused
from slviewer.simulation.boards import Pose
from slviewer.simulation.decals import MarkedScene, marked_plate
from slviewer.simulation.plans import rotation
from slviewer.simulation.renderer import Renderer
from slviewer.simulation.rig import letter
from slviewer.target.coded import detect_markers, draw_marker_sheet, marker_modules
from tests.marked_scenes import marked_cylinder, marked_sphere
from tests.perfect_model import PerfectModel

pytestmark = pytest.mark.computes

RIG = letter(0.5, 2)
TURNS = (((4.0, -6.0, 2.0), (0.0, 0.0, 620.0)), ((-5.0, 8.0, 16.0), (6.0, -4.0, 640.0)))


def pose(k: int, behind_mm: float = 0.0) -> Pose:
    turns, place = TURNS[k]
    return Pose(rotation(np.radians(turns)), np.array(place) + np.array([0, 0, behind_mm]))


def scan(scene: MarkedScene, seed: int) -> Cloud:
    sequence = one_axis(p18(RIG.projector.size), "x")
    frames = Renderer(RIG, scene).capture(sequence, seed)
    phases = decode_frames("scan", sequence, frames)
    return reconstruct_cloud(PerfectModel(RIG), phases, texture=texture(sequence, frames))


def true_motion(a: Pose, b: Pose) -> np.ndarray:
    return rigid_transform(a.R, a.t) @ np.linalg.inv(rigid_transform(b.R, b.t))


@pytest.fixture(scope="module")
def plates() -> dict[str, Cloud]:
    return {name: scan(marked_plate(pose(k)), k) for k, name in enumerate("ab")}


@pytest.fixture(scope="module")
def on_plates(plates) -> dict[str, MeasuredMarkers]:
    return {name: measure_markers(cloud) for name, cloud in plates.items()}


def largest_error(clouds: dict[str, Cloud], T: np.ndarray, true: np.ndarray) -> float:
    points = clouds["b"].measured[::50].astype(float)
    return float(np.linalg.norm(move_points(T, points) - move_points(true, points), axis=1).max())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("make", "behind_mm", "reason"),
    [
        (marked_sphere, 60.0, "sphere"),
        pytest.param(marked_cylinder, 0.0, "cylinder", marks=pytest.mark.slow),
    ],
)
def test_markers_register_shapes_that_hold_no_pose(
    make: Callable[[Pose], MarkedScene], behind_mm: float, reason: str
) -> None:
    poses = pose(0, behind_mm), pose(1, behind_mm)
    clouds = {name: scan(make(p), k) for k, (name, p) in enumerate(zip("ab", poses, strict=True))}
    with pytest.raises(Refused) as refused:
        register_all(clouds, "a")
    assert refused.value.reason == reason
    markers = {name: measure_markers(cloud) for name, cloud in clouds.items()}
    alignment = register_all(clouds, "a", Starts(markers=markers))
    error = largest_error(clouds, alignment.T_reference_scan["b"], true_motion(*poses))
    assert 0.0005 < error < 0.05
    assert 0.002 < alignment.uncertainties["b"].shift_mm < 0.05
    (registration,) = alignment.pairs.values()
    assert registration.start == "markers" and registration.overlap > 0.5


@pytest.mark.slow
def test_a_plane_and_its_corners(plates, on_plates) -> None:
    assert all(len(markers.ids) == 6 and not markers.repeated for markers in on_plates.values())
    alignment = register_all(plates, "a", Starts(markers=on_plates))
    true = true_motion(pose(0), pose(1))
    assert 0.0005 < largest_error(plates, alignment.T_reference_scan["b"], true) < 0.05
    gap = move_points(true, on_plates["b"].corners.reshape(-1, 3)) - on_plates["a"].corners.reshape(
        -1, 3
    )
    sigma = np.hypot(on_plates["a"].sigma_mm, on_plates["b"].sigma_mm).ravel()
    assert 0.2 < np.sqrt(np.mean(gap**2)) / np.sqrt(np.mean(sigma**2)) < 1.3, "what is predicted"


@pytest.mark.slow
def test_scans_that_do_not_overlap_are_joined_by_markers_alone(plates, on_plates) -> None:
    """Each shows one half of the plate's surface, both all of its markers."""
    halves = {}
    for name, cloud in plates.items():
        points = cloud.points.copy()
        middle = points.shape[1] // 2
        points[:, slice(middle, None) if name == "a" else slice(None, middle)] = np.nan
        halves[name] = replace(cloud, points=points)
    alignment = register_all(halves, "a", Starts(markers=on_plates))
    assert (
        0.0005
        < largest_error(plates, alignment.T_reference_scan["b"], true_motion(pose(0), pose(1)))
        < 0.1
    )


@pytest.mark.slow
def test_a_marker_that_was_moved_is_named_and_one_of_two_is_undecidable(on_plates) -> None:
    a, b = on_plates["a"], on_plates["b"]
    corners = b.corners.copy()
    corners[2] += np.array([0.6, 0.0, 0.0])
    moved = fit_marker_pose(replace(b, corners=corners), a)
    assert moved is not None and moved.moved == (2,) and moved.ids == (0, 1, 3, 4, 5)
    assert np.allclose(moved.T, true_motion(pose(0), pose(1)), atol=0.1)
    few = [
        replace(m, ids=m.ids[:2], corners=c[:2], sigma_mm=m.sigma_mm[:2])
        for m, c in ((a, a.corners), (b, corners))
    ]
    few[1].corners[1] += 5.0
    with pytest.raises(Refused):
        fit_marker_pose(few[1], few[0])
    apart = replace(a, ids=a.ids + 100)
    assert fit_marker_pose(b, apart) is None


def test_a_number_that_is_seen_twice_is_left_out_and_reported() -> None:
    page = np.full((400, 600), 230, np.uint8)
    for number, (x, y) in ((7, (60, 60)), (7, (300, 60)), (9, (60, 220)), (12, (300, 220))):
        tag = cv2.resize(marker_modules(number), (96, 96), interpolation=cv2.INTER_NEAREST)
        page[y : y + 96, x : x + 96] = np.clip(tag, 25, 230)
    seen = detect_markers(cv2.GaussianBlur(page, (0, 0), 1.0))
    assert seen.ids.tolist() == [9, 12] and seen.repeated == (7,)
    expected = np.array([[60, 220], [156, 220], [156, 316], [60, 316]]) - 0.5
    assert np.abs(seen.corners[0] - expected).max() < 0.05
    none = MeasuredMarkers(np.zeros(0, int), np.zeros((0, 4, 3)), np.zeros((0, 4)))
    notes = marker_notes({"one": replace(none, repeated=(7,)), "two": none})
    assert missing_facts(notes[0], 7, "one") == [] and len(notes) == 3


@pytest.mark.slow
def test_one_marker_alone_does_not_join_scans_without_overlap(plates, on_plates) -> None:
    one = {
        n: replace(m, ids=m.ids[:1], corners=m.corners[:1], sigma_mm=m.sigma_mm[:1])
        for n, m in on_plates.items()
    }
    halves = {}
    for name, cloud in plates.items():
        points = cloud.points.copy()
        points[:, slice(200, None) if name == "a" else slice(None, 600)] = np.nan
        halves[name] = replace(cloud, points=points)
    with pytest.raises(Refused):
        register_all(halves, "a", Starts(markers=one))


@pytest.mark.parametrize(
    ("notation", "count"), [("markers:0-23:20", 24), ("markers:100-102:40", 3), ("mat:16", None)]
)
def test_sheets_are_read_back(notation: str, count: int | None) -> None:
    drawing = draw_marker_sheet(notation)
    scale = 8.0
    page = np.full((int(drawing.height * scale), int(drawing.width * scale)), 255, np.uint8)
    for x, y, w, h in drawing.rectangles:
        a, b = (
            (np.array((x, y)) * scale).round().astype(int),
            (np.array((x + w, y + h)) * scale).round().astype(int),
        )
        page[a[1] : b[1], a[0] : b[0]] = 0
    seen = detect_markers(cv2.GaussianBlur(page, (0, 0), 1.0))
    assert not seen.repeated and seen.ids.tolist() == sorted(seen.ids)
    assert len(seen.ids) == count if count else len(seen.ids) > 20
    side = float(notation.rpartition(":")[2]) * scale
    assert np.allclose(np.linalg.norm(np.diff(seen.corners, axis=1), axis=2), side, atol=1.5)


@pytest.mark.parametrize(
    "notation",
    ["markers:5-2:20", "markers:0-600:20", "markers:0-99:50", "mat:100", "mat:x", "markers:"],
)
def test_sheets_that_are_impossible_are_refused(notation: str) -> None:
    with pytest.raises(InputError):
        draw_marker_sheet(notation)
