"""Acceptance tests with a ball bar, a sphere or a plane: its certificate, the errors at each
position, their uncertainty, and whether they are allowed.

There are two kinds of ranges. Of *form* and *flatness* the error itself is a range: the narrowest
interval that holds 95 % (99.7 %) of the points' deviations from the fitted shape, so that a few
stray points do not decide. Of *size*, *spacing* and *scale* the error is one number, and its ranges
are where the true error lies with 95 % (99.7 %) probability, by the test's own uncertainty.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import permutations
from math import hypot
from typing import Any, Literal

import numpy as np
from scipy.special import stdtrit

from slviewer.errors import InputError
from slviewer.evaluation.fit import (
    ShapeResult,
    evaluate_plane,
    evaluate_spheres,
    finite_or_none,
    incidence,
)
from slviewer.geometry.vectors import unit_vectors
from slviewer.reconstruction.cloud import Cloud
from slviewer.records.acceptance import (
    AcceptanceTest,
    CertifiedArtefact,
    Decision,
    JudgedProperty,
    PositionErrors,
    PropertyError,
    ScaleError,
    StillCaptures,
    worst_decision,
)

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
K_95, K_997 = 1.96, 2.97
FORM, SIZE, SPACING, FLATNESS = (
    "probing error of form",
    "probing error of size",
    "sphere-spacing error",
    "flatness",
)
LIMITS = {FORM: "form_mm", SIZE: "size_mm", SPACING: "spacing_mm", FLATNESS: "flatness_mm"}
"""Names of the operator's limits, mm, in the file; without one there is no decision."""
POSITIONS = {"ball-bar": 7, "sphere": 7, "plane": 6}
CAPTURES, LEAST_CAPTURES = 10, 3
"""Of one still object, for the repeatability: how many are asked for, and how many it takes."""
OUTSIDE = 50.0
"""Percent of an artefact's points in R1 (R3) from which on it stands there."""


@dataclass(frozen=True)
class CertifiedValue:
    """A value of a certificate with its expanded uncertainty ``U`` (k = 2): a length in mm, the
    thermal expansion in ppm/K, the temperature in degrees Celsius (and K)."""

    value: float
    U: float


@dataclass(frozen=True)
class Artefact:
    """The content of an artefact's certificate, and how the test was made.

    ``spacing`` of a ball bar's centres; ``diameters``: one a ball; ``form``: how far its balls (or
    its plane) are from ideal ones, range, mm. All at ``reference_celsius``. ``positions``:
    {position: capture, or a pattern of captures}. ``limits``, mm, by the names in `LIMITS`.
    """

    kind: Kind
    name: str
    certificate: str
    spacing: CertifiedValue | None
    diameters: tuple[CertifiedValue, ...]
    form: CertifiedValue
    reference_celsius: float
    expansion: CertifiedValue
    temperature: CertifiedValue
    positions: Mapping[str, str]
    limits: Mapping[str, float]

    def at_measurement(self, length: CertifiedValue) -> tuple[float, float]:
        """(mm, its standard uncertainty in mm) of a calibrated length at the temperature of the
        measurement."""
        warmer, ppm = self.temperature.value - self.reference_celsius, 1e-6 * length.value
        parts = (
            length.U / 2,
            ppm * self.expansion.U / 2 * warmer,
            ppm * self.expansion.value * self.temperature.U / 2,
        )
        return length.value + ppm * self.expansion.value * warmer, hypot(*parts)

    @property
    def form_U_mm(self) -> float:
        """Expanded uncertainty (k = 2) that the artefact's own form brings into a range: 2
        sqrt((F/2)^2 + u(F)^2)."""
        return 2 * hypot(self.form.value / 2, self.form.U / 2)

    @classmethod
    def from_dict(cls, given: Mapping[str, Any]) -> "Artefact":
        """Return an artefact from the table of its file. Raises InputError for what is missing,
        unknown or impossible."""
        for table, known in _KEYS.items():
            part = given if not table else given.get(table, {})
            if not isinstance(part, Mapping):
                raise InputError(
                    f"the artefact's [{table}] must be a table: write [{table}] and its values"
                    " below it"
                )
            if unknown := set(part) - known:
                place = f" in [{table}]" if table else ""
                raise InputError(
                    f"the artefact's file says {min(unknown)!r}{place}, which is unknown: use"
                    f" {', '.join(sorted(known))}"
                )
        kind = given.get("kind")
        if kind not in tuple(BALLS):  # it may be of any type
            raise InputError(f"the artefact's kind is {kind!r}: use ball-bar, sphere or plane")
        calibrated, measured, limits = (
            given.get(table, {}) for table in ("calibrated", "measured", "limits")
        )
        return cls(
            kind=kind,
            name=str(given.get("name", kind)),
            certificate=str(given.get("certificate", "none given")),
            spacing=_read_value(calibrated, "spacing") if kind == "ball-bar" else None,
            diameters=_read_diameters(calibrated, BALLS[kind]),
            form=_read_value(calibrated, "form", least=0, otherwise=0.0),
            reference_celsius=_number(calibrated, "temperature_C", 20.0, -50),
            expansion=_read_value(calibrated, "expansion", "ppm_K", least=-10),
            temperature=CertifiedValue(
                _number(measured, "temperature_C", least=-50),
                _number(measured, "temperature_U_K", least=0),
            ),
            positions=_read_positions(measured.get("captures")),
            limits={key: _number(limits, key) for key in limits},
        )


