"""Images that the projector shows on a part: where their colours lie, what hides them, and when
they are refused."""

import shutil
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from facts import missing_facts
from trimesh.creation import box

import slviewer as sl
from slviewer.errors import InputError, UsageError
from slviewer.fringe.presets import p18
from slviewer.fringe.sequence import one_axis
from slviewer.operations.show_on_part import VERDICTS, projection_image, show_on_part
from slviewer.pipeline.edit import edit_scan
from slviewer.pipeline.inspect_parts import plan
from slviewer.pipeline.operation import load_arrays
from slviewer.pipeline.simulate import save_true_stereo
from slviewer.reconstruction.reconstruct import triangulate_grid
from slviewer.session.store import Session
from slviewer.simulation.boards import Pose, blank_board
from slviewer.simulation.mesh import MeshScene, demo_object
from slviewer.simulation.renderer import Renderer
from slviewer.simulation.rig import letter
from tests.proofs.shown_image import find_edges, list_parts, mark_half_space

pytestmark = pytest.mark.computes
PLACE = Pose(np.eye(3), np.array([0.0, 0.0, 520.0]))


def true_model(rig) -> SimpleNamespace:
    rays = rig.projector.rays()
    return SimpleNamespace(
        pinholes=SimpleNamespace(R=rig.R, t=rig.t), device_rays=(None, rays), residual_px=0.0
    )


@pytest.mark.parametrize("normal", [(1, 0, 0.1), (0.1, 1, 0), (-1, 1, 0.2)])
@pytest.mark.parametrize("part", ["relief r2", "staircase at 520 mm"])
def test_edges_of_colours_lie_within_a_fraction_of_a_pixel(part, normal) -> None:
    rig, scene = letter(0.3, 3), list_parts()[part]
    truth = Renderer(rig, scene).truth()
    points = np.where(truth.mask[..., None], truth.points, np.nan)
    measured = np.isfinite(points).all(axis=2)
    vertices, normal = points[measured], np.array(normal)
    offset = float(np.median(vertices @ normal))
    image = projection_image(
        true_model(rig), vertices, triangulate_grid(points), vertices,
        mark_half_space(normal, offset), gamma=rig.light.gamma,
    )  # fmt: skip
    observer = Renderer(letter(0.6, 3), scene)
    edges = find_edges(observer, image, observer.truth().points @ normal - offset, measured)
    off = np.abs(edges.off_px[edges.is_measured])
    assert len(off) > 300 and edges.is_measured.mean() > 0.85
    assert 0.001 < np.median(off) < 0.1
    assert np.quantile(off, 0.99) < 0.3


def test_a_rim_has_the_colours_of_its_own_surface_up_to_half_a_camera_pixel() -> None:
    rig, spread_px = letter(0.1, 1), 8.0
    centre = -rig.R.T @ rig.t
    # two plates one behind the other, seen from the projector; between grid points 8 px apart
    grid = np.stack(np.meshgrid(*(np.arange(400, 500, spread_px),) * 2), axis=-1)
    rays = np.dstack([true_model(rig).device_rays[1][tuple(grid.astype(int).T)], np.ones((13, 13))])
    near, far = (centre + (depth * rays.reshape(-1, 3)) @ rig.R for depth in (500.0, 560.0))
    keeps = grid.astype(int).T.reshape(2, -1)[1] < 450
    faces = triangulate_grid(rays * 500.0)
    own = faces[keeps[faces].all(axis=1)]
    vertices, faces = np.concatenate([near, far]), np.concatenate([own, faces + len(near)])
    colour = np.repeat([[255.0, 0, 0], [0, 255, 0]], len(near), axis=0)
    image = projection_image(
        true_model(rig), vertices, faces, colour, lambda values: values, gamma=1.0,
        spread_px=spread_px,
    )  # fmt: skip
    last = grid[..., 0][grid[..., 0] < 450].max()
    red, green = image[420:480, 410:490, 0] / 255.0, image[420:480, 410:490, 1] / 255.0
    rims = 409.5 + red.sum(axis=1)
    assert np.abs(rims - (last + spread_px / 2)).max() < 0.5
    assert np.allclose(red + green, 1, atol=0.02)


