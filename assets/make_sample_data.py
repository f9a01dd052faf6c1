"""Render a data set of simulated images: make_sample_data.py [sample|letter] [ARCHIVE].

Folders of lossless PNG images, each beside a description of its pattern sequence, of the simulated
rig of the Letter: `sample`, which ships with slviewer, has a sixth of the resolution and ideal
lenses; `letter`, which is attached to releases, has half the resolution, local distortion, more
target poses and scans in front of and behind them. An archive is the same every time on processors
of one kind; others round a few grey values differently.

`--release URL` writes assets/datasets/released.json: where the archive will be, and its hash. The
next build ships it.
"""

import argparse
import hashlib
import json
import zipfile
from dataclasses import dataclass
from pathlib import Path

import cv2

from slviewer.fringe.presets import complementary
from slviewer.fringe.sequence import one_axis
from slviewer.session.toml import describe_sequence
from slviewer.simulation.plans import letter_plan
from slviewer.simulation.renderer import Renderer
from slviewer.simulation.rig import letter

DATASETS = Path(__file__).parent / "datasets"
README = """Simulated captures of one camera and one projector, rendered by
assets/make_sample_data.py of slviewer.
Licence: MIT. Target in poses/: circles:21x16:9. The sphere's radius is 98 mm.
"""


@dataclass(frozen=True)
class Recipe:
    """What is rendered: the camera's resolution as a share of 1600x1200, the displacement by local
    distortion (None: the rig's own), the number of target poses and of phase steps, and the folders
    {name: captures} of scans.
    """

    scale: float
    local_distortion_px: float | None
    poses: int
    steps: int
    scans: dict[str, tuple[str, ...]]


RECIPES = {
    "sample": Recipe(
        0.15, 0.0, 8, 4, {"scan": ("plane_04",), "sphere": ("sphere_3",), "object": ("object_r2",)}
    ),
    "letter": Recipe(
        0.5,
        None,
        8,
        8,
        {
            "planes": ("plane_01", "plane_04", "plane_07"),
            "spheres": ("sphere_1", "sphere_3", "sphere_5"),
            "objects": ("object_r1", "object_r2", "object_r3"),
        },
    ),
}


def render(name: str, archive: Path) -> None:
    """Render a data set into a zip. The poses have both axes, the scans the x axis."""
    recipe = RECIPES[name]
    rig = letter(recipe.scale, 0, local_distortion_px=recipe.local_distortion_px)
    plan = letter_plan(rig, poses=recipe.poses)
    both = complementary(rig.projector.size, steps=recipe.steps)
    folders = {"poses": [f"pose_{i:02d}" for i in range(1, recipe.poses + 1)]} | recipe.scans
    seed = 0
    archive.parent.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(archive, "w") as packed:

        def add(path: str, data: bytes) -> None:
            packed.writestr(zipfile.ZipInfo(f"{name}/{path}", (2026, 1, 1, 0, 0, 0)), data)

        add("README.txt", README.encode())
        for folder, captures in folders.items():
            sequence = both if folder == "poses" else one_axis(both, "x")
            files = [f"{k:02d}.png" for k in range(len(sequence.frames))]
            for capture in captures:
                frames = Renderer(rig, plan[capture]).capture(sequence, seed)
                seed += 1
                for file, frame in zip(files, frames, strict=True):
                    done, encoded = cv2.imencode(".png", frame, [cv2.IMWRITE_PNG_COMPRESSION, 9])
                    assert done
                    add(f"{folder}/{capture}/{file}", encoded.tobytes())
                if capture == captures[0]:
                    add(f"{folder}/sequence.toml", describe_sequence(sequence, files).encode())


def main() -> None:
    """Render the data set that the command line names."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("name", nargs="?", choices=RECIPES, default="sample")
    parser.add_argument(
        "archive",
        nargs="?",
        type=Path,
        help="default: assets/datasets/sample.zip, or letter.zip here",
    )
    parser.add_argument("--release", metavar="URL", help="the folder of the release's files")
    options = parser.parse_args()
    archive = options.archive or (
        DATASETS / "sample.zip" if options.name == "sample" else Path(f"{options.name}.zip")
    )
    render(options.name, archive)
    data = archive.read_bytes()
    if options.release:
        record = {
            "url": f"{options.release.rstrip('/')}/{archive.name}",
            "sha256": hashlib.sha256(data).hexdigest(),
            "bytes": len(data),
        }
        (DATASETS / "released.json").write_text(
            json.dumps({options.name: record}, indent=2) + "\n", encoding="utf-8"
        )
    print(f"{archive}: {len(data) / 1e6:.1f} MB, {hashlib.sha256(data).hexdigest()}")


if __name__ == "__main__":
    main()