def _read_value(
    table: Mapping[str, Any],
    name: str,
    unit: str = "mm",
    least: float | None = None,
    otherwise: float | None = None,
) -> CertifiedValue:
    """The value ``name`` in a unit, above 0 or at least ``least``, and its uncertainty."""
    return CertifiedValue(
        _number(table, f"{name}_{unit}", otherwise, least),
        _number(table, f"{name}_U_{unit}", otherwise, 0),
    )


def _read_diameters(calibrated: Mapping[str, Any], balls: int) -> tuple[CertifiedValue, ...]:
    """Return the diameter of each of so many balls, from one number or a list."""
    if not balls:
        return ()
    U = _number(calibrated, "diameter_U_mm", least=0)
    each = calibrated.get("diameter_mm")
    listed = each if isinstance(each, list) else [each] * balls
    if len(listed) != balls:
        raise InputError(f"{len(listed)} diameters are given for {balls}: give one a ball")
    return tuple(CertifiedValue(_number({"diameter_mm": d}, "diameter_mm"), U) for d in listed)


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


def narrowest_range(deviations: np.ndarray, share: float) -> float:
    """Width of the narrowest interval that holds so great a share of the deviations (n,)."""
    values = np.sort(deviations[np.isfinite(deviations)])
    inside = max(int(np.ceil(share * len(values))), 1)
    return float((values[inside - 1 :] - values[: len(values) - inside + 1]).min())


def make_form_error(name: str, position: str, deviations: np.ndarray, U_mm: float) -> PropertyError:
    """Return the error of form from points' deviations (n,) mm from their shape."""
    inner, outer = narrowest_range(deviations, 0.95), narrowest_range(deviations, 0.997)
    return PropertyError(name, position, inner, U_mm, (0.0, inner), (0.0, outer))


def make_length_error(name: str, position: str, error_mm: float, u_mm: float) -> PropertyError:
    """Return the error of a length with its standard uncertainty."""
    inner, outer = ((error_mm - k * u_mm, error_mm + k * u_mm) for k in (K_95, K_997))
    return PropertyError(name, position, error_mm, 2 * u_mm, inner, outer)


def decide(figures: Sequence[PropertyError], limit_mm: float) -> Decision:
    """Decide with a guard band: fail if any error exceeds the limit by more than U, pass if error +
    U never does."""
    if any(abs(figure.error_mm) - figure.U_mm > limit_mm for figure in figures):
        return "fail"
    is_within = all(abs(figure.error_mm) + figure.U_mm <= limit_mm for figure in figures)
    return "pass" if is_within else "undecided"


