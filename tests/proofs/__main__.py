"""The program's claims, proved on simulated rigs with known ground truth.

python -m tests.proofs [CLAIM ...] [--quick] [--case CASE ...] [--seed SEED] [--json FILE]
"""

import sys
from argparse import ArgumentParser
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from slviewer import terminal
from slviewer.commands.command import write_json
from slviewer.pipeline.operation import Progress, ignore_progress, part
from tests.proofs.acceptance import prove_acceptance
from tests.proofs.accuracy import prove_accuracy, prove_uncertainty
from tests.proofs.cameras import prove_cameras
from tests.proofs.captures import prove_captures, prove_pipelines
from tests.proofs.causes import prove_causes
from tests.proofs.codes import prove_codes
from tests.proofs.cut_boards import prove_cut_boards
from tests.proofs.files import prove_files
from tests.proofs.guidance import prove_guidance
from tests.proofs.hand_eye import prove_hand_eye
from tests.proofs.hostile import prove_hostile
from tests.proofs.laws import prove_laws
from tests.proofs.limits import prove_limits
from tests.proofs.parts import prove_parts
from tests.proofs.plan import prove_plan
from tests.proofs.plan_faults import prove_plan_faults
from tests.proofs.proof import Proof
from tests.proofs.registration import prove_registration
from tests.proofs.relate_rigs import prove_relate_rigs
from tests.proofs.reports import prove_reports
from tests.proofs.shown_image import prove_shown
from tests.proofs.surfaces import prove_edges, prove_surfaces


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


CLAIMS: Mapping[str, tuple[str, Callable[..., Proof]]] = {
    "accuracy": ("accuracy at the noise floor", prove_accuracy),
    "boards": ("boards cut by border, light or hand", prove_cut_boards),
    "cameras": ("two cameras", prove_cameras),
    "causes": ("faults called by their names", prove_named_faults),
    "codes": ("folders of frames decoded, or what is wrong named", prove_codes),
    "edges": ("printed edges without ridges", prove_edges),
    "files": ("files of other programs", prove_files),
    "guidance": ("guided poses", prove_guidance),
    "hand-eye": ("the camera's place on a robot", prove_hand_eye),
    "hostile": ("captures of a hostile rig", prove_hostile),
    "laws": ("laws of scale, order and readout", prove_laws),
    "limits": ("rigs at their limits", prove_limits),
    "parts": ("verdicts on parts", prove_verdicts),
    "pipelines": ("captures of ordinary cameras", prove_pipelines),
    "plan": ("tolerances of an inspection plan", prove_plan),
    "registration": ("scans in one frame", prove_registration),
    "reports": ("reported situations", prove_reports),
    "rigs": ("several rigs in one frame", prove_relate_rigs),
    "shown": ("results shown on the part", prove_shown),
    "surfaces": ("surfaces that light themselves", prove_surfaces),
    "uncertainty": ("predicted uncertainty", prove_uncertainty),
}
"""Of each claim its title and what proves it."""
QUICK_SCALE = 0.25
HOSTILE_SCALE = 0.5
"""Beyond it the captures of the many hostile cases take hours, and show the same."""


@dataclass(frozen=True)
class Proofs:
    """The proof of each claim."""

    proofs: Mapping[str, Proof]

    @property
    def hold(self) -> bool:
        """Whether all claims do."""
        return all(proof.holds for proof in self.proofs.values())

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
    claims: Sequence[str] = (),
    *,
    quick: bool = False,
    cases: Sequence[str] = (),
    seed: int = 0,
    progress: Progress = ignore_progress,
) -> Proofs:
    """Prove claims on simulated rigs, all without any; ``quick``: on a quarter of the camera's
    pixels, whose figures are their own; ``cases``: of the hostile rig only these faults. Another
    ``seed`` proves them on other rigs of the same kinds."""
    scale = QUICK_SCALE if quick else 1.0
    chosen = [claim for claim in CLAIMS if not claims or claim in claims]
    proofs: dict[str, Proof] = {}
    for i, claim in enumerate(chosen):
        report = part(progress, i / len(chosen), (i + 1) / len(chosen))
        size, options = scale, {}
        if claim == "hostile":
            size, options = min(scale, HOSTILE_SCALE), {"cases": cases, "splined": not quick}
        proofs[claim] = CLAIMS[claim][1](size, seed=seed, progress=report, **options)
        report(1.0, "proven")
    return Proofs(proofs)


def main(arguments: Sequence[str] | None = None) -> int:
    """Prove what is asked for, and print it; 1 where something does not hold. All claims at full
    size take hours on two cores."""
    parser = ArgumentParser("python -m tests.proofs")
    titles = "; ".join(f"{claim}: {title}" for claim, (title, _) in CLAIMS.items())
    parser.add_argument("claims", nargs="*", metavar="CLAIM", help=titles)
    parser.add_argument("--quick", action="store_true", help="on a quarter of the camera's pixels")
    parser.add_argument(
        "--case",
        nargs="+",
        default=(),
        help="of hostile only these, as jpeg:mild or gamma:severe",
    )
    parser.add_argument("--seed", type=int, default=0, help="other rigs of the same kinds")
    parser.add_argument("--json", type=Path, help="write the figures to this file too")
    asked = parser.parse_args(arguments)
    if unknown := set(asked.claims) - set(CLAIMS):
        parser.error(f"no claim {', '.join(sorted(unknown))}: there are {', '.join(CLAIMS)}")
    proofs = prove(
        asked.claims,
        quick=asked.quick,
        cases=asked.case,
        seed=asked.seed,
        progress=terminal.progress,
    )
    write_json(asked.json, proofs.to_json())
    print(proofs.text())
    return 0 if proofs.hold else 1


if __name__ == "__main__":
    sys.exit(main())
