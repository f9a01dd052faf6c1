"""Several exposures as one stack: exact by pixel, wider in light, no worse in phase."""

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest
from facts import raises
from fringe_scene import variants

from slviewer.errors import InputError
from slviewer.fringe.decode import decode
from slviewer.fringe.hdr import merge_exposures, radiance
from slviewer.fringe.patterns import profile
from slviewer.fringe.presets import complementary, gray, p18
from slviewer.simulation.boards import BoardScene, Pose, blank_board
from slviewer.simulation.renderer import Renderer
from slviewer.simulation.rig import letter
from slviewer.simulation.scenes import Surface

EXPOSURES = (1.0, 4.0, 16.0)
PERIOD_PX = 16.0
RIG = letter(0.2)


@dataclass(frozen=True)
class Patchy:
    """A plate with a black half and a spot that shines six times as bright as paper."""

    plate: BoardScene

    def trace(self, rays: np.ndarray) -> Surface:
        surface = self.plate.trace(rays)
        x, y = surface.points[..., 0], surface.points[..., 1]
        albedo = surface.albedo.copy()
        with np.errstate(invalid="ignore"):
            albedo[x < -20] *= 0.07
            albedo[np.hypot(x - 45, y) < 25] *= 6
        return replace(surface, albedo=albedo)

    def occluded(self, points: np.ndarray, source: np.ndarray) -> np.ndarray:
        return self.plate.occluded(points, source)


@cache
def render_plate() -> Renderer:
    """Its rays are traced once for all sequences."""
    return Renderer(RIG, Patchy(blank_board(Pose(np.eye(3), np.array([0.0, 0.0, 600.0])))))


class Shot:
    """The scene in three exposures, merged, and its truth."""

    def __init__(self, make) -> None:
        self.sequence, renderer = make(RIG.projector.size), render_plate()
        self.illuminated, self.truth = renderer.truth().mask, renderer.truth().projector[..., 0]
        rng = np.random.default_rng(7)
        width, height = RIG.camera.size
        self.stacks = np.empty((len(EXPOSURES), len(self.sequence.frames), height, width), np.uint8)
        for stack, exposure in zip(self.stacks, EXPOSURES, strict=True):
            for k, frame in enumerate(stack):
                keys = rng.integers(0, 2**32, 2, dtype=np.uint32)
                renderer.frame(
                    profile(self.sequence, k), keys, frame, exposure=renderer.exposure * exposure
                )
        self.frames, self.choice = merge_exposures(self.stacks, EXPOSURES)

    def measured(self, frames: np.ndarray):
        """Phase map, coverage of what is illuminated, and the errors in their own standard
        deviations, (h, w)."""
        phase = decode(self.sequence, frames, "x")
        error = (phase.coordinate - self.truth) * (2 * np.pi / phase.period_px)
        return (
            phase,
            np.count_nonzero(phase.mask & self.illuminated) / np.count_nonzero(self.illuminated),
            error / phase.sigma_phase,
        )


shot_with = cache(Shot)


@pytest.fixture(scope="module")
def shot() -> Shot:
    return shot_with(complementary)


def brute(stacks, exposures, white):
    frames, choice = stacks[np.argmin(exposures)].copy(), np.zeros(stacks.shape[2:], int)
    for v, u in np.ndindex(*choice.shape):
        good = [k for k in range(len(exposures)) if stacks[k, :, v, u].max() < white]
        choice[v, u] = max(good, key=lambda k: exposures[k]) if good else int(np.argmin(exposures))
        frames[:, v, u] = stacks[choice[v, u], :, v, u]
    return frames, choice


@pytest.mark.parametrize(
    ("dtype", "top", "white"),
    [(np.uint8, 255, 255), (np.uint16, 4095, 4095), (np.uint16, 65520, 65520)],
)
def test_it_is_what_its_definition_says(dtype, top, white):
    rng = np.random.default_rng(3)
    light = rng.uniform(0, 1.3, (1, 5, 17, 23)) * np.logspace(-2, 0.5, 17)[:, None]
    exposures = (8.0, 2.0, 32.0)  # in no order
    stacks = np.clip(light * np.reshape(exposures, (3, 1, 1, 1)) / 8 * top, 0, top).astype(dtype)
    assert (stacks == white).any()
    frames, choice = merge_exposures(stacks, exposures)
    expected, which = brute(stacks, exposures, white)
    np.testing.assert_array_equal(choice, which)
    np.testing.assert_array_equal(frames, expected)
    assert (
        choice.dtype == np.uint8 and frames.dtype == dtype and set(np.unique(choice)) == {0, 1, 2}
    )
    np.testing.assert_array_equal(merge_exposures(list(stacks), exposures)[0], frames)


