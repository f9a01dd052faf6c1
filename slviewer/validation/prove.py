"""The program's claims, proved on simulated rigs with known ground truth."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

from slviewer.pipeline.operation import Progress, ignore_progress, part
from slviewer.validation.proof import Proof
from slviewer.validation.prove_acceptance import prove_acceptance
from slviewer.validation.prove_accuracy import prove_accuracy, prove_uncertainty
from slviewer.validation.prove_cameras import prove_cameras
from slviewer.validation.prove_captures import prove_captures
from slviewer.validation.prove_causes import prove_causes
from slviewer.validation.prove_guidance import prove_guidance
from slviewer.validation.prove_hostile import prove_hostile
from slviewer.validation.prove_parts import prove_parts
from slviewer.validation.prove_plan import prove_plan
from slviewer.validation.prove_plan_faults import prove_plan_faults
from slviewer.validation.prove_registration import prove_registration
from slviewer.validation.prove_reports import prove_reports
from slviewer.validation.prove_surfaces import prove_edges, prove_surfaces

Claim = Literal[
    "accuracy",
    "cameras",
    "causes",
    "edges",
    "guidance",
    "hostile",
    "parts",
    "plan",
    "registration",
    "reports",
    "surfaces",
    "uncertainty",
]


def prove_named_faults(scale: float, *, seed: int, progress: Progress) -> Proof:
    """Faults of calibrations, then faults of captures."""
    calibrations = prove_causes(scale, seed=seed, progress=part(progress, 0, 0.5))
    captures = prove_captures(scale, seed=seed, progress=part(progress, 0.5, 1))
    return Proof(
        calibrations.holds and captures.holds,
        scale,
        captures.rows,
        {**calibrations.record, "captures": captures.to_json()},
        [calibrations.text(), "", "faults of captures", "", *captures.above],
        captures.below,
    )


def prove_verdicts(scale: float, *, seed: int, progress: Progress) -> Proof:
    """Verdicts on parts against their models, by inspection plans, and of acceptance tests."""
    parts = prove_parts(scale, seed=seed, progress=part(progress, 0, 0.6))
    plans = prove_plan_faults(scale, seed=seed, progress=part(progress, 0.6, 0.85))
    acceptance = prove_acceptance(scale, seed=seed, progress=part(progress, 0.85, 1))
    return Proof(
        parts.holds and plans.holds and acceptance.holds,
        scale,
        acceptance.rows,
        {
            "parts": parts.to_json(),
            "plans": plans.to_json(),
            "acceptance": acceptance.to_json(),
        },
        [
            *(parts.text(), "", "inspection plans", "", plans.text(), ""),
            *("acceptance tests", "", *acceptance.above),
        ],
        acceptance.below,
    )


CLAIMS: Mapping[Claim, tuple[str, Callable[..., Proof]]] = {
    "accuracy": ("accuracy at the noise floor", prove_accuracy),
    "cameras": ("two cameras", prove_cameras),
    "causes": ("faults called by their names", prove_named_faults),
    "edges": ("printed edges without ridges", prove_edges),
    "guidance": ("guided poses", prove_guidance),
    "hostile": ("captures of a hostile rig", prove_hostile),
    "parts": ("verdicts on parts", prove_verdicts),
    "plan": ("tolerances of an inspection plan", prove_plan),
    "registration": ("scans in one frame", prove_registration),
    "reports": ("reported situations", prove_reports),
    "surfaces": ("surfaces that light themselves", prove_surfaces),
    "uncertainty": ("predicted uncertainty", prove_uncertainty),
}
"""Of each claim its title and what proves it."""
assert tuple(CLAIMS) == get_args(Claim)
QUICK_SCALE = 0.25
HOSTILE_SCALE = 0.5
"""Beyond it the captures of the many hostile cases take hours, and show the same."""


@dataclass(frozen=True)
class Proofs:
    """The proof of each claim."""

    proofs: Mapping[Claim, Proof]

    @property
    def failure(self) -> str:
        """Which claims do not hold; empty where all do."""
        failed = ", ".join(claim for claim, proof in self.proofs.items() if not proof.holds)
        return failed and f"not proven: {failed}: the tables show which figures miss their bounds"

    def text(self) -> str:
        """Each table under its title, then whether each claim holds."""
        titled = [(CLAIMS[claim][0], proof) for claim, proof in self.proofs.items()]
        blocks = [f"{title}\n\n{proof.text()}\n" for title, proof in titled]
        lines = [f"{'pass' if proof.holds else 'FAIL'}  {title}" for title, proof in titled]
        return "\n".join([*blocks, *lines])

    def to_json(self) -> dict[str, Any]:
        """Return plain values by claim."""
        return {claim: proof.to_json() for claim, proof in self.proofs.items()}


def prove(
    only: Sequence[Claim] = (),
    *,
    quick: bool = False,
    cases: Sequence[str] = (),
    seed: int = 0,
    progress: Progress = ignore_progress,
) -> Proofs:
    """Prove on simulated rigs that results reach the noise floor, faults are named, and predicted
    errors are honest.

    Ends with status 1 where something does not hold. At full size it takes an hour or two on two
    cores.

    Args:
        quick: A quarter of the camera's resolution; its figures are its own.
        only: What to prove: accuracy on planes and spheres, two cameras, causes of bad
            calibrations and captures, printed edges, guidance of an operator to good poses,
            captures of a hostile rig, verdicts on right and wrong parts, tolerances of an
            inspection plan, registration of scans, reported situations, surfaces that light
            themselves, uncertainty against true errors; by default all.
        cases: Of the hostile rig only these faults, such as flicker, jpeg:mild or
            gamma:severe:scan.
        seed: Another seed proves it on other rigs of the same kinds.
    """
    scale = QUICK_SCALE if quick else 1.0
    chosen = [claim for claim in CLAIMS if not only or claim in only]
    proofs: dict[Claim, Proof] = {}
    for i, claim in enumerate(chosen):
        report = part(progress, i / len(chosen), (i + 1) / len(chosen))
        size, options = scale, {}
        if claim == "hostile":
            size, options = min(scale, HOSTILE_SCALE), {"cases": cases, "splined": not quick}
        proofs[claim] = CLAIMS[claim][1](size, seed=seed, progress=report, **options)
        report(1.0, "proven")
    return Proofs(proofs)
