"""Bringing captures that other tools made into a session.

Of a folder of captures, those that can be read and decoded are saved in one step, and a warning
names each other with its reason; with `strict`, one fault refuses the folder. Those that the
session has already, with the same content, are skipped: an import that was interrupted continues
when it is repeated.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from slviewer.errors import InputError
from slviewer.examination.light import estimate_frame_light
from slviewer.fringe.decode import decode
from slviewer.fringe.origin import estimate_gray_origin
from slviewer.fringe.phase import Reason
from slviewer.fringe.sequence import Axis, PatternSequence, PerAxis, parse_size
from slviewer.pipeline.capture_phases import decode_examined
from slviewer.pipeline.examination import examine_frames, load_or_save_examination
from slviewer.pipeline.exposure_check import warn_of_exposure
from slviewer.pipeline.feedback import Progress, Warn, ignore_progress, ignore_warnings
from slviewer.pipeline.models import available_models
from slviewer.pipeline.open_session import SessionLike, opened, opened_or_made
from slviewer.session.capture import Capture, NewCapture
from slviewer.session.importers import guessed_description
from slviewer.session.importers.guessed_description import GuessedDescription
from slviewer.session.importers.images import Channel
from slviewer.session.importers.imported import (
    FolderLayout,
    ImportableRecording,
    Imports,
    Skipped,
    define_layout,
    none_usable,
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

Role = Literal["calibration", "scan"]
Size = str | tuple[int, int]
MAX_OUTSIDE = 0.01
"""Part of the pixels whose codes may lie outside of the projector: misread ones."""


def import_captures(
    source: Path | str,
    session: SessionLike,
    layout: str = "detect",
    *,
    sequence: Path | str | None = None,
    role: Role = "calibration",
    prefix: str | None = None,
    projector: Size | None = None,
    channel: Channel | None = None,
    origin: str | None = None,
    force: bool = False,
    strict: bool = False,
    progress: Progress = ignore_progress,
    warn: Warn = ignore_warnings,
    **options: Any,
) -> list[str]:
    """Import a folder of captures that another tool made; returns the captures' names.

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
    layout's `read`.

    Captures that cannot be read or decoded are skipped, and ``warn`` is called with the reason.
    Raises InputError where none is left, or, with ``strict``, for the first of them; nothing is
    saved then. Captures that are there already, equal in every frame, stay as they are, with a
    warning; one whose stored frames are damaged is replaced.
    """
    imports = find_captures(
        source,
        layout,
        sequence,
        prefix=prefix,
        projector=projector,
        channel=channel,
        session=session,
        warn=warn,
        **options,
    )
    for message in imports.warnings:
        warn(message)
    skipped = list(imports.skipped)
    if strict and skipped:
        raise InputError(str(skipped[0]))

    stated: set[str] = set()
    names: list[str] = []
    unchanged: list[str] = []
    damaged: set[str] = set()

    def warn_once(message: str) -> None:
        """Issue a warning unless the same message was issued before."""
        if message not in stated:
            stated.add(message)
            warn(message)

    def read() -> Iterator[NewCapture]:
        """Yield the checked captures one by one; one that cannot be used is a warning, or raises
        with ``strict``."""
        for i, recording in enumerate(imports.recordings):
            progress(i / len(imports), f"reading {recording.name}")
            try:
                capture = recording.read()
                checked_capture = check_imported_capture(
                    replace(capture, frames=capture.merged_frames(), exposures_ms=()), warn
                )
            except InputError as error:
                if strict:
                    raise
                skipped.append(Skipped(recording.name, str(error)))
                continue
            for message in _list_assumptions(recording, capture):
                warn_once(message)
            names.append(capture.name)
            capture = replace(
                capture, sequence=checked_capture.sequence, source=origin or capture.source
            )
            comparison = store.compare_capture(capture, role)
            if comparison == "same":
                unchanged.append(capture.name)
                continue
            if comparison == "damaged":
                warn(
                    f"{capture.name}: its stored frames are damaged: the capture is replaced, and"
                    " now in the trash"
                )
                damaged.add(capture.name)
            yield capture
        if len(skipped) == len(imports.skipped) + len(imports.recordings):
            raise none_usable(skipped)

    with opened_or_made(session) as store:
        store.save_captures(read(), role, force=force or damaged)
        for each in skipped:
            warn(f"not imported: {each}")
        if unchanged:
            warn(
                "already in the session with the same content, and not imported again:"
                f" {', '.join(unchanged)}"
            )
        for name in names:
            progress(1.0, f"looking at {name}")
            for sentence in load_or_save_examination(store, store.load_capture(name)).warnings():
                warn(f"{name}: {sentence}")
    progress(1.0, "imported")
    return names


def read_captures(
    source: Path | str,
    layout: str = "detect",
    *,
    sequence: Path | str | None = None,
    projector: Size | None = None,
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
    return [
        replace(capture, frames=capture.merged_frames(), exposures_ms=()) for capture in imports
    ]


def find_captures(
    source: Path | str,
    layout: str = "detect",
    sequence: Path | str | None = None,
    *,
    prefix: str | None = None,
    projector: Size | None = None,
    channel: Channel | None = None,
    session: SessionLike | None = None,
    warn: Warn = ignore_warnings,
    **options: Any,
) -> Imports:
    """The captures of a folder, not yet read; ``session`` knows the projector's size, and what
    files of the same names show, where it is not stated."""
    source = expand_user(source)
    same = _layout_of_session(session, source)
    if layout == "detect":
        layout = "frames" if sequence is not None else _detect_layout(source, same)
    known = layouts()
    if layout not in known:
        raise InputError(
            f"the layout {layout!r} is unknown: use"
            f" {', '.join(known)}{LAYOUT_PLUGINS.explain_missing(layout)}"
        )
    size = None if projector is None else parse_size(projector)
    assumed = None
    if layout == "frames":
        toml = sequence or find_description(source)
        if toml is not None:
            options["toml"] = Path(toml)
        elif same is not None:
            known = {layout: same}
            warn("the images are described as those of the session: --sequence to describe them")
        else:
            raise InputError(
                f"{source} holds no TOML that describes the images: add one, or give --sequence"
            )
    elif size is None:
        assumed = _known_projector_size(session)
        size = assumed or known[layout].projector
    try:
        imports = known[layout].read(source, prefix=prefix, projector=size, **options)
    except InputError:
        _warn_of_assumed_size(assumed, warn)  # it may be why
        raise
    sizes = {recording.sequence.projector_size for recording in imports.recordings}
    # a layout that states the size itself does not use the assumed one
    if assumed in sizes - {known[layout].projector}:
        _warn_of_assumed_size(assumed, warn)
    if channel is not None:
        imports = replace(
            imports,
            recordings=[replace(recording, channel=channel) for recording in imports.recordings],
        )
    return imports


def guess_description(
    folder: Path | str, *, projector: Size | None = None, channel: Channel | None = None
) -> GuessedDescription:
    """The TOML of a capture without a description, from its images; ``doubts`` name what stays
    open. Nothing is saved.

    Of a folder of captures, the first is read. Raises InputError where the images cannot belong to
    one capture.
    """
    return guessed_description.guess_toml(
        Path(folder), None if projector is None else parse_size(projector), channel
    )


def describe_import(names: Sequence[str], role: Role) -> str:
    """Return what was imported, as the operator reads it."""
    one, several = (
        ("a target pose", "target poses") if role == "calibration" else ("a scan", "scans")
    )
    count = (
        f"1 capture imported as {one}"
        if len(names) == 1
        else f"{len(names)} captures imported as {several}"
    )
    return f"{count}: {', '.join(names)}"


def _warn_of_assumed_size(size: tuple[int, int] | None, warn: Warn) -> None:
    """Warn that the projector's size was taken from the session, if it was."""
    if size is not None:
        warn(
            f"the projector is assumed to have {size[0]}x{size[1]} px, as in the session:"
            " --projector for another size"
        )


