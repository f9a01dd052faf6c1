"""The faults of the hostile rig do what they say: sizes of gains, bytes of a codec, places of
frames, geometry."""

import numpy as np
import pytest

from slviewer.fringe.decode import decode
from slviewer.fringe.presets import gray_bits, phase_steps
from slviewer.fringe.sequence import Frame, PatternSequence
from slviewer.simulation.boards import Pose, blank_board
from slviewer.simulation.renderer import Renderer
from slviewer.simulation.rig import letter
from tests.proofs import hostile_frames as faults
from tests.proofs.hostile_frames import Shot
from tests.proofs.hostile_rig import (
    FAULTS,
    SEVERITIES,
    expose_frames,
    hostile_light,
    render_light,
)
from tests.proofs.hostile_scenes import MirrorTable, put_on_table, with_hand

pytestmark = pytest.mark.computes

PROJECTOR = (912, 1140)
SEQUENCE = PatternSequence(
    PROJECTOR,
    tuple(
        frame
        for axis in ("x", "y")
        for frame in (
            *phase_steps(axis, 8, 16.0),
            *gray_bits(axis, 7),
            Frame("complementary", axis),
        )
    ),
)
RIG = letter(0.1, local_distortion_px=0.0)
PLANE = blank_board(Pose(np.eye(3), np.array([0.0, 0.0, 600.0])))
LIGHT, RENDERER = render_light(RIG, PLANE, SEQUENCE)
RNG = np.random.default_rng(3)


def shot(**change):
    return Shot(
        **{
            "sequence": SEQUENCE,
            "rng": np.random.default_rng(5),
            "room_light": RENDERER.room_light(),
        }
        | change
    )


def test_drift_has_the_rms_that_it_says():
    gains = faults.vary_exposure(np.ones((32, 2, 2)), 0.1, shot(rng=RNG))
    assert np.std(gains) == pytest.approx(0.1, rel=0.02) and np.mean(gains) == pytest.approx(
        1, abs=0.02
    )
    scaled = faults.scale_frames(LIGHT, gains[: len(LIGHT), 0, 0])
    assert np.allclose(scaled.sum((1, 2)) / LIGHT.sum((1, 2)), gains[: len(LIGHT), 0, 0], rtol=1e-5)


def test_an_exposure_loop_settles_at_its_target():
    gains = faults.follow_exposure(np.full((40, 2, 2), 80.0), 0.3, shot())[:, 0, 0] / 80.0
    assert gains[0] == pytest.approx(1.3) and gains[-1] == pytest.approx(1, abs=2e-3)
    assert np.all(np.diff(gains) < 0)


def test_flicker_is_bands_of_rows_that_differ_from_frame_to_frame():
    even = np.full_like(LIGHT, 90.0)
    ratio = faults.add_flicker(even, 0.05, shot()) / even
    assert np.allclose(ratio, ratio[:, :, :1], atol=1e-5)
    assert ratio.max() == pytest.approx(1.05, abs=2e-3) and ratio.min() == pytest.approx(
        0.95, abs=2e-3
    )
    assert np.std(ratio[:, 60, 0]) > 0.02


def test_a_lamp_adds_light_and_no_modulation():
    illuminated = faults.switch_lamp_on(LIGHT, 0.15, shot())
    assert np.array_equal(illuminated[:4], LIGHT[:4])
    more = (illuminated - LIGHT)[4:]
    assert np.allclose(more, more[0], atol=1e-4)
    white = LIGHT.max() / (1 + RIG.light.ambient)
    assert np.median(more[0][RENDERER.truth().mask]) / white == pytest.approx(0.15, rel=0.1)


def test_jpeg_passes_a_codec_that_loses_more_at_lower_quality():
    frames = expose_frames(RENDERER, LIGHT, SEQUENCE)
    coded = {quality: faults.compress_jpeg(frames, quality) for quality in (85, 65, 50)}
    lost = [float(np.std(each.astype(float) - frames)) for each in coded.values()]
    assert 0.5 < lost[0] < lost[1] < lost[2] < 6
    # Its error is that of quantised 8x8 blocks: coding again what was coded changes much less.
    again = faults.compress_jpeg(coded[50], 50)
    assert np.std(again.astype(float) - coded[50]) < 0.5 * lost[2]


