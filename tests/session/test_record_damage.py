"""Records of a session with an entry of another value or type are named, and end no command in a
traceback."""

import json
import os
import random
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from facts import raises
from fuzz import VALUES

from slviewer.calibration.splined.model import SplinedModel
from slviewer.errors import DamagedError, SlviewerError
from slviewer.pipeline.models import COMPILED, available_models, load_model, load_projector
from slviewer.session.results import read_meta
from slviewer.session.store import Session

Run = Callable[..., tuple[int, str, str]]
pytestmark = pytest.mark.computes
WRONG = [value for value in VALUES if not isinstance(value, int) or abs(value) < 2**63]


def list_places(data: Any) -> Iterator[tuple[Any, Any]]:
    """Yield (container, key) of every value."""
    keys = data if isinstance(data, dict) else range(len(data)) if isinstance(data, list) else ()
    for key in keys:
        yield data, key
        yield from list_places(data[key])


def damage_record(path: Path, rng: random.Random) -> str:
    """Replace or remove an entry of a record, and return which."""
    data = json.loads(path.read_text())
    places = list(list_places(data))
    # entries of long lists are alike: names of entries are as likely
    inside, key = rng.choice(
        [p for p in places if isinstance(p[1], str)] if rng.random() < 0.6 else places
    )
    old = inside[key]
    if rng.random() < 0.1:
        del inside[key]
        how = "removed"
    else:
        inside[key] = rng.choice(WRONG)
        how = repr(inside[key])[:40]
    path.unlink()
    path.write_text(json.dumps(data))
    return f"{path.name}: {key!r} {str(old)[:30]} -> {how}"


def read_everything(folder: Path) -> None:
    """Read what a session holds, as commands and the wizard do; damage is a SlviewerError."""
    readers: list[Callable[[Session], object]] = [
        lambda store: [capture.size for capture in store.captures()],
        lambda store: [load_model(store, name) for name in available_models(store)],
        load_projector,
    ]
    for read in readers:
        try:
            with Session.open(folder) as store:
                read(store)
        except SlviewerError as error:
            assert str(error).isprintable()


def check_damage(recorded: Path, folder: Path, seed: int, run: Run) -> str:
    """Damage one record of a copy of the session, read it, and return what is wrong."""
    rng = random.Random(seed)
    shutil.copytree(recorded / "session", folder, copy_function=os.link)
    by_kind = dict[str, list[Path]]()
    for file in sorted(folder.rglob("*.json")):
        by_kind.setdefault("/".join(file.relative_to(folder).parts[:2]), []).append(file)
    path = rng.choice(by_kind[rng.choice(sorted(by_kind))])
    how = f"seed {seed}, {path.relative_to(folder).parent}/{damage_record(path, rng)}"
    try:
        read_everything(folder)
        for command in (("inspect",), ("inspect", "--check"), ("measurements",)):
            status, out, err = run(command[0], folder, *command[1:])
            if status not in (0, 1) or "Traceback" in err or "unexpected" in err:
                return f"{how}: {err[-500:]}"
            is_checked = "--check" in command and path.name == "meta.json"
            if is_checked and path.relative_to(folder).parent.name not in out + err:
                return f"{how}: not named"
    except Exception as error:
        return f"{how}: {error!r}"
    finally:
        shutil.rmtree(folder)
    return ""


@pytest.mark.parametrize("seeds", [range(2), pytest.param(range(2, 60), marks=pytest.mark.slow)])
def test_damaged_records_are_named(recorded: Path, tmp_path: Path, run: Run, seeds: range) -> None:
    wrong = [check_damage(recorded, tmp_path / "s", seed, run) for seed in seeds]
    assert not [text for text in wrong if text]


@pytest.mark.parametrize(
    "name", ["far", *(pytest.param(n, marks=pytest.mark.slow) for n in ("axis", "centre", "step"))]
)
def test_a_compiled_model_with_a_damaged_number_is_named_and_compiled_anew(
    recorded: Path, tmp_path: Path, run: Run, name: str
) -> None:
    folder = tmp_path / "s"
    shutil.copytree(recorded / "session", folder)
    path = folder / "results" / COMPILED / "meta.json"
    for value in ([1.0], None, "z", {}, float("nan")):
        meta = json.loads((recorded / "session" / "results" / COMPILED / "meta.json").read_text())
        meta["compiled"][name] = value
        path.write_text(json.dumps(meta))
        with raises(DamagedError, name):
            read_meta(path.parent)
    status, out, err = run("inspect", folder, "--check")
    assert status == 1
    assert COMPILED in out + err
    with Session.open(folder) as store:
        assert isinstance(load_model(store, "splined"), SplinedModel)
