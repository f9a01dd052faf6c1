"""What the program claims of itself, proved on this machine."""

from pathlib import Path
from typing import Literal

from slviewer import terminal
from slviewer.commands.parsing import deferred, write_json
from slviewer.errors import SlviewerError


@deferred
def prove(
    quick: bool = False,
    only: tuple[Literal["accuracy", "causes", "guidance", "hostile", "registration", "uncertainty"], ...] = (),
    case: tuple[str, ...] = (),
    seed: int = 0,
    json: Path | None = None,
) -> None:
    """Prove on simulated rigs that results reach the noise floor, faults are named, and predicted errors are honest.

    Ends with status 1 where something does not hold. At full size it takes an hour or two on two cores.

    Args:
        quick: A quarter of the camera's resolution; its figures are its own.
        only: What to prove: accuracy on planes and spheres, causes of bad calibrations, guidance of an operator to
            good poses, captures of a hostile rig, registration of scans, uncertainty against true errors; by default
            all.
        case: Of the hostile rig only these faults, such as flicker, jpeg:mild or gamma:severe:scan.
        seed: Another seed proves it on other rigs of the same kinds.
        json: Write all figures to this file too.
    """
    from slviewer.validation import prove

    result = prove.prove(only, quick=quick, cases=case, seed=seed, progress=terminal.progress)
    write_json(json, result.to_json())
    print(result.text())
    if result.failed:
        raise SlviewerError(f"not proven: {', '.join(result.failed)}: the tables say which figures miss their bounds")