def _detect_layout(source: Path, same: FolderLayout | None) -> str:
    """The name of the layout of a folder; frames where only the session describes it."""
    try:
        return detect_layout(source)
    except InputError:
        if same is None:
            raise
        return "frames"


def _layout_of_session(session: SessionLike | None, source: Path) -> FolderLayout | None:
    """The layout of folders whose files are named like, and show the same as, those of an imported
    capture of the session; None where the source holds no such folder."""
    if session is None or not (isinstance(session, Session) or is_session(expand_user(session))):
        return None
    with opened(session) as store:
        captures = [each for each in store.captures() if each.files and not each.exposures_ms]

    def find_same(folder: Path) -> Capture | None:
        """Return a capture whose files the folder holds."""
        named = (each for each in captures if all((folder / f).is_file() for f in each.files))
        return next(named, None)

    def describe(
        folder: Path, name: str, projector: tuple[int, int] | None
    ) -> tuple[ImportableRecording, list[str]]:
        """Return the recording of a folder."""
        same = find_same(folder)
        assert same is not None
        sequence = replace(same.sequence, projector_size=projector or same.sequence.projector_size)
        files = tuple(folder / file for file in same.files)
        channel = same.meta.get("settings", {}).get("channel")
        return ImportableRecording(name, sequence, files, folder, channel=channel), []

    if not source.is_dir() or not any(map(find_same, (source, *source.iterdir()))):
        return None
    holds = "files named as in the session"
    return define_layout("frames", holds, describe, lambda folder: find_same(folder) is not None)


