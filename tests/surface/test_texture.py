"""Textures: what the scans show comes to its place, without shading, gains, seams or what is
hidden."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from ball_scans import RADIUS, SIDES, ball, looking_from
from facts import raises

from slviewer.errors import InputError
from slviewer.geometry.rigid import move_points
from slviewer.reconstruction.cloud import Cloud
from slviewer.registration.open3d_loader import open3d
from slviewer.session.shape_files import write_textured
from slviewer.surface.shapes import Mesh
from slviewer.surface.texture import TexturedMesh, texture_mesh

pytestmark = pytest.mark.computes

LIGHT = np.array([120.0, 10.0, -5.0])
AWAY = 300.0


def albedo(points: np.ndarray) -> np.ndarray:
    """Reflectance of places on the ball: waves 15 mm long, and one half darker."""
    return (
        0.5
        + 0.2 * np.sin(points[..., 0] / 2.4) * np.cos(points[..., 1] / 2.4)
        + 0.15 * np.sign(points[..., 2])
    )


def painted(name: str, gain: float) -> Cloud:
    """A scan of the painted ball, lit from beside the camera."""
    cloud = ball(AWAY, 0.02, 1, size=(200, 150))
    places = move_points(looking_from(SIDES[name], AWAY), cloud.points.reshape(-1, 3)).reshape(
        cloud.points.shape
    )
    normals = (cloud.points - [0, 0, AWAY]) / RADIUS
    to_light = LIGHT - cloud.points
    distance = np.linalg.norm(to_light, axis=-1)
    lit = np.clip(np.sum(normals * to_light, axis=-1) / distance, 0, None)
    grey = gain * 300 * albedo(places) * lit * (AWAY / distance) ** 2
    grey += np.random.default_rng(2).normal(size=grey.shape)
    return replace(cloud, texture=np.clip(np.nan_to_num(grey), 0, 255).astype(np.uint8))


@pytest.fixture(scope="module")
def textured() -> TexturedMesh:
    names = dict(zip(SIDES, (1.0, 0.8, 0.9, 0.7, 1.0, 0.85), strict=True))
    scans = {name: painted(name, gain) for name, gain in names.items()}
    sphere = trimesh.creation.icosphere(5, RADIUS)
    poses = {name: looking_from(SIDES[name], AWAY) for name in scans}
    return texture_mesh(Mesh(sphere.vertices, sphere.faces), scans, poses, size=512, light=LIGHT)


def made_up() -> tuple[Mesh, np.ndarray, np.ndarray]:
    """A sphere with coordinates uv (n, 2) and an image (512, 512, 3) of chance, to be written and
    read back."""
    sphere, chance = trimesh.creation.icosphere(3, RADIUS), np.random.default_rng(4)
    image = chance.integers(0, 256, (512, 512, 3)).astype(np.uint8)
    return Mesh(sphere.vertices, sphere.faces), chance.random((len(sphere.vertices), 2)), image


def shown(textured: TexturedMesh) -> np.ndarray:
    """The image's red at each vertex."""
    size = len(textured.image)
    column, row = textured.uv[:, 0] * size - 0.5, (1 - textured.uv[:, 1]) * size - 0.5
    at = (
        np.clip(np.round(row), 0, size - 1).astype(int),
        np.clip(np.round(column), 0, size - 1).astype(int),
    )
    return textured.image[at][:, 0].astype(float)


@pytest.mark.slow
def test_the_texture_is_the_reflectance_without_shading_and_exposures(
    textured: TexturedMesh,
) -> None:
    red, truth = shown(textured), albedo(textured.mesh.vertices)
    away_from_step = np.abs(textured.mesh.vertices[:, 2]) > 3
    factor = np.sum(red * truth) / np.sum(truth**2)
    error = (red / factor - truth)[away_from_step]
    assert 0.005 < np.sqrt(np.mean(error**2)) < 0.03  # of 0.5; texels are 1 mm wide
    assert np.percentile(np.abs(error), 99) < 0.1
    assert textured.seen > 0.97 and 0.3 < textured.mm_per_texel < 1.5
    assert 1 <= textured.charts < 60 and 0 < textured.seams < 0.3
    assert len(textured.uv) == len(textured.mesh.vertices) >= 10242 and "px" in textured.text()
    assert textured.uv.min() >= 0 and textured.uv.max() <= 1


@pytest.mark.parametrize("suffix", ["obj", "glb"])
def test_trimesh_and_open3d_read_mesh_and_image(tmp_path: Path, suffix: str) -> None:
    path, (mesh, uv, picture) = tmp_path / f"part.{suffix}", made_up()
    size = write_textured(path, mesh, uv, picture, ("a note",))
    assert size == sum(each.stat().st_size for each in tmp_path.iterdir())
    found = trimesh.load(path, force="mesh", process=False, maintain_order=True)
    assert len(found.faces) == len(mesh.faces)
    assert found.extents.max() * (1000 if suffix == "glb" else 1) == pytest.approx(
        2 * RADIUS, rel=1e-3
    )
    assert np.allclose(found.visual.uv, uv, atol=1e-5)
    material = found.visual.material
    image = np.asarray(material.baseColorTexture if suffix == "glb" else material.image)
    assert np.array_equal(image[..., :3], picture)
    o3d = open3d()
    model = o3d.io.read_triangle_model(str(path))
    (material,) = model.materials
    assert np.asarray(material.albedo_img).shape[:2] == picture.shape[:2]
    assert len(model.meshes[0].mesh.triangles) == len(mesh.faces)
    if suffix == "obj":
        assert {each.name for each in tmp_path.iterdir()} == {"part.obj", "part.mtl", "part.png"}


@pytest.mark.slow
def test_what_stands_in_the_way_leaves_no_trace() -> None:
    """A view that sees another surface at a place does not colour it."""
    scan = painted("front", 1.0)
    sphere = trimesh.creation.icosphere(4, RADIUS)
    nearer = trimesh.creation.icosphere(4, RADIUS + 5)  # not what the scan saw
    pose = {"front": looking_from(SIDES["front"], AWAY)}
    both = trimesh.util.concatenate([sphere, nearer.apply_translation([100, 0, 0])])
    found = texture_mesh(Mesh(both.vertices, both.faces), {"front": scan}, pose, size=512)
    assert 0.1 < found.seen < 0.25  # less than half of one ball of two


def test_what_cannot_be_textured_is_refused(tmp_path: Path) -> None:
    sphere = trimesh.creation.icosphere(2, RADIUS)
    mesh = Mesh(sphere.vertices, sphere.faces)
    scan, pose = painted("front", 1.0), {"front": looking_from(SIDES["front"], AWAY)}
    with raises(InputError, "front", "texture"):
        texture_mesh(mesh, {"front": replace(scan, texture=None)}, pose)
    with raises(InputError, "100 px", 512, 8192):
        texture_mesh(mesh, {"front": scan}, pose, size=100)
    with raises(InputError, "part.stl", ".glb", ".obj"):
        write_textured(tmp_path / "part.stl", *made_up())
