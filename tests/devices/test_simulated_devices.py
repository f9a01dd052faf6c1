"""The simulated rig, asked through the protocols alone, against its world's truth."""

import threading
from dataclasses import replace

import numpy as np
import pytest
from clocks import SteppingClock
from facts import raises

from slviewer.devices.capture import capture_frames
from slviewer.devices.protocols import CameraSettings, Rig
from slviewer.devices.simulated import AUTO, preset_rig, simulated_rig
from slviewer.devices.world import SETTLED_S, SimulatedWorld
from slviewer.errors import Cancelled, DeviceError, InputError
from slviewer.fringe.decode import decode
from slviewer.fringe.patterns import render_pattern
from slviewer.fringe.presets import complementary, p18
from slviewer.fringe.sequence import Frame, PatternSequence
from slviewer.simulation.boards import BoardShape, Pose
from slviewer.simulation.plans import rotation, target_poses
from slviewer.simulation.renderer import Renderer
from slviewer.simulation.rig import letter
from slviewer.target.board import Board
from slviewer.target.detect import detect

PROJECTOR = (912, 1140)
WHITE = PatternSequence(PROJECTOR, (Frame("white"),))


@pytest.fixture
def world():
    return SimulatedWorld(letter(0.2))


@pytest.fixture
def rig(world):
    with simulated_rig(world).opened() as rig:
        yield rig


def seen(rig: Rig) -> np.ndarray:
    """One frame of what is shown now."""
    out = np.zeros(rig.camera.size[::-1], rig.camera.dtype)
    rig.camera.grab(out)
    return out


@pytest.mark.computes
def test_an_image_is_seen_as_the_pattern_of_the_same_grey_levels(world, rig):
    world.place("plane", Pose(rotation(np.array([0.2, -0.3, 0])), np.array([0, 0, 600.0])))
    sequence = complementary(PROJECTOR)
    rig.projector.load(sequence)
    for index in (0, len(sequence.frames) - 1):
        rig.projector.show(index)
        expected = seen(rig).astype(float)
        levels = render_pattern(sequence, index)
        rig.projector.show_image(np.repeat(levels[..., None], 3, axis=2))
        off = seen(rig) - expected
        assert abs(off.mean()) < 0.7 and off.std() < 5 and np.ptp(expected) > 100
    image = np.zeros((*PROJECTOR[::-1], 3), np.uint8)
    image[..., 0] = 255  # a third of the light of white, for a camera without colours
    rig.projector.show_image(image)
    red = seen(rig).astype(float)
    rig.projector.show_level(255)
    lit = world.renderer(False).truth().mask
    assert red[lit].mean() / seen(rig)[lit].mean() == pytest.approx(0.36, abs=0.06)
    with pytest.raises(InputError):
        rig.projector.show_image(image[1:])


@pytest.mark.computes
def test_a_capture_decodes_to_the_truth(world, rig):
    world.place("plane", Pose(rotation(np.array([0.2, -0.3, 0])), np.array([0, 0, 600.0])))
    sequence = complementary(PROJECTOR)
    frames = capture_frames(rig, sequence)
    truth = Renderer(world.rig, world.scene).truth()
    inner = truth.mask.copy()  # beside the plate's rim, pixels mix it with the dark
    for axis in (0, 1):
        for step in (-1, 1):
            inner &= np.roll(truth.mask, step, axis)
    for k, axis in enumerate(("x", "y")):
        phase = decode(sequence, frames, axis)
        assert phase.mask[inner].mean() > 0.999
        good = inner & phase.mask
        error = (phase.coordinate - truth.projector[..., k])[good]
        sigma = (phase.sigma_phase * phase.period_px / (2 * np.pi))[good]
        assert 0.93 < np.sqrt(np.mean(error**2) / np.mean(sigma**2)) < 1.1
        assert abs(error.mean()) < 2e-3


@pytest.mark.computes
def test_frames_arrive_in_place_in_order_and_with_progress(world, rig):
    sequence = p18(PROJECTOR)
    width, height = rig.camera.size
    out = np.zeros((len(sequence.frames), height, width), np.uint8)
    done = []
    assert capture_frames(rig, sequence, out, lambda k, n: done.append((k, n))) is out
    assert done == [(k, len(out)) for k in range(len(out) + 1)]
    expected = Renderer(world.rig, world.scene).capture(sequence, seed=9)
    sensor = world.rig.sensor
    for seen_frame, frame in zip(out.astype(float), expected, strict=True):
        assert abs((seen_frame - frame).mean()) < 0.05
        brightest = sensor.read_variance + sensor.shot_variance * sensor.peak_level
        assert np.sqrt(sensor.read_variance) < (seen_frame - frame).std() < np.sqrt(2 * brightest)


