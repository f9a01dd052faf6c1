"""The white balance of textures: a white reference becomes neutral, and what is no reference is
refused."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from colour_camera import ColouredCamera, coloured
from facts import raises

from slviewer.devices.simulated import simulated_rig
from slviewer.devices.world import SimulatedWorld
from slviewer.errors import InputError, UsageError
from slviewer.pipeline.capture import capture
from slviewer.pipeline.mesh import balance, measure_white, mesh
from slviewer.pipeline.rig_choice import RigSetup
from slviewer.session.store import Session
from slviewer.simulation.rig import letter
from tests.rendered_calibration import true_calibration

pytestmark = pytest.mark.computes

COLOUR = np.array([ColouredCamera.RED, 1.0, ColouredCamera.BLUE])


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A session of a reddish colour camera: a white plate, an object, and the object in grey."""
    folder, rig = tmp_path_factory.mktemp("white") / "session", letter(0.15)
    true_calibration(folder, rig)
    world = SimulatedWorld(rig)
    for thing, name in (("plane", "card"), ("object", "part"), ("object", "grey")):
        world.place(thing)  # type: ignore[arg-type]
        one = simulated_rig(world)
        made = RigSetup(one if name == "grey" else coloured(one))
        capture(folder, name, {}, role="scan", patterns="gray", set_up=lambda *_, made=made: made)
    return folder


def mean_colour(path: Path) -> np.ndarray:
    """The mean colour of a texture, without what no scan saw."""
    image = np.asarray(trimesh.load(path, force="mesh").visual.material.baseColorTexture)[
        ..., :3
    ].astype(float)
    return np.asarray(image[image.max(axis=2) > 20].mean(axis=0))


@pytest.mark.slow
def test_the_texture_of_a_white_balanced_part_is_neutral(session: Path, tmp_path: Path) -> None:
    mesh(session, ["part"], tmp_path / "raw.glb", texture=512)
    mesh(session, ["part"], tmp_path / "white.glb", texture=512, white="card")
    raw, white = mean_colour(tmp_path / "raw.glb"), mean_colour(tmp_path / "white.glb")
    assert raw / raw[1] == pytest.approx(COLOUR, abs=0.02)
    assert white / white[1] == pytest.approx(1.0, abs=0.02) and white[1] > 40


@pytest.mark.slow
def test_gains_undo_the_cast_and_keep_overexposed_pixels_neutral(session: Path) -> None:
    with Session.open(session) as store:
        gains = measure_white(store, "card")
        assert gains * COLOUR == pytest.approx(
            ColouredCamera.BLUE, abs=0.01
        ) and gains.max() == pytest.approx(1.0)
        shown = balance(np.full((1, 1, 3), 255, np.uint8), gains)
        assert len(np.unique(shown)) == 1
        for reference, fact in (("grey", "colours"), ("board", "target poses")):
            with raises(InputError, reference, fact):
                measure_white(store, reference)


def test_what_has_no_colours_is_refused(session: Path, tmp_path: Path) -> None:
    with raises(InputError, "grey", "colours"):
        mesh(session, ["grey"], tmp_path / "grey.glb", texture=512, white="card")
    with raises(UsageError, "--texture"):
        mesh(session, ["part"], tmp_path / "part.stl", white="card")
