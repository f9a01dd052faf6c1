"""Periods that a description rounds are known by the drift of the fringes against each other."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from slviewer.fringe.decode import decode
from slviewer.fringe.rounded_periods import find_rounded_periods, replace_periods
from slviewer.fringe.sequence import Frame, PatternSequence
from slviewer.pipeline.import_captures import import_captures
from slviewer.session.store import Session
from tests.facts import missing_facts

pytestmark = pytest.mark.computes
EXACT, ROUNDED = (912 / 70, 912 / 64, 912 / 59), (13.03, 14.25, 15.46)


def make_frames(
    shown: tuple[float, ...], stated: tuple[float, ...], sign: int = 1, gamma: float = 1.0
) -> tuple[PatternSequence, np.ndarray, np.ndarray]:
    """Return a sequence, frames (n, h, w) of fringes with other periods, and their coordinates."""
    rng = np.random.default_rng(0)
    u = np.linspace(20, 880, 1000) + 0.8 * np.sin(np.arange(80) / 17)[:, None]
    frames, images = list[Frame](), list[np.ndarray]()
    for period, name in zip(shown, stated, strict=True):
        for k in range(4):
            frames.append(Frame("phase", "x", step=k, steps=4, period_px=name))
            level = 0.5 + 0.4 * np.cos(2 * np.pi * (u / period + sign * k / 4))
            images.append(200 * level**gamma + 20 + rng.normal(0, 2, u.shape))
    sequence = PatternSequence((912, 1140), tuple(frames), phase_sign=sign)
    return sequence, np.rint(images).astype(np.uint8), u


@pytest.mark.parametrize(("sign", "gamma"), [(1, 1.0), (-1, 1.0), (1, 2.2)])
def test_fringes_of_whole_numbers_are_known_from_rounded_ones(sign: int, gamma: float) -> None:
    sequence, frames, u = make_frames(EXACT, ROUNDED, sign, gamma)
    found = find_rounded_periods(sequence, frames, decoded := decode(sequence, frames, "x"))
    assert found is not None and found.is_taken
    assert found.fringes == (59, 70)
    assert abs(found.fit - 1) < 0.2 and 0 < found.sigma < 0.1
    off = np.nanmean(decoded.phase / (2 * np.pi) * 13.03 - u)
    exact = decode(replace_periods(sequence, "x", found.exact), frames, "x")
    assert abs(np.nanmean(exact.phase / (2 * np.pi) * EXACT[0] - u)) < 0.1 * abs(off)


def test_periods_that_are_what_they_state_stay() -> None:
    sequence, frames, _ = make_frames(ROUNDED, ROUNDED)
    found = find_rounded_periods(sequence, frames, decode(sequence, frames, "x"))
    assert found is not None and found.is_contradicted and not found.is_taken
    for periods in (EXACT, (13.0, 14.0, 15.0), (13.11, 14.25, 15.46)):
        sequence, frames, _ = make_frames(periods, periods)
        assert find_rounded_periods(sequence, frames, decode(sequence, frames, "x")) is None


def import_periods(folder: Path, periods: dict[str, list], frames: np.ndarray) -> dict[str, tuple]:
    """Import frames described with each of the periods, by name; return the sequences and the
    warnings."""
    (folder / "scan").mkdir()
    for i, image in enumerate(frames):
        cv2.imwrite(str(folder / "scan" / f"{i:02d}.png"), image)
    head = 'projector = "912x1140"\norder = "name"\n'
    head += '[[frames]]\nkind = "phase"\naxis = "x"\nsteps = 4\n'
    found = {}
    for name, period_px in periods.items():
        (folder / f"{name}.toml").write_text(f"{head}period_px = {period_px}\n")
        warnings = list[str]()
        import_captures(
            folder / "scan", folder / name, "frames", role="scan",
            sequence=folder / f"{name}.toml", warn=warnings.append,
        )  # fmt: skip
        sequence = Session.open(folder / name).load_capture("scan").sequence
        found[name] = sequence, " ".join(warnings)
    return found


def test_import_takes_whole_fringes_and_says_so(tmp_path: Path) -> None:
    _, frames, _ = make_frames(EXACT, ROUNDED)
    periods = {"rounded": [*ROUNDED], "exact": ["912/70", 14.25, "912/59"]}
    for name, (sequence, said) in import_periods(tmp_path, periods, frames).items():
        assert sequence.periods_px("x") == EXACT[::-1]
        assert bool(missing_facts(said, "59 and 70 fringes", '"912/70"')) == (name == "exact")


@pytest.mark.parametrize(
    ("counts", "stated"), [((73, 72, 64), [12.49, 12.67, 14.25]), ((94, 93, 80), [9.7, 9.81, 11.4])]
)
def test_rounded_beats_of_the_projectors_length(
    tmp_path: Path, counts: tuple[int, ...], stated: list[float]
) -> None:
    """Rounding makes the beat shorter than the projector; 9.7 is 9.70, of two decimals."""
    exact = tuple(912 / count for count in counts)
    _, frames, _ = make_frames(exact, exact)
    ((sequence, said),) = import_periods(tmp_path, {"rounded": stated}, frames).values()
    assert sequence.periods_px("x") == exact[::-1]
    assert not missing_facts(said, f'"912/{counts[0]}"')


@pytest.mark.parametrize("sign", [1, -1])
def test_fringes_of_another_sign_are_mentioned(tmp_path: Path, sign: int) -> None:
    """Fringes alone do not show whether their steps run backwards, or the projector is upside
    down."""
    _, frames, _ = make_frames(EXACT, EXACT, sign)
    ((_, said),) = import_periods(tmp_path, {"exact": ["912/70", 14.25, "912/59"]}, frames).values()
    assert ("phase_sign is -1" in said) == (sign < 0)
