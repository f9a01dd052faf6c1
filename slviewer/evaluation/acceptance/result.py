"""An acceptance test as a whole: what was found at each position, the scale, and the verdicts."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import stdtrit

from slviewer.errors import InputError
from slviewer.evaluation.acceptance.artefact import Artefact
from slviewer.evaluation.acceptance.figures import K_95, judge_property
from slviewer.evaluation.acceptance.measure import FLATNESS, FORM, SIZE, SPACING
from slviewer.records.acceptance import Decision, JudgedProperty, PositionErrors, ScaleError

POSITIONS = {"ball-bar": 7, "sphere": 7, "plane": 6}
OUTSIDE = 50.0
"""Percent of an artefact's points in R1 (R3) from which on it stands there."""


@dataclass(frozen=True)
class Acceptance:
    """The result of an acceptance test with one artefact and one calibration ("model")."""

    artefact: Artefact
    model: str
    positions: tuple[PositionErrors, ...]
    judgements: tuple[JudgedProperty, ...]
    scale: ScaleError | None

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


def conclude_test(
    artefact: Artefact, model: str, positions: Sequence[PositionErrors]
) -> Acceptance:
    """The test's result from its positions. Raises InputError where there is none."""
    if not positions:
        raise InputError(
            f"no capture shows {artefact.name}: name some in [measured] captures of its file"
        )
    figures = [figure for position in positions for figure in position.figures]
    limits = artefact.limits
    allowed = {
        FORM: limits.form_mm,
        SIZE: limits.size_mm,
        SPACING: limits.spacing_mm,
        FLATNESS: limits.flatness_mm,
    }
    present = {figure.property for figure in figures}
    judgements = tuple(
        judge_property(name, figures, limit) for name, limit in allowed.items() if name in present
    )
    return Acceptance(
        artefact, model, tuple(positions), judgements, _estimate_scale(artefact, positions)
    )


def _estimate_scale(artefact: Artefact, positions: Sequence[PositionErrors]) -> ScaleError | None:
    """Estimate the scale by the spacing of a ball bar's centres, by a sphere's diameter; None for a
    plane."""
    length = artefact.spacing or (artefact.diameters[0] if artefact.diameters else None)
    if length is None:
        return None
    mm, u_shared = artefact.at_measurement(length)
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
