"""An input of an operation is one field: terminal, Python and panels read what it declares."""

from collections.abc import Callable
from dataclasses import dataclass, fields
from types import SimpleNamespace
from typing import Annotated, Any

import pytest
from facts import raises

from slviewer.commands.command import read_command
from slviewer.errors import UsageError
from slviewer.gui.panel import Form
from slviewer.inputs import Input, check_inputs, find_inputs
from slviewer.pipeline.operation import OPERATIONS, takes_settings
from slviewer.pipeline.operations import OPERATIONS as ALL


@dataclass(frozen=True)
class Inherited:
    """Base.

    Args:
        gain: A factor.
    """

    gain: Annotated[float, Input(0, 4, label="Gain of the camera")] = 1.0


@dataclass(frozen=True)
class ProbeSettings(Inherited):
    """What is probed.

    Args:
        radius: Nominal radius, mm, over
            two lines.
        steps: How many.

    Python alone: ``title``.
    """

    radius: Annotated[float | None, Input(0.001, 1e6, "mm", step=0.1)] = None
    steps: Annotated[int, Input(2, 9)] = 3
    title: str = ""


@takes_settings(ProbeSettings)
def probe(settings: ProbeSettings) -> float:
    """Probe."""
    return settings.radius or 0.0


@pytest.mark.parametrize("radius", [0.0, -1.0, 1e7, float("nan"), float("inf")])
def test_python_holds_the_declared_range(radius: float) -> None:
    assert probe(radius=2.5) == 2.5 and probe() == 0
    with raises(UsageError, "radius is", "give a number from 0.001 to 1e+06 mm"):
        probe(radius=radius)


def test_each_of_several_numbers_is_checked() -> None:
    with raises(UsageError, "exposures is -3"):
        Input(1, 10).check("exposures", (5.0, -3.0))
    Input(1, 10).check("exposures", ())
    Input(1, 10).check("axis", "x")


class Panel:
    """Takes what a form asks for."""

    def __init__(self) -> None:
        self.built: list[tuple[Any, ...]] = []

    def number(self, *given: Any) -> SimpleNamespace:
        self.built.append(given)
        return SimpleNamespace(value=given[1])


def test_a_form_has_every_declared_field_and_no_other() -> None:
    panel = Panel()
    form = Form(panel, ProbeSettings)  # type: ignore[arg-type]
    assert panel.built == [
        ("Gain of the camera", 1.0, 0, 4, None, "A factor."),
        ("Radius, mm", 0.0, 0, 1e6, 0.1, "Nominal radius, mm, over two lines. 0: not given."),
        ("Steps", 3, 2, 9, None, "How many."),
    ]
    assert form.values() == {"gain": 1.0, "radius": None, "steps": 3}
    form["radius"].value, form["steps"].value = 2, 4.0
    entered = form.values()
    assert entered == {"gain": 1.0, "radius": 2.0, "steps": 4} and type(entered["steps"]) is int
    assert list(Form(panel, ProbeSettings, "steps").values()) == ["steps"]  # type: ignore[arg-type]


def test_help_states_the_declared_range() -> None:
    described = read_command("pipeline.reconstruct:verify", "captures").__doc__ or ""
    assert "(0.001 to 1e+06 mm)" in described


def test_what_operations_declare_fits_their_defaults() -> None:
    declared: Callable[[type], Any] = find_inputs
    assert ALL is OPERATIONS and "radius" in declared(OPERATIONS["verify"].settings)
    for each in OPERATIONS.values():
        for name, (field, limits) in declared(each.settings).items():
            limits.check(name, field.default)
            assert limits.low < limits.high and field in fields(each.settings)
    check_inputs(ProbeSettings())
