"""What a package needs to add cameras, projectors, turntables, boards, importers, exporters and
operations with their panels to slviewer.

A plugin is an object under an entry point, whose name is the object's ``name``:

=======================  ===========================================================================
``slviewer.drivers``     a `Driver`: factories of cameras, projectors, turntables or whole rigs
``slviewer.boards``      a `BoardType`: coordinates of a board's features, and their detection
``slviewer.importers``   a `FolderLayout`: another program's folders of images, best made by
                         `define_layout`
``slviewer.exporters``   an `Exporter`: a file format for points or meshes
``slviewer.operations``  an operation, made by `operation`, and with it its kind of `Record`
``slviewer.panels``      a subclass of `PanelPlugin`: a folder in a step of the wizard
=======================  ===========================================================================

The ``check_...`` functions test one as slviewer uses it, for the tests of its package.
"""

import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import closing
from functools import partial, wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any, ParamSpec

import numpy as np

from slviewer.devices.drivers import DRIVER_PLUGINS, Driver
from slviewer.devices.protocols import (
    Camera,
    CameraSettings,
    ImageProjector,
    Openable,
    Projector,
    Rig,
    Turntable,
    check_angle,
    check_frame,
    check_image,
    check_index,
    check_level,
    check_sequence,
    stated_full_scale,
)
from slviewer.entry_points import OPERATION_PLUGINS
from slviewer.errors import (
    Cancelled,
    DetectionError,
    DeviceError,
    InputError,
    SlviewerError,
    TurntableError,
)
from slviewer.fringe.patterns import render_pattern as render
from slviewer.fringe.presets import complementary, gray_bits, phase_steps
from slviewer.fringe.sequence import Frame, PatternSequence, PerAxis
from slviewer.inputs import Input
from slviewer.pipeline.import_captures import check_imported_capture
from slviewer.pipeline.operation import Found, Job, ignore_warnings, operation
from slviewer.records.record import Record
from slviewer.session.importers.imported import (
    FolderLayout,
    ImportableRecording,
    check_complete,
    define_layout,
    has_images,
    match_images,
    unknown_files_warning,
)
from slviewer.session.importers.layouts import LAYOUT_PLUGINS
from slviewer.session.shape_files import EXPORTER_PLUGINS, Exporter
from slviewer.surface.shapes import Mesh, PointSet
from slviewer.target.board import BOARD_PLUGINS, Board, BoardType
from slviewer.target.detect import detect

if TYPE_CHECKING:
    from slviewer.gui.panel import Form, PanelPlugin

