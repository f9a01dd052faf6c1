"""How far a calibration can be trusted: the drift check and the acceptance test."""

from pathlib import Path

from tyro.conf import Positional

from slviewer import workflow
from slviewer.commands.parsing import ModelName, deferred, ui, write_json


@deferred
def check(session: Positional[Path], capture: Positional[str], json: Path | None = None) -> None:
    """Say from one capture of the board whether the saved calibration is still good, and why if it is not.

    Args:
        session: Session folder.
        capture: Name of a capture, of any role, that shows the calibration's board.
        json: Write the result to this file too.
    """
    result = workflow.check(session, capture, **ui())
    write_json(json, result.to_json())
    print(result.text())