def _known_projector_size(session: SessionLike | None) -> tuple[int, int] | None:
    """The projector's size by the session's captures, else by its imported calibration; None where
    both are missing."""
    if session is None or not (isinstance(session, Session) or is_session(expand_user(session))):
        return None
    with opened(session) as store:
        sizes = {capture.sequence.projector_size for capture in store.captures()} - {None}
        if not sizes and "stereo" in available_models(store):
            meta = store.load_result("calibration/stereo", only=())[0]
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
    outside = [
        (phase.reason == Reason.OUTSIDE).sum() / max(1, int(phase.illuminated.sum()))
        for phase in (decode(each, frames, axis) for each in (sequence, centred))
    ]
    return centred if outside[1] < MAX_OUTSIDE < outside[0] else None


def check_imported_capture(capture: NewCapture, warn: Warn) -> NewCapture:
    """The capture, with its Gray origin estimated if it was not given; InputError where its frames
    contradict its description.
    """
    sequence = capture.sequence
    if not capture.settings.get("gray_origin_given", True) and any(
        f.kind == "gray" for f in sequence.frames
    ):
        axes = [
            axis
            for axis in sequence.axes
            if sequence.periods_px(axis) and sequence.find("gray", axis)
        ]
        try:
            light = estimate_frame_light(sequence, capture.frames)
            origins = {
                axis: estimate_gray_origin(sequence, capture.frames, axis, light) for axis in axes
            }
        except InputError:
            # Frames out of order and changed light leave no common origin; name the cause.
            unstated = ("gray-origin", "phase-offset")
            for finding in examine_frames(sequence, capture.frames, capture.files).rejected:
                if finding.cause not in unstated:
                    raise InputError(finding.text()) from None
            raise
        if origins:
            first = next(iter(origins.values()))
            sequence = replace(
                sequence, gray_origin_px=PerAxis(origins.get("x", first), origins.get("y", first))
            )
            listed = ", ".join(f"{origin:.2f} px along {axis}" for axis, origin in origins.items())
            warn(f"{capture.name}: by the fringes, Gray code 0 begins at {listed}")
        for axis in (each for each in sequence.axes if not sequence.periods_px(each)):
            if (centred := _centre_code(sequence, capture.frames, axis)) is not None:
                sequence = centred
                warn(
                    f"{capture.name}: the codes along {axis} fit the projector if they are centred"
                    f" on it: gray_origin is taken for {sequence.origin_px(axis):g} px"
                )
    phases = decode_examined(capture.name, sequence, capture.frames, capture.files)
    warn_of_exposure(capture.name, sequence, capture.frames, phases, warn)
    return replace(capture, sequence=sequence)
