"""The TOML of images that nobody described, as they themselves suggest it."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path

from slviewer.errors import InputError
from slviewer.fringe.sequence import Frame, Size, parse_size
from slviewer.session.importers.guess import Guess, guess_sequence
from slviewer.session.importers.images import DEFAULT_CHANNEL, Channel, read_frames
from slviewer.session.importers.imported import explain_stacks, images_by_name, list_folders
from slviewer.session.names import join_names
from slviewer.session.toml import format_value, table_lines


@dataclass(frozen=True)
class GuessedDescription:
    """``toml``: the text, whose comments say what supports each entry. ``summary``: a line for each
    group of images, and the assumptions. ``doubts``: what stays open; empty where the description
    is sure. ``is_complete``: whether every image is described, so that the TOML can be imported."""

    toml: str
    summary: tuple[str, ...]
    doubts: tuple[str, ...]
    is_complete: bool


def guess_description(
    folder: Path, projector: str | None, channel: Channel | None
) -> GuessedDescription:
    """Guess the pattern sequence of a folder's images, in natural order of their names, as a TOML
    with doubts; nothing is saved. ``projector``: width x height, px, where it is known.

    Of a folder of captures, the first is read. Raises InputError where there are no images, or they
    cannot belong to one capture (other sizes, damaged).
    """
    source, files = folder, list[Path]()
    folders = list_folders(source)
    for folder in folders:
        if len(files := images_by_name(folder)) >= 3:
            break
    else:
        raise InputError(
            f"{source} and the folders in it hold fewer than three images{explain_stacks(folders)}",
            "give the folder of a capture",
        )
    images = read_frames(files, channel=channel or DEFAULT_CHANNEL)
    size = None if projector is None else parse_size(projector)
    guess = guess_sequence(images.stack, size)
    names = [file.name for file in files]
    shown = (channel or DEFAULT_CHANNEL) if images.in_colour else channel
    other = "; the green of these colour images was read: try --channel red, blue or max"
    hint = other if images.in_colour and channel is None and not any(guess.frames) else ""
    doubts = tuple(
        f"{_format_span(names, indices)}: {text}{hint}" for indices, text in guess.doubts
    )
    toml = _format_toml(folder, names, guess, shown, size, doubts)
    is_binary = guess.sequence is not None and guess.sequence.binary
    summary = (*_summarise_frames(names, guess.frames, is_binary), *guess.notes)
    return GuessedDescription(toml, summary, doubts, guess.sequence is not None)


def _summarise_frames(
    names: list[str], frames: Sequence[Frame | None], is_binary: bool
) -> list[str]:
    """Return a line for each group of neighbouring images of one kind and axis."""

    def describe(index: int) -> str:
        """Return what an image shows, the same for all images of a group."""
        frame = frames[index]
        if frame is None:
            return "not identified"
        along = f" along {frame.axis}" if frame.axis else ""
        if frame.kind == "phase":
            return f"{frame.steps} phase steps{along}, period {frame.period_px:g} px"
        if frame.kind in ("gray", "inverse"):
            return f"{'binary' if is_binary else 'Gray'} code of {frame.bits} bits{along}"
        return f"{frame.kind}{along}"

    groups = groupby(range(len(names)), key=describe)
    return [f"{_format_span(names, tuple(images))}: {text}" for text, images in groups]


def _format_span(names: list[str], indices: tuple[int, ...]) -> str:
    """Format the names at some indices: "first to last" where they are consecutive, else a list."""
    whole = len(indices) > 1 and indices == tuple(range(indices[0], indices[-1] + 1))
    return (
        f"{names[indices[0]]} to {names[indices[-1]]}"
        if whole
        else join_names([names[i] for i in indices])
    )


def _format_toml(
    folder: Path,
    names: list[str],
    guess: Guess,
    channel: Channel | None,
    projector: Size | None,
    doubts: tuple[str, ...],
) -> str:
    """Return the text of the guessed TOML, with comments for its evidence and doubts."""
    described = guess.sequence.to_dict() if guess.sequence else {}
    lines = [f"# Guessed from the {len(names)} images of {folder.name}."]
    lines += [f"# UNSURE: {doubt}" for doubt in doubts]
    lines += [f"# {note}" for note in guess.notes]
    if projector is None:
        lines.append('# projector = "1280x800"  # unknown: needed to calibrate and to reconstruct')
    else:
        lines.append(f'projector = "{projector[0]}x{projector[1]}"')
    lines.append('order = "name"  # all images of a folder in natural order of their names')
    if channel is not None:
        lines.append(f"channel = {format_value(channel)}")
    # Without gray_origin the import estimates it from the images.
    keys = ("phase_sign", "phase_offset", "gray_cell_px", "relative", "code")
    lines += table_lines({key: described[key] for key in keys if key in described})
    evidence: dict[int, list[str]] = {}
    for image, text in guess.evidence:
        evidence.setdefault(image, []).append(text)
    doubtful = {
        image: text for images, text in guess.doubts if len(images) < len(names) for image in images
    }
    for index, (name, frame) in enumerate(zip(names, guess.frames, strict=True)):
        lines += ["", *(f"# {text}" for text in evidence.get(index, []))]
        if index in doubtful:
            lines.append(f"# UNSURE: {doubtful[index]}")
        if frame is None:
            lines.append(f"# [[frame]] of {name}: add its kind")
            continue
        lines.append(f"[[frame]]  # {name}")
        lines += table_lines(frame.to_dict())
    return "\n".join(lines) + "\n"
