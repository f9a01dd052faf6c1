"""What an importer hands back, and how it finds the capture folders in a source."""

import os
import re
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from fnmatch import translate
from pathlib import Path
from typing import Any

from slviewer.errors import InputError
from slviewer.fringe.binary_bits import has_binary_beside_phase, to_gray_code
from slviewer.fringe.sequence import PatternSequence, Size
from slviewer.session.capture import NewCapture
from slviewer.session.importers.images import (
    DEFAULT_CHANNEL,
    IMAGE_SUFFIXES,
    SEVERAL,
    Channel,
    count_images,
    file_of,
    is_raw,
    list_pages,
    read_frames,
    warn_of_unread,
)
from slviewer.session.names import join_names, natural_key, natural_order, new_name, plain_name
from slviewer.session.reading import expand_user

_MOST_REASONS = 3


@dataclass(frozen=True)
class ImportableRecording:
    """One capture that is complete by its file names, not yet read."""

    name: str
    sequence: PatternSequence
    # one a frame, in the sequence's order; of several exposures one after the other
    files: tuple[Path, ...]
    source: Path
    settings: Mapping[str, Any] = field(default_factory=dict)
    channel: Channel | None = None  # of colour frames; None: the default
    exposures_ms: tuple[float, ...] = ()
    second: "ImportableRecording | None" = None  # of a second camera
    unknown: tuple[Path, ...] = ()  # images beside these that the layout does not know

    def read_channel(self, channel: Channel) -> "ImportableRecording":
        """Return the recording with another channel of colour frames, of both cameras."""
        second = None if self.second is None else self.second.read_channel(channel)
        return replace(self, channel=channel, second=second)

    def read(self, as_shown: bool = False) -> NewCapture:
        """The capture with its frames; InputError where an image cannot be used.
        `settings["channel"]` states which channel of colour frames was taken. ``as_shown``: without
        a second camera, and with plain binary numbers beside phase steps as they are."""
        capture = self._read_own(as_shown)
        if self.second is None or as_shown:
            return capture
        second = replace(self.second._read_own(), sequence=capture.sequence, texture=None)
        return replace(capture, second=second)

    def _read_own(self, as_shown: bool = False) -> NewCapture:
        """The capture without what a second camera saw."""
        channel = self.channel or DEFAULT_CHANNEL
        kinds = [frame.kind for frame in self.sequence.frames]
        # the frame that shows the scene's colours, in the middle one of several exposures
        shown = next((kinds.index(kind) for kind in ("texture", "white") if kind in kinds), None)
        middle = len(self.exposures_ms) // 2 * len(kinds)
        colour_frame = None if shown is None else shown + middle
        images = read_frames(self.files, colour_frame, channel, self.sequence.full_scale)
        settings = {**self.settings, "channel": channel} if images.in_colour else self.settings
        sequence, stack = replace(self.sequence, full_scale=images.full_scale), images.stack
        if has_binary_beside_phase(sequence) and not as_shown:
            sequence, stack = to_gray_code(sequence, stack)
        files = [
            file.relative_to(self.source) if file.is_relative_to(self.source) else file
            for file in self.files
        ]
        return NewCapture(
            self.name, sequence, stack, images.texture, str(self.source), settings,
            self.exposures_ms,
            tuple(file.as_posix() for file in files),
        )  # fmt: skip


@dataclass(frozen=True)
class Skipped:
    """A capture folder that cannot be imported, and why."""

    name: str
    reason: str

    def __str__(self) -> str:
        return f"{self.name}: {self.reason.removeprefix(f'{self.name}: ')}"


@dataclass(frozen=True)
class Imports:
    """All captures of a source. Iterating reads them one at a time, so that memory is needed for
    one."""

    recordings: Sequence[ImportableRecording]
    messages: Sequence[str]  # warnings of the layout
    # captures whose files are missing, double or contradict the layout
    skipped: Sequence[Skipped] = ()

    @property
    def warnings(self) -> list[str]:
        """The layout's messages, and which files, folders and channels were not used."""
        unknown = (
            message
            for each in self.recordings
            for message in unknown_files_warning(each.source, each.unknown)
        )
        firsts = [each.files[0] for each in self.recordings if each.files]
        return [*self.messages, *unknown, *warn_of_unread(firsts)]

    def __len__(self) -> int:
        return len(self.recordings)

    def __iter__(self) -> Iterator[NewCapture]:
        return (recording.read() for recording in self.recordings)


