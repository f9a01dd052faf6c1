"""The LightCrafter 4500: its protocol byte by byte, its pictures plane by plane, bursts and what
can go wrong with them on a simulated controller."""

import json
import struct
import sys
from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from clocks import SteppingClock
from copies import copy_session
from facts import missing_facts, raises

from slviewer.devices import drivers as drivers_module
from slviewer.devices.browser import PageChannels
from slviewer.devices.capture import can_burst, capture_frames
from slviewer.devices.dlpc350 import Command, Dlpc350, lut_entry, open_hid
from slviewer.devices.lightcrafter4500 import (
    SIZE,
    LightCrafter4500,
    PatternTiming,
    list_lightcrafters,
)
from slviewer.devices.protocols import CameraSettings, Rig
from slviewer.devices.simulated import SimulatedProjector
from slviewer.devices.simulated_dlpc350 import (
    SimulatedDlpc350,
    SimulatedTriggeredCamera,
    simulated_lightcrafter,
)
from slviewer.devices.world import SimulatedWorld
from slviewer.errors import DeviceError, InputError
from slviewer.fringe.decode import decode
from slviewer.fringe.patterns import profile
from slviewer.fringe.presets import gray, p18, phase_steps
from slviewer.fringe.sequence import Frame, PatternSequence
from slviewer.pipeline.rig_choice import check_choice, list_needed_pages, set_up
from slviewer.preflight.check_rig import preflight
from slviewer.simulation.rig import letter

PLANES = {
    8: "G7G6G5G4G3G2G1G0 R7R6R5R4R3R2R1R0 B7B6B5B4B3B2B1B0",
    7: "G7G6G5G4G3G2G1 R7R6R5R4R3R2R1 B7B6B5B4B3B2B1",
    4: "G3G2G1G0 G7G6G5G4 R3R2R1R0 R7R6R5R4 B3B2B1B0 B7B6B5B4",
    2: "G1G0 G3G2 G5G4 G7G6 R1R0 R3R2 R5R4 R7R6 B1B0 B3B2 B5B4 B7B6",
    1: "G0 G1 G2 G3 G4 G5 G6 G7 R0 R1 R2 R3 R4 R5 R6 R7 B0 B1 B2 B3 B4 B5 B6 B7",
}
"""The bit planes of each pattern number (DLPU010G, table 2-70)."""
SHORT = PatternSequence(
    SIZE,
    (*phase_steps("x", 4, 16.0), Frame("white"), *phase_steps("y", 3, 16.0), Frame("black")),
    relative=True,
)


@pytest.fixture
def world() -> SimulatedWorld:
    world = SimulatedWorld(letter(0.1, flicker=0.0))
    world.place("plane")
    return world


@pytest.fixture
def lightcrafter(world: SimulatedWorld) -> Iterator[tuple[Rig, SimulatedDlpc350]]:
    rig, controller = simulated_lightcrafter(world, PatternTiming())
    with rig.opened():
        yield rig, controller


class Recorder:
    """A transport that answers with what is planned."""

    def __init__(self, *answers: str) -> None:
        self.answers = [bytes.fromhex(answer) for answer in answers]
        self.written: list[bytes] = []

    def write(self, packet: bytes) -> None:
        self.written.append(packet)

    def read(self, timeout_s: float) -> bytes:
        return self.answers.pop(0).ljust(64, b"\0") if self.answers else b""

    def close(self) -> None:
        raise OSError("gone")


def test_packets_are_those_of_the_guide():
    # an answer to an earlier command comes first; the second command is acknowledged
    recorder = Recorder("c0 00 01 00 ff", "c0 01 01 00 02", "40 02 00 00")
    control = Dlpc350(recorder, "the controller")
    assert control.read(Command.MAIN_STATUS) == 2
    control.write(Command.EXPOSURE, (8333).to_bytes(4, "little") * 2)
    assert [packet.rstrip(b"\0").hex(" ") for packet in recorder.written] == [
        "c0 01 02 00 0c 1a",
        "40 02 0a 00 29 1a 8d 20 00 00 8d 20",
    ]
    assert {len(packet) for packet in recorder.written} == {64}
    control.close()