def test_what_the_projector_cannot_see_is_dark() -> None:
    rig = letter(0.1, 1)
    centre = -rig.R.T @ rig.t
    near = np.array([[x, y, 500.0] for x in (-30, 30) for y in (-30, 30)])
    # the far square is in the shadow of the near one, except for its rim
    far = centre + (near * [0.8, 0.8, 1] - centre) * 1.2
    vertices = np.concatenate([near, far])
    faces = np.array([[0, 1, 2], [1, 3, 2], [4, 5, 6], [5, 7, 6]])
    colour = np.repeat([[255.0, 0, 0], [0, 255, 0]], 4, axis=0)
    image = projection_image(true_model(rig), vertices, faces, colour, lambda values: values)
    assert (image[..., 0] > 200).sum() > 1000
    assert (image[..., 1] > 20).sum() < 0.02 * (image[..., 0] > 200).sum()


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> tuple[Path, np.ndarray]:
    """A session whose imported calibration is the truth, with scans of a relief and of a block, and
    what the camera sees of the relief in white light."""
    folder = tmp_path_factory.mktemp("shown") / "session"
    rig = letter(0.2, seed=2, local_distortion_px=0)
    sequence = one_axis(p18(rig.projector.size), "x")
    block = box((70, 50, 30))
    scenes = {"object": demo_object(PLACE), "block": MeshScene(block.vertices, block.faces, PLACE)}
    with Session.create(folder) as store:
        save_true_stereo(store, rig)
        for i, (name, scene) in enumerate(scenes.items()):
            frames = Renderer(rig, scene).capture(sequence, i)
            store.save_capture(name, "scan", sequence, frames, source="simulated")
            if name == "object":
                white = frames[[f.kind for f in sequence.frames].index("texture")]
    return folder, white


@pytest.fixture
def folder(made, tmp_path) -> Path:
    shutil.copytree(made[0], tmp_path / "session", symlinks=True)
    return tmp_path / "session"


def test_a_measured_region_and_its_value_are_shown(folder, tmp_path) -> None:
    centre = sl.reconstruct(folder, "object").only and [0.0, 0.0, 505.0]
    sl.measure(folder, "object", "sphere", ball=[*centre, 25.0], name="crown")
    found = show_on_part(folder, "object", of="measure", out=tmp_path / "shown.png")
    record, image = found.only, cv2.imread(str(tmp_path / "shown.png"))
    assert image.shape == (1140, 912, 3)
    assert np.array_equal(load_arrays(folder, "part-image/1")["image"], image[..., ::-1])
    assert 0.001 < record.illuminated_share < 0.2
    assert record.illuminated_share < (image > 0).any(axis=2).mean() + 1e-9
    assert 0.01 < record.position_sigma_px < 1.0 and 0.1 < record.pixel_mm < 1.0
    assert missing_facts(found.text(), "object", "measure", "px") == []


def test_a_comparison_is_shown_in_its_colours(folder, tmp_path) -> None:
    larger = tmp_path / "part.stl"
    box((70, 50, 29.0)).export(larger)
    sl.compare(folder, "block", larger, tolerance=0.2)
    with pytest.raises(InputError, match="has not been compared"):
        show_on_part(folder, "object")
    shown = show_on_part(folder, "block", of="verdict").only
    assert 0.01 < shown.illuminated_share < 0.5
    sl.compare(folder, "block", larger)
    with pytest.raises(InputError, match="no tolerance"):
        show_on_part(folder, "block", of="verdict")
    box((70, 50, 28.0)).export(larger)
    with pytest.raises(InputError, match="has changed since"):
        show_on_part(folder, "block")


def test_what_was_not_measured_is_outlined(folder, tmp_path) -> None:
    nominal = tmp_path / "part.stl"
    box((70, 50, 30)).export(nominal)
    with pytest.raises(InputError, match="has not been compared"):
        show_on_part(folder, "block", of="missing")
    rig = letter(0.2, seed=2, local_distortion_px=0)
    corners = np.array([[x, y, 505.0] for x, y in ((-15, -10), (15, -10), (15, 10), (-15, 10))])
    edit_scan(folder, "block", polygon=rig.camera.project(corners).ravel().tolist())
    sl.compare(folder, "block", nominal)
    show_on_part(folder, "block", of="missing", out=tmp_path / "shown.png")
    is_lit = cv2.imread(str(tmp_path / "shown.png")).any(axis=2)
    square = np.zeros_like(is_lit, np.uint8)
    cv2.fillConvexPoly(square, np.rint(rig.project(corners)).astype(np.int32), 1)
    # what is near a point counts as measured: about two of the camera's pixels, 1.5 mm wide here
    inside, around = (
        op(square, np.ones((41, 41), np.uint8)).astype(bool) for op in (cv2.erode, cv2.dilate)
    )
    assert not is_lit[inside].any()
    border = around & ~inside
    columns = np.unique(np.nonzero(is_lit & border)[1])
    width = np.ptp(np.nonzero(square)[1])
    assert 0.4 * width < len(columns) < 1.2 * width  # dashes, all round
    assert is_lit[border].sum() > 0.02 * border.sum()


