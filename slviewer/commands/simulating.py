"""Without a rig: simulated sessions, and the Letter's experiments on them."""

from pathlib import Path
from typing import Literal

from tyro.conf import Positional

from slviewer.commands.parsing import deferred, ui, write_json


@deferred
def simulate(
    session: Positional[Path],
    preset: Literal["letter", "turn"] = "letter",
    scale: float = 1.0,
    poses: int = 25,
    seed: int = 0,
) -> None:
    """Fill a new session with captures of a simulated rig: target poses, planes, spheres, an object at three depths.

    The preset turn has, beside target poses, the object turned by up to 15 degrees between its three depths, and
    another on a turntable, in twelve steps round.

    Args:
        session: Session folder to make.
        preset: letter: planes, spheres and an object at three depths; turn: an object at three depths, and another on a
            turntable.
        scale: Resolution of the camera, as a share of 1600x1200 px; 0.25 is quick.
        poses: How many target poses.
        seed: Another seed is another rig of the same kind.
    """
    from slviewer.pipeline import simulate
    from slviewer.pipeline.simulate import TARGET  # only now: nothing heavy is imported before it is needed

    names = simulate.simulate(session, preset=preset, scale=scale, poses=poses, seed=seed, **ui())
    print(f"{len(names)} captures simulated into {session}; next: slviewer calibrate {session} --target {TARGET}")


@deferred
def reproduce(
    quick: bool = False,
    out: Path | None = None,
    json: Path | None = None,
    seed: int = 0,
) -> None:
    """Repeat the Letter's experiments on the simulated rig, and put its figures beside ours.

    Args:
        quick: Half resolution; its figures are its own.
        out: Folder for the session and the report; by default reproduction, or reproduction-quick.
        json: Write the figures to this file too.
        seed: Another seed is another rig of the same kind.
    """
    from slviewer.validation import reproduce

    folder = out or Path("reproduction-quick" if quick else "reproduction")
    result = reproduce.reproduce(folder, quick=quick, seed=seed, **ui())
    write_json(json, result.to_json())
    print(result.text())
