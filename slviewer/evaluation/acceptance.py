"""Acceptance tests with a ball bar, a sphere or a plane: its certificate, the errors at each
position, their uncertainty, and whether they are allowed.

There are two kinds of ranges. Of *form* and *flatness* the error itself is a range: the narrowest
interval that holds 95 % (99.7 %) of the points' deviations from the fitted shape, so that a few
stray points do not decide. Of *size*, *spacing* and *scale* the error is one number, and its ranges
are where the true error lies with 95 % (99.7 %) probability, by the test's own uncertainty.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, permutations
from math import dist, hypot
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from scipy.special import stdtrit

from slviewer.errors import InputError
from slviewer.evaluation.artefact_evidence import collect_evidence
from slviewer.evaluation.fit import (
    ShapeResult,
    evaluate_plane,
    evaluate_spheres,
    finite_or_none,
    incidence,
)
from slviewer.geometry.shapes import Sphere
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
    SurfaceEvidence,
    worst_decision,
)
from slviewer.records.record import from_plain, to_vector

Kind = Literal["ball-bar", "sphere", "plane"]
BALLS = {"ball-bar": 2, "sphere": 1, "plane": 0}
K_95, K_997 = 1.96, 2.97
FORM = "probing error of form"
SIZE = "probing error of size"
SPACING = "sphere-spacing error"
FLATNESS = "flatness"
LIMITS = {FORM: "form_mm", SIZE: "size_mm", SPACING: "spacing_mm", FLATNESS: "flatness_mm"}
"""Names of the operator's limits, mm, in the file; without one there is no decision."""
POSITIONS = {"ball-bar": 7, "sphere": 7, "plane": 6}
CAPTURES, LEAST_CAPTURES = 10, 3
"""Of one still object, for the repeatability: how many are asked for, and how many it takes."""
OUTSIDE = 50.0
"""Percent of an artefact's points in R1 (R3) from which on it stands there."""


@dataclass(frozen=True)
class CertifiedValue:
    """A length of a certificate with its expanded uncertainty ``U`` (k = 2), mm."""

    value: float
    U: float


_Length = Annotated[float, msgspec.Meta(gt=0, le=1e5)]
_Spread = Annotated[float, msgspec.Meta(ge=0, le=1e5)]
_Celsius = Annotated[float, msgspec.Meta(ge=-50, le=1e3)]


class Calibrated(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The values of a certificate with their expanded uncertainties ``U`` (k = 2): the ``spacing``
    of a ball bar's centres, one ``diameter`` or one a ball, and ``form``: how far its balls (or its
    plane) are from ideal ones, range. All at ``temperature_C``."""

    expansion_ppm_K: Annotated[float, msgspec.Meta(ge=-10, le=1e4)]  # noqa: N815
    expansion_U_ppm_K: Annotated[float, msgspec.Meta(ge=0, le=1e4)]  # noqa: N815
    temperature_C: _Celsius = 20.0  # noqa: N815
    spacing_mm: _Length | None = None
    spacing_U_mm: _Spread | None = None  # noqa: N815
    diameter_mm: _Length | list[_Length] | None = None
    diameter_U_mm: _Spread | None = None  # noqa: N815
    form_mm: _Spread = 0.0
    form_U_mm: _Spread = 0.0  # noqa: N815


class Measured(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How the test was made: the artefact's temperature, and the captures or patterns of them, by
    the names of the positions where these are others."""

    temperature_C: _Celsius  # noqa: N815
    temperature_U_K: Annotated[float, msgspec.Meta(ge=0, le=1e3)]  # noqa: N815
    captures: list[str] | dict[str, str]


