"""Simulated sessions, the Letter's experiments on them, proofs and timings."""

from pathlib import Path
from typing import Literal

from tyro.conf import Positional

from slviewer import terminal
from slviewer.commands.parsing import deferred, ui, write_json
from slviewer.errors import SlviewerError


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


@deferred
def bench(
    calibration: bool = False, live: bool = False, minutes: float = 0.5, scale: float = 1.0, json: Path | None = None
) -> None:
    """Time the main stages on this machine, beside what they cannot beat.

    Args:
        calibration: Also simulate and calibrate 25 poses (minutes, and 3.5 GB of disk at full size).
        live: Also scan live, at half the resolution, with one viewer that draws and one that stalls.
        minutes: How long.
        scale: Resolution of the camera, as a share of 1600x1200.
        json: Write the figures to this file too.
    """
    from slviewer.validation import bench

    result = bench.bench(calibration=calibration, scale=scale, progress=terminal.progress)
    print(result.text())
    figures = result.to_json()
    if live:
        from slviewer.validation.bench_live import live_rate

        streamed = live_rate(0.5 * scale, 60 * minutes, terminal.progress)
        print(streamed.text())
        figures["live"] = streamed.to_json()
    write_json(json, figures)