@pytest.mark.computes
def test_one_exposure_changes_nothing_and_the_brightest_still_count_as_clipped(shot):
    frames, choice = merge_exposures(shot.stacks[2:], (16.0,))
    np.testing.assert_array_equal(frames, shot.stacks[2])
    assert not choice.any()
    assert (frames.max(axis=0) == 255).any()


@pytest.mark.computes
def test_coverage_rises_and_every_error_stays_at_its_noise(shot):
    single = [shot.measured(stack)[1] for stack in shot.stacks]
    assert max(single) < 0.6  # 0.54 at best: the black half, or the paper and the spot
    phase, coverage, normalised = shot.measured(shot.frames)
    assert 0.99 < coverage <= 1
    valid = phase.mask & shot.illuminated
    # no fringe order is wrong
    assert np.abs(normalised[valid] * phase.sigma_phase[valid]).max() < 1.0
    for index in range(len(EXPOSURES)):
        part = valid & (shot.choice == index)
        assert np.count_nonzero(part) > 0.02 * np.count_nonzero(shot.illuminated)
        assert 0.9 < np.median(np.abs(normalised[part])) / 0.6745 < 1.15
    dark = shot.choice == 2
    # 0.3 at the shortest exposure, were it not masked
    assert np.median(phase.sigma_phase[valid & dark]) < 0.06


@pytest.mark.computes
def test_at_the_borders_of_the_choice_the_phase_is_that_of_the_exposure_chosen(shot):
    merged, _, normalised = shot.measured(shot.frames)
    beside = np.zeros(shot.choice.shape, bool)
    for axis in (0, 1):
        step = np.diff(shot.choice.astype(int), axis=axis) != 0
        beside |= np.pad(step, [(0, 1) if a == axis else (0, 0) for a in (0, 1)])
        beside |= np.pad(step, [(1, 0) if a == axis else (0, 0) for a in (0, 1)])
    for index, stack in enumerate(shot.stacks):
        alone, here = decode(shot.sequence, stack, "x"), shot.choice == index
        np.testing.assert_array_equal(merged.wrapped[here], alone.wrapped[here])
        both = here & beside & merged.mask & alone.mask
        np.testing.assert_array_equal(merged.phase[both], alone.phase[both])
    edge = beside & merged.mask & shot.illuminated
    assert np.count_nonzero(edge) > 300
    # the lens mixes bright and dark light there, in one exposure too: above the noise, far below a
    # period
    assert np.sqrt(np.mean(normalised[edge] ** 2)) < 2.5


@pytest.mark.computes
@pytest.mark.parametrize("make", variants([p18, complementary, gray], complementary))
def test_the_measured_noise_is_that_of_one_exposure(make):
    shot = shot_with(make)
    single, merged = (
        decode(shot.sequence, frames, "x").noise for frames in (shot.stacks[0], shot.frames)
    )
    for level in (40, 100, 180):
        true = 1.2 + 1 / 12 + 0.0245 * (level - 3)
        assert (merged[0] + merged[1] * level) / true == pytest.approx(1, abs=0.15), (
            single,
            merged,
        )


@pytest.mark.slow
@pytest.mark.computes
def test_noise_that_is_taken_from_neighbours_is_little_disturbed_by_the_borders():
    shot = Shot(lambda size: complementary(size, 3))
    single, merged = (
        decode(shot.sequence, frames, "x").noise for frames in (shot.stacks[0], shot.frames)
    )
    for level in (40, 100, 180):
        assert 0.8 < (merged[0] + merged[1] * level) / (single[0] + single[1] * level) < 1.4


@pytest.mark.computes
def test_radiance_is_smooth_where_the_choice_is_not(shot):
    texture = shot.sequence.frames.index(
        next(f for f in shot.sequence.frames if f.kind == "texture")
    )
    light = radiance(shot.frames[texture], shot.choice, EXPOSURES)
    once = shot.stacks[0][texture].astype(float)
    clear = shot.illuminated & (once < 255) & (once > 20)
    assert np.median(np.abs(light - once)[clear]) < 3  # the dark level and the noise of one frame
    assert light.max() == once.max() > 200


def test_what_does_not_fit_is_refused():
    stacks = np.zeros((3, 4, 5, 6), np.uint8)
    for some, exposures, fact in (
        (stacks[:2], (1.0, 2.0, 3.0), "alike"),
        ([stacks[0], stacks[1, :, 1:]], (1.0, 2.0), "alike"),
        (stacks, (1.0, 2.0, 2.0), "1, 2, 2"),
        (stacks, (0.0, 1.0, 2.0), "above 0"),
        ([], (), "alike"),
    ):
        with raises(InputError, fact):
            merge_exposures(some, exposures)