@dataclass(frozen=True)
class FolderLayout:
    """How a tool lays its captures out on disk.

    ``read(source, prefix=, projector=, ...)`` reads a source; ``is_capture(folder)``: whether the
    file names in a folder are those of one capture; ``projector``: its size where none is given,
    None where the layout implies none.
    """

    name: str
    holds: str
    read: Callable[..., Imports]
    is_capture: Callable[[Path], bool]
    projector: Size | None = None

    def recognises(self, folder: Path) -> bool:
        """Whether `is_capture` is true; False where it fails, so that one layout does not hide the
        others."""
        try:
            return bool(self.is_capture(folder))
        except Exception:  # whatever a plugin raises; `check_importer` shows it to its author
            return False


def define_layout(
    name: str,
    holds: str,
    describe: Callable[..., tuple[ImportableRecording, list[str]]],
    is_capture: Callable[[Path], bool],
    projector: Size | None = None,
    needs_projector: str = "",
) -> FolderLayout:
    """Return a layout whose captures are recognised by their file names alone.

    ``describe(folder, name, projector)`` returns the recording of one folder and warnings; it may
    have more parameters, which Python passes to `read`; ``needs_projector``: what depends on the
    projector's size, if anything does.
    """
    default = projector

    def read(
        source: Path,
        *,
        prefix: str | None = None,
        projector: Size | None = None,
        **options: Any,
    ) -> Imports:
        """Return the captures of a source; InputError where the projector's size is needed and not
        given."""
        size = projector or default
        if size is None and needs_projector:
            raise missing_projector(needs_projector)
        return collect_captures(
            Path(source),
            prefix,
            is_capture,
            holds,
            lambda folder, name: describe(folder, name, size, **options),
        )

    return FolderLayout(name, holds, read, is_capture, default)


def missing_projector(what: str) -> InputError:
    """Return the error that the projector's size, on which ``what`` depends, is not known."""
    return InputError(f"{what} depend on the projector's size", "give it with --projector 1280x800")


def has_wildcard(name: str) -> bool:
    """Return whether a name contains the wildcards * or ?."""
    return "*" in name or "?" in name


def match_files(folder: Path, pattern: str) -> list[Path]:
    """The images in a folder, or in the inner folder that the pattern names, whose name matches, as
    `images_by_name`."""
    *inner, last = pattern.split("/")
    folder = folder.joinpath(*inner)
    if not folder.is_dir():
        return []
    return images_by_name(folder, re.compile(translate(last.replace("[", "[[]"))))


def images_by_name(folder: Path, pattern: re.Pattern[str] = re.compile("")) -> list[Path]:
    """The images of a folder whose name matches, in `natural_order` of their names. Of a RAW file
    and an image that the camera made of it, the RAW file alone. The only image is its pages, as
    `list_pages` names them, where it is a TIFF of several."""
    images = [
        entry
        for entry in visible(folder)
        if entry.suffix.lower() in IMAGE_SUFFIXES and pattern.match(entry.name)
    ]
    raw = {file.stem for file in images if is_raw(file)}
    chosen = [file for file in images if is_raw(file) or file.stem not in raw]
    if len(chosen) == 1:
        return list_pages(chosen[0])
    return [folder / name for name in natural_order([file.name for file in chosen])]


def explain_stacks(folders: Sequence[Path]) -> str:
    """Return what could be done about files of several images in folders, as a sentence; "" where
    there are none."""
    for file in (entry for folder in folders for entry in sorted(visible(folder))):
        if file.suffix.lower() in (".gif", *IMAGE_SUFFIXES) and (count := count_images(file)) > 1:
            return f". {file.name} holds {count} images: {SEVERAL}"
    return ""


