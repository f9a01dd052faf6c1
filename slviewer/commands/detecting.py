"""A board in photographs."""

from pathlib import Path

from tyro.conf import Positional

from slviewer.commands.parsing import deferred, write_json
from slviewer.errors import DetectionError


@deferred
def detect(
    images: Positional[tuple[Path, ...]],
    target: str,
    out: Path | None = None,
    csv: Path | None = None,
    json: Path | None = None,
) -> None:
    """Detect a calibration board in photographs: where its circles or corners are, or why it cannot be measured.

    Ends with status 1 where the board is not detected in every image.

    Args:
        images: Image files, or folders of them.
        target: circles:21x16:9 (columns x rows : pitch mm), acircles:…, chessboard:9x7:75 (inner corners : square mm),
            charuco:….
        out: The picture with numbered features and the board's axes; a folder where there are several images.
        csv: Table of all features: image, index, place on the board in mm, place in the image in px.
        json: Write the result to this file too.
    """
    from slviewer.pipeline import detect

    result = detect.detect_board(images, target, out=out, csv_out=csv)
    write_json(json, result.to_json())
    print(result.text())
    if result.detected < len(result.images):
        missing = len(result.images) - result.detected
        raise DetectionError(f"{result.board} not detected in {missing} of {len(result.images)} images")
