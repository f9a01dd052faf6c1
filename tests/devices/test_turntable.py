"""Turntables keep the protocol, and every fault ends the motion with its meaning and remedy."""

import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from gcode_controller import Controller, Fault

from slviewer.devices.browser import PageChannels
from slviewer.devices.grbl import ALARMS, ERRORS, GcodeTurntable
from slviewer.devices.protocols import Turntable
from slviewer.devices.simulated import SimulatedTurntable
from slviewer.devices.world import SimulatedWorld
from slviewer.errors import Cancelled, DeviceError, InputError, TurntableError
from slviewer.pipeline.rig_choice import set_up
from slviewer.pipeline.rig_presets import check_choice, load_rig
from slviewer.pipeline.turn import place_object
from slviewer.preflight.turntable import check_turntable
from slviewer.simulation.rig import letter

FAST: dict[str, Any] = {"speed_deg_s": 600.0, "settle_ms": 0.0, "boot_s": 2.0, "reply_s": 0.6}


@pytest.fixture(params=["simulated", "grbl", "marlin"])
def table(request: pytest.FixtureRequest) -> Iterator[Turntable]:
    if request.param == "simulated":
        yield SimulatedTurntable(SimulatedWorld(letter(0.05)))
        return
    with Controller(request.param) as controller:
        yield GcodeTurntable(controller.port, degrees_per_unit=2.0, limits_deg=[-1000, 1000], **FAST)


def test_a_turntable_turns_where_it_is_asked_to(table: Turntable) -> None:
    assert table.name
    table.close()  # harmless
    for use in (table.position_deg, lambda: table.turn_to(1.0)):
        with pytest.raises(DeviceError, match="not open"):
            use()
    table.open()
    with pytest.raises(DeviceError, match="open already"):
        table.open()
    assert table.position_deg() == pytest.approx(0.0, abs=0.05)
    for deg in (30.0, 390.0, -12.5):
        checked: list[int] = []
        table.turn_to(deg, lambda checked=checked: checked.append(1))
        assert checked and table.position_deg() == pytest.approx(deg, abs=0.01)
    with pytest.raises(InputError, match="1e"):
        table.turn_to(1e9)
    table.close()
    table.close()
    table.open()  # knows where it stands
    assert table.position_deg() == pytest.approx(-12.5, abs=0.01)
    assert check_turntable_closed(table).verdict == "good"


def check_turntable_closed(table: Turntable) -> Any:
    table.close()
    return check_turntable(table)


def test_a_cancelled_motion_stops(table: Turntable) -> None:
    class StopError(Cancelled):
        pass

    def stop() -> None:
        if time.monotonic() > end:
            raise StopError("stopped")

    table.open()
    end = time.monotonic() + (0.15 if isinstance(table, GcodeTurntable) else 0.0)
    with pytest.raises(StopError):
        table.turn_to(900.0, stop)
    reached = table.position_deg()
    time.sleep(0.1)
    assert 0.0 <= reached < 890.0 and table.position_deg() == reached


def broken(dialect: Any, fault: Fault) -> str:
    """The message of a fault in the middle of a turn of 60 degrees."""
    with Controller(dialect) as controller:
        table = GcodeTurntable(controller.port, **FAST)
        table.open()
        controller.fault = fault
        with pytest.raises(TurntableError) as raised:
            table.turn_to(60.0)
        if fault in ("stuck", "alarm"):  # it does not turn on unattended, and nothing unlocks it
            stop = "cancel" if dialect == "grbl" else "M410"
            deadline = time.monotonic() + 10.0  # the controller may read it after the driver has given up
            while stop not in controller.received and time.monotonic() < deadline:
                time.sleep(0.01)
            assert stop in controller.received
        assert not any("$X" in line for line in controller.received)
        table.close()
    return str(raised.value)


@pytest.mark.parametrize(
    ("fault", "facts"),
    [
        ("alarm", ("alarm 1", "limit switch", "$X")),
        ("error", ("error 15", "soft limits", "$20=0")),
        ("silent", ("did not confirm", "cable")),
        ("stuck", ("did not reach 60 degrees", "turns freely")),
        ("unplugged", ("unplugged", "plug it in")),
        ("reset", ("restarted", "power supply")),
        ("stops", ("stopped at", "instead of 60")),
    ],
)
def test_a_fault_of_grbl_is_named_with_its_remedy(fault: Fault, facts: tuple[str, ...]) -> None:
    message = broken("grbl", fault)
    assert all(fact in message for fact in facts), message


@pytest.mark.parametrize(
    ("fault", "fact"),
    [
        ("error", "Printer halted"),
        ("silent", "did not confirm"),
        ("stuck", "did not confirm"),
        ("unplugged", "unplugged"),
        ("reset", "restarted"),
        ("stops", "instead of 60"),
    ],
)
def test_a_fault_of_marlin_is_named(fault: Fault, fact: str) -> None:
    assert fact in broken("marlin", fault)


