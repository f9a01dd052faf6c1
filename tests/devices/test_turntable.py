"""Turntables keep the protocol, and every fault ends the motion with its meaning and remedy."""

from collections.abc import Callable, Iterator
from typing import Any

import pytest
from clocks import until
from facts import missing_facts, raises
from gcode_controller import Controller, Fault

from slviewer.devices.browser import PageChannels
from slviewer.devices.grbl import ALARMS, ERRORS, ControllerTiming, GcodeTurntable
from slviewer.devices.protocols import Turntable
from slviewer.devices.simulated import SimulatedTurntable
from slviewer.devices.world import SimulatedWorld
from slviewer.errors import Cancelled, DeviceError, InputError, TurntableError
from slviewer.pipeline.rig_choice import check_choice, load_rig, place_object, set_up
from slviewer.preflight.turntable import check_turning
from slviewer.simulation.rig import letter

FAST: dict[str, Any] = {"speed_deg_s": 6000.0, "settle_ms": 0.0, "boot_s": 60.0, "reply_s": 60.0}


def timing(controller: Controller) -> ControllerTiming:
    """Waits for a controller that answers each line at once, in its own time."""
    return ControllerTiming(poll_s=0.01, quiet_s=0.05, clock=controller.clock)


@pytest.fixture(params=["simulated", "grbl", "marlin"])
def controller(request: pytest.FixtureRequest) -> Iterator[Controller | None]:
    """The controller of a turntable; None for the simulated one, which has none."""
    if request.param == "simulated":
        yield None
        return
    with Controller(request.param) as controller:
        yield controller


@pytest.fixture
def table(controller: Controller | None) -> Turntable:
    return make_table(controller)


def make_table(controller: Controller | None, **options: Any) -> Turntable:
    if controller is None:
        return SimulatedTurntable(SimulatedWorld(letter(0.05)))
    return GcodeTurntable(
        controller.port,
        degrees_per_unit=2.0,
        limits_deg=[-1000, 1000],
        timing=timing(controller),
        **(FAST | options),
    )


def test_a_turntable_turns_where_it_is_asked_to(table: Turntable) -> None:
    assert table.name
    table.close()  # harmless
    for use in (table.position_deg, lambda: table.turn_to(1.0)):
        with raises(DeviceError, "not open"):
            use()
    table.open()
    with raises(DeviceError, "open already"):
        table.open()
    assert table.position_deg() == pytest.approx(0.0, abs=0.05)
    for deg in (30.0, 390.0, -12.5):
        checked: list[int] = []
        table.turn_to(deg, lambda checked=checked: checked.append(1))
        assert checked and table.position_deg() == pytest.approx(deg, abs=0.01)
    with raises(InputError, "1e+09"):
        table.turn_to(1e9)
    table.close()
    table.close()
    table.open()  # knows where it stands
    assert table.position_deg() == pytest.approx(-12.5, abs=0.01)
    assert check_turntable_closed(table).verdict == "good"


def check_turntable_closed(table: Turntable) -> Any:
    table.close()
    return check_turning(table)


def test_a_cancelled_motion_stops(controller: Controller | None) -> None:
    class StopError(Cancelled):
        pass

    def stop() -> None:
        if controller is None or controller.position > 1.0:
            raise StopError("stopped")

    table = make_table(controller, speed_deg_s=20.0)
    table.open()
    with pytest.raises(StopError):
        table.turn_to(900.0, stop)
    reached = table.position_deg()
    assert 0.0 <= reached < 890.0 and table.position_deg() == reached
    assert controller is None or (not controller.is_moving and reached > 1.0)


def broken(dialect: Any, fault: Fault) -> str:
    """The message of a fault in the middle of a turn of 60 degrees."""
    with Controller(dialect) as controller:
        table = GcodeTurntable(controller.port, timing=timing(controller), **FAST)
        table.open()
        controller.fault = fault

        def give_up() -> None:
            if controller.is_stuck:
                controller.skip(1000.0)

        with pytest.raises(TurntableError) as raised:
            table.turn_to(60.0, give_up)
        if fault in ("stuck", "alarm"):  # it does not turn on unattended, and nothing unlocks it
            stop = "cancel" if dialect == "grbl" else "M410"
            # perhaps after the driver has given up
            assert until(lambda: stop in controller.received)
        assert not any("$X" in line for line in controller.received)
        table.close()
    return str(raised.value)