def measure_artefact(
    artefact: Artefact,
    cloud: Cloud,
    position: str,
    capture: str,
    depth_range: tuple[float, float] | None = None,
    plate: np.ndarray | None = None,
) -> PositionErrors:
    """Measure the figures of one position. ``plate`` (h, w) bool: the plane's pixels, if these are
    known.

    Raises InputError where the artefact is not found in the cloud.
    """
    if artefact.kind == "plane":
        shown = [evaluate_plane(cloud.points, plate, cloud.sigma_z)]
        figures = [make_form_error(FLATNESS, position, shown[0].error_map, artefact.form_U_mm)]
        noise = 0.0
    else:
        nominal = float(np.mean([diameter.value for diameter in artefact.diameters])) / 2
        shown = evaluate_spheres(cloud.points, len(artefact.diameters), cloud.sigma_z, nominal)
        figures, noise = _measure_balls(artefact, cloud, shown, position)
    region = np.logical_or.reduce([np.isfinite(result.error_map) for result in shown])
    return PositionErrors(
        position=position,
        capture=capture,
        figures=figures,
        rms_mm=[result.rms_mm for result in shown],
        floor_mm=[finite_or_none(result.noise_floor_mm) for result in shown],
        points=int(np.count_nonzero(region)),
        noise_mm=noise,
        incidence=None if depth_range is None else incidence(cloud.points, region, depth_range),
        warnings=[result.warning for result in shown if result.warning],
    )


def _measure_balls(
    artefact: Artefact, cloud: Cloud, balls: list[ShapeResult], position: str
) -> tuple[list[PropertyError], float]:
    """The figures of one ball or two, and the noise of a length between their centres (of a
    diameter, for one)."""
    # the certificate's order says nothing of left and right: the balls' own sizes do
    sizes = np.array([2 * ball.radius_mm for ball in balls])
    known = min(
        permutations(artefact.at_measurement(diameter) for diameter in artefact.diameters),
        key=lambda order: float(np.abs(sizes - [mm for mm, _ in order]).sum()),
    )
    spreads = [_fit_covariance(cloud.points, ball) for ball in balls]
    figures = []
    for ball, (diameter, u), spread in zip(balls, known, spreads, strict=True):
        figures.append(make_form_error(FORM, position, ball.error_map, artefact.form_U_mm))
        u_size = float(np.hypot(u, 2 * np.sqrt(spread[3, 3])))
        figures.append(make_length_error(SIZE, position, 2 * ball.radius_mm - diameter, u_size))
    if artefact.spacing is None:
        return figures, float(2 * np.sqrt(spreads[0][3, 3]))
    between = balls[1].sphere.centre - balls[0].sphere.centre
    length = float(np.linalg.norm(between))
    along = between / length
    noise = float(np.sqrt(sum(along @ spread[:3, :3] @ along for spread in spreads)))
    true, u = artefact.at_measurement(artefact.spacing)
    figures.append(make_length_error(SPACING, position, length - true, float(np.hypot(u, noise))))
    return figures, noise


def _fit_covariance(points: np.ndarray, ball: ShapeResult) -> np.ndarray:
    """(4, 4) mm^2 of centre and radius, from the scatter of the points about the sphere."""
    offsets = points[ball.inliers].astype(np.float64) - ball.sphere.centre
    J = np.column_stack([unit_vectors(offsets), np.ones(len(offsets))])
    return ball.rms_mm**2 * np.linalg.inv(J.T @ J)