@pytest.mark.parametrize("dialect", ["grbl", "marlin"])
@pytest.mark.parametrize("fault", ["garbage", "slow"])
def test_noise_and_slowness_are_no_faults(dialect: Any, fault: Fault) -> None:
    with Controller(dialect) as controller:
        table = GcodeTurntable(controller.port, **FAST)
        table.open()
        controller.fault = fault
        table.turn_to(60.0)
        assert table.position_deg() == pytest.approx(60.0, abs=0.01)
        table.close()


@pytest.mark.parametrize(
    ("fault", "facts"),
    [
        ("locked", ("locked by an alarm", "$X")),
        ("paused", ("is paused", "feed hold")),
        ("other baud", ("unreadable", "115200")),
        ("silent", ()),
    ],
)
def test_a_controller_that_cannot_turn_is_not_opened(fault: Fault, facts: tuple[str, ...]) -> None:
    with Controller("grbl", fault) as controller:
        table = GcodeTurntable(controller.port, **FAST)
        if fault == "silent":
            controller.dialect = "marlin"
            table = GcodeTurntable(controller.port, dialect="grbl", **FAST)
            facts = ("does not answer as grbl", "dialect")
        with pytest.raises(TurntableError) as raised:
            table.open()
        assert all(fact in str(raised.value) for fact in facts), raised.value
        with pytest.raises(DeviceError, match="not open"):
            table.position_deg()
        check = check_turntable(table)
        assert check.verdict == "bad" and check.remedy


@pytest.mark.parametrize("dialect", ["grbl", "marlin"])
def test_a_controller_that_restarts_when_its_port_is_opened_is_waited_for(dialect: Any) -> None:
    with Controller(dialect, "boots") as controller:
        table = GcodeTurntable(controller.port, **FAST)
        table.open()
        table.turn_to(10.0)
        assert table.position_deg() == pytest.approx(10.0, abs=0.01)
        table.close()


def test_a_port_that_does_not_exist_is_named() -> None:
    with pytest.raises(TurntableError, match="/dev/no-such-port"):
        GcodeTurntable("/dev/no-such-port").open()


def test_every_alarm_and_error_has_a_remedy() -> None:
    assert set(ALARMS) == set(range(1, 10)) and 9 in ERRORS
    assert all(": " in text for text in (*ALARMS.values(), *ERRORS.values()))


@pytest.mark.parametrize(
    ("turntable", "fact"),
    [
        ({"driver": "grbl", "port": "COM3", "baud": 0}, "baud"),
        ({"driver": "grbl", "port": "COM3", "axis": "Q"}, "axis"),
        ({"driver": "grbl", "port": "COM3", "speed_deg_s": 0.0}, "speed_deg_s"),
        ({"driver": "grbl", "port": "COM3", "settle_ms": -1.0}, "settle_ms"),
        ({"driver": "grbl", "port": "COM3", "degrees_per_unit": float("nan")}, "degrees_per_unit"),
        ({"driver": "grbl"}, "port"),
        ({"driver": "grbl", "port": "COM3", "bauds": 1}, "bauds"),
        ({"driver": "simulated", "repeatability_deg": 99.0}, "repeatability_deg"),
        ({"driver": "opencv"}, "no turntable"),
        ({"port": "COM3"}, "driver"),
        ("grbl", "turntable"),
    ],
)
def test_settings_are_checked_before_anything_is_opened(turntable: Any, fact: str) -> None:
    with pytest.raises(InputError, match=fact):
        check_choice({"driver": "simulated", "turntable": turntable}, "my rig")


def test_impossible_settings_are_refused() -> None:
    make: Callable[..., Any] = GcodeTurntable
    for options in ({"degrees_per_unit": 0.0}, {"limits_deg": [90, -90]}, {"limits_deg": [1]}):
        with pytest.raises(InputError):
            make("COM3", **options)


def test_the_shipped_rig_has_a_turntable_with_something_to_see_on_it() -> None:
    bench = set_up(load_rig("turntable"), None)
    table, world = bench.rig.turntable, bench.world
    assert table is not None and world is not None and world.standing == "board"
    place_object(bench)
    assert world.standing == "stone"
    table.open()
    before = world.pose
    table.turn_to(90.0)
    assert 0 < abs(world.table_deg - 90.0) < 0.2
    table.turn_to(360.0)
    assert abs(world.pose.R - before.R).max() < 0.01
    camera, projector = {"driver": "opencv", "source": 0, "size": [64, 48]}, {"driver": "browser", "size": [9, 9]}
    with pytest.raises(InputError, match="simulated"):
        set_up(
            {"camera": camera, "projector": projector, "turntable": {"driver": "simulated"}}, None, pages=PageChannels()
        )
