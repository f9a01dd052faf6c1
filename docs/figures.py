"""Write or check the figures in README and docs: the output of the commands that the pages name.

    python docs/figures.py [--check] [--slow] [--pictures] [PAGE ...]

A page names a command in a comment, and its output follows up to the end mark:

    <!-- figures: slviewer plan-rig webcam-1080p pocket-720p 500 -->
    <!-- end of figures -->

Single numbers in a sentence or a table follow a comment ``<!-- = NAME -->``, never at the start of
a line, and end with ``<!-- . -->``; `SOURCES` names the commands, and how the numbers follow from
their JSON. These, and ``slow figures:``, need commands of minutes, which run with ``--slow``.
``--check`` changes nothing, and ends with status 1 where a number is off by more than 2 % and more
than its last digit. ``--pictures`` runs the examples and writes their pictures into
docs/images/gallery, and those of docs/diagrams.py into docs/images/diagrams.
"""

import argparse
import contextlib
import importlib
import io
import json
import os
import re
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable
from functools import cache
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
PROOFS = "python -m tests.proofs "
sys.path.insert(0, str(ROOT))

from slviewer import cli  # noqa: E402

EXAMPLES = ROOT / "docs" / "examples"
GALLERY = ROOT / "docs" / "images" / "gallery"
BLOCK = re.compile(
    r"<!-- (?P<slow>slow )?figures: (?P<command>[^\n]+) -->\n(?P<body>.*?)<!-- end of figures -->",
    re.DOTALL,
)
NUMBER = re.compile(r"\d+(?:\.\d+)?")
TOLERANCE = 0.02
VALUE = re.compile(r"<!-- = (?P<name>[^\n>]+) -->(?P<number>[\d.]+)<!-- \. -->")


def compute_values(data: dict[str, Any]) -> dict[str, float]:
    """Return the numbers of the pages by name, from the JSON of ``reproduce``."""
    inside = {
        name: each for name, each in data["planes"].items() if each["incidence"]["R2"] >= 87.0
    }
    values = {"inside ratio": data["in_range_ratio"]}
    for group, captures in (
        ("planes", data["planes"]),
        ("inside", inside),
        ("spheres", data["spheres"]),
    ):
        for model in ("stereo", "pixelwise"):
            values[f"{group} {model}"] = _mean(
                each["models"][model]["rms_mm"] for each in captures.values()
            )
        values[f"{group} floor"] = _mean(
            each["models"]["stereo"]["noise_floor_mm"] for each in captures.values()
        )
    for model in ("stereo", "pixelwise"):
        values[f"radius {model}"] = _mean(
            each["models"][model]["radius_mm"] for each in data["spheres"].values()
        )
        values[f"spacing {model}"] = data["spacing_rms_mm"][model]
    for place, plane in (("front", "plane_01"), ("behind", "plane_07")):
        models = data["planes"][plane]["models"]
        values[f"{place} ratio"] = models["stereo"]["rms_mm"] / models["pixelwise"]["rms_mm"]
    for name, pair in data["merge"]["pairs"].items():
        values[f"merge {name[-2:]}"] = pair["point_to_point_rms_mm"]
    return values


def _mean(numbers: Iterable[float]) -> float:
    """Return the mean of some numbers."""
    listed = list(numbers)
    return sum(listed) / len(listed)


def compute_accuracy(data: dict[str, Any]) -> dict[str, float]:
    """Return the numbers of the pages by name, from the proof of accuracy's JSON."""
    record = data["accuracy"]
    means = {
        model: [
            _mean(plane["rms_mm"][model] for plane in rig["planes"].values())
            for rig in record["rigs"]
        ]
        for model in ("stereo", "splined", "floor")
    }
    largest = _find_largest(record["checks"])
    return {
        "accuracy stereo least": min(means["stereo"]),
        "accuracy stereo most": max(means["stereo"]),
        "accuracy splined": max(means["splined"]),
        "accuracy floor": max(means["floor"]),
        **{
            f"accuracy {region}": largest[f"splined over the floor in {region}"]
            for region in ("R1", "R2", "R3")
        },
        "accuracy radius": largest["largest error of a sphere's radius in mm"],
        "accuracy spacing": largest["largest error of a spacing in mm"],
    }


def compute_registration(data: dict[str, Any]) -> dict[str, float]:
    """Return the numbers of the pages by name, from the proof of registration's JSON."""
    record = data["registration"]
    largest, surface = _find_largest(record["checks"]), record["surface"]
    return {
        "registration shift": largest["error of its place in mm"],
        "registration turn": largest["error of its turn in degrees"],
        "registration loop": largest["loop error in mm round all scans"],
        "registration predicted shift": largest["predicted over true error of the shift"],
        "registration predicted turn": largest["predicted over true error of the turn"],
        "registration single least": min(surface["single_mm"].values()),
        "registration single most": max(surface["single_mm"].values()),
        "registration fused": surface["fused_mm"],
        "registration mesh": surface["turned_mm"],
    }