__all__ = [
    "Board", "BoardType", "Camera", "CameraSettings", "DetectionError", "DeviceError", "Driver",
    "Exporter", "FolderLayout", "Form", "Found", "Frame", "ImageProjector",
    "ImportableRecording", "Input", "InputError", "Job", "Mesh", "Openable", "PanelPlugin",
    "PatternSequence", "PerAxis", "PointSet", "Projector", "Record", "Rig", "Turntable",
    "TurntableError", "check_angle", "check_board", "check_camera", "check_complete",
    "check_exporter", "check_frame", "check_image", "check_importer", "check_index", "check_level",
    "check_projector", "check_sequence", "check_turntable", "define_layout", "gray_bits",
    "has_images", "match_images", "operation", "phase_steps", "render", "unknown_files_warning",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    if name not in ("Form", "PanelPlugin"):
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from slviewer.gui import panel  # of a second: only panels need it

    return getattr(panel, name)


_SEEN_LEVEL, _OTHER_LEVEL = 85, 170
"""With which the buffers are filled before two grabs."""
_ANGLE_TOLERANCE_DEG = 0.5
P = ParamSpec("P")


def _listed(inspect: Callable[P, Iterator[str]]) -> Callable[P, list[str]]:
    """Decorate what yields the faults of a plugin: they are returned as a list, with the exception
    that ends it early, if one does."""

    @wraps(inspect)
    def collect(*arguments: P.args, **options: P.kwargs) -> list[str]:
        plugin = (arguments or tuple(options.values()))[0]
        if isinstance(plugin, type):
            return [f"{plugin.__name__} is a class: give an object of it, {plugin.__name__}(...)"]
        faults: list[str] = []
        try:
            faults.extend(inspect(*arguments, **options))
        except Exception as error:  # whatever a plugin raises is a fault of it
            faults.append(f"the check ended early with {type(error).__name__}: {error}")
        return faults

    return collect


@_listed
def check_camera(camera: Camera) -> Iterator[str]:
    """List what a closed camera does against the protocol `Camera`. It is opened, grabs some
    frames, and is closed."""
    yield from _check_size(camera)
    if not isinstance(camera.dtype, np.dtype) or camera.dtype not in (np.uint8, np.uint16):
        yield f"dtype is {camera.dtype!r}: it must be np.dtype(np.uint8) or np.dtype(np.uint16)"
        return
    width, height = camera.size
    frame = np.zeros((height, width), camera.dtype)
    yield from _check_opening(camera, camera.grab, frame)
    with closing(camera):
        camera.open()
        frames = [np.full_like(frame, level) for level in (_SEEN_LEVEL, _OTHER_LEVEL)]
        for each in frames:
            camera.grab(each)
        untouched = np.sum((frames[0] == _SEEN_LEVEL) & (frames[1] == _OTHER_LEVEL))
        if untouched > frame.size // 1000:  # some may have these levels in truth
            yield f"grab left {untouched} of {frame.size} pixels as they were: fill them all"
        largest, stated = int(np.max(frames)), stated_full_scale(camera)
        if stated is None and camera.dtype == np.uint16:
            yield (
                "full_scale is missing: state the grey level at which the camera clips, such as"
                " 4095"
            )
        if stated is not None and not largest <= stated <= np.iinfo(camera.dtype).max:
            yield (
                f"full_scale is {stated}, and {camera.dtype} frames reach {largest}: state where"
                " they clip"
            )
        grabbing, wrong = "grab into an array of another", frame.astype(np.float32)
        yield from _expect(InputError, f"{grabbing} shape", camera.grab, frame[1:])
        yield from _expect(InputError, f"{grabbing} type", camera.grab, wrong)
        returned = {"settings": camera.settings(), "apply": camera.apply(CameraSettings())}
        for name, settings in returned.items():
            if not isinstance(settings, CameraSettings):
                yield f"{name} does not return CameraSettings"
        exposure = camera.settings().exposure_ms
        applied = camera.apply(CameraSettings(exposure_ms=exposure)).exposure_ms
        if applied != camera.settings().exposure_ms:
            yield (
                f"apply returns {applied} ms, and settings {camera.settings().exposure_ms} ms"
                " after it"
            )
        if exposure is not None and (
            applied is None or not np.isclose(applied, exposure, rtol=0.05)
        ):
            yield f"apply of the present exposure, {exposure:g} ms, leaves {applied} ms"


@_listed
def check_projector(projector: Projector) -> Iterator[str]:
    """List what a closed projector does against the protocol `Projector`. It is opened, shows a
    sequence, and is closed."""
    yield from _check_size(projector)
    yield from _check_opening(projector, projector.show_level, 0)
    with closing(projector):
        projector.open()
        yield from _expect(DeviceError, "show before load", projector.show, 0)
        width, height = projector.size
        frames = (
            Frame("white"),
            Frame("black"),
            *phase_steps("x", 3, 16.0),
            *phase_steps("y", 3, 16.0),
        )
        other = PatternSequence((width + 1, height), frames)
        yield from _expect(InputError, "load of patterns of another size", projector.load, other)
        for sequence in (complementary((width, height)), PatternSequence((width, height), frames)):
            projector.load(sequence)
            for index in (0, len(sequence.frames) - 1):
                projector.show(index)
        for index in (-1, len(frames)):
            yield from _expect(InputError, f"show of frame {index}", projector.show, index)
        for level in (0, 128, 255, None):
            projector.show_level(level)
        for level in (-1, 256):
            yield from _expect(InputError, f"show_level of {level}", projector.show_level, level)
        if isinstance(projector, ImageProjector):
            image = np.zeros((height, width, 3), np.uint8)
            projector.show_image(image)
            for other_image in (image[1:], image[..., 0], image.astype(np.float32)):
                what = f"show_image of {other_image.shape} {other_image.dtype}"
                yield from _expect(InputError, what, projector.show_image, other_image)
            projector.load(sequence)
        yield from _expect(
            None, "show after show_level, where the sequence stays loaded,", projector.show, 0
        )


@_listed
def check_turntable(turntable: Turntable, turn_deg: float = 5.0) -> Iterator[str]:
    """List what a closed turntable does against the protocol `Turntable`. It turns by an angle and
    back."""
    if not (turntable.name):
        yield "name is empty"
    yield from _check_opening(turntable, turntable.position_deg)
    with closing(turntable):
        turntable.open()
        start = turntable.position_deg()
        limits = turntable.limits_deg
        to = start + turn_deg
        if limits is not None and to > limits[1]:
            to = start - turn_deg
        for angle in (to, start):
            turntable.turn_to(angle)
            if abs(turntable.position_deg() - angle) > _ANGLE_TOLERANCE_DEG:
                yield f"after turn_to({angle:g}) it stands at {turntable.position_deg():g} degrees"
        if limits is not None:
            yield from _expect(
                InputError, "turn_to beyond the limits", turntable.turn_to, limits[1] + 1
            )

        def cancel() -> None:
            raise Cancelled("cancelled")

        yield from _expect(
            Cancelled, "turn_to with a check that raises", turntable.turn_to, to, cancel
        )
        turntable.turn_to(start)


@_listed
def check_importer(layout: FolderLayout, capture: Path, **options: Any) -> Iterator[str]:
    """List what a layout does wrong with a folder that holds one capture; ``options`` are those of
    its ``read``.

    Its frames are decoded and compared with their description, as an import does: use a sound
    capture, recorded or rendered. A copy of the folder without its first image, and an empty
    folder, must be refused or skipped with a reason.
    """
    if not layout.is_capture(capture):
        yield f"is_capture is False for {capture}"
        return
    imports = layout.read(capture, **options)
    if len(imports) != 1:
        yield f"read finds {len(imports)} captures in {capture}, which is one"
    for recording in imports.recordings:
        expected = recording.sequence.count_images(recording.exposures_ms)
        if len(recording.files) != expected:
            yield f"{recording.name}: {len(recording.files)} images for {expected} frames"
            continue
        try:
            new = recording.read()
            check_imported_capture(new, ignore_warnings)
        except InputError as error:
            yield str(error)
    with tempfile.TemporaryDirectory() as folder:
        empty = Path(folder) / "empty"
        empty.mkdir()
        if layout.is_capture(empty):
            yield "is_capture is True for an empty folder"
        yield from _expect(
            InputError, "read of an empty folder", partial(layout.read, empty, **options)
        )
        shorter = Path(folder) / "captures" / capture.name
        shutil.copytree(capture, shorter)
        missing = imports.recordings[0].files[0].resolve().relative_to(capture.resolve())
        (shorter / missing).unlink()
        try:
            incomplete = layout.read(shorter.parent, **options)
        except InputError:
            pass
        else:
            if len(incomplete):
                yield f"a capture without {missing} is read as if it were complete"


@_listed
def check_board(notation: str) -> Iterator[str]:
    """List what is wrong with the board of an installed plugin, by a notation such as its
    example."""
    board = Board.parse(notation)
    if Board.parse(str(board)) != board:
        yield f"{board} is another board than {notation}"
    points = board.points
    if len(np.unique(np.round(points, 6), axis=0)) != len(points):
        yield "some features have the same coordinates"
    for level in (0, 128, 255):
        blank = np.full((480, 640), level, np.uint8)
        yield from _expect(DetectionError, "detection in an empty image", detect, board, blank)


@_listed
def check_exporter(exporter: Exporter) -> Iterator[str]:
    """List what is wrong with a file format: it must encode small shapes with and without normals
    and colours."""
    rng = np.random.default_rng(0)
    points = rng.normal(0, 10, (4, 3)).astype(np.float32)
    normals = np.tile(np.array([0, 0, 1], np.float32), (4, 1))
    colours = rng.integers(0, 255, (4, 3)).astype(np.uint8)
    faces = np.array([[0, 1, 2], [1, 2, 3]], np.int32)
    if not (exporter.name == exporter.name.lower() and exporter.name.isalnum()):
        yield "name is not a plain suffix"
    shapes: list[PointSet | Mesh] = []
    if exporter.takes_points:
        shapes += [PointSet(points), PointSet(points, normals=normals, colours=colours)]
    if exporter.takes_meshes:
        shapes += [Mesh(points, faces), Mesh(points, faces, normals=normals, colours=colours)]
    if not shapes:
        yield "it takes neither points nor meshes"
    for shape in shapes:
        content = exporter.encode(shape, {"sigma": np.full(4, 0.01, np.float32)}, ("a note",))
        if not isinstance(content, bytes) or not content:
            yield f"encode of a {type(shape).__name__} does not return bytes"


def _check_size(device: Camera | Projector) -> list[str]:
    """List what is wrong with the name and the size of a closed device."""
    faults = [] if isinstance(device.name, str) and device.name else ["name is empty"]
    size = device.size
    if (
        not isinstance(size, tuple)
        or len(size) != 2
        or not all(isinstance(side, int) and side > 0 for side in size)
    ):
        faults.append(f"size is {size!r}: it must be a tuple of two int, (width, height) px")
    return faults


def _check_opening(
    device: Camera | Projector | Turntable, use: Callable[..., object], *arguments: Any
) -> Iterator[str]:
    """List faults of `open` and `close`: using a closed device is an error, closing it twice and
    reopening are not."""
    yield from _expect(DeviceError, "use before open", use, *arguments)
    yield from _expect(None, "close before open", device.close)
    with closing(device):
        device.open()
        yield from _expect(DeviceError, "a second open", device.open)
    yield from _expect(None, "a second close", device.close)
    yield from _expect(DeviceError, "use after close", use, *arguments)


def _expect(
    error: type[SlviewerError] | None, what: str, call: Callable[..., object], *arguments: Any
) -> list[str]:
    """Return a fault unless the call raises the error, or with None nothing."""
    try:
        call(*arguments)
    except Exception as raised:
        if error is not None and isinstance(raised, error):
            return []
        wanted = "nothing" if error is None else error.__name__
        return [f"{what} raises {type(raised).__name__} ({raised}), not {wanted}"]
    return [] if error is None else [f"{what} raises nothing: it must raise {error.__name__}"]


def plugins() -> str:
    """List the plugins: drivers, boards, importers, exporters, operations and panels that other
    packages add.

    Ends with status 1 where one cannot be used, and states why.
    """
    from slviewer.gui.panel import PANEL_PLUGINS

    groups = (
        *(DRIVER_PLUGINS, BOARD_PLUGINS, LAYOUT_PLUGINS, EXPORTER_PLUGINS),
        *(OPERATION_PLUGINS, PANEL_PLUGINS),
    )
    found = [each for group in groups for each in group.others]
    if not found:
        return "no plugins are installed"
    lines = [
        f"{each.group.removeprefix('slviewer.')}: {each.name}, from {each.package}:"
        f" {each.problem or 'can be used'}"
        for each in found
    ]
    if any(plugin.problem for plugin in found):
        raise InputError(
            "a plugin cannot be used: update or uninstall its package\n" + "\n".join(lines)
        )
    return "\n".join(lines)
