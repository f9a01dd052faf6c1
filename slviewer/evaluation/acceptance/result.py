"""An acceptance test as a whole: what was found at each position, the scale, and the verdicts."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import stdtrit

from slviewer.errors import InputError
from slviewer.evaluation.acceptance.artefact import Artefact
from slviewer.evaluation.acceptance.figures import K_95, K_997, RULE, Decision, Judgement, judge_property
from slviewer.evaluation.acceptance.measure import FLATNESS, FORM, SIZE, SPACING, Position
from slviewer.evaluation.render import Row, render
from slviewer.records.plain import to_plain

POSITIONS = {"ball-bar": 7, "sphere": 7, "plane": 6}
CLAIM = "follows the ideas of VDI/VDE 2634 part 2 and ISO 10360-13, and claims conformity with neither"
OUTSIDE = 50.0
"""Percent of an artefact's points in R1 (R3) from which on it stands there."""


@dataclass(frozen=True)
class ScaleEstimate:
    """Relative scale error of the instrument, ppm, positive where it measures too long; ``u_ppm`` is its standard
    uncertainty.

    From the errors of one length at several positions: their mean, with the scatter between positions (widened for
    their number by Student's t) and what all of them share, the certificate and the temperature.
    """

    ppm: float
    u_ppm: float
    length_mm: float
    positions: int

    @property
    def U_ppm(self) -> float:
        """Expanded uncertainty of the scale in ppm, k = 2."""
        return 2 * self.u_ppm

    def within(self, k: float) -> tuple[float, float]:
        """The interval of k standard uncertainties, ppm."""
        return self.ppm - k * self.u_ppm, self.ppm + k * self.u_ppm

    def to_json(self) -> dict[str, Any]:
        """Return the fields and both intervals as plain values."""
        return to_plain(self) | {"within_95_ppm": self.within(K_95), "within_997_ppm": self.within(K_997)}


@dataclass(frozen=True)
class Acceptance:
    """The result of an acceptance test with one artefact and one calibration ("model")."""

    artefact: Artefact
    model: str
    positions: tuple[Position, ...]
    judgements: tuple[Judgement, ...]
    scale: ScaleEstimate | None

    @property
    def decision(self) -> Decision | None:
        """Of all properties together: one fail fails; None where no limit was given."""
        decisions = {judgement.decision for judgement in self.judgements} - {None}
        for worst in ("fail", "undecided", "pass"):
            if worst in decisions:
                return worst
        return None

    @property
    def lacks(self) -> tuple[str, ...]:
        """What the positions do not test."""
        gaps = []
        needed = POSITIONS[self.artefact.kind]
        if len(self.positions) < needed:
            gaps.append(f"{len(self.positions)} of {needed} positions were measured")
        shares = [position.incidence for position in self.positions if position.incidence]
        for part in ("R1", "R3") if shares else ():
            if not any(share[part] >= OUTSIDE for share in shares):
                gaps.append(f"no position lies in {part}: what is measured there is untested")
        return tuple(gaps)

    def rows(self) -> list[Row]:
        """One a position, keys are the columns' titles: the worst figure of each property, mm."""
        table = []
        for position in self.positions:
            row: Row = {"position": position.position}
            if position.incidence:
                row["R1/R2/R3 %"] = "/".join(f"{share:.0f}" for share in position.incidence.values())
            for title, name in (("flatness", FLATNESS), ("form", FORM)):
                if name in position.properties:
                    worst = position.error(name)
                    row |= {f"{title} (95 %)": worst.within_95_mm[1], f"{title} (99.7 %)": worst.within_997_mm[1]}
            for title, name in (("size", SIZE), ("spacing", SPACING)):
                if name in position.properties:
                    worst = position.error(name)
                    row |= {f"{title} error": worst.error_mm, f"{title} +- (95 %)": _half_width(worst.within_95_mm)}
                    row[f"{title} +- (99.7 %)"] = _half_width(worst.within_997_mm)
            row |= {"RMS": max(position.rms_mm), "noise floor": max(position.floor_mm), "points": position.points}
            table.append(row)
        return table

    def text(self) -> str:
        """Return the result as a report for the terminal."""
        a = self.artefact
        lines = [
            f"{a.name} ({a.kind}), certificate: {a.certificate}",
            f"{len(self.positions)} positions, measured by {self.model} at {a.temperature.celsius:g} C; in mm",
            render(self.rows()),
        ]
        for judgement in self.judgements:
            worst = judgement.worst
            limit = "no limit given" if judgement.limit_mm is None else f"limit {judgement.limit_mm:g} mm"
            lines.append(
                f"{judgement.property}: {worst.error_mm:+.4f} mm at {worst.position}, test uncertainty U = "
                f"{worst.U_mm:.4f} mm (k = 2); {limit}: {judgement.decision or 'not decided'}"
            )
        if self.scale is not None:
            s = self.scale
            (low, high), (lower, higher) = s.within(K_95), s.within(K_997)
            lines.append(
                f"scale: {s.ppm:+.0f} ppm, U = {s.U_ppm:.0f} ppm (k = 2); 95 %: {low:+.0f} to {high:+.0f}, 99.7 %: "
                f"{lower:+.0f} to {higher:+.0f} ppm"
            )
        lines += [f"incomplete: {what}" for what in self.lacks]
        lines += [f"{p.position}: {warning}" for p in self.positions for warning in p.warnings]
        if self.decision is not None:
            lines.append(f"{self.decision.upper()}: {RULE}")
        return "\n".join([*lines, f"This test {CLAIM}."])

    def to_json(self) -> dict[str, Any]:
        """Return the published values of ``accept --json``."""
        return to_plain(self) | {
            "scale": None if self.scale is None else self.scale.to_json(),
            "decision": self.decision,
            "lacks": self.lacks,
            "rule": RULE,
            "claim": CLAIM,
        }


def conclude_test(artefact: Artefact, model: str, positions: Sequence[Position]) -> Acceptance:
    """The test's result from its positions. Raises InputError where there is none."""
    if not positions:
        raise InputError(f"no capture shows {artefact.name}: name some in [measured] captures of its file")
    figures = [figure for position in positions for figure in position.figures]
    limits = artefact.limits
    allowed = {FORM: limits.form_mm, SIZE: limits.size_mm, SPACING: limits.spacing_mm, FLATNESS: limits.flatness_mm}
    present = {figure.property for figure in figures}
    judgements = tuple(judge_property(name, figures, limit) for name, limit in allowed.items() if name in present)
    return Acceptance(artefact, model, tuple(positions), judgements, _estimate_scale(artefact, positions))


def _estimate_scale(artefact: Artefact, positions: Sequence[Position]) -> ScaleEstimate | None:
    """Estimate the scale by the spacing of a ball bar's centres, by a sphere's diameter; None for a plane."""
    length = artefact.spacing or (artefact.diameters[0] if artefact.diameters else None)
    if length is None:
        return None
    mm, u_shared = artefact.at_measurement(length)
    name = SIZE if artefact.spacing is None else SPACING
    errors = np.array([f.error_mm for position in positions for f in position.figures if f.property == name])
    n = len(errors)
    per_deviation = stdtrit(n - 1, 0.975) / K_95 / np.sqrt(n)
    u_mean = float(errors.std(ddof=1) * per_deviation) if n > 1 else positions[0].noise_mm
    return ScaleEstimate(1e6 * float(errors.mean()) / mm, 1e6 * float(np.hypot(u_mean, u_shared)) / mm, mm, n)


def _half_width(interval: tuple[float, float]) -> float:
    """Return half the width of an interval."""
    return (interval[1] - interval[0]) / 2
