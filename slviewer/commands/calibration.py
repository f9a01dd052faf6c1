"""Making a calibration, and finding out how far it can be trusted."""

from pathlib import Path
from typing import Literal

from tyro.conf import Positional

from slviewer.commands.parsing import ModelName, deferred, ui, write_json
from slviewer.errors import DetectionError, UsageError


@deferred
def calibrate(
    session: Positional[Path],
    target: str,
    models: tuple[ModelName, ...] = (),
    poses: tuple[str, ...] = (),
    exclude: tuple[str, ...] = (),
    smoothing: Literal["spline", "polynomial"] = "spline",
    degree: int = 5,
    validate: bool = False,
    camera_only: bool = False,
    out: Path | None = None,
    json: Path | None = None,
) -> None:
    """Calibrate from the session's target poses, and say whether the calibration is good, and if not, why.

    One that is rejected ends with status 3; it is kept to look into, and not used.

    Args:
        session: Session folder; with --camera-only also a folder of pictures of the board.
        target: circles:21x16:9 (columns x rows : pitch mm), acircles:…, chessboard:9x7:75 (inner corners : square mm),
            charuco:….
        models: Which models to fit; by default stereo, which is always made, the Letter's pixelwise, and splined.
        poses: Calibrate from these target poses alone: names, or patterns such as 'pose_0*'.
        exclude: Leave these target poses out, this time; the wizard excludes poses for good.
        smoothing: How the Letter's step 2 smooths a board's phase; the spline keeps the local distortion.
        degree: Degree of the polynomial, with --smoothing polynomial.
        validate: Also compare the models on poses that they were not made from, as `slviewer validate` does.
        camera_only: Calibrate the camera's lens alone, from pictures of the board; the session stays as it is.
        out: With --camera-only: write the lens to this .yml, .xml or .json, for OpenCV.
        json: Write the result to this file too.
    """
    from slviewer.pipeline import calibrate, calibrate_camera
    from slviewer.pipeline.validate import validate as compare_models

    if camera_only:
        camera = calibrate_camera.calibrate_camera_alone(session, target, poses=poses, exclude=exclude, out=out, **ui())
        write_json(json, camera.to_json())
        print(camera.text())
        return
    if out is not None:
        raise UsageError("--out belongs to --camera-only: `slviewer export calibration` writes the rig's calibration")
    result = calibrate.calibrate(
        session, target, models=models, poses=poses, exclude=exclude, smoothing=smoothing, degree=degree, **ui()
    )
    data = result.to_json()
    print(result.text())
    if validate:
        compared = compare_models(session, models=models, **ui())
        data["validation"] = compared.to_json()
        print(compared.text())
    write_json(json, data)


@deferred
def validate(
    session: Positional[Path], models: tuple[ModelName, ...] = (), folds: int = 5, json: Path | None = None
) -> None:
    """Measure target poses with calibrations made without them, and recommend the best model.

    Args:
        session: Session folder, calibrated.
        models: Which models to compare; by default all there are. The recommended one is used where none is named.
        folds: In how many parts the poses are left out, one after the other.
        json: Write the result to this file too.
    """
    from slviewer.pipeline import validate

    result = validate.validate(session, models=models, folds=folds, **ui())
    write_json(json, result.to_json())
    print(result.text())


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
