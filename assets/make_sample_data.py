"""Render the sample data that ships with slviewer: make_sample_data.py [ARCHIVE]. The same archive every time.

Six target poses (both axes), and a plane, a sphere and an object (axis x), of the simulated rig of the Letter at 15 %
of its resolution, with its noise: folders of lossless PNG images, each beside a description of its pattern sequence.
"""

import sys
import zipfile
from pathlib import Path

import cv2

from slviewer.fringe.presets import complementary
from slviewer.fringe.sequence import one_axis
from slviewer.session.toml import describe_sequence
from slviewer.simulation.plans import letter_plan
from slviewer.simulation.renderer import Renderer
from slviewer.simulation.rig import letter

POSES = 6
SCANS = {"scan": "plane_04", "sphere": "sphere_3", "object": "object_r2"}
"""{folder: capture}"""

README = """Simulated captures of one camera and one projector, rendered by assets/make_sample_data.py of slviewer.
Licence: MIT. Target in poses/: circles:21x16:9. The sphere's radius is 98 mm.
"""


def main(archive: Path) -> None:
    rig = letter(0.15, 0, local_distortion_px=0.0)
    plan = letter_plan(rig, poses=POSES)
    both = complementary(rig.projector.size, steps=4)
    names = {f"pose_{i:02d}": "poses" for i in range(1, POSES + 1)} | {v: k for k, v in SCANS.items()}
    with zipfile.ZipFile(archive, "w") as packed:

        def add(name: str, data: bytes) -> None:
            entry = zipfile.ZipInfo(f"sample/{name}", (2026, 1, 1, 0, 0, 0))
            packed.writestr(entry, data)

        add("README.txt", README.encode())
        for seed, (name, folder) in enumerate(names.items()):
            sequence = both if folder == "poses" else one_axis(both, "x")
            frames = Renderer(rig, plan[name]).capture(sequence, seed)
            files = [f"{k:02d}.png" for k in range(len(frames))]
            for file, frame in zip(files, frames, strict=True):
                done, encoded = cv2.imencode(".png", frame, [cv2.IMWRITE_PNG_COMPRESSION, 9])
                assert done
                add(f"{folder}/{name}/{file}", encoded.tobytes())
            if name == "pose_01" or folder != "poses":
                add(f"{folder}/sequence.toml", describe_sequence(sequence, files).encode())


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent / "datasets" / "sample.zip")
