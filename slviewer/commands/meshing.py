"""How to mesh, as arguments of `slviewer mesh` and `slviewer export`."""

from collections.abc import Callable
from typing import Any, Literal

from slviewer.commands.command import Option, show_result

MESHING = (
    Option(
        "method",
        Literal["grid", "poisson", "volume"] | None,
        None,
        "Of a mesh: grid joins the pixels of one scan; poisson fits one surface to all points;"
        " volume averages them in small cells. By default grid for one scan and poisson for merged"
        " ones.",
    ),
    Option(
        "fill_holes",
        float | None,
        None,
        "Of a mesh: fill holes of up to so many mm across; by default a few spacings of the"
        " points.",
    ),
    Option("triangles", int | None, None, "Of a mesh: thin it to so many triangles."),
    Option(
        "smooth",
        int,
        0,
        "Of a mesh: rounds of smoothing, 0 for none; how far it moved the surface is reported.",
    ),
    Option(
        "watertight",
        bool,
        False,
        "Of a mesh: close the surface, or report why it cannot be closed. A gap that no scan shows,"
        " such as the foot that an object stands on, is closed flat, and reported.",
    ),
)
"""The fields of `MeshingPlan`, in their order."""


def run_meshing(function: Callable[..., Any], arguments: dict[str, Any]) -> None:
    """Call a function that takes a `MeshingPlan`, and show what it returns."""
    from slviewer.surface.meshing import MeshingPlan

    plan = MeshingPlan(*(arguments.pop(option.name) for option in MESHING))
    show_result(function, {**arguments, "plan": plan})
