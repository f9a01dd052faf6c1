"""What the program claims of itself, proved on simulated rigs whose truth is known."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, Protocol, get_args

from slviewer.pipeline.feedback import Progress, ignore_progress, part
from slviewer.validation.prove_accuracy import prove_accuracy
from slviewer.validation.prove_causes import prove_causes
from slviewer.validation.prove_guidance import prove_guidance
from slviewer.validation.prove_hostile import prove_hostile
from slviewer.validation.prove_registration import prove_registration
from slviewer.validation.prove_uncertainty import prove_uncertainty

Claim = Literal["accuracy", "causes", "guidance", "hostile", "registration", "uncertainty"]
CLAIMS: tuple[Claim, ...] = get_args(Claim)
TITLES: Mapping[Claim, str] = {
    "accuracy": "accuracy at the noise floor",
    "causes": "faults called by their names",
    "guidance": "guided poses",
    "hostile": "captures of a hostile rig",
    "registration": "scans in one frame",
    "uncertainty": "predicted uncertainty",
}
QUICK_SCALE = 0.25
HOSTILE_SCALE = 0.5
"""Beyond it the captures of the many hostile cases take hours, and say the same."""


class Proof(Protocol):
    """What came of one claim."""

    @property
    def holds(self) -> bool:
        """Whether every figure lies where it must."""

    def text(self) -> str:
        """The table, for people."""

    def to_json(self) -> dict[str, Any]:
        """Plain values."""


@dataclass(frozen=True)
class Proofs:
    """Each claim's own proof."""

    proofs: Mapping[Claim, Proof]

    @property
    def failed(self) -> tuple[Claim, ...]:
        """The claims that do not hold."""
        return tuple(claim for claim, proof in self.proofs.items() if not proof.holds)

    @property
    def failure(self) -> str:
        """Which claims do not hold; empty where all do."""
        if not self.failed:
            return ""
        return f"not proven: {', '.join(self.failed)}: the tables say which figures miss their bounds"

    def text(self) -> str:
        """For people: each table under its title, and what holds in the end."""
        blocks = [f"{TITLES[claim]}\n\n{proof.text()}\n" for claim, proof in self.proofs.items()]
        lines = [f"{'pass' if proof.holds else 'FAIL'}  {TITLES[claim]}" for claim, proof in self.proofs.items()]
        return "\n".join([*blocks, *lines])

    def to_json(self) -> dict[str, Any]:
        """Plain values."""
        return {claim: proof.to_json() for claim, proof in self.proofs.items()}


def prove(
    only: Sequence[Claim] = (),
    *,
    quick: bool = False,
    cases: Sequence[str] = (),
    seed: int = 0,
    progress: Progress = ignore_progress,
) -> Proofs:
    """Prove on simulated rigs that results reach the noise floor, faults are named, and predicted errors are honest.

    Ends with status 1 where something does not hold. At full size it takes an hour or two on two cores.

    Args:
        quick: A quarter of the camera's resolution; its figures are its own.
        only: What to prove: accuracy on planes and spheres, causes of bad calibrations, guidance of an operator to
            good poses, captures of a hostile rig, registration of scans, uncertainty against true errors; by default
            all.
        cases: Of the hostile rig only these faults, such as flicker, jpeg:mild or gamma:severe:scan.
        seed: Another seed proves it on other rigs of the same kinds.
    """
    scale = QUICK_SCALE if quick else 1.0
    work: Mapping[Claim, Callable[[Progress], Proof]] = {
        "accuracy": lambda report: prove_accuracy(scale, seed=seed, progress=report),
        "causes": lambda report: prove_causes(scale, seed=seed, progress=report),
        "guidance": lambda report: prove_guidance(scale, seed=seed, progress=report),
        "hostile": lambda report: prove_hostile(
            min(scale, HOSTILE_SCALE), cases=cases, splined=not quick, seed=seed, progress=report
        ),
        "registration": lambda report: prove_registration(scale, seed=seed, progress=report),
        "uncertainty": lambda report: prove_uncertainty(scale, seed=seed, progress=report),
    }
    chosen = [claim for claim in CLAIMS if not only or claim in only]
    found: dict[Claim, Proof] = {}
    for i, claim in enumerate(chosen):
        found[claim] = work[claim](part(progress, i / len(chosen), (i + 1) / len(chosen)))
    return Proofs(found)
