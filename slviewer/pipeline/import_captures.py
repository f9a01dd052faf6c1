"""Bringing captures and calibrations that other tools made into a session.

Of a folder of captures, those that can be read and decoded are saved in one step, and a warning
names each other with its reason; with `strict`, one fault refuses the folder. Those that the
session has already, with the same content, are skipped: an import that was interrupted continues
when it is repeated. A calibration becomes the session's own once it agrees with itself and with the
session's captures.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import KW_ONLY, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, get_args

import numpy as np

from slviewer.calibration.stereo import StereoModel
from slviewer.errors import InputError, UnknownLayoutError
from slviewer.examination.findings import REMEDIES, contradict
from slviewer.examination.light import estimate_frame_light
from slviewer.fringe.decode import decode
from slviewer.fringe.origin import estimate_gray_origin
from slviewer.fringe.phase import PhaseMap, PhaseMaps, Reason
from slviewer.fringe.raw_image import describe_mosaic
from slviewer.fringe.rounded_periods import (
    RoundedPeriods,
    find_rounded_periods,
    list_exact_periods,
    replace_periods,
)
from slviewer.fringe.sequence import Axis, PatternSequence, PerAxis, Size, parse_size
from slviewer.geometry.lens import Lens
from slviewer.geometry.rig import StereoRig
from slviewer.pipeline.capture_phases import decode_examined
from slviewer.pipeline.examination import examine_frames, load_or_save_examination, warn_of_exposure
from slviewer.pipeline.imported_calibration import confirm_by_captures, save_check
from slviewer.pipeline.imported_verdict import warning_of_imported
from slviewer.pipeline.models import available_models, save_imported_stereo, trash_models
from slviewer.pipeline.operation import (
    Callbacks,
    SessionLike,
    Warn,
    ignore_warnings,
    opened,
    opened_or_made,
    takes_settings,
)
from slviewer.session.capture import NewCapture, Role
from slviewer.session.importers import matlab_calibration, opencv_calibration
from slviewer.session.importers.filestorage import Storage, read_storage
from slviewer.session.importers.guess import describe_reversal
from slviewer.session.importers.guessed_frames import guess_description
from slviewer.session.importers.images import Channel, file_of
from slviewer.session.importers.imported import (
    FolderLayout,
    ImportableRecording,
    Imports,
    Skipped,
    define_layout,
    list_folders,
    none_usable,
    pair_cameras,
)
from slviewer.session.importers.layouts import (
    LAYOUT_PLUGINS,
    detect_layout,
    find_description,
    layouts,
)
from slviewer.session.layout import is_session
from slviewer.session.reading import expand_user
from slviewer.session.store import Session
from slviewer.session.units import MM, Units

GivenSize = str | Size
Keys = tuple[str, str, str, str, str, str]
QUARTER_TURNS = 0.02
"""Of a period: an origin so near to quarters of it is an offset of the fringes."""
MAX_OUTSIDE = 0.01
"""Part of the pixels whose codes may lie outside of the projector: misread ones."""


@dataclass(frozen=True)
class ImportSettings(Callbacks):
    """Which captures are imported, and how.

    Args:
        source: One capture folder, or a folder of them.
        session: Session folder; made if it does not exist.
        role: calibration for target poses, scan for anything else.
        prefix: Put before each capture's name: planes gives planes_pose_03.
        projector: Width x height of the projector, px; by default what the images' TOML states,
            else as in the session, else what the layout implies.
        channel: Of colour images; green where nothing states it.
        force: Replace captures of the same name (the old ones go to the session's trash).
        strict: Import nothing where one capture cannot be used, instead of skipping it with a
            warning.

    ``layout`` is one of `layouts.layouts()`, or "detect": the one that the file names show.
    Captures are named after their folders. ``sequence`` is the TOML of the layout frames, by
    default the one in ``source``, else what the session knows of files of the same names; where
    Gray code 0 begins is estimated from the images if it does not state that. ``origin`` is
    recorded as where the captures come from, by default their folders. ``options`` are those of the
    layout's `read`, which are keywords of `import_captures` too.
    """

    source: Path | str
    session: SessionLike
    layout: str = "detect"
    _: KW_ONLY
    sequence: Path | str | None = None
    role: Role = "calibration"
    prefix: str | None = None
    projector: GivenSize | None = None
    channel: Channel | None = None
    origin: str | None = None
    force: bool = False
    strict: bool = False
    options: Mapping[str, Any] = field(default_factory=dict)


@takes_settings(ImportSettings)
def import_captures(settings: ImportSettings) -> list[str]:
    """Import a folder of captures that another tool made; returns the captures' names.

    Captures that cannot be read or decoded are skipped, and ``warn`` is called with the reason.
    Raises InputError where none is left, or, with ``strict``, for the first of them; nothing is
    saved then. Captures that are there already, equal in every frame, stay as they are, with a
    warning; one whose stored frames are damaged is replaced.
    """
    role, progress, warn = settings.role, settings.progress, settings.warn
    imports = find_captures(
        settings.source, settings.layout, settings.sequence, prefix=settings.prefix,
        projector=settings.projector, channel=settings.channel, session=settings.session, warn=warn,
        **settings.options,
    )  # fmt: skip
    for message in imports.warnings:
        warn(message)
    skipped = list(imports.skipped)
    if settings.strict and skipped:
        raise InputError(str(skipped[0]))
    comparisons: dict[str, str] = {}  # of the captures that can be used, with those of the session
    damaged: set[str] = set()
    assumptions: dict[str, None] = {}

    def read() -> Iterator[NewCapture]:
        """Yield the checked captures one by one; one that cannot be used is a warning, or raises
        with ``strict``."""
        for i, recording in enumerate(imports.recordings):
            progress(i / len(imports), f"reading {recording.name}")
            try:
                capture = recording.read()
                sequence = _check_recording(recording, capture, warn).sequence
            except InputError as error:
                if settings.strict:
                    raise
                skipped.append(Skipped(recording.name, str(error)))
                continue
            assumptions.update(dict.fromkeys(_list_assumptions(recording, capture)))
            seen = capture.second and replace(capture.second, sequence=sequence)
            origin = settings.origin or capture.source
            capture = replace(capture, sequence=sequence, source=origin, second=seen)
            comparison = store.compare_capture(capture, role)
            comparisons[capture.name] = comparison
            if comparison == "damaged":
                warn(
                    f"{capture.name}: its stored frames are damaged: the capture is replaced, and"
                    " now in the trash"
                )
                damaged.add(capture.name)
            if comparison != "same":
                yield capture
        if not comparisons:
            raise none_usable(skipped)

    with opened_or_made(settings.session) as store:
        store.save_captures(read(), role, force=settings.force or damaged)
        for message in (*assumptions, *(f"not imported: {each}" for each in skipped)):
            warn(message)
        if unchanged := [name for name, comparison in comparisons.items() if comparison == "same"]:
            warn(
                "already in the session with the same content, and not imported again:"
                f" {', '.join(unchanged)}"
            )
        for name in comparisons:
            progress(1.0, f"looking at {name}")
            for sentence in load_or_save_examination(store, store.load_capture(name)).warnings():
                warn(f"{name}: {sentence}")
    progress(1.0, "imported")
    return list(comparisons)


def read_captures(
    source: Path | str,
    layout: str = "detect",
    *,
    sequence: Path | str | None = None,
    projector: GivenSize | None = None,
    channel: Channel | None = None,
    warn: Warn = ignore_warnings,
    **options: Any,
) -> list[NewCapture]:
    """Read a folder of captures of any known layout into memory, as ``import_captures`` does;
    nothing is saved.

    Of several exposures each pixel comes from the longest that did not clip it. Raises InputError
    where an image cannot be used; captures that are incomplete are skipped with a warning.
    """
    imports = find_captures(
        source, layout, sequence, projector=projector, channel=channel, warn=warn, **options
    )
    for message in (*imports.warnings, *map(str, imports.skipped)):
        warn(message)
    return [_merge_exposures(capture) for capture in imports]


def _merge_exposures(capture: NewCapture) -> NewCapture:
    """Return a capture in which each pixel comes from the longest exposure that did not clip it."""
    second = capture.second and _merge_exposures(capture.second)
    return replace(capture, frames=capture.merged_frames(), exposures_ms=(), second=second)


def find_captures(
    source: Path | str,
    layout: str = "detect",
    sequence: Path | str | None = None,
    *,
    prefix: str | None = None,
    projector: GivenSize | None = None,
    channel: Channel | None = None,
    session: SessionLike | None = None,
    warn: Warn = ignore_warnings,
    **options: Any,
) -> Imports:
    """The captures of a folder, not yet read; ``session`` knows the projector's size, and what
    files of the same names show, where it is not stated."""
    source = expand_user(source)
    with _opened_if_there(session) as store:
        session_layout = _layout_of_session(store, source)
        try:
            chosen = _choose_layout(source, layout, sequence, session_layout, warn)
        except UnknownLayoutError as error:
            raise _suppose_layout(source, projector, channel, error) from error
        # a file of frames states the size
        is_stated = projector is not None or chosen.name == "frames"
        assumed = None if is_stated else _known_projector_size(store)
        size = assumed or (chosen.projector if projector is None else parse_size(projector))
    assumption = assumed and (
        f"the projector is assumed to have {assumed[0]}x{assumed[1]} px, as in the session:"
        " --projector for another size"
    )
    try:
        imports = pair_cameras(chosen.read(source, prefix=prefix, projector=size, **options))
    except InputError:
        if assumption:
            warn(assumption)  # it may be why
        raise
    used = {recording.sequence.projector_size for recording in imports.recordings}
    # not where the layout has that size in any case, or its files state another
    if assumption and assumed in used and assumed != chosen.projector:
        warn(assumption)
    if channel is None:
        return imports
    recordings = [recording.read_channel(channel) for recording in imports.recordings]
    return replace(imports, recordings=recordings)


def _suppose_layout(
    source: Path, projector: GivenSize | None, channel: Channel | None, error: UnknownLayoutError
) -> UnknownLayoutError:
    """Return the error that says what the images of an unknown layout show, as far as they suggest
    it; the given error where there are too few of them."""
    size = None if projector is None else parse_size(projector)
    try:
        guess = guess_description(source, size and f"{size[0]}x{size[1]}", channel)
    except InputError:
        return error
    lines = [*guess.summary, *(f"unsure: {doubt}" for doubt in guess.doubts)]
    return UnknownLayoutError(
        "\n  ".join([f"{source} has none of the known layouts. What its images suggest:", *lines])
        + "\n`slviewer import frames --guess FOLDER --out FOLDER/sequence.toml` writes this down:"
        " correct it there, and import again"
    )


def describe_import(names: Sequence[str], role: Role) -> str:
    """Return what was imported, as the operator reads it."""
    noun = "target pose" if role == "calibration" else "scan"
    count = f"1 capture imported as a {noun}"
    if len(names) != 1:
        count = f"{len(names)} captures imported as {noun}s"
    return f"{count}: {', '.join(names)}"


def _opened_if_there(session: SessionLike | None) -> AbstractContextManager[Session | None]:
    """Return a context manager of the session; of None where there is none yet."""
    if session is None or not (isinstance(session, Session) or is_session(expand_user(session))):
        return nullcontext()
    return opened(session)


def _choose_layout(
    source: Path, layout: str, sequence: Path | str | None, same: FolderLayout | None, warn: Warn
) -> FolderLayout:
    """The layout of that name, or that of a folder; frames with the TOML that describes it, or
    ``same``, where only the session does."""
    if layout == "detect":
        try:
            layout = "frames" if sequence is not None else detect_layout(source)
        except InputError:
            if same is None:
                raise
            layout = "frames"
    known = layouts()
    if layout not in known:
        raise InputError(
            f"the layout {layout!r} is unknown",
            f"use {', '.join(known)}{LAYOUT_PLUGINS.explain_missing(layout)}",
        )
    if layout != "frames":
        return known[layout]
    if (toml := sequence or find_description(source)) is not None:
        return replace(known[layout], read=partial(known[layout].read, toml=Path(toml)))
    if same is None:
        raise InputError(
            f"{source} holds no TOML that describes the images", "add one, or give --sequence"
        )
    warn("the images are described as those of the session: --sequence to describe them")
    return same


def _layout_of_session(store: Session | None, source: Path) -> FolderLayout | None:
    """The layout of folders whose files are named like, and show the same as, those of an imported
    capture of the session; None where the source holds no such folder."""
    if store is None or not source.is_dir():
        return None
    captures = [each for each in store.captures() if each.files and not each.exposures_ms]
    same = {
        folder: capture
        for folder in list_folders(source)
        for capture in reversed(captures)
        if all(file_of(folder / file).is_file() for file in capture.files)
    }

    def describe(
        folder: Path, name: str, projector: Size | None
    ) -> tuple[ImportableRecording, list[str]]:
        """Return the recording of a folder."""
        capture = same[folder]
        size = projector or capture.sequence.projector_size
        sequence = replace(capture.sequence, projector_size=size)
        files = tuple(folder / file for file in capture.files)
        channel = capture.meta.get("settings", {}).get("channel")
        return ImportableRecording(name, sequence, files, folder, channel=channel), []

    holds = "files named as in the session"
    return define_layout("frames", holds, describe, same.__contains__) if same else None


def _known_projector_size(store: Session | None) -> Size | None:
    """The projector's size by the session's captures, else by its imported calibration; None where
    both are missing."""
    if store is None:
        return None
    sizes = {capture.sequence.projector_size for capture in store.captures()} - {None}
    if not sizes and "stereo" in available_models(store):
        meta = store.load_meta("calibration/stereo")
        return tuple(meta["projector"]) if meta.get("projector") else None
    return sizes.pop() if len(sizes) == 1 else None


def _list_assumptions(recording: ImportableRecording, capture: NewCapture) -> Iterator[str]:
    """What was assumed of a capture because nothing stated it."""
    used = capture.settings.get("channel")
    if used and recording.channel is None:
        others = ", ".join(channel for channel in get_args(Channel) if channel != used)
        yield (
            f"the frames are in colour: their {used} channel was used (--channel, or channel in the"
            f" TOML: {others})"
        )
    if recording.sequence.binary and not capture.sequence.binary:
        yield (
            "the images of plain binary numbers are stored as Gray code, by which the phase steps"
            " are counted: pixels at the edges of its cells that stay unclear are masked"
        )
    if capture.sequence.projector_size is None:
        yield (
            "the size of the projector is not stated: the captures can be decoded, and to calibrate"
            ' or reconstruct them import them again with projector = "912x1140" in the TOML, or'
            " --projector"
        )


def _centre_code(
    sequence: PatternSequence, frames: np.ndarray, axis: Axis
) -> PatternSequence | None:
    """Return a sequence whose Gray code alone is centred on the projector along an axis; None
    unless the codes in view exceed the projector without that, and do not with it."""
    if sequence.projector_size is None:
        return None
    origins = {"x": sequence.origin_px("x"), "y": sequence.origin_px("y")}
    excess = 2 ** len(sequence.find("gray", axis)) * sequence.gray_cell(axis) - sequence.extent(
        axis
    )
    origins[axis] = -0.5 - excess / 2
    centred = replace(sequence, gray_origin_px=PerAxis(**origins))
    outside = [decode(each, frames, axis).share(Reason.OUTSIDE) for each in (sequence, centred)]
    return centred if outside[1] < MAX_OUTSIDE < outside[0] else None


def _check_recording(recording: ImportableRecording, capture: NewCapture, warn: Warn) -> NewCapture:
    """`check_imported_capture`; InputError, too, where numbers that are read as Gray code
    contradict their description, and with exchanged axes as a remedy for codes that do not cover
    the projector, where those would."""
    if recording.sequence.binary != capture.sequence.binary and not capture.exposures_ms:
        shown = recording.read(as_shown=True)
        examination = examine_frames(shown.sequence, shown.frames, shown.files)
        for finding in examination.rejected:
            raise InputError(f"{shown.name}: {finding.text()}")
    try:
        return check_imported_capture(capture, warn)
    except InputError as error:
        others: dict[Axis | None, Axis] = {"x": "y", "y": "x"}
        own = capture.sequence
        frames = (replace(frame, axis=others.get(frame.axis)) for frame in own.frames)
        described, exchanged = (
            [contradict(each, axis) is not None for axis in own.axes]
            for each in (own, replace(own, frames=tuple(frames)))
        )
        if len(own.axes) == 2 and any(described) and not any(exchanged):
            remedy = f"{error.remedy}, or {REMEDIES['axes-swapped']}"
            raise InputError(error.observation, remedy, error.place) from None
        raise


def check_imported_capture(capture: NewCapture, warn: Warn) -> NewCapture:
    """The capture with merged exposures, and with its Gray origin estimated if it was not given;
    InputError where its frames contradict its description.
    """
    capture = _merge_exposures(capture)
    sequence, frames = capture.sequence, capture.frames
    has_gray = any(frame.kind == "gray" for frame in sequence.frames)
    if has_gray and not capture.settings.get("gray_origin_given", True):
        sequence = _estimate_origins(capture, warn)
        for axis in (each for each in sequence.axes if not sequence.periods_px(each)):
            if (centred := _centre_code(sequence, frames, axis)) is not None:
                sequence = centred
                warn(
                    f"{capture.name}: the codes along {axis} fit the projector if they are centred"
                    f" on it: gray_origin is taken for {sequence.origin_px(axis):g} px"
                )
    if mosaic := describe_mosaic(capture.name, frames):
        warn(mosaic)
    sequence, phases = _decode_described(replace(capture, sequence=sequence), warn)
    warn_of_exposure(capture.name, sequence, frames, phases, warn)
    for axis, decoded in phases.items():
        if unneeded := _describe_unneeded_bits(sequence, axis):
            warn(f"{capture.name}: {unneeded}")
        if other := _explain_fall(sequence, decoded):
            warn(f"{capture.name}: {describe_reversal(axis, 'the coordinate falls', other)}")
        if rounded := find_rounded_periods(sequence, frames, decoded):
            sequence = _take_periods(capture.name, sequence, axis, rounded, warn)
    return replace(capture, sequence=sequence)


def _describe_unneeded_bits(sequence: PatternSequence, axis: Axis) -> str:
    """Return that a code has more bits than the cells of the projector need, in words; empty where
    it has not: cells that are described too wide double the coordinates, and nothing shows it."""
    bits, cell = len(sequence.find("gray", axis)), sequence.gray_cell(axis)
    if not bits or sequence.projector_size is None:
        return ""
    cells = int(np.ceil((sequence.extent(axis) - sequence.origin_px(axis) - 0.5) / cell))
    if 2 ** (bits - 1) < cells:
        return ""
    return (
        f"axis {axis} has {bits} bits, and its {cells} cells of {cell:g} px need fewer: see that"
        " gray_cell_px and the projector's size are right"
    )


def _explain_fall(sequence: PatternSequence, decoded: PhaseMap) -> str:
    """Return what else makes the coordinate of fringes or of a binary code alone fall along its own
    axis of the camera than a turned device; empty where it does not fall, or the frames tell."""
    axis = decoded.axis
    other = f"or phase_sign is {-sequence.sign(axis)}, which fringes alone do not show"
    if sequence.find("gray", axis):
        if decoded.steps or not (sequence.binary and sequence.find("inverse", axis)):
            return ""
        other = "or patterns and inverses are exchanged, which a binary code alone does not show"
    along = "yx".index(axis)
    own, across = (np.nanmean(np.diff(decoded.phase, axis=i)) for i in (along, 1 - along))
    return other if own < -abs(across) else ""


def _decode_described(capture: NewCapture, warn: Warn) -> tuple[PatternSequence, PhaseMaps]:
    """Return the sequence of a capture of one exposure, and its decoded phases. Where the frames
    contradict it, and not one with the periods that its own are rounded from, these are taken: too
    short beats, and periods of few decimals, look like other faults. Raises InputError by what the
    described periods show, or by these where the described ones cannot be decoded."""
    name, sequence, messages = capture.name, capture.sequence, list[str]()
    try:
        return sequence, decode_examined(name, sequence, capture.frames, capture.files)
    except InputError as error:
        whole = sequence
        for axis in sequence.axes:
            if exact := list_exact_periods(sequence, axis):
                rounded = RoundedPeriods(exact, sequence.extent(axis), fit=1.0, sigma=0.0)
                whole = _take_periods(name, whole, axis, rounded, messages.append)
        if not messages:
            raise
        try:
            phases = decode_examined(name, whole, capture.frames, capture.files)
        except InputError as exact_error:
            is_decodable = not any(contradict(sequence, axis) for axis in sequence.axes)
            raise (error if is_decodable else exact_error) from None
    for message in messages:
        warn(message)
    return whole, phases


def _take_periods(
    name: str, sequence: PatternSequence, axis: Axis, rounded: RoundedPeriods, warn: Warn
) -> PatternSequence:
    """Return the sequence with the periods that its own are rounded from, if they are, and warn of
    these and of those that may be."""
    if rounded.is_contradicted:
        return sequence
    extent = sequence.extent(axis)
    off_px = extent * max(abs(exact / each - 1) for each, exact in rounded.exact.items())
    described = [f"{each:g}" for each in rounded.exact]
    stated = [f'"{extent}/{count}"' for count in rounded.fringes]
    remedy = " and ".join(f"{a} as {b}" for a, b in zip(described, stated, strict=True))
    counts = " and ".join(map(str, rounded.fringes))
    is_taken = rounded.is_taken
    warn(
        f"{name}: {' and '.join(described)} px along {axis} {'are' if is_taken else 'may be'}"
        f" rounded from {counts} fringes across {extent} px,"
        f" {'which are taken' if is_taken else 'which the frames do not show'}: rounded periods put"
        f" coordinates up to {off_px:.2g} px off. State {remedy} in period_px"
    )
    return replace_periods(sequence, axis, rounded.exact) if is_taken else sequence


def _estimate_origins(capture: NewCapture, warn: Warn) -> PatternSequence:
    """Return the sequence with the Gray origin of each axis that has fringes too; or, where that is
    quarters of a period, as a sine or another sign makes them, with a phase offset: code 0 begins
    at the projector's first column, unless stated."""
    sequence, frames = capture.sequence, capture.frames
    axes = [
        each for each in sequence.axes if sequence.periods_px(each) and sequence.find("gray", each)
    ]
    try:
        light = estimate_frame_light(sequence, frames)
        origins = {axis: estimate_gray_origin(sequence, frames, axis, light) for axis in axes}
    except InputError:
        # Frames out of order and changed light leave no common origin; name the cause.
        unstated = ("gray-origin", "phase-offset")
        for finding in examine_frames(sequence, frames, capture.files).rejected:
            if finding.cause not in unstated:
                raise InputError(finding.text()) from None
        raise
    if not origins:
        return sequence
    offsets = {"x": sequence.offset_rad("x"), "y": sequence.offset_rad("y")}
    for axis, origin in origins.items():
        # the first column begins half a pixel before its middle, which some count as 0
        period, edge = sequence.periods_px(axis)[-1], 0.25
        quarters = round(4 * (origin + edge) / period)
        rest = origin - quarters / 4 * period
        if quarters % 4 and abs(rest + edge) < edge + QUARTER_TURNS * period:
            offsets[axis] = (offsets[axis] + np.pi / 2 * quarters) % (2 * np.pi)
            origins[axis] = rest
            warn(
                f"{capture.name}: by the Gray code, the fringes along {axis} begin"
                f" {-quarters / 4 % 1:g} periods late: phase_offset = {offsets[axis]:.3f} (rad) is"
                f" taken; if the code begins elsewhere instead, state gray_origin = {origin:.2f}"
                " (px)"
            )
    listed = ", ".join(f"{origin:.2f} px along {axis}" for axis, origin in origins.items())
    warn(f"{capture.name}: by the fringes, Gray code 0 begins at {listed}")
    first = next(iter(origins.values()))
    origin_px = PerAxis(origins.get("x", first), origins.get("y", first))
    return replace(sequence, gray_origin_px=origin_px, phase_offset_rad=PerAxis(**offsets))


def import_opencv_calibration(
    file: Path | str,
    session: SessionLike,
    keys: Keys | None = None,
    *,
    unit: Units | None = None,
    projector: GivenSize | None = None,
    camera: GivenSize | None = None,
    force: bool = False,
    warn: Warn = ignore_warnings,
) -> StereoModel | None:
    """Import a stereo calibration made elsewhere, from an OpenCV FileStorage file.

    Args:
        file: The .yml, .xml or .json file.
        session: Session folder; made if it does not exist.
        keys: The file's names for the matrices K_camera D_camera K_projector D_projector R T; R and
            T map camera to projector. By default the common names are recognised, those of MATLAB's
            parameters too, and those used are printed.
        unit: Unit of T; by default what the file states, else mm, which is checked where a capture
            shows a known length.
        projector: Width x height of the projector, px; by default what the file states, else the
            session's captures.
        camera: Width x height of the camera, px; by default what the file states, else the
            session's captures.
        force: Replace the session's stereo calibration (the old one goes to the session's trash).

    Returns the model, or None while nothing states a size. The session's other calibrations go to
    the trash with the stereo one that they were made from.

    Raises InputError, and replaces nothing, where sizes contradict each other, and where the
    patterns of a capture in the session contradict the calibration: R and T inverted or transposed,
    matrices exchanged or at another pixel scale, another rig. Warns where no capture confirms it.
    """
    path = Path(file)
    storage = read_storage(path)
    unit = unit or matlab_calibration.read_unit(storage)
    matrices = opencv_calibration.read_matrices(storage, keys, MM[unit or "mm"])
    stated = opencv_calibration.read_sizes(storage)
    _warn_of_unused(storage, keys, stated, warn)
    with opened_or_made(session) as store:
        there = available_models(store)
        if there and not force:
            raise InputError(
                f"{store.folder} holds a {' and a '.join(there)} calibration already",
                "replace it with --force (it goes to the session's trash)",
            )
        captures = store.captures(with_frames=True)
        others = {capture.other_size for capture in captures} - {None}
        sizes = {
            device: _resolve_size(path, device, given, stated, captured)
            for device, given, captured in (
                ("camera", camera, {capture.size for capture in captures}),
                ("projector", projector, others),
            )
        }
        camera_lens, projector_lens = (  # raises what a lens cannot have
            Lens(matrices[f"K_{device}"], matrices[f"D_{device}"], size or (1, 1))
            for device, size in sizes.items()
        )
        rig = StereoRig(camera_lens, projector_lens, matrices["R"], matrices["T"])
        model = None if None in sizes.values() else StereoModel.from_rig(rig)
        checks = () if model is None else confirm_by_captures(captures, model.rig)
        if not any(check.is_good for check in checks):
            _check_principal_points(matrices, sizes, warn)
        with store.together():
            trash_models(store, there)
            save_imported_stereo(store, matrices, source=str(file), unit=unit, **sizes)
        for check in checks:
            save_check(store, check)
        if warning := warning_of_imported(store):
            warn(warning)
        return model


def _warn_of_unused(
    storage: Storage, keys: Keys | None, sizes: dict[str, tuple[Size, str]], warn: Warn
) -> None:
    """Warn of the entries of a calibration that an import does not use, by their names; ``sizes``:
    those that it states."""
    keys_used = keys or opencv_calibration.identify_keys(storage)
    if unused := opencv_calibration.list_unused(storage, keys_used, sizes):
        warn(f"{storage.name}: not used: {', '.join(unused)}")


def identify_calibration_keys(file: Path | str) -> dict[str, str]:
    """{entry: the file's name for it}, as ``import_opencv_calibration`` takes them by default.
    Raises InputError."""
    keys = opencv_calibration.identify_keys(read_storage(Path(file)))
    return dict(zip(opencv_calibration.ENTRIES, keys, strict=True))


def _resolve_size(
    path: Path,
    device: str,
    given: GivenSize | None,
    stated: dict[str, tuple[Size, str]],
    captured: set[Any],
) -> Size | None:
    """The size that is given, else stated in the file, else the captures'; InputError where these
    differ."""
    sources = {f"--{device}": parse_size(given)} if given is not None else {}
    if device in stated:
        sources[f"{path.name}: {stated[device][1]}"] = stated[device][0]
    if len(captured) == 1:
        sources["the session's captures"] = next(iter(captured))
    if len(set(sources.values())) > 1:
        conflict = ", ".join(
            f"{width}x{height} px by {source}" for source, (width, height) in sources.items()
        )
        raise InputError(
            f"the {device} has {conflict}",
            "the calibration does not belong to these captures, or one size is wrong",
        )
    size = next(iter(sources.values()), None)
    if len(captured) > 1 and size not in captured:
        raise InputError(
            f"the session's captures have several {device} sizes",
            f"give the calibrated one with --{device}",
        )
    return size


def _check_principal_points(
    matrices: Mapping[str, np.ndarray], sizes: Mapping[str, Size | None], warn: Warn
) -> None:
    """Warn where an optical axis is outside of its image: a shifted lens, or another pixel
    scale."""
    for device, size in sizes.items():
        if size is None:
            continue
        (width, height), (cx, cy) = size, matrices[f"K_{device}"][:2, 2]
        if -0.5 <= cx <= width - 0.5 and -0.5 <= cy <= height - 0.5:
            continue
        warn(
            f"the {device}'s principal point ({cx:.0f}, {cy:.0f}) lies outside of its"
            f" {width}x{height} px: the lens is shifted, camera and projector are exchanged in the"
            " file, or it is of another pixel scale; import a capture with patterns along both"
            " axes, and the calibration after it: the patterns then tell"
        )
