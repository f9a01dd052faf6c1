"""An inspection plan as a TOML file: how a part is aligned, its features, and the characteristics
with their limits."""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from slviewer.errors import InputError
from slviewer.geometry.vectors import unit_vectors
from slviewer.inspection.features import MEANINGS, Feature
from slviewer.inspection.regions import Region
from slviewer.records.inspection import Characteristic
from slviewer.records.measurement import LEAST_AREA
from slviewer.records.record import Matrix4, Vector, from_plain, to_plain
from slviewer.session.atomic import replace_file
from slviewer.session.reading import read_toml
from slviewer.session.toml import table_lines

VERSION = 1
PLANS, OWN_PLAN = "plans", "exports/plan.toml"
"""Of a session: folder with the plans that were uploaded, and the plan that was made in it."""
SIZES = ("radius", "diameter")
FORMS = ("flatness", "roundness", "cylindricity")
TO_DATUM = ("parallelism", "perpendicularity")
RELATIONS = tuple(dict.fromkeys(meaning.name for each in MEANINGS.values() for meaning in each))
KINDS: dict[str, int] = {
    **dict.fromkeys((*SIZES, *FORMS, "position", "profile"), 1),
    **dict.fromkeys((*TO_DATUM, *RELATIONS), 2),
}
"""The number of features that each kind of characteristic takes; the second is the datum."""


@dataclass(frozen=True)
class PlanFeature:
    """A feature to fit: its ``kind`` in a ``region``; ``place``, ``direction`` and ``radius``:
    nominal, in part coordinates, for positions. A ``surface`` is compared with the nominal
    model. ``filled``: percent of the feature's area in the region, if it went on, that a whole part
    has."""

    name: str
    kind: Literal["plane", "sphere", "cylinder", "surface"]
    region: Region
    place: Vector | None = None
    direction: Vector | None = None
    radius: float | None = None
    filled: float | None = None

    def __post_init__(self) -> None:
        if self.filled is not None and not 0 < self.filled <= 100:
            raise ValueError(f"filled is {self.filled:g}: give 0 to 100, in percent")

    def nominal(self) -> Feature:
        """The nominal feature. Raises InputError where the plan does not give it."""
        lacks_direction = self.direction is None and self.kind != "sphere"
        if self.kind == "surface" or self.place is None or lacks_direction:
            raise InputError(
                f"The nominal of {self.name} is not known",
                "give place, direction and radius of the feature in the plan.",
            )
        direction = None if self.direction is None else unit_vectors(np.array(self.direction))
        return Feature(self.kind, np.array(self.place), direction, self.radius)


@dataclass(frozen=True)
class Alignment:
    """From scans to part coordinates: "none" (parts lie in a fixture), "best fit" to the
    ``nominal`` model, or "3-2-1" by three ``datums``, features' names, which are looked for from
    ``start``, T_part_scan (4, 4) of the plan's scan.
    """

    kind: Literal["none", "best fit", "3-2-1"] = "none"
    nominal: str | None = None
    datums: tuple[str, ...] = ()
    start: Matrix4 | None = None

    def __post_init__(self) -> None:
        if (self.kind == "best fit") != (self.nominal is not None):
            raise ValueError(
                "a best fit needs the file of its nominal model, and other alignments take none"
            )
        if (self.kind == "3-2-1") != (self.start is not None):
            raise ValueError(
                "3-2-1 needs the pose of the plan's own scan as start, and other alignments take"
                " none"
            )
        if len(self.datums) != (3 if self.kind == "3-2-1" else 0):
            raise ValueError("3-2-1 takes three datums, and other alignments take none")


@dataclass(frozen=True)
class Plan:
    """An inspection plan. ``min_area``: percent of a feature's area, of what the views can see of
    the nominal model, that has to be measured for a decision."""

    name: str
    feature: tuple[PlanFeature, ...]
    characteristic: tuple[Characteristic, ...]
    alignment: Alignment = field(default_factory=Alignment)
    version: int = VERSION
    min_area: float = LEAST_AREA

    def __post_init__(self) -> None:
        if self.version != VERSION:
            raise ValueError(
                f"the plan has version {self.version}, and this program reads {VERSION}"
            )
        if not 0 <= self.min_area <= 100:
            raise ValueError(f"min_area is {self.min_area:g}: give 0 to 100, in percent")
        for what, listed in (("feature", self.feature), ("characteristic", self.characteristic)):
            names = [each.name for each in listed]
            if not names or len(set(names)) < len(names):
                raise ValueError(
                    f"each {what} needs a name of its own, and there must be one:"
                    f" {', '.join(names)}"
                )
        for each in self.characteristic:
            if each.kind not in KINDS:
                raise ValueError(
                    f"there is no kind {each.kind!r}: choose one of {', '.join(KINDS)}"
                )
            if len(each.features) != KINDS[each.kind]:
                raise ValueError(
                    f"a {each.kind} takes {KINDS[each.kind]} features, not {len(each.features)}"
                )
        known = {each.name for each in self.feature}
        asked = {name for each in self.characteristic for name in each.features} | set(
            self.alignment.datums
        )
        if unknown := sorted(asked - known):
            raise ValueError(
                f"there is no feature {', '.join(unknown)}: there are {', '.join(sorted(known))}"
            )


def read_plan(path: Path | str) -> Plan:
    """The plan in a TOML file; a relative path of its nominal model refers to the file's folder.
    Raises InputError that names what does not fit."""
    data = read_toml(path)
    unknown = [key for key in data if key not in Plan.__dataclass_fields__]
    if unknown:
        raise InputError(
            f"{path}: a plan has no {', '.join(unknown)}", "remove it, or correct its name"
        )
    try:
        plan = from_plain(data, Plan)
    except InputError as error:
        raise InputError(
            f"{path} is not an inspection plan ({error})", "correct it there"
        ) from error
    if plan.alignment.nominal is None:
        return plan
    nominal = Path(path).expanduser().absolute().parent / plan.alignment.nominal
    return replace(plan, alignment=replace(plan.alignment, nominal=str(nominal)))


def list_plans(session: Path) -> tuple[str, ...]:
    """List the plans in a session's folder: paths in it, that of the plan made there first."""
    own = [OWN_PLAN] if (session / OWN_PLAN).is_file() else []
    return (*own, *sorted(f"{PLANS}/{each.name}" for each in (session / PLANS).glob("[!.]*.toml")))


def write_plan(plan: Plan, path: Path | str) -> None:
    """Write the plan as TOML."""
    replace_file(Path(path).expanduser().absolute(), plan_toml(plan).encode())


def plan_toml(plan: Plan) -> str:
    """The TOML text of a plan."""
    lines = [
        (
            "# Inspection plan of slviewer; lengths in mm, angles in degrees, places in part"
            " coordinates."
        ),
        "# Limits are absolute values; leave one out where there is none.",
        *table_lines({"version": plan.version, "name": plan.name, "min_area": plan.min_area}),
        "",
        "[alignment]",
        *table_lines(_entries(plan.alignment)),
    ]
    for title, listed in (("feature", plan.feature), ("characteristic", plan.characteristic)):
        for each in listed:
            lines += ["", f"[[{title}]]", *table_lines(_entries(each))]
    return "\n".join(lines) + "\n"


def _entries(record: Any) -> dict[str, Any]:
    """The fields of a record that hold something."""
    return {key: value for key, value in to_plain(record).items() if value not in (None, (), [])}