@pytest.mark.parametrize(
    ("answer", "facts"),
    [
        ("e0 01 00 00", ["refused", "MAIN_STATUS"]),
        ("c0 01 00 00", ["refused", "MAIN_STATUS"]),
        ("", ["MAIN_STATUS", 2]),
    ],
)
def test_refused_and_missing_answers_are_errors(answer, facts):
    control = Dlpc350(Recorder(*filter(None, [answer])), "the controller")
    with raises(DeviceError, "the controller", *facts):
        control.read(Command.MAIN_STATUS)


class HidDevice:
    """A device as hidapi has it, which echoes what it gets."""

    def __init__(self) -> None:
        self.open_path = lambda path: None
        self.sent = b""

    def write(self, data: bytes) -> int:
        self.sent = data
        return -1 if self.sent == b"\0" * 65 else len(data)

    def read(self, length: int, timeout_ms: int) -> list[int]:
        assert (length, timeout_ms > 0) == (64, True)
        return list(self.sent[1:])

    def close(self) -> None:
        self.sent = b""


def test_the_device_is_found_by_its_serial_number(monkeypatch):
    listed = [
        {"path": b"0", "serial_number": "LCR2", "interface_number": 1},
        {"path": b"1", "serial_number": "LCR2", "interface_number": 0},
        {"path": b"2", "serial_number": "LCR3", "interface_number": 0},
    ]
    hid = SimpleNamespace(device=HidDevice, enumerate=lambda vendor, product: listed)
    monkeypatch.setitem(sys.modules, "hid", hid)
    assert list_lightcrafters() == [
        "LightCrafter 4500, serial LCR2",
        "LightCrafter 4500, serial LCR3",
    ]
    transport = open_hid("LCR3")
    transport.write(b"\1" * 64)
    assert transport.read(0.0) == b"\1" * 64
    with pytest.raises(OSError, match="write"):
        transport.write(b"\0" * 64)
    transport.close()
    with raises(DeviceError, "LCR4", "slviewer devices"):
        open_hid("LCR4")


def test_an_entry_of_the_look_up_table_has_its_bits_in_place():
    assert lut_entry(0, 8, 7, first=True, black=False).hex() == "017800"
    assert lut_entry(2, 7, 4, first=False, black=True).hex() == "0b4702"


@pytest.mark.parametrize(
    ("main", "hardware", "system", "at_start", "running"),
    [
        (0b010, 1, 1, [], []),
        (0b000, 1, 1, [], ["stopped", "HDMI"]),
        (0b110, 1, 1, ["frozen"], ["frozen"]),
        (0b011, 1, 1, ["parked"], ["parked"]),
        (0b000, 0b11001001, 1, [], ["stopped", "forced", "aborted", "error"]),
        (0b010, 0b100, 0, ["start up", "mirrors", "memory"], []),
    ],
)
def test_status_bits_are_put_into_words(main, hardware, system, at_start, running):
    bits = {Command.MAIN_STATUS: main, Command.HARDWARE_STATUS: hardware}

    class Status(Recorder):
        def read(self, timeout_s: float) -> bytes:
            _, number, _, command = struct.unpack_from("<BBHH", self.written[-1])
            value = bits.get(command, system)
            return bytes([0xC0, number, 1, 0, value]).ljust(64, b"\0")

    control = Dlpc350(Status(), "the controller")
    faults = control.list_faults(is_running=False)
    assert not missing_facts(str(control.describe_faults(faults)), *at_start) and len(
        faults
    ) == len(at_start)
    with raises(DeviceError, *running) if running else nullcontext():
        control.check_running()


def test_a_mode_or_a_validation_that_takes_too_long_is_an_error(world):
    projector = SimulatedProjector(world)
    controller = SimulatedDlpc350(projector, SimulatedTriggeredCamera(world))
    control = Dlpc350(controller, "the controller", SteppingClock(0.5).now)
    controller.fault = "busy"
    entry = lut_entry(0, 8, 7, first=True, black=False)
    with raises(DeviceError, "busy", 5):
        control.send_sequence([entry], 8333, b"\xbb" * 3)
    with raises(DeviceError, "POWER", 1, 5):
        Dlpc350(Deaf(), "the controller", SteppingClock(0.5).now).set(Command.POWER, 1)