class Limits(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The operator's limits; None: no decision."""

    form_mm: _Length | None = None
    size_mm: _Length | None = None
    spacing_mm: _Length | None = None
    flatness_mm: _Length | None = None


class Artefact(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The content of an artefact's certificate, and how the test was made."""

    kind: Kind
    calibrated: Calibrated
    measured: Measured
    name: str = ""
    certificate: str = "none given"
    limits: Limits = Limits()

    def __post_init__(self) -> None:
        msgspec.structs.force_setattr(self, "name", self.name or self.kind)
        values, balls = self.calibrated, BALLS[self.kind]
        needed = ["spacing_mm", "spacing_U_mm"] if balls == 2 else []
        needed += ["diameter_mm", "diameter_U_mm"] if balls else []
        if missing := [key for key in needed if getattr(values, key) is None]:
            raise ValueError(f"a {self.kind} lacks {missing[0]}: give what its certificate states")
        if balls and isinstance(values.diameter_mm, list) and len(values.diameter_mm) != balls:
            raise ValueError(
                f"{len(values.diameter_mm)} diameters are given for {balls}: give one a ball"
            )
        if not self.measured.captures:
            raise ValueError(
                'it names no captures: in [measured] write captures = ["bar_*"], or a table'
                " [measured.captures] of position = capture"
            )

    @property
    def positions(self) -> dict[str, str]:
        """Return {position: capture, or a pattern of captures}."""
        captures = self.measured.captures
        return captures if isinstance(captures, dict) else {name: name for name in captures}

    @property
    def spacing(self) -> CertifiedValue | None:
        """Return the spacing of a ball bar's centres; None for other artefacts."""
        values = self.calibrated
        if BALLS[self.kind] < 2 or values.spacing_mm is None:
            return None
        return CertifiedValue(values.spacing_mm, values.spacing_U_mm or 0.0)

    @property
    def diameters(self) -> tuple[CertifiedValue, ...]:
        """Return the diameter of each ball."""
        values, balls = self.calibrated, BALLS[self.kind]
        each = values.diameter_mm or []
        listed = each if isinstance(each, list) else [each] * balls
        return tuple(CertifiedValue(mm, values.diameter_U_mm or 0.0) for mm in listed[:balls])

    def at_measurement(self, length: CertifiedValue) -> tuple[float, float]:
        """(mm, its standard uncertainty in mm) of a calibrated length at the temperature of the
        measurement."""
        values, test, ppm = self.calibrated, self.measured, 1e-6 * length.value
        warmer = test.temperature_C - values.temperature_C
        parts = (
            length.U / 2,
            ppm * values.expansion_U_ppm_K / 2 * warmer,
            ppm * values.expansion_ppm_K * test.temperature_U_K / 2,
        )
        return length.value + ppm * values.expansion_ppm_K * warmer, hypot(*parts)

    @property
    def form_U_mm(self) -> float:
        """Expanded uncertainty (k = 2) that the artefact's own form brings into a range: 2
        sqrt((F/2)^2 + u(F)^2)."""
        return 2 * hypot(self.calibrated.form_mm / 2, self.calibrated.form_U_mm / 2)

    @classmethod
    def from_dict(cls, given: Mapping[str, Any]) -> "Artefact":
        """Return an artefact from the table of its file. Raises InputError for what is missing,
        unknown or impossible."""
        try:
            return from_plain(given, cls)
        except InputError as error:
            place = error.place
            table, _, key = place.partition(".")
            entries = given.get(table)
            if isinstance(entries, Mapping):
                place, entries = f"[{table}] {key}", entries.get(key)
            known = BALLS if table == "kind" else _TABLES.get(table, cls).__struct_fields__
            remedy = f"use {', '.join(known)}"
            if entries is not None and table != "kind":
                remedy = f"{entries!r} is impossible: check unit and sign"
            raise InputError(
                f"{error.observation}; {remedy}", place=f"the artefact's file: {place.strip()}"
            ) from error


_TABLES: dict[str, type[msgspec.Struct]] = {
    "calibrated": Calibrated,
    "measured": Measured,
    "limits": Limits,
}


def narrowest_range(deviations: np.ndarray, share: float) -> float:
    """Width of the narrowest interval that holds so great a share of the deviations (n,)."""
    values = np.sort(deviations[np.isfinite(deviations)])
    inside = max(int(np.ceil(share * len(values))), 1)
    return float((values[inside - 1 :] - values[: len(values) - inside + 1]).min())


def make_form_error(
    name: str, position: str, shown: ShapeResult, evidence: SurfaceEvidence, U_mm: float
) -> PropertyError:
    """Return the error of form from points' deviations from their shape: the range of 95 % of
    them, or that which neighbours share, if that is wider."""
    inner, outer = (narrowest_range(shown.error_map, share) for share in (0.95, 0.997))
    noise = finite_or_none(shown.noise_floor_mm) or shown.rms_mm
    error = max(inner, evidence.range_mm)
    return PropertyError(
        name, position, error, U_mm, (0.0, inner), (0.0, outer), U_mm + 2 * K_95 * noise
    )


def make_length_error(name: str, position: str, error_mm: float, u_mm: float) -> PropertyError:
    """Return the error of a length with its standard uncertainty."""
    inner, outer = ((error_mm - k * u_mm, error_mm + k * u_mm) for k in (K_95, K_997))
    return PropertyError(name, position, error_mm, 2 * u_mm, inner, outer, 2 * u_mm)


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
    projector: np.ndarray | None = None,
) -> PositionErrors:
    """Measure the figures of one position. ``plate`` (h, w) bool: the plane's pixels, ``projector``
    (3,) mm: its centre, if these are known.

    Raises InputError where the artefact is not found in the cloud.
    """
    if artefact.kind == "plane":
        shown = [evaluate_plane(cloud.points, plate, cloud.sigma_z)]
        evidence = [collect_evidence(shown[0], cloud.points, projector, plate)]
        figures = [make_form_error(FLATNESS, position, shown[0], evidence[0], artefact.form_U_mm)]
        noise = 0.0
    else:
        nominal = float(np.mean([diameter.value for diameter in artefact.diameters])) / 2
        shown = evaluate_spheres(cloud.points, len(artefact.diameters), cloud.sigma_z, nominal)
        evidence = [collect_evidence(ball, cloud.points, projector) for ball in shown]
        figures, noise = _measure_balls(artefact, cloud, shown, evidence, position)
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
        evidence=evidence,
        centres_mm=[to_vector(s.shape.centre) for s in shown if isinstance(s.shape, Sphere)],
    )