def compute_edges(data: dict[str, Any]) -> dict[str, float]:
    """Return the numbers of the pages by name, from the proof of edges's JSON."""
    rows = {row["scene"]: row for row in data["edges"]["rows"]}
    return {
        f"edges {column} {scene.rpartition(' blur ')[2]}": row[title]
        for scene, row in rows.items()
        if scene.startswith("printed plane")
        for column, title in (("without", "without, µm"), ("with", "with, µm"), ("ratio", "ratio"))
    }


def compute_surfaces(data: dict[str, Any]) -> dict[str, float]:
    """Return the numbers of the pages by name, from the proof of surfaces's JSON."""
    values = {}
    for surface, sequences in data["surfaces"]["surfaces"].items():
        for sequence, errors in sequences.items():
            values[f"surfaces {surface}; {sequence}"] = errors["rms_mm"]
        p18 = sequences["p18"]
        values[f"surfaces {surface}; ratio"] = p18["rms_mm"] / sequences["micro"]["rms_mm"]
        for name, share in (("masked", "gross_caught"), ("caught", "caught"), ("lost", "lost")):
            if p18[share] is not None:  # no point is wrong there
                values[f"surfaces {surface}; {name}"] = 100 * p18[share]
    return values


def _find_largest(checks: Iterable[dict[str, Any]]) -> dict[str, float]:
    """Return {figure: its largest value} of all rigs."""
    largest: dict[str, float] = {}
    for check in checks:
        if check["value"] is not None:
            largest[check["what"]] = max(check["value"], largest.get(check["what"], check["value"]))
    return largest


SOURCES: dict[str, tuple[str, Callable[[dict[str, Any]], dict[str, float]]]] = {
    "accuracy": ("python -m tests.proofs accuracy --quick", compute_accuracy),
    "registration": ("python -m tests.proofs registration --quick", compute_registration),
    "edges": ("python -m tests.proofs edges", compute_edges),
    "surfaces": ("python -m tests.proofs surfaces", compute_surfaces),
    "": ("slviewer reproduce --quick", compute_values),
}
"""{first word of a number's name: the command, some minutes, and the numbers that follow from
it}."""


def find_value(name: str) -> float:
    """Return a number of the pages by name. Raises KeyError."""
    group = name.partition(" ")[0]
    return compute_group(group if group in SOURCES else "")[name]


@cache
def compute_group(group: str) -> dict[str, float]:
    """Run the command of a group of `SOURCES`, and return its numbers by name."""
    command, compute = SOURCES[group]
    with tempfile.TemporaryDirectory() as folder:
        out = f" --out {folder}/reproduction" if "reproduce" in command else ""
        run(f"{command}{out} --json {folder}/result.json")
        return compute(json.loads(Path(folder, "result.json").read_text(encoding="utf-8")))


def find_pages() -> list[Path]:
    """Return all pages that may hold figures."""
    docs = [page for page in (ROOT / "docs").rglob("*.md") if "_build" not in page.parts]
    return [ROOT / "README.md", *sorted(docs)]


def run(command: str) -> str:
    """Return what a command of slviewer prints, as a block of text."""
    main, arguments = cli.main, shlex.split(command.removeprefix("slviewer "))
    if command.startswith(PROOFS):
        sys.path.insert(0, str(ROOT))
        main = importlib.import_module("tests.proofs.__main__").main
        arguments = shlex.split(command.removeprefix(PROOFS))
    elif not command.startswith("slviewer "):
        raise SystemExit(f"{command}: figures come from commands of slviewer and from proofs")
    printed = io.StringIO()
    with (
        tempfile.TemporaryDirectory() as folder,
        contextlib.chdir(folder),
        contextlib.redirect_stdout(printed),
    ):
        status = main(arguments)
    if status:
        raise SystemExit(f"{command} failed with status {status}")
    return f"\n```text\n{printed.getvalue().rstrip()}\n```\n\n"


def agree(written: str, printed: str) -> bool:
    """Whether two texts are equal but for small differences of their numbers."""
    if NUMBER.sub("#", written) != NUMBER.sub("#", printed):
        return False
    pairs = zip(NUMBER.findall(written), NUMBER.findall(printed), strict=True)
    return all(
        abs(float(a) - float(b)) <= max(TOLERANCE * float(b), _last_digit(a)) for a, b in pairs
    )


def _last_digit(number: str) -> float:
    """Return one unit of the last digit of a number."""
    return 1.01 * 10.0 ** -len(number.partition(".")[2])