def test_frames_change_places():
    frames = np.arange(32, dtype=np.uint8).reshape(32, 1, 1) * np.ones((1, 2, 2), np.uint8)
    assert faults.delay_frames(frames, 2)[:, 0, 0].tolist() == [30, 31, *range(30)]
    assert faults.drop_frame(frames, 4)[:, 0, 0].tolist() == [*range(4), *range(5, 32), 31]
    assert faults.repeat_frames(frames, 1, shot())[1:4, 0, 0].tolist() == [1, 1, 3]
    assert faults.swap_neighbours(frames, 1, shot())[:4, 0, 0].tolist() == [0, 2, 1, 3]
    assert faults.exchange_axis_frames(frames, 0, shot())[:, 0, 0].tolist() == [
        *range(16, 32),
        *range(16),
    ]
    assert faults.reverse_bits(frames, 0, shot())[8:16, 0, 0].tolist() == [
        14,
        13,
        12,
        11,
        10,
        9,
        8,
        15,
    ]
    assert faults.reorder_steps(frames, 0, shot())[:8, 0, 0].tolist() == [2, 3, 4, 5, 6, 7, 0, 1]
    assert faults.reorder_steps(frames, 1, shot())[:8, 0, 0].tolist() == [0, 7, 6, 5, 4, 3, 2, 1]


def test_hot_pixels_are_as_many_as_said_and_stay_where_they_are():
    frames = np.full((3, 200, 200), 100, np.uint8)
    spoilt = faults.add_hot_pixels(frames, 0.02, shot())
    assert np.array_equal(spoilt[0], spoilt[2])
    assert np.mean(spoilt == 255) == pytest.approx(0.01, rel=0.2) and np.mean(
        spoilt == 0
    ) == pytest.approx(0.01, rel=0.2)


def test_a_dim_projector_has_the_amplitude_that_it_says():
    light, _ = hostile_light(FAULTS["dim-projector"], "severe", RIG, PLANE, SEQUENCE, 0)
    phase = decode(SEQUENCE, expose_frames(RENDERER, light, SEQUENCE), "x")
    assert np.median(phase.modulation[RENDERER.truth().mask]) == pytest.approx(6, rel=0.15)


def test_noise_is_that_of_the_rig_where_nothing_is_wrong():
    frames = np.stack([expose_frames(RENDERER, LIGHT[:1], SEQUENCE, seed=k)[0] for k in range(24)])
    inner = RENDERER.truth().mask & (LIGHT[0] > 50)
    variance = frames.astype(float).var(0, ddof=1)[inner].mean()
    expected = RIG.sensor.read_variance + RIG.sensor.shot_variance * LIGHT[0][inner].mean() + 1 / 12
    assert variance == pytest.approx(expected, rel=0.03)


def test_the_hand_hides_part_of_the_plane_and_throws_a_shadow():
    scene = with_hand(PLANE, 60.0)
    hidden = Renderer(RIG, scene).truth()
    clean = RENDERER.truth()
    nearer = clean.points[..., 2] - hidden.points[..., 2]
    assert 0.03 < np.nanmean(nearer > 2) < 0.4
    shadow = clean.mask & ~hidden.mask & (np.abs(nearer) < 1e-6)
    assert np.count_nonzero(shadow) > 20


def test_the_mirror_shows_the_plane_below_itself_and_lights_it_again():
    low = blank_board(Pose(np.eye(3), np.array([0.0, -40.0, 600.0])))
    table = put_on_table(low, 0.5, 0)
    assert isinstance(table, MirrorTable)
    rays = RIG.camera.rays()
    mirrored = np.isfinite(table.trace(rays).points[..., 2]) & ~table.is_direct(rays)
    assert (
        mirrored.any()
        and np.nonzero(mirrored)[0].min() > np.nonzero(table.is_direct(rays))[0].max() - 3
    )
    # What the mirror shows are points of the plate itself.
    assert np.allclose(table.trace(rays).points[mirrored][:, 2], 600.0, atol=1e-6)
    light, _ = render_light(RIG, table, SEQUENCE)
    alone, _ = render_light(RIG, low, SEQUENCE)
    exposures = Renderer(RIG, table).exposure / Renderer(RIG, low).exposure
    assert np.all((light / exposures - alone)[:, table.is_direct(rays)] > -1e-2)
    assert (light / exposures - alone)[:, table.is_direct(rays)].max() > 5


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[] if k % 3 == 0 else pytest.mark.slow)
        for k, name in enumerate(FAULTS)
    ],
)
def test_every_fault_disturbs_the_capture_more_the_more_severe_it_is(name):
    fault, number = FAULTS[name], 3
    clean = expose_frames(RENDERER, LIGHT, SEQUENCE, number).astype(float)
    changes = []
    for severity in SEVERITIES:
        light, renderer = LIGHT, RENDERER
        if fault.is_optical:
            light, renderer = hostile_light(fault, severity, RIG, PLANE, SEQUENCE, number)
        frames = expose_frames(renderer, light, SEQUENCE, number, fault, severity)
        assert frames.shape == clean.shape and frames.dtype == np.uint8
        changes.append(np.abs(frames - clean).mean())
    assert min(changes) > 0
    variants = {
        "exchanged-axes",
        "reversed-axis",
        "reversed-bits",
        "step-order",
        "duplicate-frame",
        "swapped-frames",
    }
    assert name in variants or changes[0] < changes[2]