def _measure_balls(
    artefact: Artefact,
    cloud: Cloud,
    balls: list[ShapeResult],
    evidence: list[SurfaceEvidence],
    position: str,
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
    for ball, proof, (diameter, u), spread in zip(balls, evidence, known, spreads, strict=True):
        figures.append(make_form_error(FORM, position, ball, proof, artefact.form_U_mm))
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
            f"no capture shows {artefact.name}", "name some in [measured] captures of its file"
        )
    figures = [figure for position in positions for figure in position.figures]
    judgements, gaps = list[JudgedProperty](), dict[str, str]()
    for name, key in LIMITS.items():
        limit_mm = getattr(artefact.limits, key)
        if mine := [figure for figure in figures if figure.property == name]:
            worst = max(mine, key=lambda figure: abs(figure.error_mm) + figure.U_mm)
            decision = None if limit_mm is None else decide(mine, limit_mm)
            if limit_mm is not None and decision == "pass":
                gaps |= {p.position: gap for p in positions if (gap := p.explain_gap(limit_mm))}
                decision = "undecided" if gaps else decision
            judgements.append(JudgedProperty(name, worst, limit_mm, decision))
    decisions = {each.decision for each in judgements if each.decision is not None}
    return AcceptanceTest(
        artefact=CertifiedArtefact(artefact.name, artefact.certificate, artefact.kind),
        model=model,
        positions=list(positions),
        judgements=judgements,
        scale=_estimate_scale(artefact, positions),
        decision=worst_decision(decisions) if decisions else None,
        lacks=[
            *(f"{position}: {gap}" for position, gap in gaps.items()),
            *_list_gaps(artefact, positions),
        ],
    )


def _list_gaps(artefact: Artefact, positions: Sequence[PositionErrors]) -> Iterator[str]:
    """Yield what the positions do not test."""
    needed = POSITIONS[artefact.kind]
    if len(positions) < needed:
        yield f"{len(positions)} of {needed} positions were measured"
    for first, second in combinations(positions, 2):
        pairs = zip(first.centres_mm, second.centres_mm, strict=True)
        nearest = min((diameter.value for diameter in artefact.diameters), default=0.0) / 8
        if first.centres_mm and all(dist(a, b) < nearest for a, b in pairs):
            yield f"{first.position} and {second.position} are the same place"
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
            f"{count} captures show no repeatability", f"take {CAPTURES} of the same still object"
        )
    depths, noise = (np.stack(maps) for maps in zip(*pairs, strict=True))
    depths -= depths[0].copy()  # small, so that squares keep their digits
    sigma = depths.std(axis=0, ddof=1)
    always = np.isfinite(sigma)
    if not always.any():
        raise InputError(
            "no pixel was measured in every capture", "leave the object where it is, and in view"
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
