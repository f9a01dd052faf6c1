"""Folders of frames of other programs: each is decoded to the known coordinates, or what the
description or the files have wrong is named."""

from collections import Counter, defaultdict
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from slviewer.errors import SlviewerError
from slviewer.fringe.phase import PhaseMap
from slviewer.pipeline.capture_phases import decode_captures
from slviewer.pipeline.import_captures import import_captures
from slviewer.pipeline.operation import Progress, opened, track
from slviewer.session.importers.guessed_frames import guess_description
from tests.proofs.file_variants.codes import FAULTS, Folder, draw_folder, write_folder
from tests.proofs.proof import Proof

DESCRIPTIONS = ("right", "guessed", "names", *FAULTS)
"""How folders are described: by a TOML that is right, by one that is guessed from the images, by
one whose order of names is not that of the images, or with a fault."""
KINDS = ("right", "said", "WRONG REASON", "SILENT", "TRACEBACK")
"""How an import ends; the last two are faults, as is a refusal of a right description. A reason is
wrong where it has none of the words by which the fault is known."""
COUNT = 20
"""Folders of each description; three times as many of the right one."""
MOST_WRONG_REASONS = 0.1
"""Share of all folders. Faults imitate each other: a wrong period does motion between periods."""
_LEAST_DECODED = 0.6
"""Of the pixels that the projector lights; edges of code cells and of the step are masked."""
_MOST_OFF, _OFF_PX = 0.005, 1.0
"""Share of the decoded pixels that may be this far from their coordinate."""
_BIAS_PX = 0.1


def _compare(folder: Folder, phase: PhaseMap) -> str:
    """Return what differs between decoded and known coordinates; empty where nothing does."""
    code, seen = folder.code, folder.scene.is_seen
    error = (phase.coordinate - folder.scene.coordinates[phase.axis])[phase.mask]
    cell = 0.5 * code.period_px if code.family == "bits" else 0.0
    if np.count_nonzero(phase.mask & seen) < _LEAST_DECODED * np.count_nonzero(seen):
        return f"{np.mean(phase.mask[seen]):.2f} of {phase.axis} is decoded"
    off, bias = np.mean(np.abs(error) > _OFF_PX + cell), np.median(error)
    if off > _MOST_OFF or abs(bias) > max(_BIAS_PX, cell):
        return f"{phase.axis} is {bias:.3g} px off, {100 * off:.1f} % by more than a pixel"
    return ""


def judge(folder: Folder, place: Path) -> tuple[str, str]:
    """Return how the import of a folder ends, of `KINDS`, and what differs or was said."""
    source, said = place / "scan", list[str]()
    write_folder(folder, source)
    toml = folder.toml
    try:
        if folder.wrong == "guessed":
            width, height = folder.code.projector
            guess = guess_description(source, f"{width}x{height}", None)
            if guess.doubts:
                return "said", "; ".join(guess.doubts)
            toml = guess.toml
        (source / "frames.toml").write_text(toml)
        names = import_captures(source, place / "session", role="scan", warn=said.append)
        with opened(place / "session") as session:
            ((_, _, phases),) = decode_captures(session, names, said.append)
    except SlviewerError as error:
        text = " | ".join([str(error), *said])
        is_named = any(word in text for word in folder.reasons)
        return ("said" if is_named else "WRONG REASON"), text
    except Exception as error:  # the fault that is looked for
        return "TRACEBACK", f"{type(error).__name__}: {error}"
    text = " | ".join(said)
    lost = [each for phase in phases.values() if (each := _compare(folder, phase))]
    if not lost:
        return "right", text
    is_named = any(word in text for word in folder.reasons)
    return ("said" if is_named else "SILENT"), f"{'; '.join(lost)} ({text or 'no note'})"


def draw_folders(seed: int, description: str, count: int) -> Iterator[Folder]:
    """Draw folders of one kind of description."""
    wanted = "" if description == "right" else description
    seeds = np.random.SeedSequence([seed, DESCRIPTIONS.index(description)])
    while count:
        folder = draw_folder(np.random.default_rng(seeds.spawn(1)[0]), wanted)
        if folder is not None:
            yield folder
            count -= 1


def prove_codes(scale: float, seed: int, progress: Progress) -> Proof:
    """Import folders of every code and description, and count how that ends."""
    counts, shown = defaultdict[str, Counter[str]](Counter), defaultdict[str, list[str]](list)
    of_each = {name: COUNT * (3 if name == "right" else 1) for name in DESCRIPTIONS}
    folders = {
        f"{name} {i}": folder
        for name, count in of_each.items()
        for i, folder in enumerate(draw_folders(seed, name, max(1, round(scale * count))))
    }
    for title, folder, _ in track(progress, folders):
        name = title.rpartition(" ")[0]
        with TemporaryDirectory() as place:
            kind, text = judge(folder, Path(place))
        counts[name][kind] += 1
        if kind in KINDS[2:]:
            is_fault = kind != "WRONG REASON" or name == "right"
            shown["fault" if is_fault else "reason"].append(
                f"{kind} {name} [{folder.form}]: {text[:400]}"
            )
    rows = [
        {"description": name, "folders": sum(of.values()), **{kind: of[kind] for kind in KINDS}}
        for name, of in counts.items()
    ]
    faults, reasons = shown["fault"], shown["reason"]
    summary = (
        f"{len(folders) - len(faults) - len(reasons)} of {len(folders)} folders are decoded, or"
        f" said why not; {len(reasons)} are refused for another reason"
    )
    holds = not faults and len(reasons) <= max(1, MOST_WRONG_REASONS * len(folders))
    record = {"descriptions": {name: dict(of) for name, of in counts.items()}, **shown}
    return Proof(holds, scale, rows, record, below=[summary, *faults[:40], *reasons[:40]])