@pytest.mark.computes
def test_the_same_captures_have_the_same_noise_previews_or_not(world):
    stacks = []
    for previews in (0, 3):
        with simulated_rig(world).opened() as rig:
            rig.projector.show_level(200)
            for _ in range(previews):
                seen(rig)
            stacks.append((capture_frames(rig, WHITE)[0], capture_frames(rig, WHITE)[0]))
    assert np.array_equal(stacks[0], stacks[1])
    assert not np.array_equal(*stacks[0])


@pytest.mark.computes
def test_two_frames_of_one_pattern_differ_by_their_noise(rig):
    rig.projector.show_level(128)
    first, second = seen(rig).astype(float), seen(rig).astype(float)
    bright = first > 90
    noise = (first - second)[bright]
    sensor = letter(0.2).sensor
    expected = 2 * (
        sensor.read_variance + sensor.shot_variance * (first[bright].mean() - 3) + 1 / 12
    )
    assert noise.var() == pytest.approx(expected, rel=0.1)


def test_light_follows_the_level(rig):
    rig.projector.show_level(255)
    white = seen(rig).mean()
    rig.projector.show_level(128)
    grey = seen(rig).mean()
    rig.projector.show_level(None)
    dark = seen(rig).mean()
    assert dark < 30 and (grey - dark) / (white - dark) == pytest.approx(128 / 255, rel=0.03)


@pytest.mark.computes
def test_exposure_scales_the_light_and_saturates(world, rig):
    assert rig.camera.settings() == AUTO
    rig.projector.show_level(255)
    auto = seen(rig).astype(float)
    assert np.mean(auto == 255) == 0
    half = rig.camera.apply(CameraSettings(exposure_ms=0.5))
    assert half == rig.camera.settings() == CameraSettings(0.5, 1.0)
    dark = world.rig.sensor.dark_level
    assert (seen(rig).mean() - dark) / (auto.mean() - dark) == pytest.approx(0.5, rel=0.01)
    rig.camera.apply(CameraSettings(exposure_ms=3.0))
    plate = auto > 150
    assert np.all(seen(rig)[plate] == 255)
    assert rig.camera.apply(CameraSettings(exposure_ms=1e5)).exposure_ms == 100.0


@pytest.mark.computes
def test_gain_brings_light_and_noise(world, rig):
    rig.projector.show_level(255)
    spread, mean = {}, {}
    for setting in (CameraSettings(0.8, 1.0), CameraSettings(0.1, 8.0)):
        rig.camera.apply(setting)
        one, two = seen(rig).astype(float), seen(rig).astype(float)
        bright = one > 130
        spread[setting.gain], mean[setting.gain] = (one - two)[bright].std(), one[bright].mean()
    assert mean[8.0] == pytest.approx(mean[1.0], rel=0.02)
    assert 2.5 < spread[8.0] / spread[1.0] < 5  # shot noise alone gives sqrt(8)


@pytest.mark.computes
def test_moving_the_board_changes_the_next_frame(world, rig):
    rig.projector.show_level(255)
    poses = target_poses(world.rig, world.board, 3)
    for pose in poses:
        world.place("board", pose)
        found = detect(world.board, seen(rig))
        expected = world.rig.camera.project(pose.to_camera(world.scene.features))[found.ids]
        assert np.abs(found.pixels - expected).max() < 0.15
        assert np.array_equal(world.pose.t, pose.t)


@pytest.mark.slow
@pytest.mark.computes
def test_a_draft_shows_the_board_where_it_is_and_captures_are_never_drafts():
    time = SteppingClock()
    world = SimulatedWorld(letter(0.5), clock=time.now)
    with simulated_rig(world).opened() as rig:
        world.place("board", target_poses(world.rig, world.board, 2)[1])
        rig.projector.show_level(255)
        draft = seen(rig)
        found = detect(world.board, draft)
        truth = world.rig.camera.project(world.pose.to_camera(world.scene.features))[found.ids]
        assert np.abs(found.pixels - truth).max() < 0.2
        full = capture_frames(rig, WHITE)[0]
        assert (
            np.abs(np.diff(full.astype(float))).mean()
            > 1.05 * np.abs(np.diff(draft.astype(float))).mean()
        )
        time.sleep(SETTLED_S + 0.01)
        rig.projector.show_level(255)
        assert abs(seen(rig).astype(float) - full).std() < 4


