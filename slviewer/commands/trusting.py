"""How far a calibration can be trusted: the drift check and the acceptance test."""

from pathlib import Path

from tyro.conf import Positional

from slviewer.commands.parsing import ModelName, deferred, ui, write_json


@deferred
def check(session: Positional[Path], capture: Positional[str], json: Path | None = None) -> None:
    """Say from one capture of the board whether the saved calibration is still good, and why if it is not.

    Args:
        session: Session folder.
        capture: Name of a capture, of any role, that shows the calibration's board.
        json: Write the result to this file too.
    """
    from slviewer.pipeline import check

    result = check.check(session, capture, **ui())
    write_json(json, result.to_json())
    print(result.text())


@deferred
def accept(
    session: Positional[Path],
    artefact: Path,
    model: ModelName | None = None,
    still: tuple[str, ...] = (),
    apply_scale: bool = False,
    json: Path | None = None,
) -> None:
    """Test a calibration with a ball bar, a sphere or a plane that has a certificate, against the operator's limits.

    Args:
        session: Session folder.
        artefact: TOML file with what the certificate says, the captures that show the artefact, and the limits.
        model: Which calibration to test; by default the best one available.
        still: Captures (ten) of one still object, for the repeatability.
        apply_scale: Record the scale that is found as a correction.
        json: Write the result to this file too.
    """
    from slviewer.pipeline import accept

    result = accept.accept(session, artefact, model=model, still=still, apply_scale_found=apply_scale, **ui())
    write_json(json, result.to_json())
    print(result.text())