def match_images(
    folder: Path, pattern: re.Pattern[str]
) -> tuple[dict[tuple[int, ...], Path], list[Path]]:
    """{numbers in its name: image} of a folder's images whose stem matches the pattern, in order of
    the numbers, and its other entries. Raises InputError where two images have the same numbers."""
    images: dict[tuple[int, ...], Path] = {}
    others: list[Path] = []
    for file in sorted(visible(folder)):
        match = pattern.fullmatch(file.stem)
        if not match or file.suffix.lower() not in IMAGE_SUFFIXES:
            others.append(file)
            continue
        numbers = tuple(int(group) for group in match.groups())
        if numbers in images:
            raise InputError(
                f"it holds {images[numbers].name} and {file.name} for one pattern",
                "keep one of them",
            )
        images[numbers] = file
    return dict(sorted(images.items())), others


def check_complete(
    images: Mapping[tuple[int, ...], Path], stem: str, count: int = 0, first: int = 0
) -> None:
    """Raise InputError where images numbered ``first``, ``first`` + 1, ... have gaps, or are fewer
    than ``count``.

    Numbers of missing images are named with as many digits as those that are there.
    """
    if not images and not count:
        raise InputError(
            f"it holds no images {stem}{first:02d} and so on", "copy or record them again"
        )
    end = first + count if count else max(images)[0] + 1
    if missing := [number for number in range(first, end) if (number,) not in images]:
        digits = min(
            (
                len(run)
                for (number,), file in images.items()
                for run in re.findall(r"\d+", file.stem)
                if int(run) == number
            ),
            default=2,
        )
        raise InputError(
            f"it lacks {stem}{join_names([f'{n:0{digits}d}' for n in missing])}",
            "copy or record them again",
        )


def has_images(folder: Path, pattern: re.Pattern[str]) -> bool:
    """Whether a folder exists and contains images whose stem matches the pattern."""
    return folder.is_dir() and any(
        pattern.fullmatch(entry.stem) and entry.suffix.lower() in IMAGE_SUFFIXES
        for entry in visible(folder)
    )


def collect_captures(
    source: Path,
    prefix: str | None,
    is_capture: Callable[[Path], bool],
    looks_like: str,
    describe: Callable[[Path, str], tuple[ImportableRecording, list[str]]],
) -> Imports:
    """The captures of a source in counting order: `source` itself if it is one, else the folders
    right inside it.

    `describe(folder, name)` returns the recording of one folder and warnings; where it raises
    InputError, that capture alone is skipped. A folder that is named like the captures beside it
    and has nothing of one inside is skipped too. Raises InputError where the source holds no
    captures (they should look like `looks_like`), or none can be used.
    """
    source, *inner = list_folders(source)
    captures = [source] if is_capture(source) else list(filter(is_capture, inner))
    if not captures:
        raise InputError(
            f"{source} holds no captures: {looks_like} was looked for in it and in the folders"
            f" inside{explain_stacks([source, *inner])}"
        )
    recordings, warnings, skipped = [], [], []
    stems = {_name_pattern(folder) for folder in captures}
    for folder in inner if captures != [source] else ():
        if folder in captures:
            continue
        if _name_pattern(folder) in stems:
            skipped.append(Skipped(folder.name, f"it holds no frames ({looks_like})"))
        else:
            warnings.append(
                f"folder {folder.name} was left aside: it holds no capture ({looks_like})"
            )
    for folder in captures:
        try:
            name = f"{prefix}_{folder.name}" if prefix else folder.name
            recording, more = describe(folder, new_name(plain_name(name, "capture")))
        except InputError as error:
            skipped.append(Skipped(folder.name, str(error)))
        except Exception as error:  # a plugin's own fault
            fault = (
                f"its layout failed, {type(error).__name__}: {error}; report it to the layout's"
                " maker"
            )
            skipped.append(Skipped(folder.name, fault))
        else:
            recordings.append(recording)
            warnings += more
    if not recordings:
        raise none_usable(skipped)
    for name in (names := [recording.name for recording in recordings]):
        if names.count(name) > 1:
            raise InputError(f"several folders of {source} would be called {name}", "rename one")
    return Imports(recordings, warnings, skipped)


_CAMERAS = tuple(
    (re.compile(rf"(?<![a-zA-Z]){first}(?![a-zA-Z0-9])", re.IGNORECASE), second)
    for first, second in (("left", "right"), ("l", "r"), ("cam0", "cam1"), ("camera0", "camera1"))
)
"""How names of files and folders say which of two cameras they are of."""


