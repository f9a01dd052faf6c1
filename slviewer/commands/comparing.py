"""A scan against the model that it was made from, and what was measured."""

from pathlib import Path
from typing import Literal

from tyro.conf import Positional

from slviewer.commands.parsing import ModelName, deferred, ui, write_json


@deferred
def compare(
    session: Positional[Path],
    scan: Positional[str],
    nominal: Positional[Path],
    tolerance: float | None = None,
    units: Literal["mm", "cm", "m", "inch"] | None = None,
    reach: float | None = None,
    out: Path | None = None,
    json: Path | None = None,
    model: ModelName | None = None,
    accept_rejected: bool = False,
) -> None:
    """Compare a scan with a nominal model after best-fit alignment: figures, coloured points, pictures in the report.

    Args:
        session: Session folder.
        scan: Name of the capture, or merge/1 and the like for a merge that the session keeps.
        nominal: STL, PLY or OBJ file of the part as it should be.
        tolerance: Plus and minus, mm; the answer is pass, fail, or too close to tell.
        units: What the file's numbers are; asked for where its size does not fit the scan's.
        reach: Points farther than this from the nominal, mm, belong to something else (a table, a clamp); by default
            2 % of the nominal's diagonal.
        out: PLY file, the deviation as a scalar and as colours; by default in the session's exports.
        json: Write the figures to this file too.
        model: Which calibration to use; by default the best one available.
        accept_rejected: Use the calibration although its verdict rejects it.
    """
    from slviewer.pipeline import compare

    result = compare.compare(
        session,
        scan,
        nominal,
        tolerance=tolerance,
        units=units,
        reach=reach,
        out=out,
        model=model,
        accept_rejected=accept_rejected,
        **ui(),
    )
    write_json(json, result.to_json())
    print(result.text())