class Deaf(Recorder):
    """A controller that accepts everything and changes nothing."""

    def read(self, timeout_s: float) -> bytes:
        return bytes([0xC0, self.written[-1][1], 1, 0, 0]).ljust(64, b"\0")


@pytest.mark.parametrize("bits", PLANES)
def test_pictures_have_the_patterns_in_the_planes_of_their_numbers(bits):
    timing = PatternTiming(bits, refresh_hz=20.0)
    numbers = PLANES[bits].split()
    assert timing.count == len(numbers)
    levels = np.random.default_rng(bits).integers(0, 2**bits, (len(numbers), 50))
    full = 2**bits - 1
    picture = timing.pack([np.rint(each * 255 / full).astype(np.uint8) for each in levels])
    for number, shown in zip(numbers, levels, strict=True):
        planes = [number[k : k + 2] for k in range(0, len(number), 2)]
        read = sum(
            (picture[:, "RGB".index(colour)] >> int(bit) & 1).astype(int) << place
            for place, (colour, bit) in enumerate(reversed(planes))
        )
        np.testing.assert_array_equal(read, shown)


@pytest.mark.parametrize(
    ("settings", "count", "period_us", "has_black"),
    [
        ((8,), 2, 8333, False),  # three take 25 ms
        ((7,), 3, 5478, True),
        ((7, 2), 2, 8218, True),
        ((4,), 6, 2739, True),
        ((1,), 24, 684, True),
        ((8, 1, 8333), 1, 8333, True),  # dark for as long
        ((7, None, 7000), 2, 7000, True),
        ((8, None, None, 120.0), 1, 8333, False),
        ((8, None, None, 40.0), 3, 8333, False),
    ],
)
def test_as_many_patterns_fit_a_picture_as_their_shortest_exposures_allow(
    settings, count, period_us, has_black
):
    timing = PatternTiming(*settings)
    assert (timing.count, timing.period_us, timing.has_black) == (count, period_us, has_black)


@pytest.mark.parametrize(
    ("settings", "facts"),
    [
        ({"per_picture": 3}, ["per_picture", 3, 8, 60, 2, 8333]),
        ({"pattern_us": 8000}, ["pattern_us", 8000, 8, 8333]),
        ({"pattern_us": 17_000}, ["pattern_us", 17000, 60, 0]),
        ({"bits": 7, "per_picture": 4}, ["per_picture", 4, 7, 3, 4500]),
        ({"led_currents": (0, 0, 0)}, ["led_currents", 0, "LED"]),
        ({"trigger_delays_us": (-21.0, 0.0, 0.0)}, ["trigger_delays_us", -21.0, -20, 2.7]),
        ({"trigger_delays_us": (0.0, 3.0, 0.0)}, ["trigger_delays_us", 3.0]),
    ],
)
def test_settings_that_do_not_fit_are_refused(settings, facts):
    with raises(InputError, *facts):
        PatternTiming(**settings)


def test_a_picture_holds_patterns_of_one_axis():
    timing = PatternTiming(7)
    pictures, places = timing.divide(SHORT)
    assert [(picture.axis, picture.rgb.shape) for picture in pictures] == [
        ("x", (912, 3)),
        ("x", (912, 3)),
        ("y", (1140, 3)),
        ("x", (912, 3)),
    ]
    # x x x | x white - | y y y | black
    assert places == (0, 1, 2, 3, 4, 6, 7, 8, 9)
    assert (pictures[1].rgb[:, 0] == 0xFE).all()  # red: seven bits of white
    with raises(InputError, "bits", "one bit"):
        PatternTiming(1).divide(SHORT)
    assert len(PatternTiming(1).divide(gray(SIZE))[0]) == 2