@pytest.mark.parametrize(
    ("limits", "decision"),
    [
        ("upper = 2.0", "pass"),
        ("upper = 0.001", "undecided"),
        ("lower = 1.0\nupper = 2.0", "fail"),  # too flat
    ],
)
def test_features_of_a_plan_are_shown_as_they_were_decided(
    folder, tmp_path, limits, decision
) -> None:
    path, out = tmp_path / "plan.toml", tmp_path / "shown.png"
    with pytest.raises(InputError, match="not been inspected"):
        show_on_part(folder, "block", of="plan")
    sl.measure(folder, "block", "plane", ball=[0.0, 0.0, 505.0, 15.0], name="top")
    plan(folder, out=path, tolerance=2.0)
    assert path.read_text().count("upper = 2.0") == 1
    path.write_text(path.read_text().replace("upper = 2.0", limits))
    assert sl.run_plan(folder, path, ["block"]).only.parts[0].decision == decision
    show_on_part(folder, "block", of="plan", out=out)
    image = cv2.imread(str(out))[..., ::-1].astype(int)
    is_lit = image.max(axis=2) > 40
    has_colour = is_lit & (np.ptp(image, axis=2) > 40)
    assert np.abs(np.median(image[has_colour], axis=0) - VERDICTS[decision]).max() < 3
    assert 0.005 < has_colour.mean() < 0.1
    assert (image > 250).all(axis=2).sum() > 100  # its name and value
    path.write_text(path.read_text().replace("upper = ", "upper = 1"))
    with pytest.raises(InputError, match="has changed since"):
        show_on_part(folder, "block", of="plan")


@pytest.mark.parametrize(
    ("moved_px", "message"), [(0.0, ""), (0.2, ""), (1.5, "moved by 1.. camera"), (80.0, "not")]
)
def test_a_part_that_has_moved_is_refused(made, folder, tmp_path, moved_px, message) -> None:
    sl.measure(folder, "object", "sphere", ball=[0.0, 0.0, 505.0, 25.0])
    _, white = made
    M = np.array([[1.0, 0, moved_px], [0, 1, 0]])
    now = cv2.warpAffine(white, M, white.shape[::-1], flags=cv2.INTER_CUBIC)
    cv2.imwrite(str(tmp_path / "now.png"), np.rint(0.8 * now + 5).astype(np.uint8))
    if not message:
        found = show_on_part(folder, "object", of="measure", frame=tmp_path / "now.png")
        assert found.only.moved_px == pytest.approx(moved_px, abs=0.12)
        return
    with pytest.raises(InputError, match=message):
        show_on_part(folder, "object", of="measure", frame=tmp_path / "now.png")


def test_what_cannot_be_shown_is_refused(folder, tmp_path) -> None:
    with pytest.raises(InputError, match="nothing was measured"):
        show_on_part(folder, "object", of="measure")
    with pytest.raises(UsageError, match="give the scan"):
        show_on_part(folder, "merge/1")
    with pytest.raises(UsageError, match="end its name"):
        show_on_part(folder, "object", out=tmp_path / "shown.jpg")
    small = tmp_path / "small.png"
    cv2.imwrite(str(small), np.zeros((20, 30), np.uint8))
    sl.measure(folder, "object", "sphere", ball=[0.0, 0.0, 505.0, 25.0])
    with pytest.raises(InputError, match="30x20 px"):
        show_on_part(folder, "object", of="measure", frame=small)


def test_a_blank_plate_shows_no_motion_and_says_so(made, folder, caplog) -> None:
    rig = letter(0.2, seed=2, local_distortion_px=0)
    sequence = one_axis(p18(rig.projector.size), "x")
    frames = Renderer(rig, blank_board(PLACE, (600, 500))).capture(sequence, 3)
    with Session.open(folder, write=True) as store:
        store.save_capture("plate", "scan", sequence, frames, source="simulated")
    sl.measure(folder, "plate", "plane", ball=[0.0, 0.0, 520.0, 40.0])
    now = folder.parent / "now.png"
    cv2.imwrite(str(now), frames[[f.kind for f in sequence.frames].index("texture")])
    warned: list[str] = []
    settings = show_on_part.settings("plate", "measure", now)
    found = show_on_part.run(folder, settings, warn=warned.append)
    assert found.only.moved_px is None
    assert any("no structure" in each for each in warned)