@pytest.mark.parametrize(
    ("fault", "facts"),
    [
        ("alarm", ("alarm 1", "limit switch", "$X")),
        ("error", ("error 15", "soft limits", "$20=0")),
        ("silent", ("confirm", "$J=G91", "cable")),
        ("stuck", ("reach", "60 degrees", "freely")),
        ("unplugged", ("unplugged", "plug")),
        ("reset", ("restarted", "power supply")),
        ("stops", ("stopped", "60 degrees")),
    ],
)
def test_a_fault_of_grbl_is_named_with_its_remedy(fault: Fault, facts: tuple[str, ...]) -> None:
    message = broken("grbl", fault)
    assert not missing_facts(message, *facts), message


@pytest.mark.parametrize(
    ("fault", "facts"),
    [
        ("error", ("Printer halted",)),
        ("silent", ("confirm", "G1")),
        ("stuck", ("confirm", "M400")),
        ("unplugged", ("unplugged",)),
        ("reset", ("restarted",)),
        ("stops", ("stopped", "60 degrees")),
    ],
)
def test_a_fault_of_marlin_is_named(fault: Fault, facts: tuple[str, ...]) -> None:
    message = broken("marlin", fault)
    assert not missing_facts(message, *facts), message


@pytest.mark.parametrize("dialect", ["grbl", "marlin"])
@pytest.mark.parametrize("fault", ["garbage", "slow"])
def test_noise_and_slowness_are_no_faults(dialect: Any, fault: Fault) -> None:
    with Controller(dialect) as controller:
        table = GcodeTurntable(controller.port, timing=timing(controller), **FAST)
        table.open()
        controller.fault = fault
        table.turn_to(60.0)
        assert table.position_deg() == pytest.approx(60.0, abs=0.01)
        table.close()


@pytest.mark.parametrize(
    ("fault", "facts"),
    [
        ("locked", ("locked", "alarm", "$X")),
        ("paused", ("paused", "feed hold")),
        ("other baud", ("unreadable", "115200", "baud")),
        ("silent", ()),
    ],
)
def test_a_controller_that_cannot_turn_is_not_opened(fault: Fault, facts: tuple[str, ...]) -> None:
    with Controller("grbl", fault) as controller:
        dialect: Any = "auto"
        if fault == "silent":
            controller.dialect, dialect = "marlin", "grbl"
            facts = ("grbl", "dialect", "60 s")
        table = GcodeTurntable(controller.port, dialect=dialect, timing=timing(controller), **FAST)
        with raises(TurntableError, *facts):
            table.open()
        with raises(DeviceError, "not open"):
            table.position_deg()
        check = check_turning(table)
        assert check.verdict == "bad" and check.remedy


@pytest.mark.parametrize("dialect", ["grbl", "marlin"])
def test_a_controller_that_restarts_when_its_port_is_opened_is_waited_for(dialect: Any) -> None:
    with Controller(dialect, "boots") as controller:
        table = GcodeTurntable(controller.port, timing=timing(controller), **FAST)
        table.open()
        table.turn_to(10.0)
        assert table.position_deg() == pytest.approx(10.0, abs=0.01)
        table.close()


def test_a_port_that_does_not_exist_is_named() -> None:
    with raises(TurntableError, "/dev/no-such-port"):
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
        ({"driver": "opencv"}, "opencv"),
        ({"driver": "grbl", "port": "COM3", "timing": 1}, "timing"),
        ({"port": "COM3"}, "driver"),
        ("grbl", "turntable"),
    ],
)
def test_settings_are_checked_before_anything_is_opened(turntable: Any, fact: str) -> None:
    with raises(InputError, fact, "turntable"):
        check_choice({"driver": "simulated", "turntable": turntable}, "my rig")


def test_impossible_settings_are_refused() -> None:
    make: Callable[..., Any] = GcodeTurntable
    for options in ({"degrees_per_unit": 0.0}, {"limits_deg": [90, -90]}, {"limits_deg": [1]}):
        with pytest.raises(InputError):
            make("COM3", **options)


@pytest.mark.computes
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
    camera, projector = (
        {"driver": "opencv", "source": 0, "size": [64, 48]},
        {
            "driver": "browser",
            "size": [9, 9],
        },
    )
    with raises(InputError, "simulated"):
        set_up(
            {"camera": camera, "projector": projector, "turntable": {"driver": "simulated"}},
            None,
            pages=PageChannels(),
        )