def test_the_commands_of_an_open_projector(world):
    timing = PatternTiming(7, None, None, 60.0, (10, 0, 255), (-10.0, 0.0, 2.68))
    rig, controller = simulated_lightcrafter(world, timing)
    with rig.opened():
        received = dict(controller.received)
        assert received[Command.LED_CURRENTS] == bytes([245, 255, 0])
        assert received[Command.TRIGGER_OUT_1] == bytes([0, 0xBB - 93, 0xBB])
        assert received[Command.TRIGGER_OUT_2] == bytes([0, 0xD4])
        assert received[Command.EXPOSURE] == (5478).to_bytes(4, "little") * 2
        assert received[Command.LUT_SIZE] == bytes([2, 1, 2, 0])
        # green three times, red and blue LEDs, black after the last
        assert received[Command.MAILBOX_DATA].hex(" ", 3) == "015700 035700 035702"
        assert (received[Command.POWER], received[Command.DISPLAY_MODE]) == (b"\0", b"\1")
        assert isinstance(rig.projector, LightCrafter4500) and rig.projector.notes == ()
    assert dict(controller.received)[Command.DISPLAY_MODE] == b"\0"  # a display again


@pytest.mark.computes
@pytest.mark.parametrize("bits", [8, 7])
def test_a_burst_has_the_frames_that_are_shown_one_by_one(world, bits):
    rig, _ = simulated_lightcrafter(world, PatternTiming(bits))
    assert can_burst(rig)
    done: list[tuple[int, int]] = []
    with rig.opened():
        single = capture_frames(replace(rig, bursts=False), SHORT)
        burst = capture_frames(rig, SHORT, progress=lambda *k: done.append(k))
        # noise of two frames, and of 7 bits their rounding
        difference = burst.astype(float) - single
        assert abs(difference.mean()) < 0.05
        assert 0.5 < difference.std() < 4
        assert done == [(0, 9), (9, 9)]
        again = capture_frames(replace(rig, bursts=False), SHORT)
        assert (again.astype(float) - single).std() < 4


@pytest.mark.computes
def test_a_burst_decodes_to_the_truth(world, lightcrafter):
    rig, _ = lightcrafter
    sequence = p18(SIZE)
    frames = capture_frames(rig, sequence)
    truth = world.renderer(preview=False).truth()
    for k, axis in enumerate(("x", "y")):
        phase = decode(sequence, frames, axis)
        both = phase.mask & truth.mask
        assert both.sum() > 0.95 * truth.mask.sum()
        columns = phase.phase[both] * 18.0 / (2 * np.pi)
        error_px = columns - truth.projector[..., k][both]
        assert 0.005 < np.median(np.abs(error_px)) < 0.1


@pytest.mark.computes
@pytest.mark.parametrize(
    ("fault", "facts"),
    [
        ("unplugged", ["LightCrafter 4500", "unplugged"]),
        ("invalid", ["refused", "exposure", "per_picture"]),
        ("frozen", ["frozen", "buffer"]),
        ("trigger lost", ["trigger", "exposure", 12, 14, 8.33]),
        ("repeated", ["refreshes", 14, 16]),
    ],
)
def test_faults_end_one_capture(lightcrafter, fault, facts):
    rig, controller = lightcrafter
    sequence = PatternSequence(SIZE, SHORT.frames[:9], relative=True)
    capture_frames(rig, sequence)
    controller.fault = fault
    with raises(DeviceError, *facts):
        capture_frames(rig, sequence)
    controller.fault = None
    if fault == "unplugged":
        rig.close()
        rig.open()
    assert capture_frames(rig, sequence).mean() > 10


@pytest.mark.parametrize("fault", ["unplugged", "in use"])
def test_a_projector_that_cannot_be_opened_is_closed(world, fault):
    rig, controller = simulated_lightcrafter(world, PatternTiming())
    controller.fault = fault
    with raises(DeviceError, "LightCrafter 4500", "other programs", "udev"):
        rig.open()
    controller.fault = None
    with rig.opened():
        rig.projector.show_level(100)


def test_a_frozen_buffer_ends_a_single_frame_too(lightcrafter):
    rig, controller = lightcrafter
    rig.projector.load(SHORT)
    rig.projector.show(0)
    controller.fault = "frozen"
    with raises(DeviceError, "frozen"):
        rig.projector.show(1)