def update(page: Path, check: bool, slow: bool) -> bool:
    """Write the figures of a page, or check them; returns whether they were right."""
    text = page.read_text(encoding="utf-8")
    right = True

    def replace(match: re.Match[str]) -> str:
        """Return the block with the command's output."""
        nonlocal right
        if match["slow"] and not slow:
            return match[0]
        printed = run(match["command"])
        if agree(match["body"], printed):
            return match[0]
        right = False
        print(f"{page.name}: {match['command']}\n--- written{match['body']}--- printed{printed}")
        return (
            f"<!-- {match['slow'] or ''}figures: {match['command']} -->\n{printed}<!-- end of"
            " figures -->"
        )

    def replace_value(match: re.Match[str]) -> str:
        """Return the number with its marks."""
        nonlocal right
        digits = len(match["number"].partition(".")[2])
        number = f"{find_value(match['name']):.{digits}f}"
        if agree(match["number"], number):
            return match[0]
        right = False
        print(f"{page.name}: {match['name']} is {number}, written {match['number']}")
        return f"<!-- = {match['name']} -->{number}<!-- . -->"

    changed = BLOCK.sub(replace, text)
    if slow:
        changed = VALUE.sub(replace_value, changed)
    if not check and changed != text:
        page.write_text(changed, encoding="utf-8")
    return right


def draw_pictures() -> None:
    """Run the scripts and notebooks of docs/examples, and write their pictures for the site's
    gallery."""
    GALLERY.mkdir(parents=True, exist_ok=True)
    environment = os.environ | {"PYTHONPATH": str(ROOT), "MPLBACKEND": "agg"}
    with tempfile.TemporaryDirectory() as images:
        fetch = [sys.executable, "-m", "slviewer.cli", "fetch", "sample", images]
        subprocess.run(fetch, env=environment, check=True)
        arrays = [sys.executable, str(EXAMPLES / "arrays.py"), images, "circles:21x16:9"]
        subprocess.run([*arrays, str(GALLERY / "arrays.png")], env=environment, check=True)
    for script in sorted(EXAMPLES.glob("*.py")):
        # its only argument is a picture's path
        if "sys.argv[1:]" not in script.read_text(encoding="utf-8"):
            picture = GALLERY / f"{script.stem}.png"
            subprocess.run([sys.executable, str(script), str(picture)], env=environment, check=True)
    subprocess.run(
        [sys.executable, str(ROOT / "docs" / "diagrams.py")], env=environment, check=True
    )
    for notebook in sorted(EXAMPLES.glob("*.ipynb")):
        subprocess.run(
            [sys.executable, __file__, "--notebook", str(notebook)], env=environment, check=True
        )
    for picture in GALLERY.glob("*.png"):
        _reduce(picture)


def _reduce(picture: Path) -> None:
    """Reduce a picture to 900 px of width and 128 colours, as it is part of every installation."""
    from PIL import Image

    image = Image.open(picture).convert("RGB")
    image.thumbnail((900, 900))
    image.quantize(128, dither=Image.Dither.NONE).save(picture, optimize=True)


def run_notebook(notebook: Path, folder: Path | None = None, scale: float | None = None) -> None:
    """Run the code of a notebook in this process; write the pictures of cell k as NAME_k.png into
    ``folder``.

    ``scale`` replaces the resolution that the notebook states, to be quicker.
    """
    import matplotlib.pyplot as plt

    names: dict[str, object] = {"__name__": "__main__"}
    for k, cell in enumerate(json.loads(notebook.read_text(encoding="utf-8"))["cells"]):
        code = "".join(cell["source"])
        if cell["cell_type"] != "code":
            continue
        if scale is not None:
            code = re.sub(r"(?m)^SCALE = [\d.]+", f"SCALE = {scale}", code)
        exec(compile(code, notebook.name, "exec"), names)  # noqa: S102 - our own notebook
        if plt.get_fignums():
            if folder is not None:
                plt.savefig(folder / f"{notebook.stem}_{k}.png", dpi=80)
            plt.close("all")


def main() -> int:
    """Run the commands of the pages; returns the exit status."""
    assert __doc__ is not None
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("pages", nargs="*", type=Path, help="by default README and all of docs")
    parser.add_argument("--check", action="store_true", help="compare, and change nothing")
    parser.add_argument("--slow", action="store_true", help="also commands that take minutes")
    parser.add_argument(
        "--pictures", action="store_true", help="run the examples, and write their pictures"
    )
    parser.add_argument("--notebook", type=Path, help="run one notebook, and write its pictures")
    given = parser.parse_args()
    if given.notebook:
        run_notebook(given.notebook, GALLERY)
        return 0
    if given.pictures:
        draw_pictures()
        return 0
    right = [
        update(page.resolve(), given.check, given.slow) for page in given.pages or find_pages()
    ]
    return int(given.check and not all(right))


if __name__ == "__main__":
    sys.exit(main())