@pytest.mark.computes
def test_each_thing_keeps_its_place(world, rig):
    rig.projector.show_level(255)
    centre = np.array([5.0, -4.0, 650.0])
    world.place("sphere", Pose(np.eye(3), centre))
    sphere = seen(rig)
    world.place("plane")
    assert world.standing == "plane" and not np.array_equal(seen(rig), sphere)
    world.place("sphere")
    assert np.array_equal(world.pose.t, centre)
    assert abs(seen(rig).astype(float) - sphere).std() < 4
    world.place("object")
    assert seen(rig).std() > 20
    with raises(InputError, "cube"):
        world.place("cube")
    with raises(InputError, "finite"):
        world.place("board", Pose(np.eye(3), np.array([0, 0, np.nan])))


@pytest.mark.computes
def test_another_board_can_be_printed(world, rig):
    board = Board.parse("chessboard:9x6:15")
    world.print_board(board, BoardShape(bow_x_mm=0.1))
    assert world.board == board and world.shape.bow_x_mm == 0.1 and world.standing == "board"
    rig.projector.show_level(255)
    assert len(detect(board, seen(rig)).ids) == 54
    with raises(InputError, "ChArUco"):
        world.print_board(Board.parse("charuco:9x6:15"))


def test_an_empty_view_is_dark_and_no_error(world, rig):
    world.place("sphere", Pose(np.eye(3), np.array([5000.0, 0.0, 600.0])))
    rig.projector.show_level(255)
    assert seen(rig).max() < 15


@pytest.mark.computes
def test_the_board_may_move_in_another_thread_during_a_capture(world, rig):
    poses = target_poses(world.rig, world.board, 5)
    stop = threading.Event()

    def move():
        while not stop.wait(0.002):
            world.place("board", poses[np.random.default_rng().integers(5)])

    mover = threading.Thread(target=move)
    mover.start()
    try:
        frames = capture_frames(rig, PatternSequence(PROJECTOR, (Frame("white"),) * 8))
    finally:
        stop.set()
        mover.join()
    assert frames.reshape(8, -1).max(1).min() > 100


def test_cancelling_ends_the_capture_and_leaves_the_rig_usable(rig):
    def stop(done: int, n: int) -> None:
        if done == 5:
            raise Cancelled("stopped by the operator")

    with pytest.raises(Cancelled):
        capture_frames(rig, p18(PROJECTOR), progress=stop)
    assert capture_frames(rig, WHITE)[0].max() > 150


def test_wrong_use_is_refused_in_words(world):
    rig = simulated_rig(world)
    with pytest.raises(DeviceError):
        seen(rig)
    with pytest.raises(DeviceError):
        rig.projector.load(WHITE)
    rig.close()
    with rig.opened():
        with pytest.raises(DeviceError):
            rig.open()
        with pytest.raises(DeviceError):
            rig.projector.show(0)
        with raises(InputError, "912x1140"):
            capture_frames(rig, p18((800, 600)))
        with raises(InputError, "frames"):
            capture_frames(rig, WHITE, np.zeros((2, 3, 4), np.uint8))
        with raises(InputError, "shape"):
            rig.camera.grab(np.zeros((3, 4), np.uint8))
        with pytest.raises(InputError):
            rig.projector.show_level(300)
        rig.projector.load(WHITE)
        with pytest.raises(InputError):
            rig.projector.show(1)
    with raises(InputError, "preset", "unknown"):
        preset_rig("unknown")
    with raises(InputError, "exposure"):
        CameraSettings(exposure_ms=-1.0)


@pytest.mark.computes
def test_a_steady_lamp_is_steady_and_a_flickering_one_is_not(world):
    spread = {}
    for flicker in (0.0, 0.02):
        lamp = replace(world.rig, light=replace(world.rig.light, flicker=flicker))
        with simulated_rig(SimulatedWorld(lamp)).opened() as rig:
            frames = capture_frames(rig, PatternSequence(PROJECTOR, (Frame("white"),) * 12))
        spread[flicker] = frames.mean((1, 2)).std() / frames.mean()
    assert spread[0.0] < 1e-3 and 0.008 < spread[0.02] < 0.04