def conclude_test(
    artefact: Artefact, model: str, positions: Sequence[PositionErrors]
) -> AcceptanceTest:
    """Return the record of a test with one artefact and one calibration ("model") from its
    positions. Raises InputError where there is none."""
    if not positions:
        raise InputError(
            f"no capture shows {artefact.name}: name some in [measured] captures of its file"
        )
    figures = [figure for position in positions for figure in position.figures]
    judgements = list[JudgedProperty]()
    for name, key in LIMITS.items():
        limit_mm = artefact.limits.get(key)
        if mine := [figure for figure in figures if figure.property == name]:
            worst = max(mine, key=lambda figure: abs(figure.error_mm) + figure.U_mm)
            decision = None if limit_mm is None else decide(mine, limit_mm)
            judgements.append(JudgedProperty(name, worst, limit_mm, decision))
    decisions = {each.decision for each in judgements if each.decision is not None}
    return AcceptanceTest(
        artefact=CertifiedArtefact(artefact.name, artefact.certificate, artefact.kind),
        model=model,
        positions=list(positions),
        judgements=judgements,
        scale=_estimate_scale(artefact, positions),
        decision=worst_decision(decisions) if decisions else None,
        lacks=list(_list_gaps(artefact, positions)),
    )


def _list_gaps(artefact: Artefact, positions: Sequence[PositionErrors]) -> Iterator[str]:
    """Yield what the positions do not test."""
    needed = POSITIONS[artefact.kind]
    if len(positions) < needed:
        yield f"{len(positions)} of {needed} positions were measured"
    shares = [position.incidence for position in positions if position.incidence]
    for part in ("R1", "R3") if shares else ():
        if not any(share[part] >= OUTSIDE for share in shares):
            yield f"no position lies in {part}: what is measured there is untested"


def _estimate_scale(artefact: Artefact, positions: Sequence[PositionErrors]) -> ScaleError | None:
    """Estimate the scale by the spacing of a ball bar's centres, by a sphere's diameter; None for a
    plane."""
    if artefact.kind == "plane":
        return None
    mm, u_shared = artefact.at_measurement(artefact.spacing or artefact.diameters[0])
    name = SIZE if artefact.spacing is None else SPACING
    errors = np.array(
        [f.error_mm for position in positions for f in position.figures if f.property == name]
    )
    n = len(errors)
    per_deviation = stdtrit(n - 1, 0.975) / K_95 / np.sqrt(n)
    u_mean = float(errors.std(ddof=1) * per_deviation) if n > 1 else positions[0].noise_mm
    return ScaleError(
        1e6 * float(errors.mean()) / mm, 1e6 * float(np.hypot(u_mean, u_shared)) / mm, mm, n
    )


def repeatability(measured: Iterable[tuple[np.ndarray, np.ndarray]]) -> StillCaptures:
    """Repeatability of captures given as (z, sigma_z), each (h, w) mm, NaN where invalid.

    Raises InputError for fewer than three captures, captures of different size, and for no pixel
    that all measured.
    """
    pairs = [(np.asarray(z, np.float32), np.asarray(sigma, np.float32)) for z, sigma in measured]
    count, shapes = len(pairs), {z.shape for z, _ in pairs}
    if len(shapes) > 1:
        raise InputError(
            f"captures of {' and '.join(map(str, shapes))} pixels do not repeat each other"
        )
    if count < LEAST_CAPTURES:
        raise InputError(
            f"{count} captures show no repeatability: take {CAPTURES} of the same still object"
        )
    depths, noise = (np.stack(maps) for maps in zip(*pairs, strict=True))
    depths -= depths[0].copy()  # small, so that squares keep their digits
    sigma = depths.std(axis=0, ddof=1)
    always = np.isfinite(sigma)
    if not always.any():
        raise InputError(
            "no pixel was measured in every capture: leave the object where it is, and in view"
        )
    levels = depths[:, always].mean(axis=1, dtype=np.float64)
    return StillCaptures(
        count,
        int(np.count_nonzero(always)),
        float(np.median(sigma[always])),
        float(np.percentile(sigma[always], 95)),
        float(np.nanmedian(np.sqrt((noise[:, always] ** 2).mean(axis=0)))),
        float(np.ptp(levels)),
    )