@pytest.mark.computes
def test_the_preflight_times_both_modes_and_names_a_lost_trigger(lightcrafter):
    rig, controller = lightcrafter
    clock = SteppingClock(step_s=0.001).clock
    check = preflight(rig, clock=clock).check("burst")
    assert check.verdict == "good"
    # 25 patterns on 13 pictures, and two white ones
    assert check.figures["burst_s"] == pytest.approx(15 * 2 * 8.333e-3, abs=1e-3)
    assert check.figures["frames"] == 25 and check.figures["misplaced_frames"] == []
    assert not missing_facts(check.observation, 25, "0.25")
    controller.fault = "trigger lost"
    lost = preflight(rig, clock=clock).check("burst")
    assert lost.verdict == "bad" and not missing_facts(lost.observation, "trigger", 30)


@pytest.mark.computes
@pytest.mark.slow
def test_the_terminal_scans_verifies_and_merges_with_bursts(recorded, tmp_path, run):
    session = copy_session(recorded / "session", tmp_path / "session")
    rig = tmp_path / "rig.toml"
    rig.write_text('driver = "simulated"\nscale = 0.25\ndlpc350 = true\nthing = "sphere"\n')
    for name in ("ball_1", "ball_2"):
        assert run("capture", session, name, "--rig", rig, "--role", "scan")[0] == 0
        assert run("reconstruct", session, name)[0] == 0
    out = tmp_path / "out.json"
    assert run("verify", session, "ball_1", "--shape", "sphere", "--json", out)[0] == 0
    fit = json.loads(out.read_text())["verify"]["ball_1"]["models"]["splined"]
    assert fit["radius_mm"] == pytest.approx(98, abs=0.2) and 0.005 < fit["rms_mm"] < 0.1
    merge = ("merge", session, "ball_2", "--reference", "ball_1", "--start", "identity")
    status, _, error = run(*merge)
    assert status == 0, error


@pytest.mark.parametrize(
    ("settings", "seconds"), [((8,), 0.25), ((7,), 0.183), ((8, 1, 8333), 0.45)]
)
def test_a_burst_lasts_as_long_as_its_pictures(world, settings, seconds):
    rig, _ = simulated_lightcrafter(world, PatternTiming(*settings))
    assert isinstance(rig.projector, LightCrafter4500)
    with rig.opened():
        rig.projector.load(PatternSequence(SIZE, p18(SIZE).frames[:25]))
        assert rig.projector.prepare().seconds == pytest.approx(seconds, abs=1e-3)


def test_an_exposure_longer_than_a_pattern_is_refused(lightcrafter):
    rig, _ = lightcrafter
    rig.camera.apply(CameraSettings(exposure_ms=9.0))
    with raises(DeviceError, 9, 8.333, "exposure"):
        capture_frames(rig, SHORT)


def test_a_rig_file_chooses_the_driver_and_its_settings(monkeypatch):
    choice = {
        "camera": {"driver": "browser", "size": [64, 48]},
        "projector": {"driver": "lightcrafter4500", "bits": 7, "serial": "LCR3"},
    }
    check_choice(choice, "the rig")
    assert list_needed_pages(choice) == ("projector", "camera")
    monkeypatch.setattr(drivers_module, "find_spec", lambda name: None)
    with raises(DeviceError, "hid", "pip install 'slviewer[lightcrafter]'"):
        set_up(choice, None, pages=PageChannels())
    monkeypatch.setattr(drivers_module, "find_spec", lambda name: name)
    projector = set_up(choice, None, pages=PageChannels()).rig.projector
    assert isinstance(projector, LightCrafter4500) and projector.size == (912, 1140)
    for settings, facts in (
        ({"bits": 3}, ["bits", 3]),
        ({"size": [912, 1140]}, ["size", "per_picture", "serial"]),
        ({"led_currents": [1, 2, 256]}, ["led_currents", 256]),
    ):
        wrong = {**choice, "projector": {"driver": "lightcrafter4500", **settings}}
        with raises(InputError, "lightcrafter4500" if "size" in settings else "wrong", *facts):
            check_choice(wrong, "the rig")


def test_the_simulated_rig_is_chosen_by_an_option():
    bench = set_up({"driver": "simulated", "scale": 0.1, "dlpc350": True}, None)
    assert can_burst(bench.rig) and bench.world is not None
    assert profile(SHORT, 0)[1].shape == (912,)