def pair_cameras(imports: Imports) -> Imports:
    """Join the captures of two cameras, if that is what all captures of a source are: those of the
    first have a name with left, L, cam0 or camera0 in it, of the folder or of every file, and each
    of their files has a namesake with right, R, cam1 or camera1. Where a description names the
    cameras, nothing is joined by names."""
    if any(each.second for each in imports.recordings):
        return imports
    pairs = [pair for each in imports.recordings if (pair := _find_pair(each))]
    of_second = {file for pair in pairs if pair.second for file in pair.second.files}
    own = {file for pair in pairs for file in pair.files}
    if not pairs or any(own.union(of_second).isdisjoint(each.files) for each in imports.recordings):
        return imports
    text = f"{join_names([pair.name for pair in pairs], 3)}: taken by two cameras, by their names"
    pairs = [
        replace(pair, unknown=tuple(file for file in pair.unknown if file not in of_second))
        for pair in pairs
    ]
    return replace(imports, recordings=pairs, messages=[*imports.messages, text])


def _find_pair(recording: ImportableRecording) -> ImportableRecording | None:
    """Return a recording of the first camera with that of the second; None for others."""
    for is_first, second in _CAMERAS:
        files = tuple(_name_alike(file, is_first, second) for file in recording.files)
        if files and all(file_of(file).is_file() for file in files):
            name = is_first.sub("", recording.name).strip("_- ") or recording.source.parent.name
            other = replace(recording, files=files, source=files[0].parent)
            return replace(recording, name=plain_name(name, "capture"), second=other)
    return None


def _name_alike(file: Path, is_first: re.Pattern[str], second: str) -> Path:
    """Return where the second camera's image of a file of the first is: the name of the file, else
    of its folder, names the other camera in the same case. The folder of a file without one."""
    own = file_of(file)
    for part in (own, own.parent):
        if found := is_first.search(part.name):
            written = second.upper() if found[0].isupper() else second
            if found[0].istitle() and len(second) > 1:
                written = second.capitalize()
            name = part.name[: found.start()] + written + part.name[found.end() :]
            return part.parent.joinpath(name, *file.relative_to(part).parts)
    return own.parent


def none_usable(skipped: Sequence[Skipped]) -> InputError:
    """Return the error that states why each capture of a source was skipped; each reason once."""
    if len(skipped) == 1:
        return InputError(str(skipped[0]))
    reasons = defaultdict[str, list[str]](list)
    for each in skipped:
        reasons[each.reason.removeprefix(f"{each.name}: ")].append(each.name)
    shown = [
        f"{join_names(names, 3)}: {reason}"
        for reason, names in list(reasons.items())[:_MOST_REASONS]
    ]
    more = [f"and {len(reasons) - len(shown)} more reasons"] if len(reasons) > len(shown) else []
    return InputError(
        f"none of the {len(skipped)} captures can be imported. " + "; ".join(shown + more)
    )


def list_folders(source: Path) -> list[Path]:
    """The folder, and those right inside it in counting order. InputError where it is none."""
    if not expand_user(source).is_dir():
        raise InputError(
            f"{source} is not a folder", "give the folder of a capture, or a folder of such folders"
        )
    source = Path(os.path.abspath(expand_user(source)))  # a link keeps its own name
    inner = [entry for entry in visible(source) if entry.is_dir()]
    return [source, *sorted(inner, key=lambda entry: natural_key(entry.name))]


def visible(folder: Path) -> list[Path]:
    """Return the entries of a folder without hidden files; InputError where it cannot be listed."""
    try:
        return [entry for entry in folder.iterdir() if not entry.name.startswith(".")]
    except OSError as error:
        raise InputError(f"{folder} cannot be listed ({error})", "check its permissions") from error


def unknown_files_warning(folder: Path, files: Sequence[Path]) -> list[str]:
    """A warning that names files which the layout does not know, as a list of one, or of none."""
    if not files:
        return []
    images = [file for file in files if file.suffix.lower() in IMAGE_SUFFIXES]
    shown = join_names([file.name for file in dict.fromkeys((*images, *files))])
    return [f"{folder.parent.name}/{folder.name}: {shown} left aside: not part of the layout"]


def _name_pattern(folder: Path) -> str:
    """Return a folder's name in lower case with every number replaced by "#"."""
    return re.sub(r"\d+", "#", folder.name.lower())
