"""From captures to clouds: calibrate, reconstruct, verify, merge."""

from pathlib import Path
from typing import Literal

from tyro.conf import Positional

from slviewer.commands.parsing import Axis, ModelName, Start, deferred, ui, write_json
from slviewer.errors import UsageError


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
def reconstruct(
    session: Positional[Path],
    capture: Positional[str],
    model: ModelName | None = None,
    axis: Axis | None = None,
    depth_range: tuple[float, float] | None = None,
    out: Path | None = None,
    grid: Path | None = None,
    mesh: bool = False,
    accept_rejected: bool = False,
) -> None:
    """Reconstruct a capture as a cloud; a board pose also says how flat each model measures the board.

    Args:
        session: Session folder.
        capture: Name of the capture.
        model: Which calibration to use; by default the best one available.
        axis: Which pattern axis gives the depth; by default the one with the smaller predicted noise.
        depth_range: For patterns that do not cover the projector: near and far end, mm, of the depths between which
            all surfaces lie; by default the calibrated depths.
        out: PLY file; by default in the session's exports. That of a board pose holds the points inside the board's
            outline.
        grid: Also write the whole organised cloud, (h, w, 3) float32 mm, NaN where invalid, as .npy.
        mesh: Put the triangles between neighbouring pixels into the PLY.
        accept_rejected: Use the calibration although its verdict rejects it.
    """
    from slviewer.pipeline import reconstruct

    result = reconstruct.reconstruct(
        session,
        capture,
        model=model,
        axis=axis,
        depth_range=depth_range,
        out=out,
        grid=grid,
        mesh=mesh,
        accept_rejected=accept_rejected,
        **ui(),
    )
    print(result.text())


@deferred
def verify(
    session: Positional[Path],
    captures: Positional[tuple[str, ...]],
    shape: Literal["plane", "sphere"],
    model: tuple[ModelName, ...] = (),
    range: tuple[float, float] | None = None,
    radius: float | None = None,
    axis: Axis | None = None,
    json: Path | None = None,
    accept_rejected: bool = False,
) -> None:
    """Measure captures of a plane or a sphere with each model, and compare.

    Args:
        session: Session folder.
        captures: Names of the captures.
        shape: What the captures show.
        model: Which calibrations to compare; by default all there are.
        range: Near and far end of the calibrated depths R2, mm; by default those of the board poses.
        radius: Nominal radius of the sphere, mm: helps to find it; the fitted radius stays free.
        axis: Which pattern axis gives the depth; by default the one with the smaller predicted noise.
        json: Write the result to this file too.
        accept_rejected: Use the calibration although its verdict rejects it.
    """
    from slviewer.pipeline import verify

    result = verify.verify(
        session,
        captures,
        shape,
        models=model,
        depth_range=range,
        radius=radius,
        axis=axis,
        accept_rejected=accept_rejected,
        **ui(),
    )
    write_json(json, result.to_json())
    print(result.text())


@deferred
def merge(
    session: Positional[Path],
    captures: Positional[tuple[str, ...]],
    reference: str,
    out: Path | None = None,
    model: ModelName | None = None,
    start: Start = "features",
    angle: float | None = None,
    json: Path | None = None,
    accept_rejected: bool = False,
) -> None:
    """Register scans to a reference scan, close their loops, and fuse them into one surface.

    Says how surely each pair lies, how well loops close, and what was left out, and why.

    Args:
        session: Session folder.
        captures: Names of the captures, in the order in which they were taken.
        reference: The capture whose frame the merged cloud takes.
        out: PLY file. Left out, the session keeps the merge as merge/1 and so on, for mesh, compare, measure and
            export, and its file is in the session's exports.
        start: Where registration starts from: features finds by itself how the scans lie; turntable uses --angle;
            identity takes them to lie nearly right already.
        angle: Degrees that the turntable turns from each capture to the next, with --start turntable.
        model: Which calibration to use; by default the best one available.
        json: Write the registrations to this file too.
        accept_rejected: Use the calibration although its verdict rejects it.
    """
    from slviewer.pipeline import merge

    result = merge.merge(
        session,
        captures,
        reference,
        out,
        model=model,
        start=start,
        angle=angle,
        accept_rejected=accept_rejected,
        **ui(),
    )
    write_json(json, result.to_json())
    print(result.text())
