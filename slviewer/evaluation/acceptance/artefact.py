"""A ball bar, a sphere or a plane with its certificate, and what the operator asks of the
instrument."""

from collections.abc import Mapping
from dataclasses import dataclass
from math import hypot
from typing import Any, Literal

from slviewer.errors import InputError

Kind = Literal["ball-bar", "sphere", "plane"]
BALLS = {"ball-bar": 2, "sphere": 1, "plane": 0}
_KEYS = {
    "": {"kind", "name", "certificate", "calibrated", "measured", "limits"},
    "calibrated": {
        "temperature_C", "expansion_ppm_K", "expansion_U_ppm_K",
        "spacing_mm", "spacing_U_mm", "diameter_mm", "diameter_U_mm", "form_mm", "form_U_mm",
    },
    "measured": {"temperature_C", "temperature_U_K", "captures"},
    "limits": {"form_mm", "size_mm", "spacing_mm", "flatness_mm"},
}  # fmt: skip
_MOST = {"_mm": 1e5, "_ppm_K": 1e4, "_C": 1e3, "_K": 1e3}
"""The largest value that a certificate may state, by the end of its name."""


@dataclass(frozen=True)
class Length:
    """A calibrated length, mm, with its expanded uncertainty ``U_mm`` (k = 2)."""

    mm: float
    U_mm: float


@dataclass(frozen=True)
class Expansion:
    """Relative thermal expansion of the artefact, with its expanded uncertainty (k = 2)."""

    ppm_per_kelvin: float
    U_ppm_per_kelvin: float


@dataclass(frozen=True)
class Temperature:
    """The artefact's temperature while it was measured, with its expanded uncertainty (k = 2)."""

    celsius: float
    U_kelvin: float


@dataclass(frozen=True)
class Limits:
    """The operator's limits, mm; None: no decision."""

    form_mm: float | None = None
    size_mm: float | None = None
    spacing_mm: float | None = None
    flatness_mm: float | None = None


@dataclass(frozen=True)
class Artefact:
    """The content of an artefact's certificate, and how the test was made.

    ``spacing`` of a ball bar's centres; ``diameters``: one a ball; ``form``: how far its balls (or
    its plane) are from ideal ones, range, mm. All at ``reference_celsius``. ``positions``:
    {position: capture, or a pattern of captures}.
    """

    kind: Kind
    name: str
    certificate: str
    spacing: Length | None
    diameters: tuple[Length, ...]
    form: Length
    reference_celsius: float
    expansion: Expansion
    temperature: Temperature
    positions: Mapping[str, str]
    limits: Limits

    def at_measurement(self, length: Length) -> tuple[float, float]:
        """(mm, its standard uncertainty in mm) of a calibrated length at the temperature of the
        measurement."""
        warmer, ppm = self.temperature.celsius - self.reference_celsius, 1e-6 * length.mm
        parts = (
            length.U_mm / 2,
            ppm * self.expansion.U_ppm_per_kelvin / 2 * warmer,
            ppm * self.expansion.ppm_per_kelvin * self.temperature.U_kelvin / 2,
        )
        return length.mm + ppm * self.expansion.ppm_per_kelvin * warmer, hypot(*parts)

    @property
    def form_U_mm(self) -> float:
        """Expanded uncertainty (k = 2) that the artefact's own form brings into a range: 2
        sqrt((F/2)^2 + u(F)^2)."""
        return 2 * hypot(self.form.mm / 2, self.form.U_mm / 2)

    @classmethod
    def from_dict(cls, given: Mapping[str, Any]) -> "Artefact":
        """Return an artefact from the table of its file. Raises InputError for what is missing,
        unknown or impossible."""
        _check_keys(given)
        kind = given.get("kind")
        if kind not in tuple(BALLS):  # it may be of any type
            raise InputError(f"the artefact's kind is {kind!r}: use ball-bar, sphere or plane")
        calibrated, measured, limits = (
            given.get(table, {}) for table in ("calibrated", "measured", "limits")
        )
        spacing = None
        if kind == "ball-bar":
            spacing = Length(
                _number(calibrated, "spacing_mm"), _number(calibrated, "spacing_U_mm", least=0)
            )
        return cls(
            kind=kind,
            name=str(given.get("name", kind)),
            certificate=str(given.get("certificate", "none given")),
            spacing=spacing,
            diameters=_read_diameters(calibrated, BALLS[kind]),
            form=Length(
                _number(calibrated, "form_mm", 0.0, 0), _number(calibrated, "form_U_mm", 0.0, 0)
            ),
            reference_celsius=_number(calibrated, "temperature_C", 20.0, -50),
            expansion=Expansion(
                _number(calibrated, "expansion_ppm_K", least=-10),
                _number(calibrated, "expansion_U_ppm_K", least=0),
            ),
            temperature=Temperature(
                _number(measured, "temperature_C", least=-50),
                _number(measured, "temperature_U_K", least=0),
            ),
            positions=_read_positions(measured.get("captures")),
            limits=Limits(**{key: _number(limits, key) for key in limits}),
        )


def _check_keys(given: Mapping[str, Any]) -> None:
    """Raise InputError for a table of the artefact's file that is none, and for a key that is not
    in `_KEYS`."""
    for table, known in _KEYS.items():
        part = given if not table else given.get(table, {})
        if not isinstance(part, Mapping):
            raise InputError(
                f"the artefact's [{table}] must be a table: write [{table}] and its values below it"
            )
        if unknown := set(part) - known:
            raise InputError(
                "the artefact's file says"
                f" {sorted(unknown)[0]!r}{f' in [{table}]' if table else ''}, which is unknown: use"
                f" {', '.join(sorted(known))}"
            )


def _read_diameters(calibrated: Mapping[str, Any], balls: int) -> tuple[Length, ...]:
    """Return the diameter of each of so many balls, from one number or a list."""
    if not balls:
        return ()
    U = _number(calibrated, "diameter_U_mm", least=0)
    each = calibrated.get("diameter_mm")
    listed = each if isinstance(each, list) else [each] * balls
    if len(listed) != balls:
        raise InputError(f"{len(listed)} diameters are given for {balls}: give one a ball")
    return tuple(Length(_number({"diameter_mm": d}, "diameter_mm"), U) for d in listed)


def _read_positions(captures: object) -> dict[str, str]:
    """Return {position: capture} from a list of captures or a table."""
    if isinstance(captures, list):
        captures = {str(name): name for name in captures}  # any values: they are checked next
    if (
        not isinstance(captures, Mapping)
        or not captures
        or not all(isinstance(c, str) for c in captures.values())
    ):
        raise InputError(
            'the artefact\'s file names no captures: in [measured] write captures = ["bar_*"], or a'
            " table [measured.captures] of position = capture"
        )
    return {str(position): capture for position, capture in captures.items()}


def _number(
    table: Mapping[str, Any], key: str, otherwise: float | None = None, least: float | None = None
) -> float:
    """The number at ``key``, above 0 or at least ``least``, and at most what `_MOST` says of its
    unit."""
    value = table.get(key, otherwise)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError(
            f"the artefact's file says {key} = {value!r}: give a number, as its certificate does"
        )
    most = next(most for unit, most in _MOST.items() if key.endswith(unit))
    if not ((value > 0 if least is None else value >= least) and value <= most):
        raise InputError(
            f"the artefact's file says {key} = {value:g}, which is impossible: check unit and sign"
        )
    return float(value)
