"""`slviewer preflight --capture`: the checks of a rig on recorded frames."""

import json
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest
from imperfect_rig import Imperfections, imperfect

from slviewer.cli import main
from slviewer.devices.capture import capture_frames
from slviewer.devices.simulated import simulated_rig
from slviewer.devices.world import SimulatedWorld
from slviewer.fringe.presets import complementary, gray, p18
from slviewer.fringe.sequence import PatternSequence
from slviewer.pipeline.examination import Preflight
from slviewer.preflight.check_rig import check_recorded_rig
from slviewer.session.capture import NewCapture
from slviewer.session.store import Session
from slviewer.simulation.rig import letter

pytestmark = pytest.mark.computes

Change = Callable[[np.ndarray], np.ndarray]


@lru_cache
def frames_of(
    sequence_of: Callable = complementary, gamma: float = 1.0, **wrong: object
) -> tuple[PatternSequence, np.ndarray]:
    world = SimulatedWorld(letter(0.2, 0, gamma=gamma))
    world.place("object")
    rig, _ = imperfect(simulated_rig(world), Imperfections(**wrong))
    sequence = sequence_of(rig.projector.size)
    with rig.opened():
        stack = capture_frames(rig, sequence)
    stack.flags.writeable = False  # tests share it
    return sequence, stack


def checked(folder: Path, sequence: PatternSequence, stack: np.ndarray) -> Preflight:
    with Session.create(folder) as store:
        store.save_capture("part", "scan", sequence, stack, source="a test")
    return check_recorded_rig(folder, "part")


def gained(stack: np.ndarray, gain: float | np.ndarray, offset: float = 0.0) -> np.ndarray:
    return np.clip(np.rint(stack * gain + offset), 0, 255).astype(np.uint8)


@pytest.mark.parametrize(
    "sequence_of",
    [p18, *(pytest.param(each, marks=pytest.mark.slow) for each in (complementary, gray))],
)
def test_a_sound_capture_is_good(tmp_path: Path, sequence_of: Callable) -> None:
    found = checked(tmp_path / "session", *frames_of(sequence_of))
    # a camera of 320 pixels does not resolve stripes one projector pixel wide
    unresolved = {"description"} if sequence_of is gray else set()
    assert {check.name for check in found.checks if check.verdict == "warning"} == unresolved
    assert found.verdict == ("warning" if unresolved else "good")
    names = {
        "description",
        "order",
        "repeats",
        "exposure",
        "flicker",
        "ambient",
        "gamma",
        "noise",
        "decoding",
    }
    assert {check.name for check in found.checks} == names
    decoded = found.check("decoding").figures
    assert all(0.9 < decoded[axis]["decoded_share"] <= 1 for axis in ("x", "y"))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("wrong", "frame"),
    [
        ({"repeated": frozenset({10})}, 11),
        pytest.param({"swapped": 4}, 5, marks=pytest.mark.slow),
        pytest.param({"lag": 1}, 2, marks=pytest.mark.slow),
    ],
)
def test_the_order_is_checked(tmp_path: Path, wrong: dict, frame: int) -> None:
    found = checked(tmp_path / "session", *frames_of(p18, **wrong))
    order = found.check("order")
    assert order.verdict == "bad" and frame in order.figures["misplaced_frames"] and order.remedy
    assert found.verdict == "bad"
    assert found.check("repeats").verdict == "bad" or "repeated" not in wrong


def test_saturation_is_checked(tmp_path: Path) -> None:
    sequence, stack = frames_of()
    exposure = checked(tmp_path / "session", sequence, gained(stack, 2.5)).check("exposure")
    assert exposure.verdict == "bad" and exposure.figures["saturated_share"] > 0.05


def test_darkness_is_checked(tmp_path: Path) -> None:
    sequence, stack = frames_of()
    exposure = checked(tmp_path / "session", sequence, gained(stack, 0.1)).check("exposure")
    assert (
        exposure.verdict == "bad" and 0.05 < exposure.figures["bright_share_of_full_scale"] < 0.12
    )


@pytest.mark.slow
def test_noise_is_checked(tmp_path: Path) -> None:
    sequence, stack = frames_of(p18)
    noisy = gained(stack, 0.25, 60 + 6 * np.random.default_rng(0).standard_normal(stack.shape))
    noise = checked(tmp_path / "session", sequence, noisy).check("noise")
    assert noise.verdict == "warning" and 5.5 < noise.figures["x"]["noise_levels"] < 6.5


@pytest.mark.slow
def test_drifting_light_is_checked(tmp_path: Path) -> None:
    sequence, stack = frames_of(p18)
    gains = 1 - 0.2 * np.random.default_rng(0).random(len(stack))
    flicker = checked(tmp_path / "session", sequence, gained(stack, gains[:, None, None])).check(
        "flicker"
    )
    assert flicker.verdict == "warning" and flicker.remedy


@pytest.mark.slow
def test_gamma_is_checked(tmp_path: Path) -> None:
    gamma = checked(tmp_path / "session", *frames_of(p18, gamma=2.2)).check("gamma")
    assert gamma.verdict == "warning" and 1.5 < gamma.figures["gamma"] < 2.6


@pytest.mark.slow
def test_a_description_that_contradicts_the_frames_is_bad(tmp_path: Path) -> None:
    sequence, stack = frames_of(gray)
    smaller = PatternSequence(
        (sequence.projector[0] // 2, sequence.projector[1] // 2), sequence.frames
    )
    description = checked(tmp_path / "session", smaller, stack).check("description")
    assert description.verdict == "bad" and description.remedy


def listed(text: str) -> list[dict[str, str]]:
    """The verdict and the name of each check that a text lists, a line each."""
    return [
        dict(zip(("verdict", "name"), line.split(), strict=False)) for line in text.splitlines()
    ]


@pytest.mark.slow
def test_the_command_writes_json_and_ends_with_1_for_a_bad_capture(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    sequence, stack = frames_of()
    with Session.create(tmp_path / "session") as store:
        store.save_capture("good", "scan", sequence, stack, source="a test")
        store.save_capture("bright", "scan", sequence, gained(stack, 3), source="a test")
    out = tmp_path / "found.json"
    assert (
        main(["preflight", "--capture", str(tmp_path / "session"), "good", "--json", str(out)]) == 0
    )
    assert json.loads(out.read_text())["verdict"] == "good"
    assert {"verdict": "good", "name": "order:"} in listed(capsys.readouterr().out)
    assert (
        main(["preflight", "--capture", str(tmp_path / "session"), "bright", "--json", str(out)])
        == 1
    )
    assert json.loads(out.read_text())["verdict"] == "bad"
    said = capsys.readouterr()
    assert {"verdict": "bad", "name": "exposure:"} in listed(said.out) and said.err
    assert (
        main(["preflight", "--capture", str(tmp_path / "session"), "good", "--rig", "simulated"])
        == 2
    )


def test_the_frames_of_a_second_camera_are_checked_too(tmp_path: Path) -> None:
    sequence, stack = frames_of(p18)
    late = NewCapture("part", sequence, np.roll(stack, 1, axis=0))
    with Session.create(tmp_path / "session") as store:
        store.save_capture("part", "scan", sequence, stack, second=late)
    order = check_recorded_rig(tmp_path / "session", "part").check("order")
    assert order.verdict == "bad" and "Second camera" in order.observation
